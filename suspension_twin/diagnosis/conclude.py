# SPDX-License-Identifier: Apache-2.0
"""From evidence to the document of diagnosis.json and the twin with the named effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import wording
from suspension_twin.diagnosis.answer import WITH_SIGNATURE, answer_of, kept_row, leading_channel, rounded
from suspension_twin.diagnosis.case import Case
from suspension_twin.diagnosis.decision import Decision, decide, learnt, usual
from suspension_twin.diagnosis.features import add_linearised, evidence_of, refined_row, usual_errors_of
from suspension_twin.diagnosis.judge import Candidate, Judged, candidate
from suspension_twin.diagnosis.library import NUISANCE_COUNTERPART, library
from suspension_twin.diagnosis.next_experiment import next_experiment
from suspension_twin.diagnosis.recalibration import recalibrated
from suspension_twin.diagnosis.request import DiagnosisRequest, DiagnosisResult, DriveView
from suspension_twin.diagnosis.shrink import RemainingResidual
from suspension_twin.diagnosis.where import (
    concentrated_section,
    localise,
    road_error_matches,
    signature,
    strongest_tone,
)
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.files import Json
from suspension_twin.inference.cross_validation import evidence
from suspension_twin.inference.fit import LONG, ROUGH, fitted, twin_of
from suspension_twin.inference.observation import Observation
from suspension_twin.inference.problem import REACH, Problem
from suspension_twin.models.parameters import pack
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.vehicle.twin import Twin

__all__ = ["conclude"]

#: Verdicts that a reference may settle, and what is said of a twin that was calibrated and has none.
_OPEN = ("suspected", "unknown")
_OWN_REFERENCE = (
    "Diagnose again with --reference and a drive on which the twin was calibrated, if nothing was wrong then: it shows "
    "how well the model follows the sound vehicle."
)


def conclude(
    request: DiagnosisRequest, case: Case, judged: Judged, seconds: float, foreign: bool = False
) -> DiagnosisResult:
    """The document of diagnosis.json, its evidence, the twin with what was found, and what the report shows; with a
    ``foreign`` reference, of another vehicle or set-up, the answer is unknown."""
    bags, reference = ([str(Path(b).resolve()) for b in own] for own in (request.bags, request.reference))
    asked = {"bags": bags, "reference": reference, "effects": list(request.effects)}
    rows = {
        "twin": str(Path(request.twin).resolve()),
        "asked": asked,
        **evidence_of(case, judged, request.seed),
    }
    if foreign:
        rows["case"]["foreign_reference"] = True
    usual = usual_errors_of(case, judged)
    add_linearised(case, judged, rows, usual)
    rows["base"]["recalibrated"] = (
        recalibrated(judged, case.twin, request.seed, usual) if case.excited else []
    )
    decision = decide(rows, request.costs)
    kept = _of_row(judged, rows, decision)
    if kept is not judged.base:
        kept, problem = _refined(judged, kept)
        assert decision.row is not None
        decision.row["refined"] = refined_row(case, replace(judged, problem=problem), kept, request.seed)
    base = twin_of(judged.problem, judged.base.found.fit)
    twin = twin_of(judged.problem, kept.found.fit) if kept_row(rows, decision) is not None else case.twin
    document = answer_of(rows, decision)
    document["where"] = localise(judged.problem, judged.base.remaining.difference, judged.scale.noise, base)
    section = _road_section(case, judged, request.effects) if case.road and kept is judged.base else None
    if document["verdict"] in WITH_SIGNATURE:
        document["signature"] = {
            **signature(judged.problem, kept.remaining.difference, twin if kept is not judged.base else base),
            "resembles": _resembles(decision),
            **(_periodic(judged.problem, kept.remaining) if case.road else {}),
        }
        if section is not None:
            document["signature"]["stretch"] = section
    text, drive = _next(case, judged, decision, document, section)
    if document["verdict"] in _OPEN and all(case.active) and case.twin.uncertainty:
        text = f"{_OWN_REFERENCE} {text}"
    document["next_experiment"] = text
    if drive:
        document["next_drive"] = drive
    document["warnings"] = list(case.warnings)
    document["seed"], document["message"] = request.seed, wording.message(document)
    main = judged.problem.channels[0]
    closing = main if decision.row is None else leading_channel(decision.row)
    views = _views(judged.problem, case.twin, twin, closing)
    return DiagnosisResult(document, twin, views, seconds, case.warnings, rows, case.twin)


def _of_row(judged: Judged, rows: Json, decision: Decision) -> Candidate:
    """The hypothesis of the row that was decided for."""
    hypotheses = [*judged.singles, *judged.sets]
    for one, row in zip(hypotheses, rows["hypotheses"], strict=True):
        if row is decision.row:
            return one
    return judged.base


def _refined(judged: Judged, one: Candidate) -> tuple[Candidate, Problem]:
    """A hypothesis refitted in the time steps of the drives, and the problem that it was refitted on.

    Without a reference the nuisance parameters of the same action are frozen, so that the effect holds the whole
    error. With a reference that part belongs to the state before the change and is left to the nuisance parameters.
    The prior said how likely such an effect is. Its true size may be larger: each coordinate has the standard deviation
    that makes it likeliest (type II maximum likelihood), at least 1.
    """
    given, hypothesis = judged.problem, one.hypothesis
    fine = replace(given.having(hypothesis), simulation=replace(given.simulation, step=None))
    fit = fitted(fine, [one.found.fit.x], ROUGH)
    far = np.maximum(np.abs(fit.x[fine.shared :] - hypothesis.centre()), 1.0)
    if np.any(far > 1.0):
        spread = dict(zip(hypothesis.keys, far.tolist(), strict=True))
        fine = replace(fine, prior=replace(fine.prior, spread=spread))
        fit = fitted(fine, [fit.x], LONG)
    same = tuple(n for e in hypothesis.effects for n in NUISANCE_COUNTERPART.get(e, ()))
    if same and judged.scale.reference is None:
        frozen = replace(fine, prior=replace(fine.prior, frozen=same))
        whole = fitted(frozen, [fit.x], LONG)
        # not more than a nuisance parameter at the end of its reach costs
        if whole.cost <= fit.cost + REACH**2:
            fine, fit = frozen, whole
    problem = fine.having(given.hypothesis)
    return candidate(replace(judged, problem=problem), evidence(fine, fit, judged.search.blocks)), problem


def _next(
    case: Case, judged: Judged, decision: Decision, document: Json, section: Json | None
) -> tuple[str, Json]:
    if section is not None and section["like"] and document["verdict"] == "unknown":
        span = f"from {section['start_m']:.0f} to {section['end_m']:.0f} m"
        return f"Survey the road {span} again: no drive changes its file.", {}
    rivals = (
        []
        if len(document["combination"]) > 1
        else [r for c in decision.candidates if (r := _rival(judged, c))]
    )
    if document["verdict"] in ("suspected", "unknown"):
        # an unknown cause cannot be simulated: the likeliest of the library is told from none by another drive
        leading = [c for c in judged.singles if c.effects == (document["causes"][0]["effect"],)]
        rivals = list({c.effects: c for c in (*rivals, *leading, judged.base)}.values())
    return next_experiment(case, rivals, document["verdict"], judged)


def _rival(judged: Judged, causes: tuple[str, ...]) -> Candidate | None:
    """The hypothesis of one of the decision's candidates; None of a set, and of an unknown cause."""
    if not causes:
        return judged.base
    return next((c for c in judged.singles if c.effects == causes), None)


