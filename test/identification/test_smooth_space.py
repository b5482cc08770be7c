# SPDX-License-Identifier: Apache-2.0
"""Curves of many points: as many unknowns as a curve of four, the same prior, and nearly the same forces simulated."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from suspension_twin.calibration.presets import build_space, preset_named
from suspension_twin.identification.smooth_space import FEW_POINTS, SmoothSpace, smooth_space
from suspension_twin.identification.space import CURVES, Space, curve_keys, twin_value
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
