# SPDX-License-Identifier: Apache-2.0
"""Agreement of marker runs: the tracked paper's correlation, and residuals that see amplitude."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.inference.marker_runs import MarkerRun
from suspension_twin.models.tracked import simulate_tracked
from suspension_twin.vehicle.tracked import load_tracked


@pytest.fixture(scope="module")
def run(repository: Path) -> MarkerRun:
    from tracked_agreement import simulate_runs

    vehicle = load_tracked(repository / "config" / "tracked" / "pt91.yaml")
    r = simulate_tracked(vehicle, 13 / 3.6, 3.0, rate=50.0)
    whole = MarkerRun(r.t, r.markers, r.marker_velocity, r.marker_acceleration, 13 / 3.6)
    return simulate_runs([vehicle], [whole])[0][0]  # type: ignore[index]


def times(run: MarkerRun, factor: float) -> MarkerRun:
    return replace(
        run,
        markers=factor * run.markers,
        velocity=factor * run.velocity,
        acceleration=factor * run.acceleration,
    )


def test_correlation_is_blind_to_amplitude_and_the_others_are_not(run: MarkerRun) -> None:
    from tracked_agreement import compare

    twice = compare(run, times(run, 2.0))
    assert twice.correlation == pytest.approx([1.0, 1.0])
    assert twice.residual.mean() == pytest.approx(1.0)
    assert twice.motion.mean() > 0.9
    assert twice.gain == pytest.approx([2.0, 2.0])
    assert compare(run, times(run, -1.0)).correlation == pytest.approx([-1.0, -1.0])


def test_correlation_is_that_of_numpy(run: MarkerRun) -> None:
    from tracked_agreement import compare

    swapped = replace(run, markers=run.markers[:, [1, 0, 2]])
    expected = [np.corrcoef(run.markers[:, k], run.markers[:, 1 - k])[0, 1] for k in (0, 1)]
    assert compare(run, swapped).correlation == pytest.approx(expected)


def test_motion_is_compared_with_the_clock_set_right(run: MarkerRun) -> None:
    from tracked_agreement import compare

    def late(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(run.t - 0.05, run.t, c) for c in values.T], axis=1)

    shifted = replace(
        run, markers=late(run.markers), velocity=late(run.velocity), acceleration=late(run.acceleration)
    )
    worth = compare(shifted, run)
    assert worth.delay == pytest.approx(0.05, abs=0.003)
    assert worth.motion.mean() < 0.3 * worth.residual.mean() + 0.05


def test_markers_that_stand_still_are_refused(run: MarkerRun) -> None:
    from tracked_agreement import compare

    with pytest.raises(InputError, match="do not move"):
        compare(times(run, 0.0), run)
