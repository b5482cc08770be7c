# SPDX-License-Identifier: Apache-2.0
"""The table: answers gathered, measured on the sealed drives, scored, printed and kept."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from blind import ROOT, ask, baselines, measured, picture, seal
from blind.plan import Spec
from blind.score import Row, figures, row_of
from blind.values import told_values

RESULTS = ROOT / "benchmarks" / "results"
_TITLES = {
    "top1": "top-1 (named and first)",
    "sure_or_suspected": "sure or suspected, and first",
    "suspected_wrong": "suspected and wrong",
    "top1_ranked": "ranked first, whatever the verdict",
    "top3": "among the first three",
    "lowest_effect": "lowest top-1 of an effect",
    "in_set": "in the answered set",
    "set_size": "mean size of the set",
    "faint_named_right": "below 1.5 floors: named rightly",
    "faint_named_wrong": "below 1.5 floors: named wrongly",
    "false_alarms": "null: a cause named",
    "null_no_gap": "null: no gap or recalibration",
    "null_suspected": "null: a cause suspected",
    "unknown_outside": "outside the library: unknown",
    "unknown_excluded": "taken out of the library: unknown",
    "unknown_or_partly": "both: unknown or partly",
    "pairs_exact": "pairs exact",
    "pairs_no_wrong": "pairs without a wrong member",
    "stretch_top1": "on one stretch only: top-1",
    "stretch_unknown": "the same: unknown",
    "stretch_there": "the same: what it is like there is what it is",
    "recalibration_direction": "recalibration: springs and dampers in the right direction",
    "recalibration_error_median": "the same, change off by, median (points)",
    "recalibration_in_interval": "the same, in their 90 % interval",
    "wrong_name": "a wrong cause named for sure",
    "sure_and_wrong": "probability above 0.9 and wrong",
    "shrink_error_median": "shrink, predicted to measured, median (points)",
    "shrink_error_p95": "the same, 95th percentile",
    "shrink_in_interval": "measured shrink in the interval",
    "parameter_error_median": "parameters of what is rightly named off by, median",
    "parameter_in_interval": "parameters in their 90 % interval",
    "road_m_median": "place out of the true stretch, median (m)",
    "time_s_median": "time out of it, median (s)",
    "octaves_median": "frequency off, median (octaves)",
    "seconds_two_drives": "seconds a case of two drives, median",
    "seconds_worst": "seconds, worst",
    "cpu_seconds_median": "processor seconds, median",
    "memory_mb": "memory, worst (MB)",
    "failed": "failed",
}


def _further(case: Path, answer: Path, sealed: Path) -> tuple[float, float] | None:
    """Gaps above the noise on the sealed drive: of the twin as it stood and of the twin that was answered."""
    kept, twin = answer / "further.json", answer / "twin.yaml"
    if kept.is_file():
        before, after = json.loads(kept.read_text())
        return before, after
    if not twin.is_file() or not sealed.is_dir():
        return None
    from suspension_twin.drive.read import read_drive
    from suspension_twin.errors import SuspensionTwinError
    from suspension_twin.inference.simulated import simulate_drive
    from suspension_twin.vehicle.twin import load_twin

    start = load_twin(case / "twin.yaml")
    try:
        if start.road is None:
            channel = json.loads((answer / "diagnosis.json").read_text())["gap"]["channel"]
            above = [measured.planar_gap(sealed, file, channel) for file in (case / "twin.yaml", twin)]
        else:
            drive = read_drive(sealed)
            both = [start, load_twin(twin).model_copy(update={"road": start.road})]
            gaps = [simulate_drive(drive, t).gap for t in both]
            above = [float(np.sqrt(max(g.rms**2 - g.noise_rms**2, 0.0))) for g in gaps]
    except SuspensionTwinError:
        return None
    kept.write_text(json.dumps(above) + "\n", encoding="utf-8")
    return above[0], above[1]


def gather(cases: list[Spec], out: Path, tell: Callable[[str], None]) -> list[Row]:
    """A row for every case that has an answer."""
    labels = seal.labels(out)
    rows = []
    for spec in cases:
        answer = out / "answers" / spec.name
        if spec.name not in labels or not (answer / "record.json").is_file():
            continue
        case, sealed = out / "cases" / spec.name, out / "sealed" / spec.name / "sealed"
        rows.append(row_of(labels[spec.name], answer, lambda c=case, a=answer, s=sealed: _further(c, a, s)))  # type: ignore[misc]
        rows[-1]["values"] = told_values(labels[spec.name], case, answer)
    tell(f"{len(rows)} of {len(cases)} cases have an answer")
    return rows


def report(cases: list[Spec], options: argparse.Namespace, tell: Callable[[str], None]) -> None:
    """Score, print and, where asked, keep."""
    rows = gather(cases, options.out, tell)
    if not rows:
        raise SystemExit(f"{options.out}: nothing is diagnosed yet")
    seals = [seal.sealed(options.out)]
    result = _result(rows, seals, options.seeds, len(cases))
    if options.baselines:
        result["baselines"] = baselines.compare(rows, options.out, options.baselines, tell)
    picture.draw(rows, result, options.out / "confusion.png")
    if options.keep:
        _keep(rows, result, options.add, options.receiver)
    if options.json:
        print(json.dumps(result))
    else:
        print(text_of(result))
        print(f"picture: {options.out / 'confusion.png'}")


def _result(rows: list[Row], seals: list[str], seeds: str, planned: int) -> dict[str, Any]:
    return {
        "seeds": seeds,
        "commit": sorted({r["commit"] for r in rows}),
        "scored_at_commit": ask.commit(),
        "labels_sha256": seals,
        "cases": len(rows),
        "planned": planned,
        **figures(rows),
        "realities": {
            name: figures([r for r in rows if r["reality"] == name])["figures"]
            for name in sorted({r["reality"] for r in rows})
        },
    }


def _keep(rows: list[Row], result: dict[str, Any], add: bool, receiver: str = "rtk") -> None:
    """Write the table, its rows and the picture; with ``add`` beside the answers to other cases that were kept."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    file = RESULTS / f"blind_{result['seeds']}{'' if receiver == 'rtk' else f'_{receiver}'}.json"
    if add and file.is_file():
        before, new = json.loads(file.read_text(encoding="utf-8")), {r["case"] for r in rows}
        known = before["labels_sha256"]
        seals = [*([known] if isinstance(known, str) else known), *result["labels_sha256"]]
        rows = [*(r for r in before["rows"] if r["case"] not in new), *rows]
        planned = max(before["planned"], result["planned"], len(rows))
        result = _result(rows, list(dict.fromkeys(seals)), result["seeds"], planned)
    text = json.dumps({**result, "rows": [_short(r) for r in rows]}, indent=1, sort_keys=False)
    file.write_text(text + "\n", encoding="utf-8")
    picture.draw(rows, result, file.with_suffix(".png"))


