# SPDX-License-Identifier: Apache-2.0
"""Calibration on marker runs: the preset ``tracked_paper`` with its objective, and ``fast``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.calibration.labels import parameter_unit
from suspension_twin.calibration.presets import PRESETS, build_space
from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult, Progress
from suspension_twin.calibration.run import calibrate
from suspension_twin.errors import InputError, WorkError
from suspension_twin.vehicle.tracked import BOUNDS, load_tracked
from suspension_twin.vehicle.twin import load_twin

KEYS = tuple(f"vehicle.{key}" for key in BOUNDS)


@pytest.fixture(scope="module")
def file(repository: Path) -> str:
    return str(repository / "config" / "tracked" / "pt91.yaml")


@pytest.fixture(scope="module")
def runs(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, str]:
    """Two seconds of two bundled runs at 13 km/h, over the obstacle's first edge, and of one at 8 km/h."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("13kmh_1", "13kmh_2", "08kmh_1"):
        lines = (repository / "config" / "tracked" / "runs" / f"{name}.csv").read_text("utf-8").splitlines()
        (folder / f"{name}.csv").write_text("\n".join(lines[:101]) + "\n", encoding="utf-8")
    one, two, slow = (str(folder / f"{name}.csv") for name in ("13kmh_1", "13kmh_2", "08kmh_1"))
    return one, two, slow


def test_the_papers_settings() -> None:
    preset = PRESETS["tracked_paper"]
    assert (preset.genetic.population, preset.genetic.generations) == (40, 30)
    assert preset.keys == KEYS and preset.objective == "correlation" and preset.slowest
    assert preset.channels["marker_A_displacement"] == preset.channels["marker_B_displacement"]


def test_the_five_parameters_are_searched_in_decades(file: str) -> None:
    space = build_space(load_twin(file), PRESETS["tracked_paper"])
    assert space.keys == KEYS
    middle = dict(zip(KEYS, space.from_unit(np.full((5, 1), 0.5))[:, 0], strict=True))
    assert middle["vehicle.track.stiffness"] == pytest.approx(1e7)
    assert middle["vehicle.idler.setting"] == pytest.approx(-5570.0)
    # the file's b_gl of 1e4 lies two thirds of the way from 1 to 1e6
    place = space.to_unit(space.nominal[:, None])[:, 0]
    assert place[KEYS.index("vehicle.track.damping")] == pytest.approx(2 / 3)
    assert space.from_unit(place[:, None])[:, 0] == pytest.approx(space.nominal)


def test_parameters_have_their_units() -> None:
    units = {
        "track.stiffness": "N/m",
        "track.bending_stiffness": "N m/rad",
        "track.damping": "N s/m",
        "track.bending_damping": "N m s/rad",
        "idler.setting": "mm",
        "idler.taut_at": "mm",
        "arm.stiffness": "N m/rad",
        "stations.0.damping": "N m s/rad",
        "stations.5.sag": "rad",
        "gyration": "m",
        "driver.gain": "",
        "mass": "kg",
        "cog.0": "m",
        "front.unsprung_mass": "kg",
        "sprung_inertia.roll": "kg m²",
        "tyre.vertical_stiffness": "N/m",
        "front.spring.force.2": "N",
    }
    assert {key: parameter_unit(f"vehicle.{key}") for key in units} == units
    assert parameter_unit("imu.rpy.1") == "rad" and parameter_unit("imu.position.0") == "m"
    assert parameter_unit("effects.track_tension.tighter") == "mm"


def searched(file: str, runs: tuple[str, ...], **given: object) -> CalibrationResult:
    request = CalibrationRequest(file, runs, preset="tracked_paper", seed=3, max_generations=2)
    return calibrate(replace(request, **given))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def found(file: str, runs: tuple[str, str, str]) -> CalibrationResult:
    return searched(file, (runs[2], runs[0]))


def test_the_search_improves_from_generation_to_generation(found: CalibrationResult) -> None:
    """On runs of a specimen that other code simulated."""
    best = found.history[:, 1]
    assert (np.diff(best) <= 0).all() and best[-1] < best[0] and found.evaluations == 40 + 2 * 38
    assert found.objective == "correlation" and found.cost < found.initial_cost
    assert tuple(e.key for e in found.estimates) == KEYS
    for e, (low, high) in zip(found.estimates, BOUNDS.values(), strict=True):
        assert (e.lower, e.upper) == (low, high) and low <= e.value <= high
    assert found.twin.vehicle.track.stiffness == found.estimates[0].value


