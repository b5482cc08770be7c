# SPDX-License-Identifier: Apache-2.0
"""Static equilibrium of a lane without effects: exact through the piecewise linear springs and the tyres."""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models import rows
from suspension_twin.models.curves import spring_force, spring_slope
from suspension_twin.models.rows import WIDTH
from suspension_twin.units import STANDARD_GRAVITY as G

__all__ = ["stand"]

_ROUNDS = 80
_SOFT = 1.0  # N/m: what a corner without any stiffness (airborne, flat spring) is taken for


@compiled
def stand(
    w: Floats, lane: int, mx: float, my: float, forward: float, sideways: float, curves: int, hinges: int
) -> None:
    """Put one lane of a block in equilibrium on the road heights in its rows ROAD.

    ``mx``, ``my`` N m are the moments of the planar accelerations, ``curves`` the first row of the axles' curves.
    The vehicle moves with
    ``forward`` and ``sideways`` m/s along the plane through its four contact points, so that a
    drive that begins on a slope begins without a jolt. Newton on a convex piecewise quadratic
    energy: a few rounds, then exact. A lane without an equilibrium is marked failed.
    """
    axle_stride = 5 + 6 * hinges
    road = [w[(rows.ROAD + c) * WIDTH + lane] for c in range(4)]
    front = 0.5 * (road[0] + road[1])
    rear = 0.5 * (road[2] + road[3])
    xf, xr = w[rows.ARM_X * WIDTH + lane], w[(rows.ARM_X + 1) * WIDTH + lane]
    weight = G / w[rows.INV_MASS * WIDTH + lane]
    tyre = w[rows.TYRE * WIDTH + lane]
    pitch = (rear - front) / (xf - xr)
    tf = w[rows.ARM_Y * WIDTH + lane] - w[(rows.ARM_Y + 1) * WIDTH + lane]
    tr = w[(rows.ARM_Y + 2) * WIDTH + lane] - w[(rows.ARM_Y + 3) * WIDTH + lane]
    roll = 0.5 * ((road[0] - road[1]) / tf + (road[2] - road[3]) / tr)
    heave = rear + xr * pitch
    climb = -pitch * forward + roll * sideways

    wheel = [road[0], road[1], road[2], road[3]]
    small = 1e-11 * weight
    error = 2.0 * small
    for attempt in range(_ROUNDS):
        rz, rx, ry = -weight, mx, my
        kzz = kzx = kzy = kxx = kxy = kyy = 0.0
        error = 0.0
        stiffness, tyres, rest = [0.0] * 4, [0.0] * 4, [0.0] * 4
        for i in range(4):
            a = i // 2
            x, y = w[(rows.ARM_X + a) * WIDTH + lane], w[(rows.ARM_Y + i) * WIDTH + lane]
            first = curves + a * axle_stride
            body = heave + y * roll - x * pitch
            c = w[(rows.STATIC + i) * WIDTH + lane] + wheel[i] - body
            f = spring_force(w, first, hinges, lane, c)
            k = max(spring_slope(w, first, hinges, lane, c), 0.0)
            n = w[(rows.LOAD + i) * WIDTH + lane] + tyre * (road[i] - wheel[i])
            kt = tyre if n > 0.0 else 0.0
            n = max(n, 0.0)
            if k + kt < _SOFT:
                kt += _SOFT
            ru = n - f - G / w[(rows.INV_WHEEL + a) * WIDTH + lane]
            series = k * kt / (k + kt)
            stiffness[i], tyres[i], rest[i] = k, kt, ru
            f_wheel = f + k * ru / (k + kt)
            rz += f_wheel
            rx += y * f_wheel
            ry -= x * f_wheel
            kzz += series
            kzx += series * y
            kzy -= series * x
            kxx += series * y * y
            kxy -= series * x * y
            kyy += series * x * x
            error = max(error, abs(ru))
        error = max(error, abs(rz), abs(rx), abs(ry))
        if error <= small:
            break
        kzz += _SOFT
        kxx += _SOFT
        kyy += _SOFT
        # Cholesky of the three body equations
        l11 = kzz**0.5
        l21, l31 = kzx / l11, kzy / l11
        l22 = max(kxx - l21 * l21, 1e-9) ** 0.5
        l32 = (kxy - l31 * l21) / l22
        l33 = max(kyy - l31 * l31 - l32 * l32, 1e-9) ** 0.5
        q1 = rz / l11
        q2 = (rx - l21 * q1) / l22
        q3 = (ry - l31 * q1 - l32 * q2) / l33
        d3 = q3 / l33
        d2 = (q2 - l32 * d3) / l22
        d1 = (q1 - l21 * d2 - l31 * d3) / l11
        if attempt > 20:  # a cycle between segments: shorter steps end it
            d1, d2, d3 = 0.5 * d1, 0.5 * d2, 0.5 * d3
        heave, roll, pitch = heave + d1, roll + d2, pitch + d3
        for i in range(4):
            a = i // 2
            x, y = w[(rows.ARM_X + a) * WIDTH + lane], w[(rows.ARM_Y + i) * WIDTH + lane]
            move = rest[i] + stiffness[i] * (d1 + y * d2 - x * d3)
            wheel[i] += move / (stiffness[i] + tyres[i])
    if not error <= 1e3 * small:
        w[rows.FAILED * WIDTH + lane] = 1.0
    w[rows.HEAVE * WIDTH + lane] = heave
    w[rows.ROLL * WIDTH + lane] = roll
    w[rows.PITCH * WIDTH + lane] = pitch
    for i in range(4):
        w[(rows.WHEEL + i) * WIDTH + lane] = wheel[i] + w[(rows.STATIC + i) * WIDTH + lane]
        w[(rows.DAMPER + i) * WIDTH + lane] = 0.0
    for q in range(7):
        w[(rows.ACCELERATION + q) * WIDTH + lane] = 0.0
        w[(rows.VELOCITY + q) * WIDTH + lane] = 0.0 if q == 1 or q == 2 else climb
