# SPDX-License-Identifier: Apache-2.0
"""Roughness of roads: ISO 8608 (random roads, spectra, classes, single events apart) and the IRI.

ISO 8608: the standard's displacement PSD is G(n) = G(n0) (n / n0)^-w with n0 = 0.1 cycles/m and w = 2; the
classes A to H have geometric means G(n0) of 16, 64, 256, ... times 1e-6 m³, each bounded at half
and twice its mean (ISO 8608:2016, annex C).

How alike two tracks are is no part of the standard. ``coherence="isotropic"`` takes the road as
equally rough in every direction, which fixes the coherence of two tracks d metres apart at
2 pi n d K1(2 pi n d) for w = 2 (Dodds and Robson, J. Sound Vib. 31 (1973) 175); a number a gives
exp(-a n d) instead (after Bogsjö, Veh. Syst. Dyn. 45 (2007) 1), 0 being the same profile across.

Events (bumps, holes, ramps, steps): a class describes a stationary random profile. Its displacement spectrum falls
with the square of the frequency, so its slope is white: the mean slope over a length L has the standard
deviation sqrt(G_slope / (2 L)), whatever L. An event is a place where such a mean exceeds
the range that its neighbours allow. Outside the events the slope remains white, so leaving samples out does
not bend its spectrum.

International Roughness Index (ASTM E1926): the golden car is a quarter car of four numbers by its sprung mass: tyre
rate 653 s⁻², suspension rate 63.3 s⁻², damping 6 s⁻¹, unsprung mass 0.15, at 80 km/h. It filters the slope of the
profile; the index is the mean absolute rate of its suspension per metre of road (Sayers, Transp. Res. Rec.
1501 (1995) 1). The slope is constant between two points, for which the solution is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import next_fast_len
from scipy.ndimage import uniform_filter1d
from scipy.signal import detrend, lfilter, welch

from suspension_twin.arrays import Floats, runs
from suspension_twin.errors import InputError
from suspension_twin.road.build import grid_road, lateral_grid
from suspension_twin.road.road import Road

__all__ = [
    "CLASSES",
    "N0",
    "ProfileEvent",
    "Roughness",
    "class_of",
    "golden_car",
    "iri",
    "iri_along",
    "iso8608_road",
    "profile_events",
    "profile_roughness",
    "road_psd",
    "roughness",
    "smoothed_psd",
]

CLASSES: Final = "ABCDEFGH"
#: Reference spatial frequency, cycles/m.
N0: Final = 0.1
#: Range of the standard's line fit, cycles/m.
_FIT: Final = (0.011, 2.83)


def _bridged(z: ArrayLike, field: str, least: int) -> Floats:
    """A profile (n,) with missing heights bridged; InputError with fewer than ``least`` of them."""
    profile = np.asarray(z, dtype=np.float64)
    good = np.isfinite(profile)
    if profile.ndim != 1 or good.sum() < least:
        raise InputError(
            "road", field, f"needs {least} heights or more along the road, has {int(good.sum())}"
        )
    at = np.arange(profile.size)
    return np.interp(at, at[good], profile[good])


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
    for quantity, value in (("length", length), ("step", step), ("roughness_n0", g0)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError("ISO 8608 road", quantity, f"must be above 0, is {value}")
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
    return waves[:, columns]


def _share(n: Floats, reach: float, waviness: float) -> Floats:
    """Integral of (n² + m²)^-(w+1)/2 over m from -reach to reach, for each n."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    angle = np.arctan(reach / n)
    inner = np.cos(angle[:, None] * nodes) ** (waviness - 1.0) @ weights
    return n**-waviness * angle * inner


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
    track = _bridged(z, "spectrum", 16)
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


# Single events of a profile

#: Mean slopes are looked at from this length on, m: half of the shortest wave of the standard's fit.
_SHORTEST = 0.18
#: A mean slope of so many standard deviations is an event: once in ten thousand kilometres by chance.
_LIMIT = 5.0
#: Events that cover more of a profile than this are its roughness.
_MOST = 0.4
#: A mean slope below this is level, whatever is around it.
_LEVEL = 1e-6
#: Standard deviation of a normal distribution over its median absolute deviation.
_MAD = 1.4826


