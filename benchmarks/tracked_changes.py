# SPDX-License-Identifier: Apache-2.0
"""What a fault changes of the markers' motion: in the reality of 97 links, and in the model.

The specimen of ``tracked_reality`` drives once sound and once with each fault, without a camera's noise; the model is
calibrated on the sound run with the preset ``fast``. Both changes in units of what repeats differ by (1.5 mm, 0.01
m/s, 0.16 m/s²), with what a late clock and another speed would look like taken out of both. What is small here no
diagnosis sees; what correlates badly it cannot name (``disp.``: in displacements alone). Before that, in the same
units, how far the model is off the sound specimen: with the specimen's own parameters on a prescribed way, with a
driver, and calibrated. Beside it how far the fault lets the standing hull sink, which displacements from a standing
start do not show.
Usage: ``python benchmarks/tracked_changes.py [--kmh 4 20] [--faults N] [--json]``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from options import parse_options
from tracked_agreement import simulate_runs
from tracked_cases import signals
from tracked_reality import Faults, simulate
from tracked_runs import write_run

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.inference.marker_runs import RATE, MarkerRun, low_pass
from suspension_twin.models.registry import model_of
from suspension_twin.models.tracked import changed_vehicle
from suspension_twin.vehicle.tracked import TrackedVehicle
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin, save_twin

FILE = Path(__file__).resolve().parents[1] / "config" / "tracked" / "pt91.yaml"
SECONDS = {4: 14.0, 8: 7.0, 13: 4.6, 20: 3.2}  # of a run at so many km/h
SIGMA = np.repeat([1.5e-3, 0.01, 0.16], 3)
#: The sound specimen: within what ``tracked_blind`` draws.
SOUND = {
    "track.stiffness": 2e7,
    "track.bending_stiffness": 1.5e3,
    "track.damping": 1.5e4,
    "track.bending_damping": 800.0,
    "idler.setting": -5568.0,
}


def cases(sound: TrackedVehicle) -> dict[str, tuple[dict[str, dict[str, float]], TrackedVehicle, Faults]]:
    """Each fault as an effect of the model, and as the specimen and its faults."""
    change, one = sound.with_changes, (1.0,) * 6
    centre = sound.cog[0] - sound.stations[-1].x  # of gravity, ahead of the rearmost road wheels
    worn = {key: 0.45 * SOUND[key] for key in ("track.stiffness", "track.bending_stiffness")}
    return {
        "10 mm looser": ({"track_tension": {"tighter": -10.0}}, change({"idler.setting": -5558.0}), Faults()),
        "10 mm tighter": ({"track_tension": {"tighter": 10.0}}, change({"idler.setting": -5578.0}), Faults()),
        "worn to 0.45": ({"track_wear": {"stiffness": 0.45}}, change(worn), Faults()),
        "damper 6 at 0.1": (
            {"station_damper": {"station": 6, "change": -0.9}},
            sound,
            Faults(damper=(*one[:5], 0.1)),
        ),
        "damper 2 at 0.1": (
            {"station_damper": {"station": 2, "change": -0.9}},
            sound,
            Faults(damper=(1, 0.1, *one[:4])),
        ),
        "bar 2 sagged": (
            {"station_bar": {"station": 2, "sag": 0.1}},
            sound,
            Faults(sag=(0, 0.1, 0, 0, 0, 0)),
        ),
        "bar 5 sagged": (
            {"station_bar": {"station": 5, "sag": 0.1}},
            sound,
            Faults(sag=(0, 0, 0, 0, 0.1, 0)),
        ),
        "4 t": (
            {"payload": {"mass": 4000, "x": centre}},
            sound,
            Faults(payload=4000, payload_x=sound.cog[0]),
        ),
        "4 t 1 m ahead": (
            {"payload": {"mass": 4000, "x": centre + 1}},
            sound,
            Faults(payload=4000, payload_x=sound.cog[0] + 1),
        ),
    }


def filmed(vehicle: TrackedVehicle, kmh: int, faults: Faults) -> MarkerRun:
    """The specimen's run as a camera without noise would give it."""
    seconds = SECONDS[kmh]
    motion = simulate(vehicle, kmh / 3.6, seconds + 0.4, faults)
    t = np.arange(0.0, seconds, 1.0 / RATE)
    z = low_pass(np.stack([np.interp(t, motion["t"], c) for c in motion["markers"].T], axis=1), RATE)
    v = np.gradient(z, t, axis=0)
    return MarkerRun(t, z, v, np.gradient(v, t, axis=0), kmh / 3.6, f"{kmh:02d}kmh")


