# SPDX-License-Identifier: Apache-2.0
"""The virtual sensor: an ideal accelerometer and gyroscope at a place on the body.

The body is rigid, its attitude yaw-pitch-roll (z-y-x Euler angles) with yaw and the planar motion
given, its sprung centre of gravity at the simulated height. What moves as the planar motion says is
the point of the body above base_link's origin at the height of the centre of gravity: no force of
the road holds a body at its foot while it rolls and pitches, it turns about its centre of gravity. With
``p = Ry(pitch) Rx(roll) s`` the place seen from that point in the yaw frame, the acceleration is
the point's, plus ``p''``, plus Euler, Coriolis and centripetal terms of the yaw rate; specific
force is that plus g upwards, turned into the body's axes. Angles are finite throughout.
"""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import inlined
from suspension_twin.models import rows
from suspension_twin.models.rows import WIDTH, fma, sin_cos
from suspension_twin.units import STANDARD_GRAVITY as G

__all__ = ["rotation", "sense", "to_sensor_axes"]


@inlined
def sense(w: Floats, lane: int, ax: float, ay: float, yaw_rate: float, yaw_acceleration: float) -> None:
    """Write the readings of one lane's sensor into the block's signal rows."""
    roll, pitch = w[rows.ROLL * WIDTH + lane], w[rows.PITCH * WIDTH + lane]
    droll, dpitch = w[rows.ROLL_RATE * WIDTH + lane], w[rows.PITCH_RATE * WIDTH + lane]
    ddheave = w[rows.ACCELERATION * WIDTH + lane]
    ddroll, ddpitch = w[rows.ROLL_ACCELERATION * WIDTH + lane], w[rows.PITCH_ACCELERATION * WIDTH + lane]
    sx = w[rows.SENSOR * WIDTH + lane]
    sy = w[(rows.SENSOR + 1) * WIDTH + lane]
    sz = w[(rows.SENSOR + 2) * WIDTH + lane]
    above = sz - w[rows.HEIGHT * WIDTH + lane]
    sr, cr = sin_cos(roll)
    sp, cp = sin_cos(pitch)

    # place in the yaw frame and its derivatives by roll (r) and pitch (p)
    up = fma(sr, sy, cr * above)
    px, py, pz = fma(cp, sx, sp * up), fma(cr, sy, -(sr * above)), fma(cp, up, -(sp * sx))
    side = py  # d(up)/d(roll)
    rate_rr, rate_rp, rate_pp = droll * droll, 2.0 * droll * dpitch, dpitch * dpitch
    vx = fma(dpitch, pz, droll * (sp * side))
    vy = -(droll * up)
    bx = fma(
        ddpitch, pz, fma(ddroll, sp * side, fma(rate_rp, cp * side, -fma(rate_pp, px, rate_rr * (sp * up))))
    )
    by = -fma(ddroll, up, rate_rr * py)

    # vertically the sprung centre of gravity is what the model moves: place relative to it
    ex = sx - w[rows.SPRUNG * WIDTH + lane]
    ey = sy - w[(rows.SPRUNG + 1) * WIDTH + lane]
    ez = sz - w[(rows.SPRUNG + 2) * WIDTH + lane]
    eup, eside = fma(sr, ey, cr * ez), fma(cr, ey, -(sr * ez))
    esx, esz = fma(cp, ex, sp * eup), fma(cp, eup, -(sp * ex))
    bz = fma(
        ddroll,
        cp * eside,
        -fma(ddpitch, esx, fma(rate_rp, sp * eside, fma(rate_pp, esz, rate_rr * (cp * eup)))),
    )

    yaw2 = yaw_rate * yaw_rate
    fx = ax + fma(-yaw2, px, fma(-yaw_acceleration, py, fma(-2.0 * yaw_rate, vy, bx)))
    fy = ay + fma(-yaw2, py, fma(yaw_acceleration, px, fma(2.0 * yaw_rate, vx, by)))
    fz = ddheave + bz + G

    lift = fma(sp, fx, cp * fz)
    z = fma(cr, lift, -(sr * fy))
    w[rows.SIGNAL * WIDTH + lane] = fma(cp, fx, -(sp * fz))
    w[(rows.SIGNAL + 1) * WIDTH + lane] = fma(cr, fy, sr * lift)
    w[(rows.SIGNAL + 2) * WIDTH + lane] = z
    w[(rows.SIGNAL + 3) * WIDTH + lane] = fma(-yaw_rate, sp, droll)
    w[(rows.SIGNAL + 4) * WIDTH + lane] = fma(yaw_rate * cp, sr, dpitch * cr)
    w[(rows.SIGNAL + 5) * WIDTH + lane] = fma(yaw_rate * cp, cr, -(dpitch * sr))
    w[(rows.SIGNAL + 6) * WIDTH + lane] = fma(-G * cp, cr, z)


def rotation(rpy: tuple[float, float, float]) -> Floats:
    """(3, 3) matrix that takes vectors from a frame placed with ``rpy`` rad into its parent."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def to_sensor_axes(vectors: Floats, rpy: tuple[float, float, float]) -> Floats:
    """``vectors`` (..., 3) given in base_link axes, in the axes of a sensor mounted with ``rpy`` rad."""
    out: Floats = vectors @ rotation(rpy)
    return out
