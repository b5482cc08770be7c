# SPDX-License-Identifier: Apache-2.0
"""One reality: a car by Newton and Euler in its own axes, by Runge and Kutta's fourth order.

Set up here, integrated in ``newton_kernel``. Every physical fault of the plan is translated into this
reality's own numbers; what is wrong with the sensor, the clock or the road file is not its business.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from blind import newton_kernel as k
from blind.road_under import ground_of
from blind.world import SPRING_N, SPRING_REACH, START, Car, Floats, G, Plan, World

STEP = 1e-3  # s
SETTLE = 3.0  # s of standing before the clock starts
Faults = dict[str, dict[str, float]]
#: Wheels of each place of a tyre's pressure: one, an axle, all.
PLACES = ([0], [1], [2], [3], [0, 1], [2, 3], [0, 1, 2, 3])
#: Half an order of an engine: Hz at idle, 1/m in a low and a high gear, m/s of the shift, Hz that it never falls below.
ENGINE = {"idle": 6.5, "low": 0.55, "high": 0.325, "shift": 6.0, "floor": 0.0}


@dataclass(frozen=True, eq=False)
class Motion:
    """What a run leaves at every step from the clock's start: specific force and angular rate (n, 3) at
    the phone in base_link axes, place (n, 3) and quaternion (n, 4; w first) of base_link in ``map``, ``u`` (n,) m
    of the rear axle along the road, ``travel`` (n, 4) m of compression from rest."""

    t: Floats
    force: Floats
    rate: Floats
    place: Floats
    turn: Floats
    u: Floats
    travel: Floats


def loaded(car: Car, payload: dict[str, float] | None) -> Car:
    """The car with a point mass on board: only masses change, so that it sinks in."""
    if not payload:
        return car
    added, place = payload["mass"], np.array([payload["x"], payload["y"], 0.75])
    sprung = car.mass - car.unsprung().sum()
    centre = _sprung_centre(car)
    far = place - centre
    reduced = added * sprung / (added + sprung)
    inertia = np.array(car.sprung_inertia) + reduced * np.array(
        [far[1] ** 2 + far[2] ** 2, far[0] ** 2 + far[2] ** 2, far[0] ** 2 + far[1] ** 2]
    )
    cog = (np.array(car.cog) * car.mass + added * place) / (car.mass + added)
    return replace(car, mass=car.mass + added, cog=tuple(cog), sprung_inertia=tuple(inertia))


def _sprung_centre(car: Car) -> Floats:
    unsprung = car.unsprung()
    return np.asarray((np.array(car.cog) * car.mass - unsprung @ car.wheels()) / (car.mass - unsprung.sum()))


def _body_centre(car: Car, f: Faults) -> Floats:
    """Of the body alone: where the powertrain rides on its own, the rest's."""
    centre = _sprung_centre(car)
    if "powertrain_mount" in f:
        mass, sprung = f["powertrain_mount"]["mass"], car.mass - car.unsprung().sum()
        centre[0] -= mass * f["powertrain_mount"]["x"] / (sprung - mass)
    return centre


