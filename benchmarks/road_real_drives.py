# SPDX-License-Identifier: Apache-2.0
"""Roads from a real car's drives: does the road of one pass predict the vertical acceleration of another?

    python benchmarks/road_real_drives.py [--data DIR] [--pairs N] [--felt SEEDS] [--json] [--pictures DIR]

rtklibexplorer's ``GNSS_IMU`` (a car with a roof IMU and an RTK receiver, see ``../shared/data`` or
SUSPENSION_TWIN_DATA): every stretch that is driven twice in the same direction, the bump at 337.6 and 362.6 s among
them; comma2k19's example: whatever repeats. The vehicle is not known: the twin is the Mondeo preset with the sensor
where it is documented. Nothing is calibrated.

For each ordered pair of passes the road is estimated from the one, the twin drives over it along the other's path, and
its vertical acceleration is compared with the measured one. Beside it the first pass's own measured acceleration, by
place on the road. Both may be shifted along the road by up to 0.75 m and scaled, whichever fits the second pass best.

``--felt``: the second pass with a phone's receiver of each seed (``phone.py``) is placed on that road by what was felt;
how far its place along the road is from that by RTK, beside the receiver's own error, or why it is not placed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from extras import unavailable
from matplotlib.figure import Figure
from options import parse_options
from phone import phone_grade

from suspension_twin.addons.roads.drives.drives import DrivenPart, road_from_drives, surface_of
from suspension_twin.addons.roads.drives.estimate import RoadEstimateSettings
from suspension_twin.addons.roads.pictures import estimate_figure, save_picture
from suspension_twin.arrays import Floats, runs
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.types import Drive
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.inference.observation import Observation, observe
from suspension_twin.inference.placement import on_one_clock, place
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.road import Road, flat_road
from suspension_twin.vehicle.twin import Datum, Imu, Place, Twin, load_twin

ROOT = Path(__file__).resolve().parents[1]
#: Seconds after the first fix of the repeated bump, and how far around it.
BUMP, AROUND = (337.6, 362.6), 1.5
#: A repeat: this near (m), this parallel (cosine), this much later (s), on the move (m/s), this long (m).
NEAR, PARALLEL, LATER, MOVING, LONG = 2.0, 0.9, 10.0, 2.5, 7.0
SHIFT = 0.75  # m
MARGIN = 4.0  # s that a pass is longer than what is compared


@dataclass(frozen=True)
class Pair:
    """Two passes over one stretch: (start, end) s after the first sample of the IMU."""

    name: str
    first: tuple[float, float]
    second: tuple[float, float]


def rtk_car(drive: Drive) -> Twin:
    """The preset with the roof IMU as its owner describes its mounting."""
    return load_twin(ROOT / "config" / "twins" / "ford_mondeo_mk4.yaml").model_copy(
        update={
            "imu": Imu(position=(0.0, 0.0, 1.5), rpy=(0.0111, -0.1180, 3.0476)),
            "gps": Place(frame="gps_link", position=(0.0, 0.0, 2.15)),
            "datum": _datum(drive),
            "road": None,
        }
    )


def phone_car(drive: Drive) -> Twin:
    """The preset with a device on its windshield."""
    return load_twin(ROOT / "config" / "twins" / "ford_mondeo_mk4.yaml").model_copy(
        update={"datum": _datum(drive), "road": None}
    )


def _datum(drive: Drive) -> Datum:
    return Datum(latitude=float(drive.fix.latitude[0]), longitude=float(drive.fix.longitude[0]), altitude=0.0)


def repeats(whole: Observation, near: float = NEAR) -> list[Pair]:
    """Stretches of a drive that it drives again in the same direction."""
    path = whole.trajectory
    t = path.t - path.t[0]
    every = slice(None, None, 10)
    x, y, yaw, speed, at = (a[every] for a in (path.x, path.y, path.yaw, path.speed, t))
    partner = np.full(at.size, -1)
    for i in range(at.size):
        far = np.hypot(x - x[i], y - y[i])
        fits = (far < near) & (np.cos(yaw - yaw[i]) > PARALLEL) & (at < at[i] - LATER) & (speed > MOVING)
        if speed[i] > MOVING and fits.any():
            where = np.flatnonzero(fits)
            partner[i] = where[far[where].argmin()]
    found = []
    for start, end in runs(partner >= 0):
        breaks = np.flatnonzero(np.abs(np.diff(partner[start:end])) > 30) + 1
        for piece in np.split(np.arange(start, end), breaks):
            if piece.size > 2 and np.hypot(np.diff(x[piece]), np.diff(y[piece])).sum() > LONG:
                other = partner[piece[0]], partner[piece[-1]]
                first = float(at[min(other)]), float(at[max(other)])
                found.append(Pair(f"{first[0]:.0f} s", first, (float(at[piece[0]]), float(at[piece[-1]]))))
    return found


def by_place(part: Observation, values: Floats) -> tuple[Floats, Floats]:
    """m along the path of the body and values there, on the move."""
    on = part.speed > 1.0
    return np.concatenate([[0.0], np.cumsum(part.speed[1:] / part.rate)])[on], values[on]


def best(prediction: Any, measured: Floats) -> tuple[float, float, float]:
    """Correlation, share of the power explained and shift in m of the best shifted and scaled prediction."""
    scores = []
    for shift in np.arange(-SHIFT, SHIFT + 0.01, 0.05):
        p = prediction(shift)
        good = np.isfinite(p)
        r = float(np.corrcoef(p[good], measured[good])[0, 1])
        scores.append((r, r * abs(r), float(shift)))
    return max(scores)


def ahead_of(place: Observation, whole: Observation, span: tuple[float, float]) -> float:
    """m by which an observation lies ahead of another of the same drive, the mean over ``span`` s of the drive."""
    path, true = place.trajectory, whole.trajectory
    t = path.t - true.t[0]
    on = (t >= span[0]) & (t <= span[1])
    x, y, yaw = (np.interp(t[on], true.t - true.t[0], v) for v in (true.x, true.y, np.unwrap(true.yaw)))
    return float(np.mean((path.x[on] - x) * np.cos(yaw) + (path.y[on] - y) * np.sin(yaw)))


def felt_place(
    drive: Drive, twin: Twin, road: Road, whole: Observation, span: tuple[float, float], seed: int
) -> dict[str, Any]:
    """A pass over ``span`` s with a phone's receiver, placed on the road by what was felt."""
    assert twin.datum is not None
    begin, end = (float(whole.t[0]) + at for at in (span[0] - MARGIN + 0.5, span[1] + MARGIN - 0.5))
    phone = phone_grade(drive, twin.datum, seed)
    within = [np.flatnonzero((t >= begin) & (t <= end)) for t in (phone.imu.t, phone.fix.t, phone.velocity.t)]
    phone = replace(
        phone,
        imu=phone.imu.select(within[0]),
        fix=phone.fix.select(within[1]),
        velocity=phone.velocity.select(within[2]),
    )
    row: dict[str, Any] = {"seed": seed}
    try:
        read = on_one_clock(observe(phone, twin, road))
        row["receiver"] = ahead_of(read, whole, span)
        where = place(read, twin)
        row["felt"] = row["receiver"] if where is None else ahead_of(where.kept(read), whole, span)
    except SuspensionTwinError as error:
        row["error"] = str(error)
    return row