def test_the_slowest_run_is_fitted_and_the_others_validate(found: CalibrationResult) -> None:
    slow, fast = found.drives
    assert (slow.name, fast.name) == ("08kmh_1", "13kmh_1")
    assert slow.correlation > 0.98 and np.isnan(fast.correlation)
    assert set(slow.measured) == set(fast.measured) and len(slow.measured) == 9
    after = np.corrcoef(fast.measured["marker_A_displacement"], fast.after["marker_A_displacement"])[0, 1]
    assert after > 0.95


@pytest.mark.long
def test_the_search_is_repeatable_and_stops_with_the_best_so_far(
    file: str, runs: tuple[str, str, str]
) -> None:
    heard: list[Progress] = []
    request = CalibrationRequest(file, runs[:1], preset="tracked_paper", seed=3, max_generations=1)
    first = calibrate(request, heard.append)
    search = [p for p in heard if p.stage == "search"]
    assert [p.generation for p in search] == [1, 2] and search[-1].best_cost == first.history[-1, 1]
    generations: list[int] = []
    stopped = calibrate(
        replace(request, max_generations=30),
        lambda p: generations.append(p.generation),
        lambda: max(generations, default=0) >= 2,
    )
    assert stopped.stopped and stopped.generations == first.generations
    assert [e.value for e in stopped.estimates] == [e.value for e in first.estimates]
    assert np.array_equal(stopped.history[: len(first.history)], first.history)
    none = calibrate(request, should_stop=lambda: True)
    assert none.stopped and none.estimates == ()


@pytest.mark.long
def test_a_candidate_that_cannot_be_is_the_worst_and_not_the_end(
    file: str, runs: tuple[str, str, str]
) -> None:
    """A centre of gravity ahead of the foremost wheels is no vehicle's."""
    key, first = "vehicle.cog.0", load_tracked(file).stations[0].x
    some = searched(
        file, runs[:1], free=(key,), bounds=((key, 2.0, 9.0),), max_generations=1, objective="mse"
    )
    assert np.isfinite(some.cost) and 2.0 <= some.estimates[0].value < first
    with pytest.raises(WorkError, match="no candidate could be simulated"):
        searched(file, runs[:1], free=(key,), bounds=((key, first, 9.0),), max_generations=1)


@pytest.mark.long
def test_fast_fits_every_run_and_says_what_it_identified(file: str, runs: tuple[str, str, str]) -> None:
    result = calibrate(CalibrationRequest(file, runs[:2], max_generations=6))
    assert set(KEYS) < {e.key for e in result.estimates}
    assert "vehicle.gyration" in {e.key for e in result.estimates}
    assert result.cost < result.initial_cost and len(result.drives) == 2
    for e in result.estimates:
        if e.status == "identified":
            assert e.low < e.value < e.high and e.low < e.high
    assert any(e.status == "identified" for e in result.estimates)
    units = {n.name.split(".")[-1]: n.unit for n in result.nuisances}
    assert units == {"clock_offset": "s", "speed": ""}


@pytest.mark.long
def test_a_late_camera_is_the_runs_clock(file: str, runs: tuple[str, str, str], tmp_path: Path) -> None:
    header, *lines = Path(runs[0]).read_text(encoding="utf-8").splitlines()
    table = np.loadtxt(lines, delimiter=",")
    table[:, 0] += 0.02
    np.savetxt(tmp_path / "13kmh_1.csv", table, delimiter=",", header=header, comments="", fmt="%.6g")
    key = "vehicle.idler.setting"
    asked = CalibrationRequest(file, runs[:1], free=(key,))
    plain, late = (
        {n.name.split(".")[-1]: n.value for n in calibrate(request).nuisances}["clock_offset"]
        for request in (asked, replace(asked, bags=(str(tmp_path / "13kmh_1.csv"),)))
    )
    assert abs(late - plain) == pytest.approx(0.02, abs=0.008)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"bags": ()}, "drives: none are given"),
        ({"objective": "beauty"}, "objective: beauty: one of euclidean, mse, correlation"),
        ({"channels": (("roll_rate", 1.0),)}, "objective: roll_rate: no such channel: one of marker_A"),
        ({"free": ("vehicle.wings",)}, "vehicle.wings"),
        ({"bags": ("13kmh_none.csv",)}, "13kmh_none.csv: No such file"),
    ],
)
def test_what_no_calibration_can_use_is_named(
    given: dict[str, object], words: str, file: str, runs: tuple[str, str, str]
) -> None:
    with pytest.raises(InputError) as error:
        searched(file, runs[:1], **given)
    assert words in str(error.value)
