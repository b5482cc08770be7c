# SPDX-License-Identifier: Apache-2.0
"""Roads of known heights, scanned by simulated scanners, made into road files, and compared with the truth.

    python benchmarks/road_scan.py [--roads town,...] [--scanners terrestrial,mobile] [--seeds 1] [--data DIR]
                                   [--picture FILE] [--json]
    python benchmarks/road_scan.py --size 10000000 [--json]

Every road is a raster of 1 cm with a kerb on its left, grass on its right, and wet patches in both wheel paths that
return nothing. Cars pass and a person stands in the lane (``scanners.py``). Range noise is 3 mm (terrestrial) and
4 mm (mobile). In the wheel paths (0.1 m to both sides of where the wheels roll), for what ``road scan`` writes, for
its Gaussian filter on the same ground points, and for plain binning of all points with that Gaussian:

- error: rms, of the nodes with points about them; filled: rms in the small holes that were filled; open: share of the
  nodes that are marked as holes, which have no error.
- averaged noise: the range noise, as an error of height, over the square root of the points about a node; beyond it:
  the error without it, in quadrature.
- largest: the largest error beyond what the truth has within a node's distance, so that a wall between two nodes
  does not count.
- spikes: nodes whose error differs by more than 5 mm from the median of the errors 0.15 m around.
- twin: rms of the vertical acceleration at 30 km/h over that on the true road, and rms of their difference over it.

``--size`` measures time and memory of the command on so many points of the mobile scanner in a LAZ file.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy import ndimage

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from extras import unavailable  # noqa: E402
from options import parse_options  # noqa: E402
from scanners import Ground, Scan, mobile, terrestrial  # noqa: E402

from suspension_twin.addons.roads.pictures import save_picture, scan_figure  # noqa: E402
from suspension_twin.addons.roads.scan.clouds import Cloud, Georeference  # noqa: E402
from suspension_twin.addons.roads.scan.response import (  # noqa: E402
    road_responses,
    steady_path,
    vertical_acceleration,
)
from suspension_twin.addons.roads.scan.scan import FILLED, HOLE, MEASURED, ScannedRoad, road_from_scan  # noqa: E402
from suspension_twin.errors import WorkError  # noqa: E402
from suspension_twin.road.build import Centreline, grid_road  # noqa: E402
from suspension_twin.road.crg import load_road  # noqa: E402
from suspension_twin.road.recipe import make_road, parse_feature  # noqa: E402
from suspension_twin.road.road import Road  # noqa: E402
from suspension_twin.road.smoothing import smooth  # noqa: E402
from suspension_twin.vehicle.twin import load_twin  # noqa: E402

Floats = NDArray[np.float64]

BARS = {"beyond_mm": 1.5, "spike_mm": 5.0, "twin_percent": 5.0, "seconds": 60.0, "bytes": 2e9}
SCANNERS: dict[str, tuple[Callable[[Ground, int], Scan], float]] = {
    "terrestrial": (terrestrial, 0.003),
    "mobile": (mobile, 0.004),
}
SPEED = 30.0 / 3.6
#: The command in a process that tells its largest memory at its end. (``getrusage`` counts its parent's before exec.)
_MEASURED = """
import sys
from suspension_twin.cli.main import main
status = main(sys.argv[1:])
print(open("/proc/self/status").read())
sys.exit(status)
"""
_STEP, _HALF = 0.01, 8.0  # m, of the raster
_AROUND = 3.0  # m of the raster before and after the path


@dataclass(frozen=True, eq=False)
class Site:
    """A road of known heights: the raster ``ground``, and the path from x = 0 to ``length`` m."""

    name: str
    ground: Ground
    length: float

    def truth(self, x: Floats, y: Floats) -> Floats:
        """True heights in m."""
        at = [(x - self.ground.x0) / _STEP, (y - self.ground.y0) / _STEP]
        out: Floats = ndimage.map_coordinates(self.ground.z, at, order=1, mode="nearest")
        return out

    def road(self, step: float = 0.01, across: float = 0.02) -> Road:
        """The true lane as a road."""
        u, v = np.arange(0.0, self.length + 1e-9, step), np.arange(-2.0, 2.0 + 1e-9, across)
        x, y = np.meshgrid(u, v, indexing="ij")
        return grid_road(self.truth(x, y), step, v, name="truth")


def make_site(name: str, road: Road, length: float, seed: int, begin: float = 0.0) -> Site:
    """A road from ``begin`` on, repeated to and fro to ``length`` m, with what stands beside it."""
    x = np.arange(-_AROUND, length + _AROUND, _STEP)
    y = np.arange(-_HALF, _HALF, _STEP)
    period = road.length - begin
    u = np.abs((x + period) % (2.0 * period) - period) + begin + road.u_first
    edge = 0.5 * road.width - 1e-6
    known = np.isfinite(road.z).all(axis=0)
    low, high = road.v[known].min() + 1e-6, road.v[known].max() - 1e-6
    v = np.clip(y, max(-edge, low), min(edge, high))
    uu, vv = np.meshgrid(u, v, indexing="ij")
    z = road.heights_uv(uu, vv)
    z = z + 0.12 * (y >= 3.0)
    rng = np.random.default_rng([seed, 3])
    grass = np.zeros(z.shape, dtype=np.bool_)
    grass[:, y < -2.7] = True
    wet = np.zeros(z.shape, dtype=np.bool_)
    for _ in range(max(2, round(length / 15.0))):
        at, side = rng.uniform(0.0, length), rng.choice([-0.75, 0.75, 0.0])
        a, b = rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.4)
        wet |= ((x[:, None] - at) / a) ** 2 + ((y[None, :] - side) / b) ** 2 < 1.0
    return Site(name, Ground(z, _STEP, float(x[0]), float(y[0]), grass, wet), length)


def sites(data: Path, seed: int) -> dict[str, Any]:
    """Ways to make every site, by name."""
    features = [
        parse_feature("bump", "0.9x0.05@12"),
        parse_feature("pothole", "0.6x0.06@24:0.4..1.2"),
        parse_feature("hump", "3.7x0.1@34"),
        parse_feature("pothole", "0.4x0.04@46:-1.1..-0.5"),
    ]
    courses = data / "projectchrono" / "crg_roads"

    def town() -> Site:
        made = make_road(60.0, 8.0, features=features, iso="B", seed=seed, step=_STEP, v_step=0.05)
        return make_site("town", made, 60.0, seed)

    def of(name: str, path: Path, length: float, begin: float = 0.0) -> Any:
        return lambda: make_site(name, load_road(path), length, seed, begin)

    return {
        "town": town,
        "crg_road": of("crg_road", HERE.parent / "bags" / "crg_road" / "road.crg", 60.0, 25.0),
        "belgian_block": of("belgian_block", data / "ASAM_OpenCRG" / "belgian_block.crg", 40.0),
        "rms_course_1in": of("rms_course_1in", courses / "detrended_rms_course_1in.crg", 60.0, 110.0),
        "rms_course_2in": of("rms_course_2in", courses / "detrended_rms_course_2in.crg", 60.0, 110.0),
        "halfround_4in": of("halfround_4in", courses / "halfround_4in.crg", 60.0, 20.0),
        "Horstwalde": of("Horstwalde", courses / "Horstwalde.crg", 48.0, 101.0),
    }


def as_cloud(scan: Scan) -> list[tuple[Cloud, Georeference]]:
    """A scan in memory as the package takes it from a file, in pieces."""
    pieces = np.array_split(scan.points, max(1, len(scan.points) // 1_000_000))
    return [(Cloud(Path("simulated"), len(scan.points), None, lambda: iter(pieces)), Georeference())]


def plain_binning(points: Floats, like: Road, sigma: float = 0.1) -> Road:
    """Means of all points about each node, empty ones interpolated along the road, and a Gaussian filter."""
    nu, nv = like.z.shape
    dv = float(like.v[1] - like.v[0])
    i = np.rint(points[:, 0] / like.u_step).astype(np.int64)
    j = np.rint((points[:, 1] - like.v[0]) / dv).astype(np.int64)
    inside = (i >= 0) & (i < nu) & (j >= 0) & (j < nv)
    flat = i[inside] * nv + j[inside]
    count = np.bincount(flat, minlength=nu * nv).reshape(nu, nv)
    z = np.bincount(flat, points[inside, 2], minlength=nu * nv).reshape(nu, nv) / np.maximum(count, 1)
    rows = np.arange(nu)
    for k in range(nv):
        good = count[:, k] > 0
        if good.any():
            z[:, k] = np.interp(rows, rows[good], z[good, k])
    return smooth(replace(like, z=z).with_line(z=np.zeros(nu)), sigma)


def averaged_noise(scan: Scan, like: Road, noise: float, paths: NDArray[np.bool_]) -> float:
    """The range noise averaged over the points about each node, rms over the long sections ``paths``, in m."""
    nu, nv = like.z.shape
    dv = float(like.v[1] - like.v[0])
    real = scan.kind == 1
    i = np.rint(scan.points[real, 0] / like.u_step).astype(np.int64)
    j = np.rint((scan.points[real, 1] - like.v[0]) / dv).astype(np.int64)
    inside = (i >= 0) & (i < nu) & (j >= 0) & (j < nv)
    flat = i[inside] * nv + j[inside]
    count = np.bincount(flat, minlength=nu * nv).reshape(nu, nv)[:, paths]
    steep = np.bincount(flat, scan.steep[real][inside] ** 2, minlength=nu * nv).reshape(nu, nv)[:, paths]
    seen = count > 0
    return noise * float(np.sqrt(np.mean(steep[seen] / count[seen] ** 2)))


def compare(site: Site, road: Road, used: NDArray[np.bool_], paths: NDArray[np.bool_]) -> dict[str, float]:
    """Errors of a road in the long sections ``paths``, where ``used`` (nu, nv), in mm."""
    u, v = np.meshgrid(road.u, road.v, indexing="ij")
    x, y = road.uv_to_xy(u.ravel(), v.ravel())
    true = site.truth(x, y).reshape(u.shape)
    z = road.heights_grid
    error = 1e3 * (z - true)
    # The range of the truth within a node's distance.
    reach = [math.ceil(s / _STEP) for s in (road.u_step, float(road.v[1] - road.v[0]))]
    size = [2 * r + 1 for r in reach]
    i = np.rint((x - site.ground.x0) / _STEP).astype(np.int64)
    j = np.rint((y - site.ground.y0) / _STEP).astype(np.int64)
    low = ndimage.minimum_filter(site.ground.z, size)[i, j].reshape(u.shape)
    high = ndimage.maximum_filter(site.ground.z, size)[i, j].reshape(u.shape)
    beyond = 1e3 * (np.maximum(z - high, 0.0) - np.maximum(low - z, 0.0))
    around = max(3, round(0.3 / road.u_step) | 1)
    single = np.abs(beyond - ndimage.median_filter(beyond, (around, 1), mode="nearest"))
    at = used & paths[None, :]
    return {
        "error_mm": float(np.sqrt(np.mean(error[at] ** 2))),
        "largest_mm": float(np.abs(beyond[at]).max()),
        "spikes": int((single[at] > BARS["spike_mm"]).sum()),
        "largest_spike_mm": float(single[at].max()),
    }


def case(site: Site, scanner: str, seed: int, picture: Path | None = None) -> dict[str, Any]:
    """One road under one scanner."""
    scan_it, noise = SCANNERS[scanner]
    scan = scan_it(site.ground, seed)
    line = Centreline([0.0, site.length], [0.0, 0.0], 0.025)
    start = time.perf_counter()
    found = road_from_scan(as_cloud(scan), line, "line")
    seconds = time.perf_counter() - start
    car = load_twin(HERE.parent / "config" / "twins" / "ford_mondeo_mk4.yaml").with_changes({"road": None})
    half_track = 0.5 * float(np.ptp(car.vehicle.wheel_positions[:, 1]))
    paths = np.abs(np.abs(found.road.v) - half_track) < 0.1
    used = found.status == MEASURED
    filled = (found.status == FILLED) & paths[None, :]
    roads = {
        "road scan": found.road,
        "Gaussian": found.gaussian,
        "plain": plain_binning(scan.points, found.road),
    }
    drive = steady_path(found.road, car, SPEED)
    true = vertical_acceleration(site.road(), car, drive)
    level = float(np.sqrt(np.mean(true**2)))
    averaged = 1e3 * averaged_noise(scan, found.road, noise, paths)
    row: dict[str, Any] = {
        "road": site.name,
        "scanner": scanner,
        "seed": seed,
        "points": len(scan.points),
        "not_ground": int((scan.kind != 1).sum()),
        "seconds": seconds,
        "step_m": found.facts["step"],
        "open_percent": 100.0 * float((found.status == HOLE)[:, paths].mean()),
        "filled_percent": 100.0 * float((found.status == FILLED)[:, paths].mean()),
        "averaged_noise_mm": averaged,
        "coverage_90": coverage(site, found, used, paths),
        "twin_rms": level,
    }
    for name, road in roads.items():
        figures: dict[str, float] = compare(site, road, used & np.isfinite(road.heights_grid), paths)
        figures["beyond_mm"] = math.sqrt(max(0.0, figures["error_mm"] ** 2 - averaged**2))
        row[name] = figures
        try:
            a = vertical_acceleration(road, car, drive)
        except WorkError:  # a person in the road throws the twin into the air
            continue
        figures["twin_percent"] = 100.0 * (float(np.sqrt(np.mean(a**2))) / level - 1.0)
        figures["twin_difference_percent"] = 100.0 * float(np.sqrt(np.mean((a - true) ** 2))) / level
    if filled.any():
        row["road scan"]["filled_mm"] = compare(site, found.road, filled, paths)["error_mm"]
    if picture is not None:
        shown = {"edge-preserving": found.edges, "Gaussian, 0.1 m": found.gaussian, "truth": site.road()}
        save_picture(scan_figure(found, road_responses(shown, "edge-preserving", car, drive)), picture)
    return row


def coverage(site: Site, found: ScannedRoad, used: NDArray[np.bool_], paths: NDArray[np.bool_]) -> float:
    """Share of the true heights within the 90 % intervals."""
    u, v = np.meshgrid(found.road.u, found.road.v, indexing="ij")
    x, y = found.road.uv_to_xy(u.ravel(), v.ravel())
    error = found.edges.heights_grid - site.truth(x, y).reshape(u.shape)
    at = used & paths[None, :]
    return float((np.abs(error[at]) < 1.645 * found.surface.sigma[at]).mean())


def size(points: int, seed: int = 1) -> dict[str, Any]:
    """Time and memory of the command on a LAZ file of at least so many points."""
    import laspy

    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        length = 60.0 * points / 1.64e6
        made = make_road(length, 8.0, iso="C", seed=seed, step=0.02, v_step=0.1)
        scan = mobile(make_site("size", made, length, seed).ground, seed)
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales = np.full(3, 1e-4)
        data = laspy.LasData(header)
        data.x, data.y, data.z = scan.points.T
        data.write(where / "cloud.laz")
        count = len(scan.points)
        del scan, data
        (where / "line.csv").write_text(f"x,y\n0,0\n{length},0\n")
        command = [sys.executable, "-c", _MEASURED, "road", "scan", str(where / "cloud.laz")]
        command += ["--path", str(where / "line.csv"), "--out", str(where / "road.crg"), "--picture"]
        times, peak = [], 0
        for k in range(2):  # the first run may compile
            start = time.perf_counter()
            done = subprocess.run(
                [*command, str(where / "road.png"), *(["--force"] if k else [])],
                capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(HERE.parent)},
            )  # fmt: skip
            times.append(time.perf_counter() - start)
            if done.returncode:
                raise SystemExit(done.stderr)
            peak = max(peak, 1024 * int(done.stdout.rpartition("VmHWM:")[2].split()[0]))
        return {
            "points": count, "length_m": length, "file_bytes": (where / "cloud.laz").stat().st_size,
            "first_seconds": times[0], "seconds": times[1], "bytes": peak,
        }  # fmt: skip


def show(rows: list[dict[str, Any]]) -> None:
    """The cases for people."""
    console = Console(width=150)
    table = Table(title="In the wheel paths")
    for name in (
        "road", "scanner", "Mpoints", "open %", "noise [mm]", "version", "error [mm]", "beyond [mm]", "filled [mm]",
        "largest [mm]", "spikes", "twin rms %", "twin difference %",
    ):  # fmt: skip
        table.add_column(name, justify="left" if name in ("road", "scanner", "version") else "right")
    for row in rows:
        for k, name in enumerate(("road scan", "Gaussian", "plain")):
            f = row[name]
            head = (
                row["road"],
                row["scanner"],
                f"{row['points'] / 1e6:.1f}",
                f"{row['open_percent']:.1f}",
                f"{row['averaged_noise_mm']:.2f}",
            )
            table.add_row(
                *(head if k == 0 else ("",) * 5), name, f"{f['error_mm']:.2f}", f"{f['beyond_mm']:.2f}",
                f"{f['filled_mm']:.2f}" if "filled_mm" in f else "", f"{f['largest_mm']:.1f}", str(f["spikes"]),
                *twin_words(f),
            )  # fmt: skip
    console.print(table)
    covered = ", ".join(f"{row['road']} {row['scanner']} {100 * row['coverage_90']:.0f} %" for row in rows)
    console.print(f"true heights within the 90 % intervals: {covered}")


def twin_words(f: dict[str, Any]) -> tuple[str, str]:
    """What the twin feels, in words."""
    if "twin_percent" not in f:
        return "diverges", ""
    return f"{f['twin_percent']:+.1f}", f"{f['twin_difference_percent']:.1f}"


def main() -> None:
    """All roads under all scanners."""
    given = os.environ.get("SUSPENSION_TWIN_DATA")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--roads", help="names with commas; all without it")
    parser.add_argument("--scanners", default="terrestrial,mobile")
    parser.add_argument("--seeds", default="1")
    parser.add_argument("--size", type=int, metavar="POINTS")
    parser.add_argument(
        "--data", type=Path, default=Path(given) if given else HERE.parents[1] / "shared" / "data"
    )
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--json", action="store_true")
    asked = parse_options(parser, roads="town", scanners="mobile")
    if asked.size:
        row = size(asked.size)
        if asked.json:
            print(json.dumps({"bars": BARS, "size": row}, indent=1))
        else:
            print(
                f"{row['points'] / 1e6:.1f} million points, {row['file_bytes'] / 1e6:.0f} MB, {row['length_m']:.0f} m: "
                f"{row['seconds']:.1f} s, {row['bytes'] / 1e9:.2f} GB"
            )
        return
    rows = []
    for seed in (int(s) for s in asked.seeds.split(",")):
        makers = sites(asked.data, seed)
        for name in asked.roads.split(",") if asked.roads else makers:
            if name not in makers:
                raise SystemExit(f"{name} is not one of {', '.join(makers)}")
            try:
                site = makers[name]()
            except OSError as error:
                unavailable(f"{error}: name the folder of measured data with --data")
            for scanner in asked.scanners.split(","):
                rows.append(case(site, scanner, seed, asked.picture))
                print(f"{name} {scanner} {seed}", json.dumps(rows[-1]), file=sys.stderr, flush=True)
    if asked.json:
        print(json.dumps({"bars": BARS, "cases": rows}, indent=1))
    else:
        show(rows)


if __name__ == "__main__":
    main()
