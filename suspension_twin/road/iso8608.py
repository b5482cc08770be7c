# SPDX-License-Identifier: Apache-2.0
"""Random roads after ISO 8608, and the spectrum of any road beside the standard's classes.

The standard's displacement PSD is G(n) = G(n0) (n / n0)^-w with n0 = 0.1 cycles/m and w = 2; the
classes A to H have geometric means G(n0) of 16, 64, 256, ... times 1e-6 m³, each bounded at half
and twice its mean (ISO 8608:2016, annex C).

How alike two tracks are is no part of the standard. ``coherence="isotropic"`` takes the road as
equally rough in every direction, which fixes the coherence of two tracks d metres apart at
2 pi n d K1(2 pi n d) for w = 2 (Dodds and Robson, J. Sound Vib. 31 (1973) 175); a number a gives
exp(-a n d) instead (after Bogsjö, Veh. Syst. Dyn. 45 (2007) 1), 0 being the same profile across.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import next_fast_len
from scipy.signal import detrend, welch

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.build import grid_road, lateral_grid
from suspension_twin.road.road import Road

__all__ = [
    "CLASSES",
    "N0",
    "class_of",
    "iso8608_road",
    "road_psd",
    "roughness",
    "smoothed_psd",
]

CLASSES = "ABCDEFGH"
#: Reference spatial frequency, cycles/m.
N0 = 0.1
#: Where the standard fits its line, cycles/m.
_FIT = (0.011, 2.83)


def roughness(road_class: str) -> float:
    """G(n0) of a class, m³: the geometric mean of its bounds."""
    if len(road_class) != 1 or road_class.upper() not in CLASSES:
        raise InputError("road class", f"must be one letter from A to H, is {road_class!r}")
    return float(16e-6 * 4.0 ** CLASSES.index(road_class.upper()))


def iso8608_road(
    road_class: str = "C",
    length: float = 200.0,
    *,
    width: float = 6.0,
    seed: int = 0,
    step: float = 0.05,
    v_step: float = 0.1,
    roughness_n0: float | None = None,
    waviness: float = 2.0,
    coherence: Literal["isotropic"] | float = "isotropic",
    band: tuple[float, float] = (0.01, 10.0),
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
    name: str | None = None,
) -> Road:
    """Make a straight random road of an ISO 8608 class; the same seed gives the same road.

    Every long section is a Gaussian process with the class's power spectral density.

    Parameters
    ----------
    road_class : str
        "A" to "H".
    length, width : float
        m.
    seed : int
        Seed of the random numbers.
    step, v_step : float
        Distance of the nodes along and across in m.
    roughness_n0 : float, optional
        m³ at 0.1 cycles/m, in place of the class's.
    waviness : float
        Slope of the density, 2 in the standard.
    coherence : "isotropic" or float
        Between long sections.
    band : tuple of float
        Lowest and highest spatial frequency in cycles/m.
    x, y : float
        Start in ``map`` in m.
    heading : float
        Direction in rad.
    name : str, optional
        Name of the road.

    Returns
    -------
    Road
        The road, mean height 0.

    Raises
    ------
    InputError
        For a class, length or band that is impossible.

    Examples
    --------
    >>> rough, smooth = (iso8608_road(c, 50.0, width=2.0) for c in "CA")
    >>> bool(rough.z.std() > 2.0 * smooth.z.std())
    True
    """
    g0 = roughness(road_class) if roughness_n0 is None else float(roughness_n0)
    for what, value in (("length", length), ("step", step), ("roughness_n0", g0)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError("ISO 8608 road", what, f"must be above 0, is {value}")
    if not 1.0 < waviness < 4.0:
        raise InputError("ISO 8608 road", "waviness", f"must lie between 1 and 4, is {waviness}")
    if not 0.0 < band[0] < band[1]:
        raise InputError("ISO 8608 road", "band", f"must be two rising frequencies above 0, is {band}")
    v = lateral_grid(width, v_step)
    count = round(length / step) + 1
    # One period holds the road and four of its longest waves, so that its ends are not alike.
    period = next_fast_len(max(math.ceil((length + 1.0 / band[0]) / step), math.ceil(4.0 / (band[0] * step))))
    n: Floats = np.fft.rfftfreq(period, step).astype(np.float64)
    kept = (n >= band[0] * (1.0 - 1e-9)) & (n <= band[1] * (1.0 + 1e-9)) & (n < 0.5 / step)
    if not kept.any():
        raise InputError("ISO 8608 road", "band", f"holds no wave that a step of {step} m can show")
    rng = np.random.default_rng(seed)
    if coherence == "isotropic":
        modes = _isotropic_modes(rng, n[kept], v, waviness)
    elif isinstance(coherence, (int, float)) and coherence >= 0.0:
        modes = _exponential_modes(rng, n[kept], v, float(coherence))
    else:
        raise InputError(
            "ISO 8608 road", "coherence", f"must be 'isotropic' or a number from 0 on, is {coherence!r}"
        )
    # A one-sided PSD G over steps dn: E|Z|² = G dn / 2 of every complex amplitude of a two-sided series.
    amplitude = np.sqrt(0.5 * g0 * (n[kept] / N0) ** -waviness * n[1]) * period
    spectrum = np.zeros((n.size, v.size), dtype=np.complex128)
    spectrum[kept] = amplitude[:, None] * modes
    z = np.fft.irfft(spectrum, period, axis=0)[:count]
    title = name or (f"ISO 8608 class {road_class.upper()}" if roughness_n0 is None else "ISO 8608")
    return grid_road(z, step, v, x=x, y=y, heading=heading, name=title)


def _isotropic_modes(
    rng: np.random.Generator, n: Floats, v: Floats, waviness: float
) -> NDArray[np.complex128]:
    """Complex amplitudes (frequencies, nv) of unit variance with the isotropic coherence across.

    For each frequency along the road the waves across are drawn from the isotropic spectrum
    (n² + m²)^-(w+1)/2, integrated over each step of m so that the sharp peak at small n is kept.
    """
    spacing = float(np.diff(v).min())
    period = next_fast_len(max(math.ceil(6.0 * float(np.ptp(v)) / spacing), 64))
    m = np.fft.fftfreq(period, spacing)
    half = 0.5 / (period * spacing)
    edges = np.linspace(-half, half, 9)
    nodes, weights = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    power = np.zeros((n.size, m.size))
    for node, weight in zip(nodes, weights, strict=True):
        power += weight * (n[:, None] ** 2 + (m[None, :] + node) ** 2) ** (-0.5 * (waviness + 1.0))
    # About m = 0 the spectrum may be a peak narrower than the step: m = n tan(a) takes that away.
    power[:, 0] = _share(n, half, waviness)
    # Waves too short for the grid across are noise from one long section to the next.
    tail = np.maximum(_share(n, math.inf, waviness) - power.sum(axis=1), 0.0)
    power += tail[:, None] / period
    power /= power.sum(axis=1, keepdims=True)
    noise = rng.standard_normal((n.size, period)) + 1j * rng.standard_normal((n.size, period))
    waves = np.fft.fft(noise * np.sqrt(0.5 * power), axis=1)
    columns = np.rint((v - v[0]) / spacing).astype(np.intp)
    chosen: NDArray[np.complex128] = waves[:, columns]
    return chosen


def _share(n: Floats, reach: float, waviness: float) -> Floats:
    """Integral of (n² + m²)^-(w+1)/2 over m from -reach to reach, for each n."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    angle = np.arctan(reach / n)
    inner = np.cos(angle[:, None] * nodes) ** (waviness - 1.0) @ weights
    share: Floats = n**-waviness * angle * inner
    return share


