# SPDX-License-Identifier: Apache-2.0
"""A real car's roof IMU, late, tilted and with a clock that drifts, none of which the twin is told.

    python benchmarks/measured.py [--data DIR] [--json]

The recording (rtklibexplorer's ``GNSS_IMU``, beside the repository in ``../shared/data`` or in
SUSPENSION_TWIN_DATA) has documented effects. Diagnosed twice: the whole drive, and the first half alone,
whose findings are then added to the twin and judged on the second half. The one true repeat of a
bump in it gives a noise floor.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from extras import unavailable
from options import parse_options
from rich.console import Console
from rich.table import Table

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.case import build, read_case
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.diagnosis.shrink import uncalibrated_residual
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.types import Drive, cut
from suspension_twin.drive.write import write_drive
from suspension_twin.signals.offline import ingest_drive
from suspension_twin.vehicle.twin import Datum, Imu, Place, Twin, load_twin, save_twin

ROOT = Path(__file__).resolve().parents[1]
MAPPING = ROOT / "config" / "import" / "rtklibexplorer_gnss_imu_raw.yaml"
#: What its owner documents: s, ppm, degrees. Its yaw is told about an axis that points down.
DOCUMENTED = {"offset": 0.125, "drift_ppm": 257.0, "pitch": 6.79, "yaw": -5.35}
#: Seconds after the first fix at which the same bump is passed.
PASSES = (337.6, 362.6)


def described(drive: Drive) -> Twin:
    """A twin of what anybody sees: a car, its IMU on the roof looking backwards, no road."""
    fix = drive.fix
    return load_twin(ROOT / "config" / "twins" / "ford_mondeo_mk4.yaml").model_copy(
        update={
            "imu": Imu(position=(0.0, 0.0, 1.5), rpy=(0.0, 0.0, np.pi)),
            "gps": Place(frame="gps_link", position=(0.0, 0.0, 2.15)),
            "datum": Datum(latitude=fix.latitude[0], longitude=fix.longitude[0], altitude=fix.altitude[0]),
            "road": None,
        }
    )


def asked(drive: Drive, twin: Twin, folder: Path) -> DiagnosisRequest:
    """Drive and twin written down, as a diagnosis reads them."""
    write_drive(drive, folder / "drive")
    save_twin(twin, folder / "twin.yaml")
    return DiagnosisRequest(str(folder / "twin.yaml"), (str(folder / "drive"),))


def named(document: dict[str, Any]) -> dict[str, Any]:
    """What a diagnosis has found, beside what is documented."""
    found: dict[str, Any] = {"verdict": document["verdict"], "combination": document["combination"]}
    for cause in document["causes"]:
        if cause["effect"] in document["combination"]:
            for name, value in cause["parameters"].items():
                scale = 180 / np.pi if name in ("roll", "pitch", "yaw") else 1.0
                low, high = cause["parameter_intervals"][name]
                found[name] = {
                    "found": value * scale,
                    "interval": [low * scale, high * scale],
                    "documented": DOCUMENTED.get(name),
                }
    return found


def gap(drive: Drive, twin: Twin, folder: Path) -> dict[str, float]:
    """Root mean square difference of each planar channel, nothing fitted."""
    request = asked(drive, twin, folder)
    bench = build(read_case(request, lambda note: None, lambda: False), lambda: False)
    difference = uncalibrated_residual(bench).difference
    return {c: float(np.sqrt(np.mean(difference[:, i] ** 2))) for i, c in enumerate(bench.channels)}


def halves(drive: Drive, folder: Path) -> dict[str, Any]:
    """The gap on the second half before and after what the first half has told."""
    start, end = float(drive.imu.t[0]), float(drive.imu.t[-1])
    middle = 0.5 * (start + end)
    first, second = cut(drive, start, middle), cut(drive, middle, end)
    twin = described(drive)
    result = diagnose(asked(first, twin, folder / "first"))
    # a drift counts from the first stamp of the drive that it is asked of
    drift = next((e.parameters["drift_ppm"] for e in result.twin.effects if e.id == "clock_drift"), 0.0)
    later = tuple(
        e.model_copy(
            update={"parameters": {"offset": e.parameters["offset"] + 1e-6 * drift * (middle - start)}}
        )
        if e.id == "time_offset"
        else e
        for e in result.twin.effects
    )
    mended = result.twin.model_copy(update={"effects": later, "road": None})
    before, after = gap(second, twin, folder / "before"), gap(second, mended, folder / "after")
    return {
        "first_half": named(result.document),
        "second_half": {
            c: {"before": before[c], "after": after[c], "shrink": 1.0 - after[c] / before[c]} for c in before
        },
    }


def repeat_floor(drive: Drive) -> dict[str, float]:
    """Vertical acceleration of two passes over one bump: what differs, by road position, over the root of two."""
    signals = ingest_drive(drive, Imu(position=(0.0, 0.0, 1.5), rpy=(0.0, 0.0, np.pi)))
    way = np.concatenate(
        [
            [0.0],
            np.cumsum(
                np.hypot(
                    np.diff(drive.fix.latitude) * 111_200.0, np.diff(drive.fix.longitude) * 111_200.0 * 0.77
                )
            ),
        ]
    )
    grid = np.arange(-6.0, 6.0, 0.02)

    def passed(seconds: float) -> Floats:
        near = np.abs(signals.t - drive.fix.t[0] - seconds) < 4.0
        t, v = signals.t[near], signals.vertical_acceleration[near]
        s = np.interp(t, drive.fix.t, way)
        close = np.abs(t - drive.fix.t[0] - seconds) < 0.5
        return np.asarray(np.interp(grid, s - s[close][int(np.argmax(np.abs(v[close])))], v))

    one, two = (passed(s) for s in PASSES)
    return {
        "rms": float(np.sqrt(np.mean(one**2))),
        "floor": float(np.std(one - two) / np.sqrt(2.0)),
        "correlation": float(np.corrcoef(one, two)[0, 1]),
    }


def show(console: Console, results: dict[str, Any]) -> None:
    table = Table("", "found", "90 % interval", "documented", title="From the whole drive")
    for name, row in results["whole"].items():
        if isinstance(row, dict):
            low, high = row["interval"]
            known = "" if row["documented"] is None else f"{row['documented']:g}"
            table.add_row(name, f"{row['found']:.4g}", f"{low:.4g} to {high:.4g}", known)
    console.print(table)
    table = Table("", "before", "after", "shrink", title="Second half, with what the first half has told")
    for name, row in results["second_half"].items():
        table.add_row(name, f"{row['before']:.4g}", f"{row['after']:.4g}", f"{100 * row['shrink']:.0f} %")
    console.print(table)
    floor = results["repeat"]
    differ = f"{floor['floor']:.3g} of {floor['rms']:.3g} m/s² differ (r = {floor['correlation']:.2f})"
    console.print(f"Two passes over one bump: {differ}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given = os.environ.get("SUSPENSION_TWIN_DATA")
    parser.add_argument(
        "--data", type=Path, default=Path(given) if given else ROOT.parent / "shared" / "data"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    options = parse_options(parser)
    folder = options.data / "rtklibexplorer_GNSS_IMU"
    if not folder.is_dir():
        unavailable(f"{folder} is not there: name the folder of measured data with --data")
    drive = replace(import_drive([folder], mapping=MAPPING).drive, name="drive")
    with tempfile.TemporaryDirectory() as work:
        whole = diagnose(asked(drive, described(drive), Path(work) / "whole")).document
        results = {"whole": named(whole), **halves(drive, Path(work)), "repeat": repeat_floor(drive)}
    if options.json:
        print(json.dumps(results, indent=1))
    else:
        show(Console(), results)


if __name__ == "__main__":
    main()
