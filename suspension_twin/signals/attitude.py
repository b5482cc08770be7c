# SPDX-License-Identifier: Apache-2.0
"""Which way is up: the direction of gravity in ``base_link`` from gyro and accelerometer.

The state is the unit vector ``up`` in ``base_link`` axes; at rest the specific force is g times
``up``. Yaw never enters, so there is nothing to initialise but the first accelerometer reading.
"""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.units import STANDARD_GRAVITY

__all__ = [
    "Quaternion",
    "carried_up",
    "level_rpy",
    "matrix_rpy",
    "normal_gravity",
    "quaternion",
    "quaternion_product",
    "rpy_matrix",
    "smooth_up",
    "tilt_of",
    "up_step",
]

#: x, y, z, w.
Quaternion = tuple[float, float, float, float]


def normal_gravity(latitude: float | None, height: float = 0.0) -> float:
    """Gravity in m/s² on WGS 84 at ``latitude`` degrees (Somigliana; NIMA TR8350.2 eq. 4-1) less the
    free-air gradient to ``height`` m; the standard 9.80665 where the latitude is not known."""
    if latitude is None:
        return STANDARD_GRAVITY
    s2 = math.sin(math.radians(latitude)) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / math.sqrt(1 - 0.00669437999014 * s2)
    return surface - 3.086e-6 * height