def _exponential_modes(
    rng: np.random.Generator, n: Floats, v: Floats, decay: float
) -> NDArray[np.complex128]:
    """Complex amplitudes (frequencies, nv) of unit variance with coherence exp(-decay n d)."""
    noise = rng.standard_normal((n.size, v.size)) + 1j * rng.standard_normal((n.size, v.size))
    noise *= math.sqrt(0.5)
    modes = np.empty_like(noise)
    modes[:, 0] = noise[:, 0]
    for j in range(1, v.size):
        alike = np.exp(-decay * n * (v[j] - v[j - 1]))
        modes[:, j] = alike * modes[:, j - 1] + np.sqrt(1.0 - alike**2) * noise[:, j]
    return modes


def road_psd(z: ArrayLike, step: float) -> tuple[Floats, Floats]:
    """Spatial frequencies (cycles/m) and one-sided displacement PSD (m³) of a track (n,) m.

    Welch's method with Hann windows over half the track each, the straight line through each taken
    out; missing heights are bridged. Raises InputError for fewer than 16 points.
    """
    track = np.asarray(z, dtype=np.float64)
    good = np.isfinite(track)
    if track.ndim != 1 or good.sum() < 16:
        raise InputError(
            "road", "spectrum", f"needs 16 heights or more along the road, has {int(good.sum())}"
        )
    at = np.arange(track.size)
    track = np.interp(at, at[good], track[good])
    segment = max(16, 2 * (track.size // 4))
    n, psd = welch(track, 1.0 / step, "hann", segment, detrend=detrend)
    return np.asarray(n[1:], dtype=np.float64), np.asarray(psd[1:], dtype=np.float64)


def smoothed_psd(n: Floats, psd: Floats) -> tuple[Floats, Floats]:
    """A PSD averaged in the standard's smoothing bands: centre frequencies and means.

    Octaves up to 1/32 cycles/m, thirds up to 1/4, twelfths above; bands without a value are left out.
    """
    edges = [2.0**-9.5]
    for per_octave, upper in ((1, 2.0**-5), (3, 2.0**-2), (12, math.inf)):
        while edges[-1] < upper * 2.0 ** (-0.5 / per_octave) * (1.0 - 1e-9) and edges[-1] < n[-1]:
            edges.append(edges[-1] * 2.0 ** (1.0 / per_octave))
    band = np.digitize(n, edges)
    used = np.unique(band[(band > 0) & (band < len(edges))])
    centres = np.array([math.sqrt(edges[b - 1] * edges[b]) for b in used])
    return centres, np.array([psd[band == b].mean() for b in used])


def class_of(n: Floats, psd: Floats) -> tuple[str, float]:
    """Class and G(n0) (m³) of a PSD: a line of waviness 2 through its smoothed values.

    Fitted from 0.011 to 2.83 cycles/m as far as the road is long and finely enough measured. A road
    smoother than class A is "A", one rougher than H "H". Raises InputError where nothing is in reach.
    """
    centres, values = smoothed_psd(n, psd)
    fit = (centres >= _FIT[0]) & (centres <= _FIT[1]) & (values > 0.0)
    if not fit.any():
        raise InputError("road", "spectrum", f"has no power between {_FIT[0]} and {_FIT[1]} cycles/m")
    g0 = float(np.exp(np.mean(np.log(values[fit] * (centres[fit] / N0) ** 2))))
    place = math.floor(math.log(g0 / 8e-6, 4.0))
    return CLASSES[min(max(place, 0), len(CLASSES) - 1)], g0
