# SPDX-License-Identifier: Apache-2.0
"""The answer: verdict, causes, candidates and message of ``diagnosis.json`` by the evidence, and its files."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from suspension_twin.diagnosis import wording
from suspension_twin.diagnosis.decision import Costs, Decision, decide, single, usual_level
from suspension_twin.diagnosis.request import DiagnosisRequest, DiagnosisResult
from suspension_twin.errors import InputError
from suspension_twin.files import Json, read_json, read_text, reader, reading, write_text
from suspension_twin.inference.hypothesis import having_effects
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin, save_twin, twin_of_text

__all__ = ["answer_of", "continued", "decided_anew", "leading_channel", "rounded", "write", "write_document"]

#: Keys of diagnosis.json that a decision made anew keeps: they depend on the drives alone.
_KEPT = ("where", "warnings", "next_experiment", "next_drive")
#: Verdicts of a gap of which something may stay unexplained.
WITH_SIGNATURE = ("unknown", "partly", "suspected")


def answer_of(evidence: Json, decision: Decision) -> Json:
    """The part of diagnosis.json that follows from the evidence.

    Parameters
    ----------
    evidence : mapping
        Content of ``evidence.json``.
    decision : Decision
        The decision on it.
    """
    case, base, rows = evidence["case"], evidence["base"], evidence["hypotheses"]
    main = next(iter(case["channels"]))
    verdict = _verdict(case, base, decision)
    kept = _written(decision.row if decision.row is not None else base)
    left = kept["channels"][main]["written"]
    if decision.row is None and not is_better(base):
        left = {"before": left["before"], "after": left["before"], "shrink": 0.0, "low": 0.0, "high": 0.0}
    document = {
        "verdict": verdict,
        "probability": round(_probability(decision), 6),
        "gap": {
            "rms": case["channels"][main]["gap"],
            "mse": rounded(case["channels"][main]["gap"] ** 2),
            "noise_rms": case["channels"][main]["noise"],
            "channel": main,
            "channels": {name: c["gap"] for name, c in case["channels"].items()},
        },
        "gap_before": left["before"],
        "gap_after": left["after"],
        "shrink": left["shrink"],
        "shrink_interval": [left["low"], left["high"]],
        "causes": _causes(rows, decision),
        "no_gap_probability": round(decision.no_gap, 6),
        "recalibration_probability": round(decision.no_gap, 6) if _needed(base) else 0.0,
        "unknown_probability": round(decision.unknown, 6),
        "candidates": [" + ".join(causes) or "no_gap" for causes in decision.candidates],
        "combination": list(decision.row["effects"]) if decision.row is not None else [],
        "unexplained": rounded(1.0 - left["shrink"]),
        "recalibration": _shrink(base.get("better", base["channels"][main]["written"])),
        "recalibrated": base.get("recalibrated", []),
        "reference": bool(case["reference"]),
        "background": {
            "share_of_motion_left": kept["level"],
            "share_left_on_reference": case["level_on_reference"],
            "noise_share_of_residual": case["temper"],
        },
        "cannot_be_judged": [r["effects"][0] for r in rows if len(r["effects"]) == 1 and not _judged(r)],
    }
    document["message"] = wording.message(document)
    return document


def leading_channel(row: Json) -> str:
    """The channel in which the shrink beyond recalibration is surest."""
    return str(max(row["channels"], key=lambda name: row["channels"][name]["low"]))


def is_better(base: Json) -> bool:
    """Whether the recalibrated twin is better than the given one on held-out road, beyond chance."""
    return bool(base.get("better", {"low": 0.0})["low"] > 0.0)


def _needed(base: Json) -> bool:
    """Whether recalibration is a finding: what moved beyond its uncertainty makes the twin better."""
    return bool(base.get("recalibrated")) and is_better(base)


def _verdict(case: Json, base: Json, decision: Decision) -> str:
    """``effect`` where at most half of the leading channel's residual beyond the discrepancy stays, else ``partly``;
    ``suspected`` where no named cause is sure."""
    if decision.row is None:
        needed = _needed(base)
        return "unknown" if decision.chosen else "recalibration" if needed else "no_gap"
    if not decision.sure:
        return "suspected"
    row = decision.row
    name = leading_channel(row)
    expected = usual_level(case) * case["channels"][name]["motion"]
    before, after = (
        np.sqrt(max(row["channels"][name][k] ** 2 - expected**2, 0.0)) for k in ("before", "after")
    )
    return "effect" if after <= 0.5 * before else "partly"


def _probability(decision: Decision) -> float:
    """Of the verdict: the presence of the leading cause, or that of no gap or unknown."""
    if decision.chosen == ():
        return decision.no_gap
    if decision.chosen == ("unknown",):
        return decision.unknown
    return max(decision.presence(effect) for effect in decision.chosen)


def _causes(rows: list[Json], decision: Decision) -> list[Json]:
    """Every effect of the library, the most probable first; members of the named set with their joint parameters."""
    together = _written(decision.row)["parameters"] if decision.row is not None else {}
    tied = [c[0] for c in decision.candidates if len(c) == 1 and c != ("unknown",)]
    causes = []
    presence = {r["effects"][0]: decision.presence(r["effects"][0]) for r in rows if single(r)}
    for row in sorted(
        filter(single, rows),
        key=lambda r: (-round(presence[r["effects"][0]], 9), -r["tempered_gain"], r["effects"][0]),
    ):
        effect = row["effects"][0]
        shown = _written(decision.row) if decision.chosen == (effect,) and decision.row is not None else row
        parameters = together.get(effect, row["parameters"][effect])
        channel = leading_channel(shown)
        beyond = shown["channels"][channel]
        cause: Json = {
            "effect": effect,
            "probability": round(decision.effects[effect], 6),
            "presence": round(presence[effect], 6),
            "parameters": {name: p["value"] for name, p in parameters.items()},
            **({"held": held} if (held := _held(parameters)) else {}),
            "channel": channel,
            **_shrink(beyond["written"]),
            "shrink_beyond_recalibration": beyond["shrink"],
            "shrink_beyond_recalibration_interval": [beyond["low"], beyond["high"]],
            "indistinguishable_from": [e for e in tied if e != effect] if effect in tied else [],
            "judged": _judged(row),
            "log_evidence": row["tempered_gain"],
        }
        ends = {name: p["interval"] for name, p in parameters.items() if "interval" in p}
        if ends and effect in decision.chosen:
            cause["parameter_intervals"] = ends
        causes.append(cause)
    return causes


def _held(parameters: Json) -> dict[str, float]:
    """Parameters of an effect as the twin file that was diagnosed has them."""
    return {name: p["held"] for name, p in parameters.items() if "held" in p}


def _judged(row: Json) -> bool:
    """Whether the drives excite an effect enough, somewhere over its prior."""
    return bool(row.get("detectable", True))


def _written(row: Json) -> Json:
    """A row as the twin file has it: refitted in the time steps of the drives."""
    return {**row, **row["refined"]} if "refined" in row else row


def _shrink(one: Json) -> Json:
    return {
        "gap_before": one["before"],
        "gap_after": one["after"],
        "shrink": one["shrink"],
        "shrink_interval": [one["low"], one["high"]],
    }


def rounded(value: float) -> float:
    """A number to six digits."""
    return float(f"{float(value):.6g}")


@reader("evidence of a diagnosis")
def decided_anew(folder: Path, costs: Costs) -> tuple[Json, Twin | None]:
    """The document of a kept diagnosis decided anew, and the twin file that goes with it.

    Parameters
    ----------
    folder : Path
        A folder with ``evidence.json`` and ``diagnosis.json`` of an earlier diagnosis.
    costs : Costs
        Costs of wrong and missing answers.

    Returns
    -------
    tuple
        The content of ``diagnosis.json`` and the twin, None where the twin file that was diagnosed is gone.

    Raises
    ------
    InputError
        The folder holds no diagnosis, or one of another version.
    """
    evidence, before = (_read(folder / name) for name in ("evidence.json", "diagnosis.json"))
    path = Path(evidence["twin"])
    decision = decide(evidence, costs)
    document = answer_of(evidence, decision)
    twin = load_twin(path) if path.is_file() else None
    if twin is not None and (row := kept_row(evidence, decision)) is not None:
        twin = _twin_with(twin, row)
    document |= {k: before[k] for k in _KEPT if k in before}
    if document["verdict"] in WITH_SIGNATURE and "signature" in before:
        document["signature"] = before["signature"]
    if before.get("before_and_after"):
        document["before_and_after"] = True
    document["seed"], document["message"] = evidence["seed"], wording.message(document)
    return document, twin


@reader("evidence of a diagnosis")
def continued(folder: Path, more: Sequence[Path], costs: Costs) -> tuple[DiagnosisRequest, Json]:
    """The request of a kept diagnosis with more drives that show the gap, and the answer before them.

    Raises
    ------
    InputError
        The folder holds no diagnosis, or one of another version.
    """
    evidence, before = (_read(folder / name) for name in ("evidence.json", "diagnosis.json"))
    asked = evidence["asked"]
    request = DiagnosisRequest(
        str(evidence["twin"]),
        (*asked["bags"], *map(str, more)),
        tuple(asked["reference"]),
        int(evidence["seed"]),
        tuple(asked["effects"]),
        costs=costs,
    )
    earlier = {"verdict": before["verdict"], "answer": wording.answer(before)}
    return request, earlier


def kept_row(evidence: Json, decision: Decision) -> Json | None:
    """The row whose twin is handed on: that of the named causes, of recalibration where it is better than the given
    twin and something is off, or None for the given twin."""
    if decision.row is not None:
        return decision.row
    base = evidence["base"]
    wanted = is_better(base) if decision.chosen else _needed(base)
    return base if wanted else None


def _twin_with(given: Twin, row: Json) -> Twin:
    """The twin of a row: its characteristics and effects in the twin file that was diagnosed."""
    shown = _written(row)
    twin = given.with_changes(shown["vehicle"])
    specs = tuple(
        EffectSpec(id=e, parameters={name: p["value"] for name, p in shown["parameters"][e].items()})
        for e in shown.get("effects", ())
    )
    return having_effects(twin.model_copy(update={"effects": given.effects, "road": given.road}), specs)


def _read(path: Path) -> Json:
    if not path.is_file():
        raise InputError(str(path.parent), f"holds no {path.name}: it is no folder of a diagnosis")
    with reading(path, "a file of a diagnosis"):
        found = read_json(path)
    if not isinstance(found, dict):
        raise InputError(str(path), "is no diagnosis")
    return found


def write(result: DiagnosisResult, folder: Path) -> None:
    """Write ``diagnosis.json``, ``evidence.json`` and ``twin.yaml`` to ``folder``, which is made.

    A twin that was not changed is handed back as it came: the text of its file.
    """
    write_text(folder / "evidence.json", json.dumps(result.evidence, allow_nan=False) + "\n")
    write_document(result.document, folder)
    hand_on(result.twin, Path(result.evidence.get("twin", "")), folder / "twin.yaml")


def write_anew(document: Json, twin: Twin | None, kept: Path, folder: Path) -> None:
    """Write ``diagnosis.json``, and ``twin.yaml`` where there is a twin, of what :func:`decided_anew` made of
    ``kept``."""
    write_document(document, folder)
    if twin is not None:
        hand_on(twin, Path(_read(kept / "evidence.json")["twin"]), folder / "twin.yaml")


def hand_on(twin: Twin, given: Path, path: Path) -> None:
    """Write ``twin`` to ``path``: the text of the ``given`` file where it is the twin of that file, paths in it as they
    are from the new place."""
    if not given.is_file() or load_twin(given) != twin:
        save_twin(twin, path)
        return
    text = read_text(given)
    if twin.road is not None and given.parent.resolve() != path.parent.resolve():
        here, there = (
            Path(os.path.relpath(twin.road.file, p.parent.resolve())).as_posix() for p in (given, path)
        )
        text = re.sub(rf"(\bfile: *[\"']?)(\./)?{re.escape(here)}(?![\w./-])", rf"\g<1>{there}", text)
    if twin_of_text(text, path) == twin:
        write_text(path, text)
    else:  # the file writes the path of its road in another way
        save_twin(twin, path)


def write_document(document: Json, folder: Path) -> None:
    """Write ``diagnosis.json`` to ``folder``."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)
    write_text(folder / "diagnosis.json", text + "\n")
