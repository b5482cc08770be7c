# SPDX-License-Identifier: Apache-2.0
"""A phone that turns in its holder: gravity's direction in the axes of the sensor before and after a moment.

Gravity is the mean specific force of windows of a second without braking and turning. The moment is that of the step
which leaves the least sum of distances between the windows and the medians on its two sides. Slopes turn gravity as
well, so what the road explains is allowed for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.signals.checks import Finding

__all__ = ["FILLED", "QUIET", "WINDOW", "MountingChange", "Windows", "mounting_change", "windows_of"]

#: s of a window: two bounces of a body on its springs average out.
WINDOW = 1.0
#: m/s² of the vehicle's own up to which a window is quiet: it turns the felt gravity by less than what a road may.
QUIET = 0.5
#: Share of a window that has to be free of braking and turning.
FILLED = 0.3
#: Windows on either side of a step at least.
_LEAST = 4
#: rad by which people who get in or out tilt a car on its springs, and what a road explains with it: its cross slope
#: of up to 2.5 % (AASHTO, Green Book; RAA) the other way round is 2.9°.
_LOAD, _CROSS_SLOPE = math.radians(0.5), math.radians(3.5)
#: rad by which slopes of 5 % up and down differ: allowed for where no receiver shows them. Where none shows the speed
#: either, pulling away and braking with 2 m/s² turn gravity by 2 times 12°.
_SLOPES, _BLIND = math.radians(6.0), math.radians(24.0)
#: Share by which slopes from altitudes may be wrong: those of a phone are.
_UNSURE = 0.5
#: Standard errors of the two medians beyond which a step is none of chance: slopes and bends correlate over windows,
#: so more than the usual three. Steps of measured drives without a turn reach 2.7 (or are their slopes').
_SURE = 5.0
#: Numerics: moments that a step is looked for at, at most.
_STEPS = 30
#: Ratio of a normal distribution's standard deviation to its median absolute deviation.
_MAD = 1.4826


@dataclass(frozen=True, eq=False)
class Windows:
    """Quiet windows: ``t`` (k,) s their middles, ``force`` (k, 3) their mean specific force in the sensor's axes, and
    ``slope`` (k,) rad of the road, None where it is not known; ``blind`` where the speed is not known, so that the
    windows may hold braking."""

    t: Floats
    force: Floats
    slope: Floats | None = None
    blind: bool = False


@dataclass(frozen=True, eq=False)
class MountingChange:
    """A turn of the sensor in its holder: gravity's direction ``before`` and ``after`` (3,), and the ``last`` and the
    ``first`` s between which it changes; ``slow``: a steady turn explains the windows better than a step."""

    before: Floats
    after: Floats
    last: float
    first: float
    slow: bool = False

    @property
    def angle(self) -> float:
        """Angle in rad."""
        sine = float(np.linalg.norm(np.cross(self.after, self.before)))
        return math.atan2(sine, float(self.after @ self.before))

    @property
    def turn(self) -> Floats:
        """(3, 3) from the sensor's axes behind the change to those before it: the least rotation that gravity asks for
        (Rodrigues)."""
        axis, cosine = np.cross(self.after, self.before), float(self.after @ self.before)
        if cosine < -1.0 + 1e-9:  # half a turn, about any axis across
            across = np.cross(self.after, np.eye(3)[int(np.argmin(np.abs(self.after)))])
            across /= np.linalg.norm(across)
            return np.asarray(2.0 * np.outer(across, across) - np.eye(3))
        cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
        return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + cosine))

    def moment(self, t: Floats, force: Floats) -> float:
        """The moment in s by samples of the ``force`` (n, 3) at ``t`` (n,): up to it they lie nearer to ``before``."""
        first, last = np.searchsorted(t, [self.last, self.first])
        along = np.cumsum(force[first:last] @ (self.after - self.before))
        return float(t[min(first + int(np.argmin(along)) + 1, t.size - 1)]) if along.size else self.first

    def text(self, moment: float, begin: float) -> str:
        """A line on it; ``moment`` is counted from the stamp ``begin``."""
        degrees = math.degrees(self.angle)
        if self.slow:
            return f"the sensor turns slowly in its holder, by {degrees:.1f}° over the drive"
        return f"the sensor turned in its holder by {degrees:.1f}° at {moment - begin:.1f} s"

    def finding(self, moment: float, begin: float) -> Finding:
        """The line with what is done about it."""
        text = self.text(moment, begin)
        if self.slow:
            return Finding("error", "turning", f"{text}: fasten it and drive again")
        return Finding("warn", "turned", f"{text}: what follows is turned back by gravity; fasten it")


def windows_of(t: Floats, force: Floats, quiet: NDArray[np.bool_] | None, slope: Floats | None) -> Windows:
    """Windows of stamps ``t`` (n,) s of the ``force`` (n, 3) where ``quiet`` (n,), with the ``slope`` (n,) rad; either
    is None where it is not known."""
    blind = quiet is None
    quiet = np.ones(t.size, dtype=np.bool_) if quiet is None else quiet
    number = np.floor((t - t[0]) / WINDOW).astype(np.intp)
    _, all_of = np.unique(number, return_counts=True)
    number = number[quiet]
    _, start, count = np.unique(number, return_index=True, return_counts=True)
    if not count.size:
        return Windows(np.empty(0), np.empty((0, 3)))
    values = np.column_stack([t, force, np.zeros(t.size) if slope is None else slope])[quiet]
    means = np.add.reduceat(values, start, axis=0) / count[:, None]
    means = means[count >= FILLED * float(np.median(all_of))]
    return Windows(means[:, 0], means[:, 1:4], None if slope is None else means[:, 4], blind)


def mounting_change(windows: Windows, ahead: Floats | None = None) -> MountingChange | None:
    """The turn of the sensor that the windows surely show, if any; with the direction ``ahead`` (3,) in its axes of a
    vehicle whose slope is known that of its pitch alone, which no cross slope explains."""
    length = np.linalg.norm(windows.force, axis=1)
    good = (
        np.abs(length / np.median(length) - 1.0) < 0.2 if length.size else length > 0
    )  # gravity, not a bump
    t, up = windows.t[good], windows.force[good] / length[good, None]
    if ahead is not None and len(up):
        level = np.median(up, axis=0)
        up = level + np.outer((up - level) @ ahead, ahead)
    n = t.size
    if n < 2 * _LEAST:
        return None
    stride = math.ceil(n / _STEPS)
    steps = np.arange(_LEAST, n - _LEAST + 1, stride)
    costs = [float(_distances(up[:k]).sum() + _distances(up[k:]).sum()) for k in steps]
    best = int(np.argmin(costs))
    k = int(steps[best])
    sides = up[:k], up[k:]
    error = math.hypot(*(_MAD * float(np.median(_distances(u))) / math.sqrt(len(u)) for u in sides))
    allowed = _BLIND if windows.blind else _SLOPES
    if windows.slope is not None:
        slope = windows.slope[good]
        allowed = _UNSURE * abs(float(np.median(slope[:k]) - np.median(slope[k:])))
    ends = float(t[max(k - stride, 0)]), float(t[min(k + stride - 1, n - 1)])
    found = MountingChange(_direction(sides[0]), _direction(sides[1]), *ends)
    least = _CROSS_SLOPE if ahead is None else _LOAD
    if found.angle < max(least + allowed, _SURE * error):
        return None
    design = np.column_stack([np.ones(n), t - t[0]])
    line = design @ np.linalg.lstsq(design, up, rcond=None)[0]
    if float(np.linalg.norm(up - line, axis=1).sum()) < costs[best]:
        return MountingChange(
            _direction(line[:1]), _direction(line[-1:]), float(t[0]), float(t[-1]), slow=True
        )
    return found


def _direction(up: Floats) -> Floats:
    """Unit vector of the median of ``up`` (k, 3)."""
    median = np.median(up, axis=0)
    return np.asarray(median / np.linalg.norm(median))


def _distances(up: Floats) -> Floats:
    """(k,) of unit vectors (k, 3) from their median."""
    return np.asarray(np.linalg.norm(up - np.median(up, axis=0), axis=1))
