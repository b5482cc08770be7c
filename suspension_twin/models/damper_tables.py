# SPDX-License-Identifier: Apache-2.0
"""Damper tables that change on the way: dampers that lose force, and dampers on elastic mounts."""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models import rows
from suspension_twin.models.rows import WIDTH

__all__ = ["retable"]


@compiled
def retable(w: Floats, h: float, curves: int, hinges: int) -> None:
    """Make the tables of the four corners for steps of ``h`` s, from DAMPER_SHARE and COMPLIANCE.

    ``curves`` is the first row of the corners' curves. A mount of compliance C in series with the damper deflects by
    C (F - F') within a step, which is as if beta were C / h larger. The arithmetic is that of ``constants``, so that
    a lane with neither keeps its table to the last bit.
    """
    points, stride = hinges + 1, 5 + 6 * hinges
    for c in range(4):
        table = curves + c * stride + 2 + 2 * hinges
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
