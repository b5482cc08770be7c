# SPDX-License-Identifier: Apache-2.0
"""Curves of many points: as many unknowns as a curve of four, the same prior, and nearly the same forces simulated."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.calibration.presets import build_space, preset_named
from suspension_twin.inference.smooth_space import FEW_POINTS, KNOTS, SmoothSpace, smooth_space
from suspension_twin.inference.space import CURVES, Space, curve_keys
from suspension_twin.models.parameters import Parameter, Prior, twin_value
from suspension_twin.vehicle.twin import Twin

CAR = [key for key in CURVES if ".front." in key or ".rear." in key]


def with_points(twin: Twin, count: int) -> Twin:
    """The twin with progressive springs and degressive dampers of ``count`` points each."""
    changes: dict[str, object] = {}
    for key in CAR:
        x, force = twin_value(twin, key).points
        share = np.arange(1, count + 1) / count
        curve = 0.6 * share + 0.4 * share**3 if key.endswith("spring") else share**0.6
        name = "compression" if key.endswith("spring") else "velocity"
        changes[f"{key}.{name}"] = tuple((x[-1] * share).tolist())
        changes[f"{key}.force"] = tuple((force[-1] * curve).tolist())
    return twin.with_changes(changes)


def spaces(twin: Twin) -> tuple[Space, Space]:
    whole = build_space(twin, preset_named("fast"))
    return whole, smooth_space(twin, whole)


@pytest.fixture(scope="module")
def many(mondeo: Twin) -> Twin:
    return with_points(mondeo, 23)


def test_a_twin_of_few_points_keeps_its_space(mondeo: Twin) -> None:
    whole, few = spaces(with_points(mondeo, FEW_POINTS))
    assert few is whole and few.simulated(mondeo) is mondeo


def test_unknowns_do_not_grow_with_points(mondeo: Twin, many: Twin) -> None:
    whole, smooth = spaces(many)
    assert len(whole) == 6 * 23 + 2
    assert len(smooth) == len(spaces(mondeo)[0]) == len(spaces(with_points(mondeo, 32))[1])
    assert smooth.keys == whole.keys
    np.testing.assert_allclose(smooth.from_slopes(smooth.z0), whole.nominal, rtol=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 30.0))
@settings(max_examples=20, deadline=None)
def test_any_coordinates_give_rising_curves_within_the_bounds(many: Twin, seed: int, width: float) -> None:
    smooth = spaces(many)[1]
    z = smooth.z0[:, None] + width * np.random.default_rng(seed).standard_normal((len(smooth), 3))
    values = smooth.from_slopes(z)
    assert np.all(values >= smooth.lower[:, None] - 1e-9) and np.all(values <= smooth.upper[:, None] + 1e-9)
    assert all(np.all(np.diff(values[list(curve.rows)], axis=0) >= 0) for curve in smooth.curves)


def test_coordinates_invert(many: Twin) -> None:
    smooth = spaces(many)[1]
    z = smooth.z0 + 0.2 * np.random.default_rng(1).standard_normal(len(smooth))
    np.testing.assert_allclose(smooth.to_slopes(smooth.from_slopes(z)), z, atol=1e-9)


def test_a_shift_scales_whole_curves(many: Twin) -> None:
    for space in spaces(many):
        values = space.from_slopes(space.shifted(space.z0, 0.2, -0.1))
        for curve in space.curves:
            factor = np.exp(0.2 if curve.part == "spring" else -0.1)
            np.testing.assert_allclose(values[list(curve.rows)], factor * curve.force, rtol=1e-9)


def test_the_prior_is_that_of_a_curve_of_four_points(mondeo: Twin, many: Twin) -> None:
    four, smooth = spaces(mondeo)[0], spaces(many)[1]
    known, found = (np.linalg.inv(space.prior_precision(0.8)) for space in (four, smooth))
    curve = next(c for c in four.curves if c.key == "vehicle.rear.damper_pull")
    knots = [i for i, name in enumerate(smooth.names) if name.startswith(f"{curve.key}.knot.")]
    rows = list(curve.rows)
    np.testing.assert_allclose(found[np.ix_(knots, knots)], known[np.ix_(rows, rows)], atol=1e-12)
    alone = smooth.names.index("vehicle.sprung_inertia.roll"), four.keys.index("vehicle.sprung_inertia.roll")
    assert found[alone[0], alone[0]] == pytest.approx(known[alone[1], alone[1]])


def test_few_points_are_simulated_that_follow_the_curves(many: Twin) -> None:
    smooth = spaces(many)[1]
    assert isinstance(smooth, SmoothSpace)
    few = smooth.simulated(many)
    assert {len(curve_keys(few, [key])) for key in CAR} == {FEW_POINTS}
    z = smooth.shifted(smooth.z0, 0.1, 0.1)[:, None]
    values = dict(zip(smooth.simulated_keys, smooth.simulated_values(z)[:, 0], strict=True))
    for key in CAR:
        x, force = twin_value(many, key).points
        at = twin_value(few, key).points[0]
        simulated = [values[point] for point in curve_keys(few, [key])]
        line = np.interp(x, [0.0, *at], [0.0, *simulated])
        assert np.abs(line - np.exp(0.1) * force).max() < 0.01 * force[-1]


def test_a_curve_of_which_one_point_is_free_stays_as_it_is(many: Twin) -> None:
    key = "vehicle.front.spring.force.11"
    smooth = smooth_space(many, build_space(many, preset_named("fast"), free=[key]))
    assert smooth.names == smooth.simulated_keys == (key,)
    few = smooth.simulated(many)
    assert len(curve_keys(few, ["vehicle.front.spring"])) == 23
    assert len(curve_keys(few, ["vehicle.rear.spring"])) <= FEW_POINTS


# -- every coordinate by its formula -------------------------------------------------------------------------------

SPRING = "vehicle.front.spring"


def hats(points: int) -> np.ndarray:
    """(n, K) of points spread evenly over the knots, the first and the last on one."""
    place = np.arange(points) * (KNOTS - 1) / (points - 1)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(KNOTS)))


def with_spring(twin: Twin, x: np.ndarray, force: np.ndarray) -> Twin:
    changes = {f"{SPRING}.compression": tuple(x.tolist()), f"{SPRING}.force": tuple(force.tolist())}
    return twin.with_changes(changes)


def free(twin: Twin, *more: Parameter, spread: float = 0.5) -> Space:
    """The front spring within wide bounds, and more before it."""
    keys = curve_keys(twin, [SPRING])
    values = [float(twin_value(twin, k)) for k in keys]
    spring = [
        Parameter(k, (1e-3 * v, 1e3 * v + 1.0), Prior(v, spread, "log"))
        for k, v in zip(keys, values, strict=True)
    ]
    return smooth_space(twin, Space(twin, [*more, *spring]))


@pytest.mark.parametrize("points", [FEW_POINTS + 1, 22, 23])
def test_the_change_of_log_slopes_is_linear_between_the_knots(mondeo: Twin, points: int) -> None:
    twin = with_points(mondeo, points)
    mass = Parameter("vehicle.mass", (1000.0, 3000.0), Prior(1725.0, 0.1, "log"))
    smooth = free(twin, mass)
    assert smooth.names == ("vehicle.mass", *(f"{SPRING}.knot.{k}" for k in range(KNOTS)))
    np.testing.assert_allclose(smooth.z0, 0.0, atol=1e-9)
    moved = np.random.default_rng(2).normal(scale=0.3, size=(5, 3))
    values = smooth.from_slopes(moved)
    x, force = twin_value(twin, SPRING).points
    slope = np.diff(force, prepend=0.0) / np.diff(x, prepend=0.0)
    for k in range(3):
        wanted = np.cumsum(slope * np.exp(hats(points) @ moved[1:, k]) * np.diff(x, prepend=0.0))
        np.testing.assert_allclose(values[1:, k], wanted, rtol=1e-9)
        np.testing.assert_array_equal(smooth.from_slopes(moved[:, k]), values[:, k])
    np.testing.assert_allclose(values[0], 1725.0 * np.exp(moved[0]))
    np.testing.assert_allclose(smooth.to_slopes(values), moved, atol=1e-9)


def test_coordinates_of_any_curve_are_those_of_the_nearest_smooth_change(many: Twin) -> None:
    """By least squares of the log slopes."""
    smooth = free(many)
    x, force = twin_value(many, SPRING).points
    off = np.random.default_rng(3).normal(scale=0.3, size=(23, 2))
    slope = np.diff(force, prepend=0.0) / np.diff(x, prepend=0.0)
    values = np.cumsum((slope * np.diff(x, prepend=0.0))[:, None] * np.exp(off), axis=0)
    wanted = np.linalg.lstsq(hats(23), off, rcond=None)[0]
    np.testing.assert_allclose(smooth.to_slopes(values), wanted, atol=1e-9)
    np.testing.assert_allclose(smooth.to_slopes(values[:, 0]), wanted[:, 0], atol=1e-9)


def test_shifts_move_the_knots_of_springs_and_of_dampers_and_points_of_small_curves(many: Twin) -> None:
    """Of the rest only points of curves."""
    few, x, force = with_points(many, 4), *twin_value(many, SPRING).points
    twin = with_spring(few, x, force)
    keys = [*curve_keys(twin, [SPRING]), *curve_keys(twin, ["vehicle.rear.damper_push"])]
    values = [float(twin_value(twin, k)) for k in keys]
    found = [
        Parameter(k, (v / 9.0, v * 9.0), Prior(v, 0.5, "log")) for k, v in zip(keys, values, strict=True)
    ]
    smooth = smooth_space(
        twin, Space(twin, [Parameter("vehicle.mass", (1e3, 3e3), Prior(1725.0, 0.5, "log")), *found])
    )
    start = np.arange(float(len(smooth)))
    moved = smooth.shifted(start, 0.3, -0.2) - start
    wanted = [0.3 if ".spring." in n else -0.2 if ".damper_" in n else 0.0 for n in smooth.names]
    np.testing.assert_allclose(moved, wanted, atol=1e-12)
    assert sorted(set(wanted)) == [-0.2, 0.0, 0.3] and start[0] == 0.0


def test_the_usual_prior_is_one_and_lets_neighbours_follow(many: Twin) -> None:
    smooth = free(many, Parameter("vehicle.mass", (1e3, 3e3), Prior(1725.0, 0.1, "log")), spread=0.4)
    precision = smooth.prior_precision()
    assert np.linalg.eigvalsh(precision).min() > 0.0
    covariance = np.linalg.inv(precision)
    np.testing.assert_allclose(np.diag(covariance), [0.01, *[0.16] * KNOTS])
    assert 0.5 < covariance[1, 2] / 0.16 < 1.0
    lone = np.linalg.inv(smooth.prior_precision(0.5))
    apart = np.abs(np.subtract.outer(np.arange(KNOTS), np.arange(KNOTS)))
    np.testing.assert_allclose(lone[1:, 1:], 0.16 * 0.5**apart)
    np.testing.assert_allclose(lone[0, 1:], 0.0, atol=1e-12)


def simulated_points(twin: Twin) -> list[int]:
    """Which of its own points a curve keeps."""
    smooth = free(twin)
    few = smooth.simulated(twin)
    x, at = twin_value(twin, SPRING).points[0], twin_value(few, SPRING).points[0]
    kept = [int(np.argmin(np.abs(x - place))) for place in at]
    np.testing.assert_array_equal(x[kept], at)
    np.testing.assert_array_equal(twin_value(few, SPRING).points[1], twin_value(twin, SPRING).points[1][kept])
    assert few.vehicle.mass == twin.vehicle.mass
    # values are simulated at the same points
    z = np.random.default_rng(4).normal(scale=0.1, size=(KNOTS, 2))
    np.testing.assert_array_equal(smooth.simulated_values(z), smooth.from_slopes(z)[kept])
    assert smooth.simulated_keys == tuple(f"{SPRING}.force.{i}" for i in range(len(kept)))
    return kept


@pytest.mark.parametrize("points", [10, 22, 31])
def test_a_straight_curve_is_simulated_at_its_knots_alone(mondeo: Twin, points: int) -> None:
    x = 0.37 * np.arange(1, points + 1) / points
    kept = simulated_points(with_spring(mondeo, x, 62_000.0 / 0.37 * x))
    assert kept == [round(k * (points - 1) / (KNOTS - 1)) for k in range(KNOTS)]


def test_a_bend_at_a_knot_needs_no_point_of_its_own_and_one_beside_it_does(mondeo: Twin) -> None:
    """Also of a spring that bears nothing at first."""
    x = 0.37 * np.arange(1, 23) / 22
    for bend, more in ((7, []), (10, [10])):
        kept = simulated_points(with_spring(mondeo, x, 1e5 * np.maximum(x - x[bend], 0.0)))
        assert kept == sorted([0, 7, 14, 21, *more])


def test_the_points_that_are_added_are_those_furthest_from_the_line(mondeo: Twin) -> None:
    x = 0.4 * np.arange(1, 22) / 21
    force = 20e3 * x
    force[10:] += 900.0
    force[17:] += 2000.0
    kept = simulated_points(with_spring(mondeo, x, force))
    assert len(kept) == FEW_POINTS and {0, 7, 13, 20} < set(kept)
    assert set(kept) == {0, 7, 9, 10, 13, 16, 17, 20}


def test_a_frozen_curve_of_many_points_is_simulated_by_its_last_and_those_that_follow_it(many: Twin) -> None:
    """It has no knots."""
    x = 0.37 * np.arange(1, 31) / 30
    straight = with_spring(many, x, 1e5 * x)
    mass = Parameter("vehicle.mass", (1000.0, 3000.0), Prior(1725.0, 0.5, "log"))
    smooth = smooth_space(straight, Space(straight, [mass]))
    assert smooth.names == smooth.simulated_keys == ("vehicle.mass",)
    few = smooth.simulated(straight)
    assert twin_value(few, SPRING).points[0].tolist() == [x[-1]]
    bent = twin_value(many, "vehicle.rear.damper_pull").points
    at, force = twin_value(few, "vehicle.rear.damper_pull").points
    assert len(at) == FEW_POINTS and at[-1] == bent[0][-1]
    assert np.abs(np.interp(bent[0], [0.0, *at], [0.0, *force]) - bent[1]).max() < 0.02 * bent[1][-1]


def test_one_curve_of_many_points_makes_a_space_smooth(mondeo: Twin, many: Twin) -> None:
    x, force = twin_value(many, SPRING).points
    assert isinstance(free(with_spring(mondeo, x, force)), SmoothSpace)
    assert not isinstance(free(with_points(mondeo, FEW_POINTS)), SmoothSpace)
    assert isinstance(free(with_points(mondeo, FEW_POINTS + 1)), SmoothSpace)
