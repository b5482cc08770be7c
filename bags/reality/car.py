# SPDX-License-Identifier: Apache-2.0
"""The car: a free rigid body and four wheels on sliders in MuJoCo, on tyres of our own.

What it has and a twin has not: finite rotations, dry friction in the struts, damping in the
tyres, a contact patch, tyre forces along the road's normal, side slip, steering and a driver.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from reality.surface import Prober, Surface

Floats = NDArray[Any]
G = 9.80665
STEP = 2.5e-4  # s
PATCH = (-0.05, -0.025, 0.0, 0.025, 0.05)  # m, where along the wheel's heading the ground is felt


@dataclass(frozen=True)
class Strut:
    """One axle's strut, at the wheel: smooth curves through (x, force) knots, with friction."""

    unsprung: float
    spring: tuple[tuple[float, float], ...]
    push: tuple[tuple[float, float], ...]
    pull: tuple[tuple[float, float], ...]
    friction: float  # N

    @staticmethod
    def curve(knots: tuple[tuple[float, float], ...]) -> PchipInterpolator:
        x, f = zip((0.0, 0.0), *knots, strict=True)
        slope = (f[-1] - f[-2]) / (x[-1] - x[-2])
        far = x[-1] + 4.0
        return PchipInterpolator([*x, far], [*f, f[-1] + slope * (far - x[-1])])


@dataclass(frozen=True)
class Car:
    """Masses and geometry; heights count from the ground at rest, x from the rear axle."""

    mass: float
    wheelbase: float
    front_track: float
    rear_track: float
    cog: tuple[float, float, float]
    sprung_inertia: tuple[float, float, float]
    wheel_radius: float
    tyre_stiffness: float
    tyre_damping: float
    cornering: float  # N/rad, one tyre
    front: Strut
    rear: Strut


class Table:
    """A curve sampled so finely that linear interpolation is exact for our purpose, and fast."""

    def __init__(self, knots: tuple[tuple[float, float], ...], reach: float, count: int = 4000) -> None:
        self.step = reach / count
        self.values: list[float] = Strut.curve(knots)(np.arange(count + 2) * self.step).tolist()
        self.last = count

    def __call__(self, x: float) -> float:
        """For x >= 0; the force beyond the table is that of its end (never reached in a drive)."""
        a = x / self.step
        i = min(int(a), self.last)
        return self.values[i] + (a - i) * (self.values[i + 1] - self.values[i])


