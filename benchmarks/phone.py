# SPDX-License-Identifier: Apache-2.0
"""Calibration from the drives of an ordinary phone, beside that from RTK.

    python benchmarks/phone.py [--seeds N] [--first SEED] [--json]
    python benchmarks/phone.py --sweep [--seeds N] [--picture FILE] [--json]

Each bundled drive is degraded to what a phone records: positions with a correlated error of 2.5 m and 60 s, twice that
in height, once a second, 0.4 s late, Doppler of 0.1 m/s, an IMU at 67 Hz with jitter. The twin is calibrated on it,
with its positions and with none, and simulated on the other bundled drive, which has RTK. Shown is its gap there over
that of the twin that RTK calibrates, and over how much of what the drive excited the true characteristics lie in
their 90 % bands. A calibration that refuses keeps the given twin. ``--sweep`` changes one property of the phone, of its
receiver, of the drive or of the tape at a time.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from options import parse_options
from rich.console import Console
from rich.table import Table

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData, VelocityData
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.models.parameters import twin_value
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road import load_road, write_road
from suspension_twin.road.recipe import Feature, Taped
from suspension_twin.signals.common_rate import resampled
from suspension_twin.vehicle.twin import Datum, RoadFile, Twin, load_twin, save_twin

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
    frame = LocalMap(datum)
    enu = frame.to_map(fix.latitude, fix.longitude, fix.altitude)
    enu += e.accuracy * correlated(fix.t, e.memory, rng) * np.array([1.0, 1.0, 2.0])
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
    """(n, 3) of unit variance at ``t`` (n,) s, an Ornstein-Uhlenbeck process of that time constant."""
    out = rng.standard_normal((t.size, 3))
    for k in range(1, t.size):
        kept = math.exp(-(t[k] - t[k - 1]) / memory)
        out[k] = kept * out[k - 1] + math.sqrt(1.0 - kept * kept) * out[k]
    return out


#: The drive that a twin is judged on, by the one that it is calibrated on.
UNSEEN = {"bump_15kmh": "crg_road", "crg_road": "bump_15kmh"}


@dataclass(frozen=True)
class Reality:
    """A bundled drive, with the given and the true twin."""

    name: str
    drive: Drive
    given: Path
    truth: Twin

    @classmethod
    def named(cls, name: str) -> Reality:
        """The bundled drive of that name."""
        folder = ROOT / "bags" / name
        return cls(name, read_drive(folder), folder / "twin.yaml", load_twin(folder / "truth.yaml"))

    @property
    def datum(self) -> Datum:
        """Of its map."""
        assert self.truth.datum is not None
        return self.truth.datum


def unseen_gap(twin: Twin, unseen: str = "crg_road") -> float:
    """The gap in m/s² rms of a calibrated twin on another bundled drive."""
    there = load_twin(ROOT / "bags" / unseen / "twin.yaml")
    twin = there.model_copy(update={"vehicle": twin.vehicle})
    return float(simulate_drive(read_drive(ROOT / "bags" / unseen), twin).gap.rms)


@dataclass(frozen=True)
class Found:
    """A calibration: its ``gap`` in m/s² on the unseen drive, mean errors of the rates of ``springs`` and the forces of
    ``dampers``, and the ``coverage`` of their bands over what was excited; ``refused``: why the given twin is kept."""

    gap: float
    springs: float = math.nan
    dampers: float = math.nan
    coverage: float = math.nan
    refused: str = ""


def calibrated(
    reality: Reality, drives: Sequence[Drive], no_position: bool = False, road: Path | None = None
) -> Found:
    """The calibration on some drives of a reality, over its own or another ``road``."""
    unseen = UNSEEN[reality.name]
    with tempfile.TemporaryDirectory() as folder:
        bags = tuple(str(Path(folder) / f"drive{k}") for k in range(len(drives)))
        for drive, bag in zip(drives, bags, strict=True):
            write_drive(drive, Path(bag))
        given = load_twin(reality.given)
        where = given if road is None else given.model_copy(update={"road": RoadFile(file=road)})
        save_twin(where, Path(folder) / "twin.yaml")
        request = CalibrationRequest(twin=str(Path(folder) / "twin.yaml"), bags=bags, no_position=no_position)
        try:
            found = calibrate(request)
        except SuspensionTwinError as error:
            return Found(unseen_gap(given, unseen), refused=str(error).partition(": ")[2])
    if found.refusal:
        return Found(unseen_gap(given, unseen), refused="worse than the given twin")
    return Found(unseen_gap(found.twin, unseen), *errors_of(found, reality.truth))


def errors_of(found: CalibrationResult, truth: Twin) -> tuple[float, float, float]:
    """Mean errors of the springs' rates and the dampers' forces, as shares, and the coverage of their 90 % bands."""
    rates, forces, inside = list[float](), list[float](), list[float]()
    for curve in found.curves:
        x, force = (np.concatenate([[0.0], values]) for values in twin_value(truth, curve.key).points)
        low, high = curve.span
        if not np.isfinite(low) or high - low < 1e-3:
            continue
        if curve.from_rest is None:
            at = curve.band.x
            here = (at >= max(low, 0.02)) & (at <= high)
            wanted, band = np.interp(at, x, force), curve.band
            off = np.abs(curve.force / np.maximum(wanted, 1.0) - 1.0)[here]
            forces += [float(np.mean(off))] if here.any() else []
        else:  # counted from where both bear the standing car
            band = curve.from_rest
            load = float(np.interp(curve.static, curve.band.x, curve.force))
            at, here = band.x + float(np.interp(load, force, x)), np.ones(band.x.size, dtype=np.bool_)
            wanted = np.interp(at, x, force)
            here_force = np.interp(band.x + curve.static, curve.band.x, curve.force)
            own, true = (float(f[-1] - f[0]) for f in (here_force, wanted))
            rates.append(abs(own / true - 1.0))
        if here.any():
            inside.append(float(np.mean(((wanted >= band.low) & (wanted <= band.high))[here])))
    return tuple(float(np.mean(v)) if v else math.nan for v in (rates, forces, inside))  # type: ignore[return-value]


def ways(reality: Reality, seed: int) -> Iterator[tuple[str, Drive]]:
    """The drives of one seed, by what is known of the place."""
    phone = phone_grade(reality.drive, reality.datum, seed)
    yield "phone", phone
    yield "no position", replace(phone, fix=FixData.empty())


@dataclass(frozen=True)
class Setting:
    """One point of the sweep: the ``factor`` that differs, its ``value`` in words and the phone's errors; how many
    ``passes`` over the bump; ``height`` m by which the tape was wrong, and whether the road is said to be ``taped``."""

    factor: str
    value: str
    errors: PhoneErrors = PhoneErrors()
    passes: int = 3
    height: float = 0.0
    taped: bool = False


def settings() -> Iterator[Setting]:
    """The phone as it is, then one thing changed at a time."""
    usual = PhoneErrors()
    yield Setting("as it is", "")
    for factor, name, unit, values in (
        ("IMU rate", "rate", "Hz", (25.0, 40.0, 50.0, 100.0)),
        ("accuracy of a position", "accuracy", "m", (0.02, 0.5, 10.0)),
        ("positions a second", "fixes", "", (0.0, 10.0)),
        ("jitter of stamps", "jitter", "s", (0.0, 0.01)),
    ):
        for value in values:
            yield Setting(factor, f"{value:g} {unit}".strip(), replace(usual, **{name: value}))
    for passes in (1, 2, 6):
        yield Setting("passes", str(passes), passes=passes)
    for height in (-0.005, 0.0, 0.005, 0.01):
        yield Setting("tape, height wrong by", f"{1e3 * height:+g} mm", height=height, taped=True)
    for height in (-0.005, 0.005):
        yield Setting("surveyed, height wrong by", f"{1e3 * height:+g} mm", height=height)


#: Middles in s of the pauses between the three passes of the bundled bump drive.
PAUSES = (24.0, 50.0)


def swept(reality: Reality, setting: Setting, seed: int) -> Found:
    """The calibration of one point of the sweep."""
    drives = [
        phone_grade(reality.drive, reality.datum, seed + 1000 * k, setting.errors)
        for k in range(-(-setting.passes // 3))
    ]
    if setting.passes < 3:
        drives = [until(drives[0], PAUSES[setting.passes - 1])]
    if not setting.errors.fixes:
        drives = [replace(drive, fix=FixData.empty()) for drive in drives]
    if not (setting.height or setting.taped):
        return calibrated(reality, drives)
    with tempfile.TemporaryDirectory() as folder:
        # the bump of the file is as much lower as the real one is higher
        road = load_road(reality.given.with_name("road.crg"))
        said = road.with_heights(road.z * (1.0 - setting.height / float(road.z.max())))
        top = int(np.argmax(said.z.max(axis=1)))
        bump = Feature("hump", (0.9, float(said.z.max())), said.u_first + top * said.u_step - 0.45)
        write_road(said, Path(folder) / "road.crg", Taped((bump,)).comment if setting.taped else "")
        return calibrated(reality, drives, road=Path(folder) / "road.crg")


def until(drive: Drive, seconds: float) -> Drive:
    """The beginning of a drive."""
    end = float(drive.imu.t[0]) + seconds
    imu, fix, velocity = drive.imu, drive.fix, drive.velocity
    return replace(
        drive,
        imu=imu.select(np.flatnonzero(imu.t < end)),
        fix=fix.select(np.flatnonzero(fix.t < end)),
        velocity=velocity.select(np.flatnonzero(velocity.t < end)),
    )


Row = dict[str, float | str]


def sweep(seeds: range, rtk: float) -> Iterator[Row]:
    """A row for each setting."""
    reality = Reality.named("bump_15kmh")
    for setting in settings():
        yield row_of(setting, [swept(reality, setting, seed) for seed in seeds], rtk)


def row_of(setting: Setting, found: Sequence[Found], rtk: float) -> Row:
    """Medians over the calibrations of a setting, and the worst gap."""
    ratios = [f.gap / rtk for f in found]
    row: Row = {"factor": setting.factor, "value": setting.value}
    row |= {
        "gap": float(np.median(ratios)),
        "worst": max(ratios),
        "refused": sum(bool(f.refused) for f in found),
    }
    for name in ("springs", "dampers", "coverage"):
        known = [getattr(f, name) for f in found if not f.refused]
        row[name] = float(np.median(known)) if known else math.nan
    return row


def draw(rows: Sequence[Row], path: Path) -> None:
    """The gap against each factor."""
    from matplotlib.figure import Figure

    factors = [f for f in dict.fromkeys(str(r["factor"]) for r in rows) if f != "as it is"]
    figure = Figure(figsize=(11.0, 6.0), layout="constrained")
    axes = figure.subplots(2, -(-len(factors) // 2), sharey=True, squeeze=False).ravel()
    for ax, factor in zip(axes, factors, strict=False):
        own = [r for r in rows if r["factor"] == factor]
        ax.plot([str(r["value"]) for r in own], [r["gap"] for r in own], "o-", color="C0")
        ax.plot([str(r["value"]) for r in own], [r["worst"] for r in own], "_", color="C0")
        ax.axhline(float(rows[0]["gap"]), color="0.6", linewidth=1.0)
        ax.set_title(factor, fontsize=10)
    for ax in axes[len(factors) :]:
        ax.set_visible(False)
    figure.supylabel("gap on an unseen drive over that with RTK")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument(
        "--first", type=int, default=200, help="seed; those below were looked at while it was made"
    )
    parser.add_argument("--drive", choices=sorted(UNSEEN), action="append", help="one drive only")
    parser.add_argument("--sweep", action="store_true", help="one property at a time")
    parser.add_argument("--picture", type=Path, help="where to draw the sweep (.png)")
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser, seeds=1, drive=["bump_15kmh"])
    seeds = range(options.first, options.first + options.seeds)
    if options.sweep:
        reality = Reality.named("bump_15kmh")
        rows = list(sweep(seeds, calibrated(reality, [reality.drive]).gap))
        if options.picture:
            draw(rows, options.picture)
        print(json.dumps(rows) if options.json else "\n".join(table_of(rows)))
        return
    for name in options.drive or sorted(UNSEEN):
        compare(Reality.named(name), seeds, options.json)


def table_of(rows: Sequence[Row]) -> Iterator[str]:
    """The sweep as a table of the documentation."""
    yield "| factor | value | gap over RTK's, median (worst) | springs off by | dampers off by | bands hold |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for r in rows:
        known = [float(r[k]) for k in ("springs", "dampers", "coverage")]
        shares = " | ".join("" if math.isnan(k) else f"{100 * k:.0f} %" for k in known)
        gap = "refused" if math.isnan(known[1]) else f"{r['gap']:.2f} ({r['worst']:.2f})"
        yield f"| {r['factor']} | {r['value']} | {gap} | {shares} |"


def compare(reality: Reality, seeds: range, as_json: bool) -> None:
    """Print the table of one drive."""
    unseen = UNSEEN[reality.name]
    rtk, start = calibrated(reality, [reality.drive]), unseen_gap(load_twin(reality.given), unseen)
    found: dict[str, list[Found]] = {"RTK": [rtk]}
    for seed in seeds:
        for name, degraded in ways(reality, seed):
            found.setdefault(name, []).append(
                calibrated(reality, [degraded], no_position=name == "no position")
            )
    rows: dict[str, dict[str, Any]] = {
        name: {
            "median": float(np.median([f.gap for f in own])) / rtk.gap,
            "p90": float(np.quantile([f.gap for f in own], 0.9)) / rtk.gap,
            "ratios": [f.gap / rtk.gap for f in own],
            "coverage": float(np.mean([f.coverage for f in own if not f.refused] or [math.nan])),
            "refused": [f.refused for f in own if f.refused],
        }
        for name, own in found.items()
    }
    if as_json:
        print(
            json.dumps(
                {
                    "drive": reality.name,
                    "rtk": rtk.gap,
                    "given": start,
                    "seeds": len(seeds),
                    "ratio_to_rtk": rows,
                }
            )
        )
        return
    table = Table(
        title=f"{reality.name}: gap on an unseen drive over that with RTK ({rtk.gap:.3f} m/s²; given twin {start:.3f})"
    )
    for head in ("drive", "median", "90 %", "refused", "90 % bands hold"):
        table.add_column(head)
    for name, row in rows.items():
        share = f"{100 * row['coverage']:.0f} %"
        table.add_row(name, f"{row['median']:.2f}", f"{row['p90']:.2f}", f"{len(row['refused'])}", share)
    Console().print(table)


if __name__ == "__main__":
    main()
