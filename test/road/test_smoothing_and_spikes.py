# SPDX-License-Identifier: Apache-2.0
"""Gaussian smoothing against its closed form; spikes found where they were put, and only there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from suspension_twin.errors import InputError
from suspension_twin.road import bump_road, circular, grid_road, load_road
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.road.smoothing import find_spikes, remove_spikes, smooth

V = np.linspace(-3, 3, 61)
U = 0.05 * np.arange(801)


@pytest.mark.parametrize("wavelength", [1.0, 2.5, 8.0])
def test_a_wave_keeps_the_share_that_theory_gives(wavelength: float) -> None:
    road = grid_road(0.1 * np.sin(2 * np.pi * U / wavelength)[:, None] * np.ones(61), 0.05, V)
    inner = slice(120, -120)
    share = np.exp(-2 * (np.pi * 0.3 / wavelength) ** 2)
    np.testing.assert_allclose(smooth(road, 0.3, 0.0).z[inner], share * road.z[inner], atol=1e-6)
    across = grid_road(0.1 * np.sin(2 * np.pi * V / wavelength) * np.ones((801, 1)), 0.05, V)
    inner = slice(16, -16)
    np.testing.assert_allclose(smooth(across, 0.0, 0.3).z[:, inner], share * across.z[:, inner], atol=1e-6)


def test_inside_it_is_scipys_gaussian() -> None:
    road = iso8608_road("C", 40, seed=1)
    ours = smooth(road, 0.2, 0.25).z
    scipys = gaussian_filter(road.z, (0.2 / 0.05, 0.25 / 0.1), truncate=5)
    np.testing.assert_allclose(ours[25:-25, 15:-15], scipys[25:-25, 15:-15], atol=2e-8)


def test_slopes_pass_unchanged_to_the_ends_around_holes_and_on_uneven_grids() -> None:
    v = np.sort(np.random.default_rng(0).uniform(-3, 3, 20))
    plane = 0.1 * U[:, None] + 0.05 * v + 2
    holes = np.array(plane)
    holes[:60, :5], holes[300], holes[500:520, 12:] = np.nan, np.nan, np.nan
    road = grid_road(holes, 0.05, v)
    road = road.with_line(z=0.2 * U, bank=0.001 * U)
    for along, across in ((0.5, None), (0.1, 2.0), (3.0, 0.0), (0.0, 0.7)):
        smoothed = smooth(road, along, across)
        np.testing.assert_allclose(smoothed.z, road.z, atol=1e-6)
        np.testing.assert_array_equal(np.isnan(smoothed.z), np.isnan(holes))
        np.testing.assert_allclose(smoothed.ref_z, road.ref_z, atol=1e-9)
        np.testing.assert_allclose(smoothed.bank, road.bank, atol=1e-9)


def test_nothing_is_smoothed_away_by_a_sigma_of_zero() -> None:
    road = iso8608_road("C", 20)
    np.testing.assert_array_equal(smooth(road, 0.0).z, road.z)
    with pytest.raises(InputError, match="sigma along"):
        smooth(road, -0.1)
    with pytest.raises(InputError, match="sigma across"):
        smooth(road, 0.1, float("nan"))


def test_a_window_longer_than_the_road_leaves_its_line() -> None:
    road = bump_road(circular(3, 0.1), 5, length=10)
    flat = smooth(road, 100.0).z
    line = np.polyval(np.polyfit(road.u, road.z[:, 0], 1), road.u)
    np.testing.assert_allclose(flat, line[:, None] * np.ones(road.v.size), atol=1e-3)


def test_the_1in_course_has_its_spike_of_79_mm(shared_data: Path) -> None:
    road = load_road(shared_data / "projectchrono/crg_roads/detrended_rms_course_1in.crg")
    worst = find_spikes(road).found[0]
    assert worst.u == pytest.approx(392, abs=0.1)
    assert worst.step == pytest.approx(0.079, abs=0.001)
    assert (worst.v_low, worst.v_high) == (-3, 3)
    # It is there until someone asks for it to go.
    assert np.abs(np.diff(road.z, axis=0)).max() == pytest.approx(0.0786, abs=1e-4)
    cleaned = remove_spikes(road)
    here = (cleaned.u > 391.8) & (cleaned.u < 392.1)
    assert np.abs(np.diff(cleaned.z[here], axis=0)).max() < 0.045
    changed = (cleaned.z != road.z).any(axis=1).sum()
    assert 0 < changed < 60


@pytest.mark.parametrize(
    "name", ["belgian_block.crg", "halfround_2in.crg", "halfround_12in.crg", "Horstwalde.crg"]
)
def test_stones_kerbs_and_twists_are_no_spikes(shared_data: Path, name: str) -> None:
    assert len(find_spikes(load_road(next(shared_data.rglob(name))))) == 0


@pytest.mark.parametrize("road_class", "ACF")
def test_random_roads_have_none_and_those_put_on_them_are_found(road_class: str) -> None:
    road = iso8608_road(road_class, 60, seed=3)
    assert len(find_spikes(road)) == 0
    size = {"A": 0.03, "C": 0.08, "F": 0.9}[road_class]
    z = np.array(road.z)
    places = [(200, 30, size), (700, 5, -size), (1000, 55, 2 * size)]
    for i, j, height in places:
        z[i, j] += height
    spiky = replace(road, z=z)
    spikes = find_spikes(spiky)
    assert {(round(s.u / 0.05), round((s.v + 3) / 0.1)) for s in spikes.found} == {
        (i, j) for i, j, _ in places
    }
    assert spikes.found[0].height == pytest.approx(2 * size, rel=0.2)
    assert np.sign([s.height for s in sorted(spikes.found, key=lambda s: s.u)]).tolist() == [1, -1, 1]
    mended = remove_spikes(spiky, spikes)
    assert np.abs(mended.z - road.z).max() < 0.3 * size
    assert len(find_spikes(mended)) == 0


def test_a_joint_across_the_road_is_no_spike() -> None:
    z = np.zeros((801, 61))
    z[400] = -0.05
    assert len(find_spikes(grid_road(z, 0.05, V))) == 0
    # With three long sections metres apart nobody can tell.
    assert len(find_spikes(grid_road(z[:, ::30], 0.05, V[::30]))) == 1


def test_missing_heights_are_no_spikes() -> None:
    z = np.array(iso8608_road("B", 40, seed=1).z)
    z[100:110, :20], z[300, 30] = np.nan, np.nan
    assert len(find_spikes(grid_road(z, 0.05, V))) == 0
