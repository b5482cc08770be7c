# SPDX-License-Identifier: Apache-2.0
"""A fourth reality: a car on bushings alone, with a body that bends, in maximal coordinates.

Every wheel carrier is a body with all its six degrees of freedom; a double wishbone and a rod hold it by five links
with bushings at their ends, soft along the road. So camber, toe, track and the way a wheel gives under braking follow
from places and stiffnesses, and change with load and travel. The rack moves the front rods' inner ends. Springs and
dampers sit between their own two points, and their lever follows from these. The body has three free modes below 30 Hz;
tyres roll on rows of cams and build their forces up by the Magic Formula. The equations are ``flexible_kernel``'s; no
code, formulation or law of a force is another reality's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from blind import flexible_kernel as k
from blind.newton import ENGINE, PLACES, Faults, Motion, rotate
from blind.world import DAMPER_N, DAMPER_REACH, SPRING_N, SPRING_REACH, START, Car, Floats, G, Plan, World

STEP = 2.5e-4  # s
SETTLE = 3.0  # s
EVERY = 4  # steps to a row of what is felt
#: Of a left wheel, from its centre: outer ends of the two legs of the lower arm, of the upper arm's, and of the rod.
OUTER = (
    (0.0, -0.06, -0.12),
    (0.0, -0.06, -0.12),
    (-0.01, -0.1, 0.17),
    (-0.01, -0.1, 0.17),
    (-0.12, -0.08, -0.02),
)
#: Inner ends on the body. The second leg of the lower arm points to the middle of the car.
INNER = (
    (0.02, -0.44, -0.11),
    (-0.32, -0.36, -0.1),
    (0.11, -0.36, 0.15),
    (-0.13, -0.36, 0.155),
    (-0.12, -0.43, -0.015),
)
#: N/m of each link with its bushings: what gives along the road is the second one.
STIFFNESS = (6e6, 6e5, 2.5e6, 2.5e6, 5e6)
DAMPING_RATIO = 0.08
#: Of spring and damper, from the wheel's centre: at the carrier and at the body.
STRUT = ((0.0, -0.1, -0.06), (0.0, -0.2, 0.48))
#: The body as a plate of even mass, for the shapes of its modes: over the wheelbase, and over the track.
PLATE = (1.5, 1.2)
MODE_DAMPING = 0.03
#: Hz: torsion, vertical and lateral bending.
MODES = ((17.0, 24.0), (20.0, 28.0), (24.0, 30.0))
_PITCH = 0.04  # m between cams
_HELD = 2e7  # N/m that hold a rider where it does not move


@dataclass(frozen=True, eq=False)
class Scene:
    """A car that stands at its start: ``state`` are the arrays that ``integrate`` steps on, ``fixed`` those that it
    reads, in its order; ``centre`` (3,) m of the body's centre in base_link."""

    state: tuple[Any, ...]
    fixed: tuple[Any, ...]
    centre: Floats

    @property
    def numbers(self) -> Floats:
        """Of the whole car, as ``flexible_kernel`` has them."""
        return np.asarray(self.fixed[0])

    @property
    def places(self) -> Floats:
        """(5, 3) m of the body's centre and the four carriers in ``map``."""
        return np.asarray(self.state[0])

    @property
    def bent(self) -> Floats:
        """(3,) m of torsion, vertical and lateral bending: what a corner of wheelbase and track moves by, the first."""
        return np.asarray(self.state[4])

    @property
    def bending(self) -> Floats:
        """(3,) m/s of the same."""
        return np.asarray(self.state[5])

    def advance(self, plan: Plan, wind: Floats, first: int, last: int) -> tuple[Floats, Floats, Floats]:
        """Step from step ``first`` of the clock to ``last``: what is felt (6), the path (12) and the modes (3), a row
        for every ``EVERY`` steps from 0 on."""
        rows = max(-(-last // EVERY), 0)
        felt, path, bent = np.zeros((rows, 6)), np.zeros((rows, 12)), np.zeros((rows, 3))
        k.integrate(
            *self.state, *self.fixed, plan.speed, plan.push, wind, first, last, EVERY, felt, path, bent
        )
        return felt, path, bent


def run(world: World, plan: Plan, faults: Faults | None = None) -> Motion:
    """Drive a plan; ``faults`` maps effects to their parameters."""
    f = faults or {}
    scene = stand(world, plan, f)
    count = round((plan.seconds - 0.5) / STEP / EVERY)
    felt, path, _ = scene.advance(plan, _wind(f, plan), -round(SETTLE / STEP), count * EVERY)
    if not np.isfinite(felt).all():
        raise FloatingPointError(f"the motion of world {world.seed} with {sorted(f)} does not stay finite")
    turn = path[:, 3:7]
    base = path[:, :3] - rotate(turn, np.broadcast_to(scene.centre, (count, 3)))
    time = np.arange(count) * STEP * EVERY
    return Motion(time, felt[:, :3], felt[:, 3:], base, turn, path[:, 7], path[:, 8:])


def modes_of(world: World, car: Car, mass: float) -> Floats:
    """(3, 3) mass in kg, frequency in rad/s and damping ratio of torsion, vertical and lateral bending of a body.

    Shapes: torsion x y of 1 at a corner of wheelbase and track; bending (x / a)^2 - c about the middle, a half of the
    wheelbase and c such that the plate's centre stays."""
    rng = np.random.default_rng([world.seed, 41])
    c = PLATE[0] ** 2 / 3.0
    torsion = mass * c * PLATE[1] ** 2 / 3.0
    bending = mass * (PLATE[0] ** 4 / 5.0 - c * c)
    rates = [2 * math.pi * rng.uniform(*band) for band in MODES]
    return np.array([[m, w, MODE_DAMPING] for m, w in zip((torsion, bending, bending), rates, strict=True)])


def shape(car: Car, x: float, y: float) -> tuple[float, float]:
    """Of torsion and of bending at a place from the body's centre."""
    a, b = 0.5 * car.wheelbase, 0.25 * sum(car.tracks)
    return x / a * y / b, (x / a) ** 2 - PLATE[0] ** 2 / 3.0


def stand(world: World, plan: Plan, f: Faults) -> Scene:
    """Put the car at the start of a plan."""
    car, part = world.car, f.get("unsprung_mass", {}).get("share", 1.0)
    body = _Body.of(car, f)
    n, c = _numbers(world, f, part, body)
    outer, inner, low, top = _places(car, body.centre)
    phone = np.array(world.phone.place) + world.phone.misplaced - body.centre
    phone = phone + [f.get("sensor_offset", {}).get(a, 0.0) for a in "xyz"]
    n[k.SX : k.SZ + 1] = phone
    a, b = 0.5 * car.wheelbase, 0.25 * sum(car.tracks)
    twist, bow = shape(car, phone[0], phone[1])
    seen = np.array([
        twist, bow, bow, phone[0] / (a * b), -phone[1] / (a * b), -2 * phone[0] / a**2, 2 * phone[0] / a**2,
    ])  # fmt: skip
    wheels = car.wheels() - body.centre
    arms = outer + wheels[:, None]
    length = np.linalg.norm(arms - inner, axis=2)
    strut = np.linalg.norm(low + wheels - top, axis=1)
    for i in range(4):
        c[k.RATIO, i] = lever(outer[i], inner[i] - wheels[i], low[i], top[i] - wheels[i])
    stiff = np.tile(STIFFNESS, (4, 1))
    damp = 2 * DAMPING_RATIO * np.sqrt(stiff * c[k.CARRIER][:, None])
    shapes = np.zeros((4, 6, 3))
    for i in range(4):
        for j, at in enumerate((*inner[i], top[i])):
            twist, bow = shape(car, at[0], at[1])
            shapes[i, j] = twist, bow, bow
    springs = np.array([car.front.spring, car.rear.spring])
    pushes, pulls = (np.array([getattr(s, w) for s in (car.front, car.rear)]) for w in ("push", "pull"))
    most = 1.5 * float(max(pushes.max(), pulls.max()))
    dampers = (pushes, pulls, _inverted(pushes, most), _inverted(pulls, most), most)
    surface = world.surface
    road = (
        np.ascontiguousarray(surface.z),
        np.array([surface.du, surface.dv, surface.v0]),
        surface.heading,
        surface.line[:, 0].copy(),
        surface.line[:, 1].copy(),
    )
    n[k.LANE] = plan.lane
    c[k.PHASE] += f.get("wheel_imbalance", {}).get("turned", 0.0) * (plan.start % 6.28)
    elastic = modes_of(world, car, n[k.MASS])
    fixed = (
        n, c, elastic, seen, outer, inner, length, stiff, damp, low, top, strut, shapes, springs, dampers, road,
    )  # fmt: skip
    return Scene(_state(world, plan, body, c), fixed, body.centre)


@dataclass(frozen=True, eq=False)
class _Body:
    """The body without what rides on it: mass, inertia (3,), centre in base_link, and the ``riders`` (m, RIDER)."""

    mass: float
    inertia: Floats
    centre: Floats
    riders: Floats

    @classmethod
    def of(cls, car: Car, f: Faults) -> _Body:
        unsprung = car.unsprung()
        mass, inertia = car.mass - unsprung.sum(), np.array(car.sprung_inertia)
        whole = (np.array(car.cog) * car.mass - unsprung @ car.wheels()) / mass
        riders = _riders(f, whole)
        centre = whole.copy()
        for own in riders:  # a part of the sprung mass that rides on its own
            rest, away = mass - own[k.R_MASS], own[k.R_X : k.R_X + 3] + whole - centre
            taken = (
                own[k.R_MASS]
                * mass
                / rest
                * np.array(
                    [away[1] ** 2 + away[2] ** 2, away[0] ** 2 + away[2] ** 2, away[0] ** 2 + away[1] ** 2]
                )
            )
            inertia = np.maximum(inertia - taken, 0.5 * inertia)
            centre, mass = centre - own[k.R_MASS] / rest * away, rest
        if "payload" in f:
            own = f["payload"]
            away = np.array([own["x"], own["y"], 0.75]) - centre
            reduced = own["mass"] * mass / (own["mass"] + mass)
            inertia = inertia + reduced * np.array(
                [away[1] ** 2 + away[2] ** 2, away[0] ** 2 + away[2] ** 2, away[0] ** 2 + away[1] ** 2]
            )
            centre, mass = centre + own["mass"] / (own["mass"] + mass) * away, mass + own["mass"]
        riders[:, k.R_X : k.R_X + 3] += whole - centre
        return cls(float(mass), inertia, centre, riders)


def _riders(f: Faults, whole: Floats) -> Floats:
    """(m, RIDER) masses on springs, their places from the centre ``whole`` of the sprung mass."""
    rows = []

    def put(
        mass: float, at: Floats, frequencies: tuple[float, float, float], damping: float, gap: float
    ) -> None:
        stiff = np.array([mass * (2 * math.pi * v) ** 2 if v else _HELD for v in frequencies])
        ratio = np.array([damping if v else 0.1 for v in frequencies])
        rows.append([mass, *at, *stiff, *(2 * ratio * np.sqrt(stiff * mass)), gap])

    if "powertrain_mount" in f:
        own = f["powertrain_mount"]
        put(own["mass"], np.array([own["x"], 0.0, 0.0]), (0.0, 0.0, own["frequency"]), 0.075, 0.0)
    if "loose_mass" in f:
        own = f["loose_mass"]
        put(own["mass"], np.array([own["x"], own["y"], whole[2]]) - whole, (0.0, 0.0, 24.0), 0.18, own["gap"])
    if "fuel_slosh" in f:
        own = f["fuel_slosh"]
        at = np.array([0.4, 0.0, 0.45]) - whole
        put(own["mass"], at, (own["frequency"], own["frequency"], 0.0), 0.035, 0.0)
    return np.array(rows).reshape(-1, k.RIDER)


def lever(outer: Floats, inner: Floats, low: Floats, top: Floats) -> float:
    """m that a strut shortens for each m that its wheel comes up: the twist of the carrier that changes no link."""
    rows = np.zeros((6, 6))
    for j in range(5):
        along = (outer[j] - inner[j]) / np.linalg.norm(outer[j] - inner[j])
        rows[j] = np.concatenate([along, np.cross(outer[j], along)])
    rows[5, 2] = 1.0
    twist = np.linalg.solve(rows, np.eye(6)[5])
    along = (low - top) / np.linalg.norm(low - top)
    return -float(along @ (twist[:3] + np.cross(twist[3:], low)))


def _places(car: Car, centre: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Links' outer ends (4, 5, 3) from the carriers' centres and inner ones from the body's, and the struts' (4, 3)."""
    outer, inner, low, top = np.zeros((4, 5, 3)), np.zeros((4, 5, 3)), np.zeros((4, 3)), np.zeros((4, 3))
    for i, wheel in enumerate(car.wheels() - centre):
        # at the rear the arms point ahead, and a right wheel is a left one in a mirror
        turned = np.array([1.0 if i < 2 else -1.0, 1.0 if i % 2 == 0 else -1.0, 1.0])
        outer[i], inner[i] = np.array(OUTER) * turned, wheel + np.array(INNER) * turned
        low[i], top[i] = np.array(STRUT[0]) * turned, wheel + np.array(STRUT[1]) * turned
    return outer, inner, low, top


def _inverted(tables: Floats, most: float) -> Floats:
    """(2, DAMPER_N + 1) velocity over force up to ``most`` N of dampers' tables, on with their last slope."""
    v, forces = np.linspace(0.0, DAMPER_REACH, DAMPER_N + 1), np.linspace(0.0, most, DAMPER_N + 1)
    out = np.empty((2, DAMPER_N + 1))
    for axle, table in enumerate(tables):
        slope = (table[-1] - table[-2]) / v[1]
        beyond = v[-1] + (forces - table[-1]) / slope
        out[axle] = np.where(forces > table[-1], beyond, np.interp(forces, table, v))
    return out


def _numbers(world: World, f: Faults, part: float, body: _Body) -> tuple[Floats, Floats]:
    car, back = world.car, world.background
    n, c = np.zeros(k.NUMBERS), np.zeros((k.BY_WHEEL, 4))
    n[k.MASS], n[k.IX : k.IZ + 1] = body.mass, body.inertia
    n[k.RADIUS], n[k.TYRE], n[k.HARD], n[k.DRIVEN] = (
        car.radius,
        car.tyre_stiffness / part,
        0.5 * back.tyre_hardening,
        car.driven,
    )
    n[k.DT], n[k.PITCH], n[k.BASE], n[k.REAR] = STEP, _PITCH, car.wheelbase, body.centre[0]
    patch = max(back.patch, f.get("tyre_envelope", {}).get("length", 0.0))
    n[k.CAMS] = max(2, 1 + round(patch / _PITCH))
    n[k.PITCH] = max(patch, 0.02) / (n[k.CAMS] - 1)
    n[k.WEIGHED], n[k.ARM] = car.mass + f.get("payload", {}).get("mass", 0.0), abs(OUTER[4][0] - OUTER[0][0])
    n[k.FADE_T] = 1.0
    if "damper_fade" in f:
        n[k.FADE], n[k.FADE_T] = f["damper_fade"]["loss"], f["damper_fade"]["time_constant"]
    for row, name, key in (
        (k.VOID, "damper_cavitation", "void"),
        (k.PLAY, "loose_ball_joint", "play"),
        (k.CUBIC, "cubic_spring", "rate"),
        (k.GROOVE, "position_sensitive_damper", "rise"),
        (k.JUDDER, "brake_judder", "depth"),
        (k.TURNS, "brake_judder", "turns"),
        (k.CLUTCH, "clutch_judder", "depth"),
        (k.CLUTCH_PITCH, "clutch_judder", "pitch"),
    ):
        n[row] = f.get(name, {}).get(key, 0.0)
    if "engine_order" in f:
        own = ENGINE | f["engine_order"]
        n[k.SHAKE] = own["force"]
        n[k.IDLE : k.FLOOR + 1] = [own[a] for a in ("idle", "low", "high", "shift", "floor")]
    _by_wheel(world, f, part, n, c)
    if "body_bending" in f:
        own = f["body_bending"]
        n[k.BEND_GAIN], n[k.BEND_W], n[k.BEND_Z] = (
            own["gain"],
            2 * math.pi * own["frequency"],
            own["damping_ratio"],
        )
        rest = car.loads() - car.unsprung() * G
        n[k.BEND_LOAD] = float(rest @ [1.0, 1.0, 0.8, 0.8])
    return n, c


def _by_wheel(world: World, f: Faults, part: float, n: Floats, c: Floats) -> None:
    car, back = world.car, world.background
    loads = car.loads() - car.unsprung() * (1.0 - part) * G
    c[k.CARRIER] = part * car.unsprung()
    # where K d (1 + H d) is the load
    even = loads / n[k.TYRE]
    c[k.SINK] = (
        even if n[k.HARD] == 0.0 else (np.sqrt(1.0 + 4.0 * n[k.HARD] * even) - 1.0) / (2.0 * n[k.HARD])
    )
    c[k.SPRING] = c[k.DAMPER] = c[k.BUMP_GAP] = c[k.REBOUND_GAP] = c[k.PRESSURE] = 1.0
    c[k.TYRE_DAMPING] = back.tyre_damping + f.get("tyre_damping", {}).get("damping", 0.0)
    fine = np.linspace(0.0, SPRING_REACH, SPRING_N + 1)
    for i in range(4):
        axle, strut = ("front", car.front) if i < 2 else ("rear", car.rear)
        c[k.REST, i] = np.interp(loads[i] - c[k.CARRIER, i] * G, strut.spring, fine)
        c[k.FRICTION, i] = back.friction[i // 2] + f.get("strut_friction", {}).get(f"{axle}_force", 0.0)
        c[k.MOUNT, i] = f.get("top_mount", {}).get(f"{axle}_stiffness", 0.0)
        c[k.BAR, i] = f.get("anti_roll_bar", {}).get(f"{axle}_stiffness", 0.0)
        c[k.WORN, i] = f.get("worn_dampers", {}).get(axle, 0.0)
        sag = f.get("spring_sag", {}).get(axle, 0.0)
        c[k.REST, i] -= sag
        c[k.SPRING, i] *= 1.0 + f.get("spring_sag", {}).get("rate", 0.0) * sag
        if "semi_active_damper" in f:
            own = f["semi_active_damper"]
            c[k.SKY if own["law"] == 0.0 else k.HOOK, i] = own[axle]
        for name, gap, rate in (
            ("bump_stop", k.BUMP_GAP, k.BUMP),
            ("rebound_stop", k.REBOUND_GAP, k.REBOUND),
        ):
            if name in f:
                c[gap, i], c[rate, i] = f[name][f"{axle}_clearance"], f[name]["stiffness"]
    for name, row in (("corner_spring", k.SPRING), ("corner_damper", k.DAMPER)):
        if name in f:
            c[row, int(f[name]["corner"])] *= 1.0 + f[name]["change"]
    if "wheel_imbalance" in f:
        own = f["wheel_imbalance"]
        c[k.IMBALANCE, int(own["corner"])], c[k.PHASE, int(own["corner"])] = own["moment"], own["phase"]
    if "tyre_pressure" in f:
        c[k.PRESSURE, PLACES[int(f["tyre_pressure"]["corner"])]] = 1.0 + f["tyre_pressure"]["change"]
    if "flat_spot" in f:
        c[k.DENT, int(f["flat_spot"]["corner"])] = f["flat_spot"]["depth"]


def _state(world: World, plan: Plan, body: _Body, c: Floats) -> tuple[Any, ...]:
    """The arrays that ``integrate`` steps on, of a car that stands at the start of its lane."""
    car, surface = world.car, world.surface
    i = round(START / surface.du)
    heading = float(surface.heading[i])
    base = surface.to_map(np.array([START]), np.array([plan.lane]))[0]
    level = float(np.mean([surface.z[round((START + d) / surface.du), 60] for d in (0.0, car.wheelbase)]))
    cos, sin = math.cos(heading), math.sin(heading)
    own = np.vstack([body.centre, car.wheels()])
    at = np.column_stack(
        [
            base[0] + cos * own[:, 0] - sin * own[:, 1],
            base[1] + sin * own[:, 0] + cos * own[:, 1],
            level + own[:, 2],
        ]
    )
    turn = np.tile([math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)], (5, 1))
    keep = np.zeros((k.STATES, 4))
    keep[k.AT_U] = [START + car.wheelbase] * 2 + [START] * 2
    riders = body.riders
    ride = np.zeros((len(riders), 6))
    for m, rider in enumerate(riders):
        x, y, z = rider[k.R_X : k.R_X + 3]
        ride[m, :3] = at[0] + [cos * x - sin * y, sin * x + cos * y, z]
        if rider[k.R_GAP] == 0.0:
            ride[m, 2] -= rider[k.R_MASS] * G / rider[k.R_KX + 2]
    return (
        at, turn, np.zeros((5, 3)), np.zeros((5, 3)), np.zeros(3), np.zeros(3), np.zeros(2), riders, ride,
        np.zeros(2), keep, np.array([0.0, 0.0, 4300.0]), np.zeros(1),
    )  # fmt: skip


def _wind(f: Faults, plan: Plan) -> Floats:
    """(n, 2) N of side force and lift, a row every ``CONTROL`` s; none at all without a wind."""
    if not {"gusts", "crosswind"} & set(f):
        return np.zeros((0, 2))
    own, count = f.get("gusts") or f["crosswind"], round(plan.seconds / k.CONTROL) + 1
    rng = np.random.default_rng([int(1e4 * own["phase"]), int(plan.start), 5])
    t = np.arange(count) * k.CONTROL
    if "gusts" in f:
        # von Karman's spectrum at 20 m/s of a length of 15 m
        frequency = np.fft.rfftfreq(count, k.CONTROL)
        size = (1.0 + 70.8 * (15.0 / 20.0 * frequency) ** 2) ** (-5.0 / 12.0) * (frequency < 6.0)
        noise = rng.standard_normal((2, frequency.size)) + 1j * rng.standard_normal((2, frequency.size))
        both = np.fft.irfft(noise * size, count, axis=1).T
        both -= both.mean(axis=0)
        both *= own["force"] / both.std(axis=0) * [0.4, 1.0] * np.clip(t, 0.0, 1.0)[:, None]
        return np.ascontiguousarray(both)
    side, at = np.zeros(count), float(rng.uniform(0.5, 2.0))
    while at < t[-1]:
        lasts, most = rng.uniform(0.8, 2.4), float(rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.0))
        into = np.clip((t - at) / lasts, 0.0, 1.0)
        side += most * np.sin(np.pi * into) ** 2
        at += lasts + rng.uniform(0.4, 2.6)
    return np.asarray(own["force"] * side[:, None] * [1.0, 0.05])
