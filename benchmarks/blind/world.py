# SPDX-License-Identifier: Apache-2.0
"""What is varied by seed: a car, a road, four drives over it, a phone, and what its user knows of it.

A world is the truth without any effect. The user's knowledge (the twin file) has the masses and the
geometry to a few per cent and a generic preset for every characteristic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from reality.driver import GRID, speed_over_path
from reality.surface import Surface, roughness
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

Floats = NDArray[Any]
G = 9.80665
Scene = Literal["usual", "smooth", "bump", "short"]
CORNERS = ("front_left", "front_right", "rear_left", "rear_right")
LENGTH, DU, DV, HALF = 200.0, 0.025, 0.05, 3.0  # m of the road: length, grid, half width
START = 8.0  # m, where the rear axle stands at first
FILE_DU, FILE_DV = 0.05, 0.1
SPRING_REACH, SPRING_N = 0.6, 1200  # m, of the tables of characteristics
DAMPER_REACH, DAMPER_N = 3.0, 3000  # m/s


@dataclass(frozen=True, eq=False)
class Strut:
    """One axle's strut at the wheel: tables of force over compression and over velocity."""

    unsprung: float
    spring: Floats
    push: Floats
    pull: Floats


@dataclass(frozen=True, eq=False)
class Car:
    """The true car; heights count from the ground at rest, x from the rear axle."""

    mass: float
    wheelbase: float
    tracks: tuple[float, float]
    cog: tuple[float, float, float]
    sprung_inertia: tuple[float, float, float]
    radius: float
    tyre_stiffness: float
    cornering: float
    driven: int  # 0 front, 1 rear
    front: Strut
    rear: Strut

    def wheels(self) -> Floats:
        """(4, 3) wheel centres in base_link at rest."""
        a, b = self.tracks[0] / 2, self.tracks[1] / 2
        r, w = self.radius, self.wheelbase
        return np.array([[w, a, r], [w, -a, r], [0.0, b, r], [0.0, -b, r]])

    def unsprung(self) -> Floats:
        return np.array([self.front.unsprung] * 2 + [self.rear.unsprung] * 2)

    def loads(self) -> Floats:
        """(4,) N that each tyre carries at rest on level ground."""
        front = self.mass * self.cog[0] / self.wheelbase
        axles = ((front, self.tracks[0]), (self.mass - front, self.tracks[1]))
        return np.array([m * G * (0.5 + side * self.cog[1] / t) for m, t in axles for side in (1, -1)])


@dataclass(frozen=True)
class Background:
    """The small things that a reality has whatever else: none of them is a finding."""

    friction: tuple[float, float] = (0.0, 0.0)  # N, front and rear
    tyre_damping: float = 0.0  # N s/m
    patch: float = 0.0  # m
    tyre_hardening: float = 0.0  # 1/m


@dataclass(frozen=True)
class Phone:
    """The phone as it is: ``place`` and ``rpy`` are what the user wrote, the rest nobody did."""

    place: tuple[float, float, float]
    rpy: tuple[float, float, float]
    misplaced: tuple[float, float, float]
    askew: tuple[float, float, float]
    force_bias: tuple[float, float, float]
    rate_bias: tuple[float, float, float]
    force_noise: float
    rate_noise: float
    holder: float  # Hz
    lag: float
    jitter: float
    lost: float


@dataclass(frozen=True, eq=False)
class Plan:
    """One drive: speed (n,) m/s and its rate every 10 ms from standing, on lateral offset ``lane`` m."""

    speed: Floats
    push: Floats
    lane: float
    start: float
    seed: int

    @property
    def seconds(self) -> float:
        return (self.speed.size - 1) * 0.01


@dataclass(frozen=True, eq=False)
class World:
    seed: int
    car: Car
    background: Background
    phone: Phone
    surface: Surface
    survey: Floats  # heights of the road file
    plans: dict[str, Plan]
    datum: tuple[float, float, float]
    known: dict[str, Any]  # the vehicle part of the user's twin file
    antenna: tuple[float, float, float]


def spring_table(rate: float, hardening: float) -> Floats:
    """Force over compression 0 .. SPRING_REACH: a slightly hardening spring."""
    x = np.linspace(0.0, SPRING_REACH, SPRING_N + 1)
    return rate * x * (1.0 + hardening * (x / 0.3) ** 2)


