# SPDX-License-Identifier: Apache-2.0
"""The vehicle that the tests of the effects share; ``effect_cases`` beside this holds the rest."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from suspension_twin.vehicle.twin import Twin, load_twin

sys.path.insert(0, str(Path(__file__).resolve().parent))


@pytest.fixture(scope="session")
def twin() -> Twin:
    path = Path(__file__).resolve().parents[2] / "config" / "twins" / "ford_mondeo_mk4.yaml"
    return load_twin(path).model_copy(update={"effects": (), "road": None})
