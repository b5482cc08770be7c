# SPDX-License-Identifier: Apache-2.0
"""The equations of ``flexible``, compiled.

Five rigid bodies, each with all its six degrees of freedom: the car's body and four wheel carriers. Nothing is
constrained. Twenty links with a bushing at each end, four struts and four tyres are forces between them (maximal
coordinates), stepped by the symplectic Euler rule. The body is elastic in three free modes (torsion, vertical and
lateral bending), which every force on it excites at its own place. Masses that ride on the body are points on springs.
Tyres roll on two or more cams in a row (Schmeitz 2004) and pull by the Magic Formula with a way to build up (Pacejka
2012); friction is Dahl's (1968).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from blind.world import DAMPER_N, DAMPER_REACH, SPRING_N, SPRING_REACH, G

# Numbers of the whole car.
(
    MASS,
    IX,
    IY,
    IZ,
    RADIUS,
    TYRE,
    HARD,
    DRIVEN,
    DT,
    CAMS,
    PITCH,
    BASE,
    REAR,
    FADE,
    FADE_T,
    VOID,
    PLAY,
    CUBIC,
    GROOVE,
    JUDDER,
    TURNS,
    CLUTCH,
    CLUTCH_PITCH,
    SHAKE,
    IDLE,
    LOW,
    HIGH,
    SHIFT,
    FLOOR,
    BEND_GAIN,
    BEND_W,
    BEND_Z,
    BEND_LOAD,
    SX,
    SY,
    SZ,
    ARM,
    LANE,
    WEIGHED,
) = range(39)
NUMBERS = 39
# Numbers by wheel.
(
    REST,
    SPRING,
    DAMPER,
    FRICTION,
    BUMP,
    BUMP_GAP,
    REBOUND,
    REBOUND_GAP,
    MOUNT,
    BAR,
    TYRE_DAMPING,
    IMBALANCE,
    PHASE,
    PRESSURE,
    SKY,
    HOOK,
    DENT,
    WORN,
    RATIO,
    CARRIER,
    SINK,
) = range(21)
BY_WHEEL = 21
# What a wheel keeps: spin, angle, shear of the tyre along and across, friction, stretch of the mount, void, force of
# the valve, compression, the last place along the road.
SPUN, TURNED, ALONG, ACROSS, STUCK, STRETCH, HOLLOW, VALVE, TRAVEL, AT_U = range(10)
STATES = 10
# Of a riding mass: kg, place from the body's centre, N/m and N s/m along its axes, m of play upwards.
R_MASS, R_X, R_KX, R_CX, R_GAP = 0, 1, 4, 7, 10
RIDER = 11
SPIN_INERTIA = 0.9  # kg m², of a wheel about its axle
CARRIER_INERTIA = (0.7, 0.9, 0.7)
CAM_REACH = 3  # samples to each side of a cam's middle
BUILD_UP = (0.15, 0.4)  # m
CORNERING, TRACTION, GRIP = 13.0, 18.0, 0.95  # per load
SHAPE_SIDE, SHAPE_LONG = 1.3, 1.5  # of the Magic Formula
CAMBER = 0.7  # per load and rad
SHEAR_DAMPING = 220.0  # N s/m
DAHL = 4e-4  # m over which friction comes
STOP = 0.06  # m at which a stop of rubber is pressed flat
VALVE_LAG = 0.009  # s
CONTROL = 4e-3  # s
_FLAT = 0.13  # rad of half a flat spot


@njit(cache=True)
def _matrix(q, r):  # type: ignore[no-untyped-def]
    """r := the rotation of a unit quaternion (w first)."""
    w, a, b, c = q[0], q[1], q[2], q[3]
    r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)


@njit(cache=True)
def _carried(r, at, go, spin, x, y, z, dy, dz, p, v):  # type: ignore[no-untyped-def]
    """p, v := place and velocity in the world of a body's point (x, y, z), which itself moves at (0, dy, dz)."""
    cx, cy, cz = spin[1] * z - spin[2] * y, spin[2] * x - spin[0] * z + dy, spin[0] * y - spin[1] * x + dz
    for k in range(3):
        p[k] = at[k] + r[k, 0] * x + r[k, 1] * y + r[k, 2] * z
        v[k] = go[k] + r[k, 0] * cx + r[k, 1] * cy + r[k, 2] * cz


