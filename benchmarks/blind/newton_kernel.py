# SPDX-License-Identifier: Apache-2.0
"""The equations of ``newton``, compiled.

A free rigid body (position, quaternion) with four wheels and an engine as masses that slide along the
body's z axis. The sliders' accelerations are eliminated, which leaves a 6 x 6 system in the body's
acceleration and angular acceleration (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 6
gives the general case). Tyres act along the road's normal; dry friction is that of Canudas de Wit et
al. (1995), with a Stribeck peak.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from blind.road_under import locate, probe
from blind.world import DAMPER_N, DAMPER_REACH, SPRING_N, SPRING_REACH, Floats, G

# Rows of the numbers that are one for all corners.
(
    MASS,
    IX,
    IY,
    IZ,
    RADIUS,
    TYRE,
    HARD,
    DRIVEN,
    SX,
    SY,
    SZ,
    BEND_W,
    BEND_Z,
    BEND_GAIN,
    FADE,
    FADE_T,
    ENGINE_W,
    ENGINE_Z,
    VOID,
    PLAY,
    ORDER_FORCE,
    ORDER_X,
    CUBIC,
    WEIGHT,
    BASE,
    GROOVE,
    GUST,
    GUST_PHASE,
    ORDER_IDLE,
    ORDER_LOW,
    ORDER_HIGH,
    ORDER_SHIFT,
    ORDER_FLOOR,
    JUDDER,
    JUDDER_TURNS,
    CLUTCH,
    CLUTCH_PITCH,
    SQUALL,
    SQUALL_PHASE,
    LOOSE_MASS,
    LOOSE_GAP,
    LOOSE_X,
    LOOSE_Y,
    SLOSH_MASS,
    SLOSH_W,
    SLOSH_Z,
    SLOSH_X,
) = range(47)
NUMBERS = 47
# Rows of the numbers by corner (columns: four wheels and the engine).
(
    X,
    Y,
    Z,
    SLIDER,
    REST,
    FRICTION,
    SPRING,
    DAMPER,
    BUMP,
    BUMP_GAP,
    REBOUND,
    REBOUND_GAP,
    MOUNT,
    BAR,
    TYRE_DAMPING,
    IMBALANCE,
    PHASE,
    SHAPE,
    PRESSURE,
    SKY,
    HOOK,
    DENT,
) = range(22)
BY_CORNER = 22
# The state: place, quaternion, velocity (body axes), spin, sliders, their rates, bristles, mounts, voids, mode,
# wheel and engine angle, a loose mass above its floor, fuel ahead and left of its tank's middle.
AT, TURN, GO, SPIN, SLIDE, RATE, BRISTLE, STRETCH, HOLLOW, MODE, ANGLE, LOOSE, FUEL = (
    0,
    3,
    7,
    10,
    13,
    18,
    23,
    27,
    31,
    35,
    37,
    39,
    41,
)
STATES = 45
BREAK = 7e-4  # m that a strut gives way before it slips
FASTEST = 0.6  # m/s
STRIBECK, STRIBECK_SPEED = 1.25, 0.02
UPPER = 0.02  # m of a stop's foam
RATTLE, RATTLE_DAMPING = (
    160.0,
    0.15,
)  # rad/s at which a loose mass bounces off its tray, and its damping ratio
SPLASH = 0.04  # damping ratio of fuel in a tank without baffles
FLAT = 0.12  # rad of half a flat spot
PLATEAU = 0.03  # m of travel from which a damper with grooves has left them behind


@njit(cache=True)
def _table(values: Floats, x: float, reach: float, count: int) -> float:
    a = x / reach * count
    if a <= 0.0:
        return 0.0
    i = min(int(a), count - 1)
    return float(values[i] + (a - i) * (values[i + 1] - values[i]))


@njit(cache=True)
def _inverse(values: Floats, force: float, reach: float, count: int) -> float:
    """Velocity at which a damper's table has this force: bisection over its rising entries."""
    low, high = 0, count
    if force >= values[count]:
        return float(reach * force / values[count])
    while high - low > 1:
        middle = (low + high) // 2
        if values[middle] <= force:
            low = middle
        else:
            high = middle
    part = (force - values[low]) / (values[high] - values[low])
    return float((low + part) * reach / count)


