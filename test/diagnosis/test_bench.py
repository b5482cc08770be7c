# SPDX-License-Identifier: Apache-2.0
"""Where hypotheses are tried: one that adds nothing is the baseline."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.case import build, read_case
from suspension_twin.diagnosis.hypotheses import BASELINE, library
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.models.hooks import turns_with, upright_with
from suspension_twin.vehicle.twin import Twin


def bench_of(case: Any) -> Bench:
    twin, bags, reference = case
    read = read_case(DiagnosisRequest(str(twin), tuple(bags), tuple(reference)), lambda note: None, lambda: False)
    return build(read, lambda: False)


@pytest.fixture(scope="module")
def leaning(make: Any, car: Twin) -> Bench:
    """Of a car with an antenna on its roof and a sensor that leans by 2°: whether that is the vehicle matters."""
    high = car.model_copy(update={"gps": car.gps.model_copy(update={"position": (0.0, 0.0, 1.5)})})
    return bench_of(make("sensor_tilt", {"roll": 0.02, "pitch": 0.03, "yaw": 0.0}, reference=True, car=high))


@pytest.mark.parametrize("level", [False, True], ids=["leaning", "level"])
def test_an_effect_of_no_severity_is_the_baseline(leaning: Bench, level: bool) -> None:
    """Whatever else is asked of the motion for its sake: else it starts behind by what the vehicle leans."""
    bench = leaning.levelled() if level else leaning
    z = bench.centre[:, None]
    plain, _ = bench.residuals(BASELINE, z)
    tried = 0
    for effect, (first, *_) in library(bench.problem.twin, True).items():
        severe = [p for p in EFFECTS[effect].parameters if p.name in EFFECTS[effect].severity]
        if turns_with([effect]) or (upright_with([effect]) and not level) or any(p.log for p in severe):
            continue  # some say themselves what leans, others are never quite nothing
        found, _ = bench.residuals(first, np.concatenate([z, first.neutral()[:, None]]))
        assert np.abs(found - plain).max() < 1e-6 * np.abs(plain).max(), effect
        tried += 1
    assert tried > 10
    other, _ = (leaning if level else leaning.levelled()).residuals(BASELINE, z)
    assert np.abs(other - plain).max() > 0.01 * np.abs(plain).max()


@pytest.mark.parametrize("effect", ["time_offset", "sensor_scale"])
def test_what_a_gross_fault_did_to_the_motion_is_taken_off_it_upright_or_not(leaning: Bench, effect: str) -> None:
    plain = leaning.problem.parts[0].excitation
    shown = {upright: replace(plain, late=0.5 + upright) for upright in (False, True)}
    known = tuple(replace(e, regained=shown, reclocked=shown) for e in leaning.excitations)
    bench = replace(leaning, excitations=known)
    assert bench.excitation(0, (effect,)).late == 0.5
    assert bench.levelled().excitation(0, (effect,)).late == 1.5
    before = bench.active.index(False)
    assert bench.excitation(before, (effect,)) is bench.problem.parts[before].excitation
