# SPDX-License-Identifier: Apache-2.0
"""From a spec to a case folder, and to the label that is kept elsewhere."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from blind import ROOT, flexible, linkage, multibody, newton, phone, severity
from blind.faults import OF_THE_CLOCK, gross, knob, on_stretch, surveyed, without_road
from blind.newton import Faults, Motion
from blind.plan import Spec
from blind.world import FILE_DU, FILE_DV, HALF, Floats, Scene, World, make_world
from suspension_twin.drive.write import write_drive
from suspension_twin.road import ReferenceLine, Road, write_road
from suspension_twin.vehicle.twin import RoadFile, load_twin, parse_twin, save_twin

Run = Callable[..., Motion]
RUN: dict[str, Run] = {
    "newton": newton.run,
    "multibody": multibody.run,
    "linkage": linkage.run,
    "flexible": flexible.run,
}
REQUEST = "request.json"
#: Names of the drives that a case shows: the reference of a twin that was calibrated beforehand is not one.
_SHOWN = {False: ("drive_fast", "drive_slow", "reference"), True: ("drive_fast", "drive_slow")}
_MSD_BASE = 0.12


@lru_cache(maxsize=4)
def _scale(seed: int, msd: bool, scene: Scene) -> severity.Scale:
    return severity.yardstick(make_world(seed, False, scene), msd)


@lru_cache(maxsize=64)
def _curve(seed: int, msd: bool, scene: Scene, effect: str, wide: bool) -> tuple[float, ...]:
    return tuple(severity.curve(make_world(seed, False, scene), _scale(seed, msd, scene), effect, seed, wide))


def faults_of(spec: Spec) -> tuple[Faults, dict[str, dict[str, float]]]:
    """The effects' parameters for the severity asked, and what severity they have."""
    world = make_world(spec.world, spec.right, spec.scene)
    faults: Faults = {}
    reached = {}
    for effect in spec.effects:
        if spec.gross:
            faults[effect] = gross(effect, spec.world)
            scale = _scale(spec.world, spec.msd, spec.scene)
            given = scale.severity(severity.change(world, scale, {effect: faults[effect]}))
            reached[effect] = {"amount": 1.0, "severity": round(given, 3)}
            continue
        curve = np.array(_curve(spec.world, spec.msd, spec.scene, effect, spec.wide))
        scale = _scale(spec.world, spec.msd, spec.scene)
        amount = severity.amount_for(curve, spec.severity)
        values = knob(effect, world, spec.world, spec.wide)(amount, scale.null)
        faults[effect] = {k: float(v) for k, v in values.items()}
        change = severity.change(world, scale, {effect: faults[effect]})
        given = scale.severity(change, severity.counted(effect, spec.wide))
        reached[effect] = {"amount": round(amount, 6), "severity": round(given, 3)}
    return faults, reached


def make_case(spec: Spec, cases: Path, sealed: Path) -> dict[str, Any]:
    """Write the case's folder under ``cases`` and its further drive under ``sealed``; return the label."""
    world = make_world(spec.world, spec.right, spec.scene)
    faults, reached = faults_of(spec)
    stretch = None
    if spec.kind == "stretch":
        rng = np.random.default_rng([spec.world, 9, len(spec.effects[0])])
        first = float(rng.uniform(60.0, 110.0))
        stretch = (round(first, 2), round(first + float(rng.uniform(25.0, 40.0)), 2))
    base = base_faults(spec, faults)
    moving = {**base, **without_road(faults)}
    folder = cases / spec.name
    folder.mkdir(parents=True)
    drives: dict[str, Any] = {}
    for name, plan in world.plans.items():
        if name == "reference" and not (spec.reference or spec.calibrated):
            continue
        own = base if name == "reference" and not spec.alike else moving
        motion = RUN[spec.reality](world, plan, {k: v for k, v in own.items() if k not in OF_THE_CLOCK})
        drive = phone.record(world, plan, motion, own, name)
        write_drive(drive, (folder if name in _SHOWN[spec.calibrated] else sealed / spec.name) / name)
        drives[name] = {"start": plan.start, "seconds": plan.seconds}
        if stretch is not None:
            drives[name]["stretch"] = _times(motion, world, stretch, plan.start)
    write_road(
        road_file(world, surveyed(world, faults, stretch)), folder / "road.crg", comment="Surveyed road"
    )
    save_twin(parse_twin(twin_file(world, spec)), folder / "twin.yaml")
    if spec.calibrated:
        _calibrate(folder, sealed / spec.name)
    if spec.without:
        (folder / REQUEST).write_text(json.dumps({"without": list(spec.without)}) + "\n", encoding="utf-8")
    scale = {} if not spec.effects else {"floor": dict(zip(severity.CHANNELS, _floor(spec), strict=True))}
    return {
        **asdict(spec),
        "faults": faults,
        "reached": reached,
        "stretch": stretch,
        "frequency": [_resonance(world, e, v) for e, v in faults.items() if "frequency" in v],
        "drives": drives,
        **scale,
    }


