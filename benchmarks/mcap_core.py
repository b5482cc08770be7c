# SPDX-License-Identifier: Apache-2.0
"""A recording of live samples, read by the MCAP library of Foxglove and Lichtblick (npm ``@mcap/core``).

A bundled drive goes through the recorder of ``record``, or a given bag is taken. ``@mcap/core`` reads its file by the
index, with all checksums, and decodes each message by the definition in the file; counts, stamps and the sums of all
numbers have to be those that the drive has. Needs node and npm, which fetches the packages named in ``PACKAGES``.
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
from options import parse_options

PACKAGES = ("@mcap/core@2.2.2", "@foxglove/rosmsg@5", "@foxglove/rosmsg2-serialization@3", "fzstd@0.1")
HERE = Path(__file__).resolve().parent
#: Of sums of thousands of numbers, each in a double.
TOLERANCE = 1e-9


def recorded(bag: Path, folder: Path) -> Path:
    """The drive, written anew by the recorder of live sources; the MCAP file."""
    from suspension_twin.addons.sources.common.hub import Packet
    from suspension_twin.addons.sources.common.recorder import LiveRecorder
    from suspension_twin.drive.read import read_drive

    drive = read_drive(bag)
    with LiveRecorder(folder / "drive") as recorder:
        for samples in (drive.imu, drive.fix, drive.velocity):
            recorder.write([Packet("phone", samples, 0.0)])
    (file,) = (folder / "drive").glob("*.mcap")
    return file


def read_by_core(file: Path, folder: Path) -> dict[str, Any]:
    """What ``@mcap/core`` finds, by topic."""
    (folder / "package.json").write_text('{"private": true, "type": "module"}\n')
    install = ["npm", "install", "--no-audit", "--no-fund", "--silent", *PACKAGES]
    if subprocess.run(install, cwd=folder, capture_output=True).returncode:
        unavailable(f"npm cannot fetch {', '.join(PACKAGES)}")
    shutil.copy(HERE / "mcap_core.mjs", folder)
    command = ["node", "mcap_core.mjs", str(file)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"mcap_core.mjs: {done.stderr.strip()}")
    return dict(json.loads(done.stdout))


def expected(bag: Path) -> dict[str, tuple[int, dict[str, float]]]:
    """By topic the number of messages and the sums of their numbers, as this project reads the drive."""
    from suspension_twin.drive.read import read_drive

    drive = read_drive(bag)
    imu, fix, velocity = drive.imu, drive.fix, drive.velocity
    columns: dict[str, dict[str, Any]] = {
        "/imu/data_raw": {"header.stamp": imu.t},
        "/fix": {
            "header.stamp": fix.t,
            "latitude.": fix.latitude,
            "longitude.": fix.longitude,
            "altitude.": fix.altitude,
        },
        "/vel": {"header.stamp": velocity.t},
    }
    for i, axis in enumerate("xyz"):
        columns["/imu/data_raw"][f"linear_acceleration.{axis}."] = imu.specific_force[:, i]
        columns["/imu/data_raw"][f"angular_velocity.{axis}."] = imu.angular_rate[:, i]
        columns["/vel"][f"twist.linear.{axis}."] = velocity.enu[:, i]
    return {
        topic: (
            int(rows["header.stamp"].size),
            {name: float(np.sum(values)) for name, values in rows.items()},
        )
        for topic, rows in columns.items()
    }


def main() -> int:
    """Record, read, compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path, nargs="?", default=HERE.parent / "bags" / "bump_15kmh")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    arguments = parse_options(parser)
    missing = [name for name in ("node", "npm") if shutil.which(name) is None]
    if missing:
        unavailable(f"not installed: {', '.join(missing)}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = recorded(arguments.bag, folder)
        found, wanted = read_by_core(file, folder), expected(arguments.bag)
    rows, good = {}, set(found) == set(wanted)
    for topic, (count, sums) in sorted(wanted.items()):
        row = found.get(topic, {"type": "", "count": 0, "sums": {}})
        errors = [
            abs(row["sums"].get(key, np.inf) - value) / max(abs(value), 1.0) for key, value in sums.items()
        ]
        rows[topic] = {"type": row["type"], "count": row["count"], "wanted": count, "worst": max(errors)}
        good = good and row["count"] == count and max(errors) < TOLERANCE
    if arguments.json:
        print(json.dumps({"topics": rows, "same": good}))
    else:
        print(f"{'topic':<16}{'type':<32}{'messages':>10}{'of':>8}{'worst sum':>12}")
        for topic, row in rows.items():
            print(f"{topic:<16}{row['type']:<32}{row['count']:>10}{row['wanted']:>8}{row['worst']:>12.1e}")
        print("The same as this project reads." if good else "NOT the same as this project reads.")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
