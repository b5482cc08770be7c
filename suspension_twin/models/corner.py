# SPDX-License-Identifier: Apache-2.0
"""One step of one lane in three parts, which the kernels with and without effects share.

``move`` takes the positions to the end of the step, ``strut_forces`` and ``tyre_forces`` compute what
springs and tyres do there, ``velocities`` solves the dampers and takes the velocities along.
Before the last an effect may change the forces; it is a loop of its own over the lanes also
because one long loop would run out of registers. Within an interval velocities are those in the
middle of a step; ``open_interval`` and ``close_interval`` bring them there and back. See
``full_car`` for the equations. ``travel`` and ``travel_rate`` are for the terms of effects.
"""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.compiled import inlined
from suspension_twin.models import rows
from suspension_twin.models.curves import damper_forces, spring_forces
from suspension_twin.models.rows import WIDTH, fma, four, put
from suspension_twin.units import STANDARD_GRAVITY as G

__all__ = [
    "close_interval",
    "move",
    "open_interval",
    "strut_forces",
    "touch",
    "travel",
    "travel_rate",
    "tyre_forces",
    "velocities",
]


@inlined
def travel(w: Floats, c: int, i: int) -> float:
    """Compression in m of corner c's spring beyond its static one."""
    body = fma(-w[(rows.ARM_X + c // 2) * WIDTH + i], w[rows.PITCH * WIDTH + i], w[rows.HEAVE * WIDTH + i])
    body = fma(w[(rows.ARM_Y + c) * WIDTH + i], w[rows.ROLL * WIDTH + i], body)
    return w[(rows.WHEEL + c) * WIDTH + i] - body - w[(rows.STATIC + c) * WIDTH + i]  # type: ignore[no-any-return]


@inlined
def travel_rate(w: Floats, c: int, i: int) -> float:
    """Rate in m/s of corner c's compression, with the velocities as they stand."""
    pitch_rate, heave_rate = w[rows.PITCH_RATE * WIDTH + i], w[rows.HEAVE_RATE * WIDTH + i]
    body = fma(-w[(rows.ARM_X + c // 2) * WIDTH + i], pitch_rate, heave_rate)
    body = fma(w[(rows.ARM_Y + c) * WIDTH + i], w[rows.ROLL_RATE * WIDTH + i], body)
    return w[(rows.WHEEL_RATE + c) * WIDTH + i] - body  # type: ignore[no-any-return]


@inlined
def open_interval(
    w: Floats,
    i: int,
    h: float,
    b0: int,
    b1: int,
    b2: int,
    b3: int,
    mx: float,
    my: float,
    dmx: float,
    dmy: float,
) -> None:
    """From velocities at a stamp to those half a step of ``h`` s later.

    ``b0``.. are the rows of beta, ``mx``, ``my`` N m the moments of the planar accelerations at the
    stamp and ``dmx``, ``dmy`` what they gain until the next.
    """
    for q in range(7):
        v = w[(rows.VELOCITY + q) * WIDTH + i]
        w[(rows.VELOCITY + q) * WIDTH + i] = fma(0.5 * h, w[(rows.ACCELERATION + q) * WIDTH + i], v)
    front, rear = -0.5 * h * w[rows.INV_WHEEL * WIDTH + i], -0.5 * h * w[(rows.INV_WHEEL + 1) * WIDTH + i]
    b = w[b0 * WIDTH + i], w[b1 * WIDTH + i], w[b2 * WIDTH + i], w[b3 * WIDTH + i]
    put(w, rows.LAG, i, front + b[0], front + b[1], rear + b[2], rear + b[3])
    put(w, rows.MOMENT, i, mx, my, dmx, dmy)


@inlined
def close_interval(w: Floats, i: int, h: float) -> None:
    """From velocities half a step beyond a stamp to those at the stamp."""
    for q in range(7):
        v = w[(rows.VELOCITY + q) * WIDTH + i]
        w[(rows.VELOCITY + q) * WIDTH + i] = fma(-0.5 * h, w[(rows.ACCELERATION + q) * WIDTH + i], v)


@inlined
def move(w: Floats, i: int, h: float) -> None:
    """Positions one step on, with the velocities in its middle."""
    for q in range(7):
        x = w[(rows.POSITION + q) * WIDTH + i]
        w[(rows.POSITION + q) * WIDTH + i] = fma(h, w[(rows.VELOCITY + q) * WIDTH + i], x)


@inlined
def strut_forces(w: Floats, i: int, c0: int, c1: int, c2: int, c3: int, hinges: int) -> None:
    """Spring forces where the lane is, into STRUT; ``c0``.. are the first rows of the corners' curves."""
    z, r, p = w[rows.HEAVE * WIDTH + i], w[rows.ROLL * WIDTH + i], w[rows.PITCH * WIDTH + i]
    front, rear = fma(-w[rows.ARM_X * WIDTH + i], p, z), fma(-w[(rows.ARM_X + 1) * WIDTH + i], p, z)
    y0, y1, y2, y3 = four(w, rows.ARM_Y, i)
    u0, u1, u2, u3 = four(w, rows.WHEEL, i)
    x0, x1 = u0 - fma(y0, r, front), u1 - fma(y1, r, front)
    x2, x3 = u2 - fma(y2, r, rear), u3 - fma(y3, r, rear)
    s0, s1, s2, s3 = spring_forces(w, c0, c1, c2, c3, hinges, i, x0, x1, x2, x3)
    put(w, rows.STRUT, i, s0, s1, s2, s3)


@inlined
def tyre_forces(
    w: Floats, i: int, r0: float, r1: float, r2: float, r3: float
) -> tuple[float, float, float, float]:
    """Linear tyre forces in N on road heights ``r0``.. m, negative where the tyre has left the road."""
    tyre = w[rows.TYRE * WIDTH + i]
    t0, t1, t2, t3 = four(w, rows.TOUCH, i)
    u0, u1, u2, u3 = four(w, rows.WHEEL, i)
    n0, n1, n2, n3 = (
        fma(tyre, r0 - u0, t0),
        fma(tyre, r1 - u1, t1),
        fma(tyre, r2 - u2, t2),
        fma(tyre, r3 - u3, t3),
    )
    return n0, n1, n2, n3


@inlined
def velocities(
    w: Floats,
    i: int,
    h: float,
    share: float,
    n0: float,
    n1: float,
    n2: float,
    n3: float,
    l0: int,
    l1: int,
    l2: int,
    l3: int,
    d0: int,
    d1: int,
    d2: int,
    d3: int,
    hinges: int,
) -> None:
    """Solve the dampers at the end of the step; velocities go on to the middle of the next one.

    Strut forces from STRUT, ``n0``.. N of the tyres; ``share`` of the interval has passed; ``l0``..
    are the rows of LAG for each corner, ``d0``.. the first rows of the dampers' tables.
    """
    h2 = 0.5 * h
    s0, s1, s2, s3 = four(w, rows.STRUT, i)
    vz, vr, vp = w[rows.HEAVE_RATE * WIDTH + i], w[rows.ROLL_RATE * WIDTH + i], w[rows.PITCH_RATE * WIDTH + i]
    # the body's velocity at the end of the step, guessed with its last acceleration
    qz = fma(h2, w[rows.HEAVE_ACCELERATION * WIDTH + i], vz)
    qr = fma(h2, w[rows.ROLL_ACCELERATION * WIDTH + i], vr)
    qp = fma(h2, w[rows.PITCH_ACCELERATION * WIDTH + i], vp)

    front, rear = w[rows.ARM_X * WIDTH + i], w[(rows.ARM_X + 1) * WIDTH + i]
    inv, ivr = w[rows.INV_WHEEL * WIDTH + i], w[(rows.INV_WHEEL + 1) * WIDTH + i]
    y0, y1, y2, y3 = four(w, rows.ARM_Y, i)
    v0, v1, v2, v3 = four(w, rows.WHEEL_RATE, i)
    a0 = fma((n0 if n0 > 0.0 else 0.0) - s0, inv, -G)
    a1 = fma((n1 if n1 > 0.0 else 0.0) - s1, inv, -G)
    a2 = fma((n2 if n2 > 0.0 else 0.0) - s2, ivr, -G)
    a3 = fma((n3 if n3 > 0.0 else 0.0) - s3, ivr, -G)
    ahead, behind = fma(-front, qp, qz), fma(-rear, qp, qz)
    f0, f1, f2, f3 = four(w, rows.DAMPER, i)
    p0 = fma(h2, a0, fma(w[l0 * WIDTH + i], f0, v0 - fma(y0, qr, ahead)))
    p1 = fma(h2, a1, fma(w[l1 * WIDTH + i], f1, v1 - fma(y1, qr, ahead)))
    p2 = fma(h2, a2, fma(w[l2 * WIDTH + i], f2, v2 - fma(y2, qr, behind)))
    p3 = fma(h2, a3, fma(w[l3 * WIDTH + i], f3, v3 - fma(y3, qr, behind)))
    f0, f1, f2, f3 = damper_forces(w, d0, d1, d2, d3, hinges, i, p0, p1, p2, p3)
    put(w, rows.DAMPER, i, f0, f1, f2, f3)
    a0, a1, a2, a3 = fma(-f0, inv, a0), fma(-f1, inv, a1), fma(-f2, ivr, a2), fma(-f3, ivr, a3)
    f0, f1, f2, f3 = s0 + f0, s1 + f1, s2 + f2, s3 + f3
    fore, aft = f0 + f1, f2 + f3
    # the last terms are the moments of the planar accelerations
    mx, my, dmx, dmy = four(w, rows.MOMENT, i)
    lift = fma(-front, fore, fma(-rear, aft, fma(share, dmy, my)))
    tilt = fma(y0, f0, y1 * f1) + fma(y2, f2, fma(y3, f3, fma(share, dmx, mx)))
    az = fma(fore + aft, w[rows.INV_MASS * WIDTH + i], -G)
    ar, ap = tilt * w[rows.INV_ROLL * WIDTH + i], lift * w[rows.INV_PITCH * WIDTH + i]

    w[rows.HEAVE_RATE * WIDTH + i] = fma(h, az, vz)
    w[rows.ROLL_RATE * WIDTH + i], w[rows.PITCH_RATE * WIDTH + i] = fma(h, ar, vr), fma(h, ap, vp)
    put(w, rows.WHEEL_RATE, i, fma(h, a0, v0), fma(h, a1, v1), fma(h, a2, v2), fma(h, a3, v3))
    w[rows.HEAVE_ACCELERATION * WIDTH + i] = az
    w[rows.ROLL_ACCELERATION * WIDTH + i], w[rows.PITCH_ACCELERATION * WIDTH + i] = ar, ap
    put(w, rows.WHEEL_ACCELERATION, i, a0, a1, a2, a3)


@inlined
def touch(w: Floats, i: int, n0: float, n1: float, n2: float, n3: float) -> None:
    """Write tyre forces ``n0``.. N where they are recorded: a tyre cannot pull."""
    put(
        w,
        rows.CONTACT,
        i,
        n0 if n0 > 0.0 else 0.0,
        n1 if n1 > 0.0 else 0.0,
        n2 if n2 > 0.0 else 0.0,
        n3 if n3 > 0.0 else 0.0,
    )
