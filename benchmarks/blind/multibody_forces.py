# SPDX-License-Identifier: Apache-2.0
"""Tyres, springs, dampers and friction of ``multibody``: what is applied to MuJoCo's joints and wheels."""

from __future__ import annotations

import math

from numba import njit

#: Numbers of the whole car.
(
    RADIUS,
    TYRE,
    GRIP,
    DRIVEN,
    PLAY,
    VOID,
    FADE,
    FADE_T,
    CUBIC,
    PATCH,
    POINTS,
    DT,
    GROOVE,
    JUDDER,
    TURNS,
    CLUTCH,
    CLUTCH_PITCH,
) = range(17)
NUMBERS = 17
#: Numbers by wheel, and the states that a wheel keeps from step to step.
(
    REST,
    SINK,
    SPRING,
    DAMPER,
    FRICTION,
    BUMP,
    BUMP_GAP,
    REBOUND,
    REBOUND_GAP,
    MOUNT,
    TYRE_DAMPING,
    IMBALANCE,
    PHASE,
    PRESSURE,
    SKY,
    HOOK,
    DENT,
    WORN,
) = range(18)
BY_WHEEL = 18
STICK, STRETCH, HOLLOW, TURNED, LAST_U, VALVE = range(6)
STATES = 6
LAG = 0.006  # s that a valve takes
STICKING = 2.5e5  # N/m of a strut that does not slip
FOAM = 0.018  # m over which a stop hardens


@njit(cache=True)
def ground(x, y, i, keep, z, du, dv, v0, heading, lx, ly):  # type: ignore[no-untyped-def]
    """Height of the surface at a point, bilinear; wheel i's last place along the road is the first guess."""
    u, v = keep[LAST_U, i], 0.0
    for _ in range(4):
        k = min(max(int(u / du), 0), heading.size - 2)
        c, s = math.cos(heading[k]), math.sin(heading[k])
        u = k * du + (x - lx[k]) * c + (y - ly[k]) * s
        v = (y - ly[k]) * c - (x - lx[k]) * s
    a = min(max(u / du, 0.0), z.shape[0] - 1.001)
    b = min(max((v - v0) / dv, 0.0), z.shape[1] - 1.001)
    p, q = int(a), int(b)
    a, b = a - p, b - q
    keep[LAST_U, i] = u
    low = (1 - b) * z[p, q] + b * z[p, q + 1]
    return (1 - a) * low + a * ((1 - b) * z[p + 1, q] + b * z[p + 1, q + 1])


@njit(cache=True)
def footing(px, py, ca, sa, i, n, keep, road):  # type: ignore[no-untyped-def]
    """Height under wheel i, evenly over its patch, and the surface's slopes ahead and to the left as it points."""
    z, steps, heading, lx, ly = road
    points, height = int(n[POINTS]), 0.0
    for k in range(points):
        d = n[PATCH] * ((k + 0.5) / points - 0.5)
        height += ground(px + d * ca, py + d * sa, i, keep, z, steps[0], steps[1], steps[2], heading, lx, ly)
    height /= points
    e = 0.03 + 0.5 * n[PATCH]
    rise = (
        ground(px + e * ca, py + e * sa, i, keep, z, steps[0], steps[1], steps[2], heading, lx, ly)
        - ground(px - e * ca, py - e * sa, i, keep, z, steps[0], steps[1], steps[2], heading, lx, ly)
    ) / (2 * e)
    lean = (
        ground(px - 0.04 * sa, py + 0.04 * ca, i, keep, z, steps[0], steps[1], steps[2], heading, lx, ly)
        - ground(px + 0.04 * sa, py - 0.04 * ca, i, keep, z, steps[0], steps[1], steps[2], heading, lx, ly)
    ) / 0.08
    return height, rise, lean


@njit(cache=True)
def lookup(table, x, reach):  # type: ignore[no-untyped-def]
    n = table.size - 1
    a = min(max(x / reach, 0.0), 1.0) * n
    i = min(int(a), n - 1)
    return table[i] + (a - i) * (table[i + 1] - table[i])


@njit(cache=True)
def slower(table, force, reach):  # type: ignore[no-untyped-def]
    """Speed at which a damper has this force (regula falsi on its table)."""
    low, high = 0.0, reach
    for _ in range(40):
        middle = 0.5 * (low + high)
        if lookup(table, middle, reach) < force:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@njit(cache=True)
