# SPDX-License-Identifier: Apache-2.0
"""Learns the decision of a diagnosis from kept evidence, and scores it on realities and effects left out.

    python benchmarks/train_decision.py [--json]                # score what can be learnt from the kept evidence;
                                                                # docs/make_docs.py tables reads it from results/
    python benchmarks/train_decision.py --write                 # and write suspension_twin/diagnosis/decision.json
    python benchmarks/train_decision.py --keep DIR...           # add answered cases of blind.py or seeded.py --out DIR

Kept evidence is ``benchmarks/results/evidence.jsonl.xz``: a line a case, its label beside its ``evidence.json``. Cases
of seeds for reporting do not belong there before they were reported on. From every case with one effect a second one
is made by taking the rows of that effect away: its right answer is unknown. The weights minimise

    -sum_i c_i log sum_(a right) p_a + ridge / 2 |w - w_0|^2

with the prior means w_0 of ``decision.json`` and under their signs; the classes cause, no gap and unknown have the
weights of ``PRIOR``. All figures, and the conformal threshold, are of cases whose reality was left out of the learning.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import lzma
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from options import parse_options
from scipy.optimize import minimize

from suspension_twin.diagnosis.decision import (
    FEATURES,
    Answer,
    Costs,
    Weights,
    answers_of,
    decide,
    prior_means,
)

HERE = Path(__file__).resolve().parent
KEPT = HERE / "results" / "evidence.jsonl.xz"
FILE = HERE.parent / "suspension_twin" / "diagnosis" / "decision.json"
#: Prior probability of the three kinds of answers.
PRIOR = {"cause": 0.5, "no_gap": 0.3, "unknown": 0.2}
#: Severity in floors from which on an effect has to be named; below, no gap is right as well.
PLAIN = 1.3
RIDGES = (1.0, 3.0, 10.0)
_COVERED = 0.9


@dataclass(frozen=True, eq=False)
class Example:
    """One case: features (A, F) of its answers, which of them are ``right`` (A,), and what it was.

    ``good`` are all right answers: of an effect too faint to be seen, no gap as well."""

    name: str
    label: dict[str, Any]
    evidence: dict[str, Any]
    answers: list[Answer]
    features: np.ndarray
    right: np.ndarray
    truth: tuple[str, ...]
    good: frozenset[tuple[str, ...]]

    @property
    def kind(self) -> str:
        """The class of its right answer."""
        return {(): "no_gap", ("unknown",): "unknown"}.get(self.truth, "cause")


def example(label: dict[str, Any], evidence: dict[str, Any], removed: bool = False) -> Example:
    """A labelled case; ``removed`` takes the rows of its effects away."""
    truth: tuple[str, ...] = tuple(sorted(label["effects"]))
    if removed:
        rows = [r for r in evidence["hypotheses"] if not set(truth) & set(r["effects"])]
        evidence, truth = {**evidence, "hypotheses": rows}, ("unknown",)
    elif label["kind"] in ("outside", "excluded", "stretch"):
        truth = ("unknown",)
    elif label["kind"] == "null":
        truth = ()
    answers = answers_of(evidence)
    severity = min((r["severity"] for r in label["reached"].values()), default=0.0)
    right = {truth}
    if label["effects"] and severity < PLAIN and truth not in ((), ("unknown",)):
        right.add(())
    if truth != ("unknown",) and len(truth) > 1 and not any(a.causes == truth for a in answers):
        right |= {(e,) for e in truth}
    if removed and severity < PLAIN:
        right.add(())
    mask = np.array([a.causes in right for a in answers])
    name = label["name"] + (" without" if removed else "")
    return Example(
        name, label, evidence, answers, np.stack([a.features for a in answers]), mask, truth, frozenset(right)
    )


def examples(lines: Sequence[dict[str, Any]], removed: bool = True) -> list[Example]:
    """All cases, and those with their effect taken away."""
    out = []
    for line in lines:
        out.append(example(line["label"], line["evidence"]))
        if removed and line["label"]["kind"] == "single" and len(line["label"]["effects"]) == 1:
            out.append(example(line["label"], line["evidence"], removed=True))
    return [e for e in out if e.right.any()]


def fit(cases: Sequence[Example], ridge: float) -> np.ndarray:
    """(F,) weights."""
    count = {k: sum(c.kind == k for c in cases) for k in PRIOR}
    share = np.array([PRIOR[c.kind] / max(count[c.kind], 1) * len(cases) for c in cases])
    size = np.array([c.features.shape[0] for c in cases])
    features = np.concatenate([c.features for c in cases])
    right = np.concatenate([c.right for c in cases])
    first = np.concatenate([[0], np.cumsum(size)[:-1]])
    usual = prior_means()
    of = np.repeat(np.arange(len(cases)), size)

    def objective(w: np.ndarray) -> tuple[float, np.ndarray]:
        u = features @ w
        u -= np.maximum.reduceat(u, first)[of]
        e = np.exp(u)
        total, good = np.add.reduceat(e, first), np.add.reduceat(e * right, first)
        good = np.maximum(good, 1e-300)
        loss = float(np.sum(share * (np.log(total) - np.log(good))))
        pull = share[of] * (e / total[of] - e * right / good[of])
        return loss + 0.5 * ridge * float((w - usual) @ (w - usual)), features.T @ pull + ridge * (w - usual)

    bounds = [{1: (0, None), -1: (None, 0), 0: (None, None)}[int(np.sign(s))] for s in usual]
    found = minimize(
        objective,
        usual,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 2000},
    )
    return np.asarray(found.x)


def probabilities(case: Example, weights: np.ndarray) -> np.ndarray:
    """(A,) of the answers."""
    u = case.features @ weights
    e = np.exp(u - u.max())
    return np.asarray(e / e.sum())


def held_out(cases: Sequence[Example], ridge: float) -> dict[str, np.ndarray]:
    """Weights by reality, learnt on all others."""
    realities = sorted({c.label["reality"] for c in cases})
    return {r: fit([c for c in cases if c.label["reality"] != r], ridge) for r in realities}


def loss(cases: Sequence[Example], weights: dict[str, np.ndarray]) -> tuple[float, float]:
    """Weighted mean of the negative log probability of what is right, by the weights of each case's reality, and its
    standard error."""
    count = {k: sum(c.kind == k for c in cases) for k in PRIOR}
    share = np.array([PRIOR[c.kind] / max(count[c.kind], 1) for c in cases])
    own = np.array(
        [-np.log(max(probabilities(c, weights[c.label["reality"]])[c.right].sum(), 1e-12)) for c in cases]
    )
    mean = float(share @ own)
    return mean, float(np.sqrt(np.sum((share * (own - mean)) ** 2)))


def chosen(losses: dict[float, tuple[float, float]]) -> float:
    """The strongest ridge whose loss is within one standard error of the least (Hastie, Tibshirani, Friedman, The
    Elements of Statistical Learning, 2009, section 7.10)."""
    least, error = min(losses.values())
    return max(r for r, (mean, _) in losses.items() if mean <= least + error)


def threshold(cases: Sequence[Example], weights: dict[str, np.ndarray]) -> float:
    """Least probability of a member of a set that holds the truth in 90 % of cases (split conformal)."""
    own = sorted(
        max(p for a, p in masses(c, weights[c.label["reality"]]).items() if a in c.good) for c in cases
    )
    rank = int(np.floor((1.0 - _COVERED) * (len(own) + 1))) - 1
    return float(np.clip(own[max(rank, 0)], 1e-4, 0.45))


def masses(case: Example, weights: np.ndarray) -> dict[tuple[str, ...], float]:
    """Probability of each different answer."""
    out: dict[tuple[str, ...], float] = {}
    for answer, p in zip(case.answers, probabilities(case, weights), strict=True):
        out[answer.causes] = out.get(answer.causes, 0.0) + float(p)
    return out


def score(
    cases: Sequence[Example], weights: dict[str, np.ndarray], conformal: float, costs: Costs
) -> dict[str, Any]:
    """Figures of decisions on cases by weights that did not see their reality."""
    rows = []
    for case in cases:
        found = decide(case.evidence, costs, Weights(weights[case.label["reality"]], conformal, {}))
        top = max(found.effects, key=found.presence, default="")
        rows.append(
            {
                "case": case.name,
                "kind": "removed" if case.name.endswith(" without") else case.label["kind"],
                "reality": case.label["reality"],
                "reference": case.label["reference"],
                "severity": min((r["severity"] for r in case.label["reached"].values()), default=0.0),
                "truth": list(case.truth),
                "chosen": list(found.chosen),
                "right": found.chosen == case.truth and (found.sure or found.row is None),
                "suspected": found.row is not None and not found.sure,
                "near": found.chosen == case.truth,
                "wrong": found.sure and not set(found.chosen) & set(case.truth),
                "wrong_suspicion": not set(found.chosen) & set(case.truth),
                "top": top in case.truth,
                "p": [
                    (p, a.causes in case.good)
                    for a, p in zip(found.answers, found.probability.tolist(), strict=True)
                ],
                "size": len(found.candidates),
                "covered": bool(case.good & set(found.candidates)),
            }
        )

    def share(key: str, **which: Any) -> list[float]:
        own = [r for r in rows if all(r[k] == v if not callable(v) else v(r[k]) for k, v in which.items())]
        return [round(float(np.mean([r[key] for r in own])), 3) if own else float("nan"), len(own)]

    plain = {"kind": "single", "severity": lambda s: s >= PLAIN}
    nulls = [r for r in rows if r["kind"] == "null"]
    return {
        "single_named": share("right", **plain),
        "single_named_or_suspected": share("near", **plain),
        "single_first": share("top", **plain),
        "single_named_with_reference": share("right", **plain, reference=True),
        "single_named_without": share("right", **plain, reference=False),
        "pair_exact": share("right", kind="pair"),
        "pair_exact_or_suspected": share("near", kind="pair"),
        "null_no_gap": share("right", kind="null"),
        "null_named": [
            round(float(np.mean([r["wrong"] for r in nulls])), 3) if nulls else float("nan"),
            len(nulls),
        ],
        "outside_unknown": share("right", kind=lambda k: k in ("outside", "excluded", "stretch")),
        "removed_unknown": share("right", kind="removed", severity=lambda s: s >= PLAIN),
        "removed_named": share("wrong", kind="removed"),
        "wrong_name": share("wrong", kind=lambda k: k != "removed"),
        "suspected_wrong": share("wrong_suspicion", suspected=True, kind=lambda k: k != "removed"),
        "coverage": share("covered"),
        "set_size": share("size"),
        "calibration_error": round(
            _calibration([p for r in rows if r["kind"] != "removed" for p in r["p"]]), 4
        ),
        "by_reality": {
            r: share("right", **plain, reality=r) for r in sorted({row["reality"] for row in rows})
        },
        "by_effect": {
            e: [*share("right", **plain, truth=[e]), share("top", **plain, truth=[e])[0]]
            for e in sorted(
                {row["truth"][0] for row in rows if row["kind"] == "single" and len(row["truth"]) == 1}
            )
        },
        "rows": [{k: v for k, v in r.items() if k != "p"} for r in rows],
    }


def _calibration(pairs: list[tuple[float, bool]]) -> float:
    """Expected calibration error in ten bins of the probabilities of at least 5 %."""
    known = [(p, r) for p, r in pairs if p >= 0.05]
    total = 0.0
    for low in np.arange(0.0, 1.0, 0.1):
        own = [(p, r) for p, r in known if low <= p < low + 0.1 or (low > 0.85 and p >= 1.0)]
        if own:
            total += len(own) * abs(float(np.mean([p for p, _ in own])) - float(np.mean([r for _, r in own])))
    return total / max(len(known), 1)


def read(path: Path = KEPT) -> list[dict[str, Any]]:
    """Kept evidence, a dictionary a case."""
    if not path.is_file():
        raise SystemExit(f"{path} is not there: add answered cases with --keep DIR")
    with lzma.open(path, "rt", encoding="utf-8") as file:
        return [json.loads(line) for line in file]


def keep(folders: Sequence[Path], path: Path = KEPT) -> int:
    """Add the evidence of answered cases to what is kept; a case answered again replaces the earlier one."""
    known = {line["label"]["name"]: line for line in read(path)} if path.is_file() else {}
    for folder in folders:
        for label in sorted((folder / "sealed").glob("*/label.json")):
            answer = folder / "answers" / label.parent.name / "evidence.json"
            if answer.is_file():
                whole = json.loads(label.read_text())
                some = ("name", "kind", "effects", "reached", "reality", "reference", "severity")
                evidence = json.loads(answer.read_text())
                known[whole["name"]] = {"label": {k: whole[k] for k in some}, "evidence": _lean(evidence)}
    lines = [json.dumps(known[name], sort_keys=True) for name in sorted(known)]
    with lzma.open(path, "wt", encoding="utf-8", preset=9) as file:
        file.write("\n".join(lines) + "\n")
    return len(lines)


def _lean(evidence: dict[str, Any]) -> dict[str, Any]:
    """Evidence without what no decision uses: fitted vehicles, and where the twin file was."""
    rows = [{k: v for k, v in r.items() if k not in ("vehicle", "refined")} for r in evidence["hypotheses"]]
    base = {k: v for k, v in evidence["base"].items() if k != "vehicle"}
    return {
        **{k: v for k, v in evidence.items() if k not in ("twin", "asked")},
        "base": base,
        "hypotheses": rows,
    }


def discrepancy(lines: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Residual of cars without any fault in the kept evidence, beside ``discrepancy`` of decision.json."""
    faultless = [x["evidence"] for x in lines if x["label"]["kind"] == "null"]
    squares = [
        max(v for c, v in e["base"]["mean_squares"].items() if e["case"]["channels"][c]["driven"])
        for e in faultless
        if e["case"]["reference"]
    ]
    levels = [e["base"]["level_fitted"] for e in faultless if not e["case"]["reference"]]
    largest = {
        key: max(e["base"][key] for e in faultless if key in e["base"]) for key in ("tone", "band", "place")
    }
    return {"square": float(np.median(squares)), "level": float(np.median(levels)), **largest}


