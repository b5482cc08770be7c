# SPDX-License-Identifier: Apache-2.0
"""The preset ``tracked_paper``: its objective, its search, its markers file, what its runs determine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.calibration.tracked_paper import (
    PUBLISHED,
    SETTINGS,
    MarkerRun,
    calibrate_tracked,
    compare,
    identifiability,
    read_markers,
)
from suspension_twin.errors import InputError
from suspension_twin.models.tracked import simulate_tracked
from suspension_twin.vehicle.tracked import BOUNDS, TrackedVehicle, load_tracked


@pytest.fixture(scope="module")
def vehicle(repository: Path) -> TrackedVehicle:
    return load_tracked(repository / "config" / "tracked" / "pt91.yaml")


@pytest.fixture(scope="module")
def run(vehicle: TrackedVehicle) -> MarkerRun:
    response = simulate_tracked(vehicle, 13 / 3.6, 3.0, rate=50.0)
    return MarkerRun(response.t, response.markers, 13 / 3.6)


def test_the_papers_settings() -> None:
    assert (SETTINGS.population, SETTINGS.generations) == (40, 30)
    assert all(BOUNDS[key][0] <= value <= BOUNDS[key][1] for key, value in PUBLISHED.items())


def test_correlation_is_blind_to_amplitude(run: MarkerRun) -> None:
    twice = compare(run.markers, 2 * run.markers)
    assert twice.cost("correlation") == pytest.approx(0.0, abs=1e-12)
    assert twice.cost("amplitude") == pytest.approx(1.0)
    assert twice.gain == pytest.approx([2.0, 2.0])
    assert compare(run.markers, -run.markers).correlation == pytest.approx([-1.0, -1.0])
    expected = [np.corrcoef(run.markers[:, k], run.markers[:, 1 - k])[0, 1] for k in (0, 1)]
    assert compare(run.markers, run.markers[:, ::-1]).correlation == pytest.approx(expected)


@pytest.mark.parametrize("objective", ["correlation", "amplitude"])
def test_the_search_comes_near_and_is_repeatable(vehicle: TrackedVehicle, run: MarkerRun, objective: str) -> None:
    start = vehicle.with_changes({"track.stiffness": 1e5, "track.bending_stiffness": 10.0})
    settings = replace(SETTINGS, population=10, generations=4)
    kinds = {"objective": objective, "seed": 3, "settings": settings}
    first = calibrate_tracked(start, run, **kinds)  # type: ignore[arg-type]
    again = calibrate_tracked(start, run, **kinds)  # type: ignore[arg-type]
    assert first.values == again.values
    assert (np.diff(first.best) <= 0).all() and first.evaluations > 40
    assert first.worth.cost(objective) == pytest.approx(first.best[-1])  # type: ignore[arg-type]
    assert first.worth.correlation.mean() > 0.9
    assert all(BOUNDS[key][0] <= value <= BOUNDS[key][1] for key, value in first.values.items())


def test_more_noise_determines_less(vehicle: TrackedVehicle, run: MarkerRun) -> None:
    quiet, loud = (identifiability(vehicle, [run], noise) for noise in (1e-4, 1e-2))
    assert set(quiet) == set(BOUNDS)
    assert all(quiet[key] < loud[key] for key in BOUNDS)
    assert max(loud, key=loud.__getitem__) == "track.damping"


def test_markers_are_read_as_they_were_written(tmp_path: Path) -> None:
    t = np.arange(0, 3, 0.004)
    table = np.stack([t, 100 * np.sin(t), 50 * np.cos(t)], axis=1)
    path = tmp_path / "run.csv"
    np.savetxt(path, table, delimiter=",", header="t,A,B", comments="")
    read = read_markers(path, 1.1)
    assert read.rate == pytest.approx(50.0)
    assert np.abs(read.markers[:, 0] - 0.1 * np.sin(read.t)).max() < 1e-5


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("t,B,A\n1,2,3\n", "must be t,A,B"),
        ("t,A,B\n1,2,x\n", "not a table"),
        ("t,A,B\n1,2,3\n", "at least 20 rows"),
        ("t,A,B\n" + "".join(f"{k % 7},1,2\n" for k in range(30)), "must rise"),
        ("t,A,B\n" + "".join(f"{k},nan,2\n" for k in range(30)), "no numbers"),
        ("t,A,B\n" + "".join(f"{k},{k * 1e6},2\n" for k in range(30)), "is the unit mm"),
    ],
)
def test_what_is_no_markers_file(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "markers.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=word) as error:
        read_markers(path, 1.0)
    assert "markers.csv" in str(error.value) and "\n" not in str(error.value)
