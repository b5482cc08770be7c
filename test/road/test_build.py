# SPDX-License-Identifier: Apache-2.0
"""Bumps and bends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.road import (
    add_bump,
    bump_road,
    circular,
    curved_road,
    flat_road,
    grid_road,
    half_sine,
    load_road,
    trapezoid,
    write_road,
)

S = np.linspace(-1, 4, 2001)


def test_shapes_are_the_named_ones() -> None:
    on = (S >= 0) & (S <= 3)
    np.testing.assert_allclose(half_sine(3, 0.1)(S), np.where(on, 0.1 * np.sin(np.pi * S / 3), 0), atol=1e-15)

    t = trapezoid(3, 0.12, top=1.0)(S)
    assert t[(S >= 1) & (S <= 2)] == pytest.approx(0.12)
    ramp = (S > 0.01) & (S < 0.99)
    assert np.gradient(t, S)[ramp] == pytest.approx(0.12)
    assert (t[~on] == 0).all()

    c = circular(3, 0.1)
    radius = (1.5**2 + 0.1**2) / 0.2
    z = c(S[on])
    np.testing.assert_allclose((S[on] - 1.5) ** 2 + (z + radius - 0.1) ** 2, radius**2, rtol=1e-12)
    assert c(1.5) == pytest.approx(0.1)
    assert c([-0.1, 0.0, 3.0, 3.1]) == pytest.approx([0, 0, 0, 0], abs=1e-12)
    assert circular(0.2, 0.1)(0.1) == pytest.approx(0.1)  # a half round
    assert circular(3, -0.1)(1.5) == pytest.approx(-0.1)


def test_a_bump_lies_where_it_is_put(tmp_path: Path) -> None:
    road = bump_road(half_sine(3, 0.1), [10, 30.0], length=50, x=5, y=6, heading=0.4)
    u = np.linspace(0, 50, 5001)
    expected = half_sine(3, 0.1)(u - 10) + half_sine(3, 0.1)(u - 30)
    for v in (-2.9, 0.0, 1.3):
        np.testing.assert_allclose(road.heights_uv(u, v), expected, atol=1e-6)
    write_road(road, tmp_path / "bump.crg")
    back = load_road(tmp_path / "bump.crg")
    x, y = road.uv_to_xy(u, 0.7)
    np.testing.assert_array_equal(back.heights(x, y), road.heights(x, y))


def test_a_bump_in_one_track_and_askew() -> None:
    flat = grid_road(np.zeros((2001, 41)), 0.01, np.linspace(-2, 2, 41))
    one = add_bump(flat, trapezoid(1, 0.05, 0.4), 5.0, v_low=0.0)
    assert one.heights_uv(5.5, [-1.0, -0.15, 0.0, 0.5, 2.0]) == pytest.approx([0, 0, 0.05, 0.05, 0.05])
    askew = add_bump(flat, half_sine(2, 0.1), 5.0, angle=np.arctan(0.5))
    for v in (-1.0, 0.0, 1.6):
        assert askew.heights_uv(6.0 + 0.5 * v, v) == pytest.approx(0.1, abs=1e-6)
    twice = add_bump(one, half_sine(2, -0.1), 5.0)
    assert twice.heights_uv(6.0, -1.0) == pytest.approx(-0.1)


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: half_sine(0, 0.1), "length"),
        (lambda: half_sine(1, float("nan")), "height"),
        (lambda: trapezoid(1, 0.1, 1.0), "top"),
        (lambda: circular(1, 0.6), "at most 0.5"),
        (lambda: bump_road(half_sine(3, 0.1), 58.0), "off the road"),
        (lambda: bump_road(half_sine(0.1, 0.1), step=0.05), "too coarse"),
        (lambda: bump_road(half_sine(1, 0.1), width=0.0), "width"),
        (lambda: add_bump(flat_road(10), half_sine(3, 0.1), 1.0), "too coarse"),
        (lambda: curved_road(flat_road(10), 0.3), "centre of a bend"),
        (lambda: flat_road(-1.0), "length"),
    ],
)
def test_what_makes_no_road_is_refused(make: object, fault: str) -> None:
    with pytest.raises(InputError, match=fault):
        make()  # type: ignore[operator]


def test_a_bend_turns_by_its_curvature_over_its_length() -> None:
    rng = np.random.default_rng(2)
    straight = grid_road(rng.normal(0.3, 0.01, (601, 9)), 0.05, np.linspace(-2, 2, 9), heading=1.0)
    bend = curved_road(straight, 0.02, name="bend")
    assert bend.name == "bend"
    np.testing.assert_allclose(np.hypot(np.diff(bend.x), np.diff(bend.y)), 0.05, rtol=1e-9)
    assert bend.headings[1] - bend.headings[0] == pytest.approx(0.02 * 0.05 * 599)
    u = np.arange(0.5, 29.5, 0.013)
    np.testing.assert_allclose(bend.heights_uv(u, 0.3), straight.heights_uv(u, 0.3), atol=1e-12)
