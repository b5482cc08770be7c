# SPDX-License-Identifier: Apache-2.0
"""``full_car`` with effects: the same step, with the terms of effects in it.

A block runs only the terms that one of its lanes has, and a term is exactly nothing for a lane
that has it not: with all of them at zero the numbers are those of ``full_car`` to the last bit.
Every corner has curves of its own here, every lane may have a road of its own.
"""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, pasted
from suspension_twin.models import effect_terms as terms
from suspension_twin.models import rows
from suspension_twin.models.corner import (
    close_interval,
    move,
    open_interval,
    strut_forces,
    tyre_forces,
    velocities,
)
from suspension_twin.models.equilibrium import stand
from suspension_twin.models.full_car import BAD_ACCELERATION, moments, record, watch
from suspension_twin.models.rows import WIDTH
from suspension_twin.models.sensor import sense
from suspension_twin.models.settle import settle
from suspension_twin.models.types import Ints

__all__ = ["EFFECT_KERNELS"]


@compiled
def _ground(w: Floats, road: Floats, lane_road: Floats, row: int, per_second: float) -> None:
    """Bring the road heights of ``row`` into the block, and how fast they rose."""
    own = lane_road.shape[0] > 0
    for c in range(4):
        for i in range(WIDTH):
            z = lane_road[row, c, i] if own else road[row, c]
            w[(rows.ROAD_RATE + c) * WIDTH + i] = (z - w[(rows.ROAD + c) * WIDTH + i]) * per_second
            w[(rows.ROAD + c) * WIDTH + i] = z


