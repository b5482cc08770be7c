# SPDX-License-Identifier: Apache-2.0
"""The linear model of a corner that a calibration is measured by."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from suspension_twin.drive.rig import RigRecord
from suspension_twin.inference.linear_corner import CORNER_CHANNELS, linear_corner
from suspension_twin.inference.observation import Observation
from suspension_twin.inference.runs import observe_rig, rig_run
from suspension_twin.models.parameters import pack
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.vehicle.twin import Twin, load_twin

RATE = 200.0


@pytest.fixture(scope="module")
def corner(repository: Path) -> Twin:
    """A corner that is linear: straight springs and dampers, the same in both directions."""
    return load_twin(repository / "config" / "twins" / "quarter_car.yaml").with_changes(
        {
            "vehicle.spring": {"compression": (1.0,), "force": (2.3e4,)},
            "vehicle.damper_push": {"velocity": (1.0,), "force": (1800.0,)},
            "vehicle.damper_pull": {"velocity": (1.0,), "force": (1800.0,)},
        }
    )


def recorded(
    twin: Twin, seed: int, force: float = 0.0, name: str = "run", seconds: float = 12.0
) -> RigRecord:
    """A run on a random road that begins at rest, with an actuator of ``force`` N rms."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1.0 / RATE)
    road = lfilter(*butter(1, 1.0, fs=RATE), 0.02 * rng.standard_normal(t.size)) * np.clip(t, 0.0, 1.0)
    pushed = force * lfilter(*butter(2, 8.0, fs=RATE), rng.standard_normal(t.size)) * np.clip(t, 0.0, 1.0)
    inputs = {"road_displacement": road} | ({"actuator_force": pushed} if force else {})
    run = rig_run(t, road, force=pushed if force else None)
    response = simulate_lanes(twin, pack(twin)[:, None], run)
    columns = {name: response.channel(name)[:, 0] for name in CORNER_CHANNELS}
    return RigRecord(name, t, inputs | columns)


def observed(record: RigRecord) -> Observation:
    return observe_rig(record, CORNER_CHANNELS)


def share(run: Observation, simulated: dict[str, np.ndarray], channel: str) -> float:
    measured = run.measured[channel]
    return 1.0 - float(np.var(measured - simulated[channel]) / np.var(measured))


@pytest.mark.parametrize("late", [0.0, 0.025, -0.02])
def test_a_linear_corner_is_found_from_its_motion(corner: Twin, late: float) -> None:
    """With its delay, of either sign, and what it then says of another run."""
    moved = corner.with_changes({"imu.latency": late})
    fitted, other = (observed(recorded(moved, seed)) for seed in (1, 2))
    found, _ = linear_corner([fitted], CORNER_CHANNELS)
    assert found.delay == pytest.approx(late, abs=1e-3)
    mass = corner.vehicle.sprung_mass
    assert found.spring * mass == pytest.approx(2.3e4, rel=0.05)
    assert found.damper * mass == pytest.approx(1800.0, rel=0.05)
    for channel in CORNER_CHANNELS:
        assert share(other, found.signals(other), channel) > 0.99


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_force_weighs_the_corner_and_shows_its_sign(corner: Twin, sign: float) -> None:
    record = recorded(corner, 3, force=100.0)
    columns = record.columns | {"actuator_force": sign * record.columns["actuator_force"]}
    found, sure = linear_corner([observed(replace(record, columns=columns))], CORNER_CHANNELS)
    assert sign * found.force == pytest.approx(1.0 / corner.vehicle.sprung_mass, rel=0.1)
    assert sign * sure > 10.0


def test_a_road_whose_velocity_was_measured_may_drift(corner: Twin) -> None:
    """An offset of the velocity by 3 cm/s is a ramp of its integral, under which nothing moves."""
    record = recorded(corner, 4, seconds=20.0)
    rate = np.gradient(record.columns["road_displacement"], record.t) + 0.03
    columns = {k: v for k, v in record.columns.items() if k != "road_displacement"}
    run = observed(replace(record, columns=columns | {"road_velocity": rate}))
    found, _ = linear_corner([run], ["body_acceleration"])
    assert share(run, found.signals(run), "body_acceleration") > 0.98
