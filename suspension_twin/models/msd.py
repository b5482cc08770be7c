# SPDX-License-Identifier: Apache-2.0
"""``msd``: the mass-spring-damper model of the car paper's game engine, section 5.3, eqs (2) to (5).

As printed, with i the corner, m the vehicle's mass, x_i the height of the mass above corner i,
x_0 the unloaded length of its spring, y_i the road, L1 and L2 the distances of the centre of
gravity from the front and the rear axle, E1 and E2 the front and the rear track, h its height::

    (2)  F_i = m/4 x_i'' = -d_i(x_i') x_i' + c_i(x_i) (y_i + x_0 - x_i)
    (3)  F_rear  = m/2 A_r (x'' + g) - m A_r (a_y + g) h / E1,   A_r = L2/L - (a_x + g) h / ((x'' + g) L)
    (4)  F_front = m/2 A_f (x'' + g) - m A_f (a_y + g) h / E2,   A_f = L1/L - (a_x + g) h / ((x'' + g) L)
    (5)  m x'' = sum F_i + F_rear + F_front

The oddities of these equations (``test/models/test_msd.py`` evaluates (3) and (4) to the letter), and how this model
reads each:

1. g is added to the horizontal accelerations. At rest, (a_x + g) h takes away a share h/L from
   both axles and (a_y + g) h / E another from each, so that the two "loads" of a standing Mondeo
   add up to 9 % of its weight. Read: g belongs to the vertical alone, a_x and a_y stand bare.
2. Front and rear are exchanged. The axle behind carries the share L1/L, the one in front L2/L;
   (3), named rear, has L2, the front track E1 and the front's sign of a_x. Read: (3) is the front
   axle, (4) the rear one, and there a_x counts positive: what leaves one axle reaches the other.
3. Units and sides. c_i(x_i) and d_i(x_i') are called coefficients, while the characteristics found
   by the paper are forces; a_y has no side, so left and right would be equally relieved, and the
   term lacks division by g where A has none (Jiang et al. 2014, from where it is taken, divide).
   Read: the characteristics are forces over compression and speed, and the lateral share
   a_y h / (E g) of an axle's load goes from the left to the right wheel.
4. The loads act upwards, and count twice. In (5) they push the chassis up, against (2) where no
   weight appears at all; and with their m/2 (x'' + g) they take half of the inertia away: the
   heave would be sqrt 2 too fast. (The paper finds "a higher frequency oscillation than the
   measurement".) Read: they are the weight that rests on a corner, so they act downwards on the
   m/4 of (2), with g alone, since the inertia stands on the left already; (5) is then the sum of
   the four corners.
5. x_i' is called the velocity of the mass. A car that climbs steadily would be held back by its
   dampers. Read, with the paper's next sentence ("the suspension's compression and velocity are
   calculated"): the velocity across the damper, x_i' - y_i'.
6. x'' = -g divides by zero, in every jump. The reading has no such division.

So each corner is ``m/4 x_i'' = spring(static + y_i - x_i) + damper(y_i' - x_i') - W_i`` with
``W = m g (L2/L - a_x h/(g L)) (1/2 -+ a_y h/(E1 g))`` in front, left and right, and the same with L1,
+ a_x and E2 behind. Wheels have no mass and do not leave the road; heave, roll and pitch are those of
the plane through the four corners, heave in the middle of the wheelbase. An unsprung mass (effect
``unsprung_mass``) puts a wheel on the vehicle's tyre stiffness under each corner.

Integration as in ``full_car``: velocity Verlet, the damper implicit by its table. The road's speed
y' is the difference over the last step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, compiled_later, inlined, specialised
from suspension_twin.models import rows
from suspension_twin.models.car import (
    Block,
    Candidates,
    CarKernel,
    LaneFunctions,
    Numbers,
    Walk,
    car_model,
    compression_at,
    hinges_of,
    shorten_spring,
    write_curves,
)
from suspension_twin.models.connectors import see
from suspension_twin.models.curves import damper_forces, spring_force, spring_forces, spring_slope
from suspension_twin.models.full_car import record, watch
from suspension_twin.models.hooks import RoadChange
from suspension_twin.models.rows import KERNEL_HINGES, WIDTH, Hinges, constants_for, fma, four, put
from suspension_twin.models.sensor import sense
from suspension_twin.models.types import Ints
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.corners import AXLES

__all__ = [
    "KERNEL",
    "MODEL",
]


@inlined
def weights(
    w: Floats, i: int, ax: float, ay: float, yaw2: float, dyaw: float
) -> tuple[float, float, float, float]:
    """Weight that rests on each corner of one lane, N; accelerations of base_link as in ``full_car``."""
    cx, cy = w[rows.COG * WIDTH + i], w[(rows.COG + 1) * WIDTH + i]
    gx, gy = fma(-dyaw, cy, fma(-yaw2, cx, ax)), fma(dyaw, cx, fma(-yaw2, cy, ay))
    weight, shift = w[rows.WEIGHT * WIDTH + i], w[rows.PITCH_SHIFT * WIDTH + i] * gx
    front = weight * (w[rows.SHARE * WIDTH + i] - shift)
    rear = weight * (w[(rows.SHARE + 1) * WIDTH + i] + shift)
    side0 = fma(-w[rows.ROLL_SHIFT * WIDTH + i], gy, w[rows.SIDE * WIDTH + i])
    side1 = fma(-w[(rows.ROLL_SHIFT + 1) * WIDTH + i], gy, w[(rows.SIDE + 1) * WIDTH + i])
    return front * (0.5 + side0), front * (0.5 - side0), rear * (0.5 + side1), rear * (0.5 - side1)


@compiled
def stand_corners(
    w: Floats,
    i: int,
    w0: float,
    w1: float,
    w2: float,
    w3: float,
    forward: float,
    sideways: float,
    springs: int,
    dampers: int,
) -> None:
    """Put one lane in equilibrium under the weights ``w0``.. on the heights in its rows ROAD."""
    weights = [w0, w1, w2, w3]
    tyre, inv = w[rows.TYRE * WIDTH + i], w[rows.INV_UNSPRUNG * WIDTH + i]
    r = [w[(rows.ROAD + c) * WIDTH + i] for c in range(4)]
    front, rear = 0.5 * (r[0] + r[1]), 0.5 * (r[2] + r[3])
    length = w[rows.ARM_X * WIDTH + i] - w[(rows.ARM_X + 1) * WIDTH + i]
    tf = w[rows.ARM_Y * WIDTH + i] - w[(rows.ARM_Y + 1) * WIDTH + i]
    tr = w[(rows.ARM_Y + 2) * WIDTH + i] - w[(rows.ARM_Y + 3) * WIDTH + i]
    climb = (front - rear) / length * forward + 0.5 * ((r[0] - r[1]) / tf + (r[2] - r[3]) / tr) * sideways
    for c in range(4):
        first = rows.CURVES + (c // 2) * (5 + 2 * springs + 4 * dampers)
        static = w[(rows.STATIC + c) * WIDTH + i]
        load = weights[c]
        wheel = r[c]
        if inv > 0.0:
            wheel = r[c] + (w[(rows.LOAD + c) * WIDTH + i] - load) / tyre
            load -= G / inv
        x = static
        for _ in range(60):
            f = spring_force(w, first, springs, i, x) - load
            if abs(f) < 1e-9 * (1.0 + abs(load)):
                break
            x -= f / max(spring_slope(w, first, springs, i, x), 1.0)
        else:
            w[rows.FAILED * WIDTH + i] = 1.0
        w[(rows.WHEEL + c) * WIDTH + i] = static + wheel - x
        w[(rows.WHEEL_RATE + c) * WIDTH + i] = climb
        w[(rows.WHEEL_ACCELERATION + c) * WIDTH + i] = 0.0
        w[(rows.DAMPER + c) * WIDTH + i] = 0.0
        w[(rows.HUB + c) * WIDTH + i] = wheel
        w[(rows.HUB_RATE + c) * WIDTH + i] = climb
        w[(rows.HUB_ACCELERATION + c) * WIDTH + i] = 0.0
        w[(rows.CONTACT + c) * WIDTH + i] = weights[c]


@inlined
def plane(w: Floats, i: int, q: int) -> None:
    """Heave, roll and pitch (rows q..) of the plane through the four corners (rows q + 3..)."""
    a, b, c, d = four(w, q + 3, i)
    length = w[rows.ARM_X * WIDTH + i] - w[(rows.ARM_X + 1) * WIDTH + i]
    tf = w[rows.ARM_Y * WIDTH + i] - w[(rows.ARM_Y + 1) * WIDTH + i]
    tr = w[(rows.ARM_Y + 2) * WIDTH + i] - w[(rows.ARM_Y + 3) * WIDTH + i]
    w[q * WIDTH + i] = 0.25 * ((a + b) + (c + d))
    w[(q + 1) * WIDTH + i] = 0.5 * ((a - b) / tf + (c - d) / tr)
    w[(q + 2) * WIDTH + i] = 0.5 * ((c + d) - (a + b)) / length


@inlined
def wheel(w: Floats, c: int, i: int, h: float, r: float) -> None:
    """One wheel to the end of the step, where the road is at r m: its height and, less the damper, its velocity.

    A wheel without mass is where the road is, and as fast as it was over the step.
    """
    inv = w[rows.INV_UNSPRUNG * WIDTH + i]
    u, v = w[(rows.HUB + c) * WIDTH + i], w[(rows.HUB_RATE + c) * WIDTH + i]
    half = fma(0.5 * h, w[(rows.HUB_ACCELERATION + c) * WIDTH + i], v)
    last = w[(rows.ROAD + c) * WIDTH + i]
    w[(rows.HUB + c) * WIDTH + i] = fma(h, half, u) if inv > 0.0 else r
    w[(rows.HUB_RATE + c) * WIDTH + i] = half if inv > 0.0 else (r - last) / h
    w[(rows.ROAD + c) * WIDTH + i] = r


@compiled
def _wheels(w: Floats, h: float, road: Floats, candidate_road: Floats, row: int) -> None:
    """All wheels of all lanes to the end of the step."""
    own = candidate_road.shape[0] > 0
    for c in range(4):
        for i in range(WIDTH):
            wheel(w, c, i, h, candidate_road[row, c, i] if own else road[row, c])


@inlined
def corners(
    w: Floats, i: int, h: float, w0: float, w1: float, w2: float, w3: float, springs: int, dampers: int
) -> None:
    """One lane a step on, from wheels that are already there."""
    h2 = 0.5 * h
    front, rear = rows.CURVES, rows.CURVES + 5 + 2 * springs + 4 * dampers
    damper = 2 + 2 * springs
    inv, unsprung = w[rows.INV_CORNER * WIDTH + i], w[rows.INV_UNSPRUNG * WIDTH + i]
    tyre = w[rows.TYRE * WIDTH + i]
    a0, a1, a2, a3 = four(w, rows.WHEEL_ACCELERATION, i)
    v0, v1, v2, v3 = four(w, rows.WHEEL_RATE, i)
    x0, x1, x2, x3 = four(w, rows.WHEEL, i)
    v0, v1, v2, v3 = fma(h2, a0, v0), fma(h2, a1, v1), fma(h2, a2, v2), fma(h2, a3, v3)
    x0, x1, x2, x3 = fma(h, v0, x0), fma(h, v1, x1), fma(h, v2, x2), fma(h, v3, x3)
    u0, u1, u2, u3 = four(w, rows.HUB, i)
    c0, c1, c2, c3 = four(w, rows.STATIC, i)
    c0, c1, c2, c3 = c0 + (u0 - x0), c1 + (u1 - x1), c2 + (u2 - x2), c3 + (u3 - x3)
    s0, s1, s2, s3 = spring_forces(w, front, front, rear, rear, springs, i, c0, c1, c2, c3)
    # what wheels with a mass feel but for their dampers; the others have unsprung = 0
    r0, r1, r2, r3 = four(w, rows.ROAD, i)
    n0, n1, n2, n3 = four(w, rows.LOAD, i)
    n0, n1, n2, n3 = (
        fma(tyre, r0 - u0, n0),
        fma(tyre, r1 - u1, n1),
        fma(tyre, r2 - u2, n2),
        fma(tyre, r3 - u3, n3),
    )
    n0, n1 = n0 if n0 > 0.0 else 0.0, n1 if n1 > 0.0 else 0.0
    n2, n3 = n2 if n2 > 0.0 else 0.0, n3 if n3 > 0.0 else 0.0
    fall = G if unsprung > 0.0 else 0.0
    load = fall / unsprung if unsprung > 0.0 else 0.0
    g0, g1 = fma(n0 - s0, unsprung, -fall), fma(n1 - s1, unsprung, -fall)
    g2, g3 = fma(n2 - s2, unsprung, -fall), fma(n3 - s3, unsprung, -fall)
    a0, a1 = (s0 - (w0 - load)) * inv, (s1 - (w1 - load)) * inv
    a2, a3 = (s2 - (w2 - load)) * inv, (s3 - (w3 - load)) * inv
    lag0 = fma(-h2, inv + unsprung, w[rows.IMPLICIT * WIDTH + i])
    lag1 = fma(-h2, inv + unsprung, w[(rows.IMPLICIT + 1) * WIDTH + i])
    e0, e1, e2, e3 = four(w, rows.HUB_RATE, i)
    d0, d1, d2, d3 = four(w, rows.DAMPER, i)
    d0, d1 = fma(lag0, d0, fma(h2, g0 - a0, e0 - v0)), fma(lag0, d1, fma(h2, g1 - a1, e1 - v1))
    d2, d3 = fma(lag1, d2, fma(h2, g2 - a2, e2 - v2)), fma(lag1, d3, fma(h2, g3 - a3, e3 - v3))
    front, rear = front + damper, rear + damper
    d0, d1, d2, d3 = damper_forces(w, front, front, rear, rear, dampers, i, d0, d1, d2, d3)
    rigid = not unsprung > 0.0
    n0, n1 = s0 + d0 if rigid else n0, s1 + d1 if rigid else n1
    n2, n3 = s2 + d2 if rigid else n2, s3 + d3 if rigid else n3
    put(w, rows.CONTACT, i, n0, n1, n2, n3)
    a0, a1, a2, a3 = fma(d0, inv, a0), fma(d1, inv, a1), fma(d2, inv, a2), fma(d3, inv, a3)
    g0, g1 = fma(-d0, unsprung, g0), fma(-d1, unsprung, g1)
    g2, g3 = fma(-d2, unsprung, g2), fma(-d3, unsprung, g3)
    put(w, rows.WHEEL, i, x0, x1, x2, x3)
    put(w, rows.WHEEL_RATE, i, fma(h2, a0, v0), fma(h2, a1, v1), fma(h2, a2, v2), fma(h2, a3, v3))
    put(w, rows.WHEEL_ACCELERATION, i, a0, a1, a2, a3)
    put(w, rows.DAMPER, i, d0, d1, d2, d3)
    put(w, rows.HUB_RATE, i, fma(h2, g0, e0), fma(h2, g1, e1), fma(h2, g2, e2), fma(h2, g3, e3))
    put(w, rows.HUB_ACCELERATION, i, g0, g1, g2, g3)


@compiled
def _record_corners(w: Floats, at: int, state: Floats) -> None:
    """Wheels where ``full_car`` has them, then compressions beyond the static ones and their rates."""
    for c in range(4):
        for i in range(WIDTH):
            u, v = w[(rows.HUB + c) * WIDTH + i], w[(rows.HUB_RATE + c) * WIDTH + i]
            state[rows.WHEEL + c, at + i] = u
            state[rows.WHEEL_RATE + c, at + i] = v
            state[rows.WHEEL_ACCELERATION + c, at + i] = w[(rows.HUB_ACCELERATION + c) * WIDTH + i]
            state[rows.DAMPER + c, at + i] = u - w[(rows.WHEEL + c) * WIDTH + i]
            state[rows.DEFLECTION_RATE + c, at + i] = v - w[(rows.WHEEL_RATE + c) * WIDTH + i]


#: Hinges of a curve, of each kernel its own, and tyre radius in m of a lane by itself.
_SPRING_HINGES, _DAMPER_HINGES, _RADIUS = 0, 0, 0.0


@compiled_later
def _run(
    blocks: Floats,
    road: Floats,
    candidate_road: Floats,
    substeps: Ints,
    motion: Floats,
    begin: int,
    end: int,
    signals: Floats,
    states: Floats,
    lane0: int,
) -> None:
    """Walk blocks through the stamps begin..end-1; arguments as in ``full_car_effects._run``."""
    for block in range(blocks.shape[0]):
        w = blocks[block]
        row = 0
        for k in range(begin, end):
            n = substeps[k]
            h = motion[k, 0]
            ax, ay, yaw, dyaw = motion[k, 1], motion[k, 2], motion[k, 3], motion[k, 4]
            if n == 0:
                for i in range(WIDTH):
                    for c in range(4):
                        own = candidate_road.shape[0] > 0
                        w[(rows.ROAD + c) * WIDTH + i] = candidate_road[row, c, i] if own else road[row, c]
                    w0, w1, w2, w3 = weights(w, i, ax, ay, yaw * yaw, dyaw)
                    stand_corners(
                        w, i, w0, w1, w2, w3, motion[k, 5], motion[k, 6], _SPRING_HINGES, _DAMPER_HINGES
                    )
                row += 1
            else:
                ax0, ay0, yaw0, dyaw0 = motion[k - 1, 1], motion[k - 1, 2], motion[k - 1, 3], motion[k - 1, 4]
                from2, to2 = yaw0 * yaw0, yaw * yaw
                for j in range(n):
                    s = (j + 1.0) / n
                    _wheels(w, h, road, candidate_road, row)
                    row += 1
                    sx, sy = fma(s, ax - ax0, ax0), fma(s, ay - ay0, ay0)
                    yaw2, sd = fma(s, to2 - from2, from2), fma(s, dyaw - dyaw0, dyaw0)
                    for i in range(WIDTH):
                        w0, w1, w2, w3 = weights(w, i, sx, sy, yaw2, sd)
                        corners(w, i, h, w0, w1, w2, w3, _SPRING_HINGES, _DAMPER_HINGES)
            for i in range(WIDTH):
                plane(w, i, rows.POSITION)
                plane(w, i, rows.VELOCITY)
                plane(w, i, rows.ACCELERATION)
            watch(w, road[row - 1, 0], road[row - 1, 1], road[row - 1, 2], road[row - 1, 3])
            for i in range(WIDTH):
                sense(w, i, ax, ay, yaw, dyaw)
            at = lane0 + block * WIDTH
            record(w, at, k - begin, signals, states)
            if states.shape[0] > 0:
                _record_corners(w, at, states[k - begin])


def _start(w: Floats, road: Floats, motion: Floats) -> None:
    """Put the vehicle in equilibrium on four heights."""
    for c in range(4):
        w[(rows.ROAD + c) * WIDTH] = road[c]
    w0, w1, w2, w3 = weights(w, 0, motion[0], motion[1], motion[2] * motion[2], motion[3])
    stand_corners(w, 0, w0, w1, w2, w3, motion[4], motion[5], _SPRING_HINGES, _DAMPER_HINGES)


@compiled_later
def _advance(
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
        corners(w, 0, h, w0, w1, w2, w3, _SPRING_HINGES, _DAMPER_HINGES)


def _read(w: Floats, motion: Floats, out: Floats) -> None:
    """Outputs at a stamp."""
    plane(w, 0, rows.POSITION)
    plane(w, 0, rows.VELOCITY)
    plane(w, 0, rows.ACCELERATION)
    r0, r1, r2, r3 = four(w, rows.ROAD, 0)
    watch(w, r0, r1, r2, r3)
    sense(w, 0, motion[0], motion[1], motion[2], motion[3])
    see(w, out)
    for c in range(4):
        u, v = w[(rows.HUB + c) * WIDTH], w[(rows.HUB_RATE + c) * WIDTH]
        out[4 + c] = u + _RADIUS
        out[8 + c] = w[(rows.STATIC + c) * WIDTH] + (u - w[(rows.WHEEL + c) * WIDTH])
        out[12 + c] = v - w[(rows.WHEEL_RATE + c) * WIDTH]
        out[30 + c] = w[(rows.HUB_ACCELERATION + c) * WIDTH]


#: The kernel for each pair of numbers of hinges.
KERNELS = {
    h: compiled(specialised(_run, f"_run_{h.spring}_{h.damper}", **constants_for(h))) for h in KERNEL_HINGES
}

_SPRING_PHASE = 1.0


def _constants(given: Candidates, road: RoadChange, antenna: float, actuated: bool) -> Block:
    """Constants of the kernel, see ``car.CarKernel``. Effects give wheels a mass, 0 for none, and an axle's springs a
    sag; they change nothing else at corners."""
    numbers, unsprung, max_step = given.numbers, given.corners.wheel_mass, given.max_step
    hinges, check = hinges_of(given.characteristics), given.problems.check
    out = np.zeros((rows.block_rows(hinges), unsprung.size))

    def shares(of: Numbers) -> tuple[Floats, Floats]:
        """Weight on the four corners, and the vehicle's, N."""
        ahead, left = of["vehicle.cog.0"] / of["vehicle.wheelbase"], of["vehicle.cog.1"]
        weight = of["vehicle.mass"] * G
        tracks = of["vehicle.front_track"], of["vehicle.rear_track"]
        return weight, np.stack(
            [
                weight * (ahead if a == 0 else 1 - ahead) * (0.5 + sign * left / tracks[a])
                for a in range(2)
                for sign in (1, -1)
            ]
        )

    base, height = numbers["vehicle.wheelbase"], numbers["vehicle.cog.2"]
    with np.errstate(all="ignore"):
        weight, _ = shares(numbers)
        _, standing = shares(given.stance)
        corner = numbers["vehicle.mass"] / 4 - unsprung
        check(~(corner > 0), "effects.unsprung_mass", "leaves no mass above the wheels")
        out[rows.TYRE] = numbers["vehicle.tyre.vertical_stiffness"]
        out[rows.COG], out[rows.COG + 1] = numbers["vehicle.cog.0"], numbers["vehicle.cog.1"]
        out[rows.HEIGHT] = height
        for i in range(3):
            out[rows.SENSOR + i] = numbers[f"imu.position.{i}"]
        out[rows.WEIGHT] = weight
        out[rows.SHARE] = numbers["vehicle.cog.0"] / base
        out[rows.SHARE + 1] = 1 - out[rows.SHARE]
        out[rows.PITCH_SHIFT] = height / (G * base)
        for a, axle in enumerate(AXLES):
            track = numbers[f"vehicle.{axle}_track"]
            out[rows.ROLL_SHIFT + a] = height / (G * track)
            out[rows.SIDE + a] = numbers["vehicle.cog.1"] / track
            out[rows.ARM_X + a] = base / 2 if a == 0 else -base / 2
            out[rows.ARM_Y + 2 * a], out[rows.ARM_Y + 2 * a + 1] = track / 2, -track / 2
        out[rows.INV_CORNER] = 1 / corner
        out[rows.INV_UNSPRUNG] = np.where(unsprung > 0, 1 / np.where(unsprung > 0, unsprung, 1.0), 0.0)
        out[rows.SPRUNG] = base / 2
        out[rows.SPRUNG + 1] = 0.0
        out[rows.SPRUNG + 2] = height
        out[rows.LOAD : rows.LOAD + 4] = standing
        for a, axle in enumerate(AXLES):
            strut = given.characteristics[axle]
            for c in (2 * a, 2 * a + 1):
                load = standing[c] - unsprung * G
                check(~(load > 0), "vehicle.cog", f"puts no load on the {axle} springs")
                out[rows.STATIC + c] = compression_at(strut.spring, load)
                unreachable = ~np.isfinite(out[rows.STATIC + c])
                check(unreachable, f"vehicle.{axle}.spring.force", "the spring never carries its static load")
            beta = max_step / 2 * (out[rows.INV_CORNER] + out[rows.INV_UNSPRUNG])
            out[rows.IMPLICIT + a] = beta
            first = rows.CURVES + a * rows.axle_rows(hinges)
            write_curves(out, first, hinges, strut, beta)
            shorten_spring(out, first, hinges.spring, given.corners.sag[2 * a])
            steepest = strut.spring.slope.max(axis=0)
            stiff = steepest * (out[rows.INV_CORNER] + out[rows.INV_UNSPRUNG])
            stiff = np.maximum(stiff, (out[rows.TYRE] + steepest) * out[rows.INV_UNSPRUNG])
            check(
                ~(np.sqrt(stiff) * max_step < _SPRING_PHASE),
                f"vehicle.{axle}.spring.force",
                f"too stiff on its mass for a step of {max_step:g} s: take a smaller step",
            )
    return Block(out, None, road)


def _walk(
    hinges: Hinges, blocks: Floats, flags: Ints | None, road: Floats, candidate_road: Floats, walk: Walk
) -> None:
    """Take blocks of lanes along; see ``car.CarKernel``."""
    KERNELS[hinges](blocks, road, candidate_road, *walk)


def _one_lane(flag: int) -> LaneFunctions:
    """A lane by itself, see ``car.CarKernel``."""
    return (_start, _advance, _read), {}


KERNEL = CarKernel(_constants, _walk, _one_lane, rigid=False)

_ON_ROAD = car_model("msd", "the game-engine model of the car paper: a body on four massless wheels")
MODEL = replace(
    _ON_ROAD,
    on_wheel=replace(
        _ON_ROAD,
        title="a body on the measured motion of its four hubs",
        recordings="rig",
        also=("imu.latency", "imu.position.0", "imu.position.1"),
        live=None,
        one_lane=None,
    ),
)