@pasted
def _run(
    blocks: Floats,
    flags: Ints,
    road: Floats,
    lane_road: Floats,
    substeps: Ints,
    motion: Floats,
    begin: int,
    end: int,
    signals: Floats,
    states: Floats,
    lane0: int,
    hinges: int,
) -> None:
    """As ``full_car._run``; ``flags`` (B,) say which terms each block needs.

    ``lane_road`` (rows, 4, WIDTH) gives every lane heights of its own, or has length 0; with it
    ``blocks`` holds one block.
    """
    stride = 5 + 6 * hinges
    c0 = rows.CURVES + 2 * stride
    c1, c2, c3 = c0 + stride, c0 + 2 * stride, c0 + 3 * stride
    b0 = rows.CORNER_IMPLICIT
    for block in range(blocks.shape[0]):
        w = blocks[block]
        flag = flags[block]
        row = 0
        for k in range(begin, end):
            n = substeps[k]
            h = motion[k, 0]
            ax, ay, yaw, dyaw = motion[k, 1], motion[k, 2], motion[k, 3], motion[k, 4]
            if n == 0:
                _ground(w, road, lane_road, row, 0.0)
                for i in range(WIDTH):
                    mx, my = moments(w, i, ax, ay, yaw * yaw, dyaw)
                    stand(w, i, mx, my, motion[k, 5], motion[k, 6], hinges)
                    settle(w, i, mx, my, hinges)
                row += 1
            else:
                if flag & terms.FADE:
                    terms.fade(w)
                if flag & terms.RETABLE:
                    terms.retable(w, h, hinges)
                ax0, ay0, yaw0, dyaw0 = motion[k - 1, 1], motion[k - 1, 2], motion[k - 1, 3], motion[k - 1, 4]
                for i in range(WIDTH):
                    mx, my = moments(w, i, ax0, ay0, yaw0 * yaw0, dyaw0)
                    to_x, to_y = moments(w, i, ax, ay, yaw * yaw, dyaw)
                    open_interval(w, i, h, b0, b0 + 1, b0 + 2, b0 + 3, mx, my, to_x - mx, to_y - my)
                for j in range(n):
                    share = (j + 1.0) / n
                    _ground(w, road, lane_road, row, 1.0 / h)
                    row += 1
                    for i in range(WIDTH):
                        move(w, i, h)
                        strut_forces(w, i, c0, c1, c2, c3, hinges)
                        n0, n1, n2, n3 = tyre_forces(
                            w,
                            i,
                            w[rows.ROAD * WIDTH + i],
                            w[(rows.ROAD + 1) * WIDTH + i],
                            w[(rows.ROAD + 2) * WIDTH + i],
                            w[(rows.ROAD + 3) * WIDTH + i],
                        )
                        w[rows.GROUND * WIDTH + i], w[(rows.GROUND + 1) * WIDTH + i] = n0, n1
                        w[(rows.GROUND + 2) * WIDTH + i], w[(rows.GROUND + 3) * WIDTH + i] = n2, n3
                    if flag & terms.FRICTION:
                        terms.friction(w, h)
                    if flag & terms.BUMP:
                        terms.stops(w, rows.BUMP_GAP, rows.BUMP_RATE, rows.BUMP_RISE, 1.0)
                    if flag & terms.REBOUND:
                        terms.stops(w, rows.REBOUND_GAP, rows.REBOUND_RATE, rows.REBOUND_RISE, -1.0)
                    if flag & terms.PROGRESSION:
                        terms.progression(w)
                    if flag & terms.PLAY:
                        terms.play(w, h)
                    if flag & terms.BAR:
                        terms.anti_roll_bars(w)
                    if flag & terms.TYRE_DAMPING:
                        terms.viscous_tyres(w)
                    for i in range(WIDTH):
                        velocities(
                            w,
                            i,
                            h,
                            share,
                            w[rows.GROUND * WIDTH + i],
                            w[(rows.GROUND + 1) * WIDTH + i],
                            w[(rows.GROUND + 2) * WIDTH + i],
                            w[(rows.GROUND + 3) * WIDTH + i],
                            rows.LAG,
                            rows.LAG + 1,
                            rows.LAG + 2,
                            rows.LAG + 3,
                            c0,
                            c1,
                            c2,
                            c3,
                            hinges,
                        )
                    if flag & terms.ENGINE:
                        terms.engine(w, h)
                    if flag & terms.BEND:
                        terms.bending(w, h)
                    if flag & terms.FADE:
                        terms.heat(w, h)
                for i in range(WIDTH):
                    close_interval(w, i, h)
            last = row - 1
            watch(w, road[last, 0], road[last, 1], road[last, 2], road[last, 3])
            for c in range(4):
                for i in range(WIDTH):
                    f = w[(rows.GROUND + c) * WIDTH + i]
                    w[(rows.CONTACT + c) * WIDTH + i] = f if f > 0.0 else 0.0
            for i in range(WIDTH):
                sense(w, i, ax, ay, yaw, dyaw)
            if flag & terms.BEND:
                for i in range(WIDTH):
                    more = w[(rows.BEND + 2) * WIDTH + i]
                    w[rows.FAILED * WIDTH + i] = (
                        w[rows.FAILED * WIDTH + i] if abs(more) < BAD_ACCELERATION else 1.0
                    )
                    w[(rows.SIGNAL + 2) * WIDTH + i] += more
                    w[(rows.SIGNAL + 6) * WIDTH + i] += more
            record(w, lane0 + block * WIDTH, k - begin, signals, states)


@compiled
def _run_3(
    blocks: Floats,
    flags: Ints,
    road: Floats,
    lane_road: Floats,
    substeps: Ints,
    motion: Floats,
    begin: int,
    end: int,
    signals: Floats,
    states: Floats,
    lane0: int,
) -> None:
    _run(blocks, flags, road, lane_road, substeps, motion, begin, end, signals, states, lane0, 3)


@compiled
def _run_7(
    blocks: Floats,
    flags: Ints,
    road: Floats,
    lane_road: Floats,
    substeps: Ints,
    motion: Floats,
    begin: int,
    end: int,
    signals: Floats,
    states: Floats,
    lane0: int,
) -> None:
    _run(blocks, flags, road, lane_road, substeps, motion, begin, end, signals, states, lane0, 7)


@compiled
def _run_31(
    blocks: Floats,
    flags: Ints,
    road: Floats,
    lane_road: Floats,
    substeps: Ints,
    motion: Floats,
    begin: int,
    end: int,
    signals: Floats,
    states: Floats,
    lane0: int,
) -> None:
    _run(blocks, flags, road, lane_road, substeps, motion, begin, end, signals, states, lane0, 31)


#: The kernel for each number of hinges per curve.
EFFECT_KERNELS = {3: _run_3, 7: _run_7, 31: _run_31}
