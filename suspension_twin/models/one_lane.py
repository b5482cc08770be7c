# SPDX-License-Identifier: Apache-2.0
"""One lane of a car's kernel by itself: its rows, and functions that start, advance and read it.

For code that walks one twin without this package, such as an FMU: the functions are made of those of the kernels, and
in the same part of Python, so that they can be written out in another language. ``WIDTH`` is 1 there: element r of
``w`` is row r. The whole-block kernels and these walk one interval by the same steps in the same order.

``road`` (4,) are heights in m, ``motion`` (6,) is ax, ay m/s², yaw rate rad/s, yaw acceleration rad/s², speed and
lateral speed m/s, as in :class:`~suspension_twin.models.types.Excitation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled_later, specialised
from suspension_twin.models import rows
from suspension_twin.models.constants import Conditions, constants
from suspension_twin.models.corner import (
    close_interval,
    move,
    open_interval,
    strut_forces,
    touch,
    tyre_forces,
    velocities,
)
from suspension_twin.models.curves import retable
from suspension_twin.models.equilibrium import stand
from suspension_twin.models.full_car import moments, watch, yaw_rate
from suspension_twin.models.full_car_effects import COMPLIANT, SOFT, effect_kernels
from suspension_twin.models.msd import corners, plane, stand_corners, weights, wheel
from suspension_twin.models.parameters import layout, pack
from suspension_twin.models.rows import WIDTH, fma, four, put, sin_cos
from suspension_twin.models.sensor import sense
from suspension_twin.vehicle.twin import Twin

__all__ = ["MOTION", "OneLane", "one_lane"]

#: Elements of ``motion``, as they are called in ``Excitation``.
MOTION = ("ax", "ay", "yaw_rate", "yaw_acceleration", "speed", "lateral_speed")

#: What each twin has of its own: hinges of a curve, first row of its curves, flags of its effects, tyre radius in m,
#: static equilibrium, and the terms of the stages with the flags of those that have one.
_HINGES = _CURVES = _FLAG = 0
_RADIUS = 0.0
_STAND: Any = stand
_DAMPERS = _STRUT = _TYRE = _BODY = _AFTER = _STAMP = _STAND
_DAMPERS_OF = _STRUT_OF = _TYRE_OF = _BODY_OF = _AFTER_OF = _STAMP_OF = 0


@dataclass(frozen=True, eq=False)
class OneLane:
    """One twin as one lane.

    Parameters
    ----------
    values
        (rows,) constants and states before the start.
    start
        ``start(w, road, motion)`` puts it in equilibrium.
    advance
        ``advance(w, n, h, road0, road1, motion0, motion1)`` walks an interval in n steps of h s; heights and motion run
        linearly from the first to the second.
    read
        ``read(w, motion, out)`` fills ``out`` with what ``models.connectors`` gives, columns in its order.
    outside
        Effects of the twin, by id, that act on the road, on the sensor's signals or on its clock, and so are not in it.
    """

    values: Floats
    start: Any
    advance: Any
    read: Any
    outside: tuple[str, ...]


def one_lane(twin: Twin, max_step: float) -> OneLane:
    """A car as one lane for steps of up to ``max_step`` s; InputError names the key of what cannot be simulated."""
    shape = layout(twin)
    known = constants(pack(twin)[:, None], shape, Conditions(max_step, actuated=True))
    known.problems.raise_first()
    given: dict[str, Any] = {"_HINGES": known.hinges, "_RADIUS": float(twin.vehicle.tyre.radius)}
    functions = _msd_start, _msd_advance, _msd_read
    if known.flags is not None:
        given |= {**effect_kernels().parts, "_FLAG": int(known.flags[0])}
        functions = _start, _advance, _read
    start, advance, read = (
        specialised(function, name, **given)
        for function, name in zip(functions, ("twin_start", "twin_advance", "twin_read"), strict=True)
    )
    inside = ("vehicle", "corners", "kernel")
    outside = [name for name, hook in shape.hooks.items() if all(getattr(hook, p) is None for p in inside)]
    return OneLane(np.ascontiguousarray(known.values[:, 0]), start, advance, read, tuple(outside))


def _start(w: Floats, road: Floats, motion: Floats) -> None:
    """Put the vehicle in equilibrium on four heights."""
    stride = 5 + 6 * _HINGES
    c0, c1, c2, c3 = _CURVES, _CURVES + stride, _CURVES + 2 * stride, _CURVES + 3 * stride
    for c in range(4):
        w[(rows.ROAD + c) * WIDTH] = road[c]
        w[(rows.ROAD_RATE + c) * WIDTH] = 0.0
    mx, my = moments(w, 0, motion[0], motion[1], motion[2] * motion[2], motion[3])
    _STAND(w, 0, mx, my, motion[4], motion[5], c0, c1, c2, c3, _HINGES)


@compiled_later
def _advance(
    w: Floats, n: int, h: float, road0: Floats, road1: Floats, motion0: Floats, motion1: Floats
) -> None:
    """Walk an interval in n steps of h s, from one road and motion to another."""
    stride = 5 + 6 * _HINGES
    beta, lag = rows.CORNER_IMPLICIT, rows.LAG
    c0, c1, c2, c3 = _CURVES, _CURVES + stride, _CURVES + 2 * stride, _CURVES + 3 * stride
    if _FLAG & (_DAMPERS_OF | COMPLIANT):
        put(w, rows.DAMPER_SHARE, 0, 1.0, 1.0, 1.0, 1.0)
        _DAMPERS(w, _FLAG, h)
        retable(w, h, _CURVES, _HINGES)
    mx, my = moments(w, 0, motion0[0], motion0[1], motion0[2] * motion0[2], motion0[3])
    to_x, to_y = moments(w, 0, motion1[0], motion1[1], motion1[2] * motion1[2], motion1[3])
    open_interval(w, 0, h, beta, beta + 1, beta + 2, beta + 3, mx, my, to_x - mx, to_y - my)
    for j in range(n):
        share = (j + 1.0) / n
        for c in range(4):
            z = road1[c] - (1.0 - share) * (road1[c] - road0[c])
            w[(rows.ROAD_RATE + c) * WIDTH] = (z - w[(rows.ROAD + c) * WIDTH]) / h
            w[(rows.ROAD + c) * WIDTH] = z
        w[rows.SPEED * WIDTH] = motion0[4] + (share - 0.5 / n) * (motion1[4] - motion0[4])
        w[rows.YAW_RATE * WIDTH] = yaw_rate(motion0[2], motion1[2], share)
        move(w, 0, h)
        strut_forces(w, 0, c0, c1, c2, c3, _HINGES)
        r0, r1, r2, r3 = four(w, rows.ROAD, 0)
        n0, n1, n2, n3 = tyre_forces(w, 0, r0, r1, r2, r3)
        put(w, rows.GROUND, 0, n0, n1, n2, n3)
        if _FLAG & SOFT:
            for c in range(4):
                w[(rows.GROUND + c) * WIDTH] *= 1.0 + w[(rows.TYRE_CHANGE + c) * WIDTH]
        if _FLAG & _STRUT_OF:
            _STRUT(w, _FLAG, h)
        if _FLAG & _TYRE_OF:
            _TYRE(w, _FLAG, h)
        n0, n1, n2, n3 = four(w, rows.GROUND, 0)
        velocities(w, 0, h, share, n0, n1, n2, n3, lag, lag + 1, lag + 2, lag + 3, c0, c1, c2, c3, _HINGES)
        if _FLAG & _BODY_OF:
            _BODY(w, _FLAG, h)
        if _FLAG & _AFTER_OF:
            _AFTER(w, _FLAG, h)
    close_interval(w, 0, h)


def _read(w: Floats, motion: Floats, out: Floats) -> None:
    """Outputs at a stamp."""
    r0, r1, r2, r3 = four(w, rows.ROAD, 0)
    watch(w, r0, r1, r2, r3)
    n0, n1, n2, n3 = four(w, rows.GROUND, 0)
    touch(w, 0, n0, n1, n2, n3)
    sense(w, 0, motion[0], motion[1], motion[2], motion[3])
    if _FLAG & _STAMP_OF:
        _STAMP(w, _FLAG, 0.0)
    _see(w, out)
    for c in range(4):
        x, y = w[(rows.ARM_X + c // 2) * WIDTH], w[(rows.ARM_Y + c) * WIDTH]
        u, v = w[(rows.WHEEL + c) * WIDTH], w[(rows.WHEEL_RATE + c) * WIDTH]
        body = out[0] + y * out[1] - x * out[2]
        out[4 + c] = u - w[(rows.STATIC + c) * WIDTH] + _RADIUS
        out[8 + c] = u - body
        out[12 + c] = v - (w[rows.HEAVE_RATE] + y * w[rows.ROLL_RATE] - x * w[rows.PITCH_RATE])
        out[30 + c] = w[(rows.WHEEL_ACCELERATION + c) * WIDTH]


def _see(w: Floats, out: Floats) -> None:
    """Pose of the body, tyre forces, what the sensor reads, and the accelerations of the body."""
    heave, roll, pitch = w[rows.HEAVE * WIDTH], w[rows.ROLL * WIDTH], w[rows.PITCH * WIDTH]
    sx, sy, sz = w[rows.SPRUNG * WIDTH], w[(rows.SPRUNG + 1) * WIDTH], w[(rows.SPRUNG + 2) * WIDTH]
    sr, cr = sin_cos(roll)
    sp, cp = sin_cos(pitch)
    out[0], out[1], out[2] = heave, roll, pitch
    out[3] = heave + sz - (cp * (sr * sy + cr * sz) - sp * sx)
    for c in range(4):
        out[16 + c] = w[(rows.CONTACT + c) * WIDTH]
    for q in range(7):
        out[20 + q] = w[(rows.SIGNAL + q) * WIDTH]
    for q in range(3):
        out[27 + q] = w[(rows.ACCELERATION + q) * WIDTH]


def _msd_start(w: Floats, road: Floats, motion: Floats) -> None:
    """Put the vehicle in equilibrium on four heights."""
    for c in range(4):
        w[(rows.ROAD + c) * WIDTH] = road[c]
    w0, w1, w2, w3 = weights(w, 0, motion[0], motion[1], motion[2] * motion[2], motion[3])
    stand_corners(w, 0, w0, w1, w2, w3, motion[4], motion[5], _HINGES)


@compiled_later
def _msd_advance(
    w: Floats, n: int, h: float, road0: Floats, road1: Floats, motion0: Floats, motion1: Floats
) -> None:
    """Walk an interval in n steps of h s, from one road and motion to another."""
    from2, to2 = motion0[2] * motion0[2], motion1[2] * motion1[2]
    for j in range(n):
        s = (j + 1.0) / n
        for c in range(4):
            wheel(w, c, 0, h, road1[c] - (1.0 - s) * (road1[c] - road0[c]))
        ax, ay = fma(s, motion1[0] - motion0[0], motion0[0]), fma(s, motion1[1] - motion0[1], motion0[1])
        yaw2, dyaw = fma(s, to2 - from2, from2), fma(s, motion1[3] - motion0[3], motion0[3])
        w0, w1, w2, w3 = weights(w, 0, ax, ay, yaw2, dyaw)
        corners(w, 0, h, w0, w1, w2, w3, _HINGES)


def _msd_read(w: Floats, motion: Floats, out: Floats) -> None:
    """Outputs at a stamp."""
    plane(w, 0, rows.POSITION)
    plane(w, 0, rows.VELOCITY)
    plane(w, 0, rows.ACCELERATION)
    r0, r1, r2, r3 = four(w, rows.ROAD, 0)
    watch(w, r0, r1, r2, r3)
    sense(w, 0, motion[0], motion[1], motion[2], motion[3])
    _see(w, out)
    for c in range(4):
        u, v = w[(rows.HUB + c) * WIDTH], w[(rows.HUB_RATE + c) * WIDTH]
        out[4 + c] = u + _RADIUS
        out[8 + c] = w[(rows.STATIC + c) * WIDTH] + (u - w[(rows.WHEEL + c) * WIDTH])
        out[12 + c] = v - w[(rows.WHEEL_RATE + c) * WIDTH]
        out[30 + c] = w[(rows.HUB_ACCELERATION + c) * WIDTH]
