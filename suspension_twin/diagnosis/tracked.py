# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a tracked vehicle from marker runs: where it and its twin disagree, why, how far that closes.

The document is that of a car's diagnosis. Each effect of the library is fitted on its own (each station of
a station's effect too), its worth is what it leaves on blocks of half a second held out of the fit, and
effects are weighed by that. A gap that no effect closes is ``unknown``; a second effect is added where the
first leaves more than noise and the second pays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.signal import welch

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.request import Progress
from suspension_twin.diagnosis.tracked_fit import (
    NOTHING,
    Bench,
    Fitted,
    calibrate_to,
    evidence,
    fit,
    hypotheses_for,
    make_bench,
    together,
)
from suspension_twin.diagnosis.tracked_visible import Visible, as_table, visible_from, words
from suspension_twin.effects.tracked_effects import TRACKED_EFFECTS, apply_tracked
from suspension_twin.errors import InputError, WorkError
from suspension_twin.gap.marker_runs import MARKERS, MarkerRun, read_run
from suspension_twin.vehicle.tracked import TrackedTwin
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin

__all__ = ["TrackedDiagnosis", "diagnose_tracked", "diagnose_tracked_files"]

_MATERIAL: Final = 0.10  # share of the gap's rms above the noise that a cause must take away
_EVIDENT: Final = float(np.log(19.0))  # log evidence of a cause that is there at odds of 19 to 1
_QUIET: Final = 1.25  # level below which a gap is what repeats differ by, unless a cause is evident
_CALM: Final = 1.5  # ... and below which a gap that no cause takes away is not worth a word
_SURE: Final = 0.60  # ... and from which on something of the library is behind it for sure
_ADEQUATE: Final = 0.50  # share of the gap above the noise that a cause named alone takes away
_PARTLY: Final = 0.35  # ... and that a cause named for a part of it does, if every effect can be judged
#: Log evidence that some effect gains where the gap is of one that cannot be judged: what the model does not tell
#: looks like something else of its kind, of the vehicle or of the camera, by accident. From specimens with worn and
#: slack tracks that are not reported; what those gained of the other kind was less than 1.
_UNTOLD: Final = 5.0
_PAYS: Final = 8.0  # log evidence that a second effect has to bring
_TIED: Final = 3.0  # log evidence within which two causes cannot be told apart
_TRACK: Final = {"track_tension", "track_wear"}
_KINDS: Final = ("displacement", "velocity", "acceleration")


@dataclass(frozen=True)
class TrackedDiagnosis:
    """``document`` as diagnosis.json, ``twin`` with what was found added, and what a page shows of each run."""

    document: dict[str, Any]
    twin: Twin
    runs: tuple[MarkerRun, ...]
    before: tuple[Floats, ...]
    after: tuple[Floats, ...]
    sigma: Floats


def diagnose_tracked_files(
    twin: str,
    runs: Sequence[str],
    reference: Sequence[str] = (),
    seed: int = 0,
    tell: Callable[[Progress], None] = lambda _: None,
) -> TrackedDiagnosis:
    """As :func:`diagnose_tracked`, from files: CSV of markers or recordings of poses, speed in their names."""
    tell(Progress("reading", 0.0))
    loaded = load_twin(twin)
    if not isinstance(loaded, TrackedTwin):
        raise InputError(twin, "model", f"is {loaded.model}: marker runs are of a tracked vehicle")
    read = [[read_run(p, loaded.vehicle) for p in paths] for paths in (runs, reference)]
    return diagnose_tracked(loaded, read[0], read[1], seed, tell)


