# SPDX-License-Identifier: Apache-2.0
"""``full_car``: seven degrees of freedom, and the kernel that integrates a block of lanes.

Equations. Heave Z of the sprung centre of gravity (up), roll (left side up), pitch (nose down)
of the sprung mass and four wheel heights u, all counted from standing level. A body point at
(x, y) ahead and left of the sprung centre is at ``Z + y roll - x pitch``; with

- ``c = static + u - (Z + y roll - x pitch)`` the spring's compression,
- ``F = spring(c) + damper(c')``, vertical, at the wheel,
- ``N = max(0, load + k (road - u))`` the tyre, which cannot pull,

``m_s Z'' = sum F - m_s g``, ``I_roll roll'' = sum y F + M_x``, ``I_pitch pitch'' = -sum x F + M_y``
and ``m_w u'' = N - F - m_w g``. Kinematics are linear in the angles, as in textbook ride models;
wheels stay under their body points, and gravity has no overturning moment.

Load transfer. The planar accelerations (a_x, a_y) of the whole vehicle's centre of gravity, at
height h, act with ``M_x = m h a_y``, ``M_y = -m h a_x``: links without anti-dive and with roll
centres on the ground hand the whole moment to springs and dampers, so that in a steady turn or a
steady braking the tyre loads balance the whole vehicle's moments about the ground.

Integration. Velocity Verlet, one evaluation of the forces a step, second order; the damper is
taken implicitly by its table (see ``constants``): with everything else at the end of the step
known and the damper's force F' of the last step as first guess, the velocity across the damper
is ``v = p - beta (F - F')``, which the table solves for F. Stable for any damper; springs bound
the step by (frequency x step) < 2. Between steps the moments M run linearly.
"""

from __future__ import annotations

import math

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, inlined, specialised
from suspension_twin.models import rows
from suspension_twin.models.car import car_model
from suspension_twin.models.corner import (
    close_interval,
    move,
    open_interval,
    strut_forces,
    touch,
    tyre_forces,
    velocities,
)
from suspension_twin.models.equilibrium import stand
from suspension_twin.models.rows import STRETCH, WIDTH, fma, four, prefetch
from suspension_twin.models.sensor import sense
from suspension_twin.models.types import Ints

__all__ = [
    "BAD_ACCELERATION",
    "BAD_ANGLE",
    "BAD_TRAVEL",
    "KERNELS",
    "MODEL",
    "moments",
    "open_lanes",
    "record",
    "watch",
]

#: A lane has diverged when an angle (rad), a suspension or tyre travel (m) or an acceleration (m/s²,
#: rad/s²) passes these.
BAD_ANGLE = 1.0
BAD_TRAVEL = 3.0
BAD_ACCELERATION = 1e6


@inlined
def watch(w: Floats, r0: float, r1: float, r2: float, r3: float) -> None:
    """Mark lanes that have left what the model means anything for; NaN counts as outside."""
    for i in range(WIDTH):
        good = abs(w[rows.ROLL * WIDTH + i]) < BAD_ANGLE
        good &= abs(w[rows.PITCH * WIDTH + i]) < BAD_ANGLE
        u0, u1, u2, u3 = four(w, rows.WHEEL, i)
        good &= (abs(u0 - r0) < BAD_TRAVEL) & (abs(u1 - r1) < BAD_TRAVEL)
        good &= (abs(u2 - r2) < BAD_TRAVEL) & (abs(u3 - r3) < BAD_TRAVEL)
        good &= abs(w[rows.HEAVE * WIDTH + i] - 0.25 * (r0 + r1 + r2 + r3)) < BAD_TRAVEL
        for q in range(3):  # what the last step made of it, before it shows in a position
            good &= abs(w[(rows.ACCELERATION + q) * WIDTH + i]) < BAD_ACCELERATION
        w[rows.FAILED * WIDTH + i] = w[rows.FAILED * WIDTH + i] if good else 1.0


@inlined
def moments(w: Floats, i: int, ax: float, ay: float, yaw2: float, dyaw: float) -> tuple[float, float]:
    """Roll and pitch moment in N m of the planar accelerations, for one lane.

    ``ax``, ``ay`` m/s² above base_link's origin, ``yaw2`` the yaw rate squared and ``dyaw`` its
    derivative in rad/s² take them to the lane's centre of gravity.
    """
    transfer = w[rows.TRANSFER * WIDTH + i]
    cx, cy = w[rows.COG * WIDTH + i], w[(rows.COG + 1) * WIDTH + i]
    return transfer * fma(dyaw, cx, fma(-yaw2, cy, ay)), -transfer * fma(-dyaw, cy, fma(-yaw2, cx, ax))


@inlined
def yaw_rate(before: float, after: float, share: float) -> float:
    """rad/s within an interval: its square is linear, as the moments are."""
    size = math.sqrt(max(fma(share, after * after - before * before, before * before), 0.0))
    return size if after >= 0.0 else -size


