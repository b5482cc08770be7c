# SPDX-License-Identifier: Apache-2.0
"""From findings to the document of diagnosis.json and the twin with the named effects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import verdict
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.case import Case
from suspension_twin.diagnosis.evidence import Blocks, intervals
from suspension_twin.diagnosis.experiment import next_experiment
from suspension_twin.diagnosis.fit import Fit, linearised_fit, twin_of
from suspension_twin.diagnosis.hypotheses import library
from suspension_twin.diagnosis.local_road_error import (
    RoadErrorMatch,
    concentrated_section,
    no_concentration,
    no_road_error,
    road_error_matches,
)
from suspension_twin.diagnosis.localisation import localise, signature
from suspension_twin.diagnosis.request import DiagnosisRequest, DiagnosisResult, DriveView
from suspension_twin.diagnosis.selection import Findings
from suspension_twin.diagnosis.shrink import RemainingResidual, Shrink, gap_rows, shrink_of
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.gap.measure import channel_unit
from suspension_twin.models.parameters import pack
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.vehicle.twin import Twin

__all__ = ["conclude"]

_RUNNER_UP = 0.01  # probability of a second cause from which on a drive is proposed to separate it
_LEAST_RESEMBLANCE = 0.1  # probability of a decoy from which on it is reported
_TIED = 0.05  # win rate of the second cause from which on both are indistinguishable


def conclude(request: DiagnosisRequest, case: Case, found: Findings, seconds: float) -> DiagnosisResult:
    """The document of diagnosis.json, the twin with what was found, and what the report shows."""
    judged, bench = found.judged, found.judged.bench
    channel = bench.problem.channels[0]
    base_shrink = _shrink(bench, found, judged.remaining[0], request.seed)
    beyond = np.array(
        [
            shrink_of(
                bench,
                judged.remaining[0],
                r,
                judged.blocks,
                judged.noise[channel],
                0,
                request.seed,
            ).shrink
            for r in judged.remaining[1:]
        ]
    )
    dominance, foreign = judged.dominance, None
    if judged.reference is not None:
        foreign = 1.0 - np.sqrt(1.0 - found.explained_shares)  # of the rms, as the other shrinks
        dominance = (
            dominance * found.explained_shares
        )  # what is measured to be there still is not explained by gaining more than others
    effects, no_gap, unknown = verdict.masses(
        judged.weights, judged.gates, found.explained_shares, judged.undetectable, dominance
    )
    unknown += float(judged.decoys.probability.sum())
    chosen = found.chosen.found.fit.hypothesis.effects
    if len(chosen) > 1:
        effects, unknown = _split_over_set(found, effects, unknown, chosen, found.explained_share)
    # all members of a set are present: they need not be distinguishable one by one
    groups = _groups(found, effects) if len(chosen) < 2 else []
    remaining = 1.0 - _shrink(bench, found, found.chosen.remaining, request.seed).shrink
    adequate = found.gates.adequate
    named, known = [*groups, list(_places(found, chosen))], judged.reference is not None
    answer, section = verdict.verdict_of(effects, no_gap, unknown, adequate, remaining, named, known), None
    if answer in ("no_gap", "unknown") and case.road:
        section, surveyed = _road_section(case, bench, found, request.effects)
        no_gap, unknown = no_gap * surveyed, unknown + no_gap * (1.0 - surveyed)
        answer = verdict.verdict_of(effects, no_gap, unknown, adequate, remaining, named, known)
    kept = found.chosen.found if answer in ("effect", "partly") else judged.base
    kept_remaining = found.chosen.remaining if kept is found.chosen.found else judged.remaining[0]
    twin = twin_of(bench, kept.fit)
    shrink = _shrink(bench, found, kept_remaining, request.seed)
    causes = _causes(bench, found, effects, beyond, foreign, groups, request.seed)
    # without a road blocks do not repeat: the discrepancy is independent from block to block
    _add_intervals(bench, judged.blocks, kept.fit, judged.temper if case.road else 1.0, causes)
    document: dict[str, Any] = {
        "verdict": answer,
        "gap": _gap(bench, found),
        "where": localise(
            bench,
            judged.remaining[0].difference,
            judged.noise,
            twin_of(bench, judged.base.fit),
        ),
        "causes": causes,
        "no_gap_probability": round(float(no_gap), 6),
        "unknown_probability": round(float(unknown), 6),
        "combination": list(kept.fit.hypothesis.effects),
        "unexplained": _round(1.0 - shrink.shrink),
        "recalibration": {
            "gap_before": _round(base_shrink.before),
            "gap_after": _round(base_shrink.after),
            "shrink": _round(base_shrink.shrink),
            "shrink_interval": [_round(v) for v in base_shrink.interval],
        },
        "background": {
            "share_of_motion_left": _round(
                verdict.relative_residual(bench, kept_remaining, judged.noise, case.driven, with_gap=True)
            ),
            "share_left_on_reference": None if judged.reference is None else _round(judged.reference),
            "noise_share_of_residual": _round(judged.temper),
        },
        "cannot_be_judged": [s.effect for s in judged.singles if not s.judged],
        "warnings": list(case.warnings),
    }
    if answer in ("unknown", "partly"):
        document["signature"] = signature(bench, kept_remaining.difference, twin)
        document["signature"]["resembles"] = _resembles(bench, found, request.seed)
        document["signature"].update(_periodic(case, bench, kept_remaining))
        if section is not None:
            document["signature"]["stretch"] = section
    tied = [judged.singles[i] for i in (groups[0] if groups else [])]
    if len(tied) < 2 and len(chosen) < 2:
        leading = [c["effect"] for c in causes[:2] if c["probability"] > _RUNNER_UP]
        tied = [s for name in leading for s in judged.singles if s.effect == name]
    document["next_experiment"] = (
        f"Survey the road from {section['start_m']:.0f} to {section['end_m']:.0f} m again: no drive changes its file."
        if section is not None and answer == "unknown" and _has_road_error(section)
        else next_experiment(case, tied, answer, judged)
    )
    document["seed"] = request.seed
    document["message"] = _message(answer, document, shrink)
    views = _views(case, bench, twin, twin_of(bench, judged.base.fit))
    return DiagnosisResult(document, twin, views, seconds, case.warnings)


def _periodic(case: Case, bench: Bench, remaining: RemainingResidual) -> dict[str, Any]:
    """The strongest tonal component of the remaining residual, by period in m or by frequency in Hz; empty if none."""
    free, tone = verdict.free_of_tones(bench, remaining) if case.road else (1.0, None)
    if tone is None or free > 0.5:
        return {}
    at = {"every_m": _round(1.0 / tone.at)} if tone.domain == "distance" else {"hz": _round(tone.at)}
    return {"periodic": {"channel": tone.channel, **at, "share": _round(tone.share)}}


def _road_section(
    case: Case, bench: Bench, found: Findings, only: Sequence[str]
) -> tuple[dict[str, Any] | None, float]:
    """The section of road where the recalibrated residual is concentrated, with the errors of the road file that would
    explain it there (None without one), and the probability that the road file is right there."""
    there = concentrated_section(bench, found.judged.remaining[0], found.judged.noise)
    if there is None:
        return None, 1.0
    of_the_road = [e for e, effect in EFFECTS.items() if effect.where == "road" and (not only or e in only)]
    offered = library(case.twin, True, of_the_road) if of_the_road else {}
    x = found.judged.base.fit.x[: bench.d + bench.q]
    like = road_error_matches(bench, x, there, [h for v in offered.values() for h in v], found.judged.temper)
    surveyed = no_road_error(like)
    if min(no_concentration(there), surveyed) > 0.5:
        return None, surveyed
    named = [
        {
            "effect": one.effect,
            "shrink": _round(one.shrink),
            "parameters": {k.split(".")[2]: float(f"{v:.6g}") for k, v in one.values.items()},
        }
        for one in like
    ]
    return {
        "start_m": there.start,
        "end_m": there.end,
        "share": _round(there.share),
        "resembles": named,
    }, surveyed


def _has_road_error(section: dict[str, Any]) -> bool:
    """Whether an error of the road file explains enough of the residual on the section."""
    found = [RoadErrorMatch(one["effect"], {}, one["shrink"]) for one in section["resembles"]]
    return no_road_error(found) < 0.5


def _resembles(bench: Bench, found: Findings, seed: int) -> list[dict[str, Any]]:
    """Decoy hypotheses that resemble an unexplained gap, the most probable first."""
    like = []
    for i in np.argsort(-found.judged.decoys.probability, kind="stable"):
        if found.judged.decoys.probability[i] > _LEAST_RESEMBLANCE:
            fit = found.judged.decoys.singles[i].fit
            values = dict(zip(fit.hypothesis.keys, fit.effects(bench), strict=True))
            like.append(
                {
                    "effect": found.judged.decoys.singles[i].effect,
                    "probability": round(float(found.judged.decoys.probability[i]), 6),
                    "parameters": {k.split(".")[2]: float(f"{float(v):.6g}") for k, v in values.items()},
                    "shrink": _round(_shrink(bench, found, found.judged.decoys.remaining[i], seed).shrink),
                }
            )
    return like


def _shrink(bench: Bench, found: Findings, after: RemainingResidual, seed: int) -> Shrink:
    channel = bench.problem.channels[0]
    return shrink_of(
        bench,
        found.judged.uncalibrated_residual,
        after,
        found.judged.blocks,
        found.judged.noise[channel],
        0,
        seed,
        new_drive=True,
    )


def _gap(bench: Bench, found: Findings) -> dict[str, Any]:
    rows = gap_rows(bench)
    rms = {
        name: _round(float(np.sqrt(np.mean(found.judged.uncalibrated_residual.difference[rows, c] ** 2))))
        for c, name in enumerate(bench.problem.channels)
    }
    first = bench.problem.channels[0]
    return {
        "rms": rms[first],
        "mse": _round(rms[first] ** 2),
        "noise_rms": _round(found.judged.noise[first]),
        "channel": first,
        "channels": rms,
    }


def _causes(
    bench: Bench,
    found: Findings,
    effects: Floats,
    beyond: Floats,
    foreign: Floats | None,
    groups: list[list[int]],
    seed: int,
) -> list[dict[str, Any]]:
    names = [s.effect for s in found.judged.singles]
    together = dict(
        zip(found.chosen.found.fit.hypothesis.keys, found.chosen.found.fit.effects(bench), strict=True)
    )
    causes = []
    for i in sorted(
        range(len(names)),
        key=lambda i: (-round(float(effects[i]), 9), -float(found.judged.weights[1 + i]), i),
    ):
        single = found.judged.singles[i]
        shrink = _shrink(bench, found, found.judged.remaining[1 + i], seed)
        held = dict(single.fit.hypothesis.fixed)
        values = {
            **held,
            **dict(zip(single.fit.hypothesis.keys, single.fit.effects(bench), strict=True)),
            **{k: v for k, v in together.items() if k.split(".")[1] == names[i]},
        }
        first = single.fit.hypothesis.on_drive(0)[0]
        gate = found.judged.gates[1 + i]
        causes.append(
            {
                "effect": names[i],
                "probability": round(float(effects[i]), 6),
                "parameters": {
                    k.split(".")[2]: float(f"{float(v):.6g}")
                    for k, v in values.items()
                    if k in held or k in first
                },
                "gap_before": _round(shrink.before),
                "gap_after": _round(shrink.after),
                "shrink": _round(shrink.shrink),
                "shrink_interval": [_round(v) for v in shrink.interval],
                "shrink_beyond_recalibration": _round(float(beyond[i])),
                "shrink_beyond_reference": None if foreign is None else _round(float(foreign[i])),
                "indistinguishable_from": [names[j] for g in groups if i in g for j in g if j != i],
                "gates": {
                    "material": _round(gate.material),
                    "adequate": _round(gate.adequate),
                    "plausible": _round(gate.plausible),
                },
                "judged": single.judged,
                "log_evidence": round(single.evidence.over(found.judged.base), 2),
            }
        )
    return causes


def _add_intervals(
    bench: Bench, blocks: Blocks, fit: Fit, temper: float, causes: list[dict[str, Any]]
) -> None:
    """Add the 90 % intervals of the parameters of the written twin to ``causes``."""
    if not fit.hypothesis.effects:
        return
    ends = intervals(bench, linearised_fit(bench, fit.hypothesis, fit.x), blocks, temper)
    for key, row in zip(*fit.hypothesis.on_drive(0), strict=True):
        (low, high), (_, effect, name) = ends[row], key.split(".")
        for cause in causes:
            if cause["effect"] == effect:
                cause.setdefault("parameter_intervals", {})[name] = [_round(low), _round(high)]


def _groups(found: Findings, effects: Floats) -> list[list[int]]:
    """Sets of effects that the evidence does not separate from the most probable one."""
    if not effects.size:
        return []
    lead = int(np.argmax(found.judged.weights[1:]))
    tied = [
        i
        for i, s in enumerate(found.judged.singles)
        if i == lead
        or (
            s.judged
            and found.judged.win_rate[1 + i, 1 + lead] > _TIED
            and found.judged.gates[1 + i].material > 0.3
        )
    ]
    return [tied] if len(tied) > 1 and found.judged.gates[1 + lead].material > 0.3 else []


def _places(found: Findings, chosen: tuple[str, ...]) -> list[int]:
    return [i for i, s in enumerate(found.judged.singles) if s.effect in chosen]


def _split_over_set(
    found: Findings, effects: Floats, unknown: float, chosen: tuple[str, ...], explained_share: float
) -> tuple[Floats, float]:
    """Probabilities where a set is named: its members carry the mass of all effects in equal parts, plus the share of
    ``unknown`` that the set explains. ``explained_share`` is that of the recalibrated gap."""
    good = verdict.retained_share(found.gates, explained_share)
    out = np.zeros_like(effects)
    places = _places(found, chosen)
    out[places] = (float(effects.sum()) + unknown * good) / len(places)
    return out, unknown * (1.0 - good)


def _views(case: Case, bench: Bench, after: Twin, recalibrated: Twin) -> tuple[DriveView, ...]:
    views = []
    channel = bench.problem.channels[0]
    for i, (part, rows, active) in enumerate(
        zip(bench.problem.parts, bench.problem.rows, bench.active, strict=True)
    ):
        if not active:
            continue
        before, middle, found = (
            _simulated(
                part, twin, bench.excitation(i, [e.id for e in twin.effects]), channel, case.kind != "run"
            )
            for twin in (case.twin, recalibrated, after)
        )
        compared = np.zeros(part.t.size, dtype=bool)
        compared[rows] = True
        measured = part.measured[channel]
        views.append(
            DriveView(part.name, part.t, part.position, part.rate, measured, before, middle, found, compared)
        )
    return tuple(views)


def _simulated(part: Any, twin: Twin, excitation: Any, channel: str, on_road: bool) -> Floats:
    """(m,) one simulated channel of a drive or a run."""
    if on_road:
        return np.asarray(part.condition(simulate_twin(twin, excitation))[channel])
    response = simulate_lanes(twin, pack(twin)[:, None], excitation)
    return np.asarray(part.conditioner.apply(response.stacked([channel]))[:, 0, 0])


def _message(answer: str, document: dict[str, Any], shrink: Shrink) -> str:
    gap, unit = document["gap"]["rms"], channel_unit(document["gap"]["channel"])
    if answer == "no_gap":
        return f"no gap: after recalibration the residual of {gap:.3g} {unit} is within noise and model discrepancy"
    if answer == "unknown":
        like, there = document["signature"]["resembles"], document["signature"].get("stretch")
        word = f"; it resembles {_label(like[0]['effect'])}" if like else ""
        if there:
            word += f"; {100 * there['share']:.0f} % of it lies from {there['start_m']:.0f} to {there['end_m']:.0f} m"
            word += (
                f", like {_label(there['resembles'][0]['effect'])} there" if _has_road_error(there) else ""
            )
        return (
            f"unknown: a gap remains ({shrink.after:.3g} {unit}) that nothing in the library explains{word}"
        )
    names = " and ".join(_label(e) for e in document["combination"])
    word = "partly " if answer == "partly" else ""
    low, high = (100.0 * v for v in shrink.interval)
    where = f"({low:.0f} to {high:.0f} %) on held-out data"
    if shrink.shrink < 0.005:
        return f"{word}{names}: it shows, but adding it does not shrink the gap {where}"
    return f"{word}{names}: the gap shrinks by {100 * shrink.shrink:.0f} % {where}"


def _label(effect: str) -> str:
    return effect.replace("_", " ")


def _round(value: float) -> float:
    return float(f"{float(value):.6g}")
