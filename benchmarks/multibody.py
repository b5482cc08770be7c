# SPDX-License-Identifier: Apache-2.0
"""The twin beside a multibody car that no one here wrote: body, wheels, suspension and tyres, side by side.

    python benchmarks/multibody.py [--data DIR] [--out DIR] [--json]

The drives and their dense truth (200 Hz) come from an established multibody engine (``no_effect_added``
of ``../shared/withheld``, or of SUSPENSION_TWIN_WITHHELD). The twin sees what a user has: the bag, the road,
a twin file with generic characteristics. It is compared as given and calibrated on the drive ``reference``;
the other drives are held out. What seven degrees of freedom cannot follow is measured on the truth alone.
Figures are written to ``OUT/multibody.json``, the picture to ``OUT/multibody.png``.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from extras import unavailable
from multibody_picture import draw
from multibody_truth import AXLES, CORNERS, Truth, beyond, read_truth
from numpy.typing import NDArray
from options import parse_options
from rich.console import Console
from rich.table import Table
from scipy.signal import butter, sosfiltfilt

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.inference.observation import observe
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.models.types import Response
from suspension_twin.road import Road, load_road
from suspension_twin.vehicle.twin import Twin, load_twin

ROOT = Path(__file__).resolve().parents[1]
Floats = NDArray[np.float64]
#: Hz. Below the first a spectrum of half a minute says little, above the last the stamps of 100 Hz end.
BANDS = ((0.3, 3.0), (3.0, 8.0), (8.0, 15.0), (15.0, 40.0))
REFERENCE, HELD_OUT = "reference", ("drive_slow", "drive_other", "drive_fast")
MOVING = 1.0  # m/s


@dataclass(frozen=True, eq=False)
class Side:
    """One signal on the IMU's stamps: ``truth`` and ``twin`` (n, k), k places of the car that share a name."""

    unit: str
    truth: Floats
    twin: Floats


def sides(at: dict[str, Floats], truth: Truth, run: Response) -> dict[str, Side]:
    """Every signal that both have, by name, the truth ``at`` the run's times; heights and loads without their means."""

    def four(name: str) -> Floats:
        return np.stack([at[f"{name}_{c}"] for c in CORNERS], axis=1)

    column = np.s_[:, None]
    out = {
        "vertical acceleration": Side("m/s²", at["fz"][column], run.force[:, 2:3]),
        "longitudinal acceleration": Side("m/s²", at["fx"][column], run.force[:, 0:1]),
        "lateral acceleration": Side("m/s²", at["fy"][column], run.force[:, 1:2]),
        "roll rate": Side("rad/s", at["wx"][column], run.rate[:, 0:1]),
        "pitch rate": Side("rad/s", at["wy"][column], run.rate[:, 1:2]),
        "roll": Side("rad", at["roll"][column], run.roll[column]),
        "pitch": Side("rad", at["pitch"][column], run.pitch[column]),
    }
    travel, height, load = four("sc") / truth.ratio, four("zw"), four("Fz")
    for k, axle in enumerate(AXLES):
        of = np.s_[:, 2 * k : 2 * k + 2]
        out[f"{axle} suspension travel"] = Side("m", travel[of], run.deflection[of])
        out[f"{axle} wheel height"] = Side("m", height[of], run.wheel_z[of])
        out[f"{axle} tyre load"] = Side("N", load[of], run.tyre_force[of])
    return out


def agreement(side: Side, rate: float, moving: NDArray[np.bool_]) -> dict[str, Any]:
    """rms of the truth and of the difference, their share, correlation, and the shares by band."""

    def figures(truth: Floats, twin: Floats) -> dict[str, float]:
        truth, twin = truth[moving], twin[moving]
        truth, twin = truth - truth.mean(axis=0), twin - twin.mean(axis=0)
        rms, off = float(np.sqrt(np.mean(truth**2))), float(np.sqrt(np.mean((truth - twin) ** 2)))
        spread = float(np.sqrt(np.mean(twin**2)))
        return {
            "rms": rms,
            "difference": off,
            "share": off / rms,
            "correlation": float(np.mean(truth * twin) / (rms * spread)),
        }

    out: dict[str, Any] = {"unit": side.unit, **figures(side.truth, side.twin), "bands": []}
    for low, high in BANDS:
        taps = butter(4, [low, min(high, 0.45 * rate)], "band", fs=rate, output="sos")
        both = (sosfiltfilt(taps, x, axis=0) for x in (side.truth, side.twin))
        out["bands"].append({"low_hz": low, "high_hz": high, **figures(*both)})
    return out


def compare(
    folder: Path, name: str, twin: Twin, truth: Truth
) -> tuple[dict[str, Any], dict[str, Side], Floats]:
    """One drive under one twin: figures of every signal, the signals, and where along the road (n,) m."""
    prepared = observe(read_drive(folder / name), twin)
    run = simulate_twin(twin, prepared.road_excitation)
    # stamps are those of the IMU: what a stamp t shows happened at t - latency
    at = truth.at(run.t - prepared.road_excitation.late - truth.start)
    both = sides(at, truth, run)
    moving = at["v_fwd"] > MOVING
    ends = prepared.road_excitation.first[1:] - 1
    under = np.stack([at[f"zr_{c}"] for c in CORNERS], axis=1)
    figures = {k: agreement(s, prepared.rate, moving) for k, s in both.items()}
    off = float(np.std((prepared.road_excitation.road[ends] - under)[moving]))
    return {"signals": figures, "road_height_rms_off_m": off}, both, at["u"]


