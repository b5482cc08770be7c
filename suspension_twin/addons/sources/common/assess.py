# SPDX-License-Identifier: Apache-2.0
"""Assessment of arriving samples: rate, units, gravity, mounting, accuracy of the receiver, use for a calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.checks import Gravity, gravity_of, rhythm_of
from suspension_twin.drive.types import FixData, ImuData, VelocityData
from suspension_twin.drive.units import Units, rates_in_degrees, recognise_units, windowed
from suspension_twin.signals.attitude import level_rpy
from suspension_twin.signals.checks import (
    Finding,
    check_axes,
    check_rate,
    check_rate_units,
    check_units,
    told,
)
from suspension_twin.signals.imu import StillLimits, standstill_mask, white_noise

__all__ = ["assess", "verdict"]

#: Standard deviation in m up to which a position tells where on a bump (0.9 m long in the car paper) a wheel is.
_ON_A_BUMP: Final = 0.1
#: Units of acceleration that show gravity, as they are written.
_UNIT: Final[dict[Units, str]] = {"m/s2": "m/s²", "g": "g"}
#: How a phone with this axis upwards is held; x to the right of its screen, y up, z out of it.
_HELD: Final = {
    "+y": "upright",
    "-y": "upside down (or its signs are those of iOS)",
    "+z": "lying face up",
    "-z": "lying face down (or its signs are those of iOS)",
    "+x": "on its left side",
    "-x": "on its right side",
}


def assess(imu: ImuData, fix: FixData, velocity: VelocityData, missing: str = "") -> list[Finding]:
    """Findings on some seconds of samples, a line each; ``missing`` says why there are no IMU samples, if that is
    known."""
    return [*_imu(imu, velocity, missing), *_positions(fix, velocity)]


def _imu(imu: ImuData, velocity: VelocityData, missing: str) -> list[Finding]:
    if len(imu) < 50:
        text = f"IMU: no samples; {missing or 'switch accelerometer and gyroscope on'}"
        return [Finding("error", "no_imu", text)]
    order = np.argsort(imu.t, kind="stable")
    t, force, rate = imu.t[order], imu.specific_force[order], imu.angular_rate[order]
    rhythm, gravity, units = rhythm_of(t), gravity_of(force), recognise_units(force)
    gaps = f"{len(rhythm.gaps)} gaps, the longest {rhythm.longest_gap:.2f} s" if rhythm.gaps else "no gaps"
    per_second = (rhythm.count - 1) / rhythm.duration if rhythm.duration else 0.0
    found = [Finding("ok", "rate", f"IMU: {rhythm.rate:.1f} Hz, {gaps}")]
    wrong = [check_rate(rhythm.rate), check_units(units, gravity.size)]
    if (np.diff(t) > 0).any():
        wrong.append(check_rate_units(rates_in_degrees(windowed(t, force, rate), velocity), True))
    if not rhythm.gaps and per_second < 0.9 * rhythm.rate:
        wrong.append(
            Finding("warn", "lossy", f"IMU: {per_second:.1f} samples a second arrive, some are lost")
        )
    found.append(
        Finding(
            "ok",
            "gravity",
            f"units: {_UNIT.get(units, units)}; {_size(units, gravity)}",
        )
    )
    speed = None
    if len(velocity) > 1:
        speed = np.interp(t, velocity.t, np.hypot(velocity.enu[:, 0], velocity.enu[:, 1]))
    usable = 10.0 < rhythm.rate < 4000.0
    still = (
        standstill_mask(rhythm.rate, force, rate, StillLimits(), speed)
        if usable
        else np.zeros(len(t), dtype=np.bool_)
    )
    if units in _UNIT:
        found.append(_mounting(gravity_of(force[still]) if still.any() else gravity, force[still]))
    if still.any():
        noise = white_noise(force[still])
        found.append(Finding("ok", "still", f"standing still: noise {noise:.3f} m/s² on each axis"))
    else:
        found.append(Finding("ok", "moving", "moving: stand still for some seconds before you drive off"))
    return told([*found, *(f for f in wrong if f is not None), *check_axes(force, rate)])


def _size(units: Units, gravity: Gravity) -> str:
    if units == "gravity removed":
        return f"mean {gravity.size:.2f} m/s², no gravity"
    return f"gravity {gravity.size:.2f}{f' {_UNIT[units]}' if units in _UNIT else ''} on {gravity.axis}"


def _mounting(gravity: Gravity, at_rest: Floats) -> Finding:
    """How the phone is held; its roll and pitch only ``at_rest`` (n, 3), because bends and brakes tilt as well."""
    text = f"mounting: {_HELD[gravity.axis]}"
    if len(at_rest):
        roll, pitch, _ = level_rpy(at_rest.mean(axis=0))
        text += (
            f", {math.degrees(gravity.tilt):.0f}° off that axis; in the twin file imu.rpy: [{roll:.3f}, {pitch:.3f}, "
            "0] (its third number, the direction, is not seen at rest)"
        )
    return Finding("warn" if gravity.axis in ("-y", "-z") else "ok", "mounting", text)


def _positions(fix: FixData, velocity: VelocityData) -> list[Finding]:
    valid = fix.select(fix.status >= 0)
    if not len(valid):
        return [
            Finding(
                "warn",
                "no_fix",
                "positions: none yet; the receiver needs the open sky, some minutes at first",
            )
        ]
    rhythm = rhythm_of(np.sort(valid.t))
    known = valid.sigma[np.isfinite(valid.sigma[:, 0]), 0]
    rate = f"{rhythm.rate:.3g} Hz" if rhythm.rate else "the first"
    if not known.size:
        text = f"positions: {rate}, without their accuracy"
        found = [Finding("warn", "accuracy", text)]
    else:
        sigma = float(np.median(known))
        level: Literal["ok", "warn"] = "ok" if sigma <= _ON_A_BUMP else "warn"
        found = [Finding(level, "accuracy", f"positions: {rate}, standard deviation {sigma:.2g} m")]
    if not len(velocity):
        found.append(
            Finding(
                "warn", "no_velocity", "velocity: none; it is derived from the positions, which is rougher"
            )
        )
    else:
        speed = float(np.hypot(velocity.enu[-1, 0], velocity.enu[-1, 1]))
        found.append(Finding("ok", "velocity", f"velocity: {speed:.1f} m/s"))
    return found


def verdict(found: Sequence[Finding]) -> Finding:
    """Whether a calibration can be made of this, in one line."""
    errors = [f for f in found if f.level == "error"]
    if errors:
        return Finding("error", "verdict", f"for a calibration: no, {errors[0].text}")
    codes = {f.code: f for f in found}
    if "no_fix" in codes:
        return Finding("error", "verdict", "for a calibration: not yet, no position; the IMU will do")
    if codes["accuracy"].level != "ok":
        text = (
            "for a calibration: on a smooth or periodic road; over a single bump the position is too rough to say "
            "where a wheel is, RTK would (a calibration also searches the shift of the whole road)"
        )
        return Finding("warn", "verdict", text)
    return Finding("ok", "verdict", "for a calibration: yes")
