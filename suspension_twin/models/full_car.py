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

Masses. The twin file gives the whole vehicle's mass and centre of gravity; taking the four
wheels away at the height of the tyre radius leaves the sprung mass and its centre.

Standing. The vehicle stands level on a level road at height 0: every axle carries its share of
the sprung weight, its left and right wheel by the lever arms of the sprung centre of gravity.
That is the one distribution without a twist of the body, and the static compression of a spring
is where its characteristic reaches that load. Heights, angles and the sensor's place count from
this stance.

Integration. Velocity Verlet, one evaluation of the forces a step, second order; springs bound the step by
(frequency x step) < 2. Between steps the moments M run linearly.

Dampers are taken implicitly. A damper may be far stiffer than a step can resolve (100 kN s/m on a 40 kg wheel
decays in 0.4 ms). With ``beta`` the velocity that a unit of damper force takes away within half a step, everything
else at the end of the step known and the damper's force F' of the last step as first guess, the velocity across the
damper is ``v = p - beta (F - F')``: the force solves ``v + beta F(v) = b``. ``F`` being piecewise linear, so is the
solution as a function of ``b``, with its hinges at ``b_j = v_j + beta F_j`` and slopes ``k_j / (1 + beta k_j)``. It is
tabled once per lane; in the kernel an implicit damper costs what an explicit one would, and is stable whatever it is.
"""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, compiled_later, inlined, specialised
from suspension_twin.models import rows
from suspension_twin.models.car import (
    Candidates,
    CarKernel,
    Characteristic,
    Numbers,
    Problems,
    car_model,
    compression_at,
    hinges_of,
    read_characteristics,
    write_curves,
)
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
from suspension_twin.models.hooks import Check
from suspension_twin.models.registry import deferred
from suspension_twin.models.rows import KERNEL_HINGES, STRETCH, WIDTH, constants_for, fma, four, prefetch
from suspension_twin.models.sensor import sense
from suspension_twin.models.types import Ints
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.corners import AXLES

__all__ = [
    "BAD_ACCELERATION",
    "KERNEL",
    "KERNELS",
    "MODEL",
    "block_rows",
    "moments",
    "open_lanes",
    "record",
    "watch",
    "yaw_rate",
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


#: Hinges of springs and dampers, of each kernel its own.
_SPRING_HINGES = _DAMPER_HINGES = 0


@compiled_later
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
    rear = front + 5 + 2 * _SPRING_HINGES + 4 * _DAMPER_HINGES
    push = 2 + 2 * _SPRING_HINGES
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
                        stand(
                            w, i, mx, my, motion[k, 5], motion[k, 6], front, front, rear, rear, _SPRING_HINGES
                        )
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
                            strut_forces(w, i, front, front, rear, rear, _SPRING_HINGES)
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
                                front + push,
                                front + push,
                                rear + push,
                                rear + push,
                                _DAMPER_HINGES,
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


#: The kernel for each pair of numbers of hinges.
KERNELS = {
    h: compiled(specialised(_run, f"_run_{h.spring}_{h.damper}", **constants_for(h))) for h in KERNEL_HINGES
}

#: Largest product of step and natural frequency for which the explicit springs are trusted.
#: The scheme is stable up to 2; beyond this the phase error alone is several per cent.
_MAX_PHASE = 1.0


def block_rows(given: Candidates, stance: bool = False) -> Floats:
    """Rows of a block without effects (rows, L); with ``stance`` those of the vehicle as it stands without effects."""
    numbers, characteristics = given.numbers, given.characteristics
    if stance:
        numbers = given.stance
        characteristics = read_characteristics(numbers, Problems(given.problems.count))
    hinges = hinges_of(characteristics)
    out = np.zeros((rows.block_rows(hinges), given.problems.count))
    with np.errstate(all="ignore"):
        _body(out, numbers, given.problems.check)
        for a, axle in enumerate(AXLES):
            track = numbers[f"vehicle.{axle}_track"]
            beta = _axle(out, a, track, characteristics[axle].spring, given)
            first = rows.CURVES + a * rows.axle_rows(hinges)
            write_curves(out, first, hinges, characteristics[axle], beta)
    return out


def _body(out: Floats, numbers: Numbers, check: Check) -> None:
    """Rows of masses, inertias and geometry."""
    get = numbers.__getitem__
    mass, radius = get("vehicle.mass"), get("vehicle.tyre.radius")
    wheels = np.stack([get("vehicle.front.unsprung_mass"), get("vehicle.rear.unsprung_mass")])
    base = get("vehicle.wheelbase")
    cog = np.stack([get(f"vehicle.cog.{i}") for i in range(3)])
    inertia = np.stack([get("vehicle.sprung_inertia.roll"), get("vehicle.sprung_inertia.pitch")])
    unsprung = 2 * wheels.sum(axis=0)
    sprung = mass - unsprung
    check(~(wheels[0] > 0), "vehicle.front.unsprung_mass", "must be above 0 kg")
    check(~(wheels[1] > 0), "vehicle.rear.unsprung_mass", "must be above 0 kg")
    check(~(sprung > 0), "vehicle.mass", "leaves no sprung mass above the wheels")
    check(~(inertia[0] > 0), "vehicle.sprung_inertia.roll", "must be above 0 kg m²")
    check(~(inertia[1] > 0), "vehicle.sprung_inertia.pitch", "must be above 0 kg m²")
    check(
        ~(get("vehicle.tyre.vertical_stiffness") > 0),
        "vehicle.tyre.vertical_stiffness",
        "must be above 0 N/m",
    )

    x = (mass * cog[0] - 2 * wheels[0] * base) / sprung
    y = mass * cog[1] / sprung
    z = (mass * cog[2] - unsprung * radius) / sprung
    out[rows.INV_MASS] = 1 / sprung
    out[rows.INV_MASS + 1 : rows.INV_MASS + 3] = 1 / inertia
    out[rows.ARM_X], out[rows.ARM_X + 1] = base - x, -x
    tracks = get("vehicle.front_track"), get("vehicle.rear_track")
    for a in range(2):
        share = (x if a == 0 else base - x) / base
        out[rows.INV_WHEEL + a] = 1 / wheels[a]
        for side, sign in enumerate((1, -1)):
            i = 2 * a + side
            out[rows.ARM_Y + i] = sign * tracks[a] / 2 - y
            suspended = sprung * G * share * (0.5 + sign * y / tracks[a])
            out[rows.LOAD + i] = suspended + wheels[a] * G
            check(
                ~(suspended > 0),
                "vehicle.cog",
                f"puts no load on the {('front', 'rear')[a]} {('left', 'right')[side]} spring",
            )
    out[rows.TYRE] = get("vehicle.tyre.vertical_stiffness")
    out[rows.TRANSFER] = mass * cog[2]
    out[rows.COG : rows.COG + 2] = cog[:2]
    out[rows.HEIGHT] = cog[2]
    out[rows.SPRUNG : rows.SPRUNG + 3] = x, y, z
    for i in range(3):
        out[rows.SENSOR + i] = get(f"imu.position.{i}")


def _axle(out: Floats, a: int, track: Floats, spring: Characteristic, given: Candidates) -> Floats:
    """Rows of an axle's springs; the beta of its damper tables in s/kg."""
    axle, check = AXLES[a], given.problems.check
    inv_wheel = out[rows.INV_WHEEL + a]
    for i in (2 * a, 2 * a + 1):
        compression = compression_at(spring, out[rows.LOAD + i] - G / inv_wheel)
        unreachable = ~np.isfinite(compression)
        check(unreachable, f"vehicle.{axle}.spring.force", "the spring never carries its static load")
        out[rows.STATIC + i] = compression

    # a corner seen from its damper: the wheel and what the body gives way there
    arm = track / 2
    body = (
        out[rows.INV_MASS]
        + arm**2 * out[rows.INV_MASS + 1]
        + out[rows.ARM_X + a] ** 2 * out[rows.INV_MASS + 2]
    )
    beta: Floats = given.max_step / 2 * (inv_wheel + body)
    out[rows.IMPLICIT + a] = beta
    stiffest = (out[rows.TYRE] + spring.slope.max(axis=0)) * inv_wheel
    check(
        ~(np.sqrt(stiffest) * given.max_step < _MAX_PHASE),
        "vehicle.tyre.vertical_stiffness",
        f"too stiff on vehicle.{axle}.unsprung_mass for a step of {given.max_step:g} s: take a smaller step",
    )
    return beta


KERNEL = CarKernel(*(deferred("full_car_effects", name) for name in ("constants_of", "walk", "one_lane")))

MODEL = car_model("full_car", "seven degrees of freedom: heave, roll and pitch of the body and four wheels")