def diagnose_tracked(
    twin: TrackedTwin,
    runs: Sequence[MarkerRun],
    reference: Sequence[MarkerRun] = (),
    seed: int = 0,
    tell: Callable[[Progress], None] = lambda _: None,
) -> TrackedDiagnosis:
    """Where, why and how far. ``reference``: runs of the same vehicle from before the gap.

    Raises InputError for runs that cannot be used and WorkError where the twin diverges on them.
    """
    if not runs:
        raise InputError("diagnose", "runs", "none is given")
    warnings = []
    vehicle = apply_tracked(twin.vehicle, {e.id: e.parameters for e in twin.effects})
    if reference:
        tell(Progress("calibrating", 0.05))
        vehicle = calibrate_to(vehicle, reference)
        lone = {f"{3.6 * r.speed:.0f} km/h" for r in runs if not any(_alike(r, s) for s in reference)}
        if lone:
            warnings.append(
                f"no reference at {', '.join(sorted(lone))}: the model alone says what is normal there"
            )
    standing = make_bench(vehicle, runs, reference, free=False)
    bench = make_bench(vehicle, runs, reference)
    base = fit(bench, NOTHING)
    if base is None:
        raise WorkError("tracked: the twin as it stands cannot be simulated on these runs")
    as_it_stands = base if not bench.free else fit(standing, NOTHING)
    assert as_it_stands is not None
    singles: dict[str, Fitted] = {}
    names = list(TRACKED_EFFECTS)
    for i, name in enumerate(names):
        tell(Progress("effects", 0.1 + 0.7 * i / len(names), name))
        tried = [f for f in (fit(bench, h) for h in hypotheses_for(name, vehicle)) if f is not None]
        if tried:
            singles[name] = min(tried, key=lambda f: f.score)
    gain = {n: evidence(bench, f) - evidence(bench, base) for n, f in singles.items()}
    order = sorted(singles, key=lambda n: -gain[n])
    chosen = singles[order[0]]
    for name in order[1:4]:
        tell(Progress("combinations", 0.85, name))
        if chosen.score < 1.0 or len(chosen.hypothesis.effects) > 1:
            break  # what is left is what noise and doubt leave
        both = fit(bench, together(chosen, singles[name]))
        if both is not None and evidence(bench, both) - evidence(bench, chosen) > _PAYS:
            chosen = both
    tell(Progress("judging", 0.95))
    seen = [visible_from(bench, name, hypotheses_for(name, vehicle)) for name in singles]
    return _conclude(twin, bench, as_it_stands, base, singles, gain, chosen, seen, seed, warnings)


def _alike(a: MarkerRun, b: MarkerRun) -> bool:
    return abs(a.speed - b.speed) <= 0.02 * a.speed


def _level(f: Fitted) -> float:
    """What is left in units of the noise."""
    return float(np.sqrt(f.left))


def _above(square: float) -> float:
    return float(np.sqrt(max(square - 1.0, 1e-6)))


def _closed(before: Fitted, after: Fitted) -> float:
    """Share of the gap above the noise that is gone."""
    return 1.0 - _above(after.left) / _above(before.left)


def _untold(name: str, gain: dict[str, float]) -> float:
    """Log evidence that an effect which cannot be judged may stand for: a track looks like a bar or a load, but not
    like a camera that is turned, and the other way about."""
    lead = max(gain, key=lambda n: gain[n])
    own = [n for n in gain if (TRACKED_EFFECTS[n].camera is None) == (TRACKED_EFFECTS[name].camera is None)]
    return _UNTOLD if lead in own else max(0.0, *(gain[n] for n in own))


def _conclude(
    twin: TrackedTwin,
    bench: Bench,
    standing: Fitted,
    base: Fitted,
    singles: dict[str, Fitted],
    gain: dict[str, float],
    chosen: Fitted,
    seen: list[Visible],
    seed: int,
    warnings: list[str],
) -> TrackedDiagnosis:
    best = max(gain.values(), default=0.0)
    names = chosen.hypothesis.effects
    closed = _closed(base, chosen)
    small = best < _TIED or closed < _MATERIAL
    quiet = (best < _EVIDENT and _level(base) < _QUIET) or (small and _level(base) < _CALM)
    # how likely it is that nothing of the library is behind it; what a cause leaves open is for the verdict to say
    nothing = float(np.clip((_SURE - closed) / (_SURE - _MATERIAL), 0.0, 1.0)) if not quiet else 0.0
    weights = {n: float(np.exp(g - best)) for n, g in gain.items()}
    total = sum(weights.values())
    mass = 1.0 - nothing
    no_gap = mass * (float(np.exp(-min(best, 50.0))) if not quiet else 0.97)
    # an effect that cannot be judged may be behind what another seems to explain
    unjudged = [v.effect for v in seen if not v.judged and v.effect not in names]
    untold = sum(float(np.exp(_untold(n, gain) - best)) for n in unjudged) if not quiet else 0.0
    untold /= total + untold
    nothing += (mass - no_gap) * untold
    mass -= (mass - no_gap) * untold
    shares = {n: (mass - no_gap) * w / total for n, w in weights.items()}
    if len(names) > 1 and not quiet:
        shares = {n: (mass - no_gap) / len(names) if n in names else 0.0 for n in shares}
    if quiet:
        verdict, kept = "no_gap", base
    elif closed < (_ADEQUATE if unjudged else _PARTLY) or untold > 0.5:
        verdict, kept = "unknown", base
    else:
        verdict, kept = ("effect" if closed > _ADEQUATE and _level(chosen) < 3.0 else "partly"), chosen
    alike = [n for n in gain if best - gain[n] < _TIED and _closed(base, singles[n]) > _MATERIAL]
    tied = alike if len(kept.hypothesis.effects) == 1 else []
    hidden = [v.effect for v in seen if not v.judged and v.effect not in kept.hypothesis.effects]
    rng = np.random.default_rng(seed)
    document: dict[str, Any] = {
        "verdict": verdict,
        "gap": _gap(bench, standing),
        "where": _where(bench, base),
        "causes": [
            _cause(n, singles[n], standing, shares[n], gain[n], tied, rng)
            for n in sorted(singles, key=lambda n: (-round(shares[n], 9), -gain[n]))
        ],
        "no_gap_probability": round(no_gap, 6),
        "unknown_probability": round(nothing, 6),
        "combination": list(kept.hypothesis.effects),
        "unexplained": round(float(np.clip(1.0 - _closed(standing, kept), 0.0, 1.0)), 6),
        "cannot_be_judged": hidden,
        "visible_from": as_table(seen),
        "next_experiment": _next(verdict, tied, bench, hidden),
        "seed": seed,
        "warnings": warnings,
    }
    if verdict in ("unknown", "partly"):
        document["signature"] = _signature(bench, kept)
    values = _given(kept)
    for cause in document["causes"]:  # a combination's parameters are those of both together
        if cause["effect"] in values:
            cause["parameters"] = values[cause["effect"]]
    for cause in document["causes"]:
        cause["judged"] = cause["effect"] not in document["cannot_be_judged"]
    document["message"] = _message(document, standing, kept, seen)
    return TrackedDiagnosis(document, _twin(twin, kept), bench.runs, standing.rest, kept.rest, bench.sigma)


