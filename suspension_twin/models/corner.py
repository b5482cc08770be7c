# SPDX-License-Identifier: Apache-2.0
"""One step of one lane in three parts, which the kernels with and without effects share.

``move`` takes the positions to the end of the step, ``strut_forces`` and ``tyre_forces`` say what
springs and tyres do there, ``velocities`` solves the dampers and takes the velocities along.
Before the last an effect may change the forces; it is a loop of its own over the lanes also
because one long loop would run out of registers. Within an interval velocities are those in the
middle of a step; ``open_interval`` and ``close_interval`` bring them there and back. See
``full_car`` for the equations.
"""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.compiled import inlined
from suspension_twin.models import rows
from suspension_twin.models.curves import damper_forces, spring_forces
from suspension_twin.models.numerics import fma
from suspension_twin.models.rows import WIDTH
from suspension_twin.units import STANDARD_GRAVITY as G

__all__ = ["close_interval", "move", "open_interval", "strut_forces", "touch", "tyre_forces", "velocities"]


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
        w[(7 + q) * WIDTH + i] = fma(0.5 * h, w[(14 + q) * WIDTH + i], w[(7 + q) * WIDTH + i])
    front, rear = -0.5 * h * w[rows.INV_WHEEL * WIDTH + i], -0.5 * h * w[(rows.INV_WHEEL + 1) * WIDTH + i]
    w[rows.LAG * WIDTH + i] = front + w[b0 * WIDTH + i]
    w[(rows.LAG + 1) * WIDTH + i] = front + w[b1 * WIDTH + i]
    w[(rows.LAG + 2) * WIDTH + i] = rear + w[b2 * WIDTH + i]
    w[(rows.LAG + 3) * WIDTH + i] = rear + w[b3 * WIDTH + i]
    w[rows.MOMENT * WIDTH + i], w[(rows.MOMENT + 1) * WIDTH + i] = mx, my
    w[(rows.MOMENT + 2) * WIDTH + i], w[(rows.MOMENT + 3) * WIDTH + i] = dmx, dmy


@inlined
def close_interval(w: Floats, i: int, h: float) -> None:
    """From velocities half a step beyond a stamp to those at the stamp."""
    for q in range(7):
        w[(7 + q) * WIDTH + i] = fma(-0.5 * h, w[(14 + q) * WIDTH + i], w[(7 + q) * WIDTH + i])


@inlined
def move(w: Floats, i: int, h: float) -> None:
    """Positions one step on, with the velocities in its middle."""
    for q in range(7):
        w[q * WIDTH + i] = fma(h, w[(7 + q) * WIDTH + i], w[q * WIDTH + i])


@inlined
def strut_forces(w: Floats, i: int, c0: int, c1: int, c2: int, c3: int, hinges: int) -> None:
    """Spring forces where the lane is, into STRUT; ``c0``.. are the first rows of the corners' curves."""
    z, r, p = w[i], w[1 * WIDTH + i], w[2 * WIDTH + i]
    front, rear = fma(-w[rows.ARM_X * WIDTH + i], p, z), fma(-w[(rows.ARM_X + 1) * WIDTH + i], p, z)
    s0, s1, s2, s3 = spring_forces(
        w,
        c0,
        c1,
        c2,
        c3,
        hinges,
        i,
        w[3 * WIDTH + i] - fma(w[rows.ARM_Y * WIDTH + i], r, front),
        w[4 * WIDTH + i] - fma(w[(rows.ARM_Y + 1) * WIDTH + i], r, front),
        w[5 * WIDTH + i] - fma(w[(rows.ARM_Y + 2) * WIDTH + i], r, rear),
        w[6 * WIDTH + i] - fma(w[(rows.ARM_Y + 3) * WIDTH + i], r, rear),
    )
    w[rows.STRUT * WIDTH + i], w[(rows.STRUT + 1) * WIDTH + i] = s0, s1
    w[(rows.STRUT + 2) * WIDTH + i], w[(rows.STRUT + 3) * WIDTH + i] = s2, s3