@njit(cache=True)
def _solve6(a: Floats, b: Floats) -> None:
    """b := a^-1 b for a symmetric positive definite (6, 6), in place, by Gauss without pivots."""
    for i in range(6):
        for k in range(i + 1, 6):
            f = a[k, i] / a[i, i]
            for j in range(i, 6):
                a[k, j] -= f * a[i, j]
            b[k] -= f * b[i]
    for i in range(5, -1, -1):
        s = b[i]
        for j in range(i + 1, 6):
            s -= a[i, j] * b[j]
        b[i] = s / a[i, i]


@njit(cache=True)
def _rotation(y: Floats, r: Floats) -> None:
    w, a, b, c = y[TURN], y[TURN + 1], y[TURN + 2], y[TURN + 3]
    n = 1.0 / math.sqrt(w * w + a * a + b * b + c * c)
    w, a, b, c = w * n, a * n, b * n, c * n
    r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)


@njit(cache=True)
def _strut(i, s, v, y, dy, n, c, springs, pushes, pulls, fade):  # type: ignore[no-untyped-def]
    """Force that pushes wheel i down, and the rates of its inner states."""
    axle = i // 2
    x = c[REST, i] + s
    force = c[SPRING, i] * _table(springs[axle], x, SPRING_REACH, SPRING_N) + n[CUBIC] * s * s * s
    # Stops of foam: soft first, and harder as they are pressed.
    deep = s - c[BUMP_GAP, i]
    if deep > 0.0:
        force += c[BUMP, i] * deep * (1.0 + (deep / UPPER) ** 2 * 0.9 + deep / UPPER * 0.4)
    deep = -s - c[REBOUND_GAP, i]
    if deep > 0.0:
        force -= c[REBOUND, i] * deep * (1.0 + (deep / UPPER) ** 2 * 0.9 + deep / UPPER * 0.4)
    scale = c[DAMPER, i] * fade * (1.0 + n[GROOVE] * min((s / PLATEAU) ** 2, 1.0))
    if c[MOUNT, i] > 0.0 or n[PLAY] > 0.0:
        z = y[STRETCH + i]
        if n[PLAY] > 0.0:
            half = 0.5 * n[PLAY]
            held = 6e5 * (z - half if z > half else (z + half if z < -half else 0.0))
        else:
            held = c[MOUNT, i] * z
        if held >= 0.0:
            inner = _inverse(pushes[axle], held / scale, DAMPER_REACH, DAMPER_N)
        else:
            inner = -_inverse(pulls[axle], -held / scale, DAMPER_REACH, DAMPER_N)
        dy[STRETCH + i] = v - inner
        force += held
    elif v >= 0.0:
        force += scale * _table(pushes[axle], v, DAMPER_REACH, DAMPER_N)
    else:
        full = scale * _table(pulls[axle], -v, DAMPER_REACH, DAMPER_N)
        if n[VOID] > 0.0 and y[HOLLOW + i] > 0.0:
            full *= 0.05
        force -= full
    if n[VOID] > 0.0:
        # Oil that tore during a quick compression leaves a void that the rebound closes first.
        if v > 0.12 and y[HOLLOW + i] < n[VOID]:
            dy[HOLLOW + i] = 0.6 * (v - 0.12)
        elif v < 0.0 and y[HOLLOW + i] > 0.0:
            dy[HOLLOW + i] = v
    level = c[FRICTION, i]
    if level > 0.0:
        most = level * (1.0 + (STRIBECK - 1.0) * math.exp(-((v / STRIBECK_SPEED) ** 2)))
        z = y[BRISTLE + i]
        slide = min(max(v, -FASTEST), FASTEST)  # beyond it the bristles are at their end anyway
        zdot = slide - abs(slide) * level / most * z / BREAK
        dy[BRISTLE + i] = zdot
        force += level / BREAK * z + 0.01 * level / BREAK * zdot
    return force


