# SPDX-License-Identifier: Apache-2.0
"""Search spaces: both coordinate systems keep curves rising and invert each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from suspension_twin.errors import InputError
from suspension_twin.identification.space import Parameter, Space, curve_keys, twin_value
from suspension_twin.vehicle.twin import Twin


def wide_space(twin: Twin, keys: tuple[str, ...] | None = None, factor: float = 20.0) -> Space:
    keys = curve_keys(twin) if keys is None else keys
    values = [float(twin_value(twin, k)) for k in keys]
    return Space(twin, [Parameter(k, v, v / factor, v * factor) for k, v in zip(keys, values, strict=True)])


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
    mass = Parameter("vehicle.mass", 1725.0, 1000.0, 3000.0, spread=0.1)
    shift = Parameter("vehicle.cog.1", 0.0, -0.2, 0.2, log=False, spread=0.05)
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
        ([], "nothing is free"),
        ([Parameter("vehicle.mass", 1.0, 2.0, 1.0)], "vehicle.mass"),
        ([Parameter("vehicle.mass", 1.0, -2.0, 1.0)], "above 0"),
        ([Parameter("vehicle.front.spring.force.9", 1.0, 0.5, 2.0)], "has 4 points"),
        (
            [
                Parameter("vehicle.front.spring.force.0", 2300.0, 2000.0, 3000.0),
                Parameter("vehicle.front.spring.force.1", 1000.0, 500.0, 1500.0),
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
