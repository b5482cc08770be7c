# SPDX-License-Identifier: Apache-2.0
"""Random roads: their spectrum is the class's, and two tracks are as alike as the model says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import csd, welch
from scipy.special import kv

from suspension_twin.errors import InputError
from suspension_twin.road.roughness import (
    CLASSES,
    class_of,
    iso8608_road,
    road_psd,
    roughness,
    smoothed_psd,
)


def class_psd(road_class: str, n: np.ndarray | float) -> np.ndarray:
    """The standard's displacement PSD, m³, at ``n`` cycles/m."""
    return roughness(road_class) * (np.asarray(n) / 0.1) ** -2


def test_classes_are_the_standards() -> None:
    # ISO 8608, annex C: geometric means at 0.1 cycles/m in 1e-6 m³, bounds at half and twice.
    means = [16, 64, 256, 1024, 4096, 16384, 65536, 262144]
    assert [roughness(c) * 1e6 for c in CLASSES] == pytest.approx(means)


@pytest.mark.parametrize("road_class", list(CLASSES))
def test_the_spectrum_of_a_road_is_its_classs(road_class: str) -> None:
    road = iso8608_road(road_class, 4000, width=2, v_step=1, seed=CLASSES.index(road_class))
    # Independent of the road's own spectrum: SciPy's, averaged over many stretches.
    n, psd = welch(road.z[:, 1], 1 / road.u_step, nperseg=8192)
    for low in (0.0125, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2):
        octave = (n > low) & (n <= 2 * low)
        ratio = (psd[octave] / class_psd(road_class, n[octave])).mean()
        # The mean of m values that are exponential, m about 10 stretches times the bins: 4 sigma.
        assert ratio == pytest.approx(1.0, abs=4 / np.sqrt(7.5 * octave.sum()))
    found, g0 = class_of(*road_psd(road.z[:, 0], road.u_step))
    assert found == road_class
    assert g0 == pytest.approx(roughness(road_class), rel=0.15)


def test_the_variance_is_the_integral_of_the_spectrum() -> None:
    z = iso8608_road("C", 20000, width=1, v_step=1, seed=4, band=(0.05, 5.0)).z[:, 1]
    # The integral of G0 (n/n0)^-2 from 0.05 to 5.
    assert z.var() == pytest.approx(256e-6 * 0.1**2 * (1 / 0.05 - 1 / 5), rel=0.1)
    n, psd = welch(z, 20, nperseg=16384)
    assert psd[(n > 5.3)].max() < 1e-3 * class_psd("C", 5.0)
    assert psd[(n > 0) & (n < 0.04)].max() < 0.05 * class_psd("C", 0.05)


@pytest.mark.parametrize(("coherence", "seed"), [("isotropic", 5), (1.5, 6), (0.0, 7)])
def test_two_tracks_are_as_alike_as_the_model_says(coherence: float | str, seed: int) -> None:
    road = iso8608_road("C", 12000, width=4, v_step=0.5, seed=seed, coherence=coherence)  # type: ignore[arg-type]
    apart = 3  # long sections, 1.5 m
    pairs = [(j, j + apart) for j in range(road.v.size - apart)]
    n, _ = welch(road.z[:, 0], 20, nperseg=4096)
    power = np.mean([welch(road.z[:, j], 20, nperseg=4096)[1] for j in range(road.v.size)], axis=0)
    cross = np.mean([csd(road.z[:, a], road.z[:, b], 20, nperseg=4096)[1] for a, b in pairs], axis=0)
    measured = cross.real / power
    for low in (0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.28):
        octave = (n > low) & (n <= 2 * low)
        if coherence == "isotropic":
            a = 2 * np.pi * n[octave] * 1.5
            expected = a * kv(1, a)
        else:
            expected = np.exp(-coherence * n[octave] * 1.5)  # type: ignore[operator]
        assert measured[octave].mean() == pytest.approx(expected.mean(), abs=0.05)
    assert np.abs(cross.imag[1:] / power[1:]).mean() < 0.1


def test_the_same_seed_gives_the_same_road() -> None:
    a, b, c = (iso8608_road("B", 50, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(a.z, b.z)
    assert np.abs(a.z - c.z).max() > 1e-3
    # One long section more or less does not make it another road along.
    assert a.length == pytest.approx(50)
    assert a.name == "ISO 8608 class B"


def test_place_and_roughness_of_ones_own() -> None:
    road = iso8608_road(length=400, roughness_n0=100e-6, x=5, y=6, heading=2.0, width=2, v_step=1)
    assert (road.x[0], road.y[0], road.headings[0]) == (5, 6, 2.0)
    found, g0 = class_of(*road_psd(road.z[:, 0], road.u_step))
    assert found == "B"
    assert g0 == pytest.approx(100e-6, rel=0.4)


def test_band_means_keep_a_power_law() -> None:
    n = np.arange(1, 20000) * 0.0005
    centres, means = smoothed_psd(n, class_psd("D", n))
    wide = centres < 0.03  # in an octave the mean of a falling power law lies above its middle
    assert means[~wide] == pytest.approx(class_psd("D", centres[~wide]), rel=0.05)
    assert (np.diff(centres) > 0).all()


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ({"road_class": "I"}, "one letter from A to H"),
        ({"road_class": "AB"}, "one letter from A to H"),
        ({"length": 0.0}, "length"),
        ({"step": float("nan")}, "step"),
        ({"roughness_n0": -1.0}, "roughness_n0"),
        ({"waviness": 1.0}, "waviness"),
        ({"band": (1.0, 0.5)}, "band"),
        ({"band": (20.0, 30.0)}, "no wave"),
        ({"coherence": -1.0}, "coherence"),
        ({"coherence": "alike"}, "coherence"),
        ({"width": -2.0}, "width"),
    ],
)
def test_what_makes_no_road_is_refused(arguments: dict[str, object], fault: str) -> None:
    with pytest.raises(InputError, match=fault):
        iso8608_road(**arguments)  # type: ignore[arg-type]


def test_a_track_too_short_for_a_spectrum_is_refused() -> None:
    with pytest.raises(InputError, match="16 heights"):
        road_psd(np.zeros(15), 0.1)
    with pytest.raises(InputError, match="no power"):
        class_of(*road_psd(np.zeros(400), 0.1))
