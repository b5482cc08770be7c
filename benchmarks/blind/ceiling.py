# SPDX-License-Identifier: Apache-2.0
"""The ceiling: the same cases with the package's own model as the reality.

The twin of a case gets the true effect at its true size and is calibrated on the drives that show it. What it then
leaves of a drive is the discrepancy between model and reality, and the noise. A drive is made anew as what this twin
feels on it plus that residual, its sign drawn anew every few seconds: as large, where it was large, with the same
spectrum, but no longer coherent with the road. The case is diagnosed again with such drives, from the twin file that it
came with. What is then named is what the decision can name where the model is complete but for noise of that size.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from blind import ask, seal
from blind.plan import MEASURED, Spec
from blind.score import TURNED, UNSIGNED, figures, row_of
from blind.world import Floats
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, ImuData
from suspension_twin.drive.write import write_drive
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.models.sensor import to_sensor_axes
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

#: s between two signs of the residual: an event of the road, as long as the body rings after it.
BLOCK = 2.0
SHOWN = ("top1", "sure_or_suspected", "top1_ranked", "suspected_wrong")


def true_twin(case: Path, label: dict[str, Any], folder: Path) -> Twin:
    """The twin of a case with the true effect, calibrated on the drives that show it."""
    given = load_twin(case / "twin.yaml")
    effects = [
        {
            "id": effect,
            "parameters": {
                name: -value
                if (effect, name) in TURNED
                else abs(value)
                if (effect, name) in UNSIGNED
                else value
                for name, value in values.items()
                if name in {p.name for p in EFFECTS[effect].parameters}
            },
        }
        for effect, values in label["faults"].items()
    ]
    file = folder / "with_effect.yaml"
    save_twin(given.with_changes({"effects": effects}), file)
    drives = sorted(str(p) for p in case.iterdir() if p.is_dir() and p.name.startswith("drive"))
    return calibrate(CalibrationRequest(twin=str(file), bags=tuple(drives))).twin


def remade(drive: Drive, twin: Twin, rng: np.random.Generator) -> Drive:
    """The drive as the twin feels it, plus its residual with other signs."""
    found = simulate_drive(drive, twin)
    signals, response = found.observation.signals, found.response
    t = signals.t
    count = math.ceil((t[-1] - t[0]) / BLOCK) + 1
    knots = t[0] + BLOCK * np.arange(count)
    sign = np.interp(t, knots, rng.choice([-1.0, 1.0], count))[:, None]

    def felt(measured: Floats, simulated: Floats) -> Floats:
        return to_sensor_axes(simulated + sign * (measured - simulated), twin.imu.rpy)

    imu = ImuData(t, felt(signals.force, response.force), felt(signals.rate, response.rate))
    return replace(drive, imu=imu)


def remake(spec: Spec, label: dict[str, Any], case: Path, folder: Path) -> None:
    """The case with drives of the package's own model."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(case, folder)
    twin = true_twin(case, label, folder)
    sound = twin.with_changes({"effects": []})
    rng = np.random.default_rng([spec.world, 13])
    for bag in sorted(p for p in folder.iterdir() if p.is_dir()):
        before = bag.name.startswith("reference") and not spec.alike
        own = remade(read_drive(bag), sound if before else twin, rng)
        shutil.rmtree(bag)
        write_drive(own, bag)
    for file in folder.glob("with_effect*"):
        file.unlink()


def compare(cases: list[Spec], out: Path, tell: Callable[[str], None]) -> dict[str, Any]:
    """Remake and diagnose single causes, and their figures beside those of the reality's drives."""
    known, digest = seal.labels(out), seal.sealed(out)
    both: list[tuple[Any, Any]] = []
    for spec in cases:
        answer = out / "answers" / spec.name
        if spec.kind != "single" or spec.reality == MEASURED or not (answer / "diagnosis.json").is_file():
            continue
        label, folder = known[spec.name], out / "own" / spec.name
        try:
            if not (folder / "made").is_file():
                remake(spec, label, out / "cases" / spec.name, folder)
                (folder / "made").write_text("")
            record = ask.ask(folder, out / "answers_own" / spec.name, digest)
        except (SuspensionTwinError, ValueError) as error:
            tell(f"{spec.name} {spec.effects[0]}: cannot be made of the own model: {error}")
            continue
        tell(f"{spec.name} {spec.effects[0]} {record['seconds']:.0f} s {record['error']}")
        rows = [row_of(label, where, lambda: None) for where in (answer, out / "answers_own" / spec.name)]
        both.append((rows[0], rows[1]))
    rows_of = {"reality": [a for a, _ in both], "own model": [b for _, b in both]}
    return {
        "cases": len(both),
        "figures": {name: {k: figures(rows)["figures"][k] for k in SHOWN} for name, rows in rows_of.items()},
        "rows": [
            {"case": a["case"], "truth": a["truth"], "reality": _said(a), "own model": _said(b)}
            for a, b in both
        ],
    }


def _said(row: dict[str, Any]) -> list[Any]:
    return [row["verdict"], row["top"], row.get("rank")]


def text_of(result: dict[str, Any]) -> str:
    """The table for people."""
    lines = [f"{result['cases']} single causes{'':<24s}" + "".join(f"{n:>12s}" for n in result["figures"])]
    for key in SHOWN:
        values = [f[key]["value"] for f in result["figures"].values()]
        lines.append(f"{key:<40s}" + "".join(f"{'-' if v is None else f'{v:.2f}':>12s}" for v in values))
    for row in result["rows"]:
        lines.append(
            f"  {row['truth'][0]:<20s} {json.dumps(row['reality'])}  own model {json.dumps(row['own model'])}"
        )
    return "\n".join(lines)