def _short(row: Row) -> Row:
    keep = {k: v for k, v in row.items() if k != "chances"}
    return {**keep, "chances": {k: round(v, 4) for k, v in row["chances"].items() if v >= 0.005}}


def text_of(result: dict[str, Any]) -> str:
    """The table for people."""
    lines = [
        f"{result['cases']} of {result['planned']} cases, {result['seeds']} seeds, commit "
        f"{', '.join(result['commit'])}",
        "",
    ]
    for key, f in result["figures"].items():
        value = "-" if f["value"] is None else f"{f['value']:.3g}"
        lines.append(f"{_TITLES[key]:<48s} {value:>8s}  n={f['n']:<4d} {f['bar']}")
    lines += ["", "top-1 by effect at 1.5 floors and above:"]
    lines += [f"  {e:<20s} {v['top1']:5.2f}  n={v['n']}" for e, v in result["by_effect"].items()]
    lines += ["", "probability said, share right:"]
    lines += [f"  {b['said']:.3f}  {b['right']:.3f}  n={b['n']}" for b in result["reliability"]]
    if "baselines" in result:
        lines += ["", "beside (single effects at 1.5 floors and above | null with a cause named):"]
        for name, b in result["baselines"].items():
            alarm = "-" if b["false_alarms"] is None else f"{b['false_alarms']:.2f}"
            right = "-" if b["top1"] is None else f"{b['top1']:.2f}"
            lines.append(f"  {name:<34s} top-1 {right} n={b['n']}   false alarms {alarm} n={b['nulls']}")
    return "\n".join(lines)
