# SPDX-License-Identifier: Apache-2.0
"""Evidence as a file: a row for each hypothesis and one for the case, from which the verdict is made.

The rows hold plain numbers in SI units and nats, so that ``diagnosis.decision`` can decide anew without a drive. The
content of ``evidence.json``:

- ``case``: kind, drives, reference, library, noise and motion by channel;
- ``base``: the recalibrated vehicle without any effect, as a row;
- ``hypotheses``: single effects, decoys and sets of effects, a row each.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.stats import chi2

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.case import Case
from suspension_twin.diagnosis.decision import FORMAT
from suspension_twin.diagnosis.judge import Candidate, Judged, detectable, tempered_gain
from suspension_twin.diagnosis.library import DECOYS, SETUP_CATEGORIES, decoys, library
from suspension_twin.diagnosis.search import FINALISTS
from suspension_twin.diagnosis.shrink import (
    BlockBootstrap,
    RemainingResidual,
    Shrink,
    gap_rows,
    relative_residual,
)
from suspension_twin.diagnosis.usual_errors import UsualErrors, usual_errors
from suspension_twin.diagnosis.where import concentrated_section, strongest_tone, unevenness
from suspension_twin.files import Json
from suspension_twin.inference.cross_validation import Evidence, intervals
from suspension_twin.inference.fit import LinearisedFit, linearised_fit
from suspension_twin.inference.gap import pooled_gap
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.problem import Problem

__all__ = [
    "add_linearised",
    "clock_offsets",
    "evidence_of",
    "refined_row",
    "usual_errors_of",
    "usual_ratio",
]

#: Change of clock and position errors over a drive, from +2 to -2 standard deviations: a slow drift of the GNSS
#: position resembles a clock drift.
_BETWEEN_ENDS = 4.0


def evidence_of(case: Case, judged: Judged, seed: int) -> Json:
    """The content of ``evidence.json``.

    Parameters
    ----------
    case : Case
        The observations.
    judged : Judged
        All hypotheses with their cross-validated evidence.
    seed : int
        Seed of the bootstrap.
    """
    known = _Rows(case, judged, seed)
    order = np.argsort([-tempered_gain(judged, c.found) for c in judged.singles], kind="stable")
    # the remaining residual of as many as can be finalists is looked at for tones and places
    singles = set(order[: FINALISTS[1]].tolist())
    hypotheses = [(c, i in singles) for i, c in enumerate(judged.singles)] + [(c, True) for c in judged.sets]
    rows = side_by_side(lambda pair: known.row(*pair), [(judged.base, False), *hypotheses])
    return {"format": FORMAT, "seed": seed, "case": known.case_row(), "base": rows[0], "hypotheses": rows[1:]}


def refined_row(case: Case, judged: Judged, one: Candidate, seed: int) -> Json:
    """Parameters with intervals, characteristics and shrinks of a hypothesis that was refitted for the twin file."""
    row = _Rows(case, judged, seed).row(one, True)
    _add_intervals(case, judged, linearised_fit(judged.problem.having(one.hypothesis), one.found.fit.x), row)
    return {key: row[key] for key in ("parameters", "vehicle", "channels", "level", "level_fitted")}


def add_linearised(case: Case, judged: Judged, rows: Json, usual: UsualErrors | None) -> None:
    """Add to the rows that could be named what takes a linearisation: 90 % intervals of the parameters and, on a road,
    ``beside``, the nats over recalibration where both stand beside the usual errors of every car."""
    hypotheses = zip([*judged.singles, *judged.sets], rows["hypotheses"], strict=True)
    wanted = [(c, r) for c, r in hypotheses if r["detailed"]]

    def add(pair: tuple[Candidate, Json]) -> float:
        one, row = pair
        fit = linearised_fit(judged.problem.having(one.hypothesis), one.found.fit.x)
        if one is not judged.base and not one.decoy:
            _add_intervals(case, judged, fit, row)
        return 0.0 if usual is None else usual.log_evidence(judged.problem, fit, judged.scale.temper)

    without, *found = side_by_side(add, [(judged.base, rows["base"]), *wanted])
    if usual is not None:
        for (_, row), nats in zip(wanted, found, strict=True):
            row["beside"] = _plain(nats - without)


def usual_errors_of(case: Case, judged: Judged) -> UsualErrors | None:
    """The usual errors of every car beside the vehicle of a case; None without a road."""
    if not case.road:
        return None
    offered = {**library(case.twin, case.excited), **decoys(case.twin, case.excited)}
    referenced = judged.scale.reference is not None
    return usual_errors(judged.problem, judged.base.found.fit.x, offered, referenced)


def _add_intervals(case: Case, judged: Judged, fit: LinearisedFit, row: Json) -> None:
    # without a road blocks do not repeat: the discrepancy is independent from block to block
    temper = judged.scale.temper if case.road else 1.0
    ends = intervals(judged.problem, fit, judged.search.blocks, temper)
    for key, i in zip(*fit.hypothesis.on_drive(0), strict=True):
        _, effect, name = key.split(".")
        row["parameters"][effect][name]["interval"] = _plain(ends[i].tolist())


class _Rows:
    """Rows of a case, all compared with the residuals of the twin as given and of recalibration alone."""

    def __init__(self, case: Case, judged: Judged, seed: int) -> None:
        problem = judged.problem
        self.case, self.judged = case, judged
        self.draws = BlockBootstrap.of(problem, judged.search.blocks, judged.scale.noise, seed)
        self.driven = [c for c, name in enumerate(problem.channels) if name in case.driven]
        self.given = self.draws.squares(judged.scale.uncalibrated.difference)
        self.recalibrated = self._squares(judged.base)

    def _squares(self, one: Candidate) -> list[Floats]:
        """Sums of squares by drive, block and channel with the nuisance parameters at zero and as fitted."""
        return [self.draws.squares(r) for r in (one.remaining.difference, one.remaining.with_nuisances)]

    def case_row(self) -> Json:
        """Kind, drives, reference, library and channels of the case."""
        judged, problem = self.judged, self.judged.problem
        rows = gap_rows(judged.problem)
        motion = np.std(problem.measured.values[rows], axis=0)
        drives = [d for d, active in zip(self.case.drives, self.case.active, strict=True) if active]
        gap = pooled_gap([d.gap(d.simulated(self.case.twin)) for d in drives], problem.channels)
        row = _plain(
            {
                "kind": self.case.kind,
                "reference": judged.scale.reference is not None,
                "level_on_reference": judged.scale.reference,
                "drives": int(sum(judged.problem.data.active)),
                "temper": judged.scale.temper,
                "library": len(set(library(self.case.twin, self.case.excited)) - set(DECOYS)),
                "channels": {
                    name: {
                        "noise": judged.scale.noise[name],
                        "motion": motion[c],
                        "gap": gap.channels[name],
                        "driven": c in self.driven,
                    }
                    for c, name in enumerate(problem.channels)
                },
            }
        )
        return cast(Json, row)

    def row(self, one: Candidate, detailed: bool) -> Json:
        """The row of a hypothesis."""
        judged, found, is_base = self.judged, one.found, one is self.judged.base
        names = judged.problem.channels
        row: Json = {
            "effects": list(one.effects),
            "decoy": one.decoy,
            "detailed": detailed,
            "gain": float((found.score - judged.base.found.score).sum()),
            "gain_fitted": found.fitted - judged.base.found.fitted,
            "tempered_gain": tempered_gain(judged, found),
            "level": self._level(one.remaining, False),
            "level_fitted": self._level(one.remaining, True),
            "mean_squares": {names[c]: v for (c, with_gap), v in found.level.items() if with_gap},
            "channels": self._channels(self._squares(one)),
            **(clock_offsets(judged.problem, found, judged.scale.temper) if self.case.excited else {}),
            "vehicle": _vehicle(judged.problem, one),
        }
        if is_base:
            row["better"] = _shrink_row(self.draws.shrinks(self.given, self._squares(one)[0])[0])
        if judged.base_since is not None:
            since = judged.base_since if is_base else one.since
            over = None if is_base else judged.base_since
            row["since"] = None if since is None else tempered_gain(judged, since, over)
        if one.powers is not None:
            row["detectable"] = detectable(one.powers)
        if not is_base:
            row |= self._parameters(one)
        if len(one.effects) > 1:
            row["added_low"] = self._added(one)
        if (is_base or detailed) and self.case.road:
            row |= self._pattern(one.remaining)
        return cast(Json, _plain(row))

    def _added(self, one: Candidate) -> float:
        """Lower end of the shrink, in the best channel, that each effect of a set adds to the others; the least."""
        own, ends, after = set(one.effects), [], self._squares(one)
        for fewer in (*self.judged.singles, *self.judged.sets):
            if set(fewer.effects) < own and len(fewer.effects) == len(own) - 1:
                pairs = zip(self._squares(fewer), after, strict=True)
                ends.append(max(s.interval[0] for b, a in pairs for s in self.draws.shrinks(b, a)))
        return float(min(ends, default=0.0))

    def _level(self, remaining: RemainingResidual, with_nuisances: bool) -> float:
        """Residual on the drives with the gap as a share of the motion."""
        return relative_residual(
            self.judged.problem, remaining, self.judged.scale.noise, self.case.driven, True, with_nuisances
        )

    def _channels(self, squares: list[Floats]) -> Json:
        """Gap before and after in each channel; ``shrink`` beyond recalibration with its interval.

        Channels that the excitation drives: with nuisance parameters at zero or as fitted, whichever shrinks more
        surely, because an effect may increase or decrease the clock and map offsets that the fit needs. Others: as
        fitted, because biases and tilt make most of the gap there.
        """
        at_zero, fitted = (self.draws.shrinks(b, a) for b, a in zip(self.recalibrated, squares, strict=True))
        written = self.draws.shrinks(self.given, squares[0], new_drive=True)
        out: Json = {}
        for c, name in enumerate(self.judged.problem.channels):
            zero = c in self.driven and fitted[c].interval[0] <= at_zero[c].interval[0]
            out[name] = {
                **_shrink_row(at_zero[c] if zero else fitted[c]),
                "worst": float(min(at_zero[c].shrink, fitted[c].shrink)) if c in self.driven else None,
                "written": _shrink_row(written[c]),
            }
        return out

    def _parameters(self, one: Candidate) -> Json:
        """Parameters by effect with their distance from the prior, and ``usual``, the largest severity over the usual
        error of a twin file, of the smallest effect."""
        problem, hypothesis = self.judged.problem, one.hypothesis
        u, (low, high) = one.found.fit.x[problem.shared :], hypothesis.bounds()
        typical, held = hypothesis.typical(), dict(hypothesis.held)
        values = one.found.fit.effect_values
        parameters: dict[str, Json] = {e: {} for e in hypothesis.effects}
        for key, value in hypothesis.fixed:
            _, effect, name = key.split(".")
            parameters[effect][name] = {"value": float(value)}
        for key, i in zip(*hypothesis.on_drive(0), strict=True):
            _, effect, name = key.split(".")
            parameter = hypothesis.searched[i][1]
            two_sided = not parameter.prior.log and parameter.neutral not in parameter.bounds
            setup = hypothesis.effect(effect).where in SETUP_CATEGORIES
            parameters[effect][name] = {
                "value": float(values[i]),
                "far": 0.0 if setup else abs(float(u[i] - typical[i])),
                "bound": bool(two_sided and not low[i] + 1e-9 < u[i] < high[i] - 1e-9),
                **({"held": held[key]} if key in held else {}),
            }
        usual = usual_ratio(problem, hypothesis, parameters, self.judged.scale.reference is not None)
        return {"parameters": parameters, "usual": usual}

    def _pattern(self, remaining: RemainingResidual) -> Json:
        """Patterns that model discrepancy does not have: a band, a tone, a place."""
        problem, noise = self.judged.problem, self.judged.scale.noise
        tone = strongest_tone(problem, remaining)
        place = concentrated_section(problem, remaining, noise)
        return {
            "band": unevenness(problem, remaining, noise),
            "tone": 0.0 if tone is None else tone.strength,
            "place": 0.0 if place is None else place.beyond,
        }


def clock_offsets(problem: Problem, found: Evidence, temper: float) -> Json:
    """Rms of the clock offsets of the drives in standard deviations of their prior, and the tail probability of all
    timing offsets by chance; empty where no clock is fitted."""
    nuisances = problem.nuisances
    own = [i for i, n in enumerate(nuisances.names) if n.endswith(".clock_offset")]
    if not own:
        return {}
    off = found.fit.x[problem.d + np.array(own)] / nuisances.spread[own]
    placed = sum(n.endswith(("clock_offset", "map_position")) for n in nuisances.names)
    spent = 0.0 if found.penalty is None else found.penalty.at(temper)[0]
    return {
        "clocks": float(np.sqrt(np.mean(off**2))),
        "clocks_by_chance": float(chi2.sf(2.0 * spent, placed)),
    }


def usual_ratio(
    problem: Problem, hypothesis: Hypothesis, parameters: dict[str, Json], referenced: bool
) -> float | None:
    """Largest severity over the usual error of a twin file, of the effect where that is smallest; None where no error
    is usual.

    A reference of the same vehicle (``referenced``) has the usual errors of its twin file, those of time excepted.
    """
    ratios = []
    for effect in (hypothesis.effect(e) for e in hypothesis.effects):
        weight = effect.usual_share * problem.twin.vehicle.mass if effect.usual_share else 0.0
        usual = {name: effect.parameter(name).prior.usual or weight for name in effect.severity}
        if effect.id == "clock_drift":
            usual = {name: max(least, _apparent_drift(problem)) for name, least in usual.items()}
        if (referenced and effect.where != "time") or not all(usual.values()):
            continue
        sizes = {n: parameters[effect.id][n] for n in effect.severity}
        ratios.append(max(abs(p["value"] - p.get("held", 0.0)) / usual[n] for n, p in sizes.items()))
    return float(min(ratios)) if ratios else None


def _shrink_row(one: Shrink) -> Json:
    return {
        "before": one.before,
        "after": one.after,
        "shrink": one.shrink,
        "low": one.interval[0],
        "high": one.interval[1],
    }


def _vehicle(problem: Problem, one: Candidate) -> dict[str, float]:
    """Fitted characteristics by the keys of the twin file."""
    values = problem.space.from_slopes(one.found.fit.x[: problem.d])
    return {k: float(v) for k, v in zip(problem.space.keys, values, strict=True)}


def _apparent_drift(problem: Problem) -> float:
    """Apparent clock drift in ppm by clock and position errors of opposite sign at both ends of the longest drive
    with the gap, within their priors; 0 where neither is fitted."""
    normal = list(zip(problem.nuisances.names, problem.nuisances.spread, strict=True))
    clock, place = (
        max((float(v) for n, v in normal if n.endswith(e)), default=0.0)
        for e in (".clock_offset", ".map_position")
    )
    seconds, speed = 1.0, 1.0
    for drive in {d for d in problem.data.drive_of if problem.data.active[d]}:
        own = [part for part, d in zip(problem.data.parts, problem.data.drive_of, strict=True) if d == drive]
        lasts = float(max(part.t[-1] for part in own) - min(part.t[0] for part in own))
        if lasts > seconds:
            seconds, speed = lasts, max(sum(float(np.ptp(part.position)) for part in own) / lasts, 1.0)
    return 1e6 * _BETWEEN_ENDS * float(np.hypot(clock, place / speed)) / seconds


def _plain(value: object) -> object:
    """Numbers of six digits and plain containers, as JSON has them; what is not finite is None."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, bool | str | int) or value is None:
        return value
    number = float(value)  # type: ignore[arg-type]
    return float(f"{number:.6g}") if np.isfinite(number) else None
