# SPDX-License-Identifier: Apache-2.0
"""Selection of the damping and what a manoeuvre determines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from suspension_twin.calibration.tracked_identify import BOUNDS_ALONE, fisher, profile
from suspension_twin.calibration.tracked_paper import simulate_runs

from suspension_twin.calibration import tracked_damping
from suspension_twin.calibration.damping import DAMPINGS, SPEEDS, pitch_variances, select_damping
from suspension_twin.errors import InputError, WorkError
from suspension_twin.gap.marker_runs import MarkerRun
from suspension_twin.models.tracked import simulate_tracked
from suspension_twin.vehicle.tracked import BOUNDS, TrackedVehicle, load_tracked


@pytest.fixture(scope="module")
def vehicle(repository: Path) -> TrackedVehicle:
    return load_tracked(repository / "config" / "tracked" / "pt91.yaml")


def test_the_papers_table() -> None:
    assert len(DAMPINGS) * len(SPEEDS) == 77 and SPEEDS[0] == 5 and SPEEDS[-1] == 55
    assert DAMPINGS == (0, 11272, 22545, 45090, 90180, 135270, 180360)


def test_a_variance_is_that_of_the_run(vehicle: TrackedVehicle) -> None:
    table = pitch_variances(vehicle, (45090.0,), (30.0,))
    pitch = simulate_tracked(vehicle, 30 / 3.6, 15.0).pitch
    assert table[0, 0] == pytest.approx(np.var(pitch))


def test_the_least_mean_within_the_range_is_taken(
    vehicle: TrackedVehicle, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = np.full((7, 11), 2.0)
    table[2, :5], table[2, 5:] = 1.0, 3.0
    table[4, 5:] = 1.5
    table[6] = np.nan
    monkeypatch.setattr(tracked_damping, "pitch_variances", lambda vehicle: table)
    assert select_damping(vehicle, 5, 25).best == 2
    fast = select_damping(vehicle, 30, 55)
    assert fast.best == 4 and fast.near == (4,) and fast.regret[2] == pytest.approx(2.0)
    with pytest.raises(InputError, match="no speed of 5, 10"):
        select_damping(vehicle, 56, 60)
    table[:] = np.nan
    with pytest.raises(WorkError, match="every damping diverged"):
        select_damping(vehicle)


def test_what_a_run_determines(vehicle: TrackedVehicle) -> None:
    t = np.arange(0, 4.0, 0.02)
    empty = MarkerRun(t, *(np.zeros((t.size, 3)) for _ in range(3)), 13 / 3.6)  # type: ignore[arg-type]
    told = simulate_runs([vehicle], [empty])[0]
    assert told is not None
    quiet, loud = (fisher(vehicle, told, np.array([1e-3, 1e-2, 0.2]) * f, (0.02, 0.05)) for f in (1.0, 100.0))
    for step in (0.02, 0.05):
        assert set(quiet[step]) == set(BOUNDS)
        assert all(quiet[step][k] < loud[step][k] <= BOUNDS_ALONE + 1e-12 for k in BOUNDS)
    # the tension is what a run over an obstacle tells most of, the links' damping what it tells nothing of
    assert quiet[0.05]["idler.setting"] < 0.1 < quiet[0.05]["track.damping"]
    p = profile(vehicle, told, np.array([1e-3, 1e-2, 0.2]), "idler.setting", points=3, rounds=1)
    assert p.cost.min() == 0.0 and p.cost[1] < p.cost[2] and 0.0 <= p.low <= p.high <= 1.0
