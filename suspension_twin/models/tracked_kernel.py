# SPDX-License-Identifier: Apache-2.0
"""The compiled part of the model ``tracked``: one lane from stamp to stamp. The model is described in ``tracked``.

World axes x forwards, z up; pitch theta is positive nose down; the angle alpha of an arm is
absolute (below the horizontal), so that an arm's angle against the hull is alpha + theta. The
hull's place in its own axes counts from the centre of gravity (CoG) of the hull.
"""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models.types import Ints
from suspension_twin.units import STANDARD_GRAVITY as G

__all__ = ["COLUMNS", "HULL", "PARAMETERS", "first_index", "walk_lane"]

PARAMETERS = (
    "hull_mass",
    "hull_inertia",
    "sprocket_x",
    "sprocket_z",
    "sprocket_radius",
    "idler_x",
    "idler_z",
    "idler_radius",
    "loop_stiffness",
    "loop_damping",
    "free_length",
    "bending_stiffness",
    "bending_damping",
    "wheel_radius",
    "wheel_mass",
    "rubber",
    "rubber_damping",
    "arm",
    "free",
    "bar",
    "jounce",
    "rebound",
    "stop",
    "ground",
    "ground_damping",
    "thickness",
    "node_mass",
    "spacing",
    "first_node",
    "height",
    "kick",
    "pitch_kick",
    "governed",
    "governor",
    "reset",
    "droop",
    "pulling_links",
    "returning_links",
)
#: Recorded at each stamp, then the arm angles against the hull (S) and the wheel loads in N (S): heave, pitch,
#: their rates, their accelerations, tension, force of the ground, energy, the energy lost and how far the vehicle is
#: ahead of its way.
COLUMNS = 11
#: State of the hull: heave, pitch, their rates, energy lost; how far it is ahead of its way, how fast that grows, its
#: acceleration, and by how much the driven span is stretched beyond the loop, m.
HULL = 9

_SETTLING = 3.0e4  # N m s/rad on every arm while the vehicle comes to rest
_ONSET = 1.0e-3  # m of contact over which its damping grows to its full value


@compiled
def _factor(n: int, mass: float, weight: float, d: Floats, e: Floats, f: Floats) -> None:
    """LDL' of mass + weight * (second differences)'(second differences), five diagonals."""
    for i in range(n):
        d[i], e[i], f[i] = mass, 0.0, 0.0
    for i in range(1, n - 1):
        d[i - 1] += weight
        d[i] += 4.0 * weight
        d[i + 1] += weight
        e[i - 1] -= 2.0 * weight
        e[i] -= 2.0 * weight
        f[i - 1] += weight
    for i in range(n):
        if i >= 1:
            d[i] -= e[i - 1] * e[i - 1] * d[i - 1]
        if i >= 2:
            d[i] -= f[i - 2] * f[i - 2] * d[i - 2]
        if i < n - 1:
            value = e[i]
            if i >= 1:
                value -= f[i - 1] * e[i - 1] * d[i - 1]
            e[i] = value / d[i]
        if i < n - 2:
            f[i] = f[i] / d[i]


@compiled
def _solve(n: int, d: Floats, e: Floats, f: Floats, x: Floats) -> None:
    """x := A^-1 x with the factors of ``_factor``."""
    for i in range(1, n):
        x[i] -= e[i - 1] * x[i - 1]
        if i >= 2:
            x[i] -= f[i - 2] * x[i - 2]
    for i in range(n):
        x[i] /= d[i]
    for i in range(n - 2, -1, -1):
        x[i] -= e[i] * x[i + 1]
        if i < n - 2:
            x[i] -= f[i] * x[i + 2]


@compiled
def tangent(dx: float, dz: float, r: float, side: float) -> tuple[float, float, float]:
    """Direction of the lower tangent from a circle to the point (dx, dz), and its length.

    ``side`` is +1 for the idler (the point behind it), -1 for the sprocket (the point in front).
    """
    square = dx * dx + dz * dz
    t = math.sqrt(max(square - r * r, 1e-12))
    scale = t / square
    turn = side * r / square
    # d = (t + i side r) u in complex notation
    return dx * scale + dz * turn, dz * scale - dx * turn, t


@compiled
def first_index(p: Floats, x: float) -> int:
    """Place of the chain's rearmost node in node spacings when the CoG is at ``x``."""
    place: int = math.ceil((x + p[28]) / p[27])
    return place


