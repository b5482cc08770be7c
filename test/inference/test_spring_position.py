# SPDX-License-Identifier: Apache-2.0
"""Slides of a spring along its compression: same response, same load, unexcited segments by the prior."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.inference.spring_position import Slide, slides, standing_at

X = np.array([0.1, 0.2, 0.3, 0.5, 0.8])
PRIOR = np.log(np.array([18e3, 22e3, 25e3, 30e3, 40e3]))
Z = PRIOR + np.array([0.1, -0.2, 0.15, 0.05, -0.1])


def force(z: np.ndarray, at: np.ndarray | float) -> np.ndarray:
    """Of a curve of segments that end at ``X``, through (0, 0), the last one going on."""
    slope, at = np.exp(z), np.atleast_1d(np.asarray(at, dtype=float))
    out = np.zeros(at.shape)
    for low, high, k in zip([0.0, *X[:-1]], [*X[:-1], np.inf], slope, strict=True):
        out += k * np.clip(at - low, 0.0, high - low)
    return out


def segment(at: float) -> int:
    """The one that ends at ``at`` or after it."""
    return min(int((at - 1e-12 > X).sum()), X.size - 1)


def by_shift(found: list[Slide]) -> dict[float, Slide]:
    return {round(s.shift, 6): s for s in found}


def test_curves_are_slid_by_four_millimetres_at_a_time_up_to_sixteen_centimetres_either_way() -> None:
    """But not by nothing, and not so far that what was seen would be above a spring at its full length."""
    found = by_shift(slides(X, Z, PRIOR, 0.8, 0.35, np.linspace(0.32, 0.38, 30)))
    every = {round(0.004 * k, 6) for k in range(-40, 41) if k}
    assert set(found) == every
    near = by_shift(slides(X, Z, PRIOR, 0.8, 0.16, np.linspace(0.13, 0.19, 30)))
    assert max(near) == 0.16 and all(0.13 + shift > 0.0 for shift in near)
    assert {shift for shift in every if shift > -0.03 + 1e-9} <= set(near)


@pytest.mark.parametrize("correlation", [0.8, 0.5, 0.0])
def test_a_slide_within_one_segment_takes_its_slope_along_and_makes_up_the_load_below(
    correlation: float,
) -> None:
    """Below it by slopes in the proportion of the prior's, above it by the prior of neighbouring slopes."""
    static, seen = 0.35, np.linspace(0.32, 0.38, 30)
    found = by_shift(slides(X, Z, PRIOR, correlation, static, seen))
    load = force(Z, static)[0]
    for shift, slide in found.items():
        places = {segment(float(v)) for v in seen + shift}
        if len(places) > 1:
            continue
        (j,) = places
        assert slide.z[j] == pytest.approx(Z[3])
        np.testing.assert_allclose(force(slide.z, seen + shift), force(Z, seen), rtol=1e-9)
        for i in range(j + 1, X.size):
            wanted = PRIOR[i] + correlation ** (i - j) * (Z[3] - PRIOR[j])
            assert slide.z[i] == pytest.approx(wanted)
        np.testing.assert_allclose(np.diff(slide.z[:j] - PRIOR[:j]), 0.0, atol=1e-9)
        below = force(slide.z, X[j - 1])[0]
        assert below == pytest.approx(load - np.exp(Z[3]) * (static + shift - X[j - 1]))
        assert slide.density == pytest.approx(np.exp(Z[3]) / below)


def test_a_segment_into_which_several_were_slid_has_their_mean_slope() -> None:
    """What was seen of each counts by its samples; an unexcited one in between follows the nearest below."""
    seen = np.array([0.15, 0.17, 0.19, 0.25, 0.34])  # in segments 1, 1, 1, 2, 3
    found = by_shift(slides(X, Z, PRIOR, 0.8, 0.22, seen))
    slope = np.exp(Z)
    slide = found[0.16]  # to 0.31, 0.33, 0.35, 0.41, 0.50: all in segment 3
    assert np.exp(slide.z[3]) == pytest.approx((3 * slope[1] + slope[2] + slope[3]) / 5)
    assert slide.z[4] == pytest.approx(PRIOR[4] + 0.8 * (slide.z[3] - PRIOR[3]))
    split = found[0.06]  # to 0.21, 0.23, 0.25, 0.31, 0.40
    assert split.z[2] == pytest.approx(Z[1])
    assert np.exp(split.z[3]) == pytest.approx((slope[2] + slope[3]) / 2)
    gap = by_shift(slides(X, Z, PRIOR, 0.8, 0.2, np.array([0.18, 0.195, 0.6])))[0.02]  # to 0.2, 0.215, 0.62
    assert (
        gap.z[1] == pytest.approx(Z[1])
        and gap.z[2] == pytest.approx(Z[1])
        and gap.z[4] == pytest.approx(Z[4])
    )
    assert gap.z[3] == pytest.approx(PRIOR[3] + 0.8 * (Z[1] - PRIOR[2]))  # of two as near, the lower