def damper_table(low: float, high: float, knee: float) -> Floats:
    """Force over velocity 0 .. DAMPER_REACH: slope ``low`` at rest, ``high`` far beyond the knee."""
    v = np.linspace(0.0, DAMPER_REACH, DAMPER_N + 1)
    return high * v + (low - high) * knee * np.tanh(v / knee)


def _car(rng: np.random.Generator) -> Car:
    mass = rng.uniform(1150.0, 2000.0)
    wheelbase = rng.uniform(2.5, 2.95)
    share = rng.uniform(0.44, 0.58)  # of the weight on the front axle
    struts = []
    for axle, part in enumerate((share, 1.0 - share)):
        unsprung = rng.uniform(33.0, 46.0)
        corner = mass * part / 2 - unsprung
        rate = corner * (2 * math.pi * (rng.uniform(1.1, 1.45) + 0.15 * axle)) ** 2
        critical = 2 * math.sqrt(rate * corner)
        push, pull = rng.uniform(0.18, 0.3) * critical, rng.uniform(0.35, 0.55) * critical
        bend = rng.uniform(0.3, 0.75)
        struts.append(
            Strut(
                unsprung,
                spring_table(rate, rng.uniform(0.0, 0.1)),
                damper_table(push, push * bend, rng.uniform(0.08, 0.25)),
                damper_table(pull, pull * bend, rng.uniform(0.08, 0.25)),
            )
        )
    height = rng.uniform(0.5, 0.62)
    tracks = (rng.uniform(1.46, 1.6), rng.uniform(1.46, 1.6))
    cog = (share * wheelbase, rng.uniform(-0.012, 0.012), height)
    roll, pitch = mass * rng.uniform(0.29, 0.36), mass * rng.uniform(1.25, 1.6)
    return Car(
        mass=mass,
        wheelbase=wheelbase,
        tracks=tracks,
        cog=cog,
        sprung_inertia=(roll, pitch, pitch + roll * rng.uniform(0.5, 0.9)),
        radius=rng.uniform(0.29, 0.33),
        tyre_stiffness=rng.uniform(185e3, 250e3),
        cornering=60e3,
        driven=int(rng.random() < 0.4),
        front=struts[0],
        rear=struts[1],
    )


def car_of(seed: int) -> Car:
    """The car of a world."""
    return _car(np.random.default_rng([seed, 1]))


def _known(car: Car, rng: np.random.Generator, right: bool) -> dict[str, Any]:
    """What a careful user writes; ``right`` gives the true characteristics instead of a preset."""

    def off(value: float, share: float) -> float:
        return round(value * (1.0 + share * rng.uniform(-1, 1)), 4)

    x, v = [0.1, 0.3, 0.5, 1.0], [0.125, 0.25, 0.35, 0.4]
    stiff, push, pull = rng.uniform(19e3, 31e3), rng.uniform(1200.0, 2800.0), rng.uniform(2600.0, 4600.0)
    axles = []
    for strut in (car.front, car.rear):
        springs, pushes, pulls = [stiff * a for a in x], [push * a for a in v], [pull * a for a in v]
        if right:
            fine = np.linspace(0, SPRING_REACH, SPRING_N + 1)
            quick = np.linspace(0, DAMPER_REACH, DAMPER_N + 1)
            end = strut.spring[-1] + (strut.spring[-1] - strut.spring[-2]) / fine[1] * (1.0 - SPRING_REACH)
            springs = [*np.interp(x[:3], fine, strut.spring), end]
            pushes, pulls = (np.interp(v, quick, f).tolist() for f in (strut.push, strut.pull))
        axles.append(
            {
                "unsprung_mass": off(strut.unsprung, 0.04),
                "spring": {"compression": x, "force": [round(float(f), 1) for f in springs]},
                "damper_push": {"velocity": v, "force": [round(float(f), 1) for f in pushes]},
                "damper_pull": {"velocity": v, "force": [round(float(f), 1) for f in pulls]},
            }
        )
    return {
        "name": "car",
        "mass": off(car.mass, 0.005),
        "wheelbase": round(car.wheelbase, 4),
        "front_track": round(car.tracks[0], 3),
        "rear_track": round(car.tracks[1], 3),
        "cog": [round(car.cog[0] + rng.uniform(-0.015, 0.015), 4), 0.0, round(car.cog[2], 2)],
        "sprung_inertia": {
            "roll": off(car.sprung_inertia[0], 0.05),
            "pitch": off(car.sprung_inertia[1], 0.05),
        },
        "tyre": {"radius": round(car.radius, 3), "vertical_stiffness": off(car.tyre_stiffness, 0.05)},
        "front": axles[0],
        "rear": axles[1],
    }


