# SPDX-License-Identifier: Apache-2.0
"""Known faults of sensor, clock and map, put into the drives of a multibody car that lack nothing.

    python benchmarks/seeded.py [--seeds development|reporting] [--gross | --vehicle] [--only NAME ...] [--workers N]
        [--keep] [--json] [--out DIR]

The drives of ``no_effect_added`` (``../shared/withheld``, or SUSPENSION_TWIN_WITHHELD) come from an established engine
with MacPherson struts, a multilink axle and a tyre that slips. No seven-degree model follows it, by about a fifth of
the motion's rms, and the engine's own truth lies beside them. What a fault of the sensor would have changed is made
from that truth, as ``blind.phone`` does for the realities of ``blind.py``, and added to what the phone recorded;
clocks are set wrong, the road file is scaled, smoothed or shifted. Each is diagnosed without and with a reference
drive, a road file without: it is as wrong before. With ``--gross`` the faults are those that a set-up has more often
than any: a clock half a second late, a sensor that stands sideways or backwards, a map metres off. A twin follows
nothing of such a drive. With ``--vehicle`` they are the vehicle's own and some that no twin can be given, which have to
be told as unknown: what another formulation of a car with the same springs, dampers and road feels of them
(``seeded_vehicle``) is added to what was recorded. ``--out DIR`` leaves cases, labels and evidence there in the layout
of ``blind.py``, so that ``train_decision.py --keep DIR`` can learn from development cases as a reality of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from blind.faults import ROAD, SENSOR, TIME, misread
from blind.newton import Faults
from blind.phone import Felt, felt
from blind.world import G, Phone
from extras import unavailable
from multibody_truth import Truth, read_truth
from options import parse_options
from rich.console import Console
from rich.table import Table
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation
from seeded_vehicle import NAMELESS, VEHICLE, changed, faults_of as vehicle_faults

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.road import Road, load_road, write_road
from suspension_twin.vehicle.twin import RoadFile, load_twin, save_twin

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DRIVES = ("drive_fast", "drive_slow", "drive_other")
EFFECTS = ("sensor_offset", *SENSOR, *TIME, *ROAD)
SEEDS = {"development": 100, "reporting": 200}
#: What is hardly above what clocks, maps and mounts have anyway, and what is plain; each case by up to a quarter
#: more or less.
FAINT, PLAIN = 0.35, 1.0
#: What a vehicle's effects change of the vertical acceleration, as shares of the motion's rms, of which such a twin
#: leaves a fifth anyway.
SHARES = {"faint": 0.3, "plain": 0.6}
#: Faults with ``--gross``, by what they are called.
GROSS = {
    "late": "time_offset",
    "drifting": "clock_drift",
    "sideways": "sensor_tilt",
    "backwards": "sensor_tilt",
    "ahead": "position_offset",
    "beside": "lateral_offset",
}
#: Highest vertical acceleration that each drive has, m/s².
_PEAK = {"drive_fast": 8.4, "drive_other": 6.3, "drive_slow": 4.7}


@dataclass(frozen=True)
class Seeded:
    """One case: what is wrong, about which share of ``PLAIN``, and which drives there are; of a vehicle's own fault
    the share of the motion that it changes, from which its parameters are drawn with ``seed``."""

    name: str
    faults: Faults
    amount: float
    drives: tuple[str, ...]
    reference: bool
    share: float = 0.0
    seed: int = 0


def faults_of(effect: str, amount: float, peak: float, rng: np.random.Generator) -> Faults:
    """An effect's parameters at a share of what is plain; ``peak`` m/s² that the drives have above gravity."""
    sign, a, b = float(rng.choice([-1.0, 1.0])), float(rng.uniform()), float(rng.uniform())
    angle = rng.normal(size=3)
    roll, pitch, yaw = np.radians(9.0) * amount * angle / np.linalg.norm(angle)
    values = {
        "sensor_offset": {
            "x": 1.2 * amount * sign,
            "y": 0.6 * amount * (2 * a - 1),
            "z": 0.2 * amount * (2 * b - 1),
        },
        "mount_resonance": {
            "gain": 1.0 * amount,
            "frequency": 8.0 + 12.0 * a,
            "damping_ratio": 0.03 + 0.07 * b,
        },
        "sensor_tilt": {"roll": roll, "pitch": pitch, "yaw": yaw},
        "sensor_bandwidth": {"cutoff": 6.0 / amount},
        "sensor_clipping": {"range": G + peak * (1.0 - 0.75 * amount)},
        "sensor_scale": {"scale": 0.25 * amount * sign},
        "time_offset": {"offset": 0.08 * amount * sign},
        "clock_drift": {"drift_ppm": 2500.0 * amount * sign},
        "road_scale": {"scale": 0.4 * amount if sign > 0 else -0.25 * amount},
        "road_smoothing": {"sigma": 0.3 * amount},
        "position_offset": {"offset": 0.5 * amount * sign},
        "lateral_offset": {"offset": 0.5 * amount * sign},
    }
    return {effect: {k: float(v) for k, v in values[effect].items()}}