class Rig:
    """The car standing on a surface, ready to be stepped with steering and drive."""

    def __init__(self, car: Car, surface: Surface, imu: tuple[float, float, float], imu_quat: Floats) -> None:
        self.car = car
        unsprung = [car.front.unsprung] * 2 + [car.rear.unsprung] * 2
        at = np.array(
            [
                [car.wheelbase, car.front_track / 2],
                [car.wheelbase, -car.front_track / 2],
                [0.0, car.rear_track / 2],
                [0.0, -car.rear_track / 2],
            ]
        )
        axle_z = car.wheel_radius
        sprung = car.mass - sum(unsprung)
        whole = np.array(car.cog) * car.mass
        wheels = np.array([[*at[i], axle_z] for i in range(4)])
        centre = (whole - np.array(unsprung) @ wheels) / sprung
        share = _shares(car, unsprung, at)
        self.mount = wheels - centre
        self.sprung_centre = centre
        self.unsprung = unsprung
        self.struts = [car.front, car.front, car.rear, car.rear]
        tables = {
            axle: (Table(axle.spring, 0.6), Table(axle.push, 3.0), Table(axle.pull, 3.0))
            for axle in (car.front, car.rear)
        }
        self.tables = [tables[s] for s in self.struts]
        self.static = [_solve(self.tables[i][0], share[i] - unsprung[i] * G) for i in range(4)]
        self.sink = [share[i] / car.tyre_stiffness for i in range(4)]
        self.free_radius = [car.wheel_radius + self.sink[i] for i in range(4)]
        self.model = mujoco.MjModel.from_xml_string(self._xml(car, sprung, imu, imu_quat))
        self.data = mujoco.MjData(self.model)
        self.surface = surface

    def _xml(self, car: Car, sprung: float, imu: tuple[float, float, float], quat: Floats) -> str:
        inertia = " ".join(f"{v:.9g}" for v in car.sprung_inertia)
        place = " ".join(f"{v:.9g}" for v in np.array(imu) - self.sprung_centre)
        turn = " ".join(f"{v:.12g}" for v in quat)
        wheels = "".join(
            f"""<body name="w{i}" pos="{self.mount[i][0]:.9g} {self.mount[i][1]:.9g} {self.mount[i][2]:.9g}">
              <joint type="slide" axis="0 0 1"/>
              <inertial pos="0 0 0" mass="{self.unsprung[i]:.9g}" diaginertia="0.9 1.4 0.9"/></body>"""
            for i in range(4)
        )
        return f"""<mujoco>
          <option timestep="{STEP}" gravity="0 0 {-G}" integrator="implicitfast"><flag contact="disable"/></option>
          <worldbody><body name="chassis">
            <freejoint/><inertial pos="0 0 0" mass="{sprung:.9g}" diaginertia="{inertia}"/>
            <site name="imu" pos="{place}" quat="{turn}"/>
            {wheels}</body></worldbody>
          <sensor><accelerometer site="imu"/><gyro site="imu"/></sensor>
        </mujoco>"""

    def place(self, x: float, y: float, yaw: float, u: float) -> None:
        """Put the car on the ground with base_link at (x, y), at rest for level ground."""
        mujoco.mj_resetData(self.model, self.data)
        c, s = math.cos(yaw), math.sin(yaw)
        self.probes = [Prober(self.surface, u + (self.car.wheelbase if i < 2 else 0.0)) for i in range(4)]
        ground = []
        for i in range(4):
            bx, by = self.mount[i][:2] + self.sprung_centre[:2]
            ground.append(self.probes[i].height(x + c * bx - s * by, y + s * bx + c * by))
        cx, cy, cz = self.sprung_centre
        self.data.qpos[:3] = [x + c * cx - s * cy, y + s * cx + c * cy, cz + float(np.mean(ground))]
        self.data.qpos[3:7] = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
        mujoco.mj_forward(self.model, self.data)

    def step(self, steer: float, drive: float, brake: float) -> None:
        """One step: ``steer`` rad at both front wheels, ``drive`` N in all at the front wheels,
        ``brake`` N in all (65 % front), which holds the car when it stands."""
        data, car = self.data, self.car
        rotation = data.xmat[1]
        r = rotation.tolist()  # chassis axes are the columns: x = r[0], r[3], r[6]
        heading = math.atan2(r[3], r[0])
        velocity = data.qvel.tolist()
        position = data.qpos.tolist()
        force, applied = data.xfrc_applied, data.qfrc_applied
        wheels = data.xpos
        centre = data.xipos[1].tolist()
        # World angular velocity of the chassis: MuJoCo keeps it in the body's own axes.
        wb = velocity[3:6]
        w = [
            r[0] * wb[0] + r[1] * wb[1] + r[2] * wb[2],
            r[3] * wb[0] + r[4] * wb[1] + r[5] * wb[2],
            r[6] * wb[0] + r[7] * wb[1] + r[8] * wb[2],
        ]
        for i in range(4):
            strut = self.struts[i]
            spring, push, pull = self.tables[i]
            rate = velocity[6 + i]
            damping = push(rate) if rate >= 0 else -pull(-rate)
            dry = strut.friction * math.tanh(rate / 0.01)
            applied[6 + i] = -(spring(max(self.static[i] + position[7 + i], 0.0)) + damping + dry)

            px, py, pz = wheels[2 + i].tolist()
            turn = heading + (steer if i < 2 else 0.0)
            cx, sx = math.cos(turn), math.sin(turn)
            probe = self.probes[i]
            felt = [probe.height(px + d * cx, py + d * sx) for d in PATCH]
            ground = sum(felt) / len(felt)
            slope = (felt[-1] - felt[0]) / (PATCH[-1] - PATCH[0])
            side = (
                probe.height(px - 0.05 * sx, py + 0.05 * cx) - probe.height(px + 0.05 * sx, py - 0.05 * cx)
            ) / 0.1
            # Velocity of the wheel's centre; what the ground does under it follows from its slope.
            dx, dy, dz = px - centre[0], py - centre[1], pz - centre[2]
            vx = velocity[0] + w[1] * dz - w[2] * dy
            vy = velocity[1] + w[2] * dx - w[0] * dz
            vz = velocity[2] + w[0] * dy - w[1] * dx + rate * r[8]
            along, across = vx * cx + vy * sx, -vx * sx + vy * cx
            depth = ground + self.free_radius[i] - pz
            normal = 0.0
            if depth > 0:
                normal = max(
                    car.tyre_stiffness * depth + car.tyre_damping * (slope * along + side * across - vz), 0.0
                )
            lateral = -normal * math.tanh(car.cornering / max(normal, 1.0) * across / max(abs(along), 1.5))
            held = 0.325 if i < 2 else 0.175
            push_on = (drive / 2 if i < 2 else 0.0) - held * brake * math.tanh(along / 0.05)
            limit = 0.9 * normal
            push_on = min(max(push_on, -limit), limit)
            # Normal force along the road's normal, drive and cornering in its plane (small slopes).
            fx_along = push_on - normal * slope
            fy_across = lateral - normal * side
            fx, fy = fx_along * cx - fy_across * sx, fx_along * sx + fy_across * cx
            fz = normal + push_on * slope + lateral * side
            arm = ground - pz  # the forces act on the ground, below the wheel's centre
            force[2 + i] = (fx, fy, fz, -arm * fy, arm * fx, 0.0)
        mujoco.mj_step(self.model, data)

    def state(self) -> Floats:
        """x, y, z of base_link, roll, pitch, yaw, four deflections from rest, speed along base_link x."""
        data = self.data
        m = data.xmat[1].reshape(3, 3)
        base = data.xpos[1] - m @ self.sprung_centre
        pitch = -math.asin(m[2, 0])
        roll = math.atan2(m[2, 1], m[2, 2])
        yaw = math.atan2(m[1, 0], m[0, 0])
        wb = m @ data.qvel[3:6]
        velocity = data.qvel[:3] + np.cross(wb, base - data.xpos[1])
        speed = velocity[0] * math.cos(yaw) + velocity[1] * math.sin(yaw)
        return np.array([*base, roll, pitch, yaw, *data.qpos[7:11], speed])


def _shares(car: Car, unsprung: list[float], at: Floats) -> Floats:
    """What each tyre carries at rest, N; left and right alike but for the offset of the load."""
    front = car.mass * car.cog[0] / car.wheelbase
    rear = car.mass - front
    out = []
    for axle, track in ((front, car.front_track), (rear, car.rear_track)):
        for side in (1, -1):
            out.append(axle * G * (0.5 + side * car.cog[1] / track))
    return np.array(out)


def _solve(curve: Table, force: float) -> float:
    low, high = 0.0, 0.6
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if curve(middle) < force else (low, middle)
    return 0.5 * (low + high)