def hooked(i, body, wheel, v, n, w, keep):  # type: ignore[no-untyped-def]
    """Force on wheel i along its travel of a damper whose valve follows the body's or the wheel's velocity with a lag:
    its coefficient is kept, and is never below nothing."""
    if w[SKY, i] == 0.0 and w[HOOK, i] == 0.0:
        return 0.0
    wanted = -w[SKY, i] * body + w[HOOK, i] * wheel
    rate = v if abs(v) > 0.01 else math.copysign(0.01, v)
    most = 3.0 * max(w[SKY, i], w[HOOK, i])
    coefficient = min(max(wanted / rate, 0.0), most)
    keep[VALVE, i] += (coefficient - keep[VALVE, i]) * n[DT] / LAG
    return keep[VALVE, i] * v


@njit(cache=True)
def roll_on(i, spin, n, w, keep):  # type: ignore[no-untyped-def]
    """Turn wheel i on by a step; m by which a flat spot is under it."""
    keep[TURNED, i] += spin * n[DT]
    if w[DENT, i] == 0.0:
        return 0.0
    turns = (keep[TURNED, i] + w[PHASE, i]) / (2.0 * math.pi)
    angle, half = 2.0 * math.pi * (turns - math.floor(turns + 0.5)), 0.15
    return w[DENT, i] * (1.0 - (angle / half) ** 2) if abs(angle) < half else 0.0


@njit(cache=True)
def braked_by(i, brake, n, keep):  # type: ignore[no-untyped-def]
    """Brake force on wheel i of the whole car's, with a disc of uneven thickness in front."""
    share = 0.33 if i < 2 else 0.17
    if n[JUDDER] > 0.0 and i < 2:
        share *= 1.0 + n[JUDDER] * math.sin(n[TURNS] * keep[TURNED, 0])
    return share * brake


@njit(cache=True)
def driven_by(i, drive, t, slow, n):  # type: ignore[no-untyped-def]
    """Drive force on wheel i of the whole car's; a clutch that grabs shakes it while the car is slow."""
    if (i < 2) != (n[DRIVEN] == 0.0):
        return 0.0
    if n[CLUTCH] > 0.0 and slow:
        drive *= 1.0 + n[CLUTCH] * math.copysign(1.0, math.sin(n[CLUTCH_PITCH] * t)) * 0.8
    return 0.5 * drive


@njit(cache=True)
def tyre(i, n, w):  # type: ignore[no-untyped-def]
    """N/m of a tyre: its air and its carcass."""
    return n[TYRE] * w[PRESSURE, i] ** 0.72


@njit(cache=True)
def strut(i, s, v, t, n, w, keep, springs, pushes, pulls, spring_reach, damper_reach):  # type: ignore[no-untyped-def]
    """Force along the slide on wheel i, and its kept states one step on."""
    axle, dt = i // 2, n[DT]
    force = w[SPRING, i] * lookup(springs[axle], w[REST, i] + s, spring_reach) + n[CUBIC] * s**3
    pressed = s - w[BUMP_GAP, i]
    if pressed > 0.0:
        force += w[BUMP, i] * FOAM * (math.exp(min(pressed / FOAM, 4.0)) - 1.0)
    pressed = -s - w[REBOUND_GAP, i]
    if pressed > 0.0:
        force -= w[REBOUND, i] * FOAM * (math.exp(min(pressed / FOAM, 4.0)) - 1.0)
    keep[STICK, i] += v * dt
    if w[FRICTION, i] > 0.0:
        most = w[FRICTION, i] / STICKING
        keep[STICK, i] = min(max(keep[STICK, i], -most), most)
        force += STICKING * keep[STICK, i]
    scale = w[DAMPER, i] * (1.0 - n[FADE] * (1.0 - math.exp(-max(t, 0.0) / n[FADE_T])))
    # grooves in the tube: free in the middle, shut within a centimetre
    scale *= 1.0 + n[GROOVE] / (1.0 + math.exp(-(abs(s) - 0.02) / 0.004))
    if w[MOUNT, i] > 0.0 or n[PLAY] > 0.0:
        z = keep[STRETCH, i]
        if n[PLAY] > 0.0:
            held = 5e5 * math.copysign(max(abs(z) - 0.5 * n[PLAY], 0.0), z)
        else:
            held = w[MOUNT, i] * z
        table = pushes[axle] if held > 0.0 else pulls[axle]
        inner = math.copysign(slower(table, abs(held) / scale, damper_reach), held) if held != 0.0 else 0.0
        keep[STRETCH, i] += (v - inner) * dt
        return force + held
    if n[VOID] > 0.0:
        # A quick compression tears the oil; the rebound has to close the void before it holds again.
        if v > 0.1:
            keep[HOLLOW, i] = min(keep[HOLLOW, i] + 0.5 * (v - 0.1) * dt, n[VOID])
        elif v < 0.0 and keep[HOLLOW, i] > 0.0:
            keep[HOLLOW, i] = max(keep[HOLLOW, i] + v * dt, 0.0)
            return force
    if v >= 0.0:
        # a worn valve holds the push a little better than the pull
        return force + scale * (1.0 - 0.93 * w[WORN, i]) * lookup(pushes[axle], v, damper_reach)
    scale *= 1.0 - w[WORN, i]
    return force - scale * lookup(pulls[axle], -v, damper_reach)


