# SPDX-License-Identifier: Apache-2.0
"""The other reality: MuJoCo's multibody mechanics under forces of ``multibody_forces``.

A free chassis carries four wheels on slides that lean a little (caster), the powertrain and the bending
mode as bodies on springs of MuJoCo's own, an anti-roll bar as a tendon, a payload as a welded mass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from extras import missing
from scipy.signal import lfilter

from blind import multibody_forces as mf
from blind.newton import ENGINE, PLACES, Faults, Motion, rotate
from blind.world import DAMPER_REACH, SPRING_N, SPRING_REACH, START, Car, Floats, G, Plan, World

try:
    import mujoco
except ModuleNotFoundError:
    missing("mujoco")

STEP = 5e-4
SETTLE = 3.0
LEAN = (0.06, 0.06, -0.03, -0.03)  # of the slides, along x
MODE_MASS = 0.4  # kg
Control = tuple[float, float, float]  # steering angle rad, drive N, brake N


@dataclass(frozen=True)
class Scene:
    """A car that stands at its start: MuJoCo's model and data, numbers of ``multibody_forces`` by car and by wheel,
    what each wheel keeps, and (3,) m of the body's centre in base_link."""

    model: mujoco.MjModel
    data: mujoco.MjData
    numbers: Floats
    wheel: Floats
    keep: Floats
    centre: Floats


def run(world: World, plan: Plan, faults: Faults | None = None) -> Motion:
    """Drive a plan; ``faults`` maps effects to their parameters."""
    f = faults or {}
    part = f.get("unsprung_mass", {}).get("share", 1.0)
    scene = stand(world, plan, f, _slides(world.car, part, body_centre(world.car), f), part)
    data, tables, road = scene.data, tables_of(world.car), road_of(world)
    lean = np.array([[a, 0.0, 1.0] for a in LEAN])
    lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    matrix, wheels, outer = data.xmat[1].reshape(3, 3), data.xpos[2:6], data.xfrc_applied[2:6]

    def act(t: float, control: Control) -> None:
        mf.apply(
            t,
            data.qpos,
            data.qvel,
            matrix,
            wheels,
            lean @ matrix.T,
            control,
            scene.numbers,
            scene.wheel,
            scene.keep,
            tables,
            (SPRING_REACH, DAMPER_REACH),
            road,
            data.qfrc_applied,
            outer,
        )

    return drive(world, plan, scene, act, lambda: data.qpos[7:11], f)


def body_centre(car: Car) -> Floats:
    """(3,) m from base_link to the centre of all that the wheels carry."""
    sprung = car.mass - car.unsprung().sum()
    return np.asarray((np.array(car.cog) * car.mass - car.unsprung() @ car.wheels()) / sprung)


def stand(world: World, plan: Plan, f: Faults, corners: tuple[str, str], part: float = 1.0) -> Scene:
    """Put the car at the start of a plan. ``corners`` are its four wheels' bodies, then tendons, as XML; ``part`` is
    the share of their mass that the wheels have."""
    phone, car, surface = world.phone, world.car, world.surface
    centre = body_centre(car)
    place = np.array(phone.place) + phone.misplaced + [f.get("sensor_offset", {}).get(a, 0.0) for a in "xyz"]
    model = mujoco.MjModel.from_xml_string(_xml(car, centre, place - centre, f, corners))
    data = mujoco.MjData(model)
    numbers, wheel, keep = _numbers(world, car, part, f)
    wheel[mf.PHASE] += f.get("wheel_imbalance", {}).get("turned", 0.0) * (plan.start % 6.28)
    i = round(START / surface.du)
    heading = float(surface.heading[i])
    x, y = surface.to_map(np.array([START]), np.array([plan.lane]))[0]
    level = float(np.mean([surface.z[round((START + d) / surface.du), 60] for d in (0.0, car.wheelbase)]))
    c, s = math.cos(heading), math.sin(heading)
    data.qpos[:3] = (x + c * centre[0] - s * centre[1], y + s * centre[0] + c * centre[1], level + centre[2])
    data.qpos[3:7] = (math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2))
    keep[mf.LAST_U] = [START + car.wheelbase] * 2 + [START] * 2
    mujoco.mj_forward(model, data)
    return Scene(model, data, numbers, wheel, keep, centre)


