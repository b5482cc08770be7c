# SPDX-License-Identifier: Apache-2.0
"""Evidence as a file: what the verdict is made from, one row a hypothesis and one for the case.

The rows hold plain numbers in SI units and nats, so that ``diagnosis.decision`` can decide anew without a drive. The
content of ``evidence.json``:

- ``case``: what was driven and how well it was measured;
- ``base``: the recalibrated vehicle without any effect, as a row;
- ``hypotheses``: single effects, decoys and sets of effects, a row each.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import chi2

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.case import Case
from suspension_twin.diagnosis.decision import FORMAT, Json
from suspension_twin.diagnosis.evidence import Evidence, intervals
from suspension_twin.diagnosis.fit import linearised_fit
from suspension_twin.diagnosis.hypotheses import DECOYS, SETUP_CATEGORIES, Hypothesis, library
from suspension_twin.diagnosis.judge import Candidate, Judged, tempered_gain
from suspension_twin.diagnosis.search import LEAST_POWER
from suspension_twin.diagnosis.shrink import (
    BlockBootstrap,
    RemainingResidual,
    Shrink,
    gap_rows,
    relative_residual,
)
from suspension_twin.diagnosis.where import concentrated_section, strongest_tone, unevenness
from suspension_twin.inference.parallel import side_by_side

__all__ = ["add_intervals", "clock_offsets", "evidence_of", "refined_row", "usual_ratio"]

#: Single effects, the best by evidence, whose remaining residual is looked at for tones and places.
_DETAILED = 6
#: Share of the mean square of a channel from which on a tonal component is looked for.
_TONE_SHARE = 0.1
#: Change of clock and position errors over a drive, from +2 to -2 standard deviations: a slow drift of the GNSS
#: position resembles a clock drift.
_BETWEEN_ENDS = 4.0


def evidence_of(case: Case, judged: Judged, seed: int) -> dict[str, Any]:
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
    draws = BlockBootstrap.of(judged.bench, judged.blocks, judged.noise, seed)
    known = _Known(case, judged, draws)
    order = np.argsort([-tempered_gain(judged, c.found) for c in judged.singles], kind="stable")
    detailed = {id(judged.singles[i]) for i in order[:_DETAILED]} | {id(c) for c in judged.sets}
    hypotheses = [*judged.singles, *judged.sets]
    rows = side_by_side(lambda c: known.row(c, id(c) in detailed), [judged.base, *hypotheses])
    return {"format": FORMAT, "seed": seed, "case": known.case_row(), "base": rows[0], "hypotheses": rows[1:]}


def refined_row(case: Case, judged: Judged, one: Candidate, seed: int) -> Json:
    """What the twin file with a hypothesis is shown by: its parameters with intervals, characteristics and shrinks."""
    known = _Known(case, judged, BlockBootstrap.of(judged.bench, judged.blocks, judged.noise, seed))
    row = known.row(one, True)
    _add_intervals(case, judged, one, row)
    return {key: row[key] for key in ("parameters", "vehicle", "channels", "level", "level_fitted")}


def add_intervals(case: Case, judged: Judged, rows: dict[str, Any]) -> None:
    """Add the 90 % intervals of the parameters to the rows that could be named."""
    hypotheses = zip([*judged.singles, *judged.sets], rows["hypotheses"], strict=True)
    wanted = [(c, r) for c, r in hypotheses if r["detailed"] and not c.decoy]
    side_by_side(lambda pair: _add_intervals(case, judged, *pair), wanted)


def _add_intervals(case: Case, judged: Judged, one: Candidate, row: Json) -> None:
    # without a road blocks do not repeat: the discrepancy is independent from block to block
    temper = judged.temper if case.road else 1.0
    fit = linearised_fit(judged.bench, one.hypothesis, one.found.fit.x)
    ends = intervals(judged.bench, fit, judged.blocks, temper)
    for key, i in zip(*one.hypothesis.on_drive(0), strict=True):
        _, effect, name = key.split(".")
        row["parameters"][effect][name]["interval"] = _plain(ends[i].tolist())


class _Known:
    """What all rows are compared with."""

    def __init__(self, case: Case, judged: Judged, draws: BlockBootstrap) -> None:
        self.case, self.judged, self.draws = case, judged, draws
        bench = judged.bench
        self.rows = gap_rows(bench)
        self.motion = np.std(bench.problem.measured.values[self.rows], axis=0)
        self.driven = [c for c, name in enumerate(bench.problem.channels) if name in case.driven]
        self.given = draws.squares(judged.uncalibrated.difference)
        self.recalibrated = [
            draws.squares(r) for r in (judged.base.remaining.difference, judged.base.remaining.with_nuisances)
        ]

    def case_row(self) -> Json:
        """What was driven and how well it was measured."""
        bench, judged = self.judged.bench, self.judged
        problem = bench.problem
        parts = [
            (p, r)
            for p, r, d in zip(problem.parts, problem.rows, problem.drive_of, strict=True)
            if bench.active[d]
        ]
        seconds = sum(r.size / p.rate for p, r in parts)
        row: Json = {
            "kind": self.case.kind,
            "reference": judged.reference is not None,
            "level_on_reference": judged.reference,
            "drives": int(sum(bench.active)),
            "seconds": seconds,
            "rate": float(problem.measured.rate),
            "blocks": int(self.draws.used.size),
            "temper": judged.temper,
            "library": len(set(library(self.case.twin, self.case.excited)) - set(DECOYS)),
            "channels": {
                name: {
                    "noise": judged.noise[name],
                    "motion": float(self.motion[c]),
                    "gap": float(np.sqrt(np.mean(judged.uncalibrated.difference[self.rows, c] ** 2))),
                    "driven": c in self.driven,
                }
                for c, name in enumerate(problem.channels)
            },
        }
        if self.case.road:
            speeds = np.concatenate([np.abs(p.along[r]) for p, r in parts])
            low, high = np.quantile(speeds, [0.05, 0.95])
            row["speed"] = {"low": float(low), "high": float(high), "mean": float(speeds.mean())}
        plain: Json = _plain(row)
        return plain

    def row(self, one: Candidate, detailed: bool) -> Json:
        """The row of a hypothesis."""
        judged, found, is_base = self.judged, one.found, one is self.judged.base
        bench = judged.bench
        temper = judged.temper
        gains = found.score - judged.base.found.score
        row: Json = {
            "effects": list(one.effects),
            "decoy": one.decoy,
            "detailed": detailed,
            "gain": float(gains.sum()),
            "gain_fitted": found.fitted - judged.base.found.fitted,
            "spread": float(np.sqrt(gains.size * np.var(gains))),
            "occam": found.occam - judged.base.found.occam,
            "tempered_gain": tempered_gain(judged, found),
            "freedom": self._freedom(found),
            "folds": self._folds(gains),
            "level": self._level(one.remaining, False),
            "level_fitted": self._level(one.remaining, True),
            "mean_squares": self._mean_squares(found, True),
            "mean_squares_on_reference": self._mean_squares(found, False),
            "channels": self._channels(one.remaining),
            **(clock_offsets(bench, found, temper) if self.case.excited else {}),
            "vehicle": _vehicle(bench, one),
        }
        if judged.base_since is not None:
            since = judged.base_since if is_base else one.since
            row["since"] = None if since is None else tempered_gain(judged, since, judged.base_since)
            if is_base:
                row["since"] = tempered_gain(judged, judged.base_since)
        if one.preexisting is not None:
            row["preexisting"] = tempered_gain(judged, one.preexisting)
        if one.powers is not None:
            row["power"] = float(one.powers.max())
            row["detectable"] = bool(one.powers.max() >= LEAST_POWER)
            row["undetectable"] = float(np.mean(temper * one.powers < LEAST_POWER))
        if not is_base:
            row |= self._parameters(one)
        if len(one.effects) > 1:
            row["added_low"] = self._added(one)
        if is_base or detailed:
            row |= self._pattern(one.remaining)
        plain: Json = _plain(row)
        return plain

    def _added(self, one: Candidate) -> float:
        """Lower end of the shrink, in the best channel, that each effect of a set adds to the others; the least."""
        own, ends = set(one.effects), []
        squares = [self.draws.squares(r) for r in (one.remaining.difference, one.remaining.with_nuisances)]
        for fewer in (*self.judged.singles, *self.judged.sets):
            if set(fewer.effects) < own and len(fewer.effects) == len(own) - 1:
                before = (fewer.remaining.difference, fewer.remaining.with_nuisances)
                pairs = zip(before, squares, strict=True)
                found = [s for b, a in pairs for s in self.draws.shrinks(self.draws.squares(b), a)]
                ends.append(max(s.interval[0] for s in found))
        return float(min(ends, default=0.0))

    def _folds(self, gains: Floats) -> float:
        """Share of the folds that gain."""
        fold = self.judged.blocks.fold(np.arange(gains.size))
        return float(np.mean(np.bincount(fold, gains) > 0.0))

    def _freedom(self, found: Evidence) -> float:
        """Nats of Occam's factor beyond that of recalibration: how much of the prior the tempered data rule out."""
        own, base = found.penalty, self.judged.base.found.penalty
        if own is None or base is None:
            return 0.0
        return own.at(self.judged.temper)[1] - base.at(self.judged.temper)[1]

    def _level(self, remaining: RemainingResidual, with_nuisances: bool) -> float:
        """Residual on the drives with the gap as a share of the motion."""
        return relative_residual(
            self.judged.bench, remaining, self.judged.noise, self.case.driven, True, with_nuisances
        )

    def _mean_squares(self, found: Evidence, with_gap: bool) -> dict[str, float]:
        """Held-out mean square in units of the noise model, by channel."""
        names = self.judged.bench.problem.channels
        return {names[c]: v for (c, side), v in found.level.items() if side == with_gap}

    def _channels(self, remaining: RemainingResidual) -> Json:
        """Gap before and after in each channel; ``shrink`` beyond recalibration with its interval.

        Channels that the excitation drives: with nuisance parameters at zero or as fitted, whichever shrinks more
        surely, because an effect may increase or decrease the clock and map offsets that the fit needs. Others: as
        fitted, because biases and tilt make most of the gap there.
        """
        draws, both = self.draws, (remaining.difference, remaining.with_nuisances)
        squares = [draws.squares(r) for r in both]
        beyond = [draws.shrinks(b, a) for b, a in zip(self.recalibrated, squares, strict=True)]
        written = draws.shrinks(self.given, squares[0], new_drive=True)
        out: Json = {}
        for c, name in enumerate(self.judged.bench.problem.channels):
            way = int(beyond[1][c].interval[0] > beyond[0][c].interval[0]) if c in self.driven else 1
            out[name] = {
                **_shrink_row(beyond[way][c]),
                "fitted": bool(way),
                "worst": float(min(beyond[0][c].shrink, beyond[1][c].shrink)) if c in self.driven else None,
                "written": _shrink_row(written[c]),
            }
        return out

    def _parameters(self, one: Candidate) -> Json:
        """Parameters by effect, with their prior; ``usual`` is the largest severity over the usual error of a twin
        file, of the smallest effect; ``signs`` the share of folds in which the main parameter keeps its sign."""
        bench, hypothesis = self.judged.bench, one.hypothesis
        p = bench.d + bench.q
        u, (low, high) = one.found.fit.x[p:], hypothesis.bounds()
        values = one.found.fit.effects(bench)
        parameters: dict[str, dict[str, Json]] = {e: {} for e in hypothesis.effects}
        for key, value in hypothesis.fixed:
            _, effect, name = key.split(".")
            parameters[effect][name] = {"value": float(value)}
        for key, i in zip(*hypothesis.on_drive(0), strict=True):
            _, effect, name = key.split(".")
            parameter = hypothesis.searched[i][1]
            two_sided = not parameter.log and parameter.neutral not in (parameter.low, parameter.high)
            setup = hypothesis.effect(effect).where in SETUP_CATEGORIES
            parameters[effect][name] = {
                "value": float(values[i]),
                "z": float(u[i]),
                "far": 0.0 if setup else abs(float(u[i])),
                "bound": bool(two_sided and not low[i] + 1e-9 < u[i] < high[i] - 1e-9),
            }
        row: Json = {
            "parameters": parameters,
            "usual": usual_ratio(bench, hypothesis, parameters, self.judged.reference is not None),
        }
        row["where"] = sorted({hypothesis.effect(e).where for e in hypothesis.effects})
        row["resonance"] = hypothesis.scan(1) is not None
        if u.size:
            main = int(np.argmax(np.abs(u)))
            row["signs"] = float(np.mean(np.sign(one.found.unknowns[p + main]) == np.sign(u[main])))
        return row

    def _pattern(self, remaining: RemainingResidual) -> Json:
        """Patterns that model discrepancy does not have: a band, a tone, a place."""
        if not self.case.road:
            return {}
        bench, noise = self.judged.bench, self.judged.noise
        tone = strongest_tone(bench, remaining, _TONE_SHARE)
        place = concentrated_section(bench, remaining, noise)
        return {
            "band": unevenness(bench, remaining, noise),
            "tone": 0.0 if tone is None else tone.strength,
            "place": 0.0 if place is None else place.beyond,
        }


