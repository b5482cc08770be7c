# SPDX-License-Identifier: Apache-2.0
"""The live pose of real cars, started at any moment of a drive, against the path smoothed from the whole drive.

    python benchmarks/live_pose.py [--data DIR] [--every S] [--json]

Drives: rtklibexplorer's ``GNSS_IMU`` (RTK at 4 Hz) and comma2k19's example (u-blox at 10 Hz), see ``../shared/data`` or
SUSPENSION_TWIN_DATA. Each moment at which the car moves is a start of the two live stages, whose samples before it
never were. The receiver is the one recorded; the same without its velocities; and one like a phone's: 1 Hz, white noise
of 2.5 m and 0.3 m/s on top, nothing of which it says (RTK drive only, whose own path is good to centimetres).
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from extras import unavailable
from options import parse_options
from rich.table import Table

from suspension_twin.arrays import Floats
from suspension_twin.cli.common import output
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.types import Drive
from suspension_twin.pose.lock import PoseLock
from suspension_twin.pose.smoothed import locked_trajectory
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.signals.ingest import ImuIngest
from suspension_twin.signals.offline import ingest_drive
from suspension_twin.vehicle.twin import Datum, Place

ROOT = Path(__file__).resolve().parents[1]
MOVING = 2.0  # m/s from which a moment is a start
SPANS = ((1.0, 5.0), (5.0, 20.0))  # s after the start
M_PER_DEGREE = 111_200.0


@dataclass(frozen=True, eq=False)
class Car:
    """A recorded drive, its sensors' places, and the path that is compared with."""

    name: str
    drive: Drive
    imu: Place
    gps: Place
    datum: Datum
    path: Trajectory


def car(folder: Path, mapping: str, imu: Place, gps: Place) -> Car:
    """The drive of ``folder`` with its smoothed path."""
    drive = import_drive([folder], mapping=ROOT / "config" / "import" / mapping).drive
    fix = drive.fix
    datum = Datum(latitude=fix.latitude[0], longitude=fix.longitude[0], altitude=fix.altitude[0])
    signals = ingest_drive(drive, imu)
    return Car(folder.name, drive, imu, gps, datum, locked_trajectory(drive, signals, gps, datum, signals.t))


def like_a_phone(drive: Drive, seed: int = 1) -> Drive:
    """One fix and velocity a second, with a phone's noise and without a word about it."""
    random = np.random.default_rng(seed)

    def each_second(t: Floats) -> np.ndarray:
        return np.flatnonzero(np.diff(np.floor(t), prepend=-1.0) > 0)

    fix = drive.fix.select(each_second(drive.fix.t))
    velocity = drive.velocity.select(each_second(drive.velocity.t))
    north, east = random.normal(0.0, 2.5 / M_PER_DEGREE, (2, len(fix)))
    fix = replace(
        fix,
        latitude=fix.latitude + north,
        longitude=fix.longitude + east / np.cos(np.radians(fix.latitude)),
        status=np.zeros(len(fix), dtype=np.int8),
        sigma=np.full((len(fix), 3), np.nan),
    )
    enu = velocity.enu + random.normal(0.0, 0.3, velocity.enu.shape)
    return replace(drive, fix=fix, velocity=replace(velocity, enu=enu))


def started(case: Car, drive: Drive, start: float, end: float, velocities: bool) -> Floats:
    """(n, 5) t, x, y, yaw and speed of the live pose, of what is between ``start`` and ``end``."""
    ingest, lock = ImuIngest(ImuSettings(), case.imu), PoseLock(None, case.gps, case.datum, case.imu)
    fix, velocity, imu = drive.fix, drive.velocity, drive.imu
    events = [(t, 0, k) for k, t in enumerate(fix.t) if start <= t < end]
    events += [(t, 1, k) for k, t in enumerate(velocity.t) if velocities and start <= t < end]
    events += [(t, 2, k) for k, t in enumerate(imu.t) if start <= t < end]
    out = []
    for t, kind, k in sorted(events):
        if kind == 0:
            place = fix.latitude[k], fix.longitude[k], fix.altitude[k]
            lock.on_fix(t, *place, int(fix.status[k]), *fix.sigma[k, :2])
        elif kind == 1:
            lock.on_velocity(t, *velocity.enu[k, :2])
        else:
            sample = ingest.push(t, imu.specific_force[k], imu.angular_rate[k])
            state = sample and lock.on_imu(sample.t, sample.force, sample.rate)
            if state and state.valid:
                out.append((*state[:4], state.motion.speed))
    return np.array(out).reshape(-1, 5)


