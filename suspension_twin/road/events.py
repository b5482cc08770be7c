# SPDX-License-Identifier: Apache-2.0
"""Single events of a profile (bumps, holes, ramps, steps), told apart from its roughness.

A class of ISO 8608 describes a stationary random profile. Its displacement spectrum falls with the
square of the frequency, so its slope is white: the mean slope over a length L has the standard
deviation sqrt(G_slope / (2 L)), whatever L. An event is a place where such a mean exceeds
what its neighbours allow. Outside the events the slope remains white, so leaving samples out does
not bend its spectrum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label
from scipy.signal import welch

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.iso8608 import class_of

__all__ = ["ProfileEvent", "Roughness", "profile_events", "profile_roughness"]

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
            what = f"a {'rise' if self.rise > 0 else 'drop'} of {1e3 * abs(self.rise):.0f} mm"
        else:
            what = f"{1e3 * abs(self.height):.0f} mm {'high' if self.height > 0 else 'deep'}"
        return f"{what}, u {self.start:.1f} to {self.end:.1f} m"


@dataclass(frozen=True, eq=False)
class Roughness:
    """ISO 8608 of a profile: class and G(n0) (m³) of what is no event, and of all of it; the events."""

    letter: str
    g0: float
    letter_with_events: str
    g0_with_events: float
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
    >>> from suspension_twin.road.iso8608 import iso8608_road
    >>> road = add_bump(iso8608_road("B", 200.0, width=2.0), half_sine(1.0, -0.08), 60.0)
    >>> found = profile_roughness(road.z[:, 0], road.u_step)
    >>> found.letter, len(found.events)
    ('B', 1)
    """
    profile, slope = _bridged(z, step)
    mask = _events(slope, step)
    everything = _class(slope, step, np.zeros(slope.size, dtype=np.bool_))
    if not mask.any():
        return Roughness(*everything, *everything, ())
    return Roughness(*_class(slope, step, mask), *everything, _described(profile, mask, step, first))


def profile_events(z: ArrayLike, step: float, first: float = 0.0) -> tuple[ProfileEvent, ...]:
    """The single events of a profile, of a level road with a bump, too, which has no spectrum; arguments and errors as
    of :func:`profile_roughness`."""
    profile, slope = _bridged(z, step)
    return _described(profile, _events(slope, step), step, first)


def _bridged(z: ArrayLike, step: float) -> tuple[Floats, Floats]:
    """The profile (n,) without holes, and its slope (n - 1,) about the median."""
    profile = np.asarray(z, dtype=np.float64)
    good = np.isfinite(profile)
    if profile.ndim != 1 or good.sum() < 32:
        raise InputError("road", "spectrum", f"needs 32 heights or more, has {int(good.sum())}")
    at = np.arange(profile.size)
    profile = np.interp(at, at[good], profile[good])
    slope = np.diff(profile) / step
    return profile, slope - np.median(slope)


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
    # From short to long: what is found at a short length is sharply bounded and out of the longer means.
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
    parts: list[list[int]] = []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    for low, high in edges.reshape(-1, 2):
        parts.append([int(low), int(high)])
        while len(parts) > 1 and parts[-1][0] - parts[-2][1] <= sum(b - a for a, b in parts[-2:]):
            last = parts.pop()
            parts[-1][1] = last[1]
    joined = np.zeros_like(mask)
    for low, high in parts:
        joined[low:high] = True
    return joined


def _means(slope: Floats, n: int) -> Floats:
    """Means of all n neighbours: (size - n + 1,)."""
    total = np.concatenate([[0.0], np.cumsum(slope)])
    means: Floats = (total[n:] - total[:-n]) / n
    return means


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
    groups, count = label(mask)
    events = []
    for k in range(1, count + 1):
        where = np.flatnonzero(groups == k)
        low, high = int(where[0]), int(where[-1]) + 1
        part = profile[low : high + 1]
        line = np.linspace(part[0], part[-1], part.size)
        tip = int(np.abs(part - line).argmax())
        events.append(
            ProfileEvent(
                first + step * low,
                first + step * high,
                float((part - line)[tip]),
                float(part[-1] - part[0]),
            )
        )
    return tuple(events)
