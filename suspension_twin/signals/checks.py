# SPDX-License-Identifier: Apache-2.0
"""Plausibility checks of an IMU's signal: units, rate, mounting, dead axes, saturation."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.units import Units
from suspension_twin.signals.attitude import level_rpy, matrix_rpy, rpy_matrix, tilt_of
from suspension_twin.units import STANDARD_GRAVITY

__all__ = [
    "EXCLUDES",
    "MAX_RATE",
    "MIN_RATE",
    "Finding",
    "check_axes",
    "check_mounting",
    "check_rate",
    "check_rate_units",
    "check_units",
    "saturated_samples",
    "told",
]

MIN_RATE = 50.0
MAX_RATE = 1600.0
#: Codes of findings about the mounting by gravity, and by comparison with the path.
_OF_GRAVITY = frozenset({"upside_down", "axes_wrong", "tilted"})
_OF_MOTION = frozenset({"swivelled", "mirrored", "clocks", "reversed", "facing"})
_OF_ROAD = frozenset({"off_road"})
#: Full scales of the accelerometers in phones, m/s².
FULL_SCALES = tuple(STANDARD_GRAVITY * g for g in (2, 4, 8, 16))


@dataclass(frozen=True)
class Finding:
    """One thing noticed. ``level`` "ok", "warn" or "error" (the result cannot be trusted until it is put
    right), ``code`` a stable word, ``text`` one line: the fault and its remedy."""

    level: Literal["ok", "warn", "error"]
    code: str
    text: str


#: Which causes a finding leaves no room for: what it shows explains their signs, or takes the ground from under them,
#: so that advice about them would be wrong. One row a finding, by codes; a cause of a later row never excludes one of
#: an earlier row.
EXCLUDES: dict[str, frozenset[str]] = {
    # without gravity in m/s² there is no upright, and no acceleration to make or to compare a path with
    "units_unknown": _OF_GRAVITY | _OF_MOTION | _OF_ROAD,
    "gravity_removed": _OF_GRAVITY,
    # a gyroscope in another unit turns the vertical and the path
    "rates_unknown": _OF_GRAVITY | _OF_MOTION | _OF_ROAD,
    # a path of velocities that are none is no reference
    "speed": _OF_MOTION | _OF_ROAD | {"senses"},
    # two sensors that contradict each other show neither what is up nor a path
    "senses": _OF_GRAVITY | _OF_MOTION | _OF_ROAD,
    # a mounting that changes is none that imu.rpy could state
    "turning": _OF_GRAVITY | _OF_MOTION,
    "swivelled": _OF_MOTION - {"swivelled"},
    # axes that are not upright show no direction about the vertical
    "upside_down": _OF_MOTION - {"swivelled", "clocks"},
    "axes_wrong": _OF_MOTION - {"swivelled", "clocks"},
    # over a drive slopes and bends tilt the mean, too
    "no_standstill": frozenset({"tilted"}),
    # of mirrored axes sign and yaw have no meaning, and they bend the path
    "mirrored": frozenset({"reversed", "facing"}) | _OF_ROAD,
    # what is compared at the wrong time shows neither yaw nor standstill nor road
    "clocks": frozenset({"reversed", "facing", "tilted"}) | _OF_ROAD,
    # a path that is made with such a sensor leaves the road
    "reversed": frozenset({"facing"}) | _OF_ROAD,
    # its imu.rpy is upright as well
    "facing": frozenset({"tilted"}) | _OF_ROAD,
    # a map that starts anywhere is beside every road
    "no_datum": _OF_ROAD,
}


def told(findings: Iterable[Finding]) -> list[Finding]:
    """The findings without those that others among them exclude."""
    kept = list(findings)
    gone = frozenset[str]().union(*(EXCLUDES.get(f.code, frozenset()) for f in kept))
    return [f for f in kept if f.code not in gone]


def check_units(units: Units, length: float) -> Finding | None:
    """Finding about ``units``; ``length`` is that of the mean specific force as delivered."""
    if units == "g":
        return Finding(
            "warn", "units_g", f"accelerations come in g (mean {length:.2f}), taken times 9.80665: send m/s²"
        )
    if units == "gravity removed":
        return Finding(
            "warn",
            "gravity_removed",
            f"gravity is already removed (mean {length:.2f} m/s²), put back along z: send the raw accelerometer, "
            "not the linear acceleration",
        )
    if units == "unknown":
        return Finding(
            "error",
            "units_unknown",
            f"the mean acceleration is {length:.2f}, neither 9.81 m/s² nor 1 g nor 0: check units and scale",
        )
    return None


def check_rate_units(evidence: str, converted: bool) -> Finding | None:
    """Finding about angular rates in deg/s, with the ``evidence`` for it if there is any."""
    if not evidence:
        return None
    done = "taken times π/180" if converted else "not converted (convert_units)"
    return Finding(
        "warn" if converted else "error",
        "degrees" if converted else "rates_unknown",
        f"angular rates come in °/s, {done}: {evidence}; send rad/s",
    )


def check_rate(rate: float) -> Finding | None:
    """A rate that the contract does not allow (2 % aside)."""
    if rate < 0.98 * MIN_RATE:
        return Finding(
            "error",
            "rate_low",
            f"IMU samples come at {rate:.4g} Hz, too slow for wheel hop: record at {MIN_RATE:.0f} Hz or more",
        )
    if rate > 1.02 * MAX_RATE:
        return Finding(
            "error", "rate_high", f"IMU samples come at {rate:.5g} Hz: record at {MAX_RATE:.0f} Hz or less"
        )
    return None


def check_mounting(mean_force: Floats, rpy: tuple[float, float, float], small: float) -> Finding | None:
    """Is ``mean_force`` (3,), the specific force at rest in what the twin file calls ``base_link`` axes,
    upright? ``rpy`` is the file's; tilts up to ``small`` rad are accepted."""
    tilt = tilt_of(mean_force)
    if tilt <= small:
        return None
    roll, pitch, yaw = matrix_rpy(rpy_matrix(level_rpy(mean_force)) @ rpy_matrix(rpy))
    degrees = math.degrees(tilt)
    suggestion = f"imu.rpy: [{roll:.4f}, {pitch:.4f}, {yaw:.4f}]"
    if tilt > math.radians(150):
        return Finding(
            "error",
            "upside_down",
            f"the IMU reads {mean_force[2]:+.2f} m/s² along z at rest: it hangs upside down (or its signs are "
            f"reversed, as iOS has them); turn it over or set {suggestion}",
        )
    if tilt > math.radians(45):
        return Finding(
            "error",
            "axes_wrong",
            f"gravity lies {degrees:.0f}° off z: the sensor's axes are not as the twin file says; set {suggestion} "
            "(gravity does not determine its yaw)",
        )
    return Finding(
        "warn",
        "tilted",
        f"the IMU stands {degrees:.1f}° off upright (or the car parks on a slope); if it is the mount, "
        f"set {suggestion}",
    )


