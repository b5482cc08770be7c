# SPDX-License-Identifier: Apache-2.0
"""Cases of the tracked vehicle's blind check: a specimen of another model, one fault, as strong as asked for in floors.

As the cars' check has it: a fault is as strong as what it changes that no recalibration takes away, in units of
the floor. The change is that of ``tracked_reality``, without a camera's noise, at both speeds; taken away is what
the start of a clock and a driver's speed may be off by, within bounds; the floor is what repeats differ by. Severity
is the largest of the nine channels' ratios. A strength beyond which nobody would believe the fault is not
exceeded: then the case has all of it, and ``floors`` in its truth says how much that is.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tracked_reality import Faults, photogrammetry, simulate
from tracked_runs import write_run

from suspension_twin.arrays import Floats
from suspension_twin.inference.marker_runs import RATE, MarkerRun, low_pass
from suspension_twin.vehicle.tracked import TrackedVehicle, load_tracked

FILE = Path(__file__).resolve().parents[1] / "config" / "tracked" / "pt91.yaml"
KINDS = (
    "none",
    "track_tension",
    "track_wear",
    "station_damper",
    "station_bar",
    "payload",
    "sensor_scale",
    "sensor_tilt",
    "time_offset",
)
SEVERITIES = (0.5, 1.5, 5.0)
SPEEDS = {8: 7.4, 13: 5.0}  # km/h: s
FLOOR = np.repeat([1.5e-3, 0.01, 0.16], 3)  # m, m/s, m/s² by which repeats of one specimen differ
_CLOCK = np.array([0.03, 0.02])  # s and share: more no start and no driver is off by
_AMOUNTS = (0.2, 0.5, 1.0)  # of the most that is believed, at which the reality is asked
_REPEATS = 2


@dataclass(frozen=True)
class Camera:
    """What a camera makes of motion, as ``tracked_reality.photogrammetry`` has it: heights times ``scale``, a clock
    ``late`` s, and ``tilt`` rad about the axis of view, by which travel lessens heights."""

    scale: float = 1.0
    late: float = 0.0
    tilt: float = 0.0

    def see(self, t: Floats, z: Floats, speed: float) -> Floats:
        """(n, k) heights m of markers on a run at ``speed`` m/s, without noise."""
        moved = np.stack([np.interp(t - self.late, t, c) for c in z.T], axis=1)
        return np.asarray(self.scale * (moved - self.tilt * speed * (t - self.late)[:, None]))


def signals(run: MarkerRun) -> Floats:
    """(n, 9) displacement, velocity and acceleration of A, B and C."""
    return np.concatenate([run.markers, run.velocity, run.acceleration], axis=1)


@dataclass(frozen=True)
class Made:
    """What a fault of some strength is: the specimen with it, and what the camera does."""

    truth: dict[str, float]
    vehicle: TrackedVehicle
    faults: Faults = Faults()
    camera: Camera = Camera()


def specimen(rng: np.random.Generator) -> TrackedVehicle:
    """A sound vehicle that is not quite what the file of its type says."""
    return load_tracked(FILE).with_changes(
        {
            "track.stiffness": float(np.exp(rng.uniform(np.log(1.5e7), np.log(4e7)))),
            "track.bending_stiffness": float(np.exp(rng.uniform(np.log(3e2), np.log(4e3)))),
            "track.damping": float(np.exp(rng.uniform(np.log(5e3), np.log(3e4)))),
            "track.bending_damping": float(np.exp(rng.uniform(np.log(1e2), np.log(2e3)))),
            "idler.setting": float(rng.uniform(-5575, -5558)),
            "mass": float(rng.uniform(41500, 43500)),
            "arm.stiffness": float(1.27e5 * rng.uniform(0.95, 1.05)),
        }
    )


def knob(kind: str, vehicle: TrackedVehicle, rng: np.random.Generator) -> Callable[[float], Made]:
    """The fault by its amount, 0 none and 1 the most that is believed."""
    sign = float(rng.choice([-1, 1]))
    if kind == "track_tension":  # to the end of the paper's range, eq. (14)
        room = -5550.0 - vehicle.idler.setting if sign < 0 else vehicle.idler.setting + 5590.0

        def made(a: float) -> Made:
            moved = sign * a * room
            setting = float(np.clip(vehicle.idler.setting - moved, -5590.0, -5550.0))
            return Made({"tighter": moved}, vehicle.with_changes({"idler.setting": setting}))

    elif kind == "track_wear":
        worn = {
            k: getattr(vehicle.track, k.split(".")[1]) for k in ("track.stiffness", "track.bending_stiffness")
        }

        def made(a: float) -> Made:
            left = 0.2**a
            return Made({"stiffness": left}, vehicle.with_changes({k: v * left for k, v in worn.items()}))

    elif kind == "station_damper":
        place = int(rng.choice([1, 2, 6]))

        def made(a: float) -> Made:
            factor = tuple(1.0 - a if i == place - 1 else 1.0 for i in range(6))
            return Made({"station": place, "change": -a}, vehicle, Faults(damper=factor))

    elif kind == "station_bar":
        place = int(rng.choice([1, 2, 5, 6]))

        def made(a: float) -> Made:
            sag = tuple(0.2 * a if i == place - 1 else 0.0 for i in range(6))
            return Made({"station": place, "sag": 0.2 * a}, vehicle, Faults(sag=sag))

    elif kind == "payload":
        x = float(rng.uniform(-1.0, 1.0))

        def made(a: float) -> Made:
            mass = 8000.0 * a
            ahead = vehicle.cog[0] + x - vehicle.stations[-1].x  # of the rearmost road wheels
            faults = Faults(payload=mass, payload_x=vehicle.cog[0] + x)
            return Made({"mass": mass, "x": ahead}, vehicle, faults)

    elif kind == "sensor_scale":

        def made(a: float) -> Made:
            return Made({"scale": sign * 0.3 * a}, vehicle, camera=Camera(scale=1.0 + sign * 0.3 * a))

    elif kind == "sensor_tilt":

        def made(a: float) -> Made:
            return Made({"pitch": -sign * 0.03 * a}, vehicle, camera=Camera(tilt=sign * 0.03 * a))

    elif kind == "time_offset":

        def made(a: float) -> Made:
            return Made({"offset": sign * 0.3 * a}, vehicle, camera=Camera(late=sign * 0.3 * a))

    else:

        def made(a: float) -> Made:
            return Made({}, vehicle)

    return made


@functools.lru_cache(maxsize=8)
def _moved(vehicle: TrackedVehicle, faults: Faults, kmh: int) -> dict[str, Floats]:
    return simulate(vehicle, kmh / 3.6, SPEEDS[kmh] + 0.4, faults)


def filmed(made: Made, kmh: int) -> MarkerRun:
    """One run as a camera without noise gives it."""
    motion = _moved(made.vehicle, made.faults, kmh)
    t = np.arange(0.0, SPEEDS[kmh], 1.0 / RATE)
    z = low_pass(np.stack([np.interp(t, motion["t"], c) for c in motion["markers"].T], axis=1), RATE)
    z = made.camera.see(t, z, kmh / 3.6)
    v = np.gradient(z, t, axis=0)
    return MarkerRun(t, z, v, np.gradient(v, t, axis=0), kmh / 3.6, f"{kmh:02d}kmh")


def left_over(change: Floats, sound: Floats, t: Floats) -> Floats:
    """(n, 9) in floors: a change without what a late clock and another speed may account for."""
    slope = -np.gradient(sound, t, axis=0)
    shifts = np.stack([(slope / FLOOR).ravel(), (slope * t[:, None] / FLOOR).ravel()], axis=1)
    c = (change / FLOOR).ravel()
    clock = np.clip(np.linalg.lstsq(shifts, c, rcond=None)[0], -_CLOCK, _CLOCK)
    return np.asarray((c - shifts @ clock).reshape(-1, 9))


def severity(made: Made, sound: dict[int, MarkerRun]) -> float:
    """Largest channel of what a fault changes at both speeds, in floors."""
    rest = [left_over(signals(filmed(made, k)) - signals(s), signals(s), s.t) for k, s in sound.items()]
    return float(np.sqrt(np.mean(np.concatenate(rest) ** 2, axis=0)).max())


def amount_for(floors: Floats, target: float) -> float:
    """Amount that gives a severity as far as the reality was asked; all of it where all is not enough."""
    rising = np.maximum.accumulate(np.concatenate([[0.0], floors])) + 1e-9 * np.arange(len(floors) + 1)
    return float(np.interp(target, rising, np.concatenate([[0.0], _AMOUNTS])))


def write_runs(made: Made, folder: Path, rng: np.random.Generator) -> None:
    """Two runs at each speed: the driver's speed, the start of the clock and the camera's noise differ."""
    folder.mkdir(parents=True)
    for kmh, seconds in SPEEDS.items():
        for repeat in range(_REPEATS):
            motion = simulate(made.vehicle, kmh / 3.6 * (1 + rng.normal(0, 0.006)), seconds, made.faults)
            table = photogrammetry(
                motion,
                int(rng.integers(1 << 30)),
                rate=50.0,
                scale=made.camera.scale,
                tilt=made.camera.tilt,
                late=made.camera.late + rng.normal(0, 0.008),
            )
            write_run(folder / f"{kmh:02d}kmh_{repeat + 1}.csv", table)


def make_cases(kind: str, seed: int, folder: Path) -> list[dict[str, Any]]:
    """Write one specimen's runs from before, and those with its fault at each severity; their truths.

    ``folder`` gets ``before`` and for each case ``after_<severity>``; ``truth.json`` holds the list. What is there
    already is taken as it is.
    """
    known = folder / "truth.json"
    if known.is_file():
        return list(json.loads(known.read_text(encoding="utf-8")))
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    vehicle = specimen(rng)
    turn = knob(kind, vehicle, rng)
    write_runs(turn(0.0), folder / "before", rng)
    sound: dict[int, MarkerRun] = {}
    floors: Floats = np.zeros(0)
    if kind != "none":
        sound = {kmh: filmed(turn(0.0), kmh) for kmh in SPEEDS}
        floors = np.array([severity(turn(a), sound) for a in _AMOUNTS])
    truths = []
    for target in SEVERITIES if kind != "none" else (0.0,):
        made = turn(amount_for(floors, target) if kind != "none" else 0.0)
        write_runs(made, folder / f"after_{target:g}", rng)
        reached = min(severity(made, sound), 99.0) if kind != "none" else 0.0
        truths.append(
            {"kind": kind, "seed": seed, "severity": target, "floors": round(reached, 2), **made.truth}
        )
    known.write_text(json.dumps(truths), encoding="utf-8")
    return truths
