# SPDX-License-Identifier: Apache-2.0
"""What ``linkage`` applies to MuJoCo's joints and bodies: struts on levers, bars, and tyres with a way to build up."""

from __future__ import annotations

import math

from numba import njit

from blind import multibody_forces as mf
from blind.multibody_forces import braked_by, driven_by, footing, hooked, roll_on, strut, tyre

#: Numbers of each linkage: its axis, the place from the wheel that this goes through, and its progression.
AX, AY, AZ, FX, FY, FZ, PROG = range(7)
LEVERS = 7
#: 1/m by which a strut's lever grows with compression, per axle.
PROGRESSION = (0.6, 1.2)
#: What a wheel keeps: its spin rad/s, and how far its tyre is sheared along and across, m.
SPIN, ALONG, ACROSS = range(3)
STATES = 3
SPIN_INERTIA = 0.9  # kg m²
BUILD_UP = (0.12, 0.35)  # m of way along and across
STIFFNESS = (16.0, 13.0)  # slip stiffness along and across, per load
SHEAR_DAMPING = 250.0  # N s/m
GRIP = 0.95


@njit(cache=True)
def sheared(xi, slip, over, way, stiffness, normal, dt):  # type: ignore[no-untyped-def]
    """A tyre's shear one step on (it relaxes over its way), and its force per shear."""
    rate = stiffness * normal / way
    xi = (xi + slip * dt) / (1.0 + over / way * dt)
    most = GRIP * normal / rate if rate > 0.0 else 0.0
    return min(max(xi, -most), most), rate


@njit(cache=True)
def apply(t, motion, lever, bars, control, n, w, keep, spin, travel, tables, reaches, road, applied, outer):  # type: ignore[no-untyped-def]
    """Fill joint forces ``applied`` and wrenches ``outer`` (5, 6) of body and wheels for one step.

    ``motion`` is the places (5, 3), axes (5, 9) and velocities (5, 6; turning first) of body and wheels, and the
    joints' places and rates; joints of wheel i are 6 + 2 i along the road and 7 + 2 i about its axis."""
    at, turned, moving, qpos, qvel = motion
    springs, pushes, pulls = tables
    steer, drive, brake = control
    dt = n[mf.DT]
    for i in range(4):
        s, ds = lift(i, qpos[8 + 2 * i], lever)
        travel[i] = s
        lengthened = s + lever[i, PROG] * s * s
        slope = (1.0 + 2.0 * lever[i, PROG] * s) * ds
        v = slope * qvel[7 + 2 * i]
        force = strut(i, lengthened, v, t, n, w, keep, springs, pushes, pulls, reaches[0], reaches[1])
        applied[7 + 2 * i] = -force * slope
    for i in range(4):
        k = bars[i // 2]
        if k > 0.0:
            other = i + 1 if i % 2 == 0 else i - 1
            s, ds = lift(i, qpos[8 + 2 * i], lever)
            applied[7 + 2 * i] -= k * (s - travel[other]) * ds
    for i in range(4):
        b = i + 1
        px, py, pz = at[b, 0], at[b, 1], at[b, 2]
        aim = math.atan2(turned[b, 3], turned[b, 0]) + (steer if i < 2 else 0.0)
        ca, sa = math.cos(aim), math.sin(aim)
        height, rise, lean = footing(px, py, ca, sa, i, n, keep, road)
        height -= roll_on(i, spin[SPIN, i], n, w, keep)
        over_body = moving[0, 5] + moving[0, 0] * (py - at[0, 1]) - moving[0, 1] * (px - at[0, 0])
        _, rises = lift(i, qpos[8 + 2 * i], lever)
        pace = rises * qvel[7 + 2 * i]
        applied[7 + 2 * i] -= hooked(i, over_body, over_body + pace, pace, n, w, keep) * rises
        arm = height - pz
        # the wheel's middle, then the tyre's foot, which leans with the body but does not turn with the spin
        wx, wy = moving[b, 0], moving[b, 1]
        qx, qy, qz = moving[b, 3], moving[b, 4], moving[b, 5]
        ahead_of = qx * ca + qy * sa
        across = -(qx + wy * arm) * sa + (qy - wx * arm) * ca
        depth = height + n[mf.RADIUS] + w[mf.SINK, i] - pz
        normal = 0.0
        if depth > 0.0:
            normal = max(
                tyre(i, n, w) * depth + w[mf.TYRE_DAMPING, i] * (rise * ahead_of + lean * across - qz), 0.0
            )
        rolled = spin[SPIN, i] * -arm
        over = max(abs(rolled), abs(ahead_of))
        slip = rolled - ahead_of
        spin[ALONG, i], k_along = sheared(spin[ALONG, i], slip, over, BUILD_UP[0], STIFFNESS[0], normal, dt)
        spin[ACROSS, i], k_across = sheared(
            spin[ACROSS, i], -across, over, BUILD_UP[1], STIFFNESS[1], normal, dt
        )
        on = k_along * spin[ALONG, i] + SHEAR_DAMPING * slip
        side = k_across * spin[ACROSS, i] - SHEAR_DAMPING * across
        on = min(max(on, -GRIP * normal), GRIP * normal)
        side = min(max(side, -GRIP * normal), GRIP * normal)
        # engine and brake as forces at the foot, of a wheel of the nominal radius
        driven = driven_by(i, drive, t, ahead_of < 6.0, n) * n[mf.RADIUS]
        most = braked_by(i, brake, n, keep) * n[mf.RADIUS]
        free = spin[SPIN, i] + (driven + on * arm) / SPIN_INERTIA * dt
        braked = min(max(free * SPIN_INERTIA / dt, -most), most)
        spin[SPIN, i] = free - braked / SPIN_INERTIA * dt
        up = normal + on * rise + side * lean
        ahead, left = on - normal * rise, side - normal * lean
        if w[mf.IMBALANCE, i] > 0.0:
            own = w[mf.IMBALANCE, i] * spin[SPIN, i] ** 2
            up += own * math.sin(keep[mf.TURNED, i] + w[mf.PHASE, i])
            ahead -= own * math.cos(keep[mf.TURNED, i] + w[mf.PHASE, i])
        gx, gy = ahead * ca - left * sa, ahead * sa + left * ca
        outer[b, 0], outer[b, 1], outer[b, 2] = gx, gy, up
        # The bearing passes no torque on but the brake's; what leans the wheel goes into its links.
        lateral = -side * sa, side * ca
        outer[b, 3] = -arm * lateral[1] - sa * braked
        outer[b, 4] = arm * lateral[0] + ca * braked
        outer[b, 5] = 0.0
        # what drives a wheel pushes the body back
        outer[0, 3] += sa * driven
        outer[0, 4] -= ca * driven


@njit(cache=True)
def lift(i, angle, lever):  # type: ignore[no-untyped-def]
    """m that wheel i has come up at an angle of its axis, and m for each radian more."""
    ax, ay, az = lever[i, AX], lever[i, AY], lever[i, AZ]
    rx, ry, rz = -lever[i, FX], -lever[i, FY], -lever[i, FZ]
    cross = ax * ry - ay * rx
    along = az * (ax * rx + ay * ry + az * rz)
    c, s = math.cos(angle), math.sin(angle)
    return rz * c + cross * s + along * (1.0 - c) - rz, -rz * s + cross * c + along * s
