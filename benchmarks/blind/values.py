# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis said of the twin's own values, beside those of the true car."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.optimize import brentq

from blind.linkage_forces import PROGRESSION
from blind.plan import LINKAGE, MEASURED
from blind.world import DAMPER_N, DAMPER_REACH, SPRING_N, SPRING_REACH, Car, Floats, G, car_of

Curve = tuple[Floats, Floats]
#: m about the standing car over which rates of springs are compared; places over which the force of a damper is
#: averaged, up to the velocity that was reached.
_NEAR, _PLACES = 0.02, np.linspace(0.0, 1.0, 9)[1:]
#: Share of the gap from which on the headline names a value.
_TOLD = 0.1


def told_values(label: dict[str, Any], case: Path, answer: Path) -> dict[str, list[float]]:
    """By the characteristics of springs and dampers that the headline of a recalibration names: true change, change
    that is told, ends of its 90 % interval; shares of the given value. A lever that grows with travel is part of a
    wheel's rate."""
    if label["reality"] == MEASURED or not (answer / "diagnosis.json").is_file():
        return {}
    document = json.loads((answer / "diagnosis.json").read_text())
    if document["verdict"] != "recalibration":
        return {}
    car = car_of(label["world"])
    vehicle = yaml.safe_load((case / "twin.yaml").read_text())["vehicle"]
    worn = label["faults"].get("worn_dampers", {})
    out = {}
    for one in document["recalibrated"]:
        places = [key.split(".")[1:3] for key in one["keys"] if key.endswith(".force")]
        if one["share"] < _TOLD or not places:
            continue
        pairs = [(_given(vehicle, *place), _true(car, *place)) for place in places]
        if "damper" in places[0][1]:
            left = 1.0 - worn.get(places[0][0], 0.0)
            reached = _reached([given for given, _ in pairs], one["before"])
            before, after = (sum(_force(pair[k], reached) for pair in pairs) for k in (0, 1))
            change = left * after / before - 1.0
        else:
            axle = places[0][0]
            load = _load(car, axle)
            # d/ds of F(s + p s^2) (1 + 2 p s) about the standing car
            levered = 2.0 * PROGRESSION[axle != "front"] * load if label["reality"] == LINKAGE else 0.0
            change = (_rate(pairs[0][1], load) + levered) / _rate(pairs[0][0], load) - 1.0
        out[one["characteristic"]] = [float(v) for v in (change, one["change"], *one["interval"])]
    return out


def _true(car: Car, axle: str, part: str) -> Curve:
    strut = getattr(car, axle)
    if part == "spring":
        return np.linspace(0.0, SPRING_REACH, SPRING_N + 1), strut.spring
    return np.linspace(0.0, DAMPER_REACH, DAMPER_N + 1), strut.push if part == "damper_push" else strut.pull


def _given(vehicle: dict[str, Any], axle: str, part: str) -> Curve:
    table = vehicle[axle][part]
    at = table["compression" if part == "spring" else "velocity"]
    return np.array([0.0, *at]), np.array([0.0, *table["force"]])


def _force(curve: Curve, reached: float) -> float:
    """N, mean of a damper up to the velocity ``reached``; beyond its table along its last slope."""
    x, force = curve
    slope = (force[-1] - force[-2]) / (x[-1] - x[-2])
    at = _PLACES * reached
    return float(np.mean(np.interp(at, x, force) + slope * np.maximum(at - x[-1], 0.0)))


def _reached(curves: list[Curve], before: float) -> float:
    """m/s up to which the mean of the given forces is what the answer says it was."""
    return float(brentq(lambda v: np.mean([_force(c, v) for c in curves]) - before, 1e-4, 20.0))


def _load(car: Car, axle: str) -> float:
    """N that a strut of an axle carries at rest."""
    first = 0 if axle == "front" else 2
    return float(np.mean(car.loads()[first : first + 2] - car.unsprung()[first : first + 2] * G))


def _rate(curve: Curve, load: float) -> float:
    """N/m of a spring about where it carries ``load``."""
    x, force = curve
    standing = float(np.interp(load, force, x))
    low, high = np.interp([standing - _NEAR, standing + _NEAR], x, force)
    return float(high - low) / (2.0 * _NEAR)
