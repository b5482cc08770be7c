# SPDX-License-Identifier: Apache-2.0
"""Piecewise linear characteristics of a block's lanes: their forces without a branch, and damper tables made anew.

``f(x) = k0 x + sum_j dk_j max(x, x_j) - sum_j dk_j x_j``: two instructions for each change of
slope, whatever segment the lane is in.
"""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, inlined
from suspension_twin.models import rows
from suspension_twin.models.rows import WIDTH, fma

__all__ = [
    "damper_forces",
    "retable",
    "spring_force",
    "spring_forces",
    "spring_slope",
]


@inlined
def _above(w: Floats, row: int, hinges: int, lane: int, x: float, force: float) -> float:
    """``force`` with the hinge at ``row`` of a curve whose slope changes above it."""
    at = w[row * WIDTH + lane]
    return fma(w[(row + hinges) * WIDTH + lane], x if x > at else at, force)


@inlined
def _below(w: Floats, row: int, hinges: int, lane: int, x: float, force: float) -> float:
    """The same with a curve whose slope changes below it."""
    at = w[row * WIDTH + lane]
    return fma(w[(row + hinges) * WIDTH + lane], x if x < at else at, force)


@inlined
def spring_force(w: Floats, first: int, hinges: int, lane: int, x: float) -> float:
    """Force in N of the spring whose rows begin at ``first``, compressed by ``x`` m."""
    force = fma(w[first * WIDTH + lane], x, w[(first + 1) * WIDTH + lane])
    for j in range(hinges):
        force = _above(w, first + 2 + j, hinges, lane, x, force)
    return force


@inlined
def spring_slope(w: Floats, first: int, hinges: int, lane: int, x: float) -> float:
    """Stiffness in N/m of that spring at ``x`` m (from above at a point)."""
    slope: float = w[first * WIDTH + lane]
    for j in range(hinges):
        if x >= w[(first + 2 + j) * WIDTH + lane]:
            slope += w[(first + 2 + hinges + j) * WIDTH + lane]
    return slope


@inlined
def spring_forces(
    w: Floats,
    c0: int,
    c1: int,
    c2: int,
    c3: int,
    hinges: int,
    lane: int,
    x0: float,
    x1: float,
    x2: float,
    x3: float,
) -> tuple[float, float, float, float]:
    """Forces in N of four springs whose rows begin at ``c0``.. for compressions ``x0``.. in m.

    Four at a time, so that the processor always has four independent sums to work on, and a
    point that left and right share is fetched once.
    """
    f0 = fma(w[c0 * WIDTH + lane], x0, w[(c0 + 1) * WIDTH + lane])
    f1 = fma(w[c1 * WIDTH + lane], x1, w[(c1 + 1) * WIDTH + lane])
    f2 = fma(w[c2 * WIDTH + lane], x2, w[(c2 + 1) * WIDTH + lane])
    f3 = fma(w[c3 * WIDTH + lane], x3, w[(c3 + 1) * WIDTH + lane])
    for j in range(2, 2 + hinges):
        f0 = _above(w, c0 + j, hinges, lane, x0, f0)
        f1 = _above(w, c1 + j, hinges, lane, x1, f1)
        f2 = _above(w, c2 + j, hinges, lane, x2, f2)
        f3 = _above(w, c3 + j, hinges, lane, x3, f3)
    return f0, f1, f2, f3


@inlined
def damper_forces(
    w: Floats,
    c0: int,
    c1: int,
    c2: int,
    c3: int,
    hinges: int,
    lane: int,
    b0: float,
    b1: float,
    b2: float,
    b3: float,
) -> tuple[float, float, float, float]:
    """Forces in N of four tabled dampers whose rows begin at ``c0``.. for ``b0``.. in m/s."""
    f0 = fma(w[c0 * WIDTH + lane], b0, w[(c0 + 2) * WIDTH + lane])
    f1 = fma(w[c1 * WIDTH + lane], b1, w[(c1 + 2) * WIDTH + lane])
    f2 = fma(w[c2 * WIDTH + lane], b2, w[(c2 + 2) * WIDTH + lane])
    f3 = fma(w[c3 * WIDTH + lane], b3, w[(c3 + 2) * WIDTH + lane])
    f0 = fma(w[(c0 + 1) * WIDTH + lane], b0 if b0 > 0.0 else 0.0, f0)
    f1 = fma(w[(c1 + 1) * WIDTH + lane], b1 if b1 > 0.0 else 0.0, f1)
    f2 = fma(w[(c2 + 1) * WIDTH + lane], b2 if b2 > 0.0 else 0.0, f2)
    f3 = fma(w[(c3 + 1) * WIDTH + lane], b3 if b3 > 0.0 else 0.0, f3)
    for j in range(3, 3 + hinges):  # push
        f0 = _above(w, c0 + j, hinges, lane, b0, f0)
        f1 = _above(w, c1 + j, hinges, lane, b1, f1)
        f2 = _above(w, c2 + j, hinges, lane, b2, f2)
        f3 = _above(w, c3 + j, hinges, lane, b3, f3)
    for j in range(3 + 2 * hinges, 3 + 3 * hinges):  # pull
        f0 = _below(w, c0 + j, hinges, lane, b0, f0)
        f1 = _below(w, c1 + j, hinges, lane, b1, f1)
        f2 = _below(w, c2 + j, hinges, lane, b2, f2)
        f3 = _below(w, c3 + j, hinges, lane, b3, f3)
    return f0, f1, f2, f3


@compiled
def retable(w: Floats, h: float, curves: int, springs: int, hinges: int) -> None:
    """Make the tables of the four corners for steps of ``h`` s, from DAMPER_SHARE and COMPLIANCE.

    ``curves`` is the first row of the corners' curves, with so many hinges of ``springs`` and so many ``hinges`` of
    dampers. A mount of compliance C in series with the damper deflects by C (F - F') within a step, which is as if beta
    were C / h larger. The arithmetic is that of ``constants``, so that a lane with neither keeps its table to the last
    bit.
    """
    points, stride = hinges + 1, 5 + 2 * springs + 4 * hinges
    for c in range(4):
        table = curves + c * stride + 2 + 2 * springs
        master = curves + 4 * stride + c * 6 * points
        for i in range(WIDTH):
            share = w[(rows.DAMPER_SHARE + c) * WIDTH + i]
            beta = w[(rows.IMPLICIT + c // 2) * WIDTH + i] + w[(rows.COMPLIANCE + c) * WIDTH + i] / h
            w[(rows.CORNER_IMPLICIT + c) * WIDTH + i] = beta
            constant = 0.0
            first_push = 0.0
            for side in range(2):
                at = master + 3 * points * side
                sign = 1.0 - 2.0 * side
                slope = share * w[(at + 2 * points) * WIDTH + i]
                last = slope / (1.0 + beta * slope)
                if side == 0:
                    first_push = last
                else:
                    w[table * WIDTH + i] = last
                    w[(table + 1) * WIDTH + i] = first_push - last
                total = 0.0
                for j in range(hinges):
                    b = sign * (w[(at + j) * WIDTH + i] + beta * (share * w[(at + points + j) * WIDTH + i]))
                    slope = share * w[(at + 2 * points + j + 1) * WIDTH + i]
                    slope = slope / (1.0 + beta * slope)
                    change = slope - last
                    last = slope
                    w[(table + 3 + 2 * hinges * side + j) * WIDTH + i] = b
                    w[(table + 3 + 2 * hinges * side + hinges + j) * WIDTH + i] = change
                    total += b * change
                constant += total
            w[(table + 2) * WIDTH + i] = -constant