@njit(cache=True)
def apply(t, qpos, qvel, xmat, xpos, axes, control, n, w, keep, tables, reaches, road, applied, outer):  # type: ignore[no-untyped-def]
    """Fill joint forces ``applied`` (from index 6 on) and wheel wrenches ``outer`` (4, 6) for one step."""
    springs, pushes, pulls = tables
    steer, drive, brake = control
    b = qvel[3:6]
    wx = xmat[0, 0] * b[0] + xmat[0, 1] * b[1] + xmat[0, 2] * b[2]
    wy = xmat[1, 0] * b[0] + xmat[1, 1] * b[1] + xmat[1, 2] * b[2]
    wz = xmat[2, 0] * b[0] + xmat[2, 1] * b[1] + xmat[2, 2] * b[2]
    facing = math.atan2(xmat[1, 0], xmat[0, 0])
    for i in range(4):
        s, v = qpos[7 + i], qvel[6 + i]
        applied[6 + i] = -strut(i, s, v, t, n, w, keep, springs, pushes, pulls, reaches[0], reaches[1])
        px, py, pz = xpos[i, 0], xpos[i, 1], xpos[i, 2]
        aim = facing + (steer if i < 2 else 0.0)
        ca, sa = math.cos(aim), math.sin(aim)
        height, rise, lean = footing(px, py, ca, sa, i, n, keep, road)
        height -= roll_on(i, (qvel[0] * ca + qvel[1] * sa) / n[RADIUS], n, w, keep)
        dx, dy, dz = px - qpos[0], py - qpos[1], pz - qpos[2]
        qx = qvel[0] + wy * dz - wz * dy + v * axes[i, 0]
        qy = qvel[1] + wz * dx - wx * dz + v * axes[i, 1]
        over = qvel[2] + wx * dy - wy * dx
        qz = over + v * axes[i, 2]
        applied[6 + i] -= hooked(i, over, qz, v, n, w, keep)
        arm = height - pz
        fx, fy = qx + wy * arm, qy - wx * arm  # of the tyre's foot
        along, across = fx * ca + fy * sa, -fx * sa + fy * ca
        depth = height + n[RADIUS] + w[SINK, i] - pz
        normal = 0.0
        if depth > 0.0:
            normal = max(
                tyre(i, n, w) * depth + w[TYRE_DAMPING, i] * (rise * along + lean * across - qz), 0.0
            )
        side = -normal * min(max(n[GRIP] * math.atan(across / (abs(along) + 0.8)), -0.9), 0.9)
        on = driven_by(i, drive, t, along < 6.0, n) - braked_by(i, brake, n, keep) * math.tanh(along / 0.03)
        on = min(max(on, -0.9 * normal), 0.9 * normal)
        up = normal + on * rise + side * lean
        ahead, left = on - normal * rise, side - normal * lean
        if w[IMBALANCE, i] > 0.0:
            spin = along / n[RADIUS]
            up += w[IMBALANCE, i] * spin * spin * math.sin(keep[TURNED, i] + w[PHASE, i])
            ahead += w[IMBALANCE, i] * spin * spin * math.cos(keep[TURNED, i] + w[PHASE, i])
        gx, gy = ahead * ca - left * sa, ahead * sa + left * ca
        outer[i, 0], outer[i, 1], outer[i, 2] = gx, gy, up
        outer[i, 3], outer[i, 4], outer[i, 5] = -arm * gy, arm * gx, 0.0