def by_situation(truth: Truth, side: Side, t: Floats, road: Road) -> dict[str, dict[str, float]]:
    """Where the misfit of the vertical acceleration lies: shares of time and of its square, by what the car does."""
    left = ((side.truth - side.twin) - np.mean(side.truth - side.twin))[:, 0] ** 2
    out = {}
    rest = truth.at(t)["v_fwd"] > MOVING
    total, time = float(left[rest].sum()), int(rest.sum())
    for name, mask in truth.situations(road).items():
        there = rest & (np.interp(t, truth.t, mask.astype(float)) > 0.5)
        out[name] = {"time": float(there.sum()) / time, "misfit": float(left[there].sum()) / total}
        rest = rest & ~there
    out["level cruising"] = {"time": float(rest.sum()) / time, "misfit": float(left[rest].sum()) / total}
    return out


def measure(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """All figures, and what the picture draws."""
    road = load_road(folder / "road.crg")
    given = load_twin(folder / "twin.yaml")
    fitted = calibrate(CalibrationRequest(str(folder / "twin.yaml"), (str(folder / REFERENCE),)))
    out: dict[str, Any] = {
        "calibrated_on": REFERENCE,
        "seconds": fitted.seconds,
        "sprung_inertia": {
            k: {
                name: getattr(t.vehicle.sprung_inertia, k)
                for name, t in (("file", given), ("found", fitted.twin))
            }
            for k in ("roll", "pitch")
        },
        "drives": {},
        "beyond_seven_degrees": {},
    }
    shown: dict[str, Any] = {}
    for name in (REFERENCE, *HELD_OUT):
        truth = read_truth(folder, name)
        row: dict[str, Any] = {"held_out": name != REFERENCE}
        for label, twin in (("given", given), ("calibrated", fitted.twin)):
            row[label], both, u = compare(folder, name, twin, truth)
            if name == "drive_fast":
                shown[label] = (both, u)
        t = truth.t
        if name == "drive_fast":
            stamps = np.interp(u, truth.columns["u"], t)
            row["misfit_by_situation"] = by_situation(truth, both["vertical acceleration"], stamps, road)
        out["drives"][name] = row
        out["beyond_seven_degrees"][name] = beyond(truth, given, road)
    return out, shown


def show(figures: dict[str, Any]) -> None:
    """Tables for people."""
    console = Console(width=150)
    for name, row in figures["drives"].items():
        head = ["", "rms of truth", "off: given", "calibr.", "share: given", "calibr.", "correl."]
        table = Table(
            *head, *[f"{b[0]:g}-{b[1]:g} Hz" for b in BANDS], title=f"{name}{', held out' * row['held_out']}"
        )
        for signal, after in row["calibrated"]["signals"].items():
            before = row["given"]["signals"][signal]
            table.add_row(
                signal,
                f"{after['rms']:.4g} {after['unit']}",
                f"{before['difference']:.3g}",
                f"{after['difference']:.3g}",
                f"{before['share']:.2f}",
                f"{after['share']:.2f}",
                f"{after['correlation']:.3f}",
                *[f"{b['share']:.2f}" for b in after["bands"]],
            )
        console.print(table)
    fast = figures["drives"]["drive_fast"]
    table = Table(
        "drive_fast, calibrated", "share of the time", "share of the misfit (vertical acceleration)"
    )
    for name, row in fast["misfit_by_situation"].items():
        table.add_row(name, f"{row['time']:.2f}", f"{row['misfit']:.2f}")
    console.print(table)
    table = Table(
        "what seven degrees cannot follow (truth alone)", *figures["drives"], title="rms, N for one axle"
    )
    rows = figures["beyond_seven_degrees"]
    for key in rows[REFERENCE]:
        table.add_row(key, *[f"{rows[name][key]:.4g}" for name in figures["drives"]])
    console.print(table)
    off = {n: 1e3 * r["calibrated"]["road_height_rms_off_m"] for n, r in figures["drives"].items()}
    console.print("road under the wheels off by " + ", ".join(f"{mm:.2f} mm ({n})" for n, mm in off.items()))


def main() -> int:
    """Measure, write the figures and the picture, print a table or with ``--json`` the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("SUSPENSION_TWIN_WITHHELD", str(ROOT.parent / "shared" / "withheld"))
    parser.add_argument("--data", type=Path, default=Path(default), help="folder that holds no_effect_added")
    parser.add_argument(
        "--out", type=Path, default=Path("out/multibody"), help="where figures and picture go"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    options = parse_options(parser)
    try:
        figures, shown = measure(options.data / "no_effect_added")
    except (SuspensionTwinError, OSError) as error:
        unavailable(str(error))
    options.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(figures, indent=2, ensure_ascii=False, allow_nan=False)
    (options.out / "multibody.json").write_text(text + "\n", encoding="utf-8")
    draw(figures, shown, options.out / "multibody.png")
    if options.json:
        print(json.dumps(figures, allow_nan=False))
    else:
        show(figures)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
