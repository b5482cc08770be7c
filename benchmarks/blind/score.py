# SPDX-License-Identifier: Apache-2.0
"""One answer against its label, and the figures over many."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blind.plan import KINDS

Row = dict[str, Any]
PLAIN = 1.3  # measured severity from which on a single effect has to be named: 1.5, met as well as the search does
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
_NAMED = ("effect", "partly")
#: Said of the road file in a label and of the true road in an answer; and a sign that is the reality's own affair.
TURNED = {("position_offset", "offset"), ("lateral_offset", "offset")}
UNSIGNED = {("body_bending", "gain")}


def row_of(label: dict[str, Any], answer: Path, further: Callable[[], tuple[float, float] | None]) -> Row:
    """What one answer was worth. ``further`` gives the gaps on the sealed drive, above noise: before and after."""
    record = json.loads((answer / "record.json").read_text())
    truth = list(label["effects"])
    row: Row = {
        "case": label["name"],
        "kind": label["kind"],
        "reality": label["reality"],
        "truth": truth,
        "severity": min((r["severity"] for r in label["reached"].values()), default=0.0),
        "asked": label["severity"],
        "reference": label["reference"],
        "right": label["right"],
        "seconds": record["seconds"],
        "cpu_seconds": record["cpu_seconds"],
        "memory_mb": record["memory_mb"],
        "commit": record["commit"],
        "error": record["error"],
    }
    file = answer / "diagnosis.json"
    if record["status"] or not file.is_file():
        return {**row, "verdict": "error", "named": [], "top": None, "set": [], "chances": {}}
    d = json.loads(file.read_text())
    causes = d["causes"]
    first = causes[0] if causes else {"effect": None, "indistinguishable_from": [], "probability": 0.0}
    named = list(d["combination"]) if d["verdict"] in _NAMED else []
    ranking = [c["effect"] for c in causes]
    chances = {c["effect"]: c["probability"] for c in causes if c["probability"] >= 1e-4}
    chances["no_gap"], chances["unknown"] = d["no_gap_probability"], d["unknown_probability"]
    row |= {
        "verdict": d["verdict"],
        "named": named or ([first["effect"]] if d["verdict"] in _NAMED else []),
        "top": first["effect"],
        "rank": [ranking.index(e) + 1 if e in ranking else None for e in truth],
        "set": [first["effect"], *first["indistinguishable_from"]] if d["verdict"] in _NAMED else [],
        "chances": chances,
        "predicted_shrink": 1.0 - d["unexplained"],
        "interval": _interval(d),
        "where": _where(label, d.get("where", {})),
        "there": [one["effect"] for one in d.get("signature", {}).get("stretch", {}).get("resembles", [])],
        "parameters": _parameters(label, d) if named else {},
    }
    gaps = further()
    if gaps is not None and gaps[0] > 1e-9:
        row["measured_shrink"] = 1.0 - gaps[1] / gaps[0]
    return row


def _interval(d: dict[str, Any]) -> list[float] | None:
    """90 % interval of the shrink of the whole gap by the written twin."""
    return list(d["shrink_interval"]) if len(d["combination"]) < 2 else None


def _parameters(label: dict[str, Any], d: dict[str, Any]) -> dict[str, list[float]]:
    """Of every parameter of an effect that is rightly named: truth, what is told, ends of its 90 % interval."""
    out = {}
    for cause in d["causes"]:
        effect = cause["effect"]
        if effect not in d["combination"]:
            continue
        for name, ends in cause.get("parameter_intervals", {}).items():
            truth = label["faults"].get(effect, {}).get(name)
            if truth is None or name == "corner":
                continue
            told = cause["parameters"][name]
            if (effect, name) in TURNED:
                truth = -truth
            elif (effect, name) in UNSIGNED:
                truth = math.copysign(truth, told)
            out[f"{effect}.{name}"] = [float(v) for v in (truth, told, *ends)]
    return out


def _where(label: dict[str, Any], where: dict[str, Any]) -> dict[str, float]:
    """How far the main region of each kind sticks out of the true one: m, s; and octaves off a frequency."""
    out = {}

    def main(regions: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
        return max(regions, key=lambda r: r.get("share", 0.0), default=None)

    if label["stretch"]:
        first, last = label["stretch"]
        # base_link is at the rear axle: the front one meets the stretch a wheelbase earlier
        region = main(where.get("road", []))
        if region:
            out["road_m"] = max(0.0, first - 3.1 - region["start_m"], region["end_m"] - last)
        region = main(where.get("time", []))
        times = region and next(
            (v["stretch"] for k, v in label["drives"].items() if k == region["bag"]), None
        )
        if region and times:
            out["time_s"] = max(0.0, times[0] - region["start"], region["end"] - times[1])
    if label["kind"] == "single" and label["frequency"] and label["severity"] >= PLAIN:
        region = main(where.get("frequency", []))
        if region:
            centre = math.sqrt(max(region["low_hz"], 0.1) * max(region["high_hz"], 0.1))
            out["octaves"] = abs(math.log2(centre / label["frequency"][0]))
    return out


def _share(rows: Iterable[Row], good: Callable[[Row], bool]) -> tuple[float | None, int]:
    kept = list(rows)
    return (float(np.mean([good(r) for r in kept])) if kept else None), len(kept)


def expected(row: Row) -> list[str]:
    """The right answers to a case."""
    if row["kind"] == "null":
        return ["no_gap"]
    return ["unknown"] if row["kind"] in ("outside", "excluded") else list(row["truth"])


def sure_and_wrong(row: Row) -> bool:
    """More than 0.9 on something that is not so."""
    return any(p > 0.9 and a not in expected(row) for a, p in row["chances"].items())


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """Every figure of the table: value, number of cases and, where there is one, the bar."""
    kinds = {k: [r for r in rows if r["kind"] == k] for k in KINDS}
    plain = [r for r in kinds["single"] if r["severity"] >= PLAIN]
    faint = [r for r in kinds["single"] if r["severity"] < PLAIN]
    located = {
        k: [r["where"][k] for r in rows if k in r.get("where", {})] for k in ("road_m", "time_s", "octaves")
    }
    shrunk = [r for r in rows if "measured_shrink" in r and r["verdict"] in _NAMED]
    errors = [100 * abs(r["measured_shrink"] - r["predicted_shrink"]) for r in shrunk]
    held = [r for r in shrunk if r["interval"]]
    by_effect = {
        e: _share([r for r in plain if r["truth"] == [e]], _top1)
        for e in sorted({r["truth"][0] for r in plain})
    }
    out: dict[str, Any] = {}

    def put(name: str, pair: tuple[float | None, int], bar: str = "") -> None:
        out[name] = {"value": pair[0], "n": pair[1], "bar": bar}

    put("top1", _share(plain, _top1), ">= 0.90")
    put(
        "sure_or_suspected",
        _share(plain, lambda r: r["verdict"] in (*_NAMED, "suspected") and _first(r)),
        ">= 0.97",
    )
    suspected = [r for r in rows if r["verdict"] == "suspected"]
    put("suspected_wrong", _share(suspected, lambda r: r["top"] not in r["truth"]), "<= 0.15")
    put("top1_ranked", _share(plain, _first))
    put(
        "top3", _share(plain, lambda r: bool(r.get("rank") and r["rank"][0] and r["rank"][0] <= 3)), ">= 0.97"
    )
    put(
        "lowest_effect",
        (min((v for v, _ in by_effect.values() if v is not None), default=None), len(by_effect)),
        ">= 0.70",
    )
    put("in_set", _share(plain, lambda r: r["truth"][0] in r["set"]))
    put("set_size", (_mean([len(r["set"]) for r in plain if r["set"]]), len(plain)))
    put("faint_named_right", _share(faint, _top1))
    put("faint_named_wrong", _share(faint, lambda r: bool(r["named"]) and not _top1(r)))
    put("false_alarms", _share(kinds["null"], lambda r: r["verdict"] in _NAMED), "<= 0.02")
    put("null_no_gap", _share(kinds["null"], lambda r: r["verdict"] in ("no_gap", "recalibration")))
    put("null_suspected", _share(kinds["null"], lambda r: r["verdict"] == "suspected"))
    put("unknown_outside", _share(kinds["outside"], lambda r: r["verdict"] == "unknown"), ">= 0.90")
    put("unknown_excluded", _share(kinds["excluded"], lambda r: r["verdict"] == "unknown"), ">= 0.90")
    both = kinds["outside"] + kinds["excluded"]
    put("unknown_or_partly", _share(both, lambda r: r["verdict"] in ("unknown", "partly")))
    put("pairs_exact", _share(kinds["pair"], lambda r: set(r["named"]) == set(r["truth"])), ">= 0.75")
    put("pairs_no_wrong", _share(kinds["pair"], lambda r: set(r["named"]) <= set(r["truth"])), ">= 0.90")
    put("stretch_top1", _share(kinds["stretch"], _top1))
    put("stretch_unknown", _share(kinds["stretch"], lambda r: r["verdict"] == "unknown"))
    put("stretch_there", _share(kinds["stretch"], lambda r: r.get("there", [])[:1] == r["truth"]))
    put("wrong_name", _share(rows, lambda r: r["verdict"] in _NAMED and not {*r["named"]} & {*r["truth"]}))
    put("sure_and_wrong", _share(rows, sure_and_wrong), "<= 0.02")
    put("shrink_error_median", (_quantile(errors, 0.5), len(errors)), "<= 3 points")
    put("shrink_error_p95", (_quantile(errors, 0.95), len(errors)), "<= 8 points")
    put(
        "shrink_in_interval",
        _share(held, lambda r: r["interval"][0] <= r["measured_shrink"] <= r["interval"][1]),
    )
    told = [v for r in rows for v in r.get("parameters", {}).values()]
    off = [abs(v / truth - 1.0) for truth, v, _, _ in told if truth]
    put("parameter_error_median", (_quantile(off, 0.5), len(off)))
    put("parameter_in_interval", (_mean([low <= truth <= high for truth, _, low, high in told]), len(told)))
    off_by = [v for r in rows for v in r.get("values", {}).values()]
    put(
        "recalibration_direction",
        (_mean([true * told > 0 for true, told, _, _ in off_by]), len(off_by)),
        ">= 0.95",
    )
    points = [100 * abs(true - told) for true, told, _, _ in off_by]
    put("recalibration_error_median", (_quantile(points, 0.5), len(off_by)))
    put(
        "recalibration_in_interval",
        (_mean([low <= true <= high for true, _, low, high in off_by]), len(off_by)),
    )
    put("road_m_median", (_quantile(located["road_m"], 0.5), len(located["road_m"])), "<= 1 m")
    put("time_s_median", (_quantile(located["time_s"], 0.5), len(located["time_s"])))
    put("octaves_median", (_quantile(located["octaves"], 0.5), len(located["octaves"])), "<= 1/6")
    put(
        "seconds_two_drives",
        (
            _quantile([r["seconds"] for r in rows if not r["reference"]], 0.5),
            sum(not r["reference"] for r in rows),
        ),
        "<= 90 s",
    )
    put("seconds_worst", (max((r["seconds"] for r in rows), default=None), len(rows)))
    put("cpu_seconds_median", (_quantile([r["cpu_seconds"] for r in rows], 0.5), len(rows)))
    put("memory_mb", (max((r["memory_mb"] for r in rows), default=None), len(rows)), "< 2048 MB")
    put("failed", _share(rows, lambda r: r["verdict"] == "error"))
    return {
        "figures": out,
        "by_effect": {e: {"top1": v, "n": n} for e, (v, n) in by_effect.items()},
        "reliability": reliability(rows),
    }


def _first(row: Row) -> bool:
    return bool(row["top"] == row["truth"][0])


def _top1(row: Row) -> bool:
    return row["verdict"] in _NAMED and _first(row)


def reliability(rows: Sequence[Row]) -> list[dict[str, float]]:
    """Of answers given a probability in each bin, how many were right."""
    pairs = [(p, a in expected(r)) for r in rows for a, p in r["chances"].items()]
    out = []
    for low, high in zip(BINS[:-1], BINS[1:], strict=True):
        own = [(p, g) for p, g in pairs if low <= p < high or (high == 1.0 and p >= 1.0)]
        if own:
            said, right = (float(np.mean(c)) for c in zip(*own, strict=True))
            out.append({"low": low, "high": high, "said": said, "right": right, "n": len(own)})
    return out


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _quantile(values: Sequence[float], q: float) -> float | None:
    return float(np.quantile(values, q)) if values else None