@settings(max_examples=12)
@given(
    st.lists(st.floats(-0.4, 0.4), min_size=5, max_size=5),
    st.floats(0.12, 0.4),
    st.floats(0.01, 0.1),
    st.floats(0.0, 0.95),
)
def test_every_slide_bears_the_load_where_it_stands(
    off: list[float], static: float, half: float, correlation: float
) -> None:
    z = PRIOR + np.array(off)
    seen = static + np.linspace(-half, half, 25)
    load = force(z, static)[0]
    for slide in slides(X, z, PRIOR, correlation, static, seen):
        lowest = segment(float(seen[0] + slide.shift))
        off_load = abs(float(force(slide.z, static + slide.shift)[0]) - load)
        assert slide.density > 0.0 and np.isfinite(slide.z).all()
        if lowest > 0:
            assert off_load < 1e-9 * load
            assert slide.density == pytest.approx(
                np.exp(z[segment(static)]) / float(force(slide.z, X[lowest - 1])[0])
            )
        else:
            assert slide.density == pytest.approx(1.0 / max(static + slide.shift, 0.004))


@pytest.mark.parametrize(
    ("static", "passing"), [(0.3, {-0.004}), (0.42, {-0.004, 0.004}), (0.6, {-0.004, 0.004})]
)
def test_a_straight_curve_whose_lowest_segment_is_seen_stays_where_it_passes_the_origin(
    static: float, passing: set[float]
) -> None:
    """To a hundredth of its load, or between two slides, of which it is then the first."""
    line = np.full(5, np.log(20e3))
    found = by_shift(slides(X, line, PRIOR, 0.8, static, np.linspace(0.02, 0.58, 200)))
    within = {shift: slide for shift, slide in found.items() if 0.02 + shift < 0.1 + 1e-9}
    assert set(within) == passing
    for shift, slide in within.items():
        np.testing.assert_allclose(slide.z, line)
        assert slide.density == pytest.approx(1.0 / (static + shift))


def test_a_curve_that_cannot_bear_its_load_is_left_out() -> None:
    """Slid far up with a stiff excited piece, nothing remains for what is below, or less than nothing."""
    stiff = np.log(np.array([5e3, 5e3, 60e3, 60e3, 60e3]))
    static, seen = 0.24, np.linspace(0.205, 0.275, 30)
    found = by_shift(slides(X, stiff, PRIOR, 0.8, static, seen))
    load = force(stiff, static)[0]
    for k in range(1, 41):
        shift = round(0.004 * k, 6)
        edge = X[segment(seen[0] + shift) - 1]
        remains = load - 60e3 * (static + shift - edge)
        assert (shift in found) == (remains > 0.0), shift


@pytest.mark.parametrize("corner", [0, 1, 2, 3])
@pytest.mark.parametrize("static", [0.06, 0.1, 0.17, 0.35, 0.9])
def test_standing_at_a_corner(corner: int, static: float) -> None:
    """The same load there, slopes below in their proportion, and beyond it the local slope and their proportion."""
    z = standing_at(X, Z, static, corner)
    assert force(z, X[corner])[0] == pytest.approx(force(Z, static)[0])
    np.testing.assert_allclose(np.diff(z[: corner + 1]), np.diff(Z[: corner + 1]), atol=1e-12)
    assert z[corner + 1] == pytest.approx(Z[segment(static)])
    np.testing.assert_allclose(np.diff(z[corner + 1 :]), np.diff(Z[corner + 1 :]), atol=1e-12)