def judged(
    drive: Drive, twin: Twin, whole: Observation, pair: Pair, picture: Path | None, seeds: int
) -> dict[str, Any]:
    """One ordered pair: the road of the first pass under the second."""
    (a0, a1), (b0, b1) = pair.first, pair.second
    found = road_from_drives(
        [DrivenPart(drive, a0 - MARGIN, a1 + MARGIN)], twin, RoadEstimateSettings(samples=3)
    )
    road = surface_of(found)
    begin = float(whole.t[0])
    second = observe(drive, twin, road).part(begin + b0 - MARGIN, begin + b1 + MARGIN)
    simulated = second.condition(simulate_twin(twin, second.road_excitation))["vertical_acceleration"]
    measured = second.measured["vertical_acceleration"]
    first = whole.part(begin + a0 - MARGIN, begin + a1 + MARGIN)
    # Places of both passes on the road's own line.
    places = []
    for part in (first, second):
        path = part.trajectory
        u = road.xy_to_uv(path.x, path.y)[0]
        places.append(np.interp(part.t, path.t, u))
    moving = first.speed > 1.0
    order = np.argsort(places[0][moving])
    u_first, a_first = places[0][moving][order], first.measured["vertical_acceleration"][moving][order]
    t = second.t - begin
    # Beside the road its border is held: what crosses the whole road goes on there.
    usable = np.asarray(np.interp(second.t, whole.t, whole.mask.astype(float)) > 0.99)
    k = usable & (t >= b0) & (t <= b1) & (places[1] > road.u_first) & (places[1] < road.u_last)
    if k.sum() < 0.5 * (b1 - b0) * second.rate:
        raise ValueError("too little of the second pass lies on the road of the first")
    u_second = places[1]

    def of_twin(shift: float) -> Floats:
        speed = np.maximum(second.speed, 1.0)
        return np.asarray(np.interp(second.t - shift / speed, second.t, simulated))[k]

    def of_pass(shift: float) -> Floats:
        return np.asarray(np.interp(u_second + shift, u_first, a_first))[k]

    twin_r, _, twin_shift = best(of_twin, measured[k])
    pass_r, _, pass_shift = best(of_pass, measured[k])
    plain = float(np.corrcoef(simulated[k], measured[k])[0, 1])
    left = float(np.sqrt(np.mean((measured - simulated)[k] ** 2)))
    if picture is not None:
        _draw(picture, t[k], measured[k], of_twin(twin_shift), of_pass(pass_shift), (twin_r, pass_r))
        save_picture(estimate_figure(found), picture.with_name(picture.stem + "_road.png"))
    return {
        "first": list(pair.first),
        "second": list(pair.second),
        "metres": float(np.ptp(u_second[k])),
        "speeds": [float(np.median(first.speed)), float(np.median(second.speed))],
        "beside": float(np.median(np.abs(road.xy_to_uv(second.trajectory.x, second.trajectory.y)[1]))),
        "twin": twin_r,
        "twin_unshifted": plain,
        "pass": pass_r,
        "rms": float(np.std(measured[k])),
        "left": left,
        "felt": [felt_place(drive, twin, road, whole, pair.second, seed) for seed in range(seeds)],
    }


