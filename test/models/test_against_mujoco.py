# SPDX-License-Identifier: Apache-2.0
"""The linear full car against MuJoCo: a rigid body on hinges and slides with springs between them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin

G = 9.80665
CORNERS = range(4)


@pytest.fixture(scope="module")
def linear(mondeo: Any) -> Any:
    """One slope for each spring and damper, push and pull alike; front and rear unlike."""
    changes: dict[str, Any] = {}
    for axle, k, c in (("front", 26000.0, 2100.0), ("rear", 23000.0, 1700.0)):
        changes[f"vehicle.{axle}.spring"] = {"compression": (1.0,), "force": (k,)}
        for part in ("damper_push", "damper_pull"):
            changes[f"vehicle.{axle}.{part}"] = {"velocity": (1.0,), "force": (c,)}
    return mondeo.with_changes(changes)


def build(twin: Any) -> tuple[mujoco.MjModel, Any, float]:
    """MuJoCo's car about its standing place, without gravity, which the static loads balance."""
    v = twin.vehicle
    wheels = v.wheel_positions
    mw = np.array([v.front.unsprung_mass] * 2 + [v.rear.unsprung_mass] * 2)
    ms = v.mass - mw.sum()
    cog = np.array(v.cog)
    sprung = (v.mass * cog - np.r_[wheels.T @ mw, v.tyre.radius * mw.sum()]) / ms
    arm = wheels - sprung[:2]
    axles = [v.front] * 2 + [v.rear] * 2
    wheel = "".join(
        f'<body><joint name="u{i}" type="slide" axis="0 0 1" stiffness="{v.tyre.vertical_stiffness}"/>'
        f'<inertial pos="0 0 0" mass="{mw[i]}" diaginertia="1 1 1"/></body>'
        for i in CORNERS
    )
    strut = "".join(
        f'<fixed name="s{i}" springlength="0" stiffness="{axles[i].spring.force[0]}" '
        f'damping="{axles[i].damper_push.force[0]}"><joint joint="u{i}" coef="1"/><joint joint="z" coef="-1"/>'
        f'<joint joint="roll" coef="{-arm[i, 1]}"/><joint joint="pitch" coef="{arm[i, 0]}"/></fixed>'
        for i in CORNERS
    )
    xml = f"""<mujoco><option timestep="0.00025" gravity="0 0 0" integrator="RK4"/><worldbody>
      <body><joint name="z" type="slide" axis="0 0 1"/><joint name="pitch" type="hinge" axis="0 1 0"/>
      <joint name="roll" type="hinge" axis="1 0 0"/><inertial pos="0 0 0" mass="{ms}"
      diaginertia="{v.sprung_inertia.roll} {v.sprung_inertia.pitch} 3000"/></body>{wheel}</worldbody>
      <tendon>{strut}</tendon></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml), cog, v.mass * cog[2]


def drive_mujoco(twin: Any, way: Any, ground: Any) -> np.ndarray:
    """Accelerations (n, 7) of heave, roll, pitch and wheels at the stamps, from rest on a level road."""
    model, cog, moment = build(twin)
    data = mujoco.MjData(model)
    at = {name: model.joint(name).qposadr[0] for name in ("z", "roll", "pitch", "u0", "u1", "u2", "u3")}
    order = list(at.values())
    wheels, steps = twin.vehicle.wheel_positions, round((way.t[1] - way.t[0]) / model.opt.timestep)
    fine = np.linspace(way.t[0], way.t[-1], steps * (way.t.size - 1) + 1)
    x, y, yaw, ax, ay, w = (
        np.interp(fine, way.t, c) for c in (way.x, way.y, way.yaw, *way.acceleration.T, way.yaw_rate)
    )
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    road = ground.heights(
        x[:, None] + c * wheels[:, 0] - s * wheels[:, 1], y[:, None] + s * wheels[:, 0] + c * wheels[:, 1]
    )
    dw = np.gradient(w, fine)
    mx, my = moment * (ay + dw * cog[0] - w**2 * cog[1]), -moment * (ax - dw * cog[1] - w**2 * cog[0])
    out = np.empty((way.t.size, 7))
    inputs = np.c_[mx, my, twin.vehicle.tyre.vertical_stiffness * road]
    columns = [at["roll"], at["pitch"], *order[3:]]
    middle = np.r_[(inputs[1:] + inputs[:-1]) / 2, inputs[-1:]]  # held over a step of RK4
    for k in range(fine.size):
        if k % steps == 0:
            data.qfrc_applied[columns] = inputs[k]
            mujoco.mj_forward(model, data)
            out[k // steps] = data.qacc[order]
        data.qfrc_applied[columns] = middle[k]
        mujoco.mj_step(model, data)
    return out


@pytest.mark.parametrize(("yaw_rate", "ax"), [(0.0, 0.0), (0.15, -1.5)])
def test_every_acceleration_within_half_a_per_cent(
    linear: Any, drive: Any, ground: Any, yaw_rate: float, ax: float
) -> None:
    """Over waves of 0.7 to 8 m that begin beyond the first metres, straight and braking in a bend.

    MuJoCo's rotations are finite: small waves.
    """

    def height(x: Any, y: Any) -> Any:
        fade = np.clip((x - 4.0) / 4.0, 0, 1) ** 2
        waves = (8.0, 0.012, 0.4), (2.1, 0.004, -0.9), (0.7, 0.0012, 2.0)
        return fade * sum(h * np.sin(2 * np.pi * x / length + q * y) for length, h, q in waves)

    way = drive(seconds=3.0, rate=200, speed=8.0, yaw_rate=yaw_rate, ax=ax, t0=0.0)
    # level and unaccelerated at first: both start at rest
    ramp = 0.5 - 0.5 * np.cos(np.pi * np.clip(way.t / 2.0, 0, 1))
    way = replace(way, acceleration=way.acceleration * ramp[:, None], yaw_rate=way.yaw_rate * ramp)
    road = ground(height)
    ours = simulate_twin(linear, excitation(way, linear.vehicle, road, 5e-4)).acceleration
    theirs = drive_mujoco(linear, way, road)
    error = np.sqrt(np.mean((ours - theirs) ** 2, axis=0) / np.mean(theirs**2, axis=0))
    assert (error < 0.005).all(), error