def calibrated(twin: Twin, runs: Sequence[MarkerRun]) -> Twin:
    """The twin fitted to runs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_twin(twin, folder / "twin.yaml")
        paths = []
        for run in runs:
            parts = [
                f * getattr(run, kind) for kind, f in (("markers", 1e3), ("velocity", 1), ("acceleration", 1))
            ]
            table = np.stack(parts, axis=2).reshape(run.t.size, 9)  # A's three, B's, C's
            paths.append(str(folder / f"{run.name}.csv"))
            write_run(Path(paths[-1]), np.column_stack([run.t, table]))
        return calibrate(CalibrationRequest(str(folder / "twin.yaml"), tuple(paths))).twin


def standing(vehicle: TrackedVehicle, faults: Faults) -> Floats:
    """(3,) m heights of the markers above the ground before the specimen drives off."""
    return simulate(vehicle, 8.0 / 3.6, 0.1, faults)["standing"]


def without_clock(change: Floats, sound: Floats, t: Floats) -> Floats:
    """A change in units of the noise, less the best lateness and stretch of the sound run."""
    slope = -np.gradient(sound, t, axis=0)
    shifts = np.stack([(slope / SIGMA).ravel(), (slope * t[:, None] / SIGMA).ravel()], axis=1)
    c = (change / SIGMA).ravel()
    return np.asarray(c - shifts @ np.linalg.lstsq(shifts, c, rcond=None)[0])


def correlation(real: Floats, ours: Floats) -> float:
    """Of two changes, whatever their sizes."""
    return float(real @ ours / np.sqrt((real @ real) * (ours @ ours)))


def misfits(model: TrackedVehicle, sound: Sequence[MarkerRun]) -> list[float]:
    """Of each run, the rms difference of model and specimen in units of the noise."""
    told = simulate_runs([model], sound)[0]
    assert told is not None
    return [
        float(np.sqrt(np.mean(without_clock(signals(t) - signals(s), signals(s), s.t) ** 2)))
        for t, s in zip(told, sound, strict=True)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description="What faults change, in the reality of 97 links and in the model."
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--kmh", type=int, nargs="+", choices=list(SECONDS), default=[8, 13])
    parser.add_argument("--faults", type=int, metavar="N", help="the first N; all by default")
    arguments = parse_options(parser, kmh=[20], faults=1)
    start = load_twin(FILE)
    start = model_of(start).prepared(start)  # with a driver
    specimen = start.vehicle.with_changes(SOUND)
    sound = [filmed(specimen, kmh, Faults()) for kmh in arguments.kmh]
    twin = calibrated(start, sound)
    model = twin.vehicle
    off = {
        "on a prescribed way": misfits(specimen.model_copy(update={"driver": None}), sound),
        "driven": misfits(specimen, sound),
        "calibrated": misfits(model, sound),
    }
    gyration = model.gyration / specimen.gyration
    told = simulate_runs([model], sound)[0]
    assert told is not None  # it was fitted to them
    rows: list[dict[str, Any]] = []
    for fault, (effect, vehicle, faults) in islice(cases(specimen).items(), arguments.faults):
        specs = tuple(EffectSpec(id=name, parameters=given) for name, given in effect.items())
        broken = simulate_runs([changed_vehicle(twin.model_copy(update={"effects": specs}))], sound)[0]
        assert broken is not None
        sinks = 1e3 * float(np.mean(standing(specimen, Faults()) - standing(vehicle, faults)))
        for kmh, before, plain, after in zip(arguments.kmh, sound, told, broken, strict=True):
            usual = signals(before)
            real = without_clock(signals(filmed(vehicle, kmh, faults)) - usual, usual, before.t)
            ours = without_clock(signals(after) - signals(plain), usual, before.t)
            rows.append(
                {
                    "fault": fault,
                    "kmh": kmh,
                    "real": float(np.sqrt(np.mean(real**2))),
                    "model": float(np.sqrt(np.mean(ours**2))),
                    "gain": float(real @ ours / (ours @ ours)),
                    "correlation": correlation(real, ours),
                    "sinks": sinks,
                    "displacement": correlation(*(c.reshape(-1, 9)[:, :3].ravel() for c in (real, ours))),
                }
            )
    if arguments.json:
        print(json.dumps({"sound": off, "gyration": gyration, "rows": rows}))
        return
    for name, values in off.items():
        told_off = ", ".join(f"{v:.1f} at {kmh} km/h" for kmh, v in zip(arguments.kmh, values, strict=True))
        print(f"sound, {name}: off by {told_off} times the noise")
    print(f"calibrated, its radius of gyration is {gyration:.3f} of the specimen's")
    heads = "".join(f"{h:>8}" for h in ("real", "model", "gain", "corr.", "disp.", "sinks"))
    print(f"{'':18}{'km/h':>5}{heads}   (rms in units of the noise; mm)")
    for r in rows:
        figures = (r[k] for k in ("real", "model", "gain", "correlation", "displacement", "sinks"))
        print(f"{r['fault']:18}{r['kmh']:5d}" + "".join(f"{v:8.2f}" for v in figures))


if __name__ == "__main__":
    main()