def text(v: Floats | tuple[float, ...]) -> str:
    """Numbers as XML has them."""
    return " ".join(f"{a:.10g}" for a in np.asarray(v))


def _slides(car: Car, part: float, centre: Floats, f: Faults) -> tuple[str, str]:
    """Four wheels on slides, and tendons between them for bars."""
    wheels = "".join(
        f"""<body name="w{i}" pos="{text(p - centre)}"><joint name="w{i}" type="slide" axis="{LEAN[i]} 0 1"/>
        <inertial pos="0 0 0" mass="{part * m:.9g}" diaginertia="0.9 1.4 0.9"/></body>"""
        for i, (p, m) in enumerate(zip(car.wheels(), car.unsprung(), strict=True))
    )
    bar = f.get("anti_roll_bar", {})
    bars = "".join(
        f"""<fixed stiffness="{bar[key]:.9g}"><joint joint="w{a}" coef="1"/>
        <joint joint="w{a + 1}" coef="-1"/></fixed>"""
        for key, a in (("front_stiffness", 0), ("rear_stiffness", 2))
        if bar.get(key, 0.0) > 0.0
    )
    return wheels, bars


def _xml(car: Car, centre: Floats, phone: Floats, f: Faults, corners: tuple[str, str]) -> str:
    mass, inertia, at = car.mass - car.unsprung().sum(), np.array(car.sprung_inertia), np.zeros(3)
    more, riding = _riders(centre, f)
    for part, where in riding:  # a part of the sprung mass that rides on its own
        rest = mass - part
        at = at - part / rest * (where - at)
        mass = rest
    if "powertrain_mount" in f:
        own = f["powertrain_mount"]
        stiffness = own["mass"] * (2 * math.pi * own["frequency"]) ** 2
        damping = 2 * 0.08 * math.sqrt(stiffness * own["mass"])
        more += f"""<body name="engine" pos="{own["x"]:.9g} 0 0"><joint type="slide" axis="0 0 1"
            stiffness="{stiffness:.9g}" damping="{damping:.9g}" springref="{own["mass"] * G / stiffness:.9g}"/>
            <inertial pos="0 0 0" mass="{own["mass"]:.9g}" diaginertia="6 6 6"/></body>"""
        rest = mass - own["mass"]
        at = np.array([-own["mass"] * own["x"] / rest, 0.0, 0.0])
        taken = rest * at[0] ** 2 + own["mass"] * own["x"] ** 2
        inertia = inertia - min(taken, 0.5 * inertia[1]) * np.array([0.0, 1.0, 1.0])
        mass = rest
    if "body_bending" in f:
        own = f["body_bending"]
        stiffness = MODE_MASS * (2 * math.pi * own["frequency"]) ** 2
        damping = 2 * own["damping_ratio"] * math.sqrt(stiffness * MODE_MASS)
        more += f"""<body name="mode" pos="{text(phone)}"><joint name="mode" type="slide" axis="0 0 1"
            stiffness="{stiffness:.9g}" damping="{damping:.9g}"/>
            <inertial pos="0 0 0" mass="{MODE_MASS}" diaginertia="1e-3 1e-3 1e-3"/></body>"""
    if "payload" in f:
        own = f["payload"]
        where = np.array([own["x"], own["y"], 0.75]) - centre
        more += f"""<body name="load" pos="{text(where)}">
            <inertial pos="0 0 0" mass="{own["mass"]:.9g}" diaginertia="1 1 1"/></body>"""
    wheels, bars = corners
    return f"""<mujoco>
      <option timestep="{STEP}" gravity="0 0 {-G}" integrator="implicitfast"><flag contact="disable"/></option>
      <worldbody><body name="chassis"><freejoint/>
        <inertial pos="{text(at)}" mass="{mass:.10g}" diaginertia="{text(inertia)}"/>
        <site name="phone" pos="{text(phone)}"/>{wheels}{more}</body></worldbody>
      {f"<tendon>{bars}</tendon>" if bars else ""}
      <sensor><accelerometer site="phone"/><gyro site="phone"/></sensor></mujoco>"""