def _given(f: Fitted) -> dict[str, dict[str, float]]:
    given = f.hypothesis.given(f.x)
    return {e: {k: float(f"{v:.5g}") for k, v in values.items()} for e, values in given.items()}


def _twin(twin: TrackedTwin, kept: Fitted) -> Twin:
    """The twin as it was, with what was found added; an effect that it has already is replaced."""
    found = _given(kept)
    specs = [e for e in twin.effects if e.id not in found]
    specs += [EffectSpec(id=name, parameters=values) for name, values in found.items()]
    return twin.model_copy(update={"effects": tuple(specs)})


def _cause(
    name: str,
    f: Fitted,
    standing: Fitted,
    share: float,
    gain: float,
    tied: list[str],
    rng: np.random.Generator,
) -> dict[str, Any]:
    blocks = rng.integers(0, f.levels.size, (400, f.levels.size))
    before, after = (np.sqrt(np.maximum(g.levels[blocks].mean(axis=1) - 1.0, 1e-6)) for g in (standing, f))
    low, high = np.quantile(1.0 - after / before, [0.05, 0.95])
    return {
        "effect": name,
        "probability": round(share, 6),
        "parameters": _given(f)[name],
        "gap_before": round(_above(standing.left), 4),
        "gap_after": round(_above(f.left), 4),
        "shrink": round(_closed(standing, f), 4),
        "shrink_interval": [round(float(low), 4), round(float(high), 4)],
        "indistinguishable_from": [n for n in tied if n != name] if name in tied else [],
        "log_evidence": round(gain, 2),
    }


def _gap(bench: Bench, standing: Fitted) -> dict[str, Any]:
    rest = np.concatenate(standing.rest) * bench.sigma
    seen = bench.sigma < 1e5
    channels = {
        f"marker_{m}_{kind}": round(float(np.sqrt(np.mean(rest[:, 3 * i + k] ** 2))), 6)
        for i, kind in enumerate(_KINDS)
        for k, m in enumerate(MARKERS)
        if seen[3 * i + k]
    }
    columns = np.flatnonzero(seen[6:]) + 6
    rms = float(np.sqrt(np.mean(rest[:, columns] ** 2)))
    noise = float(np.sqrt(np.mean(bench.sigma[columns] ** 2)))
    return {"rms": round(rms, 6), "mse": round(rms**2, 6), "noise_rms": round(noise, 6), "channels": channels}


