# SPDX-License-Identifier: Apache-2.0
"""The road under both wheel paths from drives, beside the true road, in realities that are not the twin.

    python benchmarks/road_from_drives.py [--seeds 7001,...] [--realities newton,multibody] [--json] [--picture FILE]
    python benchmarks/road_from_drives.py --only rtk|lanes|five|phone|joint

A car of the blind benchmark is calibrated on a surveyed road of 200 m, then driven over another road of 300 m:

- ``rtk``: at 20 and 40 km/h with an RTK receiver. Error and correlation of waves between 0.5 and 10 m in each wheel
  path, share of the truth within the 90 % intervals. On a third drive at 30 km/h: what the twin leaves of the
  vertical acceleration on this road, over what it leaves on the road as surveyed (0.3 mm of noise, 5 by 10 cm). The
  drives lie up to 0.2 m beside each other, and a survey knows what lies between wheel paths; hence beside it what
  the true heights of the same two wheel paths leave.
- ``lanes``: the two drives of ``rtk``, and third drives at stated distances beside them. What the twin leaves on the
  estimate, on the survey, and on the true heights of the drive that is nearest, held to both sides; on the estimate
  corrected by the true difference between the lanes; and on what the true heights of both drives predict of the third
  lane by the coherence of an isotropic surface.
- ``five``: the two drives of ``rtk`` and three more with an RTK receiver, in lanes up to 0.2 m apart. What the twin
  leaves of the third drive, with heights on one line in each wheel path, and on several where the drives lie apart.
- ``phone``: five drives at 20 to 50 km/h with a receiver that is 2.5 m off and wanders. Correlation after the map's
  own error along the road, which no drive shows, is taken out.
- ``joint``: the two drives of ``rtk``, and a twin whose springs, dampers, tyre, masses and inertias are wrong by 8 to
  35 %. Error of the road with this twin, and with vehicle and road estimated at once; of each parameter its distance
  from the calibrated one in its own standard deviations.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import k1

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "bags")]

from options import parse_options  # noqa: E402
from road_drives_world import Site, drive_over, make_site, phone_fixes, truth_along  # noqa: E402

from suspension_twin.addons.roads.drives.drives import road_from_drives, surface_of  # noqa: E402
from suspension_twin.addons.roads.drives.estimate import (  # noqa: E402
    SEEN_BAND,
    STEP,
    RoadEstimate,
    RoadEstimateSettings,
    WheelProfiles,
)
from suspension_twin.addons.roads.drives.passes import banded, lags_along  # noqa: E402
from suspension_twin.addons.roads.drives.vehicle import PARAMETERS, scaled_twin  # noqa: E402
from suspension_twin.addons.roads.pictures import estimate_figure, save_picture  # noqa: E402
from suspension_twin.arrays import Floats  # noqa: E402
from suspension_twin.drive.types import Drive  # noqa: E402
from suspension_twin.inference.simulated import simulate_drive  # noqa: E402
from suspension_twin.road.road import Road  # noqa: E402

BARS = {
    "rms_mm": 2.0,
    "correlation": 0.97,
    "coverage": (0.85, 0.95),
    "gap_ratio": 1.5,
    "phone_correlation": 0.85,
}
SPEEDS = (20.0, 40.0, 30.0, 25.0, 35.0, 50.0)  # km/h, of the drives by their numbers
#: By what the twin of ``joint`` is wrong: logarithms of factors, and m.
WRONG = {
    "front springs": 0.15,
    "rear springs": -0.15,
    "front dampers": -0.35,
    "rear dampers": 0.30,
    "tyre stiffness": 0.08,
    "front unsprung mass": -0.08,
    "rear unsprung mass": 0.08,
    "pitch inertia": 0.10,
    "roll inertia": -0.10,
    "centre of gravity": 0.05,
}
_EDGE = 15.0  # m at both ends that are left out: the car speeds up and brakes there


def wheel_truth(site: Site, found: RoadEstimate) -> Floats:
    """True heights (2, n) m along the estimate's wheel paths, in the map."""
    out = []
    for v in (0.5 * found.profiles.track, -0.5 * found.profiles.track):
        x, y = found.profiles.road().uv_to_xy(found.profiles.u, np.full(found.profiles.u.size, v))
        out.append(truth_along(site, x, y))
    return np.array(out)


