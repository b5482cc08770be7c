#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Makes the bundled drives: ``python bags/make_bags.py [--out DIR] [--only NAME]``.

A MuJoCo car (``reality/``) is driven over a surface and measured by a simulated phone and RTK
receiver, or by the phone alone. The same seeds give the same drives. Needs ``mujoco`` (the extra ``test``).
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from reality import scenes  # noqa: E402
from reality.car import STEP, Car, Rig, Strut  # noqa: E402
from reality.scenes import MONDEO, Scene  # noqa: E402
from reality.sensors import phone_samples, receiver_fixes  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from suspension_twin.drive import types  # noqa: E402
from suspension_twin.drive.write import write_drive  # noqa: E402
from suspension_twin.road import ReferenceLine, Road, write_road  # noqa: E402
from suspension_twin.vehicle.twin import Twin, parse_twin, save_twin  # noqa: E402

Floats = NDArray[Any]
SETTLE = 3.0  # s on the ground before the clock starts
CONTROL = 10  # steps between two decisions of the driver
TRUTH = 40  # steps between two rows of the truth (100 Hz)


@dataclass(frozen=True, eq=False)
class Recording:
    """What one run leaves: the drive, and the truth at 100 Hz from the phone's first moment on.

    ``truth`` columns: t (s), x, y, z of base_link (m), roll, pitch, yaw (rad), speed (m/s), four
    deflections from rest (m, front left, front right, rear left, rear right), and the vertical
    acceleration an ideal sensor at the phone's place feels (m/s², gravity's part removed).
    """

    drive: types.Drive
    truth: dict[str, Floats]