def gross(kind: str, rng: np.random.Generator) -> Faults:
    """A fault of ``GROSS`` of any such size and sign."""
    sign, size, angle = (
        float(rng.choice([-1.0, 1.0])),
        float(rng.uniform()),
        rng.uniform(-0.05, 0.05, 3).tolist(),
    )
    yaw = np.pi / 2 * sign if kind == "sideways" else np.pi
    values = {
        "late": {"offset": sign * (0.3 + 0.7 * size)},
        "drifting": {"drift_ppm": sign * (4000.0 + 6000.0 * size)},
        "ahead": {"offset": sign * (1.0 + 4.0 * size)},
        "beside": {"offset": sign * (0.7 + 0.6 * size)},
    }
    turned = {"roll": angle[0], "pitch": angle[1], "yaw": float(yaw) + angle[2]}
    return {GROSS[kind]: values.get(kind, turned)}


def plan_gross(seeds: str) -> list[Seeded]:
    """Every gross fault, without and with a reference."""
    out = []
    for number, kind in enumerate(GROSS):
        for reference in (False,) if GROSS[kind] in ROAD else (False, True):
            rng = np.random.default_rng([SEEDS[seeds], 50 + number, reference])
            drives = tuple(sorted(rng.choice(DRIVES, 2, replace=False).tolist()))
            name = f"{kind}_gross_{'ref' if reference else 'alone'}"
            out.append(Seeded(name, gross(kind, rng), 4.0, drives, reference))
    return out


def plan_vehicle(seeds: str) -> list[Seeded]:
    """Every effect of the vehicle, and those that no twin can be given, without and with a reference."""
    out = []
    for number, effect in enumerate(VEHICLE):
        for kind, share in SHARES.items():
            for reference in (False, True):
                key = [SEEDS[seeds], 80 + number, int(10 * share), reference]
                rng = np.random.default_rng(key)
                drives = tuple(sorted(rng.choice(DRIVES, 2, replace=False).tolist()))
                name = f"{effect}_{kind}_{'ref' if reference else 'alone'}"
                out.append(
                    Seeded(
                        name,
                        {effect: {}},
                        share,
                        drives,
                        reference,
                        share * float(rng.uniform(0.8, 1.25)),
                        int(rng.integers(1 << 30)),
                    )
                )
    return out


def plan(seeds: str) -> list[Seeded]:
    """Every effect faint and plain, without and with a reference; and nothing, on every pair of drives.

    A road file that is wrong is so before and after: that is no case with a reference.
    """
    out = []
    for number, effect in enumerate(EFFECTS):
        for amount in (FAINT, PLAIN):
            for reference in (False,) if effect in ROAD else (False, True):
                rng = np.random.default_rng([SEEDS[seeds], number, int(10 * amount), reference])
                drives = tuple(sorted(rng.choice(DRIVES, 2, replace=False).tolist()))
                name = f"{effect}_{'plain' if amount == PLAIN else 'faint'}_{'ref' if reference else 'alone'}"
                peak = max(_PEAK[d] for d in drives)
                faults = faults_of(effect, amount * float(rng.uniform(0.8, 1.25)), peak, rng)
                out.append(Seeded(name, faults, amount, drives, reference))
    for left in DRIVES:
        pair = tuple(d for d in DRIVES if d != left)
        for reference in (False, True):
            out.append(
                Seeded(
                    f"none_{'_'.join(d[6:] for d in pair)}_{'ref' if reference else 'alone'}",
                    {},
                    0.0,
                    pair,
                    reference,
                )
            )
    return out


