# SPDX-License-Identifier: Apache-2.0
"""Search spaces: both coordinate systems keep curves rising and invert each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.errors import InputError
from suspension_twin.inference.space import Curve, Space, bounds_of, curve_keys
from suspension_twin.models.parameters import Parameter, Prior, twin_value
from suspension_twin.vehicle.twin import Twin, load_twin


def wide_space(twin: Twin, keys: tuple[str, ...] | None = None, factor: float = 20.0) -> Space:
    keys = curve_keys(twin) if keys is None else keys
    values = [float(twin_value(twin, k)) for k in keys]
    return Space(
        twin,
        [
            Parameter(k, (v / factor, v * factor), Prior(v, 0.5, "log"))
            for k, v in zip(keys, values, strict=True)
        ],
    )


def rising(space: Space, values: np.ndarray) -> bool:
    full = dict(zip(space.keys, values, strict=True))
    for curve in space.curves:
        force = [full[space.keys[r]] if r >= 0 else f for r, f in zip(curve.rows, curve.force, strict=True)]
        if force[0] < 0 or np.any(np.diff(force) < 0):
            return False
    return True


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 30.0))
@settings(max_examples=60, deadline=None)
def test_any_coordinates_give_rising_curves_within_the_bounds(mondeo: Twin, seed: int, width: float) -> None:
    space = wide_space(mondeo)
    rng = np.random.default_rng(seed)
    for values in (
        space.from_slopes(space.z0 + width * rng.standard_normal(len(space))),
        space.from_unit(0.5 + width * rng.standard_normal(len(space))),
    ):
        assert rising(space, values)
        assert np.all(values >= space.lower - 1e-9) and np.all(values <= space.upper + 1e-9)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_coordinates_invert(mondeo: Twin, seed: int) -> None:
    space = wide_space(mondeo)
    rng = np.random.default_rng(seed)
    z = space.z0 + 0.5 * rng.standard_normal(len(space))
    np.testing.assert_allclose(space.to_slopes(space.from_slopes(z)), z, rtol=0, atol=1e-9)
    values = space.from_slopes(z)
    np.testing.assert_allclose(space.from_unit(space.to_unit(values)), values, rtol=1e-12)


def test_a_frozen_point_holds_its_neighbours(mondeo: Twin) -> None:
    keys = tuple(k for k in curve_keys(mondeo, ("vehicle.front.spring",)) if not k.endswith(".2"))
    space = wide_space(mondeo, keys)
    frozen = twin_value(mondeo, "vehicle.front.spring.force.2")
    z = space.z0 + 5.0
    low = space.from_slopes(z)
    assert low[0] <= low[1] <= frozen <= low[2]
    values = space.from_unit(np.ones(len(space)))
    assert values[1] == pytest.approx(frozen)


def test_other_parameters_move_by_ratio_or_by_spread(mondeo: Twin) -> None:
    mass = Parameter("vehicle.mass", (1000.0, 3000.0), Prior(1725.0, 0.1, "log"))
    shift = Parameter("vehicle.cog.1", (-0.2, 0.2), Prior(0.0, 0.05))
    space = Space(mondeo, [mass, shift])
    assert space.from_slopes(np.array([np.log(1.1), 2.0])) == pytest.approx([1.1 * 1725.0, 0.1])
    assert space.to_slopes(np.array([1725.0, -0.05])) == pytest.approx([0.0, -1.0])
    assert space.from_unit(np.array([0.5, 0.5])) == pytest.approx([np.sqrt(3e6), 0.0])


def test_prior_couples_neighbours_of_one_curve_only(mondeo: Twin) -> None:
    space = wide_space(mondeo)
    covariance = np.linalg.inv(space.prior_precision(0.8))
    names = [k.rsplit(".", 1)[0] for k in space.keys]
    for i, a in enumerate(names):
        for j, b in enumerate(names):
            if a != b:
                assert abs(covariance[i, j]) < 1e-12
    assert covariance[0, 1] / covariance[0, 0] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ([Parameter("vehicle.mass", (2.0, 1.0), Prior(1.0, 0.5, "log"))], "vehicle.mass"),
        ([Parameter("vehicle.mass", (-2.0, 1.0), Prior(1.0, 0.5, "log"))], "above 0"),
        ([Parameter("vehicle.front.spring.force.9", (0.5, 2.0), Prior(1.0, 0.5, "log"))], "has 4 points"),
        (
            [
                Parameter("vehicle.front.spring.force.0", (2000.0, 3000.0), Prior(2300.0, 0.5, "log")),
                Parameter("vehicle.front.spring.force.1", (500.0, 1500.0), Prior(1000.0, 0.5, "log")),
            ],
            "no rising curve",
        ),
    ],
)
def test_wrong_spaces_are_refused_by_name(mondeo: Twin, parameters: list[Parameter], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Space(mondeo, parameters)


def test_unknown_keys_are_named(mondeo: Twin) -> None:
    with pytest.raises(InputError, match="vehicle.colour"):
        twin_value(mondeo, "vehicle.colour")
    with pytest.raises(InputError, match="effects.bump_stop.clearance"):
        twin_value(mondeo, "effects.bump_stop.clearance")


def test_a_flat_segment_has_the_slope_of_a_small_share_of_the_last_force(mondeo: Twin) -> None:
    """Whether the last point is found or frozen, and the one before it found or frozen."""
    every = list(curve_keys(mondeo, ("vehicle.front.damper_push",)))
    for left_out in (every[-1:], every[-2:-1], []):
        space = wide_space(mondeo, tuple(k for k in every if k not in left_out))
        values = space.from_slopes(space.z0)
        (curve,) = space.curves
        first, second = (row for row in curve.rows[:2])
        values[second] = values[first]
        last = values[curve.rows[-1]] if curve.rows[-1] >= 0 else curve.force[-1]
        flat = np.exp(space.to_slopes(values)[second]) * curve.x[-1] / last
        assert 0.0 < flat < 0.01
        values[values > values[first]] *= 1.5  # the last force that is found, and its share with it
        again = np.exp(space.to_slopes(values)[second])
        grown = 1.5 if curve.rows[-1] >= 0 else 1.0
        assert again == pytest.approx(grown * flat * last / curve.x[-1])


# -- every coordinate by its formula -------------------------------------------------------------------------------

MASS = Parameter("vehicle.mass", (1000.0, 3000.0), Prior(1725.0, 0.1, "log"))
SHIFT = Parameter("vehicle.cog.1", (-0.1, 0.3), Prior(0.02, 0.05))
SPRING = "vehicle.front.spring"


def of_spring(*rows: tuple[int, float, float, float], spread: float = 0.5) -> list[Parameter]:
    return [
        Parameter(f"{SPRING}.force.{i}", (low, high), Prior(value, spread, "log"))
        for i, value, low, high in rows
    ]


def test_keys_are_those_of_the_curves_that_a_vehicle_has(mondeo: Twin, repository: Path) -> None:
    corner = load_twin(repository / "config" / "twins" / "quarter_car.yaml")
    parts = ("spring", "damper_push", "damper_pull")
    assert curve_keys(corner) == tuple(f"vehicle.{part}.force.{i}" for part in parts for i in range(4))
    car = [f"vehicle.{axle}.spring" for axle in ("front", "rear")]
    car += [f"vehicle.{a}.damper_{d}" for a in ("front", "rear") for d in ("push", "pull")]
    assert curve_keys(mondeo) == tuple(f"{curve}.force.{i}" for curve in car for i in range(4))
    assert (
        curve_keys(mondeo, ["vehicle.spring", "vehicle.rear.damper_pull"])[0]
        == "vehicle.rear.damper_pull.force.0"
    )


def test_a_curve_says_what_it_is(mondeo: Twin) -> None:
    space = wide_space(mondeo)
    assert [(c.axle, c.part) for c in space.curves] == [
        (axle, part)
        for axle, part in (
            ("front", "spring"), ("rear", "spring"), ("front", "damper_push"), ("front", "damper_pull"),
            ("rear", "damper_push"), ("rear", "damper_pull"),
        )
    ]  # fmt: skip
    spring, damper = space.curves[0], space.curves[3]
    assert (spring.axle, spring.part, spring.unit) == ("front", "spring", "m")
    assert (damper.axle, damper.part, damper.unit) == ("front", "damper_pull", "m/s")
    alone = Curve("vehicle.damper_push", spring.x, spring.force, (0, 1, 2, 3))
    assert (alone.axle, alone.part, alone.unit) == ("", "damper_push", "m/s")
    assert spring.rows == (0, 1, 2, 3) and spring.x.tolist() == [0.1, 0.3, 0.5, 1.0]


def test_points_that_are_frozen_have_no_row_and_the_force_of_the_twin(mondeo: Twin) -> None:
    space = Space(mondeo, [MASS, *of_spring((2, 9000.0, 1000.0, 50e3), (0, 2000.0, 100.0, 5000.0))])
    (curve,) = space.curves
    assert curve.rows == (2, -1, 1, -1) and curve.force.tolist() == [2000.0, 6900.0, 9000.0, 23000.0]
    assert twin_value(mondeo, f"{SPRING}.force.0") == 2300.0  # the twin's own is as it was


def test_a_value_of_a_twin_by_its_key(mondeo: Twin) -> None:
    assert twin_value(mondeo, "vehicle.mass") == 1725.0 and twin_value(mondeo, "vehicle.cog.2") == 0.55
    assert twin_value(mondeo, f"{SPRING}.force.1") == 6900.0
    effects = (("payload", {"mass": 90.0}), ("strut_friction", {"rear_force": 30.0}))
    twin = mondeo.with_changes({"effects": [{"id": e, "parameters": values} for e, values in effects]})
    assert twin_value(twin, "effects.strut_friction.rear_force") == 30.0
    assert twin_value(twin, "effects.strut_friction.front_force") == 0.0  # neutral, for none is given
    assert twin_value(twin, "effects.payload.mass") == 90.0
    for key in (
        "effects.payload",
        "effects.payload.mass.0",
        "effects.payload.colour",
        "effects.bump_stop.clearance",
    ):
        with pytest.raises(InputError, match="no such effect parameter"):
            twin_value(twin, key)
    for key in ("vehicle.mass.0", f"{SPRING}.force.9", f"{SPRING}.force.first", "vehicle.spring"):
        with pytest.raises(InputError, match=f"{key}: no such key"):
            twin_value(twin, key)
    with pytest.raises(InputError, match="mass"):  # what was meant
        twin_value(twin, "vehicle.maß")


def test_nothing_is_free_twice(mondeo: Twin) -> None:
    with pytest.raises(InputError, match="vehicle.mass: is listed twice"):
        Space(mondeo, [SHIFT, MASS, MASS])


@pytest.mark.parametrize(
    ("lower", "upper", "log"),
    [(1.0, 1.0, True), (np.nan, 1.0, False), (1.0, np.inf, True), (-np.inf, 1.0, False), (0.0, 1.0, True)],
)
def test_bounds_are_finite_and_apart_and_those_of_a_logarithm_above_zero(
    mondeo: Twin, lower: float, upper: float, log: bool
) -> None:
    with pytest.raises(InputError, match="bounds: vehicle.mass"):
        Space(
            mondeo, [Parameter("vehicle.mass", (lower, upper), Prior(1.0, 0.5, "log" if log else "linear"))]
        )
    assert Space(mondeo, of_spring((0, 10.0, 0.0, 20.0))).lower.tolist() == [0.0]  # a force may be nothing


def test_bounds_of_a_curve_are_those_that_some_rising_curve_has(mondeo: Twin) -> None:
    """Lower ones from the points before, upper ones from those after, frozen ones included; the nominal within."""
    space = Space(
        mondeo, of_spring((0, 500.0, 1000.0, 9e3), (1, 8e3, 200.0, 7e3), (2, 6e3, 300.0, 90e3))
    )  # the last point is frozen at 23 kN
    assert space.lower.tolist() == [1000.0, 1000.0, 1000.0]
    assert space.upper.tolist() == [7000.0, 7000.0, 23000.0]
    assert space.nominal.tolist() == [1000.0, 7000.0, 6000.0]
    after = Space(mondeo, of_spring((2, 8e3, 100.0, 90e3)))
    assert (after.lower.tolist(), after.upper.tolist()) == ([6900.0], [23000.0])
    one = Space(mondeo, of_spring((0, 3e3, 2e3, 5e3), (1, 5e3, 1e3, 2e3)))  # a single value remains
    assert one.lower.tolist() == one.upper.tolist() == [2000.0, 2000.0]
    assert one.to_unit(one.nominal).tolist() == [0.0, 0.0]
    with pytest.raises(InputError, match=r"force\.0: leave no rising curve: from 7000 to 6900 N"):
        Space(mondeo, of_spring((0, 7e3, 7e3, 9e3)))


def test_unit_coordinates_are_shares_of_the_bounds_or_of_their_ratio(mondeo: Twin) -> None:
    space = Space(mondeo, [MASS, SHIFT, *of_spring((0, 2000.0, 1000.0, 3000.0))])
    for u in (0.0, 0.25, 1.0):
        wanted = [1000.0 * 3.0**u, -0.1 + 0.4 * u, 1000.0 + 2000.0 * u]
        np.testing.assert_allclose(space.from_unit(np.full(3, u)), wanted)
        np.testing.assert_allclose(space.to_unit(np.array(wanted)), [u] * 3, atol=1e-12)
    np.testing.assert_allclose(space.from_unit(np.array([-3.0, 7.0, 1.2])), [1000.0, 0.3, 3000.0])
    np.testing.assert_allclose(space.to_unit(np.array([1.0, 9.0, 0.0])), [0.0, 1.0, 0.0], atol=1e-12)
    many = np.random.default_rng(0).uniform(size=(3, 5))
    values = space.from_unit(many)
    np.testing.assert_allclose(space.to_unit(values), many)
    for k in range(5):
        np.testing.assert_array_equal(values[:, k], space.from_unit(many[:, k]))
    plain = Space(mondeo, [SHIFT])
    np.testing.assert_allclose(plain.to_unit(plain.from_unit(many[:1])), many[:1])


def test_a_curve_of_unit_coordinates_rises_by_its_running_maximum(mondeo: Twin) -> None:
    space = Space(mondeo, of_spring((0, 2e3, 1e3, 9e3), (1, 3e3, 1e3, 9e3), (2, 8e3, 1e3, 11e3)))
    u = np.array([[0.5, 0.0], [0.25, 0.75], [0.1, 1.0]])
    np.testing.assert_allclose(space.from_unit(u), [[5e3, 1e3], [5e3, 7e3], [5e3, 11e3]])


def test_slope_coordinates_are_logarithms_of_the_slopes_of_segments(mondeo: Twin) -> None:
    """From a frozen point on where there is one, clipped to the bounds on the way."""
    space = Space(mondeo, of_spring((0, 2300.0, 10.0, 6e3), (2, 11500.0, 7e3, 20e3), (3, 23e3, 7e3, 60e3)))
    np.testing.assert_allclose(space.z0, np.log([2300 / 0.1, (11500 - 6900) / 0.2, (23e3 - 11500) / 0.5]))
    z = np.log([[30e3, 90e3], [20e3, 1e6], [40e3, 1e3]])
    values = space.from_slopes(z)
    np.testing.assert_allclose(values[:, 0], [3000.0, 6900.0 + 4000.0, 10900.0 + 20e3])
    np.testing.assert_allclose(values[:, 1], [6000.0, 20e3, 20e3 + 500.0])
    np.testing.assert_allclose(space.to_slopes(values)[:, 0], z[:, 0])
    np.testing.assert_array_equal(space.from_slopes(z[:, 0]), values[:, 0])
    np.testing.assert_array_equal(space.to_slopes(values[:, 0]), space.to_slopes(values)[:, 0])
    assert np.isfinite(space.from_slopes(np.full(3, 1e6))).all()
    np.testing.assert_allclose(space.from_slopes(np.full(3, -1e6)), [10.0, 7e3, 7e3])


def test_other_parameters_are_clipped_to_their_bounds_and_scaled_from_the_nominal(mondeo: Twin) -> None:
    space = Space(mondeo, [MASS, SHIFT])
    z = np.array([[0.2, -9.0, 9.0], [-1.0, 9.0, -9.0]])
    wanted = [[1725.0 * np.exp(0.2), 1000.0, 3000.0], [0.02 - 0.05, 0.3, -0.1]]
    np.testing.assert_allclose(space.from_slopes(z), wanted)
    np.testing.assert_allclose(space.to_slopes(np.array(wanted)[:, 0]), z[:, 0])
    np.testing.assert_allclose(space.z0, [0.0, 0.0])
    assert space.names == space.simulated_keys == space.keys == ("vehicle.mass", "vehicle.cog.1")
    assert len(space) == 2 and space.simulated(mondeo) is mondeo
    np.testing.assert_array_equal(space.simulated_values(z), space.from_slopes(z))


def test_a_shift_moves_slopes_of_springs_and_of_dampers_and_nothing_else(mondeo: Twin) -> None:
    damper = Parameter("vehicle.rear.damper_pull.force.1", (500.0, 1200.0), Prior(900.0, 0.5, "log"))
    space = Space(mondeo, [MASS, damper, *of_spring((0, 2300.0, 10.0, 6e3))])
    z = np.arange(3.0)
    np.testing.assert_allclose(space.shifted(z, 0.3, -0.2), [0.0, 0.8, 2.3])
    assert z.tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_the_prior_of_slopes_falls_off_with_the_segments_between(mondeo: Twin, correlation: float) -> None:
    """Spreads are of logarithms; what moves by its spread has a coordinate of spread one."""
    spring = [replace(p, prior=replace(p.prior, spread=s)) for p, s in zip(
        of_spring((3, 23e3, 1.0, 60e3), (0, 2300.0, 1.0, 6e3), (1, 6900.0, 1.0, 9e3)), (0.2, 0.3, 0.4), strict=True
    )]  # fmt: skip
    space = Space(mondeo, [MASS, *spring, SHIFT])
    c = correlation
    wanted = np.diag([0.01, 0.04, 0.09, 0.16, 1.0])
    for (i, j), apart in {(1, 2): 3, (1, 3): 2, (2, 3): 1}.items():
        wanted[i, j] = wanted[j, i] = np.sqrt(wanted[i, i] * wanted[j, j]) * c**apart
    np.testing.assert_allclose(space.prior_covariance(c), wanted, atol=1e-15)
    np.testing.assert_allclose(space.prior_precision(c) @ wanted, np.eye(5), atol=1e-9)


def test_the_usual_prior_is_one_and_lets_neighbours_follow(mondeo: Twin) -> None:
    space = wide_space(mondeo)
    precision = space.prior_precision()
    assert np.linalg.eigvalsh(precision).min() > 0.0
    share = np.linalg.inv(precision)[0, 1] / space.prior_covariance(0.0)[0, 0]
    assert 0.5 < share < 1.0


def test_what_lies_on_a_bound(mondeo: Twin) -> None:
    space = Space(mondeo, [MASS, SHIFT, *of_spring((0, 2000.0, 1000.0, 3000.0))])
    u = np.array([[0.0, 0.0009, 0.0011, 0.5, 0.9989, 0.9991, 1.0]] * 3)
    on = [True, True, False, False, False, True, True]
    np.testing.assert_array_equal(space.on_bound(space.from_unit(u)), [on] * 3)
    wide = space.on_bound(space.from_unit(u), share=0.3)
    np.testing.assert_array_equal(wide, [[True, True, True, False, True, True, True]] * 3)
    eighths = Space(
        mondeo, [replace(SHIFT, bounds=(0.0, 8.0), prior=replace(SHIFT.prior, typical=0.0))]
    )  # of exactly that share
    found = [eighths.on_bound(np.array([v]), share=0.125).item() for v in (1.0, 1.01, 6.99, 7.0)]
    assert found == [True, False, False, True]


def test_values_are_put_into_a_checked_copy(mondeo: Twin) -> None:
    twin = mondeo.with_changes({"effects": [{"id": "payload", "parameters": {"mass": 90.0, "x": 0.4}}]})
    load = Parameter("effects.payload.mass", (10.0, 500.0), Prior(90.0, 0.5, "log"))
    space = Space(twin, [load, MASS, *of_spring((1, 6900.0, 10.0, 9e3))])
    changed = space.applied(twin, np.array([120.0, 1800.0, 7000.0]))
    assert (
        twin_value(changed, "effects.payload.mass") == 120.0
        and twin_value(changed, "effects.payload.x") == 0.4
    )
    assert changed.vehicle.mass == 1800.0 and twin_value(changed, f"{SPRING}.force.1") == 7000.0
    assert twin_value(changed, f"{SPRING}.force.0") == 2300.0 and twin.vehicle.mass == 1725.0
    assert Space(mondeo, [MASS]).applied(mondeo, np.array([1800.0])).effects == ()
    with pytest.raises(InputError, match="force"):
        space.applied(twin, np.array([120.0, 1800.0, 70_000.0]))  # falls again behind


def test_bounds_are_given_for_a_key_or_for_its_whole_curve() -> None:
    bounds = {SPRING: (1.0, 2.0), f"{SPRING}.force.2": (3.0, 4.0), "vehicle.mass": (5.0, 6.0)}
    assert bounds_of(bounds, f"{SPRING}.force.2") == (3.0, 4.0)
    assert bounds_of(bounds, f"{SPRING}.force.11") == (1.0, 2.0)
    assert bounds_of(bounds, "vehicle.mass") == (5.0, 6.0)
    assert bounds_of(bounds, "vehicle.rear.spring.force.0") is bounds_of(bounds, "vehicle.cog.1") is None


def test_what_a_file_states_of_its_values_is_information_on_them(mondeo: Twin) -> None:
    """Of a number its own; a characteristic's points have one error in common: all stiffer by a tenth is as far off as
    one of them that is."""
    force = np.array(mondeo.vehicle.rear.spring.force)
    stated = {"vehicle.mass": 12.0, "vehicle.rear.spring.force": tuple((0.1 * force).tolist())}
    twin = mondeo.with_changes({"uncertainty": stated})
    keys = ("vehicle.mass", "vehicle.wheelbase", *curve_keys(twin, ["vehicle.rear.spring"]))
    space = wide_space(twin, keys)
    information = space.stated_precision(twin, 2.0)
    assert information[0, 0] == pytest.approx((twin.vehicle.mass / (2.0 * 12.0)) ** 2)
    assert not information[1].any() and not information[0, 1:].any()
    stiffer = np.zeros(len(space))
    stiffer[2:] = 0.1
    assert stiffer @ information @ stiffer == pytest.approx((1.0 / 2.0) ** 2, rel=1e-6)
    assert not wide_space(mondeo, keys).stated_precision(mondeo, 2.0).any()
    for sigma in (
        1e-9,
        1e-250,
    ):  # a slip of the pen: held to a thousandth, as a prior that can be computed with
        surest = mondeo.with_changes({"uncertainty": {"vehicle.mass": sigma}})
        assert space.stated_precision(surest, 2.0)[0, 0] == pytest.approx(1e6)
