# SPDX-License-Identifier: Apache-2.0
"""The rig in MuJoCo and the quarter car: the same corner, by code that shares nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from suspension_twin.gap.rig import simulate_rig
from suspension_twin.vehicle.twin import load_twin


@pytest.fixture(scope="module")
def rig(benchmarks_on_the_path: None) -> ModuleType:
    return import_module("rig")


@pytest.mark.parametrize("kind", ["sweep", "drops", "random"])
def test_a_corner_with_straight_characteristics_is_the_twins(
    rig: ModuleType, kind: str, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within half a per cent in every channel, wheels in the air after the drops."""
    monkeypatch.setattr(rig, "NOISE", dict.fromkeys(rig.NOISE, 0.0))
    corner = replace(rig.Corner(), knee=1e6, stiffening=0.0)
    twin = load_twin(repository / "config" / "twins" / "quarter_car.yaml").with_changes(
        {
            "vehicle.sprung_mass": corner.sprung,
            "vehicle.unsprung_mass": corner.unsprung,
            "vehicle.tyre.vertical_stiffness": corner.tyre,
            "vehicle.spring": {"compression": (1.0,), "force": (corner.spring,)},
            "vehicle.damper_push": {"velocity": (1.0,), "force": (corner.push,)},
            "vehicle.damper_pull": {"velocity": (1.0,), "force": (corner.pull,)},
        }
    )
    result = simulate_rig(rig.run_of(corner, kind, 5.0, np.random.default_rng(0)), twin)
    assert (result.response.channel("tyre_force").min() == 0.0) == (kind == "drops")
    for name, rms in result.gap.channels.items():
        assert rms < 0.005 * np.std(result.observation.measured[name])


def test_a_case_has_what_a_diagnosis_needs(
    rig: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig, "KINDS", ("drops",))
    answer = rig.make(tmp_path, seed=3, seconds=2.0)
    assert answer == json.loads((tmp_path / "answer.json").read_text()) and answer["effect"] in rig.EFFECTS
    assert load_twin(tmp_path / "twin.yaml").vehicle.sprung_mass == pytest.approx(400.0, rel=0.011)
    assert all((tmp_path / folder / "drops.csv").is_file() for folder in ("reference", "gap"))
