# SPDX-License-Identifier: Apache-2.0
"""The lateness of a receiver, of its speeds and the accelerometer."""

from __future__ import annotations

import numpy as np
import pytest

from suspension_twin.pose.receiver_lateness import LATE, ReceiverLateness


def driven(late: float, doppler: float = 0.1, seed: int = 0, slope: float = 0.1, still: bool = False):
    """The estimate after half a minute of driving off, braking and driving on."""
    t = np.arange(0.0, 30.0, 0.01)
    speed = np.interp(t, [0, 3, 8, 14, 17, 20, 30], [0, 0, 10, 10, 5, 5, 12]) if not still else 0.0 * t + 8.0
    rng, found = np.random.default_rng(seed), ReceiverLateness()
    ahead = np.gradient(speed, t) + slope + 0.3 * rng.standard_normal(t.size)
    for k, (now, force) in enumerate(zip(t, ahead, strict=True)):
        found.feel(1.7e9 + now, force)
        if k % 100 == 0:
            found.velocity(1.7e9 + now, np.interp(now - late, t, speed) + doppler * rng.standard_normal())
    return found


@pytest.mark.parametrize("late", [0.0, 0.15, 0.4, 0.7])
@pytest.mark.parametrize("seed", range(3))
def test_it_is_found_beside_slope_and_noise(late, seed):
    found = driven(late, seed=seed)
    assert found.spread < 0.15
    assert abs(found.seconds - late) < min(3.0 * found.spread, 0.2)


def test_at_an_even_speed_nothing_is_known():
    found = driven(0.4, still=True)
    assert found.seconds < 0.1 and found.spread > 0.5 * LATE


def test_no_speed_twice_a_second_or_after_a_pause_is_compared():
    found = ReceiverLateness()
    for k in range(1000):
        found.feel(0.01 * k, 0.0)
    for t in (5.0, 5.1, 5.2):
        found.velocity(t, 3.0)
    found.velocity(9.9, 8.0)
    assert (found.seconds, found.spread) == (0.0, LATE)
