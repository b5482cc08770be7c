# SPDX-License-Identifier: Apache-2.0
"""Detectability by a set-up: projections against closed forms, physics that every engineer knows."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from suspension_twin.addons.plan.plan import plan, rays
from suspension_twin.addons.plan.sensitivity import Products
from suspension_twin.cli.main import main
from suspension_twin.diagnosis.library import library
from suspension_twin.diagnosis.next_experiment import planned_drive
from suspension_twin.errors import InputError
from suspension_twin.road import add_bump, bump_road, half_sine, write_road
from suspension_twin.vehicle.twin import load_twin, save_twin


def across(height=0.06):
    return bump_road(half_sine(0.9, height), at=20.0, length=50.0)


def one_sided():
    return add_bump(
        bump_road(half_sine(0.9, 1e-6), at=10.0, length=50.0), half_sine(0.9, 0.05), 20.0, v_low=0.1
    )


def of(columns, known, high=np.inf):
    """Products of columns (n, K), white and in units of the expected residual."""
    square = columns.T @ columns
    low, high = np.full(known, -high), np.full(known, high)
    names = tuple(f"c{i}" for i in range(columns.shape[1]))
    return Products(
        names, known, 1e-9 * np.eye(known), low, high, square, square[None] / len(columns), ("a",)
    )


def test_known_parameters_leave_the_least_squares_residual():
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((50, 5))
    found = of(columns, 3)
    ratios, squares = found.left(np.array([3, 4]))
    solution, *_ = np.linalg.lstsq(columns[:, :3], columns[:, 3:], rcond=None)
    residual = columns[:, 3:] - columns[:, :3] @ solution
    np.testing.assert_allclose(squares, np.sum(residual**2, axis=0), rtol=1e-6)
    np.testing.assert_allclose(ratios[0], np.sqrt(np.mean(residual**2, axis=0)), rtol=1e-6)


def test_a_nuisance_makes_up_for_no_more_than_its_bound():
    columns = np.array([[1.0, 10.0], [0.0, 1.0]])  # of the ten one may take three
    _, squares = of(columns, 1, high=3.0).left(np.array([1]))
    assert squares[0] == pytest.approx(7.0**2 + 1.0)
    _, squares = of(columns, 1).left(np.array([1]))
    assert squares[0] == pytest.approx(1.0)


def test_a_rival_takes_what_is_parallel_to_it():
    columns = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 2.0], [0.0, 0.0, 1.0]])
    found = of(columns, 1)
    _, alone = found.left(np.array([2]))
    _, beside = found.left(np.array([2]), np.array([1]), np.array([1e3]))
    assert alone[0] == pytest.approx(5.0)
    assert beside[0] == pytest.approx(1.0, rel=1e-5)


def test_drives_add_up_and_keep_their_own_nuisances():
    rng = np.random.default_rng(1)
    first, second = (of(rng.standard_normal((40, 3)), 2) for _ in range(2))
    first = replace(first, names=("mass", "first.clock", "effect"))
    second = replace(second, names=("mass", "second.clock", "effect"))
    both = first + second
    assert both.names == ("mass", "first.clock", "second.clock", "effect")
    assert both.white[1, 2] == 0.0
    assert both.white[0, 3] == pytest.approx(first.white[0, 2] + second.white[0, 2])
    assert both.channels == ("a", "a")


def test_sizes_between_points_and_below_the_first(mondeo):
    friction = rays(library(mondeo, True)["strut_friction"][0])[0]
    ratios = friction.sizes / 100.0
    assert friction.size_from(ratios, 1.5) == pytest.approx(150.0)
    assert friction.size_from(ratios, 0.05) == pytest.approx(5.0)
    assert friction.size_from(ratios, 60.0) is None


def test_a_low_pass_grows_as_its_cutoff_falls(mondeo):
    cutoff = rays(library(mondeo, True)["sensor_bandwidth"][0], 1.0)[0]
    assert (np.diff(cutoff.sizes) < 0).all()
    assert cutoff.rank(5.0) > cutoff.rank(10.0)


@pytest.fixture(scope="module")
def clocks(mondeo):
    """Clock and map at one speed, and at three."""
    only = ("time_offset", "position_offset")
    return [plan(mondeo, across(), speeds, only) for speeds in ((20.0,), (8.0, 20.0, 35.0))]


def test_at_one_speed_a_late_clock_is_a_shifted_map_and_other_speeds_separate_them(clocks):
    one, several = clocks
    assert {(p.effect, p.rival) for p in one.pairs} == {
        ("time_offset", "position_offset"),
        ("position_offset", "time_offset"),
    }
    for pair in one.pairs:
        assert pair.angle < 3.0
        assert pair.size is None or pair.size > 4.0 * pair.shown.size
        assert "km/h" in pair.remedy
        assert pair.remedy_size < 0.5 * (pair.size or np.inf)
    assert not several.pairs
    assert several.angles[0, 1] > 20.0


def test_a_clock_offset_shows_beyond_the_range_of_the_nuisance(clocks):
    size = next(s.size for s in clocks[1].detectability if s.effect == "time_offset")
    assert 0.006 < size < 0.03  # three standard deviations of the nuisance, and a good deal less than typical


def test_effects_of_roll_show_on_a_one_sided_bump_alone(mondeo):
    only = ("sensor_offset", "anti_roll_bar")
    flat, lopsided = (plan(mondeo, road, (20.0,), only) for road in (across(), one_sided()))
    for found, wanted in ((flat, False), (lopsided, True)):
        seen = {(s.effect, s.parameter): s for s in found.detectability}
        assert (seen["sensor_offset", "y"].size is not None) == wanted
        assert (seen["anti_roll_bar", "front_stiffness"].ratio > 0.1) == wanted
        assert seen["sensor_offset", "x"].size is not None
    assert seen["sensor_offset", "y"].channel == "vertical_acceleration"


def test_a_higher_bump_shows_a_smaller_fault_until_model_discrepancy_dominates(mondeo):
    """The response to the fault and the model discrepancy grow with the bump, the noise does not."""
    sizes = [
        next(
            s.size
            for s in plan(mondeo, across(h), (20.0,), ("sensor_offset",)).detectability
            if s.parameter == "x"
        )
        for h in (0.006, 0.024, 0.096)
    ]
    gains = sizes[0] / sizes[1], sizes[1] / sizes[2]
    assert gains[0] > 1.5
    assert 1.0 < gains[1] < 0.7 * gains[0]


def test_inputs_that_cannot_be_planned_are_one_line(mondeo, repository):
    with pytest.raises(InputError, match="does not drive on a road"):
        plan(load_twin(repository / "config" / "tracked" / "pt91.yaml"), across())
    with pytest.raises(InputError, match="too short"):
        planned_drive(mondeo, bump_road(half_sine(0.9, 0.05), at=1.0, length=3.0), 20.0)
    with pytest.raises(InputError, match="between 1 and 300 km/h"):
        planned_drive(mondeo, across(), 0.0)
    with pytest.raises(InputError, match="road: is missing"):
        plan(mondeo)


def test_the_command_writes_a_document_and_a_page(mondeo, tmp_path, capsys, monkeypatch):
    import suspension_twin.addons.plan.plan as module

    whole = module.library
    few = ("time_offset", "position_offset", "corner_damper")
    monkeypatch.setattr(module, "library", lambda twin, excited, only: whole(twin, excited, only or few))
    write_road(across(), tmp_path / "road.crg")
    save_twin(mondeo.with_changes({"road": {"file": str(tmp_path / "road.crg")}}), tmp_path / "twin.yaml")
    command = ["plan", "--twin", str(tmp_path / "twin.yaml"), "--speed", "20", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert text.startswith("Writes ")
    assert "one odd damper, front left" in text and "clock offset" in text
    document = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert {e["effect"] for e in document["effects"]} == set(few)
    assert document["drives"][0]["speed_kmh"] == 20.0
    assert "never" in (tmp_path / "out" / "plan.html").read_text()
    assert main(command) == 2
    assert "--force" in capsys.readouterr().err