def _surface(rng: np.random.Generator, seed: int, scene: Scene = "usual") -> Surface:
    """A worn straight or gently winding road with humps, edges and holes; a smooth one without them, or with one hump
    alone."""
    u = np.arange(round(LENGTH / DU) + 1) * DU
    v = -HALF + np.arange(round(2 * HALF / DV) + 1) * DV
    worn = scene in ("usual", "short")
    z = roughness(
        (u.size, v.size), DU, DV, 10 ** (rng.uniform(-4.4, -3.8) if worn else rng.uniform(-5.2, -4.6)), seed
    )
    if scene == "bump":
        z += (rng.uniform(0.04, 0.08) * _hump(u, rng.uniform(50.0, 75.0), rng.uniform(0.5, 3.7)))[:, None]
    at = 26.0 if worn else LENGTH
    while at < LENGTH - 12.0:
        kind = rng.integers(0, 4)
        sign = 1.0 if rng.random() < 0.7 else -1.0
        if kind == 0:  # across the whole road, as a speed hump
            z += (sign * rng.uniform(0.025, 0.06) * _hump(u, at, rng.uniform(0.8, 3.5)))[:, None]
        elif kind == 1:  # under one side
            middle, width = rng.choice([-0.8, 0.8]), rng.uniform(0.5, 0.9)
            side = 1.0 / (1.0 + np.exp((np.abs(v - middle) - width) / 0.03))
            z += np.outer(sign * rng.uniform(0.02, 0.06) * _hump(u, at, rng.uniform(0.5, 1.6)), side)
        elif kind == 2:  # a short edge: a cover, a cable bridge
            z += (sign * rng.uniform(0.01, 0.025) * _hump(u, at, rng.uniform(0.15, 0.35)))[:, None]
        else:  # a settled patch: down and up again
            step = 0.5 * (np.tanh((u - at) / 0.15) - np.tanh((u - at - rng.uniform(3.0, 6.0)) / 0.15))
            z -= (rng.uniform(0.008, 0.02) * step)[:, None]
        at += rng.uniform(7.0, 14.0)
    bend = np.zeros(u.size)
    if rng.random() < 0.7:
        first = rng.uniform(40, 90)
        bend = np.where(
            (u > first) & (u < first + rng.uniform(40, 80)), rng.choice([-1, 1]) / rng.uniform(120, 350), 0
        )
    heading = rng.uniform(-math.pi, math.pi) + np.cumsum(gaussian_filter1d(bend, 4.0 / DU)) * DU
    return Surface(DU, DV, -HALF, (0.0, 0.0), heading, z)


def _hump(u: Floats, at: float, length: float) -> Floats:
    return np.where(np.abs(u - at) < length / 2, 0.5 * (1 + np.cos(2 * np.pi * (u - at) / length)), 0.0)


def drive_plan(
    rng: np.random.Generator,
    low: float,
    high: float,
    number: int,
    seed: int,
    lane: float,
    length: float = LENGTH - START - 12.0,
) -> Plan:
    """A drive over ``length`` m of the road, all by default, between speeds ``low`` and ``high`` m/s, on lateral offset
    ``lane`` m."""
    limits, s = [(0.0, rng.uniform(low, high))], 0.0
    while s < length:
        s += rng.uniform(20.0, 45.0)
        limits.append((s, rng.uniform(low, high)))
    speed = speed_over_path(length, limits, accelerate=rng.uniform(1.4, 2.0), brake=rng.uniform(1.4, 2.2))
    v = np.maximum(0.5 * (speed[1:] + speed[:-1]), 0.05)
    t = np.concatenate([[0.0], np.cumsum(GRID / v)])
    stand = rng.uniform(3.0, 4.5)
    grid = np.arange(0.0, stand + t[-1] + 1.0, 0.01)
    plan = uniform_filter1d(np.interp(grid - stand, t, speed, left=0.0, right=0.0), 81, mode="nearest")
    start = 1_700_000_000.0 + 86_400.0 * (seed % 997) + 600.0 * number + float(rng.uniform(0, 60))
    return Plan(plan, np.gradient(plan, 0.01), lane, round(start, 3), 17 * seed + number)


