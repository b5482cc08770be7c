# SPDX-License-Identifier: Apache-2.0
"""Two trucks whose published springs and dampers (Project Chrono) are the truth, for ``paper.py``.

``../shared/data/projectchrono/vehicle``: ``mtv`` and ``MAN_Kat1``, tables over ±1 m and ±1 m/s, progressive springs
and degressive dampers. The folders hold no whole vehicle; what else a twin needs is our choice and stands here.
Published tables are taken as forces at the wheel.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from suspension_twin.calibration.presets import with_table_2
from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.observation import observe
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.report import style
from suspension_twin.report.characteristics import force
from suspension_twin.report.style import COLOURS
from suspension_twin.road import bump_road, circular, write_road
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import RoadFile, Twin, parse_twin, save_twin

_ROOT = Path(__file__).resolve().parents[1]
DATA = (
    Path(os.environ.get("SUSPENSION_TWIN_DATA", _ROOT.parent / "shared" / "data"))
    / "projectchrono"
    / "vehicle"
)
#: Points of a twin's curves: where a truck's wheel goes, on the published abscissae.
_COMPRESSION = (0.1, 0.2, 0.3, 0.4)
_VELOCITY = (0.1, 0.2, 0.4, 0.8)
_CURVES = tuple(
    f"vehicle.{axle}.{part}"
    for axle in ("front", "rear")
    for part in ("spring", "damper_push", "damper_pull")
)


@dataclass(frozen=True)
class Truck:
    """Files of the two axles, and what they do not say: masses in kg, lengths in m, inertias in kg m²."""

    front: str
    rear: str
    mass: float
    wheelbase: float
    cog: tuple[float, float, float]
    inertia: tuple[float, float]
    unsprung: tuple[float, float]


TRUCKS: Mapping[str, Truck] = {
    "mtv": Truck(
        "mtv/suspension/MTV_SolidThreeLinkAxleF.json",
        "mtv/suspension/MTV_SolidThreeLinkAxleR.json",
        9500.0,
        4.1,
        (2.1, 0.0, 1.15),
        (5200.0, 21000.0),
        (480.0, 480.0),
    ),
    "MAN_Kat1": Truck(
        "MAN_Kat1/suspension/MAN_5t_FrontSolidThreeLinkAxle.json",
        "MAN_Kat1/suspension/MAN_5t_RearSolidThreeLinkAxle.json",
        11500.0,
        4.5,
        (2.2, 0.0, 1.2),
        (6500.0, 28000.0),
        (470.0, 480.0),
    ),
}


def published(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """(k, 2) spring and damper tables of an axle: deformation m or its rate m/s (extension positive) and force N."""
    text = re.sub(r"//[^\n]*", "", file.read_text(encoding="utf-8"))
    axle = json.loads(re.sub(r",(\s*[}\]])", r"\1", text))
    return np.array(axle["Spring"]["Spring Curve Data"], float), np.array(
        axle["Shock"]["Damping Curve Data"], float
    )


def true_twin(name: str) -> Twin:
    """The truck with its published curves, on the abscissae that they are given at."""
    known = TRUCKS[name]
    axles = {}
    for axle, file, unsprung in zip(
        ("front", "rear"), (known.front, known.rear), known.unsprung, strict=True
    ):
        spring, shock = published(DATA / file)
        axles[axle] = {
            "unsprung_mass": unsprung,
            "spring": _points(-spring, "compression"),
            "damper_push": _points(-shock, "velocity"),
            "damper_pull": _points(shock, "velocity"),
        }
    return parse_twin(
        {
            "vehicle": {
                "name": f"{name} with published curves",
                "mass": known.mass,
                "wheelbase": known.wheelbase,
                "front_track": 2.07,
                "rear_track": 2.07,
                "cog": list(known.cog),
                "sprung_inertia": {"roll": known.inertia[0], "pitch": known.inertia[1]},
                "tyre": {"radius": 0.57, "vertical_stiffness": 800_000.0},
                **axles,
            },
            "imu": {"position": [3.6, 0.3, 2.0]},
            "datum": {"latitude": 47.4025, "longitude": 19.284},
        }
    )


def _points(table: np.ndarray, abscissa: str) -> dict[str, list[float]]:
    """The half with positive abscissae of a (k, 2) table, rising."""
    half = table[table[:, 0] > 1e-9]
    half = half[np.argsort(half[:, 0])]
    return {abscissa: half[:, 0].round(6).tolist(), "force": half[:, 1].tolist()}


def started(truth: Twin, seed: int) -> Twin:
    """Four points for each curve, every curve a straight line 30 % above or below the truth's at its last point."""
    rng = np.random.default_rng(seed)
    changes: dict[str, object] = {}
    for key in _CURVES:
        _, axle, part = key.split(".")
        x = np.array(_COMPRESSION if part == "spring" else _VELOCITY)
        real = force(getattr(getattr(truth.vehicle, axle), part).points, x)
        middle = float(real[2] / x[2]) * (1.3 if rng.random() < 0.5 else 0.7)
        changes[f"{key}.{'compression' if part == 'spring' else 'velocity'}"] = tuple(x.tolist())
        changes[f"{key}.force"] = tuple((middle * x).tolist())
    return truth.with_changes(changes)


