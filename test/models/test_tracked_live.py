# SPDX-License-Identifier: Apache-2.0
"""``tracked`` beside its vehicle: the live twin against the batch, its sensor, its way, its mishaps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.models.live import LiveState, live_twin
from suspension_twin.models.tracked import LiveTracked, obstacle_height, simulate_tracked
from suspension_twin.models.types import PoseSample
from suspension_twin.vehicle.tracked import TrackedTwin
from suspension_twin.vehicle.twin import EffectSpec, load_twin

G = 9.80665


class Ground:
    """The obstacle across the way of +x at map height 5, with an edge of the known world."""

    def __init__(self, twin: TrackedTwin, end: float = 1e9) -> None:
        self.obstacle, self.end = twin.vehicle.obstacle, end

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        height = 5.0 + obstacle_height(self.obstacle, np.asarray(x)) + 0.0 * np.asarray(y)
        return np.where(np.asarray(x) > self.end, np.nan, height)


@pytest.fixture(scope="module")
def twin(repository: Path) -> TrackedTwin:
    loaded = load_twin(repository / "config" / "tracked" / "pt91.yaml")
    assert isinstance(loaded, TrackedTwin)
    return loaded


def drive(live: LiveTracked, x: np.ndarray, speed: float, t0: float = 100.0, ax: float = 0.0) -> list:
    return [
        live.step(t0 + 0.01 * k, PoseSample(float(p), 0.0, 0.0, speed, 0.0, 0.0, ax, 0.0))
        for k, p in enumerate(x)
    ]


def test_the_live_twin_is_the_batch(twin: TrackedTwin) -> None:
    v, speed = twin.vehicle, 8 / 3.6
    batch = simulate_tracked(v, speed, 4.0)
    live = live_twin(twin, Ground(twin))
    assert isinstance(live, LiveTracked)
    states = drive(live, batch.travel - v.cog[0] + v.stations[-1].x, speed)
    pitch = np.array([s.pitch for s in states])
    heave = np.array([s.heave for s in states])
    # the links lie elsewhere under the vehicle, by less than one of them
    assert np.abs(pitch - batch.pitch).max() < 1.5e-3
    assert np.abs(heave - 5.0 - (batch.z - batch.z[0])).max() < 4e-3
    assert np.ptp(batch.z) > 0.1 and not any(s.event for s in states[1:])
    last = states[-1]
    assert last.deflection.shape == last.tyre_force.shape == (12,) and len(twin.joint_names) == 12
    assert last.deflection[:6] == pytest.approx(last.deflection[6:])
    assert last.deflection[:6] == pytest.approx(v.arm.free_angle - batch.arm[-1], abs=4e-3)


def test_the_sensor_feels_what_the_hull_does(twin: TrackedTwin) -> None:
    live = live_twin(twin, Ground(twin))
    speed = 13 / 3.6
    dt = 0.0025
    states = [
        live.step(dt * k, PoseSample(k * dt * speed - 8.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0, 0.0))
        for k in range(700)
    ]
    at = np.array([2.13, 1.14])
    pitch, base = np.array([s.pitch for s in states]), np.array([s.z for s in states])
    height = base - at[0] * np.sin(pitch) + at[1] * np.cos(pitch)
    specific = np.array([s.force for s in states])
    upwards = specific[:, 2] * np.cos(pitch) - specific[:, 0] * np.sin(pitch) - G
    gained = np.cumsum(upwards) * dt
    speed_up = np.gradient(height, dt)
    assert np.ptp(speed_up) > 0.2
    assert np.abs(gained - speed_up + speed_up[0])[2:-2].max() < 0.03 * np.ptp(speed_up) + 0.01
    assert [s.rate[1] for s in states[1:-1]] == pytest.approx(np.gradient(pitch, dt)[1:-1], abs=0.02)


def test_who_accelerates_lifts_the_nose(twin: TrackedTwin) -> None:
    live = live_twin(twin, Ground(twin))
    still = drive(live, np.full(50, -60.0), 0.0)[-1]
    pushed = drive(live, np.full(200, -60.0), 0.0, t0=200.0, ax=2.0)[-1]
    assert still.force == pytest.approx([0.0, 0.0, G], abs=0.02)
    v = twin.vehicle
    # moment of the inertia over the stiffness of six bars in pitch, both sides; the track adds some
    squares = sum((s.x - v.cog[0]) ** 2 for s in v.stations)
    bars = 2 * v.arm.stiffness / (v.arm.length * math.cos(v.arm.standing_angle)) ** 2 * squares
    angle = 2 * v.hull_mass * 2.0 * twin.cog_height / bars
    assert pushed.pitch - still.pitch == pytest.approx(-angle, rel=0.25)


def test_it_reverses_where_it_came_from(twin: TrackedTwin) -> None:
    live = live_twin(twin, Ground(twin))
    speed = 1.5
    forwards = np.arange(-7.0, -3.0, 0.01 * speed)
    there = drive(live, forwards, speed)
    drive(live, np.full(150, forwards[-1]), 0.0, t0=300.0 - 0.2)
    back = [
        live.step(301.3 + 0.01 * k, PoseSample(float(p), 0, 0, -speed, 0, 0, 0, 0))
        for k, p in enumerate(forwards[::-1])
    ]
    assert not any(s.event for s in back[1:])
    assert back[-1].z == pytest.approx(there[0].z, abs=0.02) and abs(back[-1].pitch) < 0.01


def test_what_messages_may_hold(twin: TrackedTwin) -> None:
    live = live_twin(twin, Ground(twin, end=-20.0))
    with pytest.raises(InputError, match="no usable one"):
        live.step(0.0, PoseSample(math.nan, 0, 0, 0, 0, 0, 0, 0))
    first = live.step(1.0, PoseSample(-40.0, 0, 0, 0, 0, 0, 0, 0))
    assert first.event == "start" and first.z == pytest.approx(5.0, abs=0.02)
    assert live.step(1.0, PoseSample(-40.0, 0, 0, 0, 0, 0, 0, 0)).event == "stamp repeated"
    assert "finite" in live.step(1.1, PoseSample(math.inf, 0, 0, 0, 0, 0, 0, 0)).event
    assert "gap of 4.00 s" in live.step(5.0, PoseSample(-40.0, 0, 0, 0, 0, 0, 0, 0)).event
    assert "went back" in live.step(4.0, PoseSample(-40.0, 0, 0, 0, 0, 0, 0, 0)).event
    states = drive(live, np.arange(-40.0, -15.0, 0.1), 10.0, t0=10.0)
    assert any("no height" in s.event for s in states)
    assert all(np.isfinite([s.z, s.pitch, *s.force]).all() for s in states)


def test_an_effect_of_the_file_acts(twin: TrackedTwin) -> None:
    # slack, so that no part of the load goes through the track past the wheels
    slack = twin.vehicle.with_changes(
        {"track.stiffness": 1e5, "track.bending_stiffness": 10.0, "idler.taut_at": -5600}
    )

    def standing(*effects: EffectSpec) -> LiveState:
        changed = twin.model_copy(update={"effects": effects, "vehicle": slack})
        return drive(live_twin(changed, Ground(twin)), np.full(3, -60.0), 0.0)[-1]

    light = standing()
    centre = slack.cog[0] - slack.stations[-1].x  # of gravity, ahead of the rearmost road wheels
    heavy, ahead = (
        standing(EffectSpec(id="payload", parameters={"mass": 4000.0, "x": centre + x})) for x in (0.0, 1.0)
    )
    assert heavy.tyre_force.sum() - light.tyre_force.sum() == pytest.approx(4000 * G, rel=0.01)
    assert ahead.pitch > heavy.pitch + 1e-3
    wrong = twin.model_copy(update={"effects": (EffectSpec(id="strut_friction"),)})
    with pytest.raises(InputError, match="strut_friction is not an effect of the model tracked"):
        live_twin(wrong, Ground(twin))
