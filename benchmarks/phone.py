# SPDX-License-Identifier: Apache-2.0
"""Calibration from the drives of an ordinary phone, beside that from RTK.

    python benchmarks/phone.py [--seeds N] [--first SEED] [--json]

The bundled bump drive is degraded to what a phone records: positions with a correlated error of 2.5 m and 60 s, once
a second, 0.4 s late, Doppler of 0.1 m/s, an IMU at 67 Hz with jitter. The twin is calibrated on it, with its positions
and with none, and simulated on the other bundled drive, which has RTK. Shown is its gap there over that of the twin
that RTK calibrates. A calibration that refuses keeps the given twin.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from options import parse_options
from rich.console import Console
from rich.table import Table

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData, VelocityData
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.signals.common_rate import resampled
from suspension_twin.vehicle.twin import Datum, Twin, load_twin

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class PhoneErrors:
    """Errors of a phone's receiver: standard deviation of a position in each direction in m, correlated over
    ``memory`` s; ``fixes`` a second, ``late`` s behind the IMU's clock; ``doppler`` m/s of a velocity. Its IMU has
    ``rate`` samples a second, their stamps a ``jitter`` s."""

    accuracy: float = 2.5
    memory: float = 60.0
    fixes: float = 1.0
    late: float = 0.4
    doppler: float = 0.1
    rate: float = 67.0
    jitter: float = 1e-3


def phone_grade(drive: Drive, datum: Datum, seed: int, errors: PhoneErrors | None = None) -> Drive:
    """The drive as a phone would have recorded it that has ``errors``, where it was recorded with RTK."""
    e = errors or PhoneErrors()
    rng = np.random.default_rng(seed)
    imu = resampled(drive, e.rate).imu
    jitter = e.jitter * np.clip(rng.standard_normal(len(imu)), -3.0, 3.0)
    stamps = np.maximum.accumulate(imu.t + jitter)
    imu = replace(imu, t=stamps)
    step = (
        max(1, round(1.0 / e.fixes / float(np.median(np.diff(drive.fix.t))))) if e.fixes else len(drive.fix)
    )
    rows = np.arange(rng.integers(step), len(drive.fix), step)
    fix = drive.fix.select(rows)
    offset = e.accuracy * correlated(fix.t, e.memory, rng)
    frame = LocalMap(datum)
    enu = frame.to_map(fix.latitude, fix.longitude, fix.altitude)
    enu[:, :2] += offset
    latitude, longitude, altitude = frame.to_geodetic(enu).T
    sigma = np.tile([e.accuracy, e.accuracy, 2.0 * e.accuracy], (len(fix), 1))
    status = np.zeros(len(fix), dtype=np.int8)
    fix = replace(
        fix,
        t=fix.t + e.late,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        sigma=sigma,
        status=status,
    )
    at = np.clip(np.searchsorted(drive.velocity.t, drive.fix.t[rows]), 0, len(drive.velocity) - 1)
    noise = e.doppler * rng.standard_normal((at.size, 3))
    velocity = VelocityData(drive.velocity.t[at] + e.late, drive.velocity.enu[at] + noise)
    return replace(drive, imu=imu, fix=fix, velocity=velocity)


def correlated(t: Floats, memory: float, rng: np.random.Generator) -> Floats:
    """(n, 2) of unit variance at ``t`` (n,) s, an Ornstein-Uhlenbeck process of that time constant."""
    out = rng.standard_normal((t.size, 2))
    for k in range(1, t.size):
        kept = math.exp(-(t[k] - t[k - 1]) / memory)
        out[k] = kept * out[k - 1] + math.sqrt(1.0 - kept * kept) * out[k]
    return out


def unseen_gap(twin: Twin) -> float:
    """The gap in m/s² rms of a calibrated twin on the other bundled drive."""
    there = load_twin(ROOT / "bags" / "crg_road" / "twin.yaml")
    twin = there.model_copy(update={"vehicle": twin.vehicle})
    return float(simulate_drive(read_drive(ROOT / "bags" / "crg_road"), twin).gap.rms)


def calibrated(drive: Drive, given: Path, no_position: bool = False) -> tuple[Twin, str]:
    """The twin calibrated on a drive, and why it is the given one if it is."""
    with tempfile.TemporaryDirectory() as folder:
        write_drive(drive, Path(folder) / "drive")
        bags = (str(Path(folder) / "drive"),)
        try:
            found = calibrate(CalibrationRequest(twin=str(given), bags=bags, no_position=no_position))
        except SuspensionTwinError as error:
            return load_twin(given), str(error).partition(": ")[2]
    return (load_twin(given), "worse than the given twin") if found.is_worse else (found.twin, "")


def ways(drive: Drive, datum: Datum, seed: int) -> Iterator[tuple[str, Drive]]:
    """The drives of one seed, by what is known of the place."""
    phone = phone_grade(drive, datum, seed)
    yield "phone", phone
    yield "no position", replace(phone, fix=FixData.empty())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument(
        "--first", type=int, default=100, help="seed; 0 to 7 were looked at while it was made"
    )
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser, seeds=1)
    given = ROOT / "bags" / "bump_15kmh" / "twin.yaml"
    drive, twin = read_drive(given.parent), load_twin(given)
    assert twin.datum is not None
    rtk, start = unseen_gap(calibrated(drive, given)[0]), unseen_gap(twin)
    found: dict[str, list[float]] = {}
    refused: dict[str, list[str]] = {}
    for seed in range(options.first, options.first + options.seeds):
        for name, degraded in ways(drive, twin.datum, seed):
            result, why = calibrated(degraded, given, no_position=name == "no position")
            found.setdefault(name, []).append(unseen_gap(result) / rtk)
            refused.setdefault(name, []).extend([why] if why else [])
    rows = {
        name: {
            "median": float(np.median(ratios)),
            "p90": float(np.quantile(ratios, 0.9)),
            "ratios": ratios,
            "refused": refused[name],
        }
        for name, ratios in found.items()
    }
    if options.json:
        print(json.dumps({"rtk": rtk, "given": start, "seeds": options.seeds, "ratio_to_rtk": rows}))
        return
    table = Table(title=f"gap on an unseen drive over that with RTK ({rtk:.3f} m/s²; given twin {start:.3f})")
    for head in ("drive", "median", "90 %", "refused"):
        table.add_column(head)
    for name, row in rows.items():
        table.add_row(name, f"{row['median']:.2f}", f"{row['p90']:.2f}", f"{len(refused[name])}")
    Console().print(table)


if __name__ == "__main__":
    main()
