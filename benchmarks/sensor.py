# SPDX-License-Identifier: Apache-2.0
"""What a calibrated twin leaves of a held-out drive, beside the same twin with sensor and map refitted to that drive.

    python benchmarks/blind.py --stage generate --full --only null --limit N --out DIR   # null drives
    python benchmarks/sensor.py --nulls DIR [--limit N] [--one] [--late S] [--json]      # without: the bundled bags

A twin is calibrated on the drives of a case (``--one``: on the first alone) and simulated over a drive that the
calibration has not used. ``--late`` adds so many seconds to the stamps of every IMU sample first. ``refitted`` is the
same calibrated vehicle with clock offset, map (along the road) and mount (roll and pitch) fitted to the held-out drive
itself. ``kept`` is the calibrated vehicle with the sensor as the starting file has it (``--keep-sensor``). All are rms
of the vertical acceleration.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from options import parse_options

from suspension_twin.calibration.output import write_result
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.observation import road_of
from suspension_twin.inference.sensor_correction import SensorCorrection, turned
from suspension_twin.inference.simulated import SimulatedDrive, simulate_drive
from suspension_twin.road import Road
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin

ROOT = Path(__file__).resolve().parents[1]
#: Finite-difference steps: clock offset s, map along the road m, roll and pitch rad.
STEPS = np.array([1e-3, 1e-2, 3e-3, 3e-3])
ITERATIONS = 6
#: Of a Gauss-Newton step, the best of which is taken.
SHARES = (1.0, 0.5, 0.2)
#: What the calibrated twin may leave, in units of what the refitted one does.
ALLOWED = 1.2


@dataclass(frozen=True)
class Case:
    """A twin file, the drives to calibrate it on, and one that is held out, on the road of ``place``."""

    name: str
    twin: Path
    drives: tuple[Path, ...]
    held_out: Path
    place: Path


def cases(nulls: Path | None, limit: int, one: bool) -> list[Case]:
    """The bundled bags, each the other's held-out drive, and the null cases of a folder."""
    bags = {name: ROOT / "bags" / name for name in ("bump_15kmh", "crg_road")}
    found = [
        Case(name, bag / "twin.yaml", (bag,), bags[other], bags[other] / "twin.yaml")
        for (name, bag), other in zip(bags.items(), reversed(bags), strict=True)
    ]
    sealed = sorted((nulls / "sealed").glob("*/label.json"), key=str) if nulls else []
    for label in [s for s in sealed if json.loads(s.read_text())["kind"] == "null"][: limit or None]:
        folder = label.parents[2] / "cases" / label.parent.name
        drives = sorted(folder.glob("drive_*"), reverse=True)
        name = f"{json.loads(label.read_text())['reality']} {folder.name}"
        twin = folder / "twin.yaml"
        found.append(Case(name, twin, tuple(drives[: 1 if one else None]), label.parent / "sealed", twin))
    return found


def refitted(drive: Drive, twin: Twin, road: Road) -> tuple[SimulatedDrive, np.ndarray]:
    """The best of all clock offsets, places of the map and mountings, and what these are (4,) in SI units."""

    def seen(x: np.ndarray) -> SimulatedDrive:
        late, along, roll, pitch = x * STEPS
        imu = turned(twin.imu, (roll, pitch, 0.0)).model_copy(update={"latency": twin.imu.latency + late})
        shift = EffectSpec(id="position_offset", parameters={"offset": along})
        changed = twin.model_copy(update={"imu": imu, "effects": (*twin.effects, shift)})
        return simulate_drive(drive, changed, road)

    def left(at: SimulatedDrive, mask: np.ndarray) -> np.ndarray:
        simulated = at.observation.condition(at.response)
        channel = "vertical_acceleration"
        return np.asarray((at.observation.measured[channel] - simulated[channel])[mask])

    x = np.zeros(STEPS.size)
    best = simulate_drive(drive, twin, road)
    mask = best.observation.mask
    for _ in range(ITERATIONS):
        base = left(best, mask)
        jacobian = np.stack([left(seen(x + unit), mask) - base for unit in np.eye(x.size)], axis=1)
        step = -np.linalg.lstsq(jacobian, base, rcond=1e-6)[0]
        tried = [(x + share * step, seen(x + share * step)) for share in SHARES]
        trial, found = min(tried, key=lambda at: at[1].gap.rms)
        if found.gap.rms > 0.999 * best.gap.rms:
            break
        x, best = trial, found
    return best, x * STEPS


def judged(case: Case, late: float) -> dict[str, Any]:
    """One row of the table."""
    place, drive = load_twin(case.place), SensorCorrection(clock=-late).timed(read_drive(case.held_out))
    road = road_of(place)
    with tempfile.TemporaryDirectory() as folder:
        drives = [str(bag) for bag in case.drives]
        if late:
            drives = [str(Path(folder) / bag.name) for bag in case.drives]
            for bag, copy in zip(case.drives, drives, strict=True):
                write_drive(SensorCorrection(clock=-late).timed(read_drive(bag)), Path(copy))
        request = CalibrationRequest(twin=str(case.twin), bags=tuple(drives))
        path, _ = write_result(calibrate(request), Path(folder) / "calibrated.yaml")
        twin = load_twin(path).model_copy(update={"datum": place.datum, "road": place.road})
    kept = twin.model_copy(update={"imu": place.imu})
    best, found = refitted(drive, twin, road)
    left = simulate_drive(drive, twin, road).gap
    rows = {
        "start": simulate_drive(drive, place, road).gap.rms,
        "kept": simulate_drive(drive, kept, road).gap.rms,
        "calibrated": left.rms,
        "refitted": best.gap.rms,
        "floor": left.noise_rms,
        "ratio": left.rms / best.gap.rms,
    }
    settings = {"latency": twin.imu.latency, "rpy": list(twin.imu.rpy), "refit": found.tolist()}
    return {
        "case": case.name,
        "drives": len(case.drives),
        **{k: round(v, 4) for k, v in rows.items()},
        **settings,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nulls", type=Path, help="folder of benchmarks/blind.py with null cases")
    parser.add_argument("--limit", type=int, default=0, help="null cases to take; 0: all")
    parser.add_argument("--one", action="store_true", help="calibrate on one drive of a null case alone")
    parser.add_argument("--late", type=float, default=0.0, help="s that every IMU sample comes late")
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser)
    columns = ("start", "kept", "calibrated", "refitted", "floor", "ratio")
    out = sys.stderr if options.json else sys.stdout
    print(f"{'case':28s}" + "".join(f"{c:>11s}" for c in columns) + "  latency ms", file=out)
    rows = []
    for case in cases(options.nulls, options.limit, options.one):
        row = judged(case, options.late)
        rows.append(row)
        line = f"{row['case']:28s}" + "".join(f"{row[c]:11.4f}" for c in columns)
        print(line + f"{1e3 * row['latency']:12.2f}", file=out, flush=True)
    worst = max(row["ratio"] for row in rows)
    print(f"worst ratio {worst:.2f}, allowed {ALLOWED}", file=out)
    if options.json:
        print(json.dumps({"allowed": ALLOWED, "worst": worst, "cases": rows}))


if __name__ == "__main__":
    main()
