# SPDX-License-Identifier: Apache-2.0
"""IMU/GNSS consistency: clock offset, yaw of the mounting, mirrored axes, sign and unit of the gyro.

Both are compared by changes of velocity in the plane, as complex numbers (ahead + 1j left, in the vehicle's axes, at
the IMU's place). From a_n to b_n, half a second or the receiver's interval, they are

    p_n = (V(b_n) - V(a_n)) exp(-1j heading_n),   f_n(k) = integral of the specific force from a_n + k to b_n + k,

so that of the receiver nothing is interpolated and nothing differentiated twice: V is its own velocity, or the mean
between two of its positions, and then f is a mean alike. Both without their mean, their correlation

    c(k) = sum f_n(k) conj(p_n) / (|f| |p|)

has a magnitude that does not depend on the yaw of the sensor. The lag of the largest |c| is the clock offset, and the
angle of c there the yaw of the mounting. For left-handed sensor axes the conjugate of f correlates. With N independent
changes the likelihood of a lag is (1 - |c(k)|²)^-N, whose width is how well the lag is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.received import velocity_fault
from suspension_twin.drive.types import Drive
from suspension_twin.pose.satellites import LEVEL
from suspension_twin.signals.attitude import level_rpy, matrix_rpy, rpy_matrix
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.offline import GnssMotion, ImuSignals, gnss_motion
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.twin import Place

__all__ = ["Consistency", "clock_offset_beyond", "consistency", "findings", "yaw_beyond"]

Complexes = NDArray[np.complex128]

_LARGEST_LAG = 40.0  # s
#: s between lags that are tried, up to _CLOCK_OFFSET_ERROR and beyond; s of the grid of the IMU's integrals (numerics).
_NEAR_STEP, _FAR_STEP, _GRID = 0.05, 0.2, 0.01
#: s of a change of velocity at least, and of a mean velocity between positions (prior): braking lasts longer, the
#: errors of a receiver of centimetres become those of 0.05 m/s.
_CHANGE, _BETWEEN = 0.5, 1.0
#: Changes of a drive that are compared at most, evenly: an hour's say no more, and take seconds (numerics).
_MOST = 2000
#: Least correlation of a result, and by how much that of a long lag has to exceed that of the short ones.
_LEAST_CORRELATION, _LEAST_MARGIN = 0.75, 0.15
_LEAST = 0.2  # m/s² rms of the path's acceleration
#: s of driving that a short lag and a long one need (prior, by hand): of the 400 long lags one fits nine seconds by
#: chance.
_LEAST_SECONDS, _LONG_SECONDS = 5.0, 10.0
#: m/s from which a course gives the heading (prior: to 3° with a phone's Doppler of 0.1 m/s); of a drive too slow for
#: it, m/s from which it moves, and m/s² across up to which it goes straight on (prior, by hand).
_FAST, _MOVING, _STRAIGHT = 2.0, 0.8, 0.3
#: Limits in s and rad from which on a finding is reported, and clock offset in s from which on it is an error.
_CLOCK_OFFSET, _TURNED, _CLOCK_OFFSET_ERROR = 0.3, 0.35, 2.0
#: Standard deviations of an angle between two parts of a drive that are no chance (prior: 1 in 16 000).
_SURE = 4.0
#: Share of the path's squared change that lies on either side of a turn of the sensor at least.
_LEAST_SHARE = 0.15
#: Least rms yaw rate in rad/s for a check of the sign of the gyro.
_LEAST_YAW_RATE = 0.02
#: Largest plausible 99th percentile of the rate in rad/s; in °/s any drive exceeds it.
_LARGEST_RATE = 4.0
_LEAP_SECONDS = "GPS time is 18 s ahead of UTC"


@dataclass(frozen=True)
class Consistency:
    """``clock_offset`` s of the IMU stamps against those of the receiver (positive: later), known to ``clock_sigma`` s;
    ``yaw`` rad of the sensor against the mounting of the twin file, 0 where its axes are ``mirrored``; ``reversed``:
    the yaw rate has the wrong sign."""

    clock_offset: float
    clock_sigma: float
    yaw: float
    mirrored: bool = False
    reversed: bool = False


@dataclass(frozen=True, eq=False)
class _Felt:
    """Integrals over time of what the IMU felt, on an even grid from ``start`` s on: ``velocity`` (g,) complex m/s in
    its own axes, ``angle`` (g,) rad about the vertical, a complex number as well."""

    start: float
    velocity: Complexes
    angle: Complexes

    @classmethod
    def of(cls, signals: ImuSignals, over: float) -> _Felt:
        """The integrals, each the mean ``over`` as many s about its time."""
        t = signals.t
        grid = np.arange(t[0], t[-1], _GRID)

        half = round(0.5 * over / _GRID)
        speeds = signals.force[:, 0] + 1.0j * signals.force[:, 1], signals.rate[:, 2].astype(complex)
        velocity, angle = (_mean_about(_resampled(grid, t, _integral(t, one)), half) for one in speeds)
        return cls(float(t[0]), velocity, angle)

    def changes(self, of: Complexes, start: Floats, end: Floats) -> Complexes:
        """Changes of one of the integrals from ``start`` to ``end``."""
        rows = np.concatenate([start, end])
        place = (rows - self.start) / _GRID
        whole = np.clip(place.astype(np.intp), 0, of.size - 2)
        values = of[whole] + (place - whole) * (of[whole + 1] - of[whole])
        return np.asarray(values[start.size :] - values[: start.size])

    @property
    def end(self) -> float:
        """s of the last row."""
        return self.start + _GRID * (self.velocity.size - 1)


@dataclass(frozen=True, eq=False)
class _Changes:
    """Changes of velocity from ``start`` to ``end`` (m,) s of the receiver's clock: its own ``path`` (m,) complex m/s
    and how far its course ``turned`` (m,) rad; ``step`` s from one to the next; what the IMU ``felt``."""

    start: Floats
    end: Floats
    path: Complexes
    turned: Floats
    step: float
    felt: _Felt

    @property
    def excited(self) -> bool:
        """Whether there is enough of it."""
        if self.step * self.start.size < _LEAST_SECONDS:
            return False
        pull = _centred(self.path, self.end - self.start) / (self.end - self.start)
        return math.sqrt(float(np.mean(np.abs(pull) ** 2))) >= _LEAST

    @property
    def independent(self) -> float:
        """Number of changes that have errors of their own: of those that do not overlap every second, for each end of
        one is the start of the next."""
        return 0.5 * self.start.size * min(self.step / float(np.median(self.end - self.start)), 1.0)

    def at(self, lag: float, seconds: float) -> tuple[NDArray[np.bool_], Complexes, Complexes] | None:
        """Which of them the IMU covers ``lag`` s later, and path and felt there without their means; None of less than
        half of the energy or of the ``seconds``."""
        inside = (self.start + lag >= self.felt.start) & (self.end + lag <= self.felt.end)
        if self.step * np.count_nonzero(inside) < seconds:
            return None
        start, end, path = self.start[inside], self.end[inside], self.path[inside]
        if not inside.all() and np.linalg.norm(path) ** 2 < 0.5 * np.linalg.norm(self.path) ** 2:
            return None
        felt = self.felt.changes(self.felt.velocity, start + lag, end + lag)
        return inside, _centred(path, end - start), _centred(felt, end - start)

    def correlations(self, lag: float, seconds: float) -> tuple[complex, complex]:
        """With the path, of the felt and of its mirror image."""
        both = self.at(lag, seconds)
        if both is None:
            return 0.0j, 0.0j
        inside, path, felt = both
        long = (self.end - self.start)[inside]
        return _correlation(path, felt, long), _correlation(path, felt.conj(), long)

    def reversed(self, lag: float) -> bool:
        """Whether the rate about the vertical, ``lag`` s later, surely has the opposite sign of the course's."""
        inside = (self.start + lag >= self.felt.start) & (self.end + lag <= self.felt.end)
        start, end, turned = self.start[inside], self.end[inside], self.turned[inside]
        if not inside.any() or math.sqrt(float(np.mean((turned / (end - start)) ** 2))) < _LEAST_YAW_RATE:
            return False
        felt = self.felt.changes(self.felt.angle, start + lag, end + lag)
        return _correlation(turned.astype(complex), felt, end - start).real < -_LEAST_CORRELATION


