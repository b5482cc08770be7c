# SPDX-License-Identifier: Apache-2.0
"""Selection of a tracked vehicle's damping."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.calibration import damping
from suspension_twin.calibration.damping import DAMPINGS, SPEEDS, pitch_variances, select_damping
from suspension_twin.errors import InputError, WorkError
from suspension_twin.models.tracked import simulate_tracked
from suspension_twin.vehicle.tracked import TrackedVehicle, load_tracked


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
    monkeypatch.setattr(damping, "pitch_variances", lambda vehicle, tell: table)
    assert select_damping(vehicle, 5, 25).best == 2
    fast = select_damping(vehicle, 30, 55)
    assert fast.best == 4 and fast.near == (4,) and fast.regret[2] == pytest.approx(2.0)
    with pytest.raises(InputError, match="no speed of 5, 10"):
        select_damping(vehicle, 56, 60)
    table[:] = np.nan
    with pytest.raises(WorkError, match="every damping diverged"):
        select_damping(vehicle)
