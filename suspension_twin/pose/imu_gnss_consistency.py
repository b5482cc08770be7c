# SPDX-License-Identifier: Apache-2.0
"""IMU/GNSS consistency: clock offset, yaw of the mounting, mirrored axes, sign and unit of the gyro.

Planar acceleration a of the GNSS path and specific force f of the IMU, both as complex numbers (forward + 1j left),
have the correlation

    c(k) = sum f(n + k) conj(a(n)) / (|f| |a|),

whose magnitude does not depend on the yaw of the sensor. The lag of the largest |c| is the clock offset, and the
angle of c there the yaw of the mounting. For left-handed sensor axes the conjugate of f correlates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.received import velocity_fault
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.pose.satellites import RATE, satellite_motion
from suspension_twin.signals.attitude import matrix_rpy, rpy_matrix
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.offline import ImuSignals, gnss_motion
from suspension_twin.vehicle.twin import Datum, Place

__all__ = ["Consistency", "clock_offset_beyond", "consistency", "findings", "yaw_beyond"]

Complexes = NDArray[np.complex128]

_LARGEST_LAG = 40.0  # s
#: Least correlation of a result, and by how much that of a long lag has to exceed that of the short ones.
_LEAST_CORRELATION, _LEAST_MARGIN = 0.75, 0.15
_LEAST = 0.2  # m/s² rms of the path's acceleration
#: Of a drive too slow for a course: m/s from which it moves, m/s² across up to which it goes straight on, a low-pass.
_MOVING, _STRAIGHT, _SLOW = 0.8, 0.3, FilterSpec(2, 0.8)
#: Limits in s and rad from which on a finding is reported, and clock offset in s from which on it is an error.
_CLOCK_OFFSET, _TURNED, _CLOCK_OFFSET_ERROR = 0.3, 0.35, 2.0
#: Share of the path's squared acceleration that lies on either side of a turn of the sensor at least.
_LEAST_SHARE = 0.15
#: Least rms yaw rate in rad/s for a check of the sign of the gyro.
_LEAST_YAW_RATE = 0.02
#: Largest plausible 99th percentile of the rate in rad/s; in °/s any drive exceeds it.
_LARGEST_RATE = 4.0
_LEAP_SECONDS = "GPS time is 18 s ahead of UTC"


@dataclass(frozen=True)
class Consistency:
    """``clock_offset`` s of the IMU stamps against those of the receiver (positive: later); ``yaw`` rad of the sensor
    against the mounting of the twin file, 0 where its axes are ``mirrored``; ``reversed``: the yaw rate has the wrong
    sign."""

    clock_offset: float
    yaw: float
    mirrored: bool = False
    reversed: bool = False


@dataclass(frozen=True, eq=False)
class _Pair:
    """Both signals at RATE Hz: ``t`` (n,) s, ``force`` of the IMU and ``path`` acceleration of the receiver as complex
    numbers, ``rates`` (n, 2) about the vertical of IMU and path, and where they are ``used``."""

    t: Floats
    force: Complexes
    path: Complexes
    rates: Floats
    used: NDArray[np.bool_]


def _pair(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> _Pair | None:
    """Both signals; None where the drive has too little planar acceleration."""
    try:
        slow, path = satellite_motion(drive, signals, gps, datum)
    except InputError:
        return _pair_by_speed(drive, signals)
    # the mean is removed instead of gravity, whose direction a gyro in wrong units would spoil
    force = slow.force @ np.array([1.0, 1.0j, 0.0])
    rates = np.column_stack([slow.rate[:, 2], path.yaw_rate])
    pair = _Pair(
        slow.t, force, path.acceleration[:, 0] + 1.0j * path.speed * path.yaw_rate, rates, path.valid
    )
    return _excited(pair) or _pair_by_speed(drive, signals)


def _pair_by_speed(drive: Drive, signals: ImuSignals) -> _Pair | None:
    """Of a drive too slow for a course: the change of its speed alone, which is ahead, where it goes straight on."""
    ground = gnss_motion(drive)
    if not ground.known or signals.rate_hz < 2.0 * RATE:
        return None
    t = np.arange(signals.t[0], signals.t[-1], 1.0 / RATE)
    slow = zero_phase(_SLOW, signals.rate_hz, np.column_stack([signals.rate[:, 2], signals.force[:, :2]]))
    turn, x, y = (np.interp(t, signals.t, column) for column in slow.T)
    speed = np.nan_to_num(ground.least_speed(t))
    ahead = ground.acceleration(t, np.zeros(t.size), (0.0, 0.0, 0.0))[:, 0]
    used = (speed > _MOVING) & (np.abs(speed * turn) < _STRAIGHT)
    return _excited(_Pair(t, x + 1.0j * y, ahead.astype(complex), np.column_stack([turn, 0.0 * turn]), used))


def _excited(pair: _Pair) -> _Pair | None:
    """The pair with the path free of its mean; None where there is too little of it."""
    used = pair.used
    if np.count_nonzero(used) < 5 * RATE:
        return None
    path = np.where(used, pair.path, 0.0)
    path[used] -= path[used].mean()
    enough = math.sqrt(float(np.mean(np.abs(path[used]) ** 2))) >= _LEAST
    return replace(pair, path=path) if enough else None


def consistency(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> Consistency | None:
    """Compare IMU and GNSS; None where the drive has too little planar acceleration."""
    pair = _pair(drive, signals, gps, datum)
    return None if pair is None else _compared(pair)


def _compared(pair: _Pair) -> Consistency | None:
    plain, mirrored = (_best_delay(p, pair.path, pair.used) for p in (pair.force, pair.force.conj()))
    # mirrored axes may also correlate by chance at a long lag
    better = abs(mirrored[1]) - abs(plain[1])
    handed = better > _LEAST_MARGIN or (
        better > 0.0 and abs(mirrored[0]) <= _CLOCK_OFFSET_ERROR < abs(plain[0])
    )
    clock_offset, value = mirrored if handed else plain
    if abs(value) < _LEAST_CORRELATION:
        return None
    yaw = 0.0 if handed else float(-np.angle(value))
    return Consistency(
        clock_offset, yaw, handed, _reversed(pair.rates, pair.used, round(clock_offset * RATE))
    )


def _yaw_change(pair: _Pair) -> tuple[float, float] | None:
    """Moment in s and angle in rad of a turn of the sensor about the vertical: where the sums of f conj(a) before and
    after, each along its own angle, explain most."""
    most, best, found = min(round(_CLOCK_OFFSET_ERROR * RATE), pair.path.size - 1), 0.0, None
    for k in range(-most, most + 1):
        own = np.flatnonzero(pair.used)
        own = own[(own + k >= 0) & (own + k < pair.path.size)]
        if own.size < 10 * RATE:
            continue
        a, f = pair.path[own], pair.force[own + k] - pair.force[own + k].mean()
        product, energy = (
            np.cumsum(f * a.conj()),
            np.cumsum(np.stack([np.abs(a) ** 2, np.abs(f) ** 2]), axis=1),
        )
        total = np.abs(product) + np.abs(product[-1] - product)
        i = int(np.argmax(total))
        if total[i] <= best:
            continue
        best, found = float(total[i]), None
        sides = [(product[i], energy[:, i]), (product[-1] - product[i], energy[:, -1] - energy[:, i])]
        share = min(float(e[0]) for _, e in sides) / float(energy[0, -1])
        sure = all(abs(p) > _LEAST_CORRELATION * math.sqrt(max(float(e[0] * e[1]), 1e-12)) for p, e in sides)
        if sure and share > _LEAST_SHARE:
            found = float(pair.t[own[i]]), float(np.angle(sides[0][0] * np.conj(sides[1][0])))
    return found if found is not None and abs(found[1]) > _TURNED else None


def _best_delay(force: Complexes, reference: Complexes, used: NDArray[np.bool_]) -> tuple[float, complex]:
    """Lag in s of the force against the path with the largest correlation, and the correlation there."""
    most = min(round(_LARGEST_LAG * RATE), reference.size - 1)
    reach = min(round(_CLOCK_OFFSET_ERROR * RATE), most)
    # of the many long lags one fits a few seconds of driving by chance
    values = np.array(
        [
            _correlation(force, reference, used, k, 5.0 if abs(k) <= reach else 10.0)
            for k in range(-most, most + 1)
        ]
    )
    size = np.abs(values)
    best = int(np.argmax(size))
    near = most - reach + int(np.argmax(size[most - reach : most + reach + 1]))
    if size[best] - size[near] < _LEAST_MARGIN:
        best = near
    between = 0.0
    if 0 < best < size.size - 1:
        left, middle, right = size[best - 1 : best + 2]
        between = float(np.clip(0.5 * (right - left) / max(2.0 * middle - left - right, 1e-9), -0.5, 0.5))
    return (best - most + between) / RATE, complex(values[best])


def _reversed(rates: Floats, used: NDArray[np.bool_], k: int) -> bool:
    """Whether the first of the yaw ``rates`` (n, 2) rad/s, ``k`` samples later, surely has the opposite sign of the
    second, the path's."""
    rate, reference = rates.T
    if math.sqrt(float(np.mean(reference[used] ** 2))) < _LEAST_YAW_RATE:
        return False
    return _correlation(rate.astype(complex), reference.astype(complex), used, k).real < -_LEAST_CORRELATION