def recorded(
    drive: Drive,
    truth: Truth,
    twin_rpy: tuple[float, float, float],
    faults: Faults,
    vehicle: Floats | float = 0.0,
) -> Drive:
    """The drive as a phone with these faults would have recorded it; ``vehicle`` (n, 6) is what the vehicle's own
    faults change of specific force and angular rate at the truth's times."""
    imu = drive.imu
    columns = truth.columns
    force = np.stack([columns[k] for k in ("fx", "fy", "fz")], axis=1)
    rate = np.stack([columns[k] for k in ("wx", "wy", "wz")], axis=1)
    moved = force
    if "sensor_offset" in faults:
        arm = np.array([faults["sensor_offset"][k] for k in "xyz"])
        turned = savgol_filter(rate, 7, 3, deriv=1, delta=1.0 / truth.rate, axis=0)
        moved = force + np.cross(turned, arm) + np.cross(rate, np.cross(rate, arm))
    phone = Phone(
        place=(0.0, 0.0, 0.0),
        rpy=twin_rpy,
        misplaced=(0.0,) * 3,
        askew=(0.0,) * 3,
        holder=60.0,
        force_bias=(0.0,) * 3,
        rate_bias=(0.0,) * 3,
        force_noise=0.0,
        rate_noise=0.0,
        jitter=0.0,
        lag=0.0,
        lost=0.0,
    )
    linear = {k: v for k, v in faults.items() if k in SENSOR and k != "sensor_clipping"}
    clean = felt(Felt(truth.t, force, rate), phone, {}, ideal=True)
    faulty = felt(Felt(truth.t, moved, rate), phone, linear, ideal=True)
    change = np.hstack([faulty.force - clean.force, faulty.rate - clean.rate]) + vehicle
    mount = Rotation.from_euler("xyz", twin_rpy)
    change = np.hstack([mount.apply(change[:, :3], inverse=True), mount.apply(change[:, 3:], inverse=True)])
    since = imu.t - truth.start
    added = CubicSpline(truth.t, change)(np.clip(since - _late(drive, truth), truth.t[0], truth.t[-1]))
    read = np.hstack([imu.specific_force, imu.angular_rate]) + added
    if "sensor_clipping" in faults:
        reach = faults["sensor_clipping"]["range"]
        read[:, :3] = np.clip(read[:, :3], -reach, reach)
    drift = 1e-6 * faults.get("clock_drift", {}).get("drift_ppm", 0.0)
    stamps = truth.start + since * (1.0 + drift) + faults.get("time_offset", {}).get("offset", 0.0)
    return replace(drive, imu=replace(imu, t=stamps, specific_force=read[:, :3], angular_rate=read[:, 3:]))


def _late(drive: Drive, truth: Truth) -> float:
    """Seconds by which the phone's own filters have what it reads after the truth."""
    force = CubicSpline(truth.t, truth.columns["fz"])
    since = np.clip(drive.imu.t - truth.start, truth.t[0] + 0.02, truth.t[-1])
    late = np.arange(0.0, 0.02, 0.0005)
    return float(late[np.argmin([np.std(force(since - s) - drive.imu.specific_force[:, 2]) for s in late])])


def surveyed(road: Road, faults: Faults) -> Road:
    """The road file with what is wrong with it: the truth is ``scale`` higher, rougher or elsewhere."""
    u = np.arange(road.z.shape[0]) * road.u_step
    return replace(road, z=misread(road.z, u, road.v, faults))


def make(case: Seeded, data: Path, folder: Path) -> None:
    """Write a case in the form of any other: twin, road, drives, and a reference that nothing was done to."""
    source = data / "no_effect_added"
    folder.mkdir(parents=True)
    twin = load_twin(source / "twin.yaml")
    for name in case.drives:
        own = changed(source, name, case.faults)
        drive = recorded(read_drive(source / name), read_truth(source, name), twin.imu.rpy, case.faults, own)
        write_drive(drive, folder / name)
    if case.reference:
        write_drive(read_drive(source / "reference"), folder / "reference")
    road = folder / "road.crg"
    write_road(surveyed(load_road(source / "road.crg"), case.faults), road, comment="Surveyed road")
    save_twin(twin.model_copy(update={"road": RoadFile(file=road)}), folder / "twin.yaml")


def label(case: Seeded) -> dict[str, Any]:
    """What ``train_decision`` has to know of a case; its severity in floors of this car is about what was drawn."""
    kind = "outside" if _nameless(case.faults) else "single" if case.faults else "null"
    faint, plain = case.name.rpartition("_")[0].endswith("faint"), bool(case.faults)
    severity = 1.5 if faint else 3.0 if plain else 0.0
    return {
        "name": f"engine_{case.name}",
        "kind": kind,
        "effects": list(case.faults),
        "faults": case.faults,
        "reached": {e: {"severity": severity} for e in case.faults},
        "reality": "engine",
        "reference": case.reference,
        "severity": severity,
    }


