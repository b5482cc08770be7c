# SPDX-License-Identifier: Apache-2.0
"""The rig in MuJoCo and the quarter car: the same corner, by code that shares nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from suspension_twin.inference.runs import simulate_rig
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin


@pytest.fixture(scope="module")
def rig(benchmarks_on_the_path: None) -> ModuleType:
    return import_module("rig")


@pytest.fixture
def straight(rig: ModuleType, repository: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Twin]:
    """A corner whose characteristics are straight lines, measured without noise, and its twin."""
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
    return corner, twin


@pytest.mark.parametrize("kind", ["sweep", "drops", "random"])
def test_a_corner_with_straight_characteristics_is_the_twins(
    rig: ModuleType, straight: tuple[Any, Twin], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within half a per cent in every channel, wheels in the air after the drops, at a quarter of the rig's step.

    MuJoCo's integrator is of first order: at its usual step it is off by as much itself.
    """
    monkeypatch.setattr(rig, "step_of", lambda corner: 5e-5)
    corner, twin = straight
    result = simulate_rig(rig.run_of(corner, kind, 5.0, np.random.default_rng(0)), twin)
    assert (result.response.channel("tyre_force").min() == 0.0) == (kind == "drops")
    for name, rms in result.gap.channels.items():
        assert rms < 0.005 * np.std(result.observation.measured[name])


@pytest.mark.long
@pytest.mark.parametrize(
    ("changes", "effect", "parameters", "remaining"),
    [
        (
            {"friction": 120.0},
            "strut_friction",
            {"front_force": 120.0},
            0.6,
        ),  # without bushings that give way
        ({"mount": 1.2e5}, "top_mount", {"front_stiffness": 1.2e5}, 0.1),
        ({"tyre_damping": 600.0}, "tyre_damping", {"damping": 600.0}, 0.1),
        ({"payload": 70.0}, "payload", {"mass": 70.0}, 0.1),
        ({"gain": 1.2}, "sensor_scale", {"scale": 0.2}, 0.1),
        ({"cutoff": 15.0}, "sensor_bandwidth", {"cutoff": 15.0}, 0.1),
        ({"late": 0.02}, "time_offset", {"offset": 0.02}, 0.1),
        ({"drift": 2e-3}, "clock_drift", {"drift_ppm": 2000.0}, 0.1),
    ],
)
def test_an_effect_means_the_same_on_the_rig(
    rig: ModuleType, straight: tuple[Any, Twin], changes: Any, effect: str, parameters: Any, remaining: float
) -> None:
    """The effect in the twin file leaves less than a share of the gap that the change of the rig makes."""
    corner, twin = straight
    run = rig.run_of(replace(corner, **changes), "random", 3.0, np.random.default_rng(0))
    having = twin.model_copy(update={"effects": (EffectSpec(id=effect, parameters=parameters),)})
    before, after = simulate_rig(run, twin).gap, simulate_rig(run, having).gap
    assert after.rms < remaining * before.rms


def test_a_case_has_what_a_diagnosis_needs(
    rig: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig, "KINDS", ("drops",))
    answer = rig.make(tmp_path, seed=3, seconds=2.0)
    assert answer == json.loads((tmp_path / "answer.json").read_text()) and answer["effect"] in rig.EFFECTS
    assert load_twin(tmp_path / "twin.yaml").vehicle.sprung_mass == pytest.approx(400.0, rel=0.011)
    assert all((tmp_path / folder / "drops.csv").is_file() for folder in ("reference", "gap"))