def _draw(
    path: Path, t: Floats, measured: Floats, twin: Floats, other: Floats, r: tuple[float, float]
) -> None:
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    for ax, values, label, colour in (
        (axes[0], twin, f"twin on the road of the first pass, correlation {r[0]:.2f}", "#d1661c"),
        (axes[1], other, f"first pass itself, shifted and scaled, correlation {r[1]:.2f}", "#1f6fb2"),
    ):
        scale = float(values @ measured / (values @ values)) if colour == "#1f6fb2" else 1.0
        ax.plot(t, measured, color="#22262b", lw=0.9, label="measured on the second pass")
        ax.plot(t, scale * values, color=colour, lw=1.1, label=label)
        ax.set_ylabel("vertical [m/s²]")
        ax.grid(alpha=0.25)
        ax.margins(x=0.0)
        ax.legend(loc="upper right", frameon=False, fontsize=8)
    axes[1].set_xlabel("time of the drive [s]")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, facecolor="white")


def study(drive: Drive, twin: Twin, near: float, bump: bool, asked: argparse.Namespace) -> dict[str, Any]:
    """The first pairs of a drive, both ways: as many as ``asked``."""
    pictures: Path | None = asked.pictures
    whole = observe(drive, twin, flat_road())
    pairs = repeats(whole, near)
    if bump:
        late = float(drive.imu.t[0] - drive.fix.t[0])
        own = [(at - late - AROUND, at - late + AROUND) for at in BUMP]
        pairs.insert(0, Pair("bump", own[0], own[1]))
    rows = []
    for pair in pairs[: asked.pairs]:
        for way, one in (("", pair), (" back", Pair(pair.name, pair.second, pair.first))):
            picture = None  # a picture of the prediction, and one of the road
            if pictures is not None:
                picture = pictures / f"road_real_{pair.name.replace(' ', '')}{way.strip()}.png"
            try:
                rows.append({"name": pair.name + way, **judged(drive, twin, whole, one, picture, asked.felt)})
            except ValueError as error:
                rows.append({"name": pair.name + way, "error": str(error)})
            _say(rows[-1], sys.stderr if asked.json else sys.stdout)
    return {"pairs": len(pairs), "rows": rows}


def _say(row: dict[str, Any], out: TextIO) -> None:
    if "error" in row:
        print(f"  {row['name']}: {row['error']}", file=out, flush=True)
        return
    print(
        f"  {row['name']:12} {row['metres']:5.0f} m at {row['speeds'][0]:.1f} and {row['speeds'][1]:.1f} m/s: "
        f"twin {row['twin']:.2f} (unshifted {row['twin_unshifted']:.2f}), pass itself {row['pass']:.2f}; "
        f"{row['left']:.2f} left of {row['rms']:.2f} m/s²",
        file=out,
        flush=True,
    )
    for own in row["felt"]:
        text = own.get("error") or f"{own['felt']:+.2f} m, its receiver {own['receiver']:+.2f} m"
        print(f"    phone {own['seed']}: {text}", file=out, flush=True)


def main() -> None:
    """Both recordings."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SUSPENSION_TWIN_DATA", ROOT / "../shared/data"))
    )
    parser.add_argument(
        "--pairs", type=int, metavar="N", help="the first N of each recording; all by default"
    )
    parser.add_argument("--felt", type=int, default=0, metavar="SEEDS", help="phones that are placed by feel")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", action="store_true")
    asked = parse_options(parser, pairs=1, felt=1)
    for name in ("rtklibexplorer_GNSS_IMU", "comma2k19_Example_1"):
        if not (asked.data / name).is_dir():
            unavailable(f"{asked.data / name} is not there: name the folder of measured data with --data")
    mapping = ROOT / "config" / "import" / "rtklibexplorer_gnss_imu.yaml"
    drive = import_drive([asked.data / "rtklibexplorer_GNSS_IMU"], mapping=mapping).drive
    result = {"rtklibexplorer": study(drive, rtk_car(drive), NEAR, True, asked)}
    drive = import_drive([asked.data / "comma2k19_Example_1"]).drive
    result["comma2k19"] = study(drive, phone_car(drive), 5.0, False, asked)
    if asked.json:
        print(json.dumps(result, indent=1))
    else:
        for name, found in result.items():
            print(f"{name}: {found['pairs']} stretches driven twice")


if __name__ == "__main__":
    main()
