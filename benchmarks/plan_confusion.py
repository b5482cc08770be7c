# SPDX-License-Identifier: Apache-2.0
"""The confusion that ``suspension-twin plan`` predicts, beside what diagnoses of sealed cases did.

    python benchmarks/plan_confusion.py [--json] [--worlds N] [--fresh] [--keep]

For the worlds of stored blind results (``results/blind_report2.json`` and its like) the plan is made for what
the user of the world knows: twin file, surveyed road, the usual speeds of its two drives. Then, for each case:

- the predicted ratio of the fault that was put in, and how often such a ratio was named: the threshold ``DETECTABLE``;
- the ratio that the nearest rival leaves of it, and how often the fault came first: the threshold ``APART``;
- where another cause came first, or was the most probable one although the true one was not in the library, the place
  of that cause among all rivals, the nearest first.

The faults follow from the cases' severities by simulating the reality (minutes for each world); they are kept in
``results/plan_confusion.json`` and taken from there unless ``--fresh``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import numpy as np  # noqa: E402
from blind.folder import faults_of, road_file, twin_file  # noqa: E402
from blind.plan import (  # noqa: E402
    Seeds,
    Spec,
    plan as cases,
)
from blind.world import World, make_world  # noqa: E402
from options import parse_options  # noqa: E402

from suspension_twin.addons.plan.plan import APART, DETECTABLE, alternatives  # noqa: E402
from suspension_twin.addons.plan.sensitivity import Change, products  # noqa: E402
from suspension_twin.diagnosis.library import library  # noqa: E402
from suspension_twin.diagnosis.next_experiment import planned_drive  # noqa: E402
from suspension_twin.vehicle.twin import EffectSpec, parse_twin  # noqa: E402

SETS: tuple[Seeds, ...] = ("report2", "report3")
RESULT = HERE / "results" / "plan_confusion.json"
#: Probability from which on a wrong cause counts as taken for the true one.
TAKEN = 0.1


def chosen(worlds: int) -> tuple[dict[int, list[Spec]], dict[str, dict[str, Any]]]:
    """Single and excluded cases, by world, of the ``worlds`` of each set that have the most of them, and the rows of
    their answers."""
    rows: dict[str, dict[str, Any]] = {}
    kept: dict[int, list[Spec]] = {}
    for seeds in SETS:
        own = json.loads((HERE / "results" / f"blind_{seeds}.json").read_text())["rows"]
        rows |= {row["case"]: row for row in own}
        by: dict[int, list[Spec]] = defaultdict(list)
        for spec in cases(seeds):
            if spec.name in rows and spec.kind in ("single", "excluded") and not spec.msd:
                by[spec.world].append(spec)
        kept |= {w: by[w] for w in sorted(by, key=lambda w: -len(by[w]))[:worlds]}
    return kept, rows


def judged(world: World, specs: list[Spec], faults: dict[str, Any]) -> list[dict[str, Any]]:
    """Predicted ratio, nearest rivals and their ratios for every case of a world."""
    known = {k: v for k, v in twin_file(world, specs[0]).items() if k != "road"}
    twin, road = parse_twin({**known, "model": "full_car"}), road_file(world, world.survey)
    speeds = [world.plans[name].speed for name in ("drive_slow", "drive_fast")]
    drives = [
        planned_drive(twin, road, 3.6 * float(np.median(v[v > 1.0])), f"drive {i}")
        for i, v in enumerate(speeds)
    ]
    rivals, changes = alternatives(twin, drives[-1])
    offered = library(twin, True)
    for spec in specs:
        ((effect, values),) = faults[spec.name].items()
        hypothesis = next(
            h for h in offered[effect] if all(values[k.rpartition(".")[2]] == v for k, v in h.fixed)
        )
        point = np.clip(hypothesis.at(EffectSpec(id=effect, parameters=values)), *hypothesis.bounds())
        changes.append(Change(hypothesis, point[:, None], (spec.name,)))
    found = reduce(add, [products(twin, drive, changes) for drive in drives])
    columns = found.columns([spec.name for spec in specs])
    ratios, _ = found.left(columns)
    nearest: list[dict[str, float]] = [{} for _ in specs]
    for rival in rivals:
        left, _ = found.left(columns, found.columns(rival.names), rival.scale)
        for own, ratio in zip(nearest, left.max(axis=0).tolist(), strict=True):
            own[rival.effect] = min(ratio, own.get(rival.effect, np.inf))
    return [
        {
            "case": spec.name,
            "kind": spec.kind,
            "effect": spec.effects[0],
            "ratio": round(float(ratios[:, i].max()), 4),
            "rivals": {
                e: round(r, 4)
                for e, r in sorted(nearest[i].items(), key=lambda pair: pair[1])
                if e != spec.effects[0]
            },
        }
        for i, spec in enumerate(specs)
    ]


def figures(found: list[dict[str, Any]], rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What the prediction was worth."""
    singles = [(f, rows[f["case"]]) for f in found if f["kind"] == "single"]
    named = [(f["ratio"], row["named"] == [f["effect"]]) for f, row in singles]
    first = [(min(f["rivals"].values()), row["top"] == f["effect"]) for f, row in singles]
    places = []
    for f in found:
        row = rows[f["case"]]
        wrong = {e: p for e, p in row["chances"].items() if e in f["rivals"] and p >= TAKEN}
        if wrong and (f["kind"] == "excluded" or row["top"] != f["effect"]):
            taken = max(wrong, key=lambda e: wrong[e])
            places.append((f["effect"], taken, 1 + list(f["rivals"]).index(taken), len(f["rivals"])))
    severities = [f["ratio"] / rows[f["case"]]["severity"] for f in found]

    def share(pairs: list[tuple[float, bool]], low: float, high: float = np.inf) -> list[int]:
        own = [good for value, good in pairs if low <= value < high]
        return [sum(own), len(own)]

    return {
        "cases": len(found),
        "ratio_over_severity": [round(float(q), 3) for q in np.quantile(severities, (0.1, 0.5, 0.9))],
        "named_below_detectable": share(named, 0.0, DETECTABLE),
        "named_from_detectable": share(named, DETECTABLE),
        "first_below_apart": share(first, 0.0, APART),
        "first_from_apart": share(first, APART),
        "confusions": [{"truth": a, "taken": b, "place": p, "of": n} for a, b, p, n in places],
        "median_place": float(np.median([p for *_, p, _ in places])) if places else None,
        "by_chance": float(np.mean([0.5 * (n + 1) for *_, n in places])) if places else None,
        "among_three_nearest": [sum(p <= 3 for *_, p, _ in places), len(places)],
    }