@compiled
def _roll_on(p: Floats, w: Floats, wv: Floats, hull: Floats, x: float, index: int, lead: int) -> None:
    """The nodes keep their place on the ground: new ones come in front, or behind where it reverses."""
    sx, sz, sr, ix, iz, ir, cell = p[2], p[3], p[4], p[5], p[6], p[7], p[27]
    n = w.size
    cs, sn = math.cos(hull[1]), math.sin(hull[1])
    while index < lead:
        for i in range(n - 1):
            w[i], wv[i] = w[i + 1], wv[i + 1]
        index += 1
        px, pz = x + ix * cs + iz * sn, hull[0] - ix * sn + iz * cs
        before = (index + n - 2) * cell
        ux, uz, _ = tangent(before - px, w[n - 2] - pz, ir, 1.0)
        qx, qz = px - ir * uz, pz + ir * ux
        share = cell / (qx - before)
        w[n - 1] = w[n - 2] + share * (qz - w[n - 2])
        wv[n - 1] = wv[n - 2] + share * (hull[2] - hull[3] * (qx - x) - wv[n - 2])
    while index > lead:
        for i in range(n - 1, 0, -1):
            w[i], wv[i] = w[i - 1], wv[i - 1]
        index -= 1
        px, pz = x + sx * cs + sz * sn, hull[0] - sx * sn + sz * cs
        before = (index + 1) * cell
        ux, uz, _ = tangent(before - px, w[1] - pz, sr, -1.0)
        qx, qz = px + sr * uz, pz - sr * ux
        share = cell / (before - qx)
        w[0] = w[1] + share * (qz - w[1])
        wv[0] = wv[1] + share * (hull[2] - hull[3] * (qx - x) - wv[1])