def run(world: World, plan: Plan, faults: Faults | None = None, step: float = STEP) -> Motion:
    """Drive a plan; ``faults`` maps effects to their parameters. ``step`` s must suit them."""
    f = faults or {}
    phone = world.phone
    car = world.car
    if "unsprung_mass" in f:
        # A car on stiff and light wheels, as far as the share says.
        part = f["unsprung_mass"]["share"]
        axles = [replace(s, unsprung=part * s.unsprung) for s in (car.front, car.rear)]
        lost = 2 * (1.0 - part) * (car.front.unsprung + car.rear.unsprung)
        stiff = car.tyre_stiffness / part
        car = replace(car, front=axles[0], rear=axles[1], tyre_stiffness=stiff, mass=car.mass - lost)
    standing = car  # springs and tyres were chosen for this load
    car = loaded(car, f.get("payload"))
    n, c, sink = _numbers(world, standing, car, f)
    c[k.PHASE] += f.get("wheel_imbalance", {}).get("turned", 0.0) * (plan.start % 6.28)
    n[k.GUST_PHASE] = f.get("gusts", {}).get("phase", 0.0) + plan.start % 6.28  # no wind blows twice
    n[k.SQUALL_PHASE] = f.get("crosswind", {}).get("phase", 0.0) + plan.start % 6.28
    centre = _body_centre(car, f)
    place = np.array(phone.place) + phone.misplaced
    if "sensor_offset" in f:
        place = place + [f["sensor_offset"][a] for a in "xyz"]
    n[k.SX : k.SZ + 1] = place - centre
    patch = max(world.background.patch, f.get("tyre_envelope", {}).get("length", 0.0))
    probes = np.array([START + car.wheelbase] * 2 + [START] * 2 + [START])
    ground = ground_of(world.surface, probes, patch, sink)
    i = round(START / world.surface.du)
    heading = float(world.surface.heading[i])
    x, y = world.surface.to_map(np.array([START]), np.array([plan.lane]))[0]
    level = float(
        np.mean([world.surface.z[round((START + d) / world.surface.du), 60] for d in (0, car.wheelbase)])
    )
    state = np.zeros(k.STATES)
    state[:3] = (
        x + math.cos(heading) * centre[0] - math.sin(heading) * centre[1],
        y + math.sin(heading) * centre[0] + math.cos(heading) * centre[1],
        level + centre[2],
    )
    state[k.TURN], state[k.TURN + 3] = math.cos(heading / 2), math.sin(heading / 2)
    count = round((plan.seconds - 0.5) / step)
    felt, path = np.empty((count, 6)), np.empty((count, 12))
    springs = np.array([car.front.spring, car.rear.spring])
    pushes, pulls = np.array([car.front.push, car.rear.push]), np.array([car.front.pull, car.rear.pull])
    k.integrate(
        state,
        n,
        c,
        springs,
        pushes,
        pulls,
        ground,
        plan.speed,
        plan.push,
        car.wheelbase,
        float(centre[0]),
        plan.lane,
        car.mass,
        step,
        round(SETTLE / step),
        count,
        felt,
        path,
    )
    if not np.isfinite(felt).all():
        raise FloatingPointError(f"the motion of world {world.seed} with {sorted(f)} does not stay finite")
    turn = path[:, 3:7] / np.linalg.norm(path[:, 3:7], axis=1, keepdims=True)
    base = path[:, :3] - rotate(turn, np.broadcast_to(centre, (count, 3)))
    return Motion(np.arange(count) * step, felt[:, :3], felt[:, 3:], base, turn, path[:, 7], path[:, 8:])


def rotate(q: Floats, v: Floats) -> Floats:
    """Vectors (n, 3) turned by unit quaternions (n, 4), w first."""
    w, a = q[:, :1], q[:, 1:]
    t = 2.0 * np.cross(a, v)
    return np.asarray(v + w * t + np.cross(a, t))