def truck(name: str, out: Path, seed: int) -> dict[str, Any]:
    """Calibrate on a pass over a bump and a rough road, validate on another road, draw found over published."""
    truth = true_twin(name)
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        x, y, heading = 3.0, 2.0, 0.4
        roads = {
            "bump": bump_road(
                circular(1.2, 0.10), at=25.0, length=70.0, width=6.0, step=0.02, x=x, y=y, heading=heading
            ),
            "unseen": iso8608_road("D", 95.0, seed=seed + 1, x=x, y=y, heading=heading),
        }
        speeds = {
            "bump": [(0.0, 0.0), (3.0, 0.0), (6.0, 4.2), (15.0, 4.2), (18.0, 0.0), (20.0, 0.0)],
            "unseen": [(0.0, 0.0), (3.0, 0.0), (7.0, 6.0), (15.0, 6.0), (18.0, 0.0), (20.0, 0.0)],
        }
        start = started(truth, seed)
        for drive, road in roads.items():
            write_road(road, here / f"{drive}.crg")
            write_drive(synthetic_drive(truth, road, speeds[drive], seed=seed, name=drive), here / drive)
        named = {d: RoadFile(file=here / f"{d}.crg") for d in roads}
        save_twin(start.model_copy(update={"road": named["bump"]}), here / "twin.yaml")
        asked = CalibrationRequest(str(here / "twin.yaml"), (str(here / "bump"),), seed=seed)
        found: dict[str, CalibrationResult] = {
            "paper": calibrate(replace(asked, preset="paper", bounds=_bounds(start))),
            "fast": calibrate(asked),
        }
        unseen = read_drive(here / "unseen")

        def left(twin: Twin) -> float:
            there = observe(unseen, twin.model_copy(update={"road": named["unseen"]}))
            return there.gap(there.condition(simulate_twin(there.twin, there.road_excitation))).mse

        rows: dict[str, Any] = {}
        for preset, result in found.items():
            errors = {key: _error(result, truth, key) for key in _CURVES}
            known = [e for e in errors.values() if np.isfinite(e)]
            rows[preset] = {
                "force_error_median": float(np.median(known)),
                "force_error_worst_curve": max(known),
                "force_error": errors,
                "evaluations": result.evaluations,
                "mse_unseen": left(result.twin),
                "mse_unseen_over_truths": left(result.twin) / left(truth),
            }
        style.save(_picture(name, found, truth, start), out / f"truck_{name}.png")
        return {"presets": rows, "mse_unseen_at_start": left(start), "mse_unseen_of_truth": left(truth)}


def _bounds(start: Twin) -> tuple[tuple[str, float, float], ...]:
    """Table 2's are a car's: here a quarter to four times of where each of its points starts."""
    table = with_table_2(start)
    found = []
    for key in _CURVES:
        _, axle, part = key.split(".")
        _, forces = getattr(getattr(table.vehicle, axle), part).points
        found += [(f"{key}.force.{i}", 0.25 * float(f), 4.0 * float(f)) for i, f in enumerate(forces)]
    return tuple(found)


def _picture(name: str, found: Mapping[str, CalibrationResult], truth: Twin, start: Twin) -> Figure:
    """Recovered curves over the published ones, up to where the drive went and a little beyond."""
    colours = {"paper": COLOURS["mark"], "fast": COLOURS["simulated"]}
    spans = {c.key: c.span for c in found["fast"].curves}
    with style.using():
        fig = style.figure(9.2, 6.2)
        grid = fig.subplots(2, 2, sharex="row")
        for column, axle in enumerate(("front", "rear")):
            for row, parts in enumerate((("spring",), ("damper_push", "damper_pull"))):
                axes = grid[row, column]
                axes.set_title(f"{name}, {axle} {'spring' if row == 0 else 'damper'}")
                for part in parts:
                    sign = -1.0 if part == "damper_pull" else 1.0
                    key = f"vehicle.{axle}.{part}"
                    low, high = spans[key]
                    x = np.linspace(0.0, 0.45 if row == 0 else 1.0, 300)
                    first = part == parts[0]
                    axes.axvspan(
                        sign * low,
                        sign * high,
                        color=COLOURS["extra"],
                        alpha=0.15,
                        linewidth=0,
                        label="excited" if first else None,
                    )
                    lines = {"as it started": (start, COLOURS["before"], style.LINES["before"])}
                    lines |= {n: (r.twin, colours[n], {"linewidth": 1.5}) for n, r in found.items()}
                    lines["published"] = (truth, COLOURS["truth"], style.LINES["truth"])
                    for label, (twin, colour, line) in lines.items():
                        y = force(getattr(getattr(twin.vehicle, axle), part).points, x)
                        axes.plot(
                            sign * x, sign * y / 1e3, color=colour, label=label if first else None, **line
                        )
                axes.set_xlabel("compression [m]" if row == 0 else "velocity [m/s]   ← pull · push →")
                part_of = getattr(truth.vehicle, axle)
                if row == 0:
                    axes.set_ylim(0.0, 1.2e-3 * float(force(part_of.spring.points, x[-1:])[0]))
                else:
                    axes.set_ylim(
                        *(
                            1.5e-3 * s * float(force(p.points, x[-1:])[0])
                            for s, p in ((-1, part_of.damper_pull), (1, part_of.damper_push))
                        )
                    )
            grid[0, column].set_ylabel("force [kN]")
        style.legend(fig, *grid[0, 0].get_legend_handles_labels())
    return fig


def _error(result: CalibrationResult, truth: Twin, key: str) -> float:
    """Median relative error of a curve's force over the range that the drive excited; NaN without any."""
    curve = next(c for c in result.curves if c.key == key)
    _, axle, part = key.split(".")
    inside = (curve.band.x >= max(curve.span[0], 1e-3)) & (curve.band.x <= curve.span[1])
    if not inside.any():
        return float("nan")
    real = force(getattr(getattr(truth.vehicle, axle), part).points, curve.band.x[inside])
    return float(np.median(np.abs(curve.force[inside] / real - 1.0)))
