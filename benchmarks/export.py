# SPDX-License-Identifier: Apache-2.0
"""FMUs of a twin: valid by FMPy, how far from the twin over the bundled drives, and how fast.

The drives are walked by FMPy in both versions of FMI, with the road at the end of every step of the integration. Speed
is that of an importer in C, which sets ten inputs and gets all outputs in every communication step, in processor time
of one core; the best of several tries, since others may use the machine.

Usage: ``python benchmarks/export.py [--json] [--seconds S] [--repeats N]``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from extras import unavailable
from fmu_importers import columns, walk_2, walk_3  # first: says what is missing
from options import parse_options
from rich.table import Table

from suspension_twin.addons.export.registry import ExportSettings, export_twin
from suspension_twin.cli.common import output
from suspension_twin.drive.read import read_drive
from suspension_twin.inference.observation import observe
from suspension_twin.models.connectors import OUTPUTS
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.twin import Twin, load_twin

import fmpy  # isort: skip
from fmpy.validation import validate_fmu  # isort: skip

HERE = Path(__file__).resolve().parent
DRIVES = ("bump_15kmh", "crg_road")
STEPS = (0.001, 0.01)
#: Effects of struts, tyres and body, at sizes that are common.
EFFECTS = {
    "strut_friction": {"front_force": 80.0, "rear_force": 80.0},
    "bump_stop": {"stiffness": 8e4},
    "anti_roll_bar": {"front_stiffness": 2e4},
    "top_mount": {"front_stiffness": 3e5, "rear_stiffness": 3e5},
    "tyre_damping": {"damping": 100.0},
    "powertrain_mount": {"mass": 180.0},
}


def variants(twin: Twin) -> dict[str, Twin]:
    """Twins by what they are."""
    specs = [{"id": name, "parameters": parameters} for name, parameters in EFFECTS.items()]
    return {
        "full_car": twin,
        f"full_car, {len(specs)} effects": twin.with_changes({"effects": specs}),
        "msd": twin.with_changes({"model": "msd"}),
    }


def compared(folder: Path) -> list[dict[str, Any]]:
    """A row for each drive, twin and version."""
    rows = []
    for drive in DRIVES:
        path = HERE.parent / "bags" / drive
        twin = load_twin(path / "twin.yaml")
        driven = observe(read_drive(path), twin).road_excitation
        for name, one in variants(twin).items():
            wanted = columns(simulate_twin(one, driven))
            for version, walk in (("2.0", walk_2), ("3.0", walk_3)):
                file = folder / "twin.fmu"
                export_twin(one, "fmu", file, ExportSettings(fmi=version))
                difference = np.abs(walk(file, driven) - wanted).max(axis=0)
                share = difference / np.maximum(np.ptp(wanted, axis=0), 1e-9)
                rows.append(
                    {
                        "drive": drive,
                        "twin": name,
                        "fmi": version,
                        "problems": len(validate_fmu(str(file))),
                        "share_of_motion": float(share.max()),
                        "worst": OUTPUTS[int(share.argmax())].name,
                        "bytes": file.stat().st_size,
                    }
                )
    return rows


def timed(folder: Path, seconds: float, repeats: int) -> list[dict[str, Any]]:
    """A row for each twin and communication step."""
    program = folder / "fmu_speed"
    subprocess.run(["cc", "-O2", "-o", program, HERE / "fmu_speed.c", "-ldl", "-lm"], check=True)
    rows = []
    for name, twin in variants(load_twin(HERE.parent / "bags" / DRIVES[1] / "twin.yaml")).items():
        export_twin(twin, "fmu", folder / "twin.fmu")
        guid = fmpy.read_model_description(folder / "twin.fmu").guid
        unpacked = fmpy.extract(folder / "twin.fmu", folder / "unpacked")
        (library,) = Path(unpacked, "binaries").rglob("twin.so")
        for step in STEPS:
            command = [program, library, guid, str(step), str(seconds)]
            took = [
                float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[0])
                for _ in range(repeats)
            ]
            rows.append({"twin": name, "step": step, "times_real_time": seconds / min(took)})
    return rows


def main() -> int:
    """Print tables, or one JSON object."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seconds", type=float, default=200.0, help="simulated seconds of each timed run")
    parser.add_argument("--repeats", type=int, default=5)
    options = parse_options(parser, repeats=1)
    if shutil.which("cc") is None:
        unavailable("needs a C compiler, cc")
    with tempfile.TemporaryDirectory() as folder:
        found = compared(Path(folder))
        speed = timed(Path(folder), options.seconds, options.repeats)
    if options.json:
        print(json.dumps({"compared": found, "speed": speed}))
        return 0
    console = output()
    table = Table("drive", "twin", "FMI", "problems", "difference / motion", "output", "kB", box=None)
    for row in found:
        cells = row["drive"], row["twin"], row["fmi"], str(row["problems"]), f"{row['share_of_motion']:.1e}"
        table.add_row(*cells, row["worst"], f"{row['bytes'] / 1e3:.0f}")
    console.print("FMUs and the twin, over the bundled drives", style="bold")
    console.print(table)
    table = Table("twin", "communication step, ms", "times real time, one core", box=None)
    for row in speed:
        table.add_row(row["twin"], f"{1e3 * row['step']:g}", f"{row['times_real_time']:.0f}")
    console.print()
    console.print("Speed", style="bold")
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