@dataclass(frozen=True)
class ProfileEvent:
    """A single event from ``start`` to ``end`` m; ``height`` m by which it leaves the line between its ends,
    or ``rise`` m from one end to the other where that is more."""

    start: float
    end: float
    height: float
    rise: float

    def __str__(self) -> str:
        if abs(self.rise) > abs(self.height):
            size = f"a {'rise' if self.rise > 0 else 'drop'} of {1e3 * abs(self.rise):.0f} mm"
        else:
            size = f"{1e3 * abs(self.height):.0f} mm {'high' if self.height > 0 else 'deep'}"
        return f"{size}, u {self.start:.1f} to {self.end:.1f} m"


@dataclass(frozen=True, eq=False)
class Roughness:
    """ISO 8608 of a profile: class and G(n0) (m³) without events, the class with them, and the events."""

    letter: str
    g0: float
    letter_with_events: str
    events: tuple[ProfileEvent, ...]


def profile_roughness(z: ArrayLike, step: float, first: float = 0.0) -> Roughness:
    """ISO 8608 class of a wheel path, from the spectrum of its slope with single events apart.

    Parameters
    ----------
    z : (n,) array
        Heights in m, evenly spaced; missing ones are bridged.
    step : float
        Their distance in m.
    first : float
        Place of the first one in m, from which events are counted.

    Returns
    -------
    Roughness
        Classes, G(n0) and events.

    Raises
    ------
    InputError
        The profile is too short, or has no power where the standard looks.

    Examples
    --------
    >>> from suspension_twin.road import add_bump, half_sine
    >>> from suspension_twin.road.roughness import iso8608_road
    >>> road = add_bump(iso8608_road("B", 200.0, width=2.0), half_sine(1.0, -0.08), 60.0)
    >>> found = profile_roughness(road.z[:, 0], road.u_step)
    >>> found.letter, len(found.events)
    ('B', 1)
    """
    profile = _bridged(z, "spectrum", 32)
    slope = _centred_slope(profile, step)
    mask = _events(slope, step)
    everything = _class(slope, step, np.zeros(slope.size, dtype=np.bool_))
    if not mask.any():
        return Roughness(*everything, everything[0], ())
    return Roughness(*_class(slope, step, mask), everything[0], _described(profile, mask, step, first))


def profile_events(z: ArrayLike, step: float, first: float = 0.0) -> tuple[ProfileEvent, ...]:
    """The single events of a profile, of a level road with a bump, too, which has no spectrum; arguments and errors as
    of :func:`profile_roughness`."""
    profile = _bridged(z, "spectrum", 32)
    return _described(profile, _events(_centred_slope(profile, step), step), step, first)


def _centred_slope(profile: Floats, step: float) -> Floats:
    """Slope (n - 1,) of a profile about its median."""
    slope = np.diff(profile) / step
    return slope - np.median(slope)


def _events(slope: Floats, step: float) -> NDArray[np.bool_]:
    """Where the slope (n,) belongs to an event."""
    lengths = []
    reach = max(_SHORTEST, step)
    while reach < 0.25 * slope.size * step:
        lengths.append(max(1, round(reach / step)))
        reach *= math.sqrt(2.0)
    mask = np.zeros(slope.size, dtype=np.bool_)
    # White: the standard deviation at any length from that at all others; by medians, which events do not move.
    scales = {n: _MAD * float(np.median(np.abs(_means(slope, n)))) for n in dict.fromkeys(lengths)}
    white = float(np.median([s * math.sqrt(n) for n, s in scales.items()])) if scales else 0.0
    left = slope.copy()
    # From short to long: an event found at a short length is sharply bounded and out of the longer means.
    for n, own in scales.items():
        # A road of a steeper spectrum has more at length than a white slope.
        scale = max(own, white / math.sqrt(n))
        hit = np.abs(_means(left, n)) > max(_LIMIT * scale, _LEVEL)
        for start in np.flatnonzero(hit):
            mask[start : start + n] = True
        left[mask] = 0.0
    mask = _joined(mask)
    return mask if mask.mean() <= _MOST else np.zeros_like(mask)