@inlined
def record(w: Floats, at: int, k: int, signals: Floats, states: Floats) -> None:
    """Copy what the sensor read, and the states where they are wanted, to lanes ``at``.. of row k.

    ``signals`` (n, 7, lanes), or (n, 1, lanes) for the vertical acceleration alone.
    """
    out = signals[k]
    first = rows.SIGNAL + 7 - out.shape[0]
    for q in range(out.shape[0]):
        for i in range(WIDTH):
            out[q, at + i] = w[(first + q) * WIDTH + i]
    if states.shape[0] > 0:
        for q in range(rows.STATES):
            for i in range(WIDTH):
                states[k, q, at + i] = w[q * WIDTH + i]


@inlined
def ask_ahead(signals: Floats, k: int, at: int) -> None:
    """Fetch what ``record`` will write at row ``k``: stores that miss hold up all that follow."""
    if k < signals.shape[0]:
        for q in range(signals.shape[1]):
            for i in range(0, WIDTH, 8):
                prefetch(signals, (k * signals.shape[1] + q) * signals.shape[2] + at + i)


@inlined
def open_lanes(w: Floats, k: int, motion: Floats, b0: int, b1: int, b2: int, b3: int) -> None:
    """``open_interval`` of all lanes, for the interval that ends at stamp k."""
    yaw0, yaw = motion[k - 1, 3], motion[k, 3]
    for i in range(WIDTH):
        mx, my = moments(w, i, motion[k - 1, 1], motion[k - 1, 2], yaw0 * yaw0, motion[k - 1, 4])
        to_x, to_y = moments(w, i, motion[k, 1], motion[k, 2], yaw * yaw, motion[k, 4])
        open_interval(w, i, motion[k, 0], b0, b1, b2, b3, mx, my, to_x - mx, to_y - my)


#: Hinges of a curve, of each kernel its own.
_HINGES = 0


def _run(
    blocks: Floats,
    road: Floats,
    substeps: Ints,
    motion: Floats,
    begin: int,
    end: int,
    signals: Floats,
    states: Floats,
    lane0: int,
) -> None:
    """Walk blocks (B, rows * WIDTH) through the stamps begin..end-1 of an excitation.

    ``road``, ``substeps``, ``motion`` as in Excitation, but that ``road`` starts with the first
    row of stamp ``begin``. ``signals`` (end - begin, 7 or 1, lanes) takes what the sensor reads, from
    ``lane0`` on; ``states`` the first rows of a block, (end - begin, STATES, lanes), or nothing
    where its length is 0.
    """
    front, lag = rows.CURVES, rows.LAG
    rear = front + 5 + 6 * _HINGES
    done = 0
    for start in range(begin, end, STRETCH):
        row = done
        for block in range(blocks.shape[0]):
            w = blocks[block]
            row = done
            for k in range(start, min(start + STRETCH, end)):
                ask_ahead(signals, k - begin + 1, lane0 + block * WIDTH)
                n = substeps[k]
                h = motion[k, 0]
                ax, ay, yaw, dyaw = motion[k, 1], motion[k, 2], motion[k, 3], motion[k, 4]
                if n == 0:
                    for i in range(WIDTH):
                        for c in range(4):
                            w[(rows.ROAD + c) * WIDTH + i] = road[row, c]
                        mx, my = moments(w, i, ax, ay, yaw * yaw, dyaw)
                        stand(w, i, mx, my, motion[k, 5], motion[k, 6], front, front, rear, rear, _HINGES)
                    row += 1
                else:
                    beta = rows.IMPLICIT
                    open_lanes(w, k, motion, beta, beta, beta + 1, beta + 1)
                    for j in range(n):
                        share = (j + 1.0) / n
                        r0, r1, r2, r3 = road[row, 0], road[row, 1], road[row, 2], road[row, 3]
                        row += 1
                        for i in range(WIDTH):
                            move(w, i, h)
                            strut_forces(w, i, front, front, rear, rear, _HINGES)
                        for i in range(WIDTH):
                            n0, n1, n2, n3 = tyre_forces(w, i, r0, r1, r2, r3)
                            velocities(
                                w,
                                i,
                                h,
                                share,
                                n0,
                                n1,
                                n2,
                                n3,
                                lag,
                                lag,
                                lag + 2,
                                lag + 2,
                                front,
                                front,
                                rear,
                                rear,
                                _HINGES,
                            )
                    for i in range(WIDTH):
                        close_interval(w, i, h)
                r0, r1, r2, r3 = road[row - 1, 0], road[row - 1, 1], road[row - 1, 2], road[row - 1, 3]
                watch(w, r0, r1, r2, r3)
                for i in range(WIDTH):
                    n0, n1, n2, n3 = tyre_forces(w, i, r0, r1, r2, r3)
                    touch(w, i, n0, n1, n2, n3)
                    sense(w, i, ax, ay, yaw, dyaw)
                record(w, lane0 + block * WIDTH, k - begin, signals, states)
        done = row


#: The kernel for each number of hinges per curve.
KERNELS = {hinges: compiled(specialised(_run, f"_run_{hinges}", _HINGES=hinges)) for hinges in rows.HINGES}

MODEL = car_model("full_car", "seven degrees of freedom: heave, roll and pitch of the body and four wheels")