def on_one_line(found: RoadEstimate, heights: Floats) -> Road:
    """The road with heights (2, n) m of its wheel paths, held across."""
    profiles = WheelProfiles(found.profiles.line, found.profiles.track, heights[:, None])
    return surface_of(replace(found, profiles=profiles))


def compared(found: RoadEstimate) -> Any:
    """Where the heights are compared."""
    k = found.covered
    at = found.profiles.u[k]
    return k & (found.profiles.u > at[0] + _EDGE) & (found.profiles.u < at[-1] - _EDGE)


def rtk(site: Site, picture: Path | None) -> dict[str, Any]:
    """Two drives; then a third on the road that they gave."""
    drives = [drive_over(site, SPEEDS[i], i)[0] for i in (0, 1)]
    found = road_from_drives(drives, site.twin, RoadEstimateSettings())
    truth = wheel_truth(site, found)
    if picture is not None:
        save_picture(estimate_figure(found, truth), picture)
    own, true = (banded(z, STEP, *SEEN_BAND) for z in (found.profiles.middle, truth))
    sigma, k = found.sigma(), compared(found)
    out: dict[str, Any] = {}
    for i, side in enumerate(("left", "right")):
        error = own[i, k] - true[i, k]
        out[side] = {
            "rms_mm": 1e3 * float(np.std(error)),
            "truth_mm": 1e3 * float(np.std(true[i, k])),
            "correlation": float(np.corrcoef(own[i, k], true[i, k])[0, 1]),
            "coverage": float(np.mean(np.abs(error) < 1.645 * sigma[i, k])),
        }
    third = drive_over(site, SPEEDS[2], 2)[0]
    # What any road can do that is known along two wheel paths alone: the true heights there, held across.
    roads = (surface_of(found), site.survey, on_one_line(found, truth))
    left, out["measured_rms"] = gaps(third, site, roads)
    out["gap_on_estimate"], out["gap_on_survey"], out["gap_on_true_wheel_paths"] = left
    out["gap_ratio"] = left[0] / left[1]
    return out


def five(site: Site) -> dict[str, float]:
    """Five drives with an RTK receiver; then the third drive."""
    drives = [drive_over(site, SPEEDS[i], i)[0] for i in (0, 1, 3, 4, 5)]
    found = [
        road_from_drives(drives, site.twin, RoadEstimateSettings(samples=2, lines=lines))
        for lines in (False, True)
    ]
    third = drive_over(site, SPEEDS[2], 2)[0]
    left, _ = gaps(third, site, [*(surface_of(f) for f in found), site.survey])
    return {"one_line": left[0], "lines": left[1], "count": found[1].profiles.across.size, "survey": left[2]}


def path_of(site: Site, drive: Drive, found: RoadEstimate) -> tuple[float, Floats]:
    """Where (m to the left of the estimate's line) a drive was, and the true heights (2, n) m of its wheel paths."""
    path = simulate_drive(drive, site.twin, site.survey).observation.trajectory
    u, v = found.profiles.road().xy_to_uv(path.x, path.y)
    on = path.speed > 2.0
    beside = np.interp(found.profiles.u, u[on], v[on])
    true = []
    for side in (0.5, -0.5):
        x, y = found.profiles.road().uv_to_xy(found.profiles.u, side * found.profiles.track + beside)
        true.append(truth_along(site, x, y))
    return float(np.median(v[on])), np.array(true)


def lanes(site: Site) -> list[dict[str, float]]:
    """Two drives; third drives beside them."""
    drives = [drive_over(site, SPEEDS[i], i)[0] for i in (0, 1)]
    found = road_from_drives(drives, site.twin, RoadEstimateSettings())
    first, second = sorted((path_of(site, d, found) for d in drives), key=lambda p: p[0])
    usual = path_of(site, drive_over(site, SPEEDS[2], 2)[0], found)[0]
    middle = 0.5 * (first[0] + second[0]) - usual
    rows = []
    truth = wheel_truth(site, found)
    for offset in (0.0, 0.04, -0.04, 0.08, -0.08, -middle):
        third = drive_over(site, SPEEDS[2], 2, lane=middle + offset)[0]
        at, own = path_of(site, third, found)
        nearest = first if abs(at - first[0]) < abs(at - second[0]) else second
        roads = (
            surface_of(found),
            site.survey,
            *(
                on_one_line(found, z)
                for z in (nearest[1], found.profiles.middle + own - truth, predicted((first, second), at))
            ),
        )
        left = gaps(third, site, roads)[0]
        outside = max(0.0, first[0] - at, at - second[0])
        rows.append(
            {
                "beside_m": outside,
                "estimate": left[0],
                "survey": left[1],
                "true_nearest": left[2],
                "corrected": left[3],
                "predicted": left[4],
                "left": at > second[0],
                "ratio": left[0] / left[1],
            }
        )
    return sorted(rows, key=lambda r: r["beside_m"])


