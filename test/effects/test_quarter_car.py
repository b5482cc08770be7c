# SPDX-License-Identifier: Apache-2.0
"""Effects on a corner: which apply, with which parameters, and that neutral ones change nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.effects.registry import EFFECTS, effect
from suspension_twin.errors import InputError
from suspension_twin.inference.runs import rig_run
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin

T = np.arange(500) / 250
RUN = rig_run(
    T, 0.03 * np.sin(2 * np.pi * 2.0 * T) * np.minimum(T, 1.0) + 0.003 * np.sin(2 * np.pi * 11.0 * T)
)
APPLY = [name for name, found in EFFECTS.items() if "quarter_car" in found.models]
#: Parameters with which each effect shows on ``RUN``.
FELT: dict[str, dict[str, float]] = {
    "payload": {"mass": 60.0},
    "strut_friction": {"front_force": 150.0},
    "bump_stop": {"stiffness": 8e4, "front_clearance": 0.01},
    "rebound_stop": {"stiffness": 8e4, "front_clearance": 0.01},
    "progressive_spring": {"front_rise": 3e5},
    "top_mount": {"front_stiffness": 1e5},
    "damper_play": {"front": 0.004},
    "damper_fade": {"loss": 0.5, "time_constant": 2.0},
    "corner_damper": {"change": -0.4},
    "corner_spring": {"change": -0.1},
    "tyre_damping": {"damping": 800.0},
    "worn_dampers": {"front": 0.4},
    "spring_sag": {"front": 0.02, "rate": 4.0},
    "tyre_pressure": {"change": -0.3},
    "semi_active_damper": {"front": 2000.0},
    "time_offset": {"offset": 0.02},
    "clock_drift": {"drift_ppm": 2000.0},
    "mount_resonance": {"gain": 1.0},
    "sensor_scale": {"scale": 0.1},
    "sensor_bandwidth": {"cutoff": 15.0},
    "sensor_clipping": {"range": 10.5},
}


@pytest.fixture(scope="module")
def corner(repository: Path) -> Twin:
    return load_twin(repository / "config" / "twins" / "quarter_car.yaml")


def answer(twin: Twin, name: str, values: dict[str, float]) -> Any:
    specs = (EffectSpec(id=name, parameters=values),) if name else ()
    given = twin.model_copy(update={"effects": specs})
    response = simulate_lanes(given, lanes(given, [], np.zeros((1, 0))), RUN)
    assert not response.failed.any()
    return response.signals


@pytest.mark.parametrize("name", APPLY)
def test_neutral_changes_no_bit_and_more_is_felt(corner: Twin, name: str) -> None:
    plain = answer(corner, "", {})
    assert np.array_equal(answer(corner, name, {}), plain)
    change = np.std(answer(corner, name, FELT[name]) - plain, axis=0)[:, 0]
    sensor_only = effect(name).where == "sensor"
    assert change[0] > 0.01 * np.std(plain[:, 0]) and (
        not change[1:].any() if sensor_only else change[1:].all()
    )


def test_a_corner_has_no_front_and_rear_and_no_sides(corner: Twin) -> None:
    for name in APPLY:
        found = effect(name, "quarter_car")
        names = {p.name for p in found.parameters}
        assert not names & {"corner", "x", "y"} and not any(n.startswith("rear") for n in names)
        assert set(found.severity) <= names and found.severity
    with pytest.raises(
        InputError, match=r"effects\.strut_friction\.rear_force: is not a parameter of it: front_force"
    ):
        answer(corner, "strut_friction", {"rear_force": 1.0})


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - set(APPLY)))
def test_what_makes_no_sense_on_a_corner_says_so(corner: Twin, name: str) -> None:
    with pytest.raises(InputError, match=f"{name} is not an effect of the model quarter_car"):
        answer(corner, name, {})


def test_payload_presses_the_spring_further(corner: Twin) -> None:
    """The preset's spring has 23 kN/m: 60 kg are 25.6 mm, counted from where it stands without them."""
    sag = answer(corner, "payload", {"mass": 60.0})[0, 2, 0]
    assert sag == pytest.approx(60.0 * 9.80665 / 23000.0)