def _joined(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask with parts of one event joined: the two walls of a hole, a ramp that roughness interrupts."""
    parts: list[tuple[int, int]] = []
    for low, high in runs(mask):
        while parts and low - parts[-1][1] <= (high - low) + (parts[-1][1] - parts[-1][0]):
            low, _ = parts.pop()
        parts.append((low, high))
    joined = np.zeros_like(mask)
    for low, high in parts:
        joined[low:high] = True
    return joined


def _means(slope: Floats, n: int) -> Floats:
    """Means of all n neighbours: (size - n + 1,)."""
    total = np.concatenate([[0.0], np.cumsum(slope)])
    return np.asarray((total[n:] - total[:-n]) / n)


def _class(slope: Floats, step: float, mask: NDArray[np.bool_]) -> tuple[str, float]:
    """Class and G(n0) from the slope outside of a mask."""
    kept = ~mask
    white = np.where(kept, slope - slope[kept].mean(), 0.0)
    segment = max(16, 2 * (white.size // 4))
    n, psd = welch(white, 1.0 / step, "hann", segment, detrend=False)
    n, psd = n[1:], psd[1:] / kept.mean()
    # The difference of two points is no derivative: |2 sin(pi n step) / step| in place of 2 pi n.
    height = psd / (2.0 * np.sin(np.pi * n * step) / step) ** 2
    return class_of(np.asarray(n, dtype=np.float64), np.asarray(height, dtype=np.float64))


def _described(
    profile: Floats, mask: NDArray[np.bool_], step: float, first: float
) -> tuple[ProfileEvent, ...]:
    events = []
    for low, high in runs(mask):
        part = profile[low : high + 1]
        off = part - np.linspace(part[0], part[-1], part.size)
        height, rise = float(off[np.abs(off).argmax()]), float(part[-1] - part[0])
        events.append(ProfileEvent(first + step * low, first + step * high, height, rise))
    return tuple(events)


# International Roughness Index

_TYRE, _SPRING, _DAMPING, _UNSPRUNG = 653.0, 63.3, 6.0, 0.15
_SPEED = 80.0 / 3.6  # m/s
_BASE = 0.25  # m of the moving average, the contact of a tyre
_START = 11.0  # m over which the first slope is taken


def golden_car() -> tuple[Floats, Floats]:
    """State matrix (4, 4) and input vector (4,) of the golden car: sprung height and rate, unsprung height and rate;
    input a height."""
    k, c, u = _SPRING, _DAMPING, _UNSPRUNG
    a = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-k, -c, k, c],
            [0.0, 0.0, 0.0, 1.0],
            [k / u, c / u, -(_TYRE + k) / u, -c / u],
        ]
    )
    return a, np.array([0.0, 0.0, 0.0, _TYRE / u])


def iri(z: ArrayLike, step: float) -> float:
    """International Roughness Index of one wheel path.

    Parameters
    ----------
    z : (n,) array
        Heights in m, evenly spaced; missing ones are bridged.
    step : float
        Their distance in m.

    Returns
    -------
    float
        m/m; multiply by 1000 for the usual m/km.

    Raises
    ------
    InputError
        The profile is shorter than 11 m, or coarser than 0.3 m, at which the standard ends.

    Examples
    --------
    >>> import numpy as np
    >>> iri(0.01 * np.arange(400), 0.25)  # a slope alone is no roughness
    0.0
    """
    return float(np.mean(iri_along(z, step)))


def iri_along(z: ArrayLike, step: float) -> Floats:
    """Contribution of each interval of a profile to its index: (n - 1,) m/m, as :func:`iri`, whose mean it is."""
    profile = _bridged(z, "IRI", 2)
    if (profile.size - 1) * step < _START:
        raise InputError("road", "IRI", f"needs {_START:g} m of profile or more")
    if not 0.0 < step <= 0.3:
        raise InputError("road", "IRI", f"needs a point every 0.3 m or closer, not every {step:g} m")
    slope = np.diff(profile) / step
    # The first slope goes on before the start, so that a long grade is no event there.
    first = float(profile[round(_START / step)] - profile[0]) / (step * round(_START / step))
    width = round(_BASE / step)
    if width > 1:
        slope = uniform_filter1d(slope, width, mode="nearest")
    # Along its eigenvectors the car is four filters of the first order.
    a, b = golden_car()
    values, vectors = np.linalg.eig(a)
    inverse = np.linalg.inv(vectors)
    pole = np.exp(values * step / _SPEED)
    gain = (pole - 1.0) / values * (inverse @ b)
    rate = np.zeros(slope.size, dtype=np.complex128)
    # On an endless grade the two heights follow the slope and the two rates are 0: the difference is filtered.
    for i in range(4):
        modal = lfilter([gain[i]], [1.0, -pole[i]], slope - first)
        rate += (vectors[0, i] - vectors[2, i]) * modal
    # By linearity the grade itself moves nothing. Rounding of a level profile is no roughness.
    contribution = np.abs(rate.real)
    return np.where(contribution < 1e-12, 0.0, contribution)