def predicted(known: Sequence[tuple[float, Floats]], at: float) -> Floats:
    """Heights (2, n) m of a lane ``at`` m from those of others on an isotropic surface: the best linear prediction."""
    n = known[0][1].shape[1]
    waves = np.fft.rfftfreq(2 * n, STEP)

    def alike(d: float) -> Floats:
        x = np.maximum(2.0 * np.pi * waves * abs(d), 1e-6)
        return np.asarray(x * k1(x))

    places = [v for v, _ in known]
    among = np.array([[alike(a - b) for b in places] for a in places]).transpose(2, 0, 1)
    towards = np.array([alike(a - at) for a in places]).T
    weights = np.linalg.solve(among + 1e-4 * np.eye(len(places)), towards[..., None])[..., 0]
    mirrored = np.array([np.concatenate([z, z[:, ::-1]], axis=1) for _, z in known])
    spectrum = (np.fft.rfft(mirrored, axis=2) * weights.T[:, None]).sum(axis=0)
    return np.asarray(np.fft.irfft(spectrum, 2 * n, axis=1)[:, :n])


def gaps(drive: Drive, site: Site, roads: Sequence[Road]) -> tuple[list[float], float]:
    """Rms in m/s² that the twin leaves of the vertical acceleration on each road, and rms of what was measured."""
    results = [simulate_drive(drive, site.twin, road) for road in roads]
    both = np.logical_and.reduce([r.observation.mask for r in results])
    left = []
    for result in results:
        simulated = result.observation.condition(result.response)["vertical_acceleration"]
        measured = result.observation.measured["vertical_acceleration"]
        left.append(float(np.sqrt(np.mean((measured - simulated)[both] ** 2))))
    return left, float(np.sqrt(np.mean(measured[both] ** 2)))


def phones(site: Site) -> dict[str, Any]:
    """Five drives with a phone's receiver."""
    drives = []
    for i in (0, 1, 3, 4, 5):
        drive, motion = drive_over(site, SPEEDS[i], i)
        drives.append(phone_fixes(site, drive, motion, i))
    found = road_from_drives(drives, site.twin, RoadEstimateSettings(samples=4))
    n = found.profiles.u.size
    truth = np.array(
        [
            truth_along(
                site, found.profiles.line.x, found.profiles.line.y, np.full(n, s * 0.5 * found.profiles.track)
            )
            for s in (1, -1)
        ]
    )
    k = compared(found)
    at, lag, _ = lags_along(banded(found.profiles.middle, STEP) * k, banded(truth, STEP) * k, STEP, 12.0)
    own, true = (banded(z, STEP, *SEEN_BAND) for z in (found.profiles.middle, truth))
    there = found.profiles.u + np.interp(found.profiles.u, at, lag)
    result = {"map_error_m": float(np.median(lag))}
    for i, side in enumerate(("left", "right")):
        result[f"correlation_{side}"] = float(
            np.corrcoef(own[i, k], np.interp(there, found.profiles.u, true[i])[k])[0, 1]
        )
    return result


def joint(site: Site) -> dict[str, Any]:
    """Two drives and a vehicle that is wrong; then both at once."""
    drives = [drive_over(site, SPEEDS[i], i)[0] for i in (0, 1)]
    wrong = np.array([WRONG[name] for name in PARAMETERS])
    given = scaled_twin(site.twin, wrong)
    out: dict[str, Any] = {}
    for name, twin, settings in (
        ("calibrated", site.twin, RoadEstimateSettings()),
        ("wrong", given, RoadEstimateSettings()),
        ("joint", given, RoadEstimateSettings(joint=True, iterations=10)),
    ):
        found = road_from_drives(drives, twin, settings)
        truth = wheel_truth(site, found)
        k = compared(found)
        own, true = (banded(z, STEP, *SEEN_BAND)[:, k] for z in (found.profiles.middle, truth))
        error = own - true
        out[name] = {
            "rms_mm": [1e3 * float(np.std(e)) for e in error],
            "amplitude": float((own * true).sum() / (true**2).sum()),
            "coverage": float(np.mean(np.abs(error) < 1.645 * found.sigma()[:, k])),
        }
    vehicle = found.vehicle
    assert vehicle is not None
    out["vehicle"] = {
        name: {"wrong": float(w), "found": float(v), "sigma": float(s), "z": float((v + w) / s)}
        for name, w, v, s in zip(PARAMETERS, wrong, vehicle.values, vehicle.sigma, strict=True)
    }
    out["not_separable"] = vehicle.not_separable()
    return out