def written(weights: np.ndarray, conformal: float, ridge: float, lines: Sequence[dict[str, Any]]) -> None:
    """decision.json, with where it comes from."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"], cwd=HERE, capture_output=True, text=True
    )
    digest = hashlib.sha256("\n".join(json.dumps(x, sort_keys=True) for x in lines).encode()).hexdigest()
    document = {
        **json.loads(FILE.read_text(encoding="utf-8")),  # prior means and discrepancy
        "weights": {name: round(float(w), 4) + 0.0 for name, w in zip(FEATURES, weights, strict=True)},
        "conformal_probability": round(conformal, 5),
        "source": {
            "command": "python benchmarks/train_decision.py --write",
            "cases": len(lines),
            "realities": sorted({x["label"]["reality"] for x in lines}),
            "seeds": "report, report4, report5 (63 cases), train, flexible, flexible_dev, measured and "
            "measured_dev of blind.py, development of seeded.py",
            "commit": commit.stdout.strip(),
            "evidence_sha256": digest,
            "ridge": ridge,
        },
    }
    FILE.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--keep", nargs="+", type=Path, default=[], metavar="DIR", help="folders of blind.py --out"
    )
    parser.add_argument("--write", action="store_true", help="write decision.json")
    parser.add_argument("--costs", default="", help="as of suspension-twin diagnose")
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser)
    if options.keep:
        print(f"{keep(options.keep)} cases are kept in {KEPT}", file=sys.stderr)
    lines = read()
    cases = examples(lines)
    tried = {ridge: held_out(cases, ridge) for ridge in RIDGES}
    losses = {ridge: loss(cases, w) for ridge, w in tried.items()}
    ridge = chosen(losses)
    conformal = threshold([c for c in cases if not c.name.endswith(" without")], tried[ridge])
    figures = score(cases, tried[ridge], conformal, Costs.parsed(options.costs))
    if options.write:
        written(fit(cases, ridge), conformal, ridge, lines)
    if options.json:
        print(
            json.dumps(
                {
                    "cases": len(lines),
                    "ridge": ridge,
                    "losses": losses,
                    "discrepancy": discrepancy(lines),
                    **{name: value for name, value in figures.items() if name != "rows"},
                },
                indent=1,
            )
        )
        return
    print(f"residual of cars without any fault: {discrepancy(lines)}")
    print(f"{len(lines)} cases; ridge {ridge} of {losses}; conformal threshold {conformal:.4f}")
    for name, value in figures.items():
        if name not in ("rows", "by_effect"):
            print(f"{name:30s} {value}")
    for name, value in figures["by_effect"].items():
        if value[1]:
            print(f"  {name:28s} named {value[0]}, first {value[2]}, of {value[1]}")


if __name__ == "__main__":
    main()