@njit(cache=True)
def _gust(t: float, phase: float) -> float:
    """Wind of 0.2 to 5 Hz about its mean, rms about 1: tones closer than any drive can part."""
    total = 0.0
    for i in range(60):
        f = 0.2 * 1.056**i
        total += math.sin(2.0 * math.pi * f * t + phase * (i + 1) * (i + 2)) / (1.0 + (f / 1.2) ** 2)
    return total / 4.5


@njit(cache=True)
def _squall(t: float, phase: float) -> float:
    """Single gusts from the side, one in every 3.7 s, each with a length and a side of its own; at most 1."""
    number = math.floor(t / 3.7)
    draw = math.sin(12.9898 * (number + 1.0) + phase) * 43758.5453
    draw -= math.floor(draw)
    lasts = 0.7 + 1.6 * draw
    into = (t - 3.7 * number - 0.6) / lasts
    if t < 0.0 or into < 0.0 or into > 1.0:
        return 0.0
    side = 1.0 if math.sin(78.233 * (number + 1.0) + phase) > 0.0 else -1.0
    return side * (0.6 + 0.4 * draw) * 0.5 * (1.0 - math.cos(2.0 * math.pi * into))


@njit(cache=True)
def _rates(t, y, dy, n, c, springs, pushes, pulls, ground, seen, room, control, r, a6, b6, pushed, out):  # type: ignore[no-untyped-def]
    """dy/dt, and in ``out`` the phone's specific force and rate (6)."""
    dy[:] = 0.0
    _rotation(y, r)
    vx, vy, vz = y[GO], y[GO + 1], y[GO + 2]
    wx, wy, wz = y[SPIN], y[SPIN + 1], y[SPIN + 2]
    gx, gy, gz = -G * r[2, 0], -G * r[2, 1], -G * r[2, 2]
    for i in range(6):
        b6[i] = 0.0
        for j in range(6):
            a6[i, j] = 0.0
    m = n[MASS]
    for i in range(3):
        a6[i, i] = m
    a6[3, 3], a6[4, 4], a6[5, 5] = n[IX], n[IY], n[IZ]
    b6[0], b6[1], b6[2] = m * gx, m * gy, m * gz
    if n[SLOSH_MASS] > 0.0:  # fuel goes up and down with the body, and not along and across
        a6[0, 0] = a6[1, 1] = m - n[SLOSH_MASS]
        b6[0], b6[1] = a6[0, 0] * gx, a6[1, 1] * gy
    b6[3] = (n[IY] - n[IZ]) * wy * wz
    b6[4] = (n[IZ] - n[IX]) * wz * wx
    b6[5] = (n[IX] - n[IY]) * wx * wy
    fade = 1.0 - n[FADE] * (1.0 - math.exp(-max(t, 0.0) / n[FADE_T]))
    stress = 0.0
    steer, drive, brake = control[0], control[1], control[2]
    for i in range(5):
        mi = c[SLIDER, i]
        if mi <= 0.0:
            continue
        s, v = y[SLIDE + i], y[RATE + i]
        rx, ry, rz = c[X, i], c[Y, i], c[Z, i] + s
        # Outer force in body axes, and its moment about the slider.
        ex = ey = ez = mx = my = 0.0
        if i < 4:
            other = i + 1 if i % 2 == 0 else i - 1
            f = -_strut(i, s, v, y, dy, n, c, springs, pushes, pulls, fade)
            f -= c[BAR, i] * (s - y[SLIDE + other])
            stress -= c[SHAPE, i] * f
            px = y[AT] + r[0, 0] * rx + r[0, 1] * ry + r[0, 2] * rz
            py = y[AT + 1] + r[1, 0] * rx + r[1, 1] * ry + r[1, 2] * rz
            pz = y[AT + 2] + r[2, 0] * rx + r[2, 1] * ry + r[2, 2] * rz
            # Velocity of the wheel's centre in body axes, then in the world's.
            bx, by, bz = vx + wy * rz - wz * ry, vy + wz * rx - wx * rz, vz + wx * ry - wy * rx + v
            qx = r[0, 0] * bx + r[0, 1] * by + r[0, 2] * bz
            qy = r[1, 0] * bx + r[1, 1] * by + r[1, 2] * bz
            qz = r[2, 0] * bx + r[2, 1] * by + r[2, 2] * bz
            aim = math.atan2(r[1, 0], r[0, 0]) + (steer if i < 2 else 0.0)
            ca, sa = math.cos(aim), math.sin(aim)
            if c[SKY, i] > 0.0 or c[HOOK, i] > 0.0:
                # a valve that is opened by the velocity of body or wheel, where that takes energy out
                body = qz - r[2, 2] * v
                f += c[SKY, i] * body * 0.5 * (1.0 + math.tanh(-body * v / 4e-4))
                f -= c[HOOK, i] * qz * 0.5 * (1.0 + math.tanh(qz * v / 4e-4))
            probe(ground, i, px, py, ca, sa, seen, room)
            h, hx, hy = seen[0], seen[1], seen[2]
            # Slip is that of the tyre's foot, which the body's roll and pitch carry along with it.
            arm = h - pz
            lx, ly, lz = r[2, 0] * arm, r[2, 1] * arm, r[2, 2] * arm
            kx, ky, kz = wy * lz - wz * ly, wz * lx - wx * lz, wx * ly - wy * lx
            fx = qx + r[0, 0] * kx + r[0, 1] * ky + r[0, 2] * kz
            fy = qy + r[1, 0] * kx + r[1, 1] * ky + r[1, 2] * kz
            along, across = fx * ca + fy * sa, -fx * sa + fy * ca
            depth = h + n[RADIUS] + ground.sink[i] - pz
            if c[DENT, i] > 0.0:
                turned = (y[ANGLE] + c[PHASE, i]) / (2.0 * math.pi)
                turned = 2.0 * math.pi * (turned - math.floor(turned + 0.5)) / FLAT
                depth -= c[DENT, i] * math.exp(-turned * turned)
            normal = 0.0
            if depth > 0.0:
                stiff = n[TYRE] * (0.3 + 0.7 * c[PRESSURE, i])
                normal = stiff * depth * (1.0 + n[HARD] * depth) + c[TYRE_DAMPING, i] * (
                    hx * qx + hy * qy - qz
                )
                normal = max(normal, 0.0)
            lateral = -0.95 * normal * math.tanh(math.atan2(across, abs(along) + 0.6) / 0.066)
            hold = 0.34 if i < 2 else 0.16
            if n[JUDDER] > 0.0 and i < 2:
                hold *= 1.0 + n[JUDDER] * math.sin(n[JUDDER_TURNS] * y[ANGLE])
            push = drive
            if n[CLUTCH] > 0.0 and vx < 6.0:
                push *= 1.0 + n[CLUTCH] * math.sin(n[CLUTCH_PITCH] * t)
            on = (0.5 * push if (i < 2) == (n[DRIVEN] == 0.0) else 0.0) - hold * brake * math.tanh(
                along / 0.03
            )
            most = 0.9 * normal
            on = min(max(on, -most), most)
            # Along the road's normal, and in its plane.
            wxf = on * ca - lateral * sa - hx * normal
            wyf = on * sa + lateral * ca - hy * normal
            wzf = normal + on * (hx * ca + hy * sa) + lateral * (-hx * sa + hy * ca)
            ex = r[0, 0] * wxf + r[1, 0] * wyf + r[2, 0] * wzf
            ey = r[0, 1] * wxf + r[1, 1] * wyf + r[2, 1] * wzf
            ez = r[0, 2] * wxf + r[1, 2] * wyf + r[2, 2] * wzf
            mx, my = ly * ez - lz * ey, lz * ex - lx * ez
            b6[5] += lx * ey - ly * ex
            if c[IMBALANCE, i] > 0.0:  # on the hub: at the front of the wheel it goes down
                spin = along / n[RADIUS]
                swing = c[IMBALANCE, i] * spin * spin
                ez += swing * math.sin(y[ANGLE] + c[PHASE, i])
                ex -= swing * math.cos(y[ANGLE] + c[PHASE, i])
        else:
            f = mi * G - mi * (n[ENGINE_W] ** 2 * s + 2.0 * n[ENGINE_Z] * n[ENGINE_W] * v)
        pushed[i] = f + ez
        cx = wy * (wx * ry - wy * rx) - wz * (wz * rx - wx * rz) + 2.0 * wy * v
        cy = wz * (wy * rz - wz * ry) - wx * (wx * ry - wy * rx) - 2.0 * wx * v
        # What the body has to hold sideways: m (a + alpha x r + c) - (outer + m g), x and y alone.
        nx, ny = mi * (cx - gx) - ex, mi * (cy - gy) - ey
        b6[0] -= nx
        b6[1] -= ny
        b6[2] -= f
        b6[3] -= -rz * ny + ry * f - mx
        b6[4] -= rz * nx - rx * f - my
        b6[5] -= rx * ny - ry * nx
        a6[0, 0] += mi
        a6[0, 4] += mi * rz
        a6[0, 5] -= mi * ry
        a6[1, 1] += mi
        a6[1, 3] -= mi * rz
        a6[1, 5] += mi * rx
        a6[3, 1] -= mi * rz
        a6[3, 3] += mi * rz * rz
        a6[3, 5] -= mi * rz * rx
        a6[4, 0] += mi * rz
        a6[4, 4] += mi * rz * rz
        a6[4, 5] -= mi * rz * ry
        a6[5, 0] -= mi * ry
        a6[5, 1] += mi * rx
        a6[5, 3] -= mi * rx * rz
        a6[5, 4] -= mi * ry * rz
        a6[5, 5] += mi * (rx * rx + ry * ry)
    if n[ORDER_FORCE] > 0.0:
        shake = n[ORDER_FORCE] * math.sin(y[ANGLE + 1])
        b6[2] += shake
        b6[4] -= n[ORDER_X] * shake
    if n[GUST] > 0.0:
        # Side force and lift, pressing ahead of the centre and above it.
        side, lift = 0.4 * n[GUST] * _gust(t, n[GUST_PHASE]), n[GUST] * _gust(t, n[GUST_PHASE] + 1.0)
        b6[1] += side
        b6[2] += lift
        b6[3] -= 0.6 * side
        b6[4] -= 0.4 * lift
        b6[5] += 0.4 * side
    if n[SQUALL] > 0.0:
        side = n[SQUALL] * _squall(t, n[SQUALL_PHASE])
        b6[1] += side
        b6[3] -= 0.7 * side
        b6[5] += 0.5 * side
    rattle = 0.0
    if n[LOOSE_MASS] > 0.0:
        place, pace = y[LOOSE], y[LOOSE + 1]
        if place < 0.0:
            rattle = max(-(RATTLE**2) * place - 2.0 * RATTLE_DAMPING * RATTLE * pace, 0.0)
        elif place > n[LOOSE_GAP]:
            over = place - n[LOOSE_GAP]
            rattle = -max(RATTLE**2 * over + 2.0 * RATTLE_DAMPING * RATTLE * pace, 0.0)
        # its weight at rest is part of the body's
        press = n[LOOSE_MASS] * (G - rattle)
        b6[2] += press
        b6[3] += n[LOOSE_Y] * press
        b6[4] -= n[LOOSE_X] * press
    if n[SLOSH_MASS] > 0.0:
        swing = 2.0 * SPLASH * n[SLOSH_W]
        fx = n[SLOSH_MASS] * (n[SLOSH_W] ** 2 * y[FUEL] + swing * y[FUEL + 2])
        fy = n[SLOSH_MASS] * (n[SLOSH_W] ** 2 * y[FUEL + 1] + swing * y[FUEL + 3])
        b6[0] += fx
        b6[1] += fy
        b6[3] -= n[SLOSH_Z] * fy
        b6[4] += n[SLOSH_Z] * fx
        b6[5] += n[SLOSH_X] * fy
    _solve6(a6, b6)
    ax, ay, az, dx, dyy, dz = b6[0], b6[1], b6[2], b6[3], b6[4], b6[5]
    for i in range(5):
        mi = c[SLIDER, i]
        if mi > 0.0:
            rx, ry, rz = c[X, i], c[Y, i], c[Z, i] + y[SLIDE + i]
            cz = wx * (wz * rx - wx * rz) - wy * (wy * rz - wz * ry)
            dy[RATE + i] = pushed[i] / mi + gz - (az + dx * ry - dyy * rx + cz)
            dy[SLIDE + i] = y[RATE + i]
    # Inertial acceleration in turning axes: the velocity's own rate has the cross product taken off.
    dy[GO], dy[GO + 1], dy[GO + 2] = ax - wy * vz + wz * vy, ay - wz * vx + wx * vz, az - wx * vy + wy * vx
    dy[SPIN], dy[SPIN + 1], dy[SPIN + 2] = dx, dyy, dz
    for i in range(3):
        dy[AT + i] = r[i, 0] * vx + r[i, 1] * vy + r[i, 2] * vz
    w, a, b, d = y[TURN], y[TURN + 1], y[TURN + 2], y[TURN + 3]
    dy[TURN] = 0.5 * (-a * wx - b * wy - d * wz)
    dy[TURN + 1] = 0.5 * (w * wx + b * wz - d * wy)
    dy[TURN + 2] = 0.5 * (w * wy + d * wx - a * wz)
    dy[TURN + 3] = 0.5 * (w * wz + a * wy - b * wx)
    sx, sy, sz = n[SX], n[SY], n[SZ]
    out[0] = ax + dyy * sz - dz * sy + wy * (wx * sy - wy * sx) - wz * (wz * sx - wx * sz) - gx
    out[1] = ay + dz * sx - dx * sz + wz * (wy * sz - wz * sy) - wx * (wx * sy - wy * sx) - gy
    out[2] = az + dx * sy - dyy * sx + wx * (wz * sx - wx * sz) - wy * (wy * sz - wz * sy) - gz
    out[3], out[4], out[5] = wx, wy, wz
    if n[BEND_GAIN] != 0.0:
        dy[MODE] = y[MODE + 1]
        dy[MODE + 1] = (
            (stress - n[BASE]) / n[WEIGHT]
            - n[BEND_W] ** 2 * y[MODE]
            - 2 * n[BEND_Z] * n[BEND_W] * y[MODE + 1]
        )
        out[2] += n[BEND_GAIN] * dy[MODE + 1]
    if n[LOOSE_MASS] > 0.0:
        dy[LOOSE] = y[LOOSE + 1]
        dy[LOOSE + 1] = rattle - (az + dx * n[LOOSE_Y] - dyy * n[LOOSE_X] - gz)
    if n[SLOSH_MASS] > 0.0:
        dy[FUEL], dy[FUEL + 1] = y[FUEL + 2], y[FUEL + 3]
        dy[FUEL + 2] = -fx / n[SLOSH_MASS] - (ax + dyy * n[SLOSH_Z] - gx)
        dy[FUEL + 3] = -fy / n[SLOSH_MASS] - (ay + dz * n[SLOSH_X] - dx * n[SLOSH_Z] - gy)
    dy[ANGLE] = vx / n[RADIUS]
    # An engine's order: idling, then up with the speed in its gears.
    rise = n[ORDER_LOW] if vx < n[ORDER_SHIFT] else n[ORDER_HIGH]
    dy[ANGLE + 1] = 2.0 * math.pi * max(n[ORDER_IDLE] + max(vx, 0.0) * rise, n[ORDER_FLOOR])


