# SPDX-License-Identifier: Apache-2.0
"""Offset, drift and steps of a device's clock, from the arrival times of its samples."""

from __future__ import annotations

import numpy as np
import pytest

from suspension_twin.addons.sources.common.clock import ArrivalClock


def arrivals(
    rng: np.random.Generator,
    seconds: float,
    offset: float,
    drift: float,
    period: float = 0.2,
    rate: float = 100.0,
):
    """Batches of stamps and when they arrive: 4 ms at least and 10 ms on average on their way, now and then 0.3 s."""
    t = 1.7e9 + np.arange(int(seconds * rate)) / rate
    for batch in np.split(t, range(int(period * rate), t.size, int(period * rate))):
        way = 0.004 + rng.exponential(0.006) + (0.3 if rng.random() < 0.03 else 0.0)
        yield batch, float(batch[-1]) + offset + drift * float(batch[-1] - t[0]) + way


def test_offset_and_drift_are_those_of_the_fastest_samples() -> None:
    clock = ArrivalClock()
    for t, arrival in arrivals(np.random.default_rng(1), 240.0, 3.2, 40e-6):
        assert clock.push(t, arrival) is not None
    assert clock.live and clock.steps == 0
    assert clock.offset == pytest.approx(3.2 + 40e-6 * 240.0 + 0.004, abs=0.003)
    assert clock.drift == pytest.approx(40e-6, abs=10e-6)
    assert 0.002 < clock.jitter < 0.015


def test_the_first_seconds_give_an_offset() -> None:
    clock = ArrivalClock()
    for t, arrival in arrivals(np.random.default_rng(2), 4.0, -0.7, 0.0):
        clock.push(t, arrival)
    assert clock.offset == pytest.approx(-0.7, abs=0.015)
    assert np.isnan(clock.drift)


@pytest.mark.parametrize("step", [-300.0, -1.4, 0.4, 2.0, 3600.0])
def test_a_step_is_found_at_once_and_made_up_for(step: float) -> None:
    clock, rng = ArrivalClock(), np.random.default_rng(3)
    wrong = []
    for k, (t, arrival) in enumerate(arrivals(rng, 60.0, 0.1, 10e-6)):
        shown = t + (step if k >= 150 else 0.0)
        wrong.append(float(np.abs(clock.push(shown, arrival) - t).max()))
    assert clock.steps == 1
    assert clock.last_step == pytest.approx(step, abs=0.02)
    assert max(wrong) < 0.02


def test_a_step_within_a_batch() -> None:
    clock, rng = ArrivalClock(), np.random.default_rng(3)
    wrong = []
    for k, (t, arrival) in enumerate(arrivals(rng, 60.0, 0.1, 0.0)):
        ahead = 0.8 * (np.arange(t.size) >= 8) if k == 150 else 0.8 * (k > 150)
        wrong.append(float(np.abs(clock.push(t + ahead, arrival) - t).max()))
    assert clock.steps == 1 and max(wrong) < 0.02


def test_a_small_step_back_is_found_within_seconds() -> None:
    """Less than disorder makes up: it shows by the delays, which are longer for good."""
    clock, rng = ArrivalClock(), np.random.default_rng(4)
    wrong = []
    for k, (t, arrival) in enumerate(arrivals(rng, 60.0, 0.1, 0.0)):
        wrong.append(float(np.abs(clock.push(t - (0.4 if k >= 150 else 0.0), arrival) - t).max()))
    assert clock.steps == 1
    assert max(wrong[150 + 30 :]) < 0.03  # 6 s later


def test_a_network_that_has_become_slower_is_no_step() -> None:
    """Each sample is 0.4 s later on its way from then on, by as much: no stamp is repeated."""
    clock, rng = ArrivalClock(), np.random.default_rng(4)
    for k, (t, arrival) in enumerate(arrivals(rng, 60.0, 0.1, 0.0)):
        np.testing.assert_array_equal(clock.push(t, arrival + (0.4 if 150 <= k < 400 else 0.0)), t)
    assert clock.steps == 0


def test_a_network_that_was_slow_and_is_free_after_a_pause_is_no_step() -> None:
    """For two minutes samples wait in a queue of 0.3 to 0.5 s; it has emptied when they come again."""
    clock, rng = ArrivalClock(), np.random.default_rng(4)
    for t, arrival in arrivals(rng, 270.0, 0.1, 0.0):
        since = t[-1] - 1.7e9
        if since < 130.0:
            arrival += 0.4 + 0.1 * np.sin(since)
        if not 130.0 < since < 240.0:
            np.testing.assert_array_equal(clock.push(t, arrival), t)
    assert clock.steps == 0


def test_ten_seconds_without_a_network_are_no_step() -> None:
    clock, rng = ArrivalClock(), np.random.default_rng(5)
    for t, arrival in arrivals(rng, 90.0, 0.1, 0.0):
        away = t[-1] - 1.7e9
        if 30.0 < away < 40.0:  # they arrive together when the network is back
            arrival = 1.7e9 + 40.1 + 0.001 * (away - 30.0)
        np.testing.assert_array_equal(clock.push(t, arrival), t)
    assert clock.steps == 0
    assert clock.offset == pytest.approx(0.104, abs=0.005)


def test_ten_lost_seconds_are_no_step() -> None:
    clock, rng = ArrivalClock(), np.random.default_rng(6)
    for t, arrival in arrivals(rng, 90.0, 0.1, 0.0):
        if not 30.0 < t[-1] - 1.7e9 < 40.0:
            np.testing.assert_array_equal(clock.push(t, arrival), t)
    assert clock.steps == 0


@pytest.mark.parametrize("speed", [0.5, 2.0, 20.0])
def test_a_recording_that_is_played_is_left_alone(speed: float) -> None:
    clock, rng = ArrivalClock(), np.random.default_rng(7)
    for k, (t, arrival) in enumerate(arrivals(rng, 60.0, 0.0, 0.0)):
        if k % 40 < 37:  # with gaps
            np.testing.assert_array_equal(clock.push(t, 1.7e9 + (arrival - 1.7e9) / speed), t)
    assert not clock.live and clock.steps == 0


def test_single_samples_and_slow_ones() -> None:
    """A receiver: a stamp a second."""
    clock, rng = ArrivalClock(), np.random.default_rng(8)
    for k in range(200):
        clock.push(np.array([1.7e9 + k]), 1.7e9 + k + 0.08 + rng.exponential(0.02))
    assert clock.live and clock.steps == 0
    assert clock.offset == pytest.approx(0.08, abs=0.01)