def clock_offsets(bench: Bench, found: Evidence, temper: float) -> Json:
    """Rms of the clock offsets of the drives in standard deviations of their prior, and the tail probability of all
    timing offsets by chance; empty where no clock is fitted."""
    nuisances = bench.problem.nuisances
    own = [i for i, n in enumerate(nuisances.names) if n.endswith(".clock_offset")]
    if not own:
        return {}
    off = found.fit.x[bench.d + np.array(own)] / nuisances.spread[own]
    placed = sum(n.endswith(("clock_offset", "map_position")) for n in nuisances.names)
    spent = 0.0 if found.penalty is None else found.penalty.at(temper)[0]
    return {
        "clocks": float(np.sqrt(np.mean(off**2))),
        "clocks_by_chance": float(chi2.sf(2.0 * spent, placed)),
    }


def usual_ratio(
    bench: Bench, hypothesis: Hypothesis, parameters: dict[str, dict[str, Json]], referenced: bool
) -> float | None:
    """Largest severity over the usual error of a twin file, of the effect where that is smallest; None where no error
    is usual.

    A reference of the same vehicle (``referenced``) has the usual errors of its twin file, those of time excepted.
    """
    ratios = []
    for effect in (hypothesis.effect(e) for e in hypothesis.effects):
        weight = effect.usual_share * bench.problem.twin.vehicle.mass if effect.usual_share else 0.0
        usual = {name: effect.parameter(name).usual or weight for name in effect.severity}
        if effect.id == "clock_drift":
            usual = {name: max(least, _apparent_drift(bench)) for name, least in usual.items()}
        if (referenced and effect.where != "time") or not all(usual.values()):
            continue
        ratios.append(max(abs(parameters[effect.id][n]["value"]) / usual[n] for n in effect.severity))
    return float(min(ratios)) if ratios else None