def table(f: dict[str, Any]) -> str:
    """The figures for people."""
    low, middle, high = f["ratio_over_severity"]
    lines = [
        f"{f['cases']} cases; predicted ratio over the benchmark's severity: {middle:.2f} ({low:.2f} to {high:.2f})",
        "named rightly, of single faults with a predicted ratio below / from {:g}: {}/{}, {}/{}".format(
            DETECTABLE, *f["named_below_detectable"], *f["named_from_detectable"]
        ),
        "first, where the nearest rival leaves below / from {:g}: {}/{}, {}/{}".format(
            APART, *f["first_below_apart"], *f["first_from_apart"]
        ),
        f"{'truth':18s} {'taken for':18s} place of it among the rivals, nearest first",
    ]
    lines += [f"{c['truth']:18s} {c['taken']:18s} {c['place']} of {c['of']}" for c in f["confusions"]]
    lines.append(f"median place {f['median_place']:g}, by chance {f['by_chance']:.1f}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="figures as JSON")
    parser.add_argument("--worlds", type=int, default=5, help="worlds of each set of seeds (5)")
    parser.add_argument("--fresh", action="store_true", help="simulate the faults of the cases anew")
    parser.add_argument("--keep", action="store_true", help="write the result to benchmarks/results")
    options = parse_options(parser, worlds=1)
    kept = json.loads(RESULT.read_text())["faults"] if RESULT.is_file() and not options.fresh else {}
    by, rows = chosen(options.worlds)
    found: list[dict[str, Any]] = []
    for number, (seed, specs) in enumerate(by.items()):
        print(f"world {number + 1} of {len(by)}: {len(specs)} cases", file=sys.stderr)
        kept |= {s.name: faults_of(s)[0] for s in specs if s.name not in kept}
        found += judged(make_world(seed), specs, kept)
    result = figures(found, rows)
    print(json.dumps(result) if options.json else table(result))
    if options.keep:
        used = {f["case"]: kept[f["case"]] for f in found}
        text = json.dumps({**result, "predictions": found, "faults": used}, indent=1) + "\n"
        RESULT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