@lru_cache(maxsize=2)
def make_world(seed: int, right: bool = False, scene: Scene = "usual") -> World:
    """The world of a seed; ``right`` makes the user know the characteristics. Scenes: the usual road, a smooth one, one
    hump on a smooth one, and drives of a third of the usual length."""
    rng = np.random.default_rng([seed, 1])
    car = _car(rng)
    background = Background(
        friction=(rng.uniform(5, 14), rng.uniform(5, 14)),
        tyre_damping=rng.uniform(30, 80),
        patch=rng.uniform(0.04, 0.08),
        tyre_hardening=rng.uniform(0.0, 4.0),
    )
    place = (car.cog[0] + rng.uniform(-0.3, 0.9), rng.uniform(-0.4, 0.4), rng.uniform(0.9, 1.25))
    phone = Phone(
        place=tuple(round(p, 3) for p in place),  # type: ignore[arg-type]
        rpy=(1.309, 0.0, -1.5708) if rng.random() < 0.3 else (0.0, 0.0, 0.0),
        misplaced=tuple(rng.uniform(-0.015, 0.015, 3)),
        askew=tuple(np.radians(rng.uniform(-0.6, 0.6, 3))),
        force_bias=tuple(rng.uniform(-0.06, 0.06, 3)),
        rate_bias=tuple(rng.uniform(-0.004, 0.004, 3)),
        force_noise=rng.uniform(0.012, 0.03),
        rate_noise=rng.uniform(0.001, 0.002),
        holder=rng.uniform(42.0, 60.0),
        lag=rng.uniform(-1e-3, 1e-3),
        jitter=rng.uniform(1e-4, 4e-4),
        lost=0.001,
    )
    surface = _surface(np.random.default_rng([seed, 2]), 31 * seed + 5, scene)
    survey = surface.surveyed(FILE_DU, FILE_DV, 0.0, 3e-4, 31 * seed + 6)
    rng = np.random.default_rng([seed, 3])
    top, lane = rng.uniform(7.5, 10.5), rng.uniform(-0.4, 0.4)
    paces = {
        "drive_fast": (0.65 * top, top),
        "drive_slow": (3.4, 5.4),
        "reference": (0.5 * top, 0.75 * top),
        "sealed": (0.55 * top, 0.9 * top),
    }
    length = {"short": 62.0, "bump": 100.0}.get(scene, LENGTH - START - 12.0)
    plans = {
        name: drive_plan(rng, *pace, number, seed, lane + rng.uniform(-0.1, 0.1), length)
        for number, (name, pace) in enumerate(paces.items())
    }
    known = _known(car, np.random.default_rng([seed, 4]), right)
    datum = (round(rng.uniform(40, 55), 6), round(rng.uniform(0, 25), 6), round(rng.uniform(50, 400), 1))
    return World(seed, car, background, phone, surface, survey, plans, datum, known, (0.0, 0.0, 1.5))


def plain(world: World) -> World:
    """The same world without its background, on the road as the file has it: what a twin can follow."""
    fine = _refined(world.survey, world.surface)
    return replace(world, background=Background(), surface=replace(world.surface, z=fine))


def _refined(survey: Floats, surface: Surface) -> Floats:
    """Heights of the file on the fine grid, linear between its points."""
    u = np.arange(surface.z.shape[0]) / round(FILE_DU / DU)
    v = np.arange(surface.z.shape[1]) / round(FILE_DV / DV)
    i, j = np.minimum(u.astype(int), survey.shape[0] - 2), np.minimum(v.astype(int), survey.shape[1] - 2)
    a, b = (u - i)[:, None], (v - j)[None, :]
    near, far = ((1 - b) * survey[np.ix_(k, j)] + b * survey[np.ix_(k, j + 1)] for k in (i, i + 1))
    return np.asarray((1 - a) * near + a * far)
