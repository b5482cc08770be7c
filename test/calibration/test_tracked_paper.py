# SPDX-License-Identifier: Apache-2.0
"""The preset ``tracked_paper``: its objectives and its search."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.calibration.request import Progress
from suspension_twin.calibration.tracked_paper import (
    PUBLISHED,
    SETTINGS,
    calibrate_tracked,
    compare,
    simulate_runs,
    unit_values,
    values_at,
)
from suspension_twin.errors import InputError, WorkError
from suspension_twin.gap.marker_runs import MarkerRun
from suspension_twin.models.tracked import simulate_tracked
from suspension_twin.vehicle.tracked import BOUNDS, TrackedVehicle, load_tracked


@pytest.fixture(scope="module")
def vehicle(repository: Path) -> TrackedVehicle:
    return load_tracked(repository / "config" / "tracked" / "pt91.yaml")


@pytest.fixture(scope="module")
def run(vehicle: TrackedVehicle) -> MarkerRun:
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


def test_the_papers_settings() -> None:
    assert (SETTINGS.population, SETTINGS.generations) == (40, 30)
    assert all(BOUNDS[key][0] <= value <= BOUNDS[key][1] for key, value in PUBLISHED.items())


def test_correlation_is_blind_to_amplitude_and_the_others_are_not(run: MarkerRun) -> None:
    twice = compare(run, times(run, 2.0))
    assert twice.cost("correlation") == pytest.approx(0.0, abs=1e-12)
    assert twice.cost("amplitude") == pytest.approx(1.0)
    assert twice.cost("motion") > 0.9
    assert twice.gain == pytest.approx([2.0, 2.0])
    assert compare(run, times(run, -1.0)).correlation == pytest.approx([-1.0, -1.0])


def test_correlation_is_that_of_numpy(run: MarkerRun) -> None:
    swapped = replace(run, markers=run.markers[:, [1, 0, 2]])
    expected = [np.corrcoef(run.markers[:, k], run.markers[:, 1 - k])[0, 1] for k in (0, 1)]
    assert compare(run, swapped).correlation == pytest.approx(expected)


def test_motion_does_not_mind_a_clock_that_is_late(run: MarkerRun) -> None:
    def late(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(run.t - 0.05, run.t, c) for c in values.T], axis=1)

    shifted = replace(
        run, markers=late(run.markers), velocity=late(run.velocity), acceleration=late(run.acceleration)
    )
    worth = compare(shifted, run)
    assert worth.late == pytest.approx(0.05, abs=0.003)
    assert worth.cost("motion") < 0.3 * compare(shifted, run).residual.mean() + 0.05


def test_markers_that_stand_still_are_refused(run: MarkerRun) -> None:
    with pytest.raises(InputError, match="do not move"):
        compare(times(run, 0.0), run)


def test_places_in_the_bounds_are_decades(vehicle: TrackedVehicle) -> None:
    assert values_at(np.full(5, 0.5))["track.stiffness"] == pytest.approx(1e7)
    # the paper's b_gl lies in the middle of its range, in logarithms
    assert unit_values(vehicle)[2] == pytest.approx(2 / 3)
    back = values_at(unit_values(vehicle))
    assert all(back[k] == pytest.approx(v) for k, v in PUBLISHED.items())


@pytest.mark.parametrize("objective", ["correlation", "motion"])
def test_the_search_comes_near(vehicle: TrackedVehicle, run: MarkerRun, objective: str) -> None:
    start = vehicle.with_changes({"track.stiffness": 1e5, "track.bending_stiffness": 10.0})
    settings = replace(SETTINGS, population=10, generations=4)
    first = calibrate_tracked(start, [run], objective=objective, seed=3, settings=settings)  # type: ignore[arg-type]
    assert (np.diff(first.best) <= 0).all() and first.evaluations > 40
    assert first.worth[0].cost(objective) == pytest.approx(first.best[-1])  # type: ignore[arg-type]
    assert first.worth[0].correlation.mean() > 0.9
    assert all(BOUNDS[key][0] <= value <= BOUNDS[key][1] for key, value in first.values.items())


def test_the_search_is_repeatable_and_stops_with_the_best_so_far(
    vehicle: TrackedVehicle, run: MarkerRun
) -> None:
    settings = replace(SETTINGS, population=6, generations=2)
    told: list[Progress] = []
    first = calibrate_tracked(vehicle, [run], seed=3, settings=settings, tell=told.append)
    assert [p.generation for p in told] == [0, 1, 2] and told[-1].best_cost == first.best[-1]
    again = calibrate_tracked(vehicle, [run], seed=3, settings=settings)
    assert first.values == again.values
    asked = iter([False, False, True])
    stopped = calibrate_tracked(vehicle, [run], seed=3, settings=settings, should_stop=lambda: next(asked))
    assert list(stopped.best) == list(first.best[:2])
    with pytest.raises(WorkError, match="stopped before the search began"):
        calibrate_tracked(vehicle, [run], should_stop=lambda: True)


def test_a_candidate_that_diverges_is_the_worst_and_not_the_end(
    vehicle: TrackedVehicle, run: MarkerRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    from suspension_twin.calibration import tracked_paper

    def fragile(vehicles: list[TrackedVehicle], runs: list[MarkerRun]) -> list[list[MarkerRun] | None]:
        told = simulate_runs(vehicles, runs)
        return [None if v.track.stiffness > limit else t for v, t in zip(vehicles, told, strict=True)]

    limit = 1e7
    monkeypatch.setattr(tracked_paper, "simulate_runs", fragile)
    settings = replace(SETTINGS, population=8, generations=1)
    found = calibrate_tracked(vehicle, [run], settings=settings)
    assert np.isfinite(found.best[-1]) and found.values["track.stiffness"] <= limit
    limit = 0.0
    with pytest.raises(WorkError, match="every candidate diverged"):
        calibrate_tracked(vehicle, [run], settings=settings)


def test_no_run_and_no_objective_are_refused(vehicle: TrackedVehicle, run: MarkerRun) -> None:
    with pytest.raises(InputError, match="none is given"):
        calibrate_tracked(vehicle, [])
    with pytest.raises(InputError, match="must be one of correlation, amplitude, motion"):
        calibrate_tracked(vehicle, [run], objective="beauty")  # type: ignore[arg-type]
