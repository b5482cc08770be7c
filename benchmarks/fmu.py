# SPDX-License-Identifier: Apache-2.0
"""``model: fmu``: an FMU of other code beside the same car here, its speed, and how well its parameters are found.

The other code is ``other_car.c``: seven degrees of freedom, linear, Runge-Kutta steps, FMI 2.0. A ``full_car``
with the same numbers drives over the bundled speed bump with a simulated phone and receiver; the FMU's springs and
dampers are then searched from wrong values.

Usage: ``python benchmarks/fmu.py [--json] [--generations N] [--searches NAME ...]``.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from options import parse_options
from other_car import STIFFNESS, fmu_section, linear_car, other_car, vehicle_of  # first: says what is missing
from rich.table import Table

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.cli.common import output
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.observation import observe
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.models.live import live_twin
from suspension_twin.models.parameters import pack
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.models.types import PoseSample
from suspension_twin.road import load_road
from suspension_twin.vehicle.twin import Twin, parse_twin, save_twin

HERE = Path(__file__).resolve().parent
BUMP = HERE.parent / "bags" / "bump_15kmh"
#: m/s over s: standing, driving off, over the bump.
KNOTS = ((0.0, 0.0), (2.0, 0.0), (5.0, 4.2), (12.0, 4.2))
START = {
    "k_front": (20e3, 8e3, 50e3),
    "k_rear": (30e3, 8e3, 50e3),
    "c_front": (1500.0, 500.0, 6000.0),
    "c_rear": (3500.0, 500.0, 6000.0),
}
SEARCHES: dict[str, dict[str, Any]] = {
    "paper, GA": {"preset": "paper"},
    "tracked_paper, GA": {"preset": "tracked_paper"},
    "correlation, CMA-ES": {
        "objective": "correlation",
        "channels": (("vertical_acceleration", 1.0), ("pitch_rate", 1.0)),
    },
    "fast, Gauss-Newton": {"preset": "fast"},
}
QUANTITIES = ("heave", "roll", "pitch", "deflection", "tyre_force", "force", "rate", "vertical_acceleration")


def fmu_twin(car: Twin, file: Path, parameters: dict[str, Any]) -> Twin:
    """The FMU as a twin at the place of the car."""
    data = car.model_dump(mode="json", include={"imu", "gps", "datum", "road"}, exclude_none=True)
    section = fmu_section(file, **parameters)
    return parse_twin({"model": "fmu", "fmu": section, "vehicle": vehicle_of(car), **data})


def measured(folder: Path, generations: int, searches: Sequence[str]) -> dict[str, Any]:
    """All figures."""
    file, car = folder / "other_car.fmu", linear_car(BUMP / "twin.yaml")
    other_car(file)
    road = load_road(BUMP / "road.crg")
    drive = synthetic_drive(car, road, KNOTS, seed=3)
    write_drive(drive, folder / "drive")
    twin = fmu_twin(car, file, STIFFNESS)
    prepared = observe(drive, car, road)
    run = prepared.road_excitation
    wanted, found = simulate_twin(car, run), simulate_twin(twin, run)
    pairs = ((getattr(found, name), getattr(wanted, name)) for name in QUANTITIES)
    range_ = [float(np.abs(a - b).max() / max(np.ptp(b), 1e-2)) for a, b in pairs]
    out: dict[str, Any] = {
        "difference": dict(zip(QUANTITIES, range_, strict=True)),
        "seconds": float(np.ptp(run.t)),
    }
    many = np.repeat(pack(twin)[:, None], 8, axis=1)
    for threads in (1, 2):
        began = time.perf_counter()
        simulate_lanes(twin, many, run, threads=threads)
        out[f"times_real_time_{threads}_threads"] = 8 * out["seconds"] / (time.perf_counter() - began)
    path, model = prepared.trajectory, live_twin(twin, road)
    columns = [path.t, path.x, path.y, path.yaw, path.velocity, path.yaw_rate, path.acceleration]
    rows = np.column_stack(columns).tolist()
    began = time.perf_counter()
    for t, *row in rows:
        model.step(t, PoseSample(*row))
    out["microseconds_a_live_step"] = 1e6 * (time.perf_counter() - began) / len(rows)
    save_twin(fmu_twin(car, file, START), folder / "twin.yaml")
    out["searches"] = [searched(name, folder, generations, SEARCHES[name]) for name in searches]
    return out


def searched(name: str, folder: Path, generations: int, chosen: dict[str, Any]) -> dict[str, Any]:
    """One calibration."""
    began = time.perf_counter()
    result = calibrate(
        CalibrationRequest(
            twin=str(folder / "twin.yaml"),
            bags=(str(folder / "drive"),),
            max_generations=generations,
            **chosen,
        )
    )
    values = {e.key.split(".")[2]: e.value for e in result.estimates}
    gaps = result.drives[0].gap_before.rms, result.drives[0].gap_after.rms
    return {
        "search": name,
        "seconds": time.perf_counter() - began,
        "error": {key: values[key] / STIFFNESS[key] - 1.0 for key in STIFFNESS},
        "gap_before": gaps[0],
        "gap_after": gaps[1],
    }


def main() -> int:
    """Print tables, or one JSON object."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--generations", type=int, default=15, help="of each population search at most")
    named = {name.partition(",")[0]: name for name in SEARCHES}
    parser.add_argument("--searches", nargs="+", choices=list(named), default=list(named))
    options = parse_options(parser, generations=1, searches=["fast"])
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder), options.generations, [named[n] for n in options.searches])
    if options.json:
        print(json.dumps(found))
        return 0
    console = output()
    worst = max(found["difference"], key=found["difference"].get)
    console.print(
        f"Other code beside full_car over {found['seconds']:.0f} s: at most {found['difference'][worst]:.1e} of the "
        f"range of a quantity ({worst})"
    )
    console.print(
        f"Candidates: {found['times_real_time_1_threads']:.0f} times real time on one thread, "
        f"{found['times_real_time_2_threads']:.0f} on two; live {found['microseconds_a_live_step']:.0f} µs a step"
    )
    console.print()
    table = Table(
        "preset or objective",
        *(f"{key} %" for key in STIFFNESS),
        "gap",
        "after",
        "s",
        box=None,
        pad_edge=False,
    )
    for row in found["searches"]:
        errors = [f"{100 * row['error'][key]:+.1f}" for key in STIFFNESS]
        gaps = f"{row['gap_before']:.3f}", f"{row['gap_after']:.3f}"
        table.add_row(row["search"], *errors, *gaps, f"{row['seconds']:.0f}")
    console.print("Error of the parameters found; gap in m/s²", style="bold")
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