@njit(cache=True)
def _press(force, torque, at, p, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Add a force at a place to a body's force and its torque about its centre, in the world."""
    rx, ry, rz = p[0] - at[0], p[1] - at[1], p[2] - at[2]
    force[0] += fx
    force[1] += fy
    force[2] += fz
    torque[0] += ry * fz - rz * fy
    torque[1] += rz * fx - rx * fz
    torque[2] += rx * fy - ry * fx


@njit(cache=True)
def _table(values, x, reach, count):  # type: ignore[no-untyped-def]
    a = x / reach * count
    if a <= 0.0:
        return 0.0
    i = min(int(a), count - 1)
    return values[i] + (a - i) * (values[i + 1] - values[i])


@njit(cache=True)
def _along(road, x, y, u):  # type: ignore[no-untyped-def]
    """Place (u, v) of a point and the cell it is in; from a first guess."""
    _, steps, heading, lx, ly = road
    k, v = 0, 0.0
    for _ in range(3):
        k = min(max(int(u / steps[0]), 0), heading.size - 2)
        c, s = math.cos(heading[k]), math.sin(heading[k])
        u = k * steps[0] + (x - lx[k]) * c + (y - ly[k]) * s
        v = (y - ly[k]) * c - (x - lx[k]) * s
    return u, v, k


@njit(cache=True)
def _height(road, u, v):  # type: ignore[no-untyped-def]
    z, steps, _, _, _ = road
    a = min(max(u / steps[0], 0.0), z.shape[0] - 1.001)
    b = min(max((v - steps[2]) / steps[1], 0.0), z.shape[1] - 1.001)
    i, j = int(a), int(b)
    a, b = a - i, b - j
    return (1 - a) * ((1 - b) * z[i, j] + b * z[i, j + 1]) + a * ((1 - b) * z[i + 1, j] + b * z[i + 1, j + 1])


@njit(cache=True)
def _rolled(road, u, v, cd, sd, n, room):  # type: ignore[no-untyped-def]
    """Height and slope ahead of the plane on which a row of cams stands; (cd, sd) is the wheel's heading on the road.

    A cam is a circle of the wheel's size that touches the road where it is highest."""
    cams, pitch, radius = int(n[CAMS]), n[PITCH], n[RADIUS]
    count = cams + 2 * CAM_REACH
    for k in range(count):
        d = (k - 0.5 * (count - 1)) * pitch
        room[k] = _height(road, u + d * cd, v + d * sd)
    total = first = last = 0.0
    for m in range(cams):
        top = -1e9
        for j in range(2 * CAM_REACH + 1):
            d = (j - CAM_REACH) * pitch
            top = max(top, room[m + j] - (radius - math.sqrt(radius * radius - d * d)))
        total += top
        first = top if m == 0 else first
        last = top
    return total / cams, (last - first) / ((cams - 1) * pitch)


@njit(cache=True)
def _wheel_force(i, s, v, t, over, hub, n, c, keep, springs, dampers):  # type: ignore[no-untyped-def]
    """N between wheel and body at compression ``s`` and its rate ``v``, as at the wheel; steps on what this keeps."""
    axle, dt = i // 2, n[DT]
    pushes, pulls, given, taken, most = dampers
    force = c[SPRING, i] * _table(springs[axle], c[REST, i] + s, SPRING_REACH, SPRING_N) + n[CUBIC] * s**3
    deep = min(s - c[BUMP_GAP, i], 0.9 * STOP)
    if deep > 0.0:
        force += c[BUMP, i] * deep / (1.0 - deep / STOP)
    deep = min(-s - c[REBOUND_GAP, i], 0.9 * STOP)
    if deep > 0.0:
        force -= c[REBOUND, i] * deep / (1.0 - deep / STOP)
    level = c[FRICTION, i]
    if level > 0.0:
        f = keep[STUCK, i]
        f += level / DAHL * v * (1.0 - math.copysign(1.0, v) * f / level) * dt
        keep[STUCK, i] = min(max(f, -level), level)
        force += keep[STUCK, i]
    scale = c[DAMPER, i] * (1.0 - n[FADE] * (1.0 - math.exp(-max(t, 0.0) / n[FADE_T])))
    scale *= 1.0 + n[GROOVE] * (1.0 - math.exp(-((s / 0.022) ** 2)))
    worn = 1.0 - c[WORN, i]
    if c[MOUNT, i] > 0.0 or n[PLAY] > 0.0:
        z = keep[STRETCH, i]
        if n[PLAY] > 0.0:
            held = 5.5e5 * (z - min(max(z, -0.5 * n[PLAY]), 0.5 * n[PLAY]))
        else:
            held = c[MOUNT, i] * z
        # the damper behind the rubber goes as fast as the rubber's force drives it
        if held >= 0.0:
            inner = _table(given[axle], held / scale, most, DAMPER_N)
        else:
            inner = -_table(taken[axle], -held / scale, most, DAMPER_N)
        keep[STRETCH, i] += (v - inner) * dt
        force += held
    elif v >= 0.0:
        force += scale * worn * _table(pushes[axle], v, DAMPER_REACH, DAMPER_N)
        if n[VOID] > 0.0 and v > 0.11:  # torn oil
            keep[HOLLOW, i] = min(keep[HOLLOW, i] + 0.55 * (v - 0.11) * dt, n[VOID])
    elif keep[HOLLOW, i] > 0.0:
        keep[HOLLOW, i] = max(keep[HOLLOW, i] + v * dt, 0.0)
    else:
        force -= scale * worn * _table(pulls[axle], -v, DAMPER_REACH, DAMPER_N)
    if c[SKY, i] > 0.0 or c[HOOK, i] > 0.0:
        # the force on the wheel that a valve is asked for, as far as it takes energy out
        wish = -c[SKY, i] * over + c[HOOK, i] * hub
        keep[VALVE, i] += (wish - keep[VALVE, i]) * dt / VALVE_LAG
        if keep[VALVE, i] * v > 0.0:
            force += keep[VALVE, i]
    return force


@njit(cache=True)
def _pull(shear, way, slip, over, stiffness, shape, normal, dt):  # type: ignore[no-untyped-def]
    """A tyre's shear one step on, and its force by the Magic Formula of the slip that this stands for."""
    shear = (shear + slip * dt) / (1.0 + over / way * dt)
    steep = stiffness / (GRIP * shape)
    limit = 3.0 * way / steep
    shear = min(max(shear, -limit), limit)
    force = GRIP * normal * math.sin(shape * math.atan(steep * shear / way))
    return shear, force + (SHEAR_DAMPING * slip if normal > 0.0 else 0.0)


@njit(cache=True)
def _drive(t, r, at, go, control, summed, plan, push, road, keep, n):  # type: ignore[no-untyped-def]
    """The driver: rack for the bend ahead and the way back to the lane, a foot that follows the plan."""
    k = min(max(int(t / 0.01), 0), plan.size - 1)
    _, steps, heading, _, _ = road
    speed = go[0] * r[0, 0] + go[1] * r[1, 0]
    ahead = n[BASE] - n[REAR]
    _, v, cell = _along(road, at[0] + ahead * r[0, 0], at[1] + ahead * r[1, 0], keep[AT_U, 0])
    far = min(cell + int(0.35 * abs(speed) / steps[0]), heading.size - 30)
    bend = (heading[far + 20] - heading[max(far - 20, 0)]) / ((far + 20 - max(far - 20, 0)) * steps[0])
    turn = math.atan2(r[1, 0], r[0, 0]) - heading[cell]
    turn -= 2 * math.pi * round(turn / (2 * math.pi))
    wish = math.atan(n[BASE] * bend) - turn - math.atan(0.8 * (v - n[LANE]) / (abs(speed) + 2.0))
    wish = min(max(wish, -0.5), 0.5)
    control[0] += (-n[ARM] * wish - control[0]) * CONTROL / 0.06
    if plan[k] < 0.02 and push[k] <= 1e-9:
        control[1], control[2] = 0.0, 4300.0
        return
    miss = plan[k] - speed
    summed[0] += CONTROL * 0.9 * miss
    effort = n[WEIGHED] * (push[k] + 1.3 * miss + 0.3 * summed[0])
    control[1], control[2] = max(effort, 0.0), max(-effort, 0.0)


@njit(cache=True)
def integrate(  # type: ignore[no-untyped-def]
    at, turn, go, spin, modes, pace, extra, riders, ride, dash, keep, control, summed, n, c, elastic, phone,
    carrier, chassis, length, stiff, damp, low, top, strut, shapes, springs, dampers, road, plan, push, wind,
    first, last, every, felt, path, bent,
):  # fmt: skip
    """Step from ``first`` to ``last``; every ``every``-th step from 0 on fills a row of ``felt`` (6: the phone's
    specific force and rate), ``path`` (12: body's place and quaternion, u, compressions) and ``bent`` (3: modes)."""
    dt = n[DT]
    r = np.empty((5, 3, 3))
    force, torque, bend = np.empty((5, 3)), np.empty((5, 3)), np.empty(3)
    p, v, q, w = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    room, around = np.empty(256), np.empty(3)
    rate = max(int(CONTROL / dt + 0.5), 1)
    for step in range(first, last):
        t = step * dt
        for b in range(5):
            _matrix(turn[b], r[b])
            mass = n[MASS] if b == 0 else c[CARRIER, b - 1]
            for k in range(3):
                force[b, k] = torque[b, k] = 0.0
            force[b, 2] = -mass * G
        bend[:] = 0.0
        if step % rate == 0:
            _drive(t, r[0], at[0], go[0], control, summed, plan, push, road, keep, n)
        dashed = -n[BEND_LOAD]
        for i in range(4):
            b = i + 1
            for j in range(6):
                # links 0 to 4, and the strut
                one, two = (carrier[i, j], chassis[i, j]) if j < 5 else (low[i], top[i])
                sh = shapes[i, j]
                inner = two[1] + (control[0] if i < 2 and j == 4 else 0.0)
                _carried(
                    r[0], at[0], go[0], spin[0], two[0], inner + sh[2] * modes[2],
                    two[2] + sh[0] * modes[0] + sh[1] * modes[1], sh[2] * pace[2],
                    sh[0] * pace[0] + sh[1] * pace[1], q, w,
                )  # fmt: skip
                _carried(r[b], at[b], go[b], spin[b], one[0], one[1], one[2], 0.0, 0.0, p, v)
                dx, dy, dz = p[0] - q[0], p[1] - q[1], p[2] - q[2]
                long = math.sqrt(dx * dx + dy * dy + dz * dz)
                ux, uy, uz = dx / long, dy / long, dz / long
                grows = ux * (v[0] - w[0]) + uy * (v[1] - w[1]) + uz * (v[2] - w[2])
                if j < 5:
                    f = -stiff[i, j] * (long - length[i, j]) - damp[i, j] * grows
                else:
                    s = (strut[i] - long) / c[RATIO, i]
                    keep[TRAVEL, i] = s
                    other = i + 1 if i % 2 == 0 else i - 1
                    f = _wheel_force(
                        i, s, -grows / c[RATIO, i], t, w[2], go[b, 2], n, c, keep, springs, dampers
                    )  # fmt: skip
                    f = (f + c[BAR, i] * (s - keep[TRAVEL, other])) / c[RATIO, i]
                _press(force[b], torque[b], at[b], p, f * ux, f * uy, f * uz)
                _press(force[0], torque[0], at[0], q, -f * ux, -f * uy, -f * uz)
                fy = -f * (ux * r[0, 0, 1] + uy * r[0, 1, 1] + uz * r[0, 2, 1])
                fz = -f * (ux * r[0, 0, 2] + uy * r[0, 1, 2] + uz * r[0, 2, 2])
                bend[0] += sh[0] * fz
                bend[1] += sh[1] * fz
                bend[2] += sh[2] * fy
                dashed += (1.0 if i < 2 else 0.8) * fz
            # the tyre
            px, py, pz = at[b, 0], at[b, 1], at[b, 2]
            u, vv, cell = _along(road, px, py, keep[AT_U, i])
            keep[AT_U, i] = u
            aim = math.atan2(r[b, 1, 0], r[b, 0, 0])
            ca, sa = math.cos(aim), math.sin(aim)
            on_road = aim - road[2][cell]
            cd, sd = math.cos(on_road), math.sin(on_road)
            height, rise = _rolled(road, u, vv, cd, sd, n, room)
            lean = (
                _height(road, u - 0.06 * sd, vv + 0.06 * cd) - _height(road, u + 0.06 * sd, vv - 0.06 * cd)
            ) / 0.12
            if c[DENT, i] > 0.0:
                turns = (keep[TURNED, i] + c[PHASE, i]) / (2.0 * math.pi)
                angle = 2.0 * math.pi * (turns - math.floor(turns + 0.5)) / _FLAT
                if abs(angle) < 1.0:
                    height -= c[DENT, i] * 0.5 * (1.0 + math.cos(math.pi * angle))
            for k in range(3):
                around[k] = r[b, k, 0] * spin[b, 0] + r[b, k, 1] * spin[b, 1] + r[b, k, 2] * spin[b, 2]
            arm = height - pz
            ahead_of = go[b, 0] * ca + go[b, 1] * sa
            across = -(go[b, 0] + around[1] * arm) * sa + (go[b, 1] - around[0] * arm) * ca
            depth = height + n[RADIUS] + c[SINK, i] - pz
            normal = 0.0
            if depth > 0.0:
                firm = n[TYRE] * (0.25 + 0.75 * c[PRESSURE, i] ** 0.9)
                closing = rise * ahead_of + lean * across - go[b, 2]
                normal = max(firm * depth * (1.0 + n[HARD] * depth) + c[TYRE_DAMPING, i] * closing, 0.0)
            rolls = keep[SPUN, i] * n[RADIUS]
            over = max(abs(rolls), abs(ahead_of))
            keep[ALONG, i], on = _pull(
                keep[ALONG, i], BUILD_UP[0], rolls - ahead_of, over, TRACTION, SHAPE_LONG, normal, dt
            )
            keep[ACROSS, i], side = _pull(
                keep[ACROSS, i], BUILD_UP[1], -across, over, CORNERING, SHAPE_SIDE, normal, dt
            )
            side -= CAMBER * normal * r[b, 2, 1]
            # engine, brake and road on the wheel's spin
            drive = control[1] * 0.5 * n[RADIUS] if (i < 2) == (n[DRIVEN] == 0.0) else 0.0
            if n[CLUTCH] > 0.0 and ahead_of < 6.0:
                grab = math.sin(n[CLUTCH_PITCH] * t)
                drive *= 1.0 + n[CLUTCH] * math.copysign(math.sqrt(abs(grab)), grab) * 0.9
            hold = 0.35 if i < 2 else 0.15
            if n[JUDDER] > 0.0 and i < 2:
                hold *= 1.0 + n[JUDDER] * math.cos(n[TURNS] * keep[TURNED, 0])
            braked = -hold * control[2] * n[RADIUS] * math.tanh((keep[SPUN, i] - spin[b, 1]) / 0.25)
            keep[SPUN, i] += dt / SPIN_INERTIA * (drive + braked - on * n[RADIUS])
            keep[TURNED, i] += dt * keep[SPUN, i]
            up = normal + on * rise + side * lean
            ahead, left = on - normal * rise, side - normal * lean
            gx, gy = ahead * ca - left * sa, ahead * sa + left * ca
            force[b, 0] += gx
            force[b, 1] += gy
            force[b, 2] += up
            # what turns about the axle goes into the spin; the brake holds the carrier, the engine the body
            tx, ty = -arm * gy, arm * gx
            ax, ay, az = r[b, 0, 1], r[b, 1, 1], r[b, 2, 1]
            about = tx * ax + ty * ay + braked
            torque[b, 0] += tx - about * ax
            torque[b, 1] += ty - about * ay
            torque[b, 2] -= about * az
            torque[0, 0] -= drive * r[0, 0, 1]
            torque[0, 1] -= drive * r[0, 1, 1]
            torque[0, 2] -= drive * r[0, 2, 1]
            if c[IMBALANCE, i] > 0.0:  # on the hub: at the front of the wheel it goes down
                swing = c[IMBALANCE, i] * keep[SPUN, i] ** 2
                back = -swing * math.cos(keep[TURNED, i] + c[PHASE, i])
                force[b, 0] += back * ca
                force[b, 1] += back * sa
                force[b, 2] += swing * math.sin(keep[TURNED, i] + c[PHASE, i])
        speed = go[0, 0] * r[0, 0, 0] + go[0, 1] * r[0, 1, 0]
        if n[SHAKE] > 0.0:  # an engine's order, at the front axle
            gear = n[LOW] if speed < n[SHIFT] else n[HIGH]
            extra[0] += dt * 2.0 * math.pi * max(n[IDLE] + gear * max(speed, 0.0), n[FLOOR])
            f = n[SHAKE] * math.sin(extra[0])
            _carried(r[0], at[0], go[0], spin[0], n[BASE] - n[REAR], 0.0, 0.0, 0.0, 0.0, p, v)
            _press(force[0], torque[0], at[0], p, f * r[0, 0, 2], f * r[0, 1, 2], f * r[0, 2, 2])
        if wind.shape[0] > 0:
            k = min(max(int(t / CONTROL), 0), wind.shape[0] - 1)
            _carried(r[0], at[0], go[0], spin[0], 0.45, 0.0, 0.5, 0.0, 0.0, p, v)
            fy, fz = wind[k, 0], wind[k, 1]
            _press(
                force[0], torque[0], at[0], p, fy * r[0, 0, 1] + fz * r[0, 0, 2],
                fy * r[0, 1, 1] + fz * r[0, 1, 2], fy * r[0, 2, 1] + fz * r[0, 2, 2],
            )  # fmt: skip
        for m in range(riders.shape[0]):
            own = riders[m]
            _carried(r[0], at[0], go[0], spin[0], own[R_X], own[R_X + 1], own[R_X + 2], 0.0, 0.0, q, w)
            for k in range(3):
                p[k] = v[k] = 0.0
                for j in range(3):
                    p[k] += r[0, j, k] * (ride[m, j] - q[j])
                    v[k] += r[0, j, k] * (ride[m, 3 + j] - w[j])
                p[k], v[k] = -own[R_KX + k] * p[k], -own[R_CX + k] * v[k]
            if own[R_GAP] > 0.0:  # it lies in a tray with a lid
                above = -p[2] / own[R_KX + 2]
                if above < 0.0:
                    v[2] = max(p[2] + v[2], 0.0)
                elif above > own[R_GAP]:
                    v[2] = min(-own[R_KX + 2] * (above - own[R_GAP]) + v[2], 0.0)
                else:
                    v[2] = 0.0
                p[2] = 0.0
            fx, fy, fz = p[0] + v[0], p[1] + v[1], p[2] + v[2]
            for k in range(3):
                f = r[0, k, 0] * fx + r[0, k, 1] * fy + r[0, k, 2] * fz
                around[k] = f
                ride[m, 3 + k] += dt * (f / own[R_MASS] - (G if k == 2 else 0.0))
                ride[m, k] += dt * ride[m, 3 + k]
            _press(force[0], torque[0], at[0], q, -around[0], -around[1], -around[2])
        dash_rate = 0.0
        if n[BEND_GAIN] != 0.0:
            dash_rate = dashed / n[MASS] - n[BEND_W] ** 2 * dash[0] - 2.0 * n[BEND_Z] * n[BEND_W] * dash[1]
            dash[1] += dt * dash_rate
            dash[0] += dt * dash[1]
        for k in range(3):
            bend[k] = (
                bend[k] / elastic[k, 0]
                - elastic[k, 1] ** 2 * modes[k]
                - 2.0 * elastic[k, 2] * elastic[k, 1] * pace[k]
            )
        for b in range(5):
            mass = n[MASS] if b == 0 else c[CARRIER, b - 1]
            for k in range(3):
                force[b, k] /= mass
                p[k] = r[b, 0, k] * torque[b, 0] + r[b, 1, k] * torque[b, 1] + r[b, 2, k] * torque[b, 2]
            i0, i1, i2 = (n[IX], n[IY], n[IZ]) if b == 0 else CARRIER_INERTIA
            wx, wy, wz = spin[b, 0], spin[b, 1], spin[b, 2]
            torque[b, 0] = (p[0] + (i1 - i2) * wy * wz) / i0
            torque[b, 1] = (p[1] + (i2 - i0) * wz * wx) / i1
            torque[b, 2] = (p[2] + (i0 - i1) * wx * wy) / i2
        if step >= 0 and step % every == 0:
            row = step // every
            wx, wy, wz = spin[0, 0], spin[0, 1], spin[0, 2]
            for k in range(3):  # of the body's centre, in its axes
                p[k] = r[0, 0, k] * force[0, 0] + r[0, 1, k] * force[0, 1] + r[0, 2, k] * (force[0, 2] + G)
            bx, by, bz = torque[0, 0], torque[0, 1], torque[0, 2]
            sx, sy, sz = n[SX], n[SY], n[SZ]
            felt[row, 0] = p[0] + by * sz - bz * sy + wy * (wx * sy - wy * sx) - wz * (wz * sx - wx * sz)
            felt[row, 1] = p[1] + bz * sx - bx * sz + wz * (wy * sz - wz * sy) - wx * (wx * sy - wy * sx)
            felt[row, 2] = p[2] + bx * sy - by * sx + wx * (wz * sx - wx * sz) - wy * (wy * sz - wz * sy)
            felt[row, 1] += phone[2] * bend[2]
            felt[row, 2] += phone[0] * bend[0] + phone[1] * bend[1] + n[BEND_GAIN] * dash_rate
            felt[row, 3] = wx + phone[3] * pace[0]
            felt[row, 4] = wy + phone[4] * pace[0] + phone[5] * pace[1]
            felt[row, 5] = wz + phone[6] * pace[2]
            path[row, :3] = at[0]
            path[row, 3:7] = turn[0]
            path[row, 7] = 0.5 * (keep[AT_U, 2] + keep[AT_U, 3])
            path[row, 8:] = keep[TRAVEL]
            bent[row] = modes
        for k in range(3):
            pace[k] += dt * bend[k]
            modes[k] += dt * pace[k]
        for b in range(5):
            for k in range(3):
                go[b, k] += dt * force[b, k]
                at[b, k] += dt * go[b, k]
                spin[b, k] += dt * torque[b, k]
            wx, wy, wz = spin[b, 0], spin[b, 1], spin[b, 2]
            qw, qa, qb, qc = turn[b, 0], turn[b, 1], turn[b, 2], turn[b, 3]
            half = 0.5 * dt
            nw = qw + half * (-qa * wx - qb * wy - qc * wz)
            na = qa + half * (qw * wx + qb * wz - qc * wy)
            nb = qb + half * (qw * wy + qc * wx - qa * wz)
            nc = qc + half * (qw * wz + qa * wy - qb * wx)
            size = 1.0 / math.sqrt(nw * nw + na * na + nb * nb + nc * nc)
            turn[b, 0], turn[b, 1], turn[b, 2], turn[b, 3] = nw * size, na * size, nb * size, nc * size
        if step < 0:  # the motion left of being put down dies
            go[0, 2] *= 0.9985
            for k in range(3):
                spin[0, k] *= 0.9985
            for m in range(riders.shape[0]):
                for k in range(3):
                    ride[m, 3 + k] *= 0.999
