# SPDX-License-Identifier: Apache-2.0
"""Ways and roads from the tests of the models; the car of other code is one of the benchmarks."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))  # for other_car
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "models"))  # for ways
from ways import drive, ground, rough

__all__ = ["drive", "ground", "rough"]
