# SPDX-License-Identifier: Apache-2.0
"""A tracked vehicle that is not our model: every link a rigid body, driven by its sprocket.

Nothing of ``suspension_twin.models`` is used. The loop is closed by 97 rigid links of three degrees of
freedom each, joined by bushings (k_gl, b_gl in both directions, k_g_phi and b_g_phi about the axis), and
lies around sprocket, idler, return rollers and road wheels by contact alone; the hull moves freely
forwards, heaves and pitches, and goes where the sprocket drives it, with friction and slip on the
ground. What the model leaves out is here: traction and the dive that comes with it, the sag of the upper
run, friction in the arms' bearings, dampers that blow off, bars and rubber that stiffen.

``simulate`` gives true marker motion, ``photogrammetry`` what a camera's tool makes of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.spatial import ConvexHull

from suspension_twin.vehicle.tracked import TrackedVehicle

Floats = NDArray[np.float64]
G = 9.80665
STEP = 1.0e-4  # s
RATE = 500.0  # Hz of the recorded truth
SETTLE = 1.5  # s
LEAD = 0.5  # m between the idler and the obstacle at the start
POINTS = 5  # of contact along each link
TEETH = 0.02  # m by which the sprocket's teeth reach beyond its circle
_RUN_UP = 1.5  # s to come to speed
_STEADY = 1.0  # s at speed before the clock of a run begins


@dataclass(frozen=True)
class Faults:
    """What is wrong with this specimen, beyond its own parameters; neutral by default."""

    damper: tuple[float, ...] = (1.0,) * 6  # factor of each station's damping
    sag: tuple[float, ...] = (0.0,) * 6  # rad by which a torsion bar has set
    payload: float = 0.0  # kg, both sides
    payload_x: float = 2.8  # m from the sprocket


@njit(cache=True)
def _ground(x: float, height: float, ramp: float, top: float) -> tuple[float, float]:
    if x <= 0.0 or x >= 2 * ramp + top:
        return 0.0, 0.0
    if x < ramp:
        return height * x / ramp, height / ramp
    if x <= ramp + top:
        return height, 0.0
    return height * (2 * ramp + top - x) / ramp, -height / ramp


@njit(cache=True)
def _run(
    link: Floats,
    inverse: Floats,
    pitch: float,
    half: float,
    mass: float,
    inertia: float,
    kl: float,
    bl: float,
    kphi: float,
    circles: Floats,
    hull: Floats,
    body: Floats,
    arms: Floats,
    arm: Floats,
    stations: Floats,
    obstacle: Floats,
    speed: float,
    dt: float,
    settle: int,
    steps: int,
    every: int,
    out: Floats,
) -> bool:
    """``link`` (6, N) x, z, phi and rates; ``circles`` (C, 3) on the hull, the sprocket first, x, z, radius;
    ``hull`` (6,) x, z, theta and rates; ``arms`` (2, S); ``out`` (n, 5) hull x, z, theta, mean tension, arm 0."""
    n, s = link.shape[1], arms.shape[1]
    fx, fz, torque, old = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    q = s + 3
    matrix, right = np.zeros((q, q)), np.zeros(q)
    wheel = np.zeros((s, 4))
    push = np.zeros((s, 2))
    row, held = 0, 0.0
    for step in range(settle + steps):
        moving = step >= settle
        wanted = 0.0
        if moving:  # a driver who comes to speed and holds it
            aim = speed * min(1.0, (step - settle) * dt / _RUN_UP)
            held += dt * 12.0 * (aim - hull[3])
            wanted = aim + held + 4.0 * (aim - hull[3])
        for i in range(n):
            fx[i], fz[i], torque[i] = 0.0, -mass * G, 0.0
        pull = 0.0
        h = 0.5 * pitch
        for i in range(n):
            j = i + 1 if i < n - 1 else 0
            c1, s1, c2, s2 = (
                math.cos(link[2, i]),
                math.sin(link[2, i]),
                math.cos(link[2, j]),
                math.sin(link[2, j]),
            )
            dx = link[0, j] - h * c2 - link[0, i] - h * c1
            dz = link[1, j] - h * s2 - link[1, i] - h * s1
            vx = link[3, j] + h * s2 * link[5, j] - link[3, i] + h * s1 * link[5, i]
            vz = link[4, j] - h * c2 * link[5, j] - link[4, i] - h * c1 * link[5, i]
            ax, az = kl * dx + bl * vx, kl * dz + bl * vz
            fx[i] += ax
            fz[i] += az
            fx[j] -= ax
            fz[j] -= az
            torque[i] += h * (c1 * az - s1 * ax)
            torque[j] += h * (c2 * az - s2 * ax)
            turn = link[2, j] - link[2, i] - (2 * math.pi if j == 0 else 0.0)
            torque[i] += kphi * turn
            torque[j] -= kphi * turn
            pull += ax * c1 + az * s1
        hx, hz, th, hvx, hvz, thv = hull[0], hull[1], hull[2], hull[3], hull[4], hull[5]
        ct, st = math.cos(th), math.sin(th)
        hfx, hfz, hm = 0.0, 0.0, 0.0
        for k in range(s):
            a = arms[0, k]
            px, pz = stations[k, 0], stations[k, 1]
            rx, rz = px * ct + pz * st, pz * ct - px * st
            wheel[k, 0] = hx + rx - arm[0] * math.cos(a)
            wheel[k, 1] = hz + rz - arm[0] * math.sin(a)
            wheel[k, 2] = hvx + thv * rz + arm[0] * math.sin(a) * arms[1, k]
            wheel[k, 3] = hvz - thv * rx - arm[0] * math.cos(a) * arms[1, k]
            push[k, 0], push[k, 1] = 0.0, 0.0
        for i in range(n):
            c1, s1 = math.cos(link[2, i]), math.sin(link[2, i])
            for p in range(POINTS):
                along = pitch * ((p + 0.5) / POINTS - 0.5)
                ox, oz = along * c1, along * s1
                # the side of the wheels
                ix, iz = ox + half * s1, oz - half * c1
                x, z = link[0, i] + ix, link[1, i] + iz
                vx, vz = link[3, i] - iz * link[5, i], link[4, i] + ix * link[5, i]
                for k in range(s):
                    if abs(link[0, i] - wheel[k, 0]) > arm[2] + pitch:
                        continue
                    ddx, ddz = x - wheel[k, 0], z - wheel[k, 1]
                    square = ddx * ddx + ddz * ddz
                    if square < arm[2] * arm[2] and square > 0.01:
                        r = math.sqrt(square)
                        over = arm[2] - r
                        ux, uz = ddx / r, ddz / r
                        rate = -(vx - wheel[k, 2]) * ux - (vz - wheel[k, 3]) * uz
                        force = max(
                            0.0, arm[3] * (over + 40.0 * over * over) + arm[4] * min(1.0, over / 1e-3) * rate
                        )
                        fx[i] += force * ux
                        fz[i] += force * uz
                        torque[i] += force * (ix * uz - iz * ux)
                        push[k, 0] -= force * ux
                        push[k, 1] -= force * uz
                for k in range(circles.shape[0]):
                    if abs(link[0, i] - hx - circles[k, 0]) > circles[k, 2] + 4 * pitch:
                        continue
                    cx, cz = circles[k, 0] * ct + circles[k, 1] * st, circles[k, 1] * ct - circles[k, 0] * st
                    ddx, ddz = x - hx - cx, z - hz - cz
                    square = ddx * ddx + ddz * ddz
                    toothed = k == 0 and p == POINTS // 2
                    reach = circles[k, 2] + TEETH if toothed else circles[k, 2]
                    if square < reach * reach and square > 1e-4:
                        r = math.sqrt(square)
                        over = circles[k, 2] - r
                        ux, uz = ddx / r, ddz / r
                        bx, bz = x - hx, z - hz
                        rvx, rvz = vx - hvx - thv * bz, vz - hvz + thv * bx
                        rate = -rvx * ux - rvz * uz
                        force = 0.0
                        if over > 0.0:
                            force = max(0.0, 1e7 * over + 8e3 * min(1.0, over / 1e-3) * rate)
                        ffx, ffz = force * ux, force * uz
                        if toothed:  # by its shape a tooth takes its link along, however slack the track
                            tooth = 6e4 * (wanted - (rvx * uz - rvz * ux))
                            ffx += tooth * uz
                            ffz -= tooth * ux
                        fx[i] += ffx
                        fz[i] += ffz
                        torque[i] += ix * ffz - iz * ffx
                        hfx -= ffx
                        hfz -= ffz
                        hm -= bz * ffx - bx * ffz
                # the side of the ground
                ix, iz = ox - half * s1, oz + half * c1
                x, z = link[0, i] + ix, link[1, i] + iz
                level, slope = _ground(x, obstacle[0], obstacle[1], obstacle[2])
                if z < level:
                    size = math.sqrt(1.0 + slope * slope)
                    ux, uz = -slope / size, 1.0 / size
                    over = (level - z) / size
                    vx, vz = link[3, i] - iz * link[5, i], link[4, i] + ix * link[5, i]
                    rate = -vx * ux - vz * uz
                    force = max(0.0, obstacle[3] * over + obstacle[4] * min(1.0, over / 1e-3) * rate)
                    rub = -0.8 * force * math.tanh((vx * uz - vz * ux) / 0.05)
                    ffx, ffz = force * ux + rub * uz, force * uz - rub * ux
                    fx[i] += ffx
                    fz[i] += ffz
                    torque[i] += ix * ffz - iz * ffx
        # hull and arms, pitch positive nose down: J of a point (rx, rz) is (rz, -rx)
        matrix[:] = 0.0
        right[:] = 0.0
        matrix[0, 0] = matrix[1, 1] = body[0]
        matrix[2, 2] = body[1]
        right[0], right[1], right[2] = hfx, hfz - body[0] * G, hm
        for k in range(s):
            a, av = arms[0, k], arms[1, k]
            px, pz = stations[k, 0], stations[k, 1]
            rx, rz = px * ct + pz * st, pz * ct - px * st
            ca, sa = arm[0] * math.cos(a), arm[0] * math.sin(a)
            jt0, jt1, ja0, ja1 = rz, -rx, sa, -ca
            wx = push[k, 0] - arm[1] * (-rx * thv * thv + ca * av * av)
            wz = push[k, 1] - arm[1] * (G - rz * thv * thv + sa * av * av)
            c = 3 + k
            matrix[0, 0] += arm[1]
            matrix[1, 1] += arm[1]
            matrix[0, 2] += arm[1] * jt0
            matrix[1, 2] += arm[1] * jt1
            matrix[2, 2] += arm[1] * (jt0 * jt0 + jt1 * jt1)
            matrix[0, c] += arm[1] * ja0
            matrix[1, c] += arm[1] * ja1
            matrix[2, c] += arm[1] * (jt0 * ja0 + jt1 * ja1)
            matrix[c, c] += arm[1] * (ja0 * ja0 + ja1 * ja1)
            phi, rate = a + th, av + thv
            twist = phi - arm[5] + stations[k, 3]
            tau = -arm[6] * twist * (1.0 + 0.25 * twist * twist)
            if phi < arm[7]:
                tau -= 1e6 * (phi - arm[7])
            elif phi > arm[8]:
                tau -= 1e6 * (phi - arm[8])
            damping = stations[k, 2] if moving else 3e4
            # a vane damper whose valve opens: its torque grows slower than its speed
            tau -= damping * rate / (1.0 + 0.12 * abs(rate)) + arm[9] * math.tanh(rate / 0.02)
            right[0] += wx
            right[1] += wz
            right[2] += jt0 * wx + jt1 * wz + tau
            right[c] += ja0 * wx + ja1 * wz + tau
        for a1 in range(q):
            for b1 in range(a1):
                matrix[a1, b1] = matrix[b1, a1]
        gain = np.linalg.solve(matrix, right)
        if not moving:
            gain[0] = -50.0 * hull[3]
        hull[3:] += dt * gain[:3]
        hull[:3] += dt * hull[3:]
        arms[1] += dt * gain[3:]
        arms[0] += dt * arms[1]
        for i in range(n):
            old[i] = inertia * link[5, i] + dt * torque[i]
        calm = 1.0 if moving else 1.0 - 2.0 * dt
        for i in range(n):
            total = inverse[0] * old[i]
            for j in range(1, inverse.size):
                total += inverse[j] * (old[(i + j) % n] + old[i - j])
            link[5, i] = total * calm
            link[3, i] = (link[3, i] + dt * fx[i] / mass) * calm
            link[4, i] = (link[4, i] + dt * fz[i] / mass) * calm
            link[0, i] += dt * link[3, i]
            link[1, i] += dt * link[4, i]
            link[2, i] += dt * link[5, i]
        if moving and (step - settle) % every == 0:
            out[row, 0], out[row, 1], out[row, 2] = hull[0], hull[1], hull[2]
            out[row, 3], out[row, 4] = pull / n, arms[0, 0] + hull[2]
            row += 1
            if not (abs(hull[1]) < 10.0 and abs(hull[2]) < 1.0):
                return False
    return True


def _loop(vehicle: TrackedVehicle, idler_x: float) -> Floats:
    """Corners (m, 2) of the taut loop around all circles, in the sense in which the track runs."""
    v, half = vehicle, 0.5 * vehicle.track.thickness
    circles = [(idler_x, v.idler.height, v.idler.radius), (*v.sprocket.position, v.sprocket.radius)]
    circles += [(s.x, v.wheel_height, v.wheel.radius) for s in v.stations]
    angle = np.linspace(0, 2 * np.pi, 721)
    points = np.concatenate(
        [np.stack([x + (r + half) * np.cos(angle), z + (r + half) * np.sin(angle)], 1) for x, z, r in circles]
    )
    corners = points[ConvexHull(points).vertices][::-1]  # clockwise: front, below, rear, above
    return np.vstack([corners, corners[:1]])


def simulate(
    vehicle: TrackedVehicle,
    speed: float,
    duration: float,
    faults: Faults = Faults(),
    taut_at: float = -5552.0,
) -> dict[str, Floats]:
    """True motion at 500 Hz from standing: ``t`` s, ``x`` m of the CoG, ``markers`` (n, 3) m of A, B, C upwards
    from the standing vehicle, ``standing`` (3,) m their heights there, ``tension`` N. ``taut_at`` mm is where this
    specimen's track begins to pull."""
    v, track = vehicle, vehicle.track
    n = track.links
    free = _loop(v, -taut_at / 1000)
    pitch = float(np.hypot(*np.diff(free, axis=0).T).sum()) / n
    idler_x = -v.idler.setting / 1000
    corners = _loop(v, idler_x)
    walked = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    joints = np.linspace(0.0, walked[-1], n + 1)
    at = np.stack([np.interp(joints, walked, corners[:, i]) for i in (0, 1)], axis=1)
    link = np.zeros((6, n))
    link[:2] = (0.5 * (at[1:] + at[:-1])).T
    link[2] = np.unwrap(np.arctan2(*(at[1:] - at[:-1]).T[::-1]))
    link[2] -= 2 * np.pi * round((link[2, 0] - math.pi) / (2 * np.pi))
    half = 0.5 * track.thickness
    ahead = -LEAD - v.idler.radius - idler_x
    foot = ahead - speed * (0.5 * _RUN_UP + _STEADY)
    link[0] += foot
    cog_x, cog_z = v.cog
    hull_mass = v.hull_mass
    extra = 0.5 * faults.payload
    centre = np.array(
        [(hull_mass * cog_x + extra * faults.payload_x), hull_mass * cog_z + extra * (cog_z + 0.5)]
    )
    centre /= hull_mass + extra
    inertia = (
        hull_mass * (v.gyration**2 + (centre[0] - cog_x) ** 2) + extra * (centre[0] - faults.payload_x) ** 2
    )
    a0 = v.arm.standing_angle
    stations = np.array(
        [
            [
                s.x + v.arm.length * math.cos(a0) - centre[0],
                v.wheel_height + v.arm.length * math.sin(a0) - centre[1],
                s.damping * f,
                s.sag + sag,
            ]
            for s, f, sag in zip(v.stations, faults.damper, faults.sag, strict=True)
        ]
    )
    circles = np.array(
        [
            [-centre[0], -centre[1], v.sprocket.radius],
            [idler_x - centre[0], v.idler.height - centre[1], v.idler.radius],
            *(
                [x - centre[0], 0.305 - 0.11 - 0.03 * i - centre[1], 0.11]
                for i, x in enumerate((1.4, 2.8, 4.2))
            ),
        ]
    )
    spacing = pitch / POINTS
    arm = np.array(
        [
            v.arm.length,
            v.wheel.mass,
            v.wheel.radius,
            v.wheel.rubber * spacing,
            v.wheel.rubber_damping * spacing,
            v.arm.free_angle,
            v.arm.stiffness,
            v.arm.jounce_stop,
            v.arm.rebound_stop,
            250.0,
        ]
    )
    o = v.obstacle
    obstacle = np.array(
        [
            o.height,
            o.ramp,
            o.top,
            v.ground.stiffness * spacing,
            v.ground.damping * spacing,
        ]
    )
    link[1] -= v.ground_height
    hull = np.array([foot + centre[0], centre[1] - v.ground_height, 0.0, 0.0, 0.0, 0.0])
    arms = np.stack([np.full(len(stations), a0), np.zeros(len(stations))])
    rotary = track.link_mass * (pitch**2 / 12 + track.thickness**2 / 12)
    ring = 2 * np.eye(n) - np.roll(np.eye(n), 1, 0) - np.roll(np.eye(n), -1, 0)
    # the same row for every link; what lies far off is nothing
    row = np.linalg.inv(
        rotary * np.eye(n) + STEP * (track.bending_damping + STEP * track.bending_stiffness) * ring
    )[0]
    inverse = row[: min(n // 2, int(np.flatnonzero(np.abs(row[: n // 2]) > 1e-9 * row[0])[-1]) + 1)].copy()
    every = round(1.0 / RATE / STEP)
    steps = round((duration + _RUN_UP + 1.3 * _STEADY) / STEP) + 1
    out = np.zeros(((steps - 1) // every + 1, 5))
    sound = _run(
        link,
        inverse,
        pitch,
        half,
        track.link_mass,
        rotary,
        track.stiffness,
        track.damping,
        track.bending_stiffness,
        circles,
        hull,
        np.array([hull_mass + extra, inertia]),
        arms,
        arm,
        stations,
        obstacle,
        speed,
        STEP,
        round(SETTLE / STEP),
        steps,
        every,
        out,
    )
    if not (sound and np.isfinite(out).all()):
        raise RuntimeError("the reality diverged: choose softer links")
    marks = np.array([v.markers.A, v.markers.B, v.markers.C]) / 1000
    x, up = -marks[:, 0] - centre[0], marks[:, 1] - centre[1]
    height = out[:, 1:2] - x * np.sin(out[:, 2:3]) + up * np.cos(out[:, 2:3])
    begin = int(np.searchsorted(out[:, 0], ahead + centre[0]))
    part = slice(begin, begin + round(duration * RATE) + 1)
    kept = out[part]
    return {
        "t": np.arange(kept.shape[0]) / RATE,
        "x": kept[:, 0],
        "markers": height[part] - height[0],
        "standing": height[0],
        "pitch": kept[:, 2],
        "tension": kept[:, 3],
    }


def photogrammetry(
    motion: dict[str, Floats],
    seed: int,
    *,
    rate: float = 100.0,
    noise: float = 0.6e-3,
    scale: float = 1.0,
    late: float = 0.0,
    tilt: float = 0.0,
) -> Floats:
    """What a camera's tool gives (n, 10): s, then for A, B, C mm, m/s and m/s² upwards.

    Displacements carry white ``noise`` m; velocity and acceleration are derivatives of a smoothing spline
    through them that passes 8 Hz. ``scale`` is the camera's scale, ``late`` s its clock, ``tilt`` rad its roll about
    the axis of view: a part of the travel is then taken for height.
    """
    rng = np.random.default_rng(seed)
    t, z = motion["t"], motion["markers"] - tilt * (motion["x"] - motion["x"][0])[:, None]
    stamps = np.arange(0.0, t[-1] - 0.2 + 1e-9, 1.0 / rate)
    columns = [stamps]
    for k in range(3):
        seen = scale * np.interp(stamps - late, t, z[:, k]) + rng.normal(0.0, noise, stamps.size)
        spline = make_smoothing_spline(stamps, seen, lam=rate / (2 * np.pi * 8.0) ** 4)
        columns += [1e3 * spline(stamps), spline(stamps, 1), spline(stamps, 2)]
    return np.column_stack(columns)