def _riders(centre: Floats, f: Faults) -> tuple[str, list[tuple[float, Floats]]]:
    """Bodies in the chassis that are loose, as XML, and their masses and places from the centre."""
    bodies, riding = "", []
    if "loose_mass" in f:
        own = f["loose_mass"]
        where = np.array([own["x"], own["y"], centre[2]]) - centre
        bodies += f"""<body name="loose" pos="{text(where)}"><joint type="slide" axis="0 0 1" limited="true"
            range="0 {own["gap"]:.9g}" solreflimit="0.012 0.4"/>
            <inertial pos="0 0 0" mass="{own["mass"]:.9g}" diaginertia="0.3 0.3 0.3"/></body>"""
        riding.append((own["mass"], where))
    if "fuel_slosh" in f:
        own = f["fuel_slosh"]
        where = np.array([0.4, 0.0, 0.45]) - centre
        stiffness = own["mass"] * (2 * math.pi * own["frequency"]) ** 2
        damping = 2 * 0.03 * math.sqrt(stiffness * own["mass"])
        spring = f'type="slide" stiffness="{stiffness:.9g}" damping="{damping:.9g}"'
        bodies += f"""<body name="fuel" pos="{text(where)}"><joint {spring} axis="1 0 0"/><joint {spring} axis="0 1 0"/>
            <inertial pos="0 0 0" mass="{own["mass"]:.9g}" diaginertia="2 2 2"/></body>"""
        riding.append((own["mass"], where))
    return bodies, riding


