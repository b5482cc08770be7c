# SPDX-License-Identifier: Apache-2.0
"""What a vehicle's own effect would have changed in the drives of a multibody car, by a formulation that is not ours.

``blind.newton`` drives a car with the multibody car's own springs and dampers (taken from the engine's truth) over its
road at its speed, with the effect and without. What differs, laid over the way and not over time, is what the effect
adds to the sensor. The multibody car itself did not have it: where it would have moved otherwise than the simpler car,
its own linkages and its tyres' slip with the effect, this is missing.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from blind import newton
from blind.faults import BODY, OUTSIDE, Null, knob
from blind.newton import Faults, Motion
from blind.world import (
    DAMPER_N,
    DAMPER_REACH,
    DU,
    DV,
    HALF,
    START,
    Background,
    Car,
    Floats,
    Phone,
    Plan,
    Strut,
    World,
    spring_table,
)
from multibody_truth import AXLES, CORNERS, Truth, read_truth
from reality.surface import Surface
from scipy.interpolate import CubicSpline
from scipy.optimize import nnls
from scipy.signal import butter, sosfiltfilt

from suspension_twin.effects.registry import EFFECTS
from suspension_twin.road import load_road
from suspension_twin.vehicle.twin import load_twin

__all__ = ["NAMELESS", "VEHICLE", "changed", "faults_of"]

VEHICLE = (*(e for e in BODY if e != "sensor_offset"), *OUTSIDE)
#: Those that no twin can be given.
NAMELESS = tuple(e for e in OUTSIDE if e not in EFFECTS)
#: Between these velocities of a strut in m/s its damper is taken to be linear.
_KNOTS = np.array([0.0, 0.05, 0.15, 0.35, 0.8])


@lru_cache(maxsize=4)
def _world(source: Path, name: str) -> tuple[World, Truth, float]:
    """The multibody car, its road and one of its drives as ``blind`` has them, its truth, and m from the road's
    start to that of newton's road."""
    truth, twin, road = (
        read_truth(source, name),
        load_twin(source / "twin.yaml"),
        load_road(source / "road.crg"),
    )
    begun = float(truth.columns["u"][0]) - twin.vehicle.wheelbase - START
    u = begun + np.arange(round((road.length - begun) / DU)) * DU
    v = -HALF + np.arange(round(2 * HALF / DV) + 1) * DV
    along = np.clip(u, 0.0, road.length - 1e-6)
    z = np.stack(
        [road.heights_uv(along, np.full_like(u, np.clip(at, road.v[0], road.v[-1]))) for at in v], axis=1
    )
    surface = Surface(DU, DV, -HALF, (0.0, 0.0), np.zeros(u.size), np.nan_to_num(z))
    vehicle, imu = twin.vehicle, twin.imu
    struts = [_strut(truth, k, getattr(vehicle, axle).unsprung_mass) for k, axle in enumerate(AXLES)]
    roll, pitch = vehicle.sprung_inertia.roll, vehicle.sprung_inertia.pitch
    car = Car(
        mass=vehicle.mass,
        wheelbase=vehicle.wheelbase,
        tracks=(vehicle.front_track, vehicle.rear_track),
        cog=tuple(vehicle.cog),
        sprung_inertia=(roll, pitch, pitch + 0.7 * roll),
        radius=vehicle.tyre.radius,
        tyre_stiffness=vehicle.tyre.vertical_stiffness,
        cornering=60e3,
        driven=1,
        front=struts[0],
        rear=struts[1],
    )
    phone = Phone(
        place=imu.position,
        rpy=(0.0,) * 3,
        misplaced=(0.0,) * 3,
        askew=(0.0,) * 3,
        force_bias=(0.0,) * 3,
        rate_bias=(0.0,) * 3,
        force_noise=0.0,
        rate_noise=0.0,
        jitter=0.0,
        lag=0.0,
        lost=0.0,
        holder=60.0,
    )
    t = np.arange(0.0, float(truth.t[-1]) + 0.5, 0.01)
    speed = np.maximum(np.interp(t, truth.t, truth.columns["v_fwd"]), 0.0)
    plan = Plan(speed, np.gradient(speed, 0.01), 0.0, truth.start, 1)
    world = World(
        0, car, Background(), phone, surface, surface.z, {name: plan}, (0.0, 0.0, 0.0), {}, (0.0, 0.0, 1.5)
    )
    return world, truth, begun