def simulate(scene: Scene, seconds: float | None = None) -> Recording:
    """Drive the scene, or only its first ``seconds``; a short run is the beginning of the long one."""
    base = Rotation.from_euler("xyz", scenes.PHONE_ASKEW) * Rotation.from_euler("xyz", scenes.PHONE_RPY)
    quat = np.roll(base.as_quat(), 1)  # MuJoCo has w first
    rig = Rig(MONDEO, scene.surface, scenes.PHONE_PLACE, quat)
    driver = scene.driver()
    rig.place(*scene.start)
    for _ in range(round(SETTLE / STEP)):
        rig.step(0.0, 0.0, 4000.0)
    count = int((seconds if seconds is not None else driver.time) / STEP / CONTROL) * CONTROL
    felt = np.empty((count, 6))
    poses = np.empty((count // CONTROL, 11))
    control = (0.0, 0.0, 0.0)
    for k in range(count):
        if k % CONTROL == 0:
            state = rig.state()
            poses[k // CONTROL] = state
            control = driver(k * STEP, state[0], state[1], state[5], state[10], CONTROL * STEP)
        rig.step(*control)
        felt[k] = rig.data.sensordata
    t = np.arange(count) * STEP
    turns = Rotation.from_euler("xyz", poses[:, 3:6])
    antenna = poses[:, :3] + turns.apply(scene.antenna)
    phone, receiver = scene.phone, scene.receiver
    stamps, force, rate = phone_samples(t, felt[:, :3], felt[:, 3:], phone, scene.start_time, scene.seed)
    fix_t, geodetic, velocity = receiver_fixes(
        t[::CONTROL], antenna, receiver, scene.datum, scene.start_time, scene.seed + 100
    )
    spread = math.hypot(receiver.white, receiver.wander)
    drive = types.Drive(
        name=scene.name,
        imu=types.ImuData(stamps, force, rate),
        fix=types.FixData(
            fix_t,
            geodetic[:, 0],
            geodetic[:, 1],
            geodetic[:, 2],
            # GBAS: a base station's corrections
            status=np.full(fix_t.size, 0 if alone(scene) else 2, dtype=np.int8),
            sigma=np.tile([spread, spread, receiver.vertical * spread], (fix_t.size, 1)),
        ),
        velocity=types.VelocityData(fix_t, velocity),
    )
    rows = poses[:: TRUTH // CONTROL]
    ideal = base.apply(felt[::TRUTH, :3])
    tilt = turns[:: TRUTH // CONTROL].inv().apply([0.0, 0.0, 9.80665])[:, 2]
    names = [
        "x",
        "y",
        "z",
        "roll",
        "pitch",
        "yaw",
        "deflection_fl",
        "deflection_fr",
        "deflection_rl",
        "deflection_rr",
    ]
    truth = {"t": scene.start_time + t[::TRUTH]} | {n: rows[:, i] for i, n in enumerate(names)}
    truth |= {"speed": rows[:, 10], "vertical_acceleration": ideal[:, 2] - tilt}
    return Recording(drive, truth)


def alone(scene: Scene) -> bool:
    """Whether a phone recorded the scene by itself: its road is for the reader to measure and to place."""
    return scene.antenna == scenes.PHONE_PLACE


def road_file(scene: Scene) -> Road:
    """The road as the twin is given it."""
    every = round(scene.road_du / scene.surface.du)
    line, heading = scene.surface.line[::every], scene.surface.heading
    ends = float(heading[0]), float(heading[-1])
    return Road(
        name=scene.name,
        z=scene.road_z.astype(np.float32).astype(np.float64),
        v=scene.road_v,
        reference=ReferenceLine.level(line[:, 0], line[:, 1], scene.road_du, ends),
    )


def preset_twin(scene: Scene) -> Twin:
    """The twin before anything is known: Table 1, and straight lines for every characteristic, the
    same on both axles, at the abscissae of Table 2."""
    compression, velocity = [0.1, 0.3, 0.5, 1.0], [0.125, 0.25, 0.35, 0.4]
    axle = {
        "unsprung_mass": 40.0,
        "spring": {"compression": compression, "force": [23_000.0 * x for x in compression]},
        "damper_push": {"velocity": velocity, "force": [4000.0 * v for v in velocity]},
        "damper_pull": {"velocity": velocity, "force": [6000.0 * v for v in velocity]},
    }
    return _twin(scene, axle, axle, {"roll": 550.0, "pitch": 2600.0}, 210_000.0, "Ford Mondeo Mk IV estate")


def true_twin(scene: Scene) -> Twin:
    """The truth as far as a twin file can say it, its curves sampled finely."""
    roll, pitch, _ = MONDEO.sprung_inertia
    return _twin(
        scene,
        _axle(MONDEO.front),
        _axle(MONDEO.rear),
        {"roll": roll, "pitch": pitch},
        MONDEO.tyre_stiffness,
        "Ford Mondeo Mk IV estate, as simulated",
    )


def _axle(strut: Strut) -> dict[str, object]:
    x = np.concatenate([np.arange(0.02, 0.4001, 0.02), [0.5, 0.6, 0.8, 1.0]])
    v = np.concatenate([np.arange(0.025, 0.5001, 0.025), [0.6, 0.8, 1.0]])
    sampled: dict[str, object] = {"unsprung_mass": strut.unsprung}
    for key, name, at, knots in (
        ("spring", "compression", x, strut.spring),
        ("damper_push", "velocity", v, strut.push),
        ("damper_pull", "velocity", v, strut.pull),
    ):
        force = Strut.curve(knots)(at)
        sampled[key] = {name: [round(float(a), 4) for a in at], "force": [round(float(f), 1) for f in force]}
    return sampled


def _twin(scene: Scene, front: object, rear: object, inertia: object, tyre: float, name: str) -> Twin:
    car: Car = MONDEO
    latitude, longitude, altitude = scene.datum
    somewhere = (
        {}
        if alone(scene)
        else {
            "datum": {"latitude": round(latitude, 9), "longitude": round(longitude, 9), "altitude": altitude},
            "road": {"file": "road.crg"},
        }
    )
    return parse_twin(
        {
            "model": "full_car",
            "vehicle": {
                "name": name,
                "mass": car.mass,
                "wheelbase": car.wheelbase,
                "front_track": car.front_track,
                "rear_track": car.rear_track,
                "cog": list(car.cog),
                "sprung_inertia": inertia,
                "tyre": {"radius": 0.316, "vertical_stiffness": tyre},
                "front": front,
                "rear": rear,
            },
            "imu": {"frame": "imu_link", "position": list(scenes.PHONE_PLACE), "rpy": list(scenes.PHONE_RPY)},
            "gps": {"frame": "gps_link", "position": list(scene.antenna)},
            **somewhere,
        }
    )


def write(scene: Scene, recording: Recording, folder: Path) -> None:
    """One folder that is a rosbag2 recording and holds everything that belongs to it."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as name:
        made = Path(name) / scene.name
        write_drive(recording.drive, made)
        for stale in folder.glob("*.mcap"):
            stale.unlink()
        for file in made.iterdir():
            shutil.move(str(file), folder / file.name)
    if alone(scene):
        save_twin(preset_twin(scene), folder / "car.yaml")
        return
    write_road(
        road_file(scene), folder / "road.crg", comment=f"{scene.title}. Simulated, made by bags/make_bags.py."
    )
    save_twin(preset_twin(scene), folder / "twin.yaml")
    save_twin(true_twin(scene), folder / "truth.yaml")
    start = float(recording.truth["t"][0])
    columns: dict[str, Any] = {
        k: (v - start if k == "t" else v).astype(np.float32) for k, v in recording.truth.items()
    }
    np.savez_compressed(folder / "truth.npz", start=start, **columns)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=HERE, help="folder to write to (default: this one)")
    parser.add_argument("--only", choices=sorted(scenes.SCENES), help="one drive only")
    arguments = parser.parse_args()
    for name, scene in scenes.SCENES.items():
        if arguments.only in (None, name):
            begin = time.perf_counter()
            made = scene()
            write(made, simulate(made), arguments.out / name)
            print(f"{arguments.out / name}: {time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
