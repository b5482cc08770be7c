# SPDX-License-Identifier: Apache-2.0
"""The motion of the vehicle that IMU and receiver both see, and what it says of their clocks.

Between two velocities the receiver says what the mean planar acceleration a was, as a complex number forward + 1j left;
the IMU's mean horizontal specific force f over the same time, its stamps moved by a lag, is the same number but for the
yaw of the sensor, which is a phase. At the lag of the clocks the magnitude of the correlation

    c = Σ f conj(a) / (|f| |a|)

is largest.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import ROLLOVER, gps_to_posix, rolled_over
from suspension_twin.drive.received import velocities_from_fixes
from suspension_twin.drive.types import Drive

__all__ = ["LEAST_CORRELATION", "CommonMotion", "on_one_clock"]

Complexes: TypeAlias = NDArray[np.complex128]

#: Tolerances, set by hand: what is needed for an answer: velocities, rms of their acceleration in m/s², speed in m/s,
#: correlation.
_LEAST, _EXCITED, _MOVING, LEAST_CORRELATION = 20, 0.2, 1.0, 0.75
#: Beyond this interval in s between velocities nothing is averaged.
_APART: Final = 2.5
#: By how much the correlation with a clock that is off has to exceed that with one that is right (tolerance, by hand).
_MARGIN: Final = 0.15
#: s by which IMU and receiver may be apart besides, more than a phone's receiver is late (0.4 s), and the step in which
#: that is tried.
_REACH, _STEP = 1.5, 0.1


@dataclass(frozen=True, eq=False)
class CommonMotion:
    """Intervals between velocities, ``first`` to ``last`` (m,) s, with the mean ``acceleration`` (m,) m/s² in them, and
    the ``integral`` (n,) m/s of the IMU's horizontal specific force up to its stamps ``t`` (n,) s."""

    first: Floats
    last: Floats
    acceleration: Complexes
    t: Floats
    integral: Complexes

    @classmethod
    def of(cls, t: Floats, force: Floats, at: Floats, velocity: Complexes) -> CommonMotion:
        """From specific force (n, 3) m/s² at ``t`` (n,) s and velocity (k,) m/s, east + 1j north, at ``at`` (k,) s, in
        rising order both."""
        first, middle, last = at[:-2], velocity[1:-1], at[2:]
        with np.errstate(invalid="ignore", divide="ignore"):
            turned = (velocity[2:] - velocity[:-2]) / (last - first) * np.abs(middle) / middle
        used = (np.abs(middle) > _MOVING) & (last - first < _APART)
        return cls(first[used], last[used], turned[used], t, _integral(t, force))

    def within(self, lag: float, reach: float) -> CommonMotion:
        """The intervals that the IMU has, stamped later by ``lag`` s and up to ``reach`` s more or less."""
        inside = (self.first + lag - reach > self.t[0]) & (self.last + lag + reach < self.t[-1])
        seen = self.acceleration[inside]
        mean = seen.mean() if seen.size else 0.0
        return replace(self, first=self.first[inside], last=self.last[inside], acceleration=seen - mean)

    @property
    def enough(self) -> bool:
        """Whether there is enough to compare."""
        return bool(
            self.first.size >= _LEAST and np.sqrt(np.mean(np.abs(self.acceleration) ** 2)) >= _EXCITED
        )

    def force(self, lag: float) -> Complexes:
        """Mean horizontal specific force (m,) m/s² of the IMU in each interval, without its mean over all."""
        mean = (self._at(self.last + lag) - self._at(self.first + lag)) / (self.last - self.first)
        return np.asarray(mean - mean.mean())

    def correlation(self, lag: float) -> float:
        """Magnitude of the correlation where the IMU's stamps are later by ``lag`` s."""
        f = self.force(lag)
        size = float(np.linalg.norm(f) * np.linalg.norm(self.acceleration))
        return abs(complex(np.vdot(self.acceleration, f))) / max(size, 1e-12)

    def correlations(self, lags: Iterable[float]) -> Floats:
        """Of each of the lags (k,) s."""
        return np.array([self.correlation(lag) for lag in lags])

    def _at(self, t: Floats) -> Complexes:
        real, imaginary = self.integral.real, self.integral.imag
        return np.asarray(np.interp(t, self.t, real) + 1j * np.interp(t, self.t, imaginary))