def _numbers(world: World, standing: Car, car: Car, f: Faults) -> tuple[Floats, Floats, Floats]:
    """(NUMBERS,) and (BY_CORNER, 5) numbers of the kernel, and (4,) m that the tyres give at rest."""
    back = world.background
    n, c = np.zeros(k.NUMBERS), np.zeros((k.BY_CORNER, 5))
    unsprung = car.unsprung()
    centre = _body_centre(car, f)
    n[k.MASS] = car.mass - unsprung.sum()
    n[k.IX : k.IZ + 1] = car.sprung_inertia
    n[k.RADIUS], n[k.TYRE], n[k.HARD], n[k.DRIVEN] = (
        car.radius,
        car.tyre_stiffness,
        back.tyre_hardening,
        car.driven,
    )
    loads = standing.loads()
    sink = loads / car.tyre_stiffness
    sink = sink / (1.0 + back.tyre_hardening * sink)
    c[k.X : k.Z + 1, :4] = (car.wheels() - centre).T
    c[k.SLIDER, :4] = unsprung
    fine = np.linspace(0.0, SPRING_REACH, SPRING_N + 1)
    for i in range(4):
        strut = car.front if i < 2 else car.rear
        c[k.REST, i] = np.interp(loads[i] - standing.unsprung()[i] * G, strut.spring, fine)
        c[k.FRICTION, i] = back.friction[i // 2]
    c[k.SPRING] = c[k.DAMPER] = c[k.PRESSURE] = 1.0
    c[k.BUMP_GAP] = c[k.REBOUND_GAP] = 1.0
    c[k.TYRE_DAMPING] = back.tyre_damping
    n[k.FADE_T] = n[k.WEIGHT] = n[k.BEND_W] = 1.0
    _struts(n, c, f)
    _body(n, c, car, f, centre, loads)
    return n, c, sink


def _struts(n: Floats, c: Floats, f: Faults) -> None:
    axles = ((slice(0, 2), "front"), (slice(2, 4), "rear"))
    for i, axle in axles:
        if "strut_friction" in f:
            c[k.FRICTION, i] += f["strut_friction"][f"{axle}_force"]
        for name, gap, rate in (
            ("bump_stop", k.BUMP_GAP, k.BUMP),
            ("rebound_stop", k.REBOUND_GAP, k.REBOUND),
        ):
            if name in f:
                c[gap, i], c[rate, i] = f[name][f"{axle}_clearance"], f[name]["stiffness"]
        if "top_mount" in f:
            c[k.MOUNT, i] = f["top_mount"][f"{axle}_stiffness"]
        if "anti_roll_bar" in f:
            c[k.BAR, i] = f["anti_roll_bar"][f"{axle}_stiffness"]
        if "worn_dampers" in f:
            c[k.DAMPER, i] *= 1.0 - f["worn_dampers"][axle]
        if "spring_sag" in f:
            sag = f["spring_sag"][axle]
            c[k.REST, i] -= sag
            c[k.SPRING, i] *= 1.0 + f["spring_sag"]["rate"] * sag
        if "semi_active_damper" in f:
            own = f["semi_active_damper"]
            c[k.SKY if own["law"] == 0.0 else k.HOOK, i] = own[axle]
    for name, row in (("corner_spring", k.SPRING), ("corner_damper", k.DAMPER)):
        if name in f:
            c[row, int(f[name]["corner"])] *= 1.0 + f[name]["change"]
    if "damper_fade" in f:
        n[k.FADE], n[k.FADE_T] = f["damper_fade"]["loss"], f["damper_fade"]["time_constant"]
    c[k.TYRE_DAMPING] += f.get("tyre_damping", {}).get("damping", 0.0)
    if "wheel_imbalance" in f:
        own = f["wheel_imbalance"]
        c[k.IMBALANCE, int(own["corner"])], c[k.PHASE, int(own["corner"])] = own["moment"], own["phase"]
    if "tyre_pressure" in f:
        c[k.PRESSURE, PLACES[int(f["tyre_pressure"]["corner"])]] = 1.0 + f["tyre_pressure"]["change"]
    if "flat_spot" in f:
        c[k.DENT, int(f["flat_spot"]["corner"])] = f["flat_spot"]["depth"]
    n[k.VOID] = f.get("damper_cavitation", {}).get("void", 0.0)
    n[k.PLAY] = f.get("loose_ball_joint", {}).get("play", 0.0)
    n[k.CUBIC] = f.get("cubic_spring", {}).get("rate", 0.0)
    n[k.GROOVE] = f.get("position_sensitive_damper", {}).get("rise", 0.0)
    n[k.GUST] = f.get("gusts", {}).get("force", 0.0)
    n[k.SQUALL] = f.get("crosswind", {}).get("force", 0.0)
    for name, first, keys in (
        ("brake_judder", k.JUDDER, ("depth", "turns")),
        ("clutch_judder", k.CLUTCH, ("depth", "pitch")),
    ):
        if name in f:
            n[first], n[first + 1] = (f[name][key] for key in keys)


def _body(n: Floats, c: Floats, car: Car, f: Faults, centre: Floats, loads: Floats) -> None:
    if "body_bending" in f:
        own = f["body_bending"]
        n[k.BEND_GAIN], n[k.BEND_W], n[k.BEND_Z] = (
            own["gain"],
            2 * math.pi * own["frequency"],
            own["damping_ratio"],
        )
        n[k.WEIGHT] = n[k.MASS]
        # A free beam: its ends move against its middle, where the load is.
        c[k.SHAPE, :4] = (1.0, 1.0, 0.8, 0.8)
        n[k.BASE] = float(c[k.SHAPE, :4] @ (loads - c[k.SLIDER, :4] * G))
    if "powertrain_mount" in f:
        own = f["powertrain_mount"]
        away = own["mass"] * own["x"] / (n[k.MASS] - own["mass"])  # from the body's centre to the whole's
        c[k.SLIDER, 4] = own["mass"]
        c[k.X, 4] = own["x"] + away
        n[k.ENGINE_W], n[k.ENGINE_Z] = 2 * math.pi * own["frequency"], 0.07
        # The engine is a part of what the whole's mass and inertia were.
        n[k.MASS] -= own["mass"]
        taken = n[k.MASS] * away**2 + own["mass"] * own["x"] ** 2
        taken = min(taken, 0.5 * n[k.IY])
        n[k.IY] -= taken
        n[k.IZ] -= taken
    if "engine_order" in f:
        own = ENGINE | f["engine_order"]
        n[k.ORDER_FORCE], n[k.ORDER_X] = own["force"], car.wheelbase - centre[0]
        n[k.ORDER_IDLE : k.ORDER_FLOOR + 1] = [own[a] for a in ("idle", "low", "high", "shift", "floor")]
    if "loose_mass" in f:
        own = f["loose_mass"]
        n[k.LOOSE_MASS : k.LOOSE_Y + 1] = own["mass"], own["gap"], own["x"] - centre[0], own["y"]
    if "fuel_slosh" in f:
        own = f["fuel_slosh"]
        n[k.SLOSH_MASS], n[k.SLOSH_W] = own["mass"], 2 * math.pi * own["frequency"]
        n[k.SLOSH_Z], n[k.SLOSH_X] = 0.45 - centre[2], 0.4 - centre[0]
