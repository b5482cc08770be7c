# SPDX-License-Identifier: Apache-2.0
"""Where the tests of the exports find what they share with the benchmarks."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))  # for fmu_importers
