# SPDX-License-Identifier: Apache-2.0
"""The live twin: the batch's numbers, stamp by stamp, whatever the stamps do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.models import parameters
from suspension_twin.models.excitation import excitation
from suspension_twin.models.hooks import ClockChange, Hook, RoadChange, SignalStage
from suspension_twin.models.live import LiveTwin
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.models.types import PoseSample

FIELDS = (
    "heave",
    "roll",
    "pitch",
    "z",
    "wheel_z",
    "deflection",
    "deflection_rate",
    "tyre_force",
    "force",
    "rate",
    "vertical_acceleration",
)


def rows(way: Any) -> Any:
    columns = [way.t, way.x, way.y, way.yaw, way.velocity, way.yaw_rate, way.acceleration]
    return np.column_stack(columns).tolist()


def play(live: LiveTwin, way: Any) -> Any:
    return [live.step(t, PoseSample(*row)) for t, *row in rows(way)]


@pytest.mark.parametrize(("rate", "jitter"), [(100, 0.0), (100, 0.6), (1000, 0.5), (50, 0.2)])
def test_same_numbers_as_the_batch(mondeo: Any, drive: Any, rough: Any, rate: int, jitter: float) -> None:
    way = drive(seconds=2, rate=rate, jitter=jitter, yaw_rate=0.3, speed=7)
    batch = simulate_twin(mondeo, excitation(way, mondeo.vehicle, rough))
    states = play(LiveTwin(mondeo, rough), way)
    for field in FIELDS:
        assert np.array_equal(np.array([getattr(s, field) for s in states]), getattr(batch, field)), field
    assert [s.event for s in states] == ["start"] + [""] * (len(states) - 1)


def test_gap_in_the_stamps_starts_afresh_like_the_batch(mondeo: Any, drive: Any, rough: Any) -> None:
    way = drive(seconds=4, jitter=0.4)
    keep = (way.t < way.t[0] + 1.5) | (way.t > way.t[0] + 2.4)
    cut = type(way)(**{k: getattr(way, k)[keep] for k in way.__dataclass_fields__})
    batch = simulate_twin(mondeo, excitation(cut, mondeo.vehicle, rough))
    states = play(LiveTwin(mondeo, rough), cut)
    assert sum("gap" in s.event for s in states) == 1
    for field in FIELDS:
        assert np.array_equal(np.array([getattr(s, field) for s in states]), getattr(batch, field)), field


def test_reset_and_a_looped_drive(mondeo: Any, drive: Any, rough: Any) -> None:
    way = drive(seconds=1)
    live = LiveTwin(mondeo, rough)
    first = play(live, way)
    again = play(live, way)  # stamps jump back
    assert again[0].event.startswith("time went back")
    live.reset()
    third = play(live, way)
    assert third[0].event == "start"
    for a, b, c in zip(first, again, third, strict=True):
        assert a.heave == b.heave == c.heave
        assert np.array_equal(a.force, b.force)
        assert np.array_equal(a.force, c.force)


def test_unusable_input_is_reported_and_changes_nothing(
    mondeo: Any, drive: Any, rough: Any, flat: Any
) -> None:
    way = drive(seconds=1)
    clean = play(LiveTwin(mondeo, rough), way)
    live = LiveTwin(mondeo, rough)
    for k, (t, *row) in enumerate(rows(way)):
        motion = PoseSample(*row)
        state = live.step(t, motion)
        assert state.heave == clean[k].heave
        assert live.step(t, motion).event == "stamp repeated"
        bad = live.step(t + 0.001, motion._replace(x=float("nan")))
        assert bad.event == "input is not finite"
        assert np.isfinite(bad.force).all()
    with pytest.raises(InputError, match="no usable one before"):
        LiveTwin(mondeo, flat).step(float("nan"), PoseSample(*[float("nan")] * 8))


def test_a_hole_in_the_road_is_held_over_and_said(mondeo: Any, drive: Any, ground: Any) -> None:
    holed = ground(lambda x, y: np.where((x > 5) & (x < 5.5), np.nan, 0.01 * np.sin(x)))
    states = play(LiveTwin(mondeo, holed), drive(seconds=2, speed=5))
    assert any("no height" in s.event for s in states)
    assert all(np.isfinite(s.force).all() and np.isfinite(s.tyre_force).all() for s in states)


def test_yaw_that_wraps_is_no_turn(mondeo: Any, drive: Any, rough: Any) -> None:
    way = drive(seconds=3, yaw_rate=1.5, speed=4)
    smooth = play(LiveTwin(mondeo, rough), way)
    wrapped = type(way)(
        **{
            k: (getattr(way, k) + np.pi) % (2 * np.pi) - np.pi if k == "yaw" else getattr(way, k)
            for k in way.__dataclass_fields__
        }
    )
    for a, b in zip(smooth, play(LiveTwin(mondeo, rough), wrapped), strict=True):
        np.testing.assert_allclose(a.force, b.force, atol=1e-7)


def _low_pass(signals: Any, t: Any, fresh: Any, values: Any, state: Any) -> None:
    for k in range(t.size):
        state[:] = signals[k, :, :] if fresh[k] else state + values[0] * (signals[k] - state)
        signals[k] = state


def _road(change: RoadChange, values: Any) -> None:
    change.smoothing[:] += values["sigma"]
    change.ahead[:] += values["ahead"]
    change.scale[:] += values["scale"]


def _clock(change: ClockChange, values: Any) -> None:
    change.delay[:] += values["delay"]


HOOKS = {
    "slow": Hook(neutral={"share": 1.0}, signal=SignalStage(_low_pass, states=7)),
    "road": Hook(neutral={"sigma": 0.0, "ahead": 0.0, "scale": 0.0}, road=_road),
    "late": Hook(neutral={"delay": 0.0}, clock=_clock),
}


def test_sensor_stages_live(mondeo: Any, drive: Any, rough: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameters, "load_hook", lambda name, model: HOOKS[name])
    twin = mondeo.with_changes({"effects": [{"id": "slow", "parameters": {"share": 0.3}}]})
    way = drive(seconds=1, jitter=0.3)
    batch = simulate_twin(twin, excitation(way, twin.vehicle, rough))
    states = play(LiveTwin(twin, rough), way)
    assert np.array_equal(np.array([s.force for s in states]), batch.force)
    assert np.abs(batch.force - simulate_twin(mondeo, excitation(way, twin.vehicle, rough)).force).max() > 0.1


def rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize(
    "effect",
    [
        {"id": "road", "parameters": {"sigma": 0.1, "ahead": 0.4, "scale": 0.2}},
        {"id": "late", "parameters": {"delay": 0.05}},
    ],
)
def test_roads_and_clocks_live_are_those_of_the_batch(
    mondeo: Any, drive: Any, rough: Any, monkeypatch: pytest.MonkeyPatch, effect: Any
) -> None:
    """Not bit for bit: a live twin knows the way only as far as it has come."""
    monkeypatch.setattr(parameters, "load_hook", lambda name, model: HOOKS[name])
    twin = mondeo.with_changes({"effects": [effect]})
    way = drive(seconds=3)
    batch = simulate_twin(twin, excitation(way, twin.vehicle, rough)).vertical_acceleration
    plain = simulate_twin(mondeo, excitation(way, twin.vehicle, rough)).vertical_acceleration
    live = np.array([s.vertical_acceleration for s in play(LiveTwin(twin, rough), way)])
    assert rms((live - batch)[100:]) < 0.05 * rms((plain - batch)[100:])