def _periodic(problem: Problem, remaining: RemainingResidual) -> Json:
    """The strongest tonal component of the remaining residual, by period in m or by frequency in Hz; empty if it is as
    those of cars without any fault."""
    tone = strongest_tone(problem, remaining)
    if tone is None or tone.strength <= usual("tone"):
        return {}
    at = {"every_m": rounded(1.0 / tone.at)} if tone.domain == "distance" else {"hz": rounded(tone.at)}
    return {"periodic": {"channel": tone.channel, **at, "share": rounded(tone.share)}}


def _road_section(case: Case, judged: Judged, only: Sequence[str]) -> Json | None:
    """The section of road where the recalibrated residual is concentrated, with the errors of the road file that would
    explain it there, ``like`` whether one does; None without a section."""
    problem = judged.problem
    there = concentrated_section(problem, judged.base.remaining, judged.scale.noise)
    if there is None:
        return None
    of_the_road = [e for e, effect in EFFECTS.items() if effect.where == "road" and (not only or e in only)]
    offered = library(case.twin, True, of_the_road) if of_the_road else {}
    x = judged.base.found.fit.x[: problem.shared]
    like = road_error_matches(
        problem, x, there, [h for v in offered.values() for h in v], judged.scale.temper
    )
    if there.beyond <= usual("place") and not like:
        return None
    named = [
        {
            "effect": one.effect,
            "shrink": rounded(one.shrink),
            "parameters": {k.split(".")[2]: rounded(v) for k, v in one.values.items()},
        }
        for one in like
    ]
    return {
        "start_m": there.start,
        "end_m": there.end,
        "share": rounded(there.share),
        "resembles": named,
        "like": bool(like),
    }


def _resembles(decision: Decision) -> list[Json]:
    """Decoy hypotheses that resemble an unexplained gap, the most probable first."""
    pairs = zip(decision.answers, decision.probability, strict=True)
    like = [
        {
            "effect": a.row["effects"][0],
            "probability": round(float(p), 6),
            "parameters": {n: v["value"] for n, v in a.row["parameters"][a.row["effects"][0]].items()},
            "shrink": next(iter(a.row["channels"].values()))["written"]["shrink"],
        }
        for a, p in pairs
        if a.row is not None and a.row["decoy"] and p >= learnt().conformal
    ]
    return sorted(like, key=lambda one: -float(str(one["probability"])))


def _views(problem: Problem, given: Twin, after: Twin, channel: str) -> tuple[DriveView, ...]:
    """One channel of every drive with the gap, by the twin as given and with the named effects."""
    data, views = problem.data, []
    for part, rows, drive in zip(data.parts, data.rows, data.drive_of, strict=True):
        if not data.active[drive]:
            continue
        before, found = (_simulated(problem, part, twin, channel) for twin in (given, after))
        compared = np.zeros(part.t.size, dtype=bool)
        compared[rows] = True
        views.append(
            DriveView(
                name=part.name,
                channel=channel,
                rate=part.rate,
                t=part.t,
                position=part.position,
                measured=part.measured[channel],
                simulated={"before": before, "after": found},
                compared=compared,
            )
        )
    return tuple(views)


def _simulated(problem: Problem, part: Observation, twin: Twin, channel: str) -> Floats:
    """(m,) one simulated channel of a drive or a run, which the effects of the twin may read in another way."""
    if part.reading is None:
        response = simulate_lanes(twin, pack(twin)[:, None], part.excitation)
        return np.asarray(part.apply(response.stacked([channel]))[:, 0, 0])
    own = [e.id for e in problem.twin.effects]
    correction = part.reading.correction([e.id for e in twin.effects], own, problem.simulation.upright)
    excitation = part.reading.excitation(correction, problem.simulation.step)
    return part.condition(simulate_twin(twin, excitation))[channel]