def _integral(t: Floats, values: Complexes) -> Complexes:
    return np.concatenate([[0.0j], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t))])


def _resampled(at: Floats, t: Floats, values: Complexes) -> Complexes:
    return np.interp(at, t, values.real) + 1.0j * np.interp(at, t, values.imag)


def _mean_about(values: Complexes, half: int) -> Complexes:
    """Means over as many rows to either side."""
    if not half:
        return values
    wide = np.pad(values, half, mode="edge")
    total = np.concatenate([[0.0j], np.cumsum(0.5 * (wide[1:] + wide[:-1]))])
    return np.asarray((total[2 * half :] - total[: -2 * half]) / (2 * half))


def _centred(values: Complexes, seconds: Floats) -> Complexes:
    """Changes without the acceleration that all of them share: a bias, and gravity."""
    return np.asarray(values - seconds * (seconds @ values) / max(float(seconds @ seconds), 1e-12))


def _correlation(path: Complexes, felt: Complexes, seconds: Floats) -> complex:
    path, felt = _centred(path, seconds), _centred(felt, seconds)
    return complex(np.vdot(path, felt)) / max(float(np.linalg.norm(path) * np.linalg.norm(felt)), 1e-12)


def _changes(drive: Drive, signals: ImuSignals, gps: Place) -> list[_Changes]:
    """The changes of a drive, with and without what gravity adds on its hills where both may be; none where the drive
    has too little planar acceleration."""
    ground = gnss_motion(drive, _BETWEEN)
    if not ground.known or signals.rate_hz < 2.0 / _CHANGE:
        return []
    t, velocity = ground.t, ground.east + 1.0j * ground.north
    gap = float(np.median(np.diff(t)))
    stride = max(1, round(_CHANGE / gap))
    felt = _Felt.of(signals, ground.over)
    spacing = max(1, stride // 2, math.ceil(t.size / _MOST))
    first = np.arange(0, t.size - stride, spacing)
    last = first + stride
    whole = (t[last] - t[first]) < 1.6 * max(stride * gap, gap)

    def between(path: Complexes, heading: Floats, used: NDArray[np.bool_]) -> _Changes:
        own = used & whole
        a, b = first[own], last[own]
        return _Changes(t[a], t[b], path[own], heading[b] - heading[a], gap * spacing, felt)

    speed = np.abs(velocity)
    fast = speed > _FAST
    found = None
    if np.count_nonzero(fast) > 1:
        heading, moved = _at_imu(t, velocity, fast, gps, signals.place)
        middle = np.exp(-0.5j * (heading[last] + heading[first]))
        found = between((moved[last] - moved[first]) * middle, heading, fast[first] & fast[last])
    if found is None or not found.excited:
        moving = speed > _MOVING
        if np.count_nonzero(moving) < 2:
            return []
        heading = np.interp(t, t[moving], np.unwrap(np.angle(velocity[moving])))
        across = np.abs(heading[last] - heading[first]) * speed[first] / np.maximum(t[last] - t[first], 1e-9)
        straight = moving[first] & moving[last] & (across < _STRAIGHT)
        found = between((speed[last] - speed[first]).astype(complex), heading, straight)
    if not found.excited:
        return []
    return _with_hills(drive, ground, found)


def _with_hills(drive: Drive, ground: GnssMotion, found: _Changes) -> list[_Changes]:
    """The candidates with gravity's part on hills, felt ahead: surely where the receiver vouches for its heights."""
    t = ground.t
    slope = ground.slope(t, drive.fix)
    if slope is None:
        return [found]
    climbed = _integral(t, (G * np.sin(slope)).astype(complex)).real
    hills = np.interp(found.end, t, climbed) - np.interp(found.start, t, climbed)
    known = drive.fix.sigma[np.isfinite(drive.fix.sigma[:, 2]), 2]
    felt = replace(found, path=found.path + hills)
    return [felt] if known.size and float(np.median(known)) <= LEVEL else [found, felt]


def _at_imu(
    t: Floats, velocity: Complexes, fast: NDArray[np.bool_], gps: Place, imu: Place
) -> tuple[Floats, Complexes]:
    """(m,) rad of the heading, and (m,) m/s of the IMU's place, by the antenna's ``velocity``: its course is not the
    vehicle's where it sits ahead of the rear axle."""
    antenna, sensor = (complex(place.position[0], place.position[1]) for place in (gps, imu))
    own = velocity
    for _ in range(3):
        heading = np.interp(t, t[fast], np.unwrap(np.angle(own[fast])))
        turning = 1.0j * np.gradient(heading, t) * np.exp(1.0j * heading)
        own = velocity - antenna * turning
    return heading, velocity + (sensor - antenna) * turning


def consistency(drive: Drive, signals: ImuSignals, gps: Place) -> Consistency | None:
    """Compare IMU and GNSS; None where the drive has too little planar acceleration."""
    best = _likeliest(_changes(drive, signals, gps))
    return None if best is None else _compared(best)


@dataclass(frozen=True, eq=False)
class _Likeliest:
    """``changes`` with the lags of their largest correlations, ``plain`` and ``mirrored``."""

    changes: _Changes
    plain: _Lag
    mirrored: _Lag

    @property
    def value(self) -> float:
        """The largest correlation."""
        return max(abs(self.plain.value), abs(self.mirrored.value))


def _likeliest(candidates: Sequence[_Changes]) -> _Likeliest | None:
    """The candidate that correlates most."""
    known = [_Likeliest(one, *_best_lag(one)) for one in candidates]
    return max(known, key=lambda one: one.value, default=None)


def _compared(found: _Likeliest) -> Consistency | None:
    plain, mirrored = found.plain, found.mirrored
    # mirrored axes may also correlate by chance at a long lag
    better = abs(mirrored.value) - abs(plain.value)
    handed = better > _LEAST_MARGIN or (
        better > 0.0 and abs(mirrored.lag) <= _CLOCK_OFFSET_ERROR < abs(plain.lag)
    )
    best = mirrored if handed else plain
    if abs(best.value) < _LEAST_CORRELATION:
        return None
    yaw = 0.0 if handed else float(-np.angle(best.value))
    return Consistency(best.lag, best.sigma, yaw, handed, found.changes.reversed(best.lag))


def _yaw_change(changes: _Changes) -> tuple[float, float] | None:
    """Moment in s and angle in rad of a turn of the sensor about the vertical: where the sums of f conj(p) before and
    after, each along its own angle, explain most."""
    best, found = 0.0, None
    for lag in np.arange(-_CLOCK_OFFSET_ERROR, _CLOCK_OFFSET_ERROR + _FAR_STEP / 2, _FAR_STEP).tolist():
        both = changes.at(lag, _LONG_SECONDS)
        if both is None:
            continue
        inside, p, f = both
        product, energy = (
            np.cumsum(f * p.conj()),
            np.cumsum(np.stack([np.abs(p) ** 2, np.abs(f) ** 2]), axis=1),
        )
        total = np.abs(product) + np.abs(product[-1] - product)
        few = math.ceil(_LEAST_SECONDS / changes.step)  # one stop shows no mounting
        total[:few] = total[-few:] = 0.0
        i = int(np.argmax(total))
        if total[i] <= best:
            continue
        best, found = float(total[i]), None
        sides = [
            (product[i], energy[:, i], i + 1),
            (product[-1] - product[i], energy[:, -1] - energy[:, i], p.size - i - 1),
        ]
        share = min(float(e[0]) for _, e, _ in sides) / float(energy[0, -1])
        alike = np.array([max(abs(s), 1e-6) / math.sqrt(max(float(e[0] * e[1]), 1e-12)) for s, e, _ in sides])
        count = np.array([n for *_, n in sides]) * changes.independent / changes.start.size
        angle = float(np.angle(sides[0][0] * np.conj(sides[1][0])))
        spread = math.sqrt(float(np.sum((1.0 - alike**2) / (2.0 * count * alike**2))))
        if alike.min() > _LEAST_CORRELATION and share > _LEAST_SHARE and abs(angle) > _SURE * spread:
            found = float(changes.start[inside][i]), angle
    return found if found is not None and abs(found[1]) > _TURNED else None


@dataclass(frozen=True)
class _Lag:
    """A ``lag`` s, known to ``sigma`` s, and the correlation there."""

    lag: float
    sigma: float
    value: complex


def _best_lag(changes: _Changes) -> tuple[_Lag, _Lag]:
    """The lags of felt against path with the largest correlations, as it is and mirrored."""
    reach = min(_LARGEST_LAG, float(changes.end[-1] - changes.start[0]))
    near = _steps(_CLOCK_OFFSET_ERROR, _NEAR_STEP)
    far = _steps(reach, _FAR_STEP)
    far = far[np.abs(far) > _CLOCK_OFFSET_ERROR + 0.5 * _FAR_STEP]
    # of the many long lags one fits a few seconds of driving by chance
    here = np.array([changes.correlations(lag, _LEAST_SECONDS) for lag in near.tolist()])
    there = np.array([changes.correlations(lag, _LONG_SECONDS) for lag in far.tolist()]).reshape(-1, 2)
    found = []
    for k in range(2):
        best = _peak(changes, near, here[:, k])
        if far.size and np.abs(there[:, k]).max() - abs(best.value) >= _LEAST_MARGIN:
            best = _peak(changes, far, there[:, k])
        found.append(best)
    return found[0], found[1]


def _steps(reach: float, step: float) -> Floats:
    count = int(reach / step)
    return step * np.arange(-count, count + 1, dtype=float)


def _peak(changes: _Changes, lags: Floats, values: Complexes) -> _Lag:
    """The largest correlation, its lag by a parabola, and the width of its likelihood."""
    size = np.abs(values)
    best = int(np.argmax(size))
    lag = float(lags[best])
    if 0 < best < size.size - 1:
        left, middle, right = size[best - 1 : best + 2].tolist()
        between = 0.5 * (right - left) / max(2.0 * middle - left - right, 1e-9)
        lag += min(max(between, -0.5), 0.5) * float(lags[best + 1] - lags[best])
    fit = -changes.independent * np.log1p(-(np.minimum(size, 1.0 - 1e-9) ** 2))
    weight = np.exp(fit - fit[best])
    return _Lag(lag, float(np.sqrt((weight @ (lags - lag) ** 2) / weight.sum())), complex(values[best]))


def yaw_beyond(drive: Drive, signals: ImuSignals, gps: Place) -> float:
    """Yaw in rad of the sensor against its mounting, where beyond ``_TURNED``; else 0."""
    known = consistency(drive, signals, gps)
    return known.yaw if known is not None and abs(known.yaw) > _TURNED else 0.0


def clock_offset_beyond(drive: Drive, signals: ImuSignals, gps: Place) -> float:
    """Clock offset in s of the IMU against the receiver, where beyond ``_CLOCK_OFFSET``; else 0."""
    known = consistency(drive, signals, gps)
    return known.clock_offset if known is not None and abs(known.clock_offset) > _CLOCK_OFFSET else 0.0


def findings(drive: Drive, signals: ImuSignals, gps: Place) -> list[Finding]:
    """Findings for the user, one line each, of which some exclude others."""
    found: list[Finding] = []
    largest = float(np.percentile(np.linalg.norm(signals.rate, axis=1), 99))
    if largest > _LARGEST_RATE:
        text = f"the gyro reads more than {largest:.0f} rad/s for a hundredth of the drive: are its rates in °/s?"
        return [Finding("error", "rates_unknown", text)]
    if fault := velocity_fault(drive.fix, drive.velocity):
        return [Finding("error", "speed", fault)]
    best = _likeliest(_changes(drive, signals, gps))
    change = None if best is None else _yaw_change(best.changes)
    if change is not None:
        text = (
            f"by braking and turning the sensor turned in its holder by {math.degrees(change[1]):.0f}° about the "
            f"vertical at {change[0] - signals.t[0]:.1f} s: cut the drive there"
        )
        return [*found, Finding("error", "swivelled", text)]
    known = None if best is None else _compared(best)
    if known is None:
        return found
    if known.mirrored:
        text = "the lateral acceleration of the IMU is opposite to that of the path: its axes are mirrored, invert one"
        found.append(Finding("error", "mirrored", text))
    if known.reversed:
        text = "the gyro turns the other way about the vertical than the path: turn the sign of its rates"
        found.append(Finding("error", "reversed", text))
    if abs(known.clock_offset) > _CLOCK_OFFSET:
        after = "after" if known.clock_offset > 0 else "before"
        far = abs(known.clock_offset) > _CLOCK_OFFSET_ERROR
        seconds = f"{abs(known.clock_offset):.1f} s"
        text = f"the IMU's stamps are about {seconds} {after} the receiver's: give both one clock"
        found.append(
            Finding("error" if far else "warn", "clocks", text + (f" ({_LEAP_SECONDS})" if far else ""))
        )
    if abs(known.yaw) > _TURNED:
        tilted = any(f.code == "tilted" for f in signals.findings)
        upright = level_rpy(signals.up[signals.standing].mean(axis=0)) if tilted else (0.0, 0.0, 0.0)
        turn = rpy_matrix((0.0, 0.0, known.yaw)) @ rpy_matrix(upright)
        roll, pitch, yaw = matrix_rpy(turn @ rpy_matrix(signals.place.rpy))
        text = (
            f"by braking and turning the sensor is turned by {math.degrees(known.yaw):.0f}° about the vertical against "
            f"imu.rpy of the twin file: if it is the mount, set imu.rpy: [{roll:.4f}, {pitch:.4f}, {yaw:.4f}]"
        )
        found.append(Finding("warn", "facing", text))
    return found