def base_faults(spec: Spec, faults: Faults) -> Faults:
    """What a car has before its ``faults``."""
    return {"unsprung_mass": {"share": _MSD_BASE}} if spec.msd and "unsprung_mass" not in faults else {}


def _calibrate(folder: Path, sealed: Path) -> None:
    """Calibrate the twin of a case on the drive from before the fault, which is not among the drives of the case, with
    the road file of the case."""
    twin, made = folder / "twin.yaml", sealed / "calibrated.yaml"
    line = [
        sys.executable,
        "-m",
        "suspension_twin",
        "calibrate",
        "--twin",
        str(twin),
        str(sealed / "reference"),
    ]
    environment = dict(os.environ) | {"PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [*line, "--preset", "fast", "--out", str(made)], env=environment, capture_output=True, text=True
    )
    if run.returncode:
        raise ValueError(f"the twin cannot be calibrated: {run.stderr.strip()[-300:]}")
    known = load_twin(made)
    save_twin(known.model_copy(update={"road": RoadFile(file=folder / "road.crg")}), twin)
    for kept in sealed.glob("calibrated*"):
        kept.unlink()


def _resonance(world: World, effect: str, own: Mapping[str, float]) -> float:
    """Hz at which the effect rings in the car. An engine on its mounts rings above the frequency that it has on a
    fixed base: the body that it leans on gives way, up and down and in pitch."""
    if effect != "powertrain_mount":
        return own["frequency"]
    car, engine, x = world.car, own["mass"], own["x"]
    rest = car.mass - float(car.unsprung().sum()) - engine
    arm = x + engine * x / rest  # from the centre of the body without its engine
    inertia = car.sprung_inertia[1] - min(engine * x * arm, 0.5 * car.sprung_inertia[1])
    return own["frequency"] * math.sqrt(1.0 + engine * (1.0 / rest + arm**2 / inertia))


def _floor(spec: Spec) -> list[float]:
    return [float(f"{v:.4g}") for v in _scale(spec.world, spec.msd, spec.scene).floor]


def _times(motion: Motion, world: World, stretch: tuple[float, float], start: float) -> list[float]:
    on = np.flatnonzero(on_stretch(motion.u, world.car.wheelbase, stretch))
    return [round(start + float(motion.t[on[0]]), 3), round(start + float(motion.t[on[-1]]), 3)]


def road_file(world: World, z: Floats) -> Road:
    """The road as it was surveyed, with heights ``z`` on the file's grid."""
    line, heading = world.surface.line[::2], world.surface.heading
    ends = float(heading[0]), float(heading[-1])
    v = np.round(-HALF + np.arange(z.shape[1]) * FILE_DV, 6)
    return Road(
        name="road",
        z=z.astype(np.float32).astype(np.float64),
        v=v,
        reference=ReferenceLine.level(line[:, 0], line[:, 1], FILE_DU, ends),
    )


def twin_file(world: World, spec: Spec) -> dict[str, Any]:
    """What the user knows of the vehicle and where it stands."""
    latitude, longitude, altitude = world.datum
    known = dict(world.known)
    return {
        "model": "msd" if spec.msd else "full_car",
        "vehicle": known,
        "imu": {"frame": "imu_link", "position": list(world.phone.place), "rpy": list(world.phone.rpy)},
        "gps": {"frame": "gps_link", "position": list(world.antenna)},
        "datum": {"latitude": latitude, "longitude": longitude, "altitude": altitude},
        "road": None if spec.planar else {"file": "road.crg"},
    }