def _correlation(
    force: Complexes, reference: Complexes, used: NDArray[np.bool_], k: int, seconds: float = 5.0
) -> complex:
    """Correlation of the ``force``, ``k`` samples later, with the path; 0 where they overlap by less than half of its
    energy, or by less than as many ``seconds``."""
    first, last = max(-k, 0), min(reference.size - k, reference.size)
    own = np.flatnonzero(used[first:last]) + first
    a, p = reference[own], force[own + k]
    if own.size < seconds * RATE or np.linalg.norm(a) ** 2 < 0.5 * np.linalg.norm(reference) ** 2:
        return 0.0j
    a, p = a - a.mean(), p - p.mean()
    return complex(np.sum(p * a.conj()) / max(float(np.linalg.norm(a) * np.linalg.norm(p)), 1e-12))


def yaw_beyond(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> float:
    """Yaw in rad of the sensor against its mounting, where beyond ``_TURNED``; else 0."""
    known = consistency(drive, signals, gps, datum)
    return known.yaw if known is not None and abs(known.yaw) > _TURNED else 0.0


def clock_offset_beyond(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> float:
    """Clock offset in s of the IMU against the receiver, where beyond ``_CLOCK_OFFSET``; else 0."""
    known = consistency(drive, signals, gps, datum)
    return known.clock_offset if known is not None and abs(known.clock_offset) > _CLOCK_OFFSET else 0.0


def findings(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> list[Finding]:
    """Findings for the user, one line each, of which some exclude others."""
    found: list[Finding] = []
    largest = float(np.percentile(np.linalg.norm(signals.rate, axis=1), 99))
    if largest > _LARGEST_RATE:
        text = f"the gyro reads more than {largest:.0f} rad/s for a hundredth of the drive: are its rates in °/s?"
        return [Finding("error", "rates_unknown", text)]
    if fault := velocity_fault(drive.fix, drive.velocity):
        return [Finding("error", "speed", fault)]
    pair = _pair(drive, signals, gps, datum)
    change = None if pair is None else _yaw_change(pair)
    if change is not None:
        text = (
            f"by braking and turning the sensor turned in its holder by {math.degrees(change[1]):.0f}° about the "
            f"vertical at {change[0] - signals.t[0]:.1f} s: cut the drive there"
        )
        return [*found, Finding("error", "swivelled", text)]
    known = None if pair is None else _compared(pair)
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
        roll, pitch, yaw = matrix_rpy(rpy_matrix((0.0, 0.0, known.yaw)) @ rpy_matrix(signals.place.rpy))
        text = (
            f"by braking and turning the sensor is turned by {math.degrees(known.yaw):.0f}° about the vertical against "
            f"imu.rpy of the twin file: if it is the mount, set imu.rpy: [{roll:.4f}, {pitch:.4f}, {yaw:.4f}]"
        )
        found.append(Finding("warn", "facing", text))
    return found