def answer(
    case: Seeded, data: Path, out: Path | None = None, effects: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Make one case, diagnose it and return what was said of it; the case stays in ``out`` if that is given."""
    if case.share:
        effect = next(iter(case.faults))
        faults = vehicle_faults(effect, case.share, data / "no_effect_added", case.drives[0], case.seed)
        case = replace(case, faults=faults)
    wanted = {e for e in case.faults if e not in NAMELESS}
    nothing = "unknown" if _nameless(case.faults) else "no_gap"
    with tempfile.TemporaryDirectory() as temporary:
        folder = (out or Path(temporary)) / "cases" / f"engine_{case.name}"
        shutil.rmtree(folder, ignore_errors=True)
        make(case, data, folder)
        drives = tuple(str(folder / n) for n in case.drives)
        reference = (str(folder / "reference"),) if case.reference else ()
        try:
            found = diagnose(DiagnosisRequest(str(folder / "twin.yaml"), drives, reference, effects=effects))
        except SuspensionTwinError as error:
            return {"case": case.name, "faults": case.faults, "right": False, "error": str(error)}
        if out is not None:
            for name, content in (("answers", found.evidence), ("sealed", label(case))):
                kept = out / name / folder.name / ("evidence.json" if name == "answers" else "label.json")
                kept.parent.mkdir(parents=True, exist_ok=True)
                kept.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    d = found.document
    named = d["combination"] if d["verdict"] in ("effect", "partly") else []
    first = [c for c in d["causes"] if c["effect"] in named][:1]
    said = "no_gap" if d["verdict"] == "recalibration" else d["verdict"]
    return {
        "case": case.name,
        "faults": case.faults,
        "drives": case.drives,
        "verdict": d["verdict"],
        "named": named,
        "probability": d["probability"],
        "right": set(named) == wanted and (bool(named) or said == nothing),
        "parameters": {c["effect"]: c["parameters"] for c in first},
        "first": [[c["effect"], round(c["probability"], 3)] for c in d["causes"][:3]],
        "no_gap": d["no_gap_probability"],
        "unknown": d["unknown_probability"],
    }


def main() -> None:
    """Diagnose the cases, keep the answers, and print a table or with ``--json`` the same."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("SUSPENSION_TWIN_WITHHELD", str(ROOT.parent / "shared" / "withheld"))
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--seeds", choices=sorted(SEEDS), default="development")
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--gross", action="store_true", help="gross faults instead of faint and plain ones")
    kinds.add_argument(
        "--vehicle", action="store_true", help="the vehicle's own effects, and some without a name"
    )
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--keep", action="store_true", help=f"write the answers to {RESULTS.relative_to(ROOT)}"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--out", type=Path, help="where cases, labels and evidence stay")
    options = parse_options(parser, workers=1)
    if not (options.data / "no_effect_added" / "twin.yaml").is_file():
        unavailable(f"{options.data}: no drives of no_effect_added; name the folder with --data")
    planned = {"_gross": plan_gross, "_vehicle": plan_vehicle, "": plan}
    which = "_gross" if options.gross else "_vehicle" if options.vehicle else ""
    every = planned[which](options.seeds)
    cases = [c for c in every if not options.only or c.name in options.only]
    effects: tuple[str, ...] = ()  # all
    if options.smoke:
        cases, effects = cases[:1], ("time_offset",)
    if not cases:
        raise SystemExit(f"--only: none of {' '.join(options.only)} is a case of these seeds")
    rows = []
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        ask = partial(answer, data=options.data, out=options.out, effects=effects)
        for row in pool.map(ask, cases):
            rows.append(row)
            if not options.json:
                print(f"{row['case']:34s} {_said(row)}", flush=True)
    if options.keep:
        commit = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True
        ).stdout.strip()
        document = {"seeds": options.seeds, "commit": commit[:12], "cases": rows}
        kept = RESULTS / f"seeded{which}.json"
        kept.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    if options.json:
        print(json.dumps({"seeds": options.seeds, "cases": rows}))
        return
    table = Table(title=f"Seeded faults ({options.seeds}): right of all")
    for column in ("", "alone", "with a reference"):
        table.add_column(column)
    for nameless in (False, True):
        for kind in ("gross", "faint", "plain", "none"):
            of = [r for r in rows if kind in r["case"].split("_") and nameless == _nameless(r["faults"])]
            counts = [[r["right"] for r in of if r["case"].endswith(end)] for end in ("alone", "ref")]
            if of:
                name = f"{kind}, without a name" if nameless else kind
                table.add_row(name, *(f"{sum(c)} of {len(c)}" for c in counts))
    Console().print(table)


def _nameless(faults: Faults) -> bool:
    return bool(set(faults) & set(NAMELESS))


def _said(row: dict[str, Any]) -> str:
    mark = "right" if row["right"] else "WRONG"
    if "error" in row:
        return f"{mark} {row['error']}"
    told = " + ".join(row["named"]) or row["verdict"]
    return f"{mark} {told} {row['probability']:.2f} {row['parameters']}"


if __name__ == "__main__":
    main()