@njit(cache=True)
def _steer(y, r, plan, push, at, ground, wheelbase, reach, lane, mass, control, summed):  # type: ignore[no-untyped-def]
    """The driver: a look ahead at the road's bend, and a foot that follows the plan."""
    k = min(max(int(at / 0.01), 0), plan.size - 1)
    rear = y[AT] - reach * r[0, 0], y[AT + 1] - reach * r[1, 0]
    u, v, heading = locate(ground, 4, rear[0], rear[1])
    i = min(max(int(u / ground.du), 0), ground.heading.size - 2)
    ahead = min(i + int((0.5 + 0.25 * abs(y[GO])) / ground.du), ground.heading.size - 2)
    j = max(ahead - 20, 0)
    bend = (ground.heading[ahead] - ground.heading[j]) / max((ahead - j) * ground.du, 1e-6)
    turn = math.atan2(r[1, 0], r[0, 0]) - heading
    turn -= 2 * math.pi * round(turn / (2 * math.pi))
    wish = math.atan(wheelbase * bend) - 0.9 * turn - 0.16 * (v - lane)
    control[0] += min(max(wish - control[0], -0.003), 0.003)
    if plan[k] < 0.02 and push[k] <= 1e-9:
        control[1], control[2] = 0.0, 4000.0
        return u
    miss = plan[k] - y[GO]
    summed[0] += 0.006 * miss
    effort = mass * (push[k] + 1.2 * miss + 0.3 * summed[0])
    control[1], control[2] = max(effort, 0.0), max(-effort, 0.0)
    return u


