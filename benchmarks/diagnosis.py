# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis costs: two drives, 135 s in all, with the whole library.

    python benchmarks/diagnosis.py [--seconds S] [--json]

A car of the development seeds is driven over its road twice at a slow pace (``blind/newton.py``, which shares nothing
with the package's models), with a clock that is late. The command line diagnoses it in processes of their own: both
drives with the gap, then one of them as what was there before. Beside each stands the same diagnosis of one effect
alone, in the same run: the ratio says what the rest of the library costs. Seconds count where nothing else is at work
on two cores.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import numpy as np  # noqa: E402
from blind import newton, phone  # noqa: E402
from blind.folder import road_file, twin_file  # noqa: E402
from blind.plan import Spec  # noqa: E402
from blind.world import Plan, World, drive_plan, make_world  # noqa: E402
from options import parse_options  # noqa: E402

from suspension_twin.drive.write import write_drive  # noqa: E402
from suspension_twin.road import write_road  # noqa: E402
from suspension_twin.vehicle.twin import parse_twin, save_twin  # noqa: E402

SEED, SECONDS = 1003, 67.5
LATE = {"time_offset": {"offset": 0.02}}
#: What is wanted: s on two cores, MB.
BARS = {"seconds": 90.0, "memory_mb": 2000.0}


def paced(number: int, seconds: float) -> Plan:
    """A drive over the whole road that takes about ``seconds`` s."""

    def at(pace: float) -> Plan:
        return drive_plan(np.random.default_rng([SEED, number]), 0.8 * pace, 1.2 * pace, number, SEED, 0.0)

    low, high = 1.0, 10.0
    for _ in range(20):
        pace = 0.5 * (low + high)
        low, high = (pace, high) if at(pace).seconds > seconds else (low, pace)
    return at(low)


def make(world: World, folder: Path, seconds: float) -> float:
    """Write twin file, road and drives (``seconds`` s each) of a case; returns the seconds of the drives together."""
    spec = Spec("slow", "single", ("time_offset",), 5.0, SEED, "newton", reference=True)
    total = 0.0
    for number, (name, faults) in enumerate({"fault": LATE, "more": LATE, "before": {}}.items()):
        plan = paced(number % 2, seconds)
        motion = newton.run(world, plan, {})
        write_drive(phone.record(world, plan, motion, faults, name), folder / name)
        total += plan.seconds if name != "before" else 0.0
    write_road(road_file(world, world.survey), folder / "road.crg", comment="Surveyed road")
    save_twin(parse_twin(twin_file(world, spec)), folder / "twin.yaml")
    return total


def timed(folder: Path, drives: list[str]) -> dict[str, Any]:
    """One diagnosis by the command line: its seconds, those of the processor and its largest memory."""
    line = [sys.executable, "-m", "suspension_twin", "diagnose", "--twin", str(folder / "twin.yaml")]
    line += [*drives, "--out", str(folder / "out"), "--force"]
    began = time.monotonic()
    quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    _, status, used = os.wait4(os.posix_spawn(line[0], line, os.environ, file_actions=quiet), 0)
    seconds = time.monotonic() - began
    if status:
        raise SystemExit(f"the diagnosis ended with {os.waitstatus_to_exitcode(status)}")
    answer = json.loads((folder / "out" / "diagnosis.json").read_text(encoding="utf-8"))
    return {
        "seconds": round(seconds, 1),
        "processor_seconds": round(used.ru_utime + used.ru_stime, 1),
        "memory_mb": round(used.ru_maxrss / 1024),
        "message": answer["message"],
    }


def main() -> None:
    """Time the diagnoses and print a table, or with ``--json`` the same figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each drive")
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser, seconds=15.0)
    with tempfile.TemporaryDirectory(prefix="diagnosis_") as name:
        folder = Path(name)
        world = make_world(SEED)
        driven = make(world, folder, options.seconds)
        ways = {
            "two drives with the gap": [str(folder / "fault"), str(folder / "more")],
            "one, and one from before": [str(folder / "fault"), "--reference", str(folder / "before")],
        }
        few = ["--effect", "time_offset", "--effect", "clock_drift"] if options.smoke else []
        timed(
            folder, [*ways["two drives with the gap"], "--effect", "time_offset"]
        )  # whatever has to be compiled
        found = {
            way: {
                "library": timed(folder, [*drives, *few]),
                "alone": timed(folder, [*drives, "--effect", "time_offset"]),
            }
            for way, drives in ways.items()
        }
    if options.json:
        about = {"driven_s": round(driven, 1), "cores": os.cpu_count(), "bars": BARS}
        print(json.dumps({**about, "cases": found}, indent=1))
        return
    print(f"{driven:.0f} s of driving on {os.cpu_count()} cores; wanted {BARS}")
    for way, rows in found.items():
        for what, row in rows.items():
            print(
                f"{way:25s} {what:8s} {row['seconds']:6.1f} s, processor {row['processor_seconds']:6.1f} s, "
                f"{row['memory_mb']:5d} MB  {row['message']}"
            )
        print(f"{'':25s} ratio    {rows['library']['seconds'] / rows['alone']['seconds']:6.1f}")


if __name__ == "__main__":
    main()