def _strut(truth: Truth, axle: int, unsprung: float) -> Strut:
    """An axle's spring and damper at the wheels, from the forces in its struts."""
    c, ratio = truth.columns, float(abs(truth.ratio[2 * axle]))
    left, right = CORNERS[2 * axle : 2 * axle + 2]
    both = [np.concatenate([c[f"{kind}_{left}"], c[f"{kind}_{right}"]]) for kind in ("sc", "Fs", "sv", "Fd")]
    rate = float(np.polyfit(both[0] / ratio, both[1] * ratio, 1)[0])
    velocity, force = both[2] / ratio, both[3] * ratio
    tables = []
    for way in (1.0, -1.0):
        on = way * velocity > 0
        ramps = np.stack(
            [np.clip(way * velocity[on], a, b) - a for a, b in zip(_KNOTS[:-1], _KNOTS[1:], strict=True)]
        )
        slopes = nnls(ramps.T, way * force[on])[0]
        fine = np.linspace(0.0, DAMPER_REACH, DAMPER_N + 1)
        ends = [*_KNOTS[1:-1], DAMPER_REACH]
        tables.append(
            sum(s * (np.clip(fine, a, b) - a) for s, a, b in zip(slopes, _KNOTS[:-1], ends, strict=True))
        )
    return Strut(unsprung, spring_table(rate, 0.0), np.asarray(tables[0]), np.asarray(tables[1]))


def changed(source: Path, name: str, faults: Faults) -> Floats:
    """(n, 6) what faults change of specific force (m/s²) and angular rate (rad/s) at the sensor, in base_link axes, at
    the times of a drive's truth."""
    own = {k: v for k, v in faults.items() if k in VEHICLE}
    if not own:
        return np.zeros((read_truth(source, name).t.size, 6))
    world, truth, begun = _world(source, name)
    moved, plain = newton.run(world, world.plans[name], own), _plain(source, name)
    return _along(moved, truth, begun) - _along(plain, truth, begun)


@lru_cache(maxsize=4)
def _plain(source: Path, name: str) -> Motion:
    world, _, _ = _world(source, name)
    return newton.run(world, world.plans[name], {})


def _along(motion: Motion, truth: Truth, begun: float) -> Floats:
    """(n, 6) what is felt where the truth's rear axle has come to; before it drives off and once it has stopped, as
    long before and after: a car that stands creeps by centimetres, and not by the same."""
    way = truth.columns["u"] - truth.wheelbase - begun
    come = np.maximum.accumulate(motion.u)
    apart = np.concatenate([[True], np.diff(come) > 0])
    t = np.interp(way, come[apart], motion.t[apart])
    driven = np.flatnonzero(truth.moving)
    first, last = driven[0], driven[-1]
    t[:first] = t[first] + truth.t[:first] - truth.t[first]
    t[last:] = t[last] + truth.t[last:] - truth.t[last]
    felt = np.hstack([motion.force, motion.rate])
    return np.asarray(CubicSpline(motion.t, felt)(np.clip(t, motion.t[0], motion.t[-1])))


def faults_of(effect: str, share: float, source: Path, name: str, seed: int) -> Faults:
    """An effect's parameters where what it changes of the vertical acceleration below 20 Hz is a share of the motion's
    rms on a drive, or as much of it as there can be."""
    world, truth, _ = _world(source, name)
    turn, null = knob(effect, world, seed), Null.of(_plain(source, name))
    sos = butter(4, 20.0, fs=truth.rate, output="sos")

    def rms(vertical: Floats) -> float:
        return float(np.std(sosfiltfilt(sos, vertical)[truth.moving]))

    motion = rms(truth.columns["fz"])
    low, high = 0.0, 1.0
    for _ in range(9):
        middle = 0.5 * (low + high)
        more = rms(changed(source, name, {effect: turn(middle, null)})[:, 2]) < share * motion
        low, high = (middle, high) if more else (low, middle)
    return {effect: {k: float(v) for k, v in turn(high, null).items()}}
