# SPDX-License-Identifier: Apache-2.0
"""Controlled runs as observations: what may be simulated once, and what may not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.drive.rig import RigRecord, read_rig, write_rig
from suspension_twin.errors import InputError
from suspension_twin.inference.marker_runs import CUTOFF, FLOORS, MarkerRun, low_pass, read_run
from suspension_twin.inference.nuisance import OF_A_RIG, OF_A_RUN
from suspension_twin.inference.observation import Observation, renamed
from suspension_twin.inference.runs import marker_observation, observe_runs
from suspension_twin.vehicle.twin import Twin, load_twin


def beginning(path: Path, lines: int, folder: Path) -> Path:
    """A recording that ends early."""
    out = folder / f"first_{lines}_{path.name}"
    out.write_text("\n".join(path.read_text("utf-8").splitlines()[:lines]) + "\n", encoding="utf-8")
    return out


@pytest.mark.parametrize("long_first", [True, False])
def test_repeats_at_one_speed_are_simulated_once_where_one_is_a_part_of_the_other(
    long_first: bool, repository: Path, tmp_path: Path
) -> None:
    vehicle = load_twin(repository / "config" / "tracked" / "pt91.yaml").vehicle
    run = repository / "config" / "tracked" / "runs" / "13kmh_1.csv"
    long, short = (read_run(beginning(run, n, tmp_path), vehicle, 13.0 / 3.6) for n in (101, 71))
    first, second = (long, short) if long_first else (short, long)
    known = marker_observation(first)
    seen = marker_observation(second, [known])
    assert (seen.excitation is known.excitation) == long_first
    assert len(seen.excitation) > seen.t[-1] * seen.rate - 0.5


@pytest.mark.parametrize("long_first", [True, False])
def test_runs_of_a_rig_share_a_program_only_if_it_is_the_same(
    long_first: bool, repository: Path, tmp_path: Path
) -> None:
    twin = load_twin(repository / "config" / "twins" / "quarter_car.yaml")
    whole = repository / "config" / "rig" / "random.csv"
    part = beginning(whole, 1501, tmp_path)
    pair = [whole, part] if long_first else [part, whole]
    one, again, other = observe_runs(twin, [str(path) for path in (pair[0], pair[0], pair[1])])
    assert again.excitation is one.excitation and again.name != one.name
    assert other.excitation is not one.excitation
    assert one.position[-1] < other.position[0] or other.position[-1] < one.position[0]


# -- runs with markers -----------------------------------------------------------------------------


def marker_run(
    first: int = 10, count: int = 40, speed: float = 3.0, seen: Any = (True, True, True)
) -> MarkerRun:
    t = (first + np.arange(count)) / 50.0
    motion = np.random.default_rng(0).standard_normal((3, count, 3))
    return MarkerRun(t, *motion, speed, "some run", seen)


def test_a_run_with_markers_is_what_was_filmed() -> None:
    run = marker_run()
    seen = marker_observation(run)
    assert seen.name == "some run" and seen.rate == pytest.approx(50.0) and seen.bandwidth == CUTOFF
    assert seen.usage.priors == OF_A_RUN and seen.warnings == () and seen.position_sigma == 0.0
    np.testing.assert_array_equal(seen.t, run.t)
    np.testing.assert_allclose(seen.position, 3.0 * run.t)
    np.testing.assert_array_equal(seen.along, np.full(40, 3.0))
    columns = {"displacement": run.markers, "velocity": run.velocity, "acceleration": run.acceleration}
    assert len(seen.measured) == len(seen.noise_rms) == 9
    for k, (kind, values) in enumerate(columns.items()):
        for i, marker in enumerate("ABC"):
            np.testing.assert_array_equal(seen.measured[f"marker_{marker}_{kind}"], values[:, i])
            assert seen.noise_rms[f"marker_{marker}_{kind}"] == FLOORS[3 * k + i]


def test_a_marker_that_was_not_seen_is_not_compared() -> None:
    seen = marker_observation(marker_run(seen=(True, True, False)))
    assert len(seen.measured) == 6 and list(seen.measured) == list(seen.noise_rms)
    assert not any("_C_" in name for name in seen.measured)


@pytest.mark.parametrize("first", [0, 10])
def test_what_is_simulated_begins_with_the_run_and_is_compared_where_it_was_filmed(first: int) -> None:
    """The excitation begins at zero, whenever the film does, and ends with it; both sides pass one low-pass."""
    run = marker_run(first)
    seen = marker_observation(run)
    assert seen.excitation.speed == 3.0
    np.testing.assert_allclose(seen.excitation.t, np.arange(first + 40) / 50.0, atol=1e-12)
    stamps = np.repeat(seen.excitation.t[:, None], 2, axis=1)
    filtered = low_pass(stamps, 50.0)
    path = seen.apply(stamps)
    np.testing.assert_allclose(path, filtered[first : first + 40], rtol=1e-12)
    assert path.flags.c_contiguous


def test_repeats_share_an_excitation_of_their_speed_alone() -> None:
    long, slow, short = marker_run(count=60), marker_run(count=60, speed=2.0), marker_run()
    known = [marker_observation(slow), marker_observation(long)]
    assert marker_observation(short, known).excitation is known[1].excitation
    assert marker_observation(long, known).excitation is known[1].excitation  # just as long
    longer = marker_observation(marker_run(count=61), known)
    assert longer.excitation is not known[1].excitation and len(longer.excitation) == 71


def test_the_gap_of_a_run_is_over_all_its_samples() -> None:
    seen = marker_observation(marker_run())
    same = seen.gap(seen.measured)
    assert same.rms == 0.0
    off = seen.gap({name: values + 0.5 for name, values in seen.measured.items()})
    assert off.rms == pytest.approx(0.5) and off.noise_rms == FLOORS[0]


def test_runs_are_read_in_the_order_that_they_are_given(repository: Path, tmp_path: Path) -> None:
    """Whichever is the longest is simulated for all of its speed; runs of one name are told apart."""
    twin = load_twin(repository / "config" / "tracked" / "pt91.yaml")
    run = repository / "config" / "tracked" / "runs" / "13kmh_1.csv"
    short, long = (beginning(run, n, tmp_path) for n in (61, 91))
    found = observe_runs(twin, [str(short), str(long), str(short)])
    assert [r.t.size for r in found] == [60, 90, 60]
    assert [r.name for r in found] == [short.stem, long.stem, f"{short.stem}_2"]
    assert len({id(r.excitation) for r in found}) == 1
    assert len(found[0].excitation) == round(found[1].t[-1] * found[1].rate) + 1


# -- runs of a rig ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corner(repository: Path) -> Twin:
    return load_twin(repository / "config" / "twins" / "quarter_car.yaml")


@pytest.fixture(scope="module")
def record(repository: Path) -> RigRecord:
    whole = read_rig(repository / "config" / "rig" / "random.csv")
    return RigRecord("rig", whole.t[:800], {k: v[:800] for k, v in whole.columns.items()})


def runs_of(corner: Twin, folder: Path, *records: RigRecord) -> list[Observation]:
    paths = [folder / f"{i}" / "run.csv" for i in range(len(records))]
    for path, one in zip(paths, records, strict=True):
        path.parent.mkdir()
        write_rig(one, path)
    return observe_runs(corner, [str(path) for path in paths])


def changed(record: RigRecord, name: str, by: np.ndarray) -> RigRecord:
    old = record.columns.get(name, np.zeros(record.t.size))
    return replace(record, columns={**record.columns, name: old + by})


def test_inputs_that_differ_by_the_noise_of_a_transducer_share_an_excitation(
    corner: Twin, record: RigRecord, tmp_path: Path
) -> None:
    """A hundredth of their rms, 0.1 mm of 10 mm; an actuator repeats a program to some per cent."""
    rng = np.random.default_rng(0)
    road = record.columns["road_displacement"]
    noise = np.std(road) * rng.standard_normal(road.size)
    others = [changed(record, "road_displacement", share * noise) for share in (0.005, 0.03, 1.0)]
    one, again, repeated, other, last = runs_of(corner, tmp_path, record, *others, record)
    assert one.excitation is again.excitation is last.excitation
    assert other.excitation is not one.excitation is not repeated.excitation
    assert [r.name for r in (one, again, other, last)] == ["run", "run_2", "run_4", "run_5"]
    # samples of one program at one time are held out together, of two programs never
    np.testing.assert_array_equal(one.position, again.position)
    np.testing.assert_array_equal(one.position, last.position)
    np.testing.assert_array_equal(one.position, repeated.position)
    assert not set(other.usage.block) & set(one.usage.block)
    for run in (one, other):
        np.testing.assert_allclose(np.diff(run.position), 1.0 / run.rate)
        assert (run.along == 1.0).all() and run.along.shape == run.t.shape
        assert run.usage.priors == OF_A_RIG
    assert set(one.measured) == set(one.noise_rms) == set(record.columns) - {"road_displacement"}
    assert one.apply(np.zeros((800, 2))).shape == (one.t.size, 2)
    assert one.bandwidth < one.rate / 2


def test_an_actuator_is_an_input_too(corner: Twin, record: RigRecord, tmp_path: Path) -> None:
    push = 100.0 * np.sin(20.0 * record.t)
    forced = changed(record, "actuator_force", push)
    passive, one, again, other = runs_of(
        corner, tmp_path, record, forced, forced, changed(forced, "actuator_force", 0.1 * push)
    )
    assert one.excitation is again.excitation
    assert len({id(r.excitation) for r in (passive, one, other)}) == 3


def test_a_vehicle_that_is_compared_with_drives_has_no_runs(mondeo: Twin) -> None:
    with pytest.raises(InputError, match="full_car is compared with recorded drives"):
        observe_runs(mondeo, ["run.csv"])


# -- names -----------------------------------------------------------------------------------------


def test_observations_of_one_name_get_numbers() -> None:
    def names(*given: str) -> list[str]:
        return [o.name for o in renamed([replace(seen, name=name) for name in given])]

    seen = marker_observation(marker_run())
    assert names("a", "b", "c") == ["a", "b", "c"]
    assert names("a", "a", "b", "a", "a") == ["a", "a_2", "b", "a_3", "a_4"]
    assert names("a_2", "a", "a") == ["a_2", "a", "a_3"]
    assert names("a", "a", "a_2") == ["a", "a_2", "a_2_2"]
    assert renamed([]) == []
    kept, other = renamed([seen, seen])
    assert kept is seen and other.t is seen.t