def check_axes(force: Floats, rate: Floats) -> list[Finding]:
    """Axes of ``force`` and ``rate`` (n, 3) that never change while others do."""
    found = []
    for values, name in ((force, "accelerometer"), (rate, "gyro")):
        still = np.ptp(values, axis=0) == 0.0
        if len(values) < 50:
            continue
        if still.all():
            word = "gives nothing" if not values.any() else f"is stuck at {values[0].tolist()}"
            found.append(Finding("error", f"{name}_dead", f"the {name} {word}: check the sensor"))
        elif still.any():
            axes = ", ".join("xyz"[k] for k in np.flatnonzero(still))
            found.append(
                Finding("error", f"{name}_axis_dead", f"{name} axis {axes} never changes: check the sensor")
            )
    return found


def saturated_samples(values: Floats, full_scale: float | None = None) -> NDArray[np.bool_]:
    """(n,) True where any axis of ``values`` (n, 3) sits at the end of its range.

    With ``full_scale`` given that is the range. Without, an axis clips where its extreme value comes,
    exactly, three times at least and more than twice as often as any of the five values next to it:
    neither noise nor the steps of a converter do that.
    """
    out = np.zeros(len(values), dtype=np.bool_)
    if not len(values):
        return out
    if full_scale is not None:
        return np.asarray(np.any(np.abs(values) >= 0.9995 * full_scale, axis=1))
    for axis in values.T:
        levels, counts = np.unique(axis, return_counts=True)
        if levels.size < 20:
            continue
        for extreme, count, beside in (
            (levels[-1], counts[-1], counts[-6:-1]),
            (levels[0], counts[0], counts[1:6]),
        ):
            if count >= 3 and count > 2 * beside.max():
                out |= axis == extreme
    return out