def _numbers(world: World, car: Car, part: float, f: Faults) -> tuple[Floats, Floats, Floats]:
    back = world.background
    n, w, keep = np.zeros(mf.NUMBERS), np.zeros((mf.BY_WHEEL, 4)), np.zeros((mf.STATES, 4))
    patch = max(back.patch, f.get("tyre_envelope", {}).get("length", 0.0))
    n[mf.RADIUS], n[mf.TYRE], n[mf.GRIP], n[mf.DRIVEN] = (
        car.radius,
        car.tyre_stiffness / part,
        14.0,
        car.driven,
    )
    n[mf.PATCH], n[mf.POINTS], n[mf.DT] = patch, max(1, round(patch / 0.03)), STEP
    n[mf.FADE], n[mf.FADE_T] = f.get("damper_fade", {}).get("loss", 0.0), 1.0
    if "damper_fade" in f:
        n[mf.FADE_T] = f["damper_fade"]["time_constant"]
    n[mf.PLAY] = f.get("loose_ball_joint", {}).get("play", 0.0)
    n[mf.VOID] = f.get("damper_cavitation", {}).get("void", 0.0)
    n[mf.CUBIC] = f.get("cubic_spring", {}).get("rate", 0.0)
    n[mf.GROOVE] = f.get("position_sensitive_damper", {}).get("rise", 0.0)
    loads = car.loads() - car.unsprung() * (1.0 - part) * G
    fine = np.linspace(0.0, SPRING_REACH, SPRING_N + 1)
    w[mf.SINK] = loads / n[mf.TYRE]
    w[mf.SPRING] = w[mf.DAMPER] = w[mf.BUMP_GAP] = w[mf.REBOUND_GAP] = w[mf.PRESSURE] = 1.0
    for name, first, keys in (
        ("brake_judder", mf.JUDDER, ("depth", "turns")),
        ("clutch_judder", mf.CLUTCH, ("depth", "pitch")),
    ):
        if name in f:
            n[first], n[first + 1] = (f[name][key] for key in keys)
    w[mf.TYRE_DAMPING] = back.tyre_damping + f.get("tyre_damping", {}).get("damping", 0.0)
    for i in range(4):
        axle = "front" if i < 2 else "rear"
        strut = car.front if i < 2 else car.rear
        w[mf.REST, i] = np.interp(loads[i] - car.unsprung()[i] * part * G, strut.spring, fine)
        w[mf.FRICTION, i] = back.friction[i // 2] + f.get("strut_friction", {}).get(f"{axle}_force", 0.0)
        w[mf.MOUNT, i] = f.get("top_mount", {}).get(f"{axle}_stiffness", 0.0)
        w[mf.WORN, i] = f.get("worn_dampers", {}).get(axle, 0.0)
        sag = f.get("spring_sag", {}).get(axle, 0.0)
        w[mf.REST, i] -= sag
        w[mf.SPRING, i] *= 1.0 + f.get("spring_sag", {}).get("rate", 0.0) * sag
        if "semi_active_damper" in f:
            own = f["semi_active_damper"]
            w[mf.SKY if own["law"] == 0.0 else mf.HOOK, i] = own[axle]
        for name, gap, rate in (
            ("bump_stop", mf.BUMP_GAP, mf.BUMP),
            ("rebound_stop", mf.REBOUND_GAP, mf.REBOUND),
        ):
            if name in f:
                w[gap, i], w[rate, i] = f[name][f"{axle}_clearance"], f[name]["stiffness"]
    for name, row in (("corner_spring", mf.SPRING), ("corner_damper", mf.DAMPER)):
        if name in f:
            w[row, int(f[name]["corner"])] *= 1.0 + f[name]["change"]
    if "wheel_imbalance" in f:
        own = f["wheel_imbalance"]
        w[mf.IMBALANCE, int(own["corner"])], w[mf.PHASE, int(own["corner"])] = own["moment"], own["phase"]
    if "tyre_pressure" in f:
        w[mf.PRESSURE, PLACES[int(f["tyre_pressure"]["corner"])]] = 1.0 + f["tyre_pressure"]["change"]
    if "flat_spot" in f:
        w[mf.DENT, int(f["flat_spot"]["corner"])] = f["flat_spot"]["depth"]
    return n, w, keep


class _Driver:
    """Steers at a point ahead on the lane, and holds the planned speed."""

    def __init__(self, world: World, plan: Plan) -> None:
        surface = world.surface
        u = np.arange(0.0, surface.u[-1], 0.1)
        self.way = surface.to_map(u, np.full(u.size, plan.lane))
        self.plan, self.base, self.mass = plan, world.car.wheelbase, world.car.mass
        self.steer, self.sum = 0.0, 0.0

    def __call__(self, t: float, x: float, y: float, yaw: float, speed: float, u: float) -> Control:
        k = min(max(int(t / 0.01), 0), self.plan.speed.size - 1)
        ahead = 3.5 + 0.45 * abs(speed)
        aim = self.way[min(int((u + ahead) / 0.1), len(self.way) - 1)]
        dx, dy = aim[0] - x, aim[1] - y
        left = -dx * math.sin(yaw) + dy * math.cos(yaw)
        wish = math.atan(2.0 * self.base * left / (dx * dx + dy * dy))
        self.steer += min(max(wish - self.steer, -0.003), 0.003)
        wanted, push = float(self.plan.speed[k]), float(self.plan.push[k])
        if wanted < 0.02 and push <= 1e-9:
            return self.steer, 0.0, 4500.0
        miss = wanted - speed
        self.sum += 0.005 * miss
        effort = self.mass * (push + 1.5 * miss + 0.4 * self.sum)
        return self.steer, max(effort, 0.0), max(-effort, 0.0)


def _wind(own: Mapping[str, float], plan: Plan) -> Floats:
    """(n, 2) N of side force and lift every step: white noise through a low-pass at 1 Hz, blowing up
    over the first second."""
    rng = np.random.default_rng([int(1e4 * own["phase"]), int(plan.start)])
    raw = rng.standard_normal((round(plan.seconds / STEP) + 1, 2))
    slow = lfilter([1.0], [1.0, -math.exp(-2 * math.pi * STEP)], raw, axis=0)
    slow *= np.clip(np.arange(len(slow)) * STEP, 0.0, 1.0)[:, None] / slow.std(axis=0)
    return np.asarray(own["force"] * slow * [0.4, 1.0])


def _squalls(own: Mapping[str, float], plan: Plan) -> Floats:
    """(n, 2) N of side force and lift every step: gaps in a row of trees, each with a rise, a hold and a fall."""
    rng = np.random.default_rng([int(1e4 * own["phase"]), int(plan.start), 3])
    t = np.arange(round(plan.seconds / STEP) + 1) * STEP
    side, at = np.zeros(t.size), float(rng.uniform(0.5, 2.0))
    while at < t[-1]:
        hold, ramp = rng.uniform(0.3, 1.2), rng.uniform(0.15, 0.4)
        shape = np.interp(t, [at, at + ramp, at + ramp + hold, at + 2 * ramp + hold], [0.0, 1.0, 1.0, 0.0])
        side += rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.0) * shape
        at += 2 * ramp + hold + rng.uniform(0.5, 2.5)
    return np.asarray(own["force"] * side[:, None] * [1.0, 0.05])


