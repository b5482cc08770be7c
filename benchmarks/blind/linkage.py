# SPDX-License-Identifier: Apache-2.0
"""A third reality: MuJoCo's multibody mechanics with wheels on linkages and tyres that lag.

What ``multibody`` has on slides, each wheel has here on the axis through the instant centres of its linkage, seen from
the front and from the side: struts in front, several links behind. So it scrubs, leans, toes and is pushed up or down
by what drives, brakes and steers. The strut's lever changes with travel, the link's bushing gives along the road, the
wheel has a spin of its own, and its tyre takes a way to build up a force (Pacejka 2012, chapter 7). This is much that
no model of seven degrees has.
"""

from __future__ import annotations

import numpy as np
from extras import missing

from blind import linkage_forces as lf, multibody as mb
from blind.newton import Faults, Motion
from blind.world import DAMPER_REACH, SPRING_REACH, Car, Floats, Plan, World

try:
    import mujoco
except ModuleNotFoundError:
    missing("mujoco")

#: Per axle: m from the wheel to the instant centre seen from the front (towards the other side) and seen from the side
#: (behind the front wheels, ahead of the rear ones), and the centres' heights above the wheel's.
FRONT_VIEW, FRONT_HEIGHT = (2.3, 1.7), (-0.09, -0.06)
SIDE_VIEW, SIDE_HEIGHT = (4.0, 2.6), (-0.02, 0.05)
#: Of the bushing that holds a wheel along the road: N/m, and N s/m.
BUSHING, BUSHING_DAMPING = 4.5e5, 900.0


def run(world: World, plan: Plan, faults: Faults | None = None) -> Motion:
    """Drive a plan; ``faults`` maps effects to their parameters."""
    f = faults or {}
    part = f.get("unsprung_mass", {}).get("share", 1.0)
    bodies, lever = links(world.car, part, mb.body_centre(world.car))
    scene = mb.stand(world, plan, f, (bodies, ""), part)
    model, data = scene.model, scene.data
    tables, road = mb.tables_of(world.car), mb.road_of(world)
    spin, travel = np.zeros((lf.STATES, 4)), np.zeros(4)
    bars = np.array([f.get("anti_roll_bar", {}).get(f"{axle}_stiffness", 0.0) for axle in ("front", "rear")])
    moving, reaches = np.zeros((5, 6)), (SPRING_REACH, DAMPER_REACH)
    motion = (data.xpos[1:6], data.xmat[1:6], moving, data.qpos, data.qvel)
    outer = data.xfrc_applied[1:6]

    def act(t: float, control: mb.Control) -> None:
        for body in range(1, 6):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, moving[body - 1], 0)
        lf.apply(
            t,
            motion,
            lever,
            bars,
            control,
            scene.numbers,
            scene.wheel,
            scene.keep,
            spin,
            travel,
            tables,
            reaches,
            road,
            data.qfrc_applied,
            outer,
        )

    return mb.drive(world, plan, scene, act, lambda: travel, f)


def links(car: Car, part: float, centre: Floats) -> tuple[str, Floats]:
    """The wheels' bodies as XML, and (4, LEVERS) numbers of ``linkage_forces`` for each."""
    bodies, lever = "", np.zeros((4, lf.LEVERS))
    for i, (place, mass) in enumerate(zip(car.wheels(), car.unsprung(), strict=True)):
        axle, out = i // 2, 1.0 if i % 2 == 0 else -1.0
        back = -1.0 if axle == 0 else 1.0
        front = np.array([0.0, -out * FRONT_VIEW[axle], FRONT_HEIGHT[axle]])
        side = np.array([back * SIDE_VIEW[axle], 0.0, SIDE_HEIGHT[axle]])
        axis = (side - front) / np.linalg.norm(side - front)
        rise = np.cross(axis, -front)[2]  # m up for each radian
        if rise < 0.0:
            axis, rise = -axis, -rise
        lever[i] = (*axis, *front, lf.PROGRESSION[axle])
        bodies += f"""<body name="w{i}" pos="{mb.text(place - centre)}">
        <joint type="slide" axis="1 0 0" stiffness="{BUSHING:.9g}" damping="{BUSHING_DAMPING:.9g}"/>
        <joint type="hinge" pos="{mb.text(front)}" axis="{mb.text(axis)}"/>
        <inertial pos="0 0 0" mass="{part * mass:.9g}" diaginertia="0.9 0.7 0.9"/></body>"""
    return bodies, lever
