# SPDX-License-Identifier: Apache-2.0
"""Heights and places of a road in memory, against closed forms and a plain NumPy interpolation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.interpolate import RegularGridInterpolator

from suspension_twin.errors import InputError
from suspension_twin.road import Border, Borders, Fade, Road, curved_road, flat_road, grid_road, kernels

RNG = np.random.default_rng(1)


def test_inside_it_is_bilinear(wavy: Road) -> None:
    u, v = RNG.uniform(0, 20, 5000), RNG.uniform(-1.5, 1.5, 5000)
    plain = RegularGridInterpolator((wavy.u, wavy.v), wavy.z)
    np.testing.assert_allclose(wavy.heights_uv(u, v), plain(np.column_stack([u, v])), rtol=0, atol=1e-14)
    cos, sin = np.cos(0.6), np.sin(0.6)
    x, y = 100 + u * cos - v * sin, -40 + u * sin + v * cos
    np.testing.assert_allclose(wavy.heights(x, y), wavy.heights_uv(u, v), rtol=0, atol=1e-13)
    assert wavy.inside(x, y).all()


def test_slope_and_banking_add_to_the_grid(wavy: Road) -> None:
    sloped = wavy.with_line(z=0.1 * wavy.u + 3, bank=np.full(wavy.u.size, 0.05))
    u, v = RNG.uniform(0, 20, 500), RNG.uniform(-1.5, 1.5, 500)
    expected = wavy.heights_uv(u, v) + 3 + 0.1 * u + 0.05 * v
    np.testing.assert_allclose(sloped.heights_uv(u, v), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("radius", [-40.0, 25.0])
def test_a_bend_is_the_circle_that_it_stands_for(radius: float) -> None:
    v = np.linspace(-3, 3, 7)
    road = curved_road(grid_road(np.zeros((1001, 7)), 0.02, v), 1 / radius)
    u, w = RNG.uniform(0.1, 19.9, 400), RNG.uniform(-3, 3, 400)
    x, y = road.uv_to_xy(u, w)
    # The line is the polygon on that circle, its points 0.02 m apart: exact to h²/24R and less.
    turn = u / radius
    np.testing.assert_allclose(x, (radius - w) * np.sin(turn), rtol=0, atol=2e-5)
    np.testing.assert_allclose(y, radius - (radius - w) * np.cos(turn), rtol=0, atol=2e-5)
    np.testing.assert_allclose(road.xy_to_uv(x, y), (u, w), rtol=0, atol=1e-10)


@settings(max_examples=50, deadline=None)
@given(order=st.permutations(range(40)), copies=st.integers(1, 3))
def test_an_answer_does_not_depend_on_the_queries_before(order: list[int], copies: int) -> None:
    road = curved_road(grid_road(np.zeros((900, 4)), 0.1, np.arange(4.0)), 0.05 * np.sin(np.arange(899) / 60))
    rng = np.random.default_rng(8)
    x, y = rng.uniform(-30, 110, 40), rng.uniform(-60, 60, 40)
    u, v = road.xy_to_uv(x, y)
    chosen = np.tile(order, copies)
    again = road.xy_to_uv(x[chosen], y[chosen])
    np.testing.assert_array_equal(again, (u[chosen], v[chosen]))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    step=st.floats(0.02, 1.0),
    bend=st.floats(0.0, 1.5),
    waves=st.floats(0.2, 20.0),
)
def test_following_a_drive_finds_what_a_search_of_the_whole_line_finds(
    seed: int, step: float, bend: float, waves: float
) -> None:
    """On loops, hairpins and lines that cross themselves, for drives along, across and beside them."""
    rng = np.random.default_rng(seed)
    count = 400
    k = bend / max(0.3, 2 * step) * np.sin(waves * np.linspace(0, 6, count - 1) + rng.uniform(0, 6))
    # Narrow, so that bends may be sharp: what matters is the line.
    road = curved_road(grid_road(np.zeros((count, 3)), step, np.array([-0.1, 0.0, 0.1])), np.clip(k, -9, 9))
    u = np.linspace(-3, road.length + 3, 500)
    x, y = road.uv_to_xy(u, rng.uniform(0.1, 4) * np.sin(rng.uniform(0.05, 2) * u))
    x, y = x + rng.normal(0, 0.02, 500), y + rng.normal(0, 0.02, 500)
    followed = np.array(road.xy_to_uv(x, y))
    alone = np.array([road.xy_to_uv(a, b) for a, b in zip(x, y, strict=True)]).T
    np.testing.assert_allclose(followed, alone, rtol=0, atol=1e-9)


def test_the_nearest_part_of_the_line_is_found() -> None:
    road = curved_road(
        grid_road(np.zeros((3000, 3)), 0.1, [-1.0, 0.0, 1.0]), 0.2 * np.sin(np.arange(2999) / 40)
    )
    x, y = RNG.uniform(-20, 320, 300), RNG.uniform(-30, 30, 300)
    u, _ = road.xy_to_uv(x, y)
    nearest = np.hypot(x[:, None] - road.x, y[:, None] - road.y).argmin(axis=1)
    # From the nearest point the foot lies in one of its two segments, or beyond the road's ends.
    inner = (nearest > 0) & (nearest < road.u.size - 1)
    assert (np.abs(u - road.u[nearest])[inner] <= 0.1 + 1e-9).all()


def test_beyond_the_border_each_policy_does_what_it_says(wavy: Road) -> None:
    u, v = np.array([-5.0, 25.0, 10.0, 10.0]), np.array([0.0, 0.4, 5.0, -5.0])
    held = wavy.heights_uv(np.clip(u, 0, 20), np.clip(v, -1.5, 1.5))
    np.testing.assert_array_equal(wavy.heights_uv(u, v), held)
    np.testing.assert_array_equal(wavy.heights_uv(u, v, "hold"), held)
    np.testing.assert_array_equal(wavy.heights_uv(u, v, "zero"), np.zeros(4))
    samples = wavy.sample_uv(np.append(u, 3.0), np.append(v, 0.0), "hold")
    assert samples.inside.tolist() == [False] * 4 + [True]
    with pytest.raises(
        InputError, match=r"wavy: 4 of 4 positions are off the road, the first at u -5.00 m, v 0.00 m"
    ):
        wavy.heights_uv(u, v, "error")
    x, y = wavy.uv_to_xy(10.0, 5.0)
    with pytest.raises(
        InputError, match=r"1 of 1 positions is off the road, the first at u 10.00 m, v 5.00 m"
    ):
        wavy.heights(x, y, "error")
    with pytest.raises(InputError, match="outside: must be road, hold, zero or error"):
        wavy.heights_uv(u, v, "nothing")  # type: ignore[arg-type]


def test_a_files_own_borders_yield_to_a_policy(wavy: Road) -> None:
    road = replace(wavy, borders=Borders(u=Border(3), v=Border(offset=1.0)))
    assert road.heights_uv(23.0, 0.0) == road.heights_uv(3.0, 0.0)
    assert road.heights_uv(23.0, 0.0, "hold") == wavy.heights_uv(20.0, 0.0)
    assert road.heights_uv(3.0, 9.0) == wavy.heights_uv(3.0, 1.5) + 1.0
    assert road.heights_uv(3.0, 9.0, "hold") == wavy.heights_uv(3.0, 1.5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_position_that_is_none_is_refused(wavy: Road, bad: float) -> None:
    curved = curved_road(wavy, 0.05)
    for road in (wavy, curved):
        with pytest.raises(InputError, match="1 of 3 positions is not finite"):
            road.heights([101.0, bad, 103.0], [-40.0, -40.0, -40.0])
        u, v = road.xy_to_uv([101.0, bad], [-40.0, -40.0])
        assert np.isfinite([u[0], v[0]]).all()
        assert not np.isfinite([u[1], v[1]]).all()
        with pytest.raises(InputError, match="not finite"):
            road.heights_uv(0.0, bad)


def test_far_away_is_far_away_but_finite(wavy: Road) -> None:
    for road in (wavy, curved_road(wavy, 0.05)):
        for far in (1e6, 1e12, -1e15):
            assert np.isfinite(road.heights(far, -far))
            assert not road.inside(far, far)


def test_shapes_follow_the_arguments(wavy: Road) -> None:
    assert wavy.heights(101.0, -39.5).shape == ()
    assert wavy.heights(np.full((2, 1, 4), 101.0), np.full((3, 1), -39.5)).shape == (2, 3, 4)
    assert wavy.heights([], []).shape == (0,)
    assert wavy.heights(np.arange(100, 110)[::2], -39).dtype == np.float64
    strided = np.asfortranarray(RNG.uniform(100, 110, (30, 4)))
    np.testing.assert_array_equal(
        wavy.heights(strided[::2], -38.0), wavy.heights(np.ascontiguousarray(strided[::2]), -38.0)
    )


def test_nothing_is_compiled_a_second_time_for_another_kind_of_argument() -> None:
    """Each kernel has one signature, whatever the road and however the positions come."""
    plain = grid_road(np.zeros((50, 4)), 0.1, np.arange(4.0))
    holes = np.array(plain.z)
    holes[3, 0] = np.nan
    roads = [
        plain,
        curved_road(plain, 0.05),
        replace(plain, z=holes),
        replace(plain, borders=Borders(Border(np.int64(3)), Border(offset=1), begin=Fade(1))),  # type: ignore[arg-type]
        flat_road(np.float32(10), 10),  # type: ignore[arg-type]
    ]
    frozen = np.linspace(0, 5, 6)
    frozen.flags.writeable = False
    kinds = [
        1,
        [1, 2],
        np.float32([1, 2]),
        np.arange(9)[::2],
        frozen,
        frozen[::2],
        np.ones((2, 3), order="F"),
    ]
    of_roads = (kernels.heights_uv, kernels.xy_to_uv, kernels.uv_to_xy)
    plain.heights(0.5, 0.5)
    plain.uv_to_xy(0.5, 0.5)
    before = [set(kernel.signatures) for kernel in of_roads]  # with those of other tests in this process
    for road in roads:
        for kind in kinds:
            for other in (kind, 0.5):
                road.heights(kind, other)
                road.uv_to_xy(kind, other)
    assert [set(kernel.signatures) for kernel in of_roads] == before


def test_missing_heights_are_held_from_beside_them() -> None:
    z = np.array([[np.nan, 1.0, 2.0, np.nan], [np.nan] * 4, [1.0, np.nan, 3.0, 3.0], [4.0] * 4])
    road = grid_road(z, 1.0, [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(road.heights_uv(0.0, [0, 1, 2, 3]), [1, 1, 2, 2])
    np.testing.assert_allclose(road.heights_uv(2.0, [0, 1, 2, 3]), [1, 2, 3, 3])
    np.testing.assert_allclose(road.heights_uv(1.0, [0, 1, 2, 3]), [1, 1.5, 2.5, 2.5])
    samples = road.sample_uv(np.full(3, 2.5), [0.5, 1.5, 2.5])
    assert samples.inside.tolist() == [False, False, True]


def test_scaling_and_placing(wavy: Road) -> None:
    u, v = RNG.uniform(-2, 22, 300), RNG.uniform(-2, 2, 300)
    road = replace(wavy, borders=Borders(u=Border(offset=0.2))).with_line(bank=np.full(wavy.u.size, 0.03))
    np.testing.assert_allclose(road.scaled(-2.5).heights_uv(u, v), -2.5 * road.heights_uv(u, v), atol=1e-14)
    moved = curved_road(road, 0.03).placed(7.0, 8.0, -1.0, z=2.0)
    assert (moved.x[0], moved.y[0], moved.ref_z[0]) == (7.0, 8.0, 2.0)
    np.testing.assert_allclose(moved.heights_uv(u, v), road.heights_uv(u, v) + 2.0, atol=1e-14)
    x, y = moved.uv_to_xy(0.1, 0.0)
    assert np.arctan2(y - 8.0, x - 7.0) == pytest.approx(-1.0, abs=1e-9)
    straight = road.placed(1.0, 2.0, 0.3)
    assert straight.straight
    np.testing.assert_allclose(straight.heights(*straight.uv_to_xy(u, v)), road.heights_uv(u, v), atol=1e-12)


def test_the_flat_road_is_flat_everywhere() -> None:
    road = flat_road()
    x, y = RNG.uniform(-9e3, 9e3, (2, 100))
    assert (road.heights(x, y, "error") == 0).all()


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"x": np.zeros(7)}, "x: needs 201 values"),
        ({"x": np.zeros(201), "y": np.zeros(201)}, "stands still"),
        ({"z": np.full(201, np.nan)}, "ref_z: must be finite"),
        ({"bank": np.full(201, np.inf)}, "bank: must be finite"),
        ({"step": 0.0}, "u_step: must be above 0"),
        ({"step": np.nan}, "u_step: must be above 0"),
    ],
)
def test_arrays_that_make_no_reference_line(wavy: Road, change: dict[str, Any], fault: str) -> None:
    with pytest.raises(InputError, match=f"wavy: .*{fault}|wavy: {fault}"):
        wavy.with_line(**change)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"z": np.zeros((1, 6))}, "at least 2 by 2"),
        ({"z": np.full((201, 6), np.nan)}, "no height at all"),
        ({"z": np.full((201, 6), np.inf)}, "infinite"),
        ({"v": np.zeros(6)}, "v: must rise"),
        ({"v": np.zeros(5)}, "v: needs 6 values"),
    ],
)
def test_arrays_that_make_no_road(wavy: Road, change: dict[str, Any], fault: str) -> None:
    with pytest.raises(InputError, match=f"wavy: .*{fault}|wavy: {fault}"):
        replace(wavy, **change)