def _where(bench: Bench, base: Fitted) -> dict[str, list[dict[str, Any]]]:
    """Seconds, metres, bands and markers that hold more than twice their share of what is left."""
    total = sum(float((r**2).sum()) for r in base.rest)
    time, road = [], []
    for run, rest in zip(bench.runs, base.rest, strict=True):
        power = (rest**2).sum(axis=1)
        for begin in np.arange(run.t[0], run.t[-1], 0.5):
            part = (run.t >= begin) & (run.t < begin + 0.5)
            share = float(power[part].sum()) / total
            if share > 2.0 * part.sum() / sum(r.t.size for r in bench.runs):
                time.append(
                    {
                        "bag": run.name,
                        "start": round(float(begin), 3),
                        "end": round(float(begin) + 0.5, 3),
                        "share": round(share, 4),
                    }
                )
                front = run.speed * begin - 0.5  # of the idler's front edge from the obstacle's foot
                road.append(
                    {
                        "start_m": round(front, 2),
                        "end_m": round(front + 0.5 * run.speed, 2),
                        "share": round(share, 4),
                    }
                )
    rest = np.concatenate(base.rest)
    f, density = welch(rest[:, 3:6], bench.runs[0].rate, nperseg=min(128, rest.shape[0]), axis=0)
    density = density.sum(axis=1)
    bands = []
    for low, high in ((0.0, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, 8.0), (8.0, 16.0)):
        share = float(density[(f >= low) & (f < high)].sum() / density.sum())
        bands.append({"low_hz": low, "high_hz": high, "share": round(share, 4)})
    power = (rest**2).sum(axis=0).reshape(3, 3)
    channel = [
        {"name": f"marker_{m}", "share": round(float(power[:, k].sum() / power.sum()), 4)}
        for k, m in enumerate(MARKERS)
    ]

    def most(items: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return sorted(items, key=lambda i: -float(i["share"]))[:6]

    return {
        "time": most(time),
        "road": most(road),
        "frequency": most(bands),
        "channel": most(channel),
        "corner": [],
        "operating_point": [],
    }


def _signature(bench: Bench, kept: Fitted) -> dict[str, Any]:
    rest = np.concatenate(kept.rest)
    f, density = welch(rest[:, 3:6], bench.runs[0].rate, nperseg=min(128, rest.shape[0]), axis=0)
    density = density.sum(axis=1)
    share = np.cumsum(density) / density.sum()
    return {
        "channel": "marker velocity",
        "low_hz": round(float(f[np.searchsorted(share, 0.1)]), 2),
        "high_hz": round(float(f[np.searchsorted(share, 0.9)]), 2),
        "peak_hz": round(float(f[np.argmax(density)]), 2),
        "level": round(_level(kept), 3),
    }


def _next(verdict: str, tied: list[str], bench: Bench, unseen: list[str]) -> str:
    told = _told_next(verdict, tied, bench)
    if not unseen:
        return told
    names = " and ".join(n.replace("_", " ") for n in unseen)
    how = ": measure the sag of the run above and the length of ten links" if set(unseen) & _TRACK else ""
    return f"{told} These runs do not tell of {names}{how}."


def _told_next(verdict: str, tied: list[str], bench: Bench) -> str:
    fastest = max(3.6 * r.speed for r in bench.runs)
    if verdict == "no_gap":
        return "None is needed."
    if len(tied) > 1:
        return (
            f"To part {' from '.join(tied[:2])}: three repeats over the obstacle at {1.6 * fastest:.0f} km/h."
        )
    if verdict == "unknown":
        return "Repeat one speed three times with a marker on each outer road wheel's arm."
    return "Repeat the runs after the repair."


def _message(document: dict[str, Any], standing: Fitted, kept: Fitted, seen: list[Visible]) -> str:
    level = _level(standing)
    if document["verdict"] == "no_gap":
        faint = "; ".join(words(v) for v in seen)
        return (
            f"no gap: the runs differ from what is normal by {level:.2f} times what repeats differ by. "
            f"Would not show in these runs: {faint}"
        )
    if document["verdict"] == "unknown":
        names = " and ".join(n.replace("_", " ") for n in document["cannot_be_judged"])
        word = f"; these runs do not tell whether it is {names}" if names else ""
        return f"unknown: a gap of {level:.1f} times the noise, which nothing in the library explains for sure{word}"
    names = " and ".join(n.replace("_", " ") for n in document["combination"])
    alike = document["causes"][0]["indistinguishable_from"]
    if alike:
        names = " or ".join(n.replace("_", " ") for n in (document["causes"][0]["effect"], *alike))
        names += " (which these runs do not tell apart)"
    word = "partly " if document["verdict"] == "partly" else ""
    return (
        f"{word}{names}: the gap above the noise shrinks by {100 * _closed(standing, kept):.0f} % "
        "on blocks that the fit has not seen"
    )