def quaternion_product(p: Quaternion, q: Quaternion) -> Quaternion:
    """The rotation ``q`` followed by ``p``."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )


def rpy_matrix(rpy: tuple[float, float, float]) -> Floats:
    """(3, 3) rotation from the sensor's axes to ``base_link`` for fixed-axis roll, pitch, yaw in rad."""
    cr, cp, cy = (math.cos(a) for a in rpy)
    sr, sp, sy = (math.sin(a) for a in rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix_rpy(matrix: Floats) -> tuple[float, float, float]:
    """Roll, pitch, yaw in rad of a rotation; yaw is 0 at gimbal lock."""
    sp = -float(matrix[2, 0])
    if abs(sp) > 1.0 - 1e-12:
        roll = math.atan2(-math.copysign(1.0, -sp) * float(matrix[0, 1]), float(matrix[1, 1]))
        return roll, math.copysign(math.pi / 2, sp), 0.0
    return (
        math.atan2(float(matrix[2, 1]), float(matrix[2, 2])),
        math.asin(sp),
        math.atan2(float(matrix[1, 0]), float(matrix[0, 0])),
    )


def level_rpy(force: Floats) -> tuple[float, float, float]:
    """Roll and pitch (yaw 0) of a sensor that reads ``force`` (3,) at rest: ``rpy_matrix`` of them
    turns that reading upright. Exactly upside down reads as a roll of pi."""
    x, y, z = (float(v) for v in force)
    return math.atan2(y, z) if math.hypot(y, z) > 1e-9 else 0.0, math.atan2(-x, math.hypot(y, z)), 0.0


def tilt_of(force: Floats) -> float:
    """Angle in rad between ``force`` (3,) and +z."""
    return math.atan2(math.hypot(float(force[0]), float(force[1])), float(force[2]))


@compiled
def up_step(
    up: Floats,
    bias: Floats,
    force: Floats,
    rate: Floats,
    dt: float,
    gravity: float,
    gain: float,
    bias_gain: float,
) -> None:  # pragma: no cover - compiled
    """Advance ``up`` (3,) and the gyro ``bias`` (3,) in place by ``dt`` s: Mahony's complementary filter
    ("Nonlinear complementary filters on the special orthogonal group", 2008, eq. 48) for one vector.

    ``force`` is the specific force less what the vehicle's own planar acceleration explains. A large
    disagreement is taken for such an acceleration, not for a tilt, and weighs less.
    """
    mx, my, mz = force[0] / gravity, force[1] / gravity, force[2] / gravity
    ex = my * up[2] - mz * up[1]
    ey = mz * up[0] - mx * up[2]
    ez = mx * up[1] - my * up[0]
    weight = gain / (1.0 + (ex * ex + ey * ey + ez * ez) / 0.01)
    wx = (rate[0] - bias[0] + weight * ex) * dt
    wy = (rate[1] - bias[1] + weight * ey) * dt
    wz = (rate[2] - bias[2] + weight * ez) * dt
    bias[0] -= bias_gain * weight * ex * dt
    bias[1] -= bias_gain * weight * ey * dt
    bias[2] -= bias_gain * weight * ez * dt
    # Rotate by minus the angle: what is fixed in the world turns backwards in the body.
    a2 = wx * wx + wy * wy + wz * wz
    s = 1.0 - a2 / 6.0
    c = 0.5 - a2 / 24.0
    if a2 > 0.0025:
        a = math.sqrt(a2)
        s = math.sin(a) / a
        c = (1.0 - math.cos(a)) / a2
    ux, uy, uz = up[0], up[1], up[2]
    dx = uy * wz - uz * wy
    dy = uz * wx - ux * wz
    dz = ux * wy - uy * wx
    x = ux + s * dx + c * (dy * wz - dz * wy)
    y = uy + s * dy + c * (dz * wx - dx * wz)
    z = uz + s * dz + c * (dx * wy - dy * wx)
    norm = math.sqrt(x * x + y * y + z * z)
    up[0], up[1], up[2] = x / norm, y / norm, z / norm


@compiled
def _run(
    t: Floats, force: Floats, rate: Floats, gravity: float, gain: Floats, bias_gain: float, start: Floats
) -> Floats:  # pragma: no cover - compiled
    """(n, 3) ``up`` along stamps that may run either way."""
    n = t.size
    out = np.empty((n, 3))
    up = np.empty(3)
    bias = np.zeros(3)
    middle = np.empty(3)
    for k in range(3):
        up[k] = out[0, k] = start[k]
    for i in range(1, n):
        dt = t[i] - t[i - 1]
        # Across a gap the gyro has no data; the accelerometer is used over at most half a second.
        if abs(dt) > 0.5:
            dt = math.copysign(0.5, dt)
        for k in range(3):
            middle[k] = 0.5 * (rate[i, k] + rate[i - 1, k])
        signed = gain[i] if dt > 0 else -gain[i]
        up_step(up, bias, force[i], middle, dt, gravity, signed, bias_gain if dt > 0 else -bias_gain)
        for k in range(3):
            out[i, k] = up[k]
    return out


def carried_up(
    t: Floats, force: Floats, rate: Floats, gravity: float, time_constant: Floats
) -> tuple[Floats, Floats]:
    """Two (n, 3) ``up``: carried forward from the first stamp, and backward from the last.

    ``t`` (n,) s strictly rising, ``force`` (n, 3) specific force less the vehicle's own planar
    acceleration, ``rate`` (n, 3) rad/s less its bias, ``time_constant`` (n,) s of the
    accelerometer against the gyro.
    """
    gain = 1.0 / time_constant
    begin = _start(t, force, rate, time_constant)
    last = _start(-t[::-1], force[::-1], -rate[::-1], time_constant[::-1])
    ahead = _run(t, force, rate, gravity, gain, 0.02, begin)
    back = _run(t[::-1].copy(), force[::-1].copy(), rate[::-1].copy(), gravity, gain[::-1].copy(), 0.02, last)
    return ahead, back[::-1]


def smooth_up(t: Floats, force: Floats, rate: Floats, gravity: float, time_constant: Floats) -> Floats:
    """(n, 3) ``up`` over a whole drive, the mean of :func:`carried_up`'s two, so without delay."""
    if t.size < 2:
        return np.tile([0.0, 0.0, 1.0], (t.size, 1))
    both = np.add(*carried_up(t, force, rate, gravity, time_constant))
    return np.asarray(both / np.linalg.norm(both, axis=1, keepdims=True), dtype=np.float64)


def _start(t: Floats, force: Floats, rate: Floats, time_constant: Floats) -> Floats:
    """A first ``up``: the force of half a second if the vehicle stands, else of a whole time constant,
    turned back to the first stamp."""
    brief = t - t[0] <= 0.5
    still = float(force[brief].std(axis=0).max()) < 0.15
    window = np.flatnonzero(brief if still else t - t[0] <= float(time_constant[0]))
    steps = np.diff(t[window], prepend=t[window[0]])[:, None]
    turned = np.cumsum(rate[window] * steps, axis=0)
    mean = np.mean(force[window] + np.cross(turned, force[window]), axis=0)
    norm = float(np.linalg.norm(mean))
    return mean / norm if norm > 1.0 else np.array([0.0, 0.0, 1.0])


def quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """x, y, z, w of fixed-axis roll, pitch, yaw in rad."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