def _integral(t: Floats, force: Floats) -> Complexes:
    """Integral of the horizontal force up to each stamp, in axes of which nobody knows the yaw."""
    up = force.mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    ahead = np.eye(3)[int(np.argmin(np.abs(up)))]
    ahead = ahead - (ahead @ up) * up
    ahead /= float(np.linalg.norm(ahead))
    flat = force @ ahead + 1j * (force @ np.cross(up, ahead))
    usual = float(np.median(np.diff(t)))
    step = np.diff(t, prepend=t[0] - usual)
    step = np.where(step > 5.0 * max(usual, 0.05), 0.0, step)  # nothing is known of a gap
    return np.asarray(np.cumsum(flat * step))


def on_one_clock(drive: Drive) -> tuple[Drive, list[str]]:
    """The drive with what its receiver gave on the IMU's clock, where the two are apart by what GPS time is apart from
    UTC, and a line for each correction."""
    lines: list[str] = []
    if not len(drive.imu) or not len(drive.fix):
        return drive, lines
    if back := rolled_over(float(np.median(drive.fix.t)), float(np.median(drive.imu.t))):
        weeks = f"the receiver's dates are {back / ROLLOVER:.0f} x 1024 weeks back"
        lines.append(f"{weeks} (its week number began again): put right")
        drive = _later(drive, back)
    ahead, sure = _gps_time(drive)
    if ahead and sure:
        whose = "receiver's" if ahead > 0 else "IMU's"
        text = f"by the motion the {whose} stamps are GPS time, {abs(ahead):.0f} s ahead of UTC"
        lines.append(f"{text}: the receiver's are moved by {-ahead:+.0f} s")
        drive = _later(drive, -ahead)
    elif ahead:
        text = f"the receiver begins and ends {ahead:.0f} s after the IMU: are its stamps GPS time?"
        lines.append(f"{text} The motion does not say: they are left as they are")
    return drive, lines


def _later(drive: Drive, seconds: float) -> Drive:
    """The drive with what its receiver gave stamped ``seconds`` later."""
    fix, velocity, heading = drive.fix, drive.velocity, drive.heading
    return replace(
        drive,
        fix=replace(fix, t=fix.t + seconds),
        velocity=replace(velocity, t=velocity.t + seconds),
        heading=None if heading is None else replace(heading, t=heading.t + seconds),
    )


def _gps_time(drive: Drive) -> tuple[float, bool]:
    """By how many s the receiver's stamps are ahead of the IMU's because the leap seconds were not taken out of them
    (negative: out of the IMU's), and whether the motion says so; 0 where nothing does."""
    imu = drive.imu
    velocity = drive.velocity if len(drive.velocity) else velocities_from_fixes(drive.fix)
    (t, own), (at, order) = np.unique(imu.t, return_index=True), np.unique(velocity.t, return_index=True)
    if at.size < _LEAST or t.size < _LEAST:
        return 0.0, False
    leaps = float(at[-1] - gps_to_posix(at[-1:])[0])
    enu = velocity.enu[order]
    motion = CommonMotion.of(t, imu.specific_force[own], at, enu[:, 0] + 1j * enu[:, 1])
    energy = np.sum(np.abs(motion.within(0.0, -np.inf).acceleration) ** 2)
    around = np.arange(-_REACH, _REACH + 0.5 * _STEP, _STEP)

    def correlation(ahead: float) -> float:
        seen = motion.within(-ahead, _REACH)
        if not seen.enough or np.sum(np.abs(seen.acceleration) ** 2) < 0.5 * energy:
            return 0.0
        return float(seen.correlations((around - ahead).tolist()).max())

    def overlap(ahead: float) -> float:
        return float(min(t[-1], at[-1] - ahead) - max(t[0], at[0] - ahead))

    known = correlation(0.0)
    if known >= LEAST_CORRELATION or not leaps:
        return 0.0, False
    found = {
        ahead: correlation(ahead) for ahead in (leaps, -leaps) if overlap(ahead) >= overlap(0.0) - _REACH
    }
    best = max(found, key=lambda ahead: found[ahead], default=0.0)
    if found.get(best, 0.0) >= max(LEAST_CORRELATION, known + _MARGIN):
        return best, True
    apart = np.abs([at[0] - t[0] - leaps, at[-1] - t[-1] - leaps])
    return (leaps if (apart < _REACH).all() else 0.0), False