def off(case: Car, rows: Floats) -> tuple[Floats, Floats]:
    """Distance in m and difference of the speed in m/s from the path."""
    path = case.path
    x, y, speed = (np.interp(rows[:, 0], path.t, v) for v in (path.x, path.y, path.speed))
    return np.hypot(rows[:, 1] - x, rows[:, 2] - y), np.abs(rows[:, 4] - speed)


def scored(case: Car, drive: Drive, velocities: bool, every: float) -> dict[str, Any]:
    """Largest errors of every start in each span, and the root mean square of the whole drive from its beginning."""
    path, moments = case.path, []
    for start in np.arange(case.path.t[0] + 2.0, case.path.t[-1] - SPANS[-1][1], every):
        if np.interp(start, path.t, path.speed) < MOVING:
            continue
        rows = started(case, drive, start, start + SPANS[-1][1], velocities)
        place, pace = off(case, rows)
        since = rows[:, 0] - start
        found: list[float] = [float(since[0]) if since.size else np.inf]
        for low, high in SPANS:
            inside = (since >= low) & (since < high)
            found += [float(values[inside].max()) if inside.any() else np.inf for values in (place, pace)]
        moments.append(found)
    table = np.array(moments)
    out: dict[str, Any] = {"starts": len(moments), "first_pose_s": float(np.median(table[:, 0]))}
    for column, name in enumerate(
        f"{what}_{low:g}_{high:g}_s" for low, high in SPANS for what in ("place_m", "speed_m_s")
    ):
        values = table[:, column + 1]
        out[name] = {
            "median": float(np.median(values)),
            "p90": float(np.quantile(values, 0.9)),
            "max": float(values.max()),
        }
    place, pace = off(case, started(case, drive, path.t[0], path.t[-1], velocities))
    out["whole_drive_rms"] = {"place_m": _rms(place), "speed_m_s": _rms(pace)}
    return out


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    data = os.environ.get("SUSPENSION_TWIN_DATA", ROOT.parent / "shared" / "data")
    parser.add_argument("--data", type=Path, default=data)
    parser.add_argument("--every", type=float, default=9.0, help="s between two starts")
    parser.add_argument("--json", action="store_true")
    given = parse_options(parser, every=200.0)
    roof = Place(position=(0.0, 0.0, 1.5), rpy=(0.0111, -0.1180, 3.0476))
    folders = [given.data / name for name in ("rtklibexplorer_GNSS_IMU", "comma2k19_Example_1")]
    if missing := [folder.name for folder in folders if not folder.is_dir()]:
        unavailable(f"no {' and no '.join(missing)} in {given.data}: name the measured data by --data")
    rtk = car(
        folders[0], "rtklibexplorer_gnss_imu.yaml", roof, Place(frame="gps_link", position=(0.0, 0.0, 2.15))
    )
    screen = Place(position=(2.0, 0.0, 1.2))
    comma = car(folders[1], "comma2k19.yaml", screen, Place(frame="gps_link", position=screen.position))
    results = {
        "RTK": scored(rtk, rtk.drive, True, given.every),
        "RTK, fixes alone": scored(rtk, rtk.drive, False, given.every),
        "like a phone": scored(rtk, like_a_phone(rtk.drive), True, given.every),
        "u-blox": scored(comma, comma.drive, True, given.every / 7.0),
        "u-blox, fixes alone": scored(comma, comma.drive, False, given.every / 7.0),
    }
    if given.json:
        print(json.dumps(results, indent=1))
        return
    table = Table(title="Largest error of the live pose after a start in motion: median, 90 %, maximum")
    table.add_column("receiver")
    table.add_column("starts", justify="right")
    for low, high in SPANS:
        table.add_column(f"m, {low:g} to {high:g} s", justify="right")
        table.add_column("m/s", justify="right")
    table.add_column("whole drive, rms: m, m/s", justify="right")
    for name, found in results.items():
        cells = (
            " ".join(f"{v:.2f}" for v in values.values())
            for values in found.values()
            if isinstance(values, dict)
        )
        table.add_row(name, str(found["starts"]), *cells)
    output().print(table)


if __name__ == "__main__":
    main()