@njit(cache=True)
def integrate(  # type: ignore[no-untyped-def]
    y,
    n,
    c,
    springs,
    pushes,
    pulls,
    ground,
    plan,
    push,
    wheelbase,
    back,
    lane,
    mass,
    h,
    settle,
    count,
    felt,
    path,
):
    """Stand for ``settle`` steps, then fill ``felt`` (count, 6) and ``path`` (count, 12: x, y, z and quaternion
    of the body, u, compressions) by steps of ``h`` s. The control changes every
    6 ms."""
    k1, k2, k3 = np.empty(STATES), np.empty(STATES), np.empty(STATES)
    k4, mid = np.empty(STATES), np.empty(STATES)
    seen, room, control, r = np.empty(3), np.empty((4, 4)), np.array([0.0, 0.0, 4000.0]), np.empty((3, 3))
    a6, b6, pushed, out, summed = np.empty((6, 6)), np.empty(6), np.zeros(5), np.empty(6), np.zeros(1)
    spare, every, u = np.empty(6), max(int(0.006 / h + 0.5), 1), 0.0
    for step in range(-settle, count):
        t = step * h
        if step % every == 0:
            _rotation(y, r)
            u = _steer(y, r, plan, push, t, ground, wheelbase, back, lane, mass, control, summed)
        _rates(t, y, k1, n, c, springs, pushes, pulls, ground, seen, room, control, r, a6, b6, pushed, out)
        if step >= 0:
            felt[step] = out
            path[step, :7] = y[:7]
            path[step, 7] = u
            path[step, 8:] = y[SLIDE : SLIDE + 4]
        mid[:] = y + 0.5 * h * k1
        _rates(
            t + 0.5 * h,
            mid,
            k2,
            n,
            c,
            springs,
            pushes,
            pulls,
            ground,
            seen,
            room,
            control,
            r,
            a6,
            b6,
            pushed,
            spare,
        )
        mid[:] = y + 0.5 * h * k2
        _rates(
            t + 0.5 * h,
            mid,
            k3,
            n,
            c,
            springs,
            pushes,
            pulls,
            ground,
            seen,
            room,
            control,
            r,
            a6,
            b6,
            pushed,
            spare,
        )
        mid[:] = y + h * k3
        _rates(
            t + h,
            mid,
            k4,
            n,
            c,
            springs,
            pushes,
            pulls,
            ground,
            seen,
            room,
            control,
            r,
            a6,
            b6,
            pushed,
            spare,
        )
        y += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        if step < 0:
            # Stand still the sooner: the motion left of being put down dies within a second.
            y[GO + 2] *= 0.995
            y[RATE : RATE + 5] *= 0.995
            y[LOOSE + 1] *= 0.99
            y[FUEL + 2 : FUEL + 4] *= 0.99
