# SPDX-License-Identifier: Apache-2.0
"""Every benchmark runs to its end at the reduced size of ``--smoke`` and prints its table."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

#: What each program prints at its end.
TABLES = {
    "blind": r"picture: ",
    "calibration": r"pymoo GA",
    "demo": r"over the fixed work",
    "diagnosis": r"two drives with the gap +library .* s, processor",
    "discrepancy": r"linear filters of the road",
    "engine": r"off it where they are carried on",
    "export": r"communication step, ms +times real time",
    "felt": r"false locks",
    "fleet": r"sound vehicles named",
    "fleet_scaling": r"One core is full in the scheduler at",
    "fmu": r"Error of the parameters found",
    "fuzz": r"300 requests in .* s: passed",
    "iio_qemu": r"Largest relative difference",
    "intervals": r"a single hump . damper push",
    "live": r"p99 of the twin / of the relay",
    "live_fleet": r"twins at 100 Hz in 1 process",
    "live_pose": r"Largest error of the live pose",
    "mcap_core": r"The same as this project reads",
    "measured": r"Two passes over one bump",
    "multibody": r"what seven degrees cannot follow",
    "mutation": r"part +killed +survived",
    "paper": r"Pictures in",
    "peak": r"GFLOP/s on one core",
    "phone": r"gap on an unseen drive",
    "plan_confusion": r"median place",
    "rig": r"Gap of the twin as it is written",
    "road_changes": r"named on the scanned road",
    "road_from_drives": r"third drive: .* m/s² left on it",
    "road_real_drives": r"stretches driven twice",
    "road_scan": r"In the wheel paths",
    "roads": r"Other work, s",
    "scan_registration": r"turn, deg",
    "seeded": r"Seeded faults",
    "sensor": r"worst ratio",
    "torture": r"torture +trials +failed",
    "tracked": r"variance of the pitch",
    "tracked_blind": r"of 1 right",
    "tracked_changes": r"its radius of gyration",
    "tracked_paper": r"repeats among themselves",
    "tracked_runs": r"13 km/h, 1: \d+ rows",
    "train_decision": r"conformal threshold",
    "unity": r"Through the endpoint",
    "withheld": r"^no_effect_added +",
}
#: The same of programs with an option that makes another table.
OTHERWISE = {"intervals --apart": r"newton +. damper pull"}
#: Those that a file of their own runs to their end.
APART = {"golden", "models"}
#: Arguments that a program does not go without.
ARGUMENTS = {
    "blind": "--out {out}",
    "iio_qemu": "linux-image.deb",
    "multibody": "--out {out}",
    "paper": "--out {out}",
    "rig": "--out {out}",
    "road_changes": "--out {out}",
    "tracked_runs": "--out {out}",
    "unity": "--endpoint ROS-TCP-Endpoint",
    "withheld": "--out {out}",
}
#: Those that take a few seconds.
SHORT = {"fuzz", "iio_qemu", "mcap_core", "peak", "unity"}
#: Those that take about a minute each even at that size: run when this file is named.
LONGEST = {
    "blind",
    "calibration",
    "diagnosis",
    "demo",
    "discrepancy",
    "fleet",
    "measured",
    "multibody",
    "mutation",
    "paper",
    "plan_confusion",
    "road_changes",
    "road_from_drives",
    "road_real_drives",
    "seeded",
    "torture",
    "tracked_blind",
    "tracked_paper",
    "tracked_runs",
    "withheld",
}


def test_every_program_is_run(repository: Path) -> None:
    programs = {
        p.stem for p in (repository / "benchmarks").glob("*.py") if "__main__" in p.read_text("utf-8")
    }
    assert programs == TABLES.keys() | APART


def marked(name: str) -> Any:
    kind = pytest.mark.longest if name in LONGEST else pytest.mark.long
    return pytest.param(name, marks=() if name in SHORT else kind)


@pytest.mark.parametrize("name", [marked(name) for name in (*TABLES, *OTHERWISE)])
@pytest.mark.long
def test_it_runs_to_its_end(name: str, repository: Path, tmp_path: Path) -> None:
    """Exit status 2 and one line say what is not on this machine."""
    program, *arguments = f"{name} {ARGUMENTS.get(name, '').format(out=tmp_path / 'out')}".split()
    done = subprocess.run(
        [sys.executable, str(repository / "benchmarks" / f"{program}.py"), *arguments, "--smoke"],
        capture_output=True,
        text=True,
        timeout=1200,
        cwd=tmp_path,
        env={**os.environ, "COLUMNS": "100", "TMPDIR": str(tmp_path)},
    )
    if done.returncode == 2 and len(done.stderr.splitlines()) == 1:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr[-3000:]
    assert re.search({**TABLES, **OTHERWISE}[name], done.stdout), done.stdout
