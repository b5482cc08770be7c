# SPDX-License-Identifier: Apache-2.0
"""The same seven degrees of freedom elsewhere: MuJoCo, NumPy and the exact solution of the linear car."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from extras import missing
from scipy.linalg import expm

from suspension_twin.arrays import Floats
from suspension_twin.models.types import Excitation
from suspension_twin.vehicle.twin import Twin

try:
    import mujoco
    from mujoco import rollout
except ModuleNotFoundError:
    missing("mujoco")

G = 9.80665


def linear(twin: Twin, spring: float = 23000.0, damper: float = 1500.0) -> Twin:
    """The twin with one straight line for each curve: what MuJoCo and a closed form can follow."""
    changes: dict[str, Any] = {}
    for axle in ("front", "rear"):
        changes[f"vehicle.{axle}.spring"] = {
            "compression": (0.1, 0.3, 0.5, 1.0),
            "force": tuple(spring * x for x in (0.1, 0.3, 0.5, 1.0)),
        }
        for part in ("damper_push", "damper_pull"):
            speeds = (0.125, 0.25, 0.35, 0.4)
            changes[f"vehicle.{axle}.{part}"] = {
                "velocity": speeds,
                "force": tuple(damper * v for v in speeds),
            }
    return twin.with_changes(changes)


@dataclass(frozen=True)
class LinearCar:
    """M q'' + C q' + K q = E road, q = heave, roll, pitch and four wheels from standing."""

    mass: Floats
    damping: Floats
    stiffness: Floats
    tyres: Floats
    arms: Floats  # (4, 2) wheels from the sprung centre of gravity
    masses: tuple[float, float, float, Floats]  # sprung, roll and pitch inertia, wheels

    @classmethod
    def of(cls, twin: Twin) -> LinearCar:
        """The linear car of a twin whose curves are straight lines."""
        v = twin.vehicle
        axles = [v.front, v.front, v.rear, v.rear]
        wheels = np.array([a.unsprung_mass for a in axles])
        sprung = float(v.mass - wheels.sum())
        arms = v.wheel_positions - (v.mass * np.array(v.cog[:2]) - v.wheel_positions.T @ wheels) / sprung
        b = np.hstack([-np.ones((4, 1)), -arms[:, 1:], arms[:, :1], np.eye(4)])
        k = np.diag([a.spring.force[-1] / a.spring.compression[-1] for a in axles])
        c = np.diag([a.damper_push.force[-1] / a.damper_push.velocity[-1] for a in axles])
        e = np.vstack([np.zeros((3, 4)), v.tyre.vertical_stiffness * np.eye(4)])
        inertia = v.sprung_inertia
        mass = np.diag([sprung, inertia.roll, inertia.pitch, *wheels])
        stiffness = b.T @ k @ b + np.hstack([np.zeros((7, 3)), e])
        return cls(mass, b.T @ c @ b, stiffness, e, arms, (sprung, inertia.roll, inertia.pitch, wheels))

    def exact(self, road: Floats, step: float) -> Floats:
        """(n, 7) accelerations on a road (n, 4) that is linear between its samples; from rest."""
        inverse = np.linalg.inv(self.mass)
        a = np.zeros((22, 22))
        a[:7, 7:14] = np.eye(7)
        a[7:14, :7], a[7:14, 7:14] = -inverse @ self.stiffness, -inverse @ self.damping
        a[7:14, 14:18] = inverse @ self.tyres
        a[14:18, 18:22] = np.eye(4)
        step_on = expm(a * step)
        state = np.zeros(22)
        out = np.empty((road.shape[0], 7))
        for i, r in enumerate(road):
            after = road[min(i + 1, road.shape[0] - 1)]
            state[14:18], state[18:22] = r, (after - r) / step
            out[i] = (a @ state)[7:14]
            state = step_on @ state
        return out