def main() -> None:
    """All seeds and realities."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="7001,7002")
    parser.add_argument("--realities", default="newton,multibody")
    parser.add_argument("--only", choices=("rtk", "lanes", "five", "phone", "joint"))
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--json", action="store_true")
    asked = parse_options(parser, seeds="7001", realities="newton", only="rtk")
    rows = []
    for seed in (int(s) for s in asked.seeds.split(",")):
        for reality in asked.realities.split(","):
            site = make_site(seed, reality)
            row: dict[str, Any] = {"seed": seed, "reality": reality}
            if asked.only in (None, "rtk"):
                row["rtk"] = rtk(site, asked.picture)
            if asked.only in (None, "lanes"):
                row["lanes"] = lanes(site)
            if asked.only in (None, "five"):
                row["five"] = five(site)
            if asked.only in (None, "phone"):
                row["phone"] = phones(site)
            if asked.only in (None, "joint"):
                row["joint"] = joint(site)
            rows.append(row)
            if not asked.json:
                print_row(row)
    if asked.json:
        print(json.dumps({"bars": BARS, "cases": rows}, indent=1))


def print_row(row: dict[str, Any]) -> None:
    """One case for people."""
    print(f"{row['reality']} {row['seed']}")
    if "rtk" in row:
        r = row["rtk"]
        for side in ("left", "right"):
            s = r[side]
            print(
                f"  {side:5} error {s['rms_mm']:.2f} of {s['truth_mm']:.2f} mm rms, correlation "
                f"{s['correlation']:.3f}, 90 % intervals hold {100 * s['coverage']:.0f} %"
            )
        print(
            f"  third drive: {r['gap_on_estimate']:.3f} m/s² left on it, {r['gap_on_survey']:.3f} on the survey "
            f"({r['gap_ratio']:.2f} times), {r['gap_on_true_wheel_paths']:.3f} on the true heights of the same wheel "
            f"paths, of {r['measured_rms']:.2f}"
        )
    for one in row.get("lanes", []):
        side = ", to the left" if one["left"] else ""
        print(
            f"  {100 * one['beside_m']:.0f} cm beside both drives{side}: {one['estimate']:.3f} m/s² left, "
            f"{one['survey']:.3f} on the survey ({one['ratio']:.2f} times), {one['true_nearest']:.3f} on the true "
            f"heights of the nearest drive, {one['corrected']:.3f} corrected, {one['predicted']:.3f} predicted"
        )
    if "five" in row:
        f = row["five"]
        print(
            f"  five drives: {f['one_line']:.3f} m/s² left on one line ({f['one_line'] / f['survey']:.2f} times the "
            f"survey), {f['lines']:.3f} on {f['count']} lines ({f['lines'] / f['survey']:.2f} times)"
        )
    if "joint" in row:
        j = row["joint"]
        for name in ("calibrated", "wrong", "joint"):
            one = j[name]
            print(
                f"  {name:10} vehicle: error {one['rms_mm'][0]:.2f} and {one['rms_mm'][1]:.2f} mm rms, heights x "
                f"{one['amplitude']:.3f}, 90 % intervals hold {100 * one['coverage']:.0f} %"
            )
        for name, v in j["vehicle"].items():
            print(
                f"    {name:20} was wrong by {v['wrong']:+.2f}, changed by {v['found']:+.3f} ± {v['sigma']:.3f} "
                f"(z {v['z']:+.1f})"
            )
        for line in j["not_separable"]:
            print(f"    {line}")
    if "phone" in row:
        p = row["phone"]
        print(
            f"  phones: correlation {p['correlation_left']:.3f} and {p['correlation_right']:.3f}, "
            f"map {p['map_error_m']:.1f} m off"
        )
    sys.stdout.flush()


if __name__ == "__main__":
    main()