def tables_of(car: Car) -> tuple[Floats, ...]:
    """Springs', pushes' and pulls' tables, (2, n) each: front and rear."""
    return tuple(np.array([getattr(car.front, k), getattr(car.rear, k)]) for k in ("spring", "push", "pull"))


def road_of(world: World) -> tuple[Floats, ...]:
    """What ``multibody_forces.ground`` takes of a road."""
    surface = world.surface
    return (
        np.ascontiguousarray(surface.z),
        np.array([surface.du, surface.dv, surface.v0]),
        surface.heading,
        surface.line[:, 0].copy(),
        surface.line[:, 1].copy(),
    )


def drive(
    world: World,
    plan: Plan,
    scene: Scene,
    act: Callable[[float, Control], None],
    travel: Callable[[], Floats],
    f: Faults,
) -> Motion:
    """Follow the plan: ``act`` applies what suspension and tyres do at a time under a control, ``travel`` tells
    the four compressions."""
    model, data, centre, car = scene.model, scene.data, scene.centre, world.car
    every, driver = round(1e-3 / STEP), _Driver(world, plan)
    count, settle = round((plan.seconds - 0.5) / 1e-3), round(SETTLE / STEP)
    felt, path = np.empty((count, 6)), np.empty((count, 12))
    matrix, control = data.xmat[1].reshape(3, 3), (0.0, 0.0, 4500.0)
    gain = f.get("body_bending", {}).get("gain", 0.0)
    mode = model.joint("mode").dofadr[0] if gain else 0
    engine = ENGINE | f.get("engine_order", {})
    shake, angle = engine.get("force", 0.0), 0.0
    arm = car.wheelbase - centre[0]
    wind = _wind(f["gusts"], plan) if "gusts" in f else np.zeros((0, 2))
    if "crosswind" in f:
        wind = _squalls(f["crosswind"], plan)
    for step in range(-settle, count * every):
        t = step * STEP
        if step % 10 == 0:
            back = data.xpos[1] - matrix @ centre
            speed = float(data.qvel[:3] @ matrix[:, 0])
            u = float(scene.keep[mf.LAST_U, 2:].mean())
            control = driver(t, back[0], back[1], math.atan2(matrix[1, 0], matrix[0, 0]), speed, u)
        data.xfrc_applied[1] = 0.0
        act(t, control)
        if shake:
            v = max(speed, 0.0)
            rise = engine["low"] if v < engine["shift"] else engine["high"]
            angle += STEP * 2.0 * math.pi * max(engine["idle"] + rise * v, engine["floor"])
            push = shake * math.sin(angle)
            data.xfrc_applied[1, :3] += push * matrix[:, 2]
            data.xfrc_applied[1, 3:] -= arm * push * matrix[:, 1]
        if len(wind):
            side, lift = wind[min(max(step, 0), len(wind) - 1)]
            push = side * matrix[:, 1] + lift * matrix[:, 2]
            data.xfrc_applied[1, :3] += push
            data.xfrc_applied[1, 3:] += np.cross(matrix @ np.array([0.5, 0.0, 0.6]), push)
        mujoco.mj_step(model, data)
        if step < 0:
            data.qvel[2] *= 0.998
            data.qvel[6:] *= 0.998
        elif step % every == 0:
            k = step // every
            felt[k] = data.sensordata
            if gain:
                felt[k, 2] += gain * data.qacc[mode]
            path[k, :7], path[k, 7], path[k, 8:] = data.qpos[:7], u, travel()
    if not np.isfinite(felt).all():
        raise FloatingPointError(f"the motion of world {world.seed} with {sorted(f)} does not stay finite")
    turn = path[:, 3:7]
    base = path[:, :3] - rotate(turn, np.broadcast_to(centre, (count, 3)))
    return Motion(np.arange(count) * 1e-3, felt[:, :3], felt[:, 3:], base, turn, path[:, 7], path[:, 8:])