def _shrink_row(one: Shrink) -> Json:
    return {
        "before": one.before,
        "after": one.after,
        "shrink": one.shrink,
        "low": one.interval[0],
        "high": one.interval[1],
    }


def _vehicle(bench: Bench, one: Candidate) -> dict[str, float]:
    """Fitted characteristics by the keys of the twin file."""
    values = bench.problem.space.from_slopes(one.found.fit.x[: bench.d])
    return {k: float(v) for k, v in zip(bench.problem.space.keys, values, strict=True)}


def _apparent_drift(bench: Bench) -> float:
    """Apparent clock drift in ppm by clock and position errors of opposite sign at both ends of the longest drive
    with the gap, within their priors; 0 where neither is fitted."""
    problem = bench.problem
    normal = list(zip(problem.nuisances.names, problem.nuisances.spread, strict=True))
    clock, place = (
        max((float(v) for n, v in normal if n.endswith(e)), default=0.0)
        for e in (".clock_offset", ".map_position")
    )
    seconds, speed = 1.0, 1.0
    for drive in {d for d in problem.drive_of if bench.active[d]}:
        own = [part for part, d in zip(problem.parts, problem.drive_of, strict=True) if d == drive]
        lasts = float(max(part.t[-1] for part in own) - min(part.t[0] for part in own))
        if lasts > seconds:
            seconds, speed = lasts, max(sum(float(np.ptp(part.position)) for part in own) / lasts, 1.0)
    return 1e6 * _BETWEEN_ENDS * float(np.hypot(clock, place / speed)) / seconds


def _plain(value: Any) -> Any:
    """Numbers of six digits and plain containers, as JSON has them; what is not finite is None."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (bool, str, int)) or value is None:
        return value
    number = float(value)
    return float(f"{number:.6g}") if np.isfinite(number) else None