@inlined
def tyre_forces(
    w: Floats, i: int, r0: float, r1: float, r2: float, r3: float
) -> tuple[float, float, float, float]:
    """Linear tyre forces in N on road heights ``r0``.. m, negative where the tyre has left the road."""
    tyre = w[rows.TYRE * WIDTH + i]
    return (
        fma(tyre, r0 - w[3 * WIDTH + i], w[rows.TOUCH * WIDTH + i]),
        fma(tyre, r1 - w[4 * WIDTH + i], w[(rows.TOUCH + 1) * WIDTH + i]),
        fma(tyre, r2 - w[5 * WIDTH + i], w[(rows.TOUCH + 2) * WIDTH + i]),
        fma(tyre, r3 - w[6 * WIDTH + i], w[(rows.TOUCH + 3) * WIDTH + i]),
    )


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
    c0: int,
    c1: int,
    c2: int,
    c3: int,
    hinges: int,
) -> None:
    """Solve the dampers at the end of the step; velocities go on to the middle of the next one.

    Strut forces from STRUT, ``n0``.. N of the tyres; ``share`` of the interval has passed; ``l0``..
    are the rows of LAG for each corner, ``c0``.. as in ``strut_forces``.
    """
    h2 = 0.5 * h
    damper = 2 + 2 * hinges
    s0, s1 = w[rows.STRUT * WIDTH + i], w[(rows.STRUT + 1) * WIDTH + i]
    s2, s3 = w[(rows.STRUT + 2) * WIDTH + i], w[(rows.STRUT + 3) * WIDTH + i]
    vz, vr, vp = w[7 * WIDTH + i], w[8 * WIDTH + i], w[9 * WIDTH + i]
    # the body's velocity at the end of the step, guessed with its last acceleration
    qz, qr, qp = (
        fma(h2, w[14 * WIDTH + i], vz),
        fma(h2, w[15 * WIDTH + i], vr),
        fma(h2, w[16 * WIDTH + i], vp),
    )

    front, rear = w[rows.ARM_X * WIDTH + i], w[(rows.ARM_X + 1) * WIDTH + i]
    inv, ivr = w[rows.INV_WHEEL * WIDTH + i], w[(rows.INV_WHEEL + 1) * WIDTH + i]
    y0, y1 = w[rows.ARM_Y * WIDTH + i], w[(rows.ARM_Y + 1) * WIDTH + i]
    y2, y3 = w[(rows.ARM_Y + 2) * WIDTH + i], w[(rows.ARM_Y + 3) * WIDTH + i]
    v0, v1, v2, v3 = w[10 * WIDTH + i], w[11 * WIDTH + i], w[12 * WIDTH + i], w[13 * WIDTH + i]
    a0 = fma((n0 if n0 > 0.0 else 0.0) - s0, inv, -G)
    a1 = fma((n1 if n1 > 0.0 else 0.0) - s1, inv, -G)
    a2 = fma((n2 if n2 > 0.0 else 0.0) - s2, ivr, -G)
    a3 = fma((n3 if n3 > 0.0 else 0.0) - s3, ivr, -G)
    ahead, behind = fma(-front, qp, qz), fma(-rear, qp, qz)
    p0 = fma(w[l0 * WIDTH + i], w[rows.DAMPER * WIDTH + i], v0 - fma(y0, qr, ahead))
    p1 = fma(w[l1 * WIDTH + i], w[(rows.DAMPER + 1) * WIDTH + i], v1 - fma(y1, qr, ahead))
    p2 = fma(w[l2 * WIDTH + i], w[(rows.DAMPER + 2) * WIDTH + i], v2 - fma(y2, qr, behind))
    p3 = fma(w[l3 * WIDTH + i], w[(rows.DAMPER + 3) * WIDTH + i], v3 - fma(y3, qr, behind))
    d0, d1, d2, d3 = damper_forces(
        w,
        c0 + damper,
        c1 + damper,
        c2 + damper,
        c3 + damper,
        hinges,
        i,
        fma(h2, a0, p0),
        fma(h2, a1, p1),
        fma(h2, a2, p2),
        fma(h2, a3, p3),
    )
    a0, a1, a2, a3 = fma(-d0, inv, a0), fma(-d1, inv, a1), fma(-d2, ivr, a2), fma(-d3, ivr, a3)
    f0, f1, f2, f3 = s0 + d0, s1 + d1, s2 + d2, s3 + d3
    fore, aft = f0 + f1, f2 + f3
    force = fore + aft
    # the last terms are the moments of the planar accelerations
    roll_moment = fma(share, w[(rows.MOMENT + 2) * WIDTH + i], w[rows.MOMENT * WIDTH + i])
    pitch_moment = fma(share, w[(rows.MOMENT + 3) * WIDTH + i], w[(rows.MOMENT + 1) * WIDTH + i])
    lift = fma(-front, fore, fma(-rear, aft, pitch_moment))
    tilt = fma(y0, f0, y1 * f1) + fma(y2, f2, fma(y3, f3, roll_moment))
    az = fma(force, w[rows.INV_MASS * WIDTH + i], -G)
    ar = tilt * w[(rows.INV_MASS + 1) * WIDTH + i]
    ap = lift * w[(rows.INV_MASS + 2) * WIDTH + i]

    w[7 * WIDTH + i], w[8 * WIDTH + i], w[9 * WIDTH + i] = fma(h, az, vz), fma(h, ar, vr), fma(h, ap, vp)
    w[10 * WIDTH + i], w[11 * WIDTH + i] = fma(h, a0, v0), fma(h, a1, v1)
    w[12 * WIDTH + i], w[13 * WIDTH + i] = fma(h, a2, v2), fma(h, a3, v3)
    w[14 * WIDTH + i], w[15 * WIDTH + i], w[16 * WIDTH + i] = az, ar, ap
    w[17 * WIDTH + i], w[18 * WIDTH + i], w[19 * WIDTH + i], w[20 * WIDTH + i] = a0, a1, a2, a3
    w[rows.DAMPER * WIDTH + i], w[(rows.DAMPER + 1) * WIDTH + i] = d0, d1
    w[(rows.DAMPER + 2) * WIDTH + i], w[(rows.DAMPER + 3) * WIDTH + i] = d2, d3


@inlined
def touch(w: Floats, i: int, r0: float, r1: float, r2: float, r3: float) -> None:
    """Write the tyre forces on road heights ``r0``.. m where they are recorded."""
    n0, n1, n2, n3 = tyre_forces(w, i, r0, r1, r2, r3)
    w[rows.CONTACT * WIDTH + i] = n0 if n0 > 0.0 else 0.0
    w[(rows.CONTACT + 1) * WIDTH + i] = n1 if n1 > 0.0 else 0.0
    w[(rows.CONTACT + 2) * WIDTH + i] = n2 if n2 > 0.0 else 0.0
    w[(rows.CONTACT + 3) * WIDTH + i] = n3 if n3 > 0.0 else 0.0