@compiled
def walk_lane(
    p: Floats,
    st: Floats,
    shape: Floats,
    floor: Floats,
    base: int,
    per: int,
    travel: Floats,
    accel: Floats,
    interval: Floats,
    counts: Ints,
    settle: int,
    settle_dt: float,
    hull: Floats,
    arms: Floats,
    track: Floats,
    mark: Ints,
    out: Floats,
) -> bool:
    """Walk a lane from the first to the last of n stamps, its state in place; False where it diverges.

    ``p`` (P,) in the order of ``PARAMETERS``; ``st`` (S, 5): pivot x and z, damping, sag, first angle; ``shape``
    (Q, 3): places along a wheel, its arc there (R - sqrt(R² - s²)) and the weight in m. ``floor`` (m,) m heights
    of the ground at (``base`` + j + 0.5) / ``per`` node spacings. ``travel`` (n,) m and ``accel`` (n,) m/s² of the
    CoG along the way; ``interval`` (n - 1,) s in ``counts`` steps each. ``settle`` steps of ``settle_dt`` s of
    standing still come first; 0 goes on. State: ``hull`` (``HULL``,); ``arms`` (2, S) angle and rate; ``track``
    (2, nodes) height and rate; ``mark`` (1,) index of the first node. ``out`` (n, ``COLUMNS`` + 2 S).

    With "governed" the way is only where a driver wants to be. The sprocket then winds in the span to the last wheel
    and gives to the run above, as the ground holds the track between the wheels; see ``tracked``.
    """
    count, nodes, stamps = st.shape[0], track.shape[1], travel.size
    (
        hull_mass,
        inertia,
        sx,
        sz,
        sr,
        ix,
        iz,
        ir,
        loop_k,
        loop_b,
        free_length,
        bend_k,
        bend_b,
        radius,
        wheel_mass,
        rubber,
        rubber_b,
        arm,
        free,
        bar,
        jounce,
        rebound,
        stop,
        ground,
        ground_b,
        thick,
        node_mass,
        cell,
        first,
        height,
    ) = (
        p[0],
        p[1],
        p[2],
        p[3],
        p[4],
        p[5],
        p[6],
        p[7],
        p[8],
        p[9],
        p[10],
        p[11],
        p[12],
        p[13],
        p[14],
        p[15],
        p[16],
        p[17],
        p[18],
        p[19],
        p[20],
        p[21],
        p[22],
        p[23],
        p[24],
        p[25],
        p[26],
        p[27],
        p[28],
        p[29],
    )
    alpha, alpha_v, alpha_a = arms[0], arms[1], np.zeros(count)
    load, along, torque = np.zeros(count), np.zeros(count), np.zeros(count)
    across = np.zeros(count)
    damper_c, cosine, sine = np.zeros(count), np.zeros(count), np.zeros(count)
    w, wv, fw = track[0], track[1], np.zeros(nodes)
    slope = np.zeros(nodes)
    d, e, f = np.empty(nodes), np.empty(nodes), np.empty(nodes)
    governed, governor, reset, droop, pulling, returning = p[32] > 0.0, p[33], p[34], p[35], p[36], p[37]
    ahead, ahead_v, ahead_a, drawn = hull[5], hull[6], hull[7], hull[8]
    wholly = hull_mass + count * wheel_mass
    factored = 0.0
    hub = wheel_mass * arm * arm
    per_cell, piece = 1.0 / cell, cell / per
    index = mark[0]
    stamp, sub, aim, dt, push_on = 0, 0, 0.0, settle_dt, 0.0
    z, theta, zv, theta_v, za, theta_a = hull[0], hull[1], hull[2], hull[3], 0.0, 0.0
    while True:
        moving = settle == 0
        x = travel[stamp]
        if moving and stamp < stamps - 1:
            part = sub / counts[stamp]
            dt = interval[stamp] / counts[stamp]
            aim = (travel[stamp + 1] - travel[stamp]) / interval[stamp]
            x = travel[stamp] + part * (travel[stamp + 1] - travel[stamp])
            push_on = accel[stamp] + part * (accel[stamp + 1] - accel[stamp])
        x += ahead
        v = aim + ahead_v
        if dt != factored:
            _factor(nodes, node_mass, dt * bend_b / (cell * cell) + dt * dt * bend_k / (cell * cell), d, e, f)
            factored = dt
        lead = math.ceil((x + first) * per_cell)
        if lead != index:
            _roll_on(p, w, wv, hull, x, index, lead)
            index = lead
        gone = 0.0
        cs, sn = math.cos(theta), math.sin(theta)
        # The loop: tangents to idler and sprocket, the run below, the run above and the wraps.
        fcx, fcz = x + ix * cs + iz * sn, z - ix * sn + iz * cs
        rcx, rcz = x + sx * cs + sz * sn, z - sx * sn + sz * cs
        left, right = index * cell, (index + nodes - 1) * cell
        fux, fuz, ft = tangent(right - fcx, w[nodes - 1] - fcz, ir, 1.0)
        rux, ruz, rt = tangent(left - rcx, w[0] - rcz, sr, -1.0)
        fqx, fqz = fcx - ir * fuz, fcz + ir * fux
        rqx, rqz = rcx + sr * ruz, rcz - sr * rux
        length = ft + rt + math.hypot(ix - sx, iz - sz)
        length += ir * (0.5 * math.pi - math.atan2(fux, -fuz) - theta)
        length += sr * (math.atan2(-rux, ruz) + 2.0 * math.pi + theta - 0.5 * math.pi)
        rate = fux * -(v + theta_v * (fqz - z)) + fuz * (wv[nodes - 1] - zv + theta_v * (fqx - x))
        rate += rux * -(v + theta_v * (rqz - z)) + ruz * (wv[0] - zv + theta_v * (rqx - x))
        for i in range(nodes - 1):
            dw = w[i + 1] - w[i]
            s = math.sqrt(cell * cell + dw * dw)
            length += s
            slope[i] = dw / s
            rate += slope[i] * (wv[i + 1] - wv[i])
        stretch = length - free_length
        tension = 0.0
        if stretch > 0.0:
            tension = max(0.0, loop_k * stretch + loop_b * rate)
            gone += dt * (tension - loop_k * stretch) * rate
        # Forces on the nodes: gravity, tension, bending, the ground.
        reaction, stored, moved = 0.0, 0.5 * loop_k * max(stretch, 0.0) ** 2, 0.0
        for i in range(nodes):
            fw[i] = -node_mass * G
        for i in range(nodes - 1):
            pull = tension * slope[i]
            fw[i] += pull
            fw[i + 1] -= pull
        fw[nodes - 1] -= tension * fuz
        fw[0] -= tension * ruz
        for i in range(1, nodes - 1):
            bend = (w[i - 1] - 2.0 * w[i] + w[i + 1]) / cell
            bend_v = (wv[i - 1] - 2.0 * wv[i] + wv[i + 1]) / cell
            stored += 0.5 * bend_k * bend * bend
            gone += dt * bend_b * bend_v * bend_v
            moment = bend_k * bend / cell
            fw[i - 1] -= moment
            fw[i] += 2.0 * moment
            fw[i + 1] -= moment
        for i in range(nodes - 1):
            at = (index + i) * per - base
            for q in range(per):
                part = (q + 0.5) / per
                gap = floor[at + q] - (1.0 - part) * w[i] - part * w[i + 1]
                if gap > 0.0:
                    sinking = (1.0 - part) * wv[i] + part * wv[i + 1]
                    elastic = ground * piece * gap
                    push = max(0.0, elastic - ground_b * piece * min(1.0, gap / _ONSET) * sinking)
                    fw[i] += (1.0 - part) * push
                    fw[i + 1] += part * push
                    reaction += push
                    stored += 0.5 * elastic * gap
                    gone -= dt * (push - elastic) * sinking
        for i in range(nodes):
            moved += node_mass * (0.5 * wv[i] * wv[i] + G * w[i])
        # Wheels on the track: rubber along the arc.
        front, rear, foremost = 0.0, 0.0, 0
        for i in range(count):
            ca, sa = math.cos(alpha[i]), math.sin(alpha[i])
            cosine[i], sine[i] = ca, sa
            wx = x + st[i, 0] * cs + st[i, 1] * sn - arm * ca
            wz = z - st[i, 0] * sn + st[i, 1] * cs - arm * sa
            wheel_v = zv - theta_v * (st[i, 0] * cs + st[i, 1] * sn) - arm * ca * alpha_v[i]
            bottom = wz - radius - thick
            total, side = 0.0, 0.0
            for q in range(shape.shape[0]):
                place = (wx + shape[q, 0]) * per_cell
                k = math.floor(place) - index
                if k < 0 or k >= nodes - 1:
                    continue
                share = place - index - k
                over = (1.0 - share) * w[k] + share * w[k + 1] - bottom - shape[q, 1]
                if over > 0.0:
                    over_v = (1.0 - share) * wv[k] + share * wv[k + 1] - wheel_v
                    elastic = rubber * shape[q, 2] * over
                    push = max(0.0, elastic + rubber_b * shape[q, 2] * min(1.0, over / _ONSET) * over_v)
                    total += push
                    side -= push * shape[q, 0] / radius
                    fw[k] -= push * (1.0 - share)
                    fw[k + 1] -= push * share
                    stored += 0.5 * elastic * over
                    gone += dt * (push - elastic) * over_v
            load[i], across[i] = total, side if governed else 0.0
            if i == 0:
                foremost = min(max(math.floor(wx * per_cell) - index, 0), nodes - 2)
            moved += 0.5 * wheel_mass * wheel_v * wheel_v + wheel_mass * G * wz
            wheel_vx = theta_v * (st[i, 1] * cs - st[i, 0] * sn) + arm * sa * alpha_v[i]
            moved += 0.5 * wheel_mass * wheel_vx * wheel_vx
        if governed and moving:
            # what the sprocket has wound in beyond what the vehicle has covered is missing behind the last wheel
            last = min(max(math.floor(wx * per_cell) - index, 0), nodes - 2)
            longer = v * (1.0 / math.sqrt(1.0 - slope[last] * slope[last]) - 1.0)
            pay = -(governor + 1.0) * ahead_v - reset * ahead - longer
            pay -= droop * loop_k * drawn * (pulling + returning)
            pay += rux * theta_v * (z - rqz) - ruz * (zv - theta_v * (rqx - x) - wheel_v)
            drawn += dt * pay
            pull = (
                loop_k * drawn + loop_b * pay
            )  # of a whole loop; a span is stiffer by as much as it is shorter
            rear = max(0.0, tension + pull * pulling) - tension
            front = max(0.0, tension - pull * returning) - tension
            fw[0] -= rear * ruz
            fw[nodes - 1] -= front * fuz
            for i in range(last):
                fw[i] += rear * slope[i]
                fw[i + 1] -= rear * slope[i]
            for i in range(foremost, nodes - 1):
                fw[i] += front * slope[i]
                fw[i + 1] -= front * slope[i]
            ahead_a = ((tension + front) * fux + (tension + rear) * rux + across.sum()) / wholly
        # Hull and arms: wheel accelerations are J_z z'' + J_theta theta'' + J_alpha alpha'' + b.
        fqm = (tension + front) * (fux * (fqz - z) - fuz * (fqx - x))
        rqm = (tension + rear) * (rux * (rqz - z) - ruz * (rqx - x))
        m11, m12, m22 = hull_mass, 0.0, inertia
        r1 = -hull_mass * G + (tension + front) * fuz + (tension + rear) * ruz
        # what pushes the vehicle on acts at the ground, below the centre of gravity: it lifts the nose
        r2 = fqm + rqm - hull_mass * push_on * height
        for i in range(count):
            a, ca, sa = alpha[i], cosine[i], sine[i]
            dx, dz = st[i, 0] * cs + st[i, 1] * sn, st[i, 1] * cs - st[i, 0] * sn
            phi, phi_v = a + theta, alpha_v[i] + theta_v
            c = st[i, 2] if moving else _SETTLING
            twist = phi - free + st[i, 3]
            tau = -bar * twist
            stored += 0.5 * bar * twist * twist
            over = 0.0
            if phi < jounce:
                over = phi - jounce
            elif phi > rebound:
                over = phi - rebound
            tau -= stop * over
            stored += 0.5 * stop * over * over
            gone += dt * c * phi_v * phi_v
            tau -= c * phi_v
            damper_c[i] = dt * c
            bx = ahead_a - dx * theta_v * theta_v + arm * ca * alpha_v[i] * alpha_v[i]
            bz = -dz * theta_v * theta_v + arm * sa * alpha_v[i] * alpha_v[i]
            force = load[i] - wheel_mass * G
            m11 += wheel_mass
            m12 -= wheel_mass * dx
            m22 += wheel_mass * (dx * dx + dz * dz) + damper_c[i]
            r1 += force - wheel_mass * bz
            r2 += dz * across[i] - dx * force + tau - wheel_mass * (dz * bx - dx * bz)
            jx, jz = arm * sa, -arm * ca
            c1 = wheel_mass * jz
            c2 = wheel_mass * (jx * dz - jz * dx) + damper_c[i]
            c0 = hub + damper_c[i]
            right_side = jx * across[i] + jz * force + tau - wheel_mass * (jx * bx + jz * bz)
            m11 -= c1 * c1 / c0
            m12 -= c1 * c2 / c0
            m22 -= c2 * c2 / c0
            r1 -= c1 * right_side / c0
            r2 -= c2 * right_side / c0
            torque[i], along[i], alpha_a[i] = right_side, c2, c1
        det = m11 * m22 - m12 * m12
        za = (m22 * r1 - m12 * r2) / det
        theta_a = (m11 * r2 - m12 * r1) / det
        for i in range(count):
            alpha_a[i] = (torque[i] - alpha_a[i] * za - along[i] * theta_a) / (hub + damper_c[i])
        if moving and sub == 0:
            moved += 0.5 * hull_mass * zv * zv + 0.5 * inertia * theta_v * theta_v + hull_mass * G * z
            out[stamp, 0], out[stamp, 1], out[stamp, 2], out[stamp, 3] = z, theta, zv, theta_v
            out[stamp, 4], out[stamp, 5], out[stamp, 6], out[stamp, 7] = za, theta_a, tension, reaction
            out[stamp, 8], out[stamp, 9] = moved + stored, hull[4]
            out[stamp, 10] = ahead
            for i in range(count):
                out[stamp, 11 + i] = alpha[i] + theta
                out[stamp, 11 + count + i] = load[i]
            over = z - floor[(index + nodes // 2) * per - base]
            if not (abs(ahead) < 1.5 and abs(over) < 20.0 and abs(theta) < 1.0 and abs(tension) < 1e9):
                return False
            if stamp == stamps - 1:
                break
        hull[4] += gone
        ahead_v += dt * ahead_a
        ahead += dt * ahead_v
        zv += dt * za
        theta_v += dt * theta_a
        z += dt * zv
        theta += dt * theta_v
        for i in range(count):
            alpha_v[i] += dt * alpha_a[i]
            alpha[i] += dt * alpha_v[i]
        for i in range(nodes):
            fw[i] = node_mass * wv[i] + dt * fw[i]
        _solve(nodes, d, e, f, fw)
        for i in range(nodes):
            wv[i] = fw[i]
            w[i] += dt * wv[i]
        if settle > 0:
            settle -= 1
            if settle == 0:
                hull[4] = 0.0
                zv += p[30]
                theta_v += p[31]
        else:
            sub += 1
            if sub == counts[stamp]:
                stamp, sub = stamp + 1, 0
        hull[0], hull[1], hull[2], hull[3] = z, theta, zv, theta_v
        hull[5], hull[6], hull[7], hull[8] = ahead, ahead_v, ahead_a, drawn
    mark[0] = index
    return True
