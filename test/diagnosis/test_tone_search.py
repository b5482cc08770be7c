# SPDX-License-Identifier: Apache-2.0
"""Tones of unknown frequency are found, and their phases are those of each drive."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis.case import build, read_case
from suspension_twin.diagnosis.library import library
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.tone_search import tone_peaks, tone_starts
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.fit import linearised_fit, refit
from suspension_twin.inference.problem import Problem, whitener_of

#: Truth, and how far the start of a search may be from it.
CASES = {
    "wheel_imbalance": (
        {"corner": 2.0, "moment": 0.5, "rolling_radius": 0.292, "phase": -1.2},
        {"moment": 0.1, "rolling_radius": 0.001, "phase": 0.6},
    ),
    "engine_order": (
        {"force": 150.0, "frequency": 7.3, "per_metre": 0.41, "floor": 0.0, "phase": 1.0},
        {"force": 30.0, "frequency": 0.08, "per_metre": 0.012, "floor": 1e-6, "phase": 0.6},
    ),
    "engine_order, idling": (
        {"force": 150.0, "per_metre": 1.1, "floor": 6.0, "frequency": 0.0, "phase": 1.0},
        {"force": 40.0, "per_metre": 0.012, "floor": 0.08, "frequency": 1e-6, "phase": 0.8},
    ),
}


@pytest.fixture(scope="module", params=CASES)
def toned(request: Any, make: Any) -> tuple[str, Problem]:
    twin, bags, _ = make(request.param.partition(",")[0], CASES[request.param][0])
    case = read_case(DiagnosisRequest(str(twin), tuple(bags)), lambda note: None, lambda: False)
    return request.param, build(case, lambda: False)


def test_the_strongest_tone_is_a_start(toned: tuple[str, Problem]) -> None:
    name, problem = toned
    (truth, near), effect = CASES[name], name.partition(",")[0]
    x, cost = refit(problem, [problem.prior.centre], None, 5)
    base = linearised_fit(problem, x)
    residual = base.at.residual
    hypotheses = library(problem.twin, True, drives=2)[effect]
    right = [
        h
        for h in hypotheses
        if dict(h.fixed).get(f"effects.{effect}.corner", 2.0) == truth.get("corner", 2.0)
    ]
    (hypothesis,) = right
    peaks = tone_peaks(problem, residual, EFFECTS[effect], hypothesis.corner(effect))
    starts = tone_starts(problem, base, hypothesis, effect, peaks)
    assert 0.5 * (cost - problem.having(hypothesis).costs(starts[0][:, None])[0]) > 20.0  # nats
    found = dict(
        zip(hypothesis.keys, hypothesis.values(starts[0][problem.shared :, None])[:, 0], strict=True)
    )
    for key, value in found.items():
        name = key.split(".")[2].partition("@")[0]
        off = value - truth[name]
        off = (off + np.pi) % (2 * np.pi) - np.pi if name == "phase" else off
        assert abs(off) < near[name], (key, value)
    # another effect is no tone
    assert not tone_peaks(problem, residual, EFFECTS["strut_friction"])


def test_each_drive_has_a_phase_of_its_own(toned: tuple[str, Problem]) -> None:
    """A drive is simulated with its own, whatever the other's is."""
    name, problem = toned
    effect = name.partition(",")[0]
    hypothesis = library(problem.twin, True, drives=2)[effect][0]
    assert [k for k in hypothesis.keys if "phase" in k] == [
        f"effects.{effect}.phase",
        f"effects.{effect}.phase@1",
    ]
    strength = hypothesis.keys.index(f"effects.{effect}.{EFFECTS[effect].severity[0]}")
    rows = [hypothesis.keys.index(k) for k in hypothesis.keys if "phase" in k]
    points = np.repeat(np.concatenate([problem.prior.centre, hypothesis.neutral()])[:, None], 3, axis=1)
    points[problem.shared + strength] = 1.0
    points[[problem.shared + r for r in rows]] = [[0.0, 0.5, 0.0], [0.0, 0.5, 0.5]]
    found, failed = problem.having(hypothesis).residuals(points)
    assert not failed.any()
    first = whitener_of(problem).drive == 0
    assert np.array_equal(found[first, 2], found[first, 0]) and np.array_equal(
        found[~first, 2], found[~first, 1]
    )
    assert np.abs(found[:, 1] - found[:, 0]).max() > 0.1
