# SPDX-License-Identifier: Apache-2.0
"""Simple methods beside: one calibration, frozen, then every effect alone on top of it.

The calibration sees the reference where there is one, else the drives with the gap. Each effect's own
parameters are then searched by Nelder and Mead from a few starts over its prior on the first drive (they
are in the order of their names), the vehicle held still.
Three readings of the same fits: the largest reduction of what remains (which never says no gap), and
Akaike's and Schwarz' criteria against no effect at all, with the samples taken as independent.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from blind.score import PLAIN, Row
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.effects.base import Effect, Parameter
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.inference.observation import Observation, observe, road_of
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin

_INDEPENDENT = 0.4  # share of the samples: the low-pass leaves two fifths of the band
_SEARCH = {"maxfev": 25, "xatol": 0.02, "fatol": 0.5}
_FAR = 1e12
_SAMPLES = 2500  # of one drive's channel


def _deviance(twin: Twin, drives: Sequence[Observation]) -> float:
    """-2 log likelihood with a variance of its own for every channel."""
    total: dict[str, float] = {}
    count = 0
    for drive in drives:
        try:
            simulated = drive.condition(simulate_twin(twin, drive.road_excitation))
        except SuspensionTwinError:
            return _FAR
        count += int(drive.mask.sum())
        for name, measured in drive.measured.items():
            rest = (measured - simulated[name])[drive.mask]
            total[name] = total.get(name, 0.0) + float(rest @ rest)
    if not all(math.isfinite(v) for v in total.values()):
        return _FAR
    return _INDEPENDENT * count * sum(math.log(max(v, 1e-12) / count) for v in total.values())


def _value(p: Parameter, u: float) -> float:
    return float(p.value(np.array(u)))


def _fitted(effect: Effect, twin: Twin, drives: Sequence[Observation]) -> tuple[float, int]:
    """Least deviance of an effect on a frozen twin, and how many parameters it took."""
    searched = [p for p in effect.parameters if not p.choices]
    choices = [p for p in effect.parameters if p.choices]
    held: tuple[float | None, ...] = choices[0].choices if choices else (None,)

    def cost(u: np.ndarray, chosen: float | None) -> float:
        values = {p.name: _value(p, float(v)) for p, v in zip(searched, u, strict=True)}
        if chosen is not None:
            values[choices[0].name] = chosen
        added = (*twin.effects, EffectSpec(id=effect.id, parameters=values))
        return _deviance(twin.model_copy(update={"effects": added}), drives)

    best, start, at = _FAR, np.zeros(len(searched)), held[0]
    for chosen in held:
        for amount in (-1.0, -0.3, 0.3, 1.0, 2.5):
            u = np.array([amount if p.name in effect.severity else 0.0 for p in searched])
            if (value := cost(u, chosen)) < best:
                best, start, at = value, u, chosen
    found = minimize(cost, start, args=(at,), method="Nelder-Mead", options=_SEARCH)  # type: ignore[call-overload]
    return min(best, float(found.fun)), len(effect.parameters)


def fits(folder: Path) -> dict[str, tuple[float, int]]:
    """Deviance and number of parameters of every effect, and of none, on one case."""
    bags = sorted(str(p) for p in folder.iterdir() if p.is_dir())
    shown = [b for b in bags if not Path(b).name.startswith("reference")]
    before = [b for b in bags if b not in shown]
    request = folder / "request.json"
    without = json.loads(request.read_text())["without"] if request.is_file() else []
    twin = calibrate(
        CalibrationRequest(str(folder / "twin.yaml"), tuple(before or shown), max_generations=60)
    ).twin
    twin = twin.model_copy(update={"road": load_twin(folder / "twin.yaml").road})
    drives = [observe(read_drive(b), twin, road_of(twin)) for b in shown[:1]]
    out = {"none": (_deviance(twin, drives), 0)}
    for name, effect in EFFECTS.items():
        if twin.model in effect.hook.models and name not in without:
            out[name] = _fitted(effect, twin, drives)
    return out


def compare(rows: Sequence[Row], out: Path, most: int, tell: Callable[[str], None]) -> dict[str, Any]:
    """Top-1 on plain single effects and false alarms on null cases, for each simple method, on the first
    ``most`` of them."""
    wanted = [r for r in rows if r["kind"] == "null" or (r["kind"] == "single" and r["severity"] >= PLAIN)][
        :most
    ]
    answers: dict[str, list[tuple[Row, str]]] = {
        "largest reduction, frozen": [],
        "AIC, frozen": [],
        "BIC, frozen": [],
        "at random": [],
    }
    for i, row in enumerate(wanted):
        kept = out / "answers" / row["case"] / "frozen.json"
        if not kept.is_file():
            try:
                kept.write_text(json.dumps(fits(out / "cases" / row["case"])) + "\n", encoding="utf-8")
            except SuspensionTwinError as error:
                tell(f"{row['case']}: {error}")
                continue
            tell(f"beside: {i + 1}/{len(wanted)}")
        found = {k: (float(v[0]), int(v[1])) for k, v in json.loads(kept.read_text()).items()}
        samples = _INDEPENDENT * 6 * _SAMPLES
        effects = {k: v for k, v in found.items() if k != "none"}
        answers["largest reduction, frozen"].append((row, min(effects, key=lambda k: effects[k][0])))
        answers["AIC, frozen"].append((row, min(found, key=lambda k: found[k][0] + 2 * found[k][1])))
        answers["BIC, frozen"].append(
            (row, min(found, key=lambda k: found[k][0] + math.log(samples) * found[k][1]))
        )
        drawn = np.random.default_rng([i, 11]).choice(list(found))
        answers["at random"].append((row, str(drawn)))
    return {name: _scored(own) for name, own in answers.items()}


def _scored(answers: Sequence[tuple[Row, str]]) -> dict[str, Any]:
    single = [(r, a) for r, a in answers if r["kind"] == "single"]
    null = [(r, a) for r, a in answers if r["kind"] == "null"]
    return {
        "top1": float(np.mean([a == r["truth"][0] for r, a in single])) if single else None,
        "n": len(single),
        "false_alarms": float(np.mean([a != "none" for _, a in null])) if null else None,
        "nulls": len(null),
    }