class MujocoCar:
    """The linear car in MuJoCo: slides and hinges, springs and dampers as tendons, roads as motors.

    Contacts and constraints are off; forces of gravity balance the static ones and are left out.
    """

    def __init__(self, twin: Twin, step: float, integrator: str) -> None:
        car = LinearCar.of(twin)
        sprung, roll, pitch, wheels = car.masses
        v = twin.vehicle
        axles = [v.front, v.front, v.rear, v.rear]
        bodies, struts, motors = "", "", ""
        for i in range(4):
            bodies += (
                f'<body><joint name="u{i}" type="slide" axis="0 0 1" stiffness="{v.tyre.vertical_stiffness}"/>'
                f'<inertial pos="0 0 0" mass="{wheels[i]}" diaginertia="1 1 1"/></body>'
            )
            k = axles[i].spring.force[-1] / axles[i].spring.compression[-1]
            c = axles[i].damper_push.force[-1] / axles[i].damper_push.velocity[-1]
            struts += (
                f'<fixed springlength="0" stiffness="{k}" damping="{c}"><joint joint="u{i}" coef="1"/>'
                f'<joint joint="z" coef="-1"/><joint joint="roll" coef="{-car.arms[i, 1]}"/>'
                f'<joint joint="pitch" coef="{car.arms[i, 0]}"/></fixed>'
            )
            motors += f'<motor joint="u{i}" gear="{v.tyre.vertical_stiffness}"/>'
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{step}" gravity="0 0 0" integrator="{integrator}">'
            '<flag contact="disable" constraint="disable"/></option><worldbody><body>'
            '<joint name="z" type="slide" axis="0 0 1"/><joint name="pitch" type="hinge" axis="0 1 0"/>'
            f'<joint name="roll" type="hinge" axis="1 0 0"/><inertial pos="0 0 0" mass="{sprung}" '
            f'diaginertia="{roll} {pitch} {roll + pitch}"/></body>{bodies}</worldbody>'
            f"<tendon>{struts}</tendon><actuator>{motors}</actuator></mujoco>"
        )
        self.data = mujoco.MjData(self.model)

    def accelerations(self, road: Floats) -> Floats:
        """(n, 7) heave, roll, pitch, wheels at the beginning of each step, road (n, 4) held over it."""
        mujoco.mj_resetData(self.model, self.data)
        out = np.empty((road.shape[0], 7))
        for i, r in enumerate(road):
            self.data.ctrl[:] = r
            mujoco.mj_step(self.model, self.data)
            out[i] = self.data.qacc[[0, 2, 1, 3, 4, 5, 6]]
        return out

    def seconds_per_step(self, road: Floats, repeats: int) -> tuple[float, float]:
        """Processor time of a step: ``mj_step`` alone, and with the road's heights (MuJoCo's rollout)."""
        n = road.shape[0]
        bare = with_road = np.inf
        start = np.zeros((1, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        for _ in range(repeats):
            begin = time.thread_time()
            mujoco.mj_step(self.model, self.data, nstep=n)
            bare = min(bare, (time.thread_time() - begin) / n)
            mujoco.mj_resetData(self.model, self.data)
            begin = time.thread_time()
            rollout.rollout(self.model, self.data, start, road[None])
            with_road = min(with_road, (time.thread_time() - begin) / n)
        return bare, with_road


class NumpyCars:
    """Many nonlinear cars as one would write them in NumPy: arrays over the lanes, a loop over time.

    Semi-implicit Euler; the curves as sums of hinges, since np.interp takes one curve at a time.
    """

    def __init__(self, twin: Twin, excitation: Excitation, lanes: int) -> None:
        v = twin.vehicle
        car = LinearCar.of(twin)
        self.sprung, self.roll, self.pitch, self.wheels = car.masses
        self.x, self.y = car.arms[:, :1], car.arms[:, 1:]
        self.tyre = v.tyre.vertical_stiffness
        self.road, self.step = excitation.road, float(excitation.step[1])
        share = np.abs(self.x[[2, 0]]) / v.wheelbase
        self.load = np.repeat(self.sprung * G * share / 2, 2, axis=0)
        self.lanes = lanes
        axles = [v.front, v.front, v.rear, v.rear]
        self.curves = [[_hinges(c.points) for c in (a.spring, a.damper_push, a.damper_pull)] for a in axles]
        self.static = np.array(
            [[_where(c[0], float(w))] for c, w in zip(self.curves, self.load[:, 0], strict=True)]
        )

    def run(self) -> Floats:
        """(rows, lanes) heave."""
        q, v = np.zeros((7, self.lanes)), np.zeros((7, self.lanes))
        out = np.empty((self.road.shape[0], self.lanes))
        for row, road in enumerate(self.road):
            body, rate = q[0] + self.y * q[1] - self.x * q[2], v[0] + self.y * v[1] - self.x * v[2]
            travel, rate = self.static + q[3:] - body, v[3:] - rate
            force = np.empty((4, self.lanes))
            for i, (spring, push, pull) in enumerate(self.curves):
                damping = _sum(push, np.maximum(rate[i], 0)) - _sum(pull, np.maximum(-rate[i], 0))
                force[i] = _sum(spring, travel[i]) + damping
            ground = np.maximum(0, self.load + self.wheels[:, None] * G + self.tyre * (road[:, None] - q[3:]))
            v[0] += self.step * (force.sum(axis=0) / self.sprung - G)
            v[1] += self.step * (self.y * force).sum(axis=0) / self.roll
            v[2] -= self.step * (self.x * force).sum(axis=0) / self.pitch
            v[3:] += self.step * ((ground - force) / self.wheels[:, None] - G)
            q += self.step * v
            out[row] = q[0]
        return out


Hinges = tuple[float, list[tuple[float, float]]]


def _hinges(points: tuple[Floats, Floats]) -> Hinges:
    slopes = np.diff(np.r_[0.0, points[1]]) / np.diff(np.r_[0.0, points[0]])
    return float(slopes[0]), list(zip(points[0][:-1].tolist(), np.diff(slopes).tolist(), strict=True))


def _sum(curve: Hinges, x: Floats) -> Floats:
    total = curve[0] * x
    for at, change in curve[1]:
        total = total + change * np.maximum(x - at, 0)
    return total


def _where(curve: Hinges, load: float) -> float:
    low, high = 0.0, 3.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _sum(curve, np.array(middle)) < load else (low, middle)
    return low
