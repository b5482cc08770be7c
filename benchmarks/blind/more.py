# SPDX-License-Identifier: Apache-2.0
"""What settles an answer: a drive more, and the drive on which the twin was calibrated.

Of every case that was answered ``suspected`` or ``unknown`` the reality drives what was proposed.

The drive goes over the road of the case at the proposed speed, on a lane beside the others', with the same fault. The
case is then diagnosed anew with it, as ``diagnose --add`` does. What was proposed over another road is not driven.

Every case whose twin was calibrated beforehand is diagnosed anew with the drive of that calibration as a reference.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from blind import ask, phone, seal
from blind.faults import OF_THE_CLOCK, without_road
from blind.folder import RUN, base_faults
from blind.plan import MEASURED, Spec
from blind.score import figures as every, row_of
from blind.world import Plan, drive_plan, make_world
from suspension_twin.drive.write import write_drive

OPEN = ("suspected", "unknown")
_SURE = ("effect", "partly")
_SOUND = ("no_gap", "recalibration")
NAME, REFERENCE = "drive_more", "reference"


def proposed(answer: Path) -> dict[str, Any] | None:
    """The proposal of an answer that is open, where it is a drive over the road of the case."""
    file = answer / "diagnosis.json"
    if not file.is_file():
        return None
    document = json.loads(file.read_text(encoding="utf-8"))
    drive = document.get("next_drive", {})
    return drive if document["verdict"] in OPEN and drive and "road" not in drive else None


def driven(spec: Spec, label: dict[str, Any], kmh: float, folder: Path) -> None:
    """Write the proposed drive of a case."""
    world = make_world(spec.world, spec.right, spec.scene)
    faults = {**base_faults(spec, label["faults"]), **label["faults"]}
    moving = without_road(faults)
    rng = np.random.default_rng([spec.world, 11])
    lane = world.plans["drive_fast"].lane + float(rng.uniform(-0.1, 0.1))
    v = kmh / 3.6
    plan: Plan = drive_plan(rng, v, v, len(world.plans), spec.world, lane)
    motion = RUN[spec.reality](world, plan, {k: f for k, f in moving.items() if k not in OF_THE_CLOCK})
    write_drive(phone.record(world, plan, motion, moving, NAME), folder)


def settle(cases: list[Spec], out: Path, tell: Callable[[str], None]) -> None:
    """Drive and diagnose again; what is there stays."""
    known, digest = seal.labels(out), seal.sealed(out)
    asked = [c for c in cases if c.name in known and c.reality != MEASURED and not c.planar]
    for spec in asked:
        drive = proposed(out / "answers" / spec.name)
        if drive is None:
            continue
        folder = out / "more" / f"{spec.name}_{drive['speed_kmh']:g}"
        if not (folder / NAME).is_dir():
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(out / "cases" / spec.name, folder)
            driven(spec, known[spec.name], drive["speed_kmh"], folder / NAME)
        record = ask.ask(folder, out / "answers_more" / spec.name, digest)
        tell(
            f"{spec.name} once more at {drive['speed_kmh']:g} km/h {record['seconds']:.0f} s {record['error']}"
        )


def refer(cases: list[Spec], out: Path, tell: Callable[[str], None]) -> None:
    """Diagnose the calibrated twins again with the drive of their calibration; what is there stays."""
    known, digest = seal.labels(out), seal.sealed(out)
    for spec in cases:
        drive = out / "sealed" / spec.name / REFERENCE
        if not spec.calibrated or spec.name not in known or not drive.is_dir():
            continue
        folder = out / "referred" / spec.name
        if not (folder / REFERENCE).is_dir():
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(out / "cases" / spec.name, folder)
            shutil.copytree(drive, folder / REFERENCE)
        record = ask.ask(folder, out / "answers_referred" / spec.name, digest)
        tell(f"{spec.name} with its reference {record['seconds']:.0f} s {record['error']}")


def compared(cases: Iterable[Spec], out: Path) -> dict[str, Any]:
    """Figures of the calibrated twins alone and with the drive of their calibration, and what was said of each case."""
    labels = seal.labels(out)
    ways = {"calibrated": "answers", "with its reference": "answers_referred"}
    both = [
        [row_of(labels[spec.name], out / folder / spec.name, lambda: None) for folder in ways.values()]
        for spec in cases
        if spec.name in labels and (out / "answers_referred" / spec.name / "record.json").is_file()
    ]
    return {
        "cases": len(both),
        "figures": {name: every([pair[k] for pair in both])["figures"] for k, name in enumerate(ways)},
        "rows": [
            {
                "case": pair[0]["case"],
                "truth": pair[0]["truth"],
                "severity": pair[0]["severity"],
                **{
                    name: [
                        row["verdict"],
                        row["top"],
                        *(round(row["chances"].get(t, 0.0), 3) for t in row["truth"]),
                    ]
                    for name, row in zip(ways, pair, strict=True)
                },
            }
            for pair in both
        ],
    }


def compared_text(result: dict[str, Any]) -> str:
    """The table for people."""
    names = list(result["figures"])
    lines = [f"{result['cases']} calibrated twins{'':<13s}" + "".join(f"{n:>20s}" for n in names)]
    for key in ("top1", "sure_or_suspected", "top1_ranked", "wrong_name", "null_no_gap"):
        values = [f[key] for f in result["figures"].values()]
        said = ["" if v["value"] is None else f"{v['value']:.2f} of {v['n']}" for v in values]
        lines.append(f"  {key:<32s}" + "".join(f"{s:>20s}" for s in said))
    for row in result["rows"]:
        told = "  ->  ".join(" ".join(map(str, row[name])) for name in names)
        lines.append(f"  {' + '.join(row['truth']) or 'null':<24s} {told}")
    return "\n".join(lines)


def figures(cases: Iterable[Spec], out: Path) -> dict[str, Any]:
    """Of the cases that were open: what the drive made of them, by what is true."""
    labels = seal.labels(out)
    rows = []
    for spec in cases:
        files = [out / name / spec.name / "diagnosis.json" for name in ("answers", "answers_more")]
        if spec.name not in labels or not all(f.is_file() for f in files):
            continue
        before, after = (json.loads(f.read_text(encoding="utf-8")) for f in files)
        truth = () if spec.kind in ("outside", "excluded") else spec.effects
        rows.append(
            {
                "case": spec.name,
                "kind": spec.kind,
                "truth": list(spec.effects),
                "kmh": before["next_drive"]["speed_kmh"],
                "before": _said(before),
                "after": _said(after),
                "settled": _settled(spec.kind, truth, after),
                "wrong": after["verdict"] in _SURE and not set(after["combination"]) <= set(truth),
            }
        )
    named = [r for r in rows if r["kind"] == "single"]
    return {
        "open_and_driven": len(rows),
        "settled_rightly": sum(r["settled"] for r in rows),
        "named_wrongly": sum(r["wrong"] for r in rows),
        "single": len(named),
        "single_named": sum(r["settled"] for r in named),
        "rows": rows,
    }


def text_of(result: dict[str, Any]) -> str:
    """The table for people."""
    lines = [
        f"{result['open_and_driven']} open cases with a proposed drive: {result['settled_rightly']} settled rightly, "
        f"{result['named_wrongly']} named wrongly; of {result['single']} single causes {result['single_named']} named"
    ]
    for row in result["rows"]:
        before, after = (" ".join(map(str, row[k])) for k in ("before", "after"))
        lines.append(
            f"  {' + '.join(row['truth']) or 'null':<24s} {row['kmh']:3.0f} km/h  {before}  ->  {after}"
        )
    return "\n".join(lines)


def _said(document: dict[str, Any]) -> list[Any]:
    first = document["causes"][0]
    return [document["verdict"], first["effect"], round(first["presence"], 3)]


def _settled(kind: str, truth: tuple[str, ...], after: dict[str, Any]) -> bool:
    verdict = str(after["verdict"])
    if kind == "null":
        return verdict in _SOUND
    if not truth:
        return verdict == "unknown"
    return verdict in _SURE and set(after["combination"]) == set(truth)
