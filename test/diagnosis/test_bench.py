# SPDX-License-Identifier: Apache-2.0
"""Where hypotheses are tried: one that adds nothing is the baseline."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.case import build, read_case
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis, combined, library
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.models.hooks import turns_with, upright_with
from suspension_twin.vehicle.twin import EffectSpec, Twin


def bench_of(case: Any) -> Bench:
    twin, bags, reference = case
    read = read_case(
        DiagnosisRequest(str(twin), tuple(bags), tuple(reference)), lambda note: None, lambda: False
    )
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
def test_what_a_gross_fault_did_to_the_motion_is_taken_off_it_upright_or_not(
    leaning: Bench, effect: str
) -> None:
    plain = leaning.problem.parts[0].excitation
    shown = {upright: replace(plain, late=0.5 + upright) for upright in (False, True)}
    known = tuple(replace(e, regained=shown, reclocked=shown) for e in leaning.excitations)
    bench = replace(leaning, excitations=known)
    assert bench.excitation(0, (effect,)).late == 0.5
    assert bench.levelled().excitation(0, (effect,)).late == 1.5
    before = bench.active.index(False)
    assert bench.excitation(before, (effect,)) is bench.problem.parts[before].excitation
    problem = copy(bench.problem)
    tilt = EffectSpec(id="sensor_tilt", parameters={"roll": 0.02, "pitch": 0.03, "yaw": 0.0})
    problem.twin = problem.twin.model_copy(update={"effects": (tilt,)})
    assert (
        replace(bench, problem=problem).excitation(0, (effect,)).late == 1.5
    )  # whatever the twin file knows


def test_the_prior_of_a_named_cause_is_as_wide_as_what_was_found(leaning: Bench) -> None:
    tilt = library(leaning.problem.twin, True)["sensor_tilt"][0]
    wide = replace(leaning, spread={tilt.keys[1]: 4.0})
    (before, centre), (after, same) = leaning.prior(tilt), wide.prior(tilt)
    row = leaning.d + leaning.q + 1
    assert before[row, row] == 1.0 and after[row, row] == 1.0 / 16.0
    before[row, row] = after[row, row]
    assert np.array_equal(before, after) and np.array_equal(centre, same)
    assert np.array_equal(wide.prior(BASELINE)[0], leaning.prior(BASELINE)[0])


def test_an_effect_everywhere_is_one_of_the_vehicle(leaning: Bench) -> None:
    """On the drives from before as well, which else have no effect."""
    stiff = Hypothesis(("tyre_damping",))
    u, z = np.array([[0.7]]), leaning.centre[:, None]
    problem = copy(leaning.problem)
    problem.twin = problem.twin.model_copy(update={"effects": stiff.spec(stiff.values(u)[:, 0])})
    before = ~np.array(leaning.active)[leaning.whitener.drive]
    own, _ = replace(leaning, problem=problem).residuals(BASELINE, z)
    plain, _ = leaning.residuals(BASELINE, z)
    always, _ = leaning.residuals(stiff.on_all_drives(), np.concatenate([z, u]))
    shown, _ = leaning.residuals(stiff, np.concatenate([z, u]))
    assert_allclose(always, own, atol=1e-9)
    assert_allclose(shown[before], plain[before], atol=1e-9)
    assert_allclose(shown[~before], own[~before], atol=1e-9)
    assert np.abs(own - plain)[before].max() > 0.05
    both = combined(Hypothesis(("strut_friction",)), stiff.on_all_drives())
    assert both.on_reference() == stiff.on_all_drives() and both.rows(stiff) == [len(both) - 1]
    mixed, _ = leaning.residuals(both, np.concatenate([z, both.neutral()[:-1, None], u]))
    assert_allclose(mixed, own, atol=1e-9)


def test_known_columns_and_those_of_effects_are_the_whole_jacobian(leaning: Bench) -> None:
    effect = Hypothesis(("tyre_damping",))
    x = np.concatenate([leaning.centre, [0.7]])
    whole = leaning.linearise(effect, x)
    residual, columns = leaning.effect_columns(effect, x)
    assert_allclose(residual, whole.residual, atol=1e-9)
    model = whole.first(leaning.d + leaning.q).with_effects(residual, columns)
    for name in ("value", "squares", "slope"):
        found, expected = getattr(model, name), getattr(whole.model, name)
        assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    squares = whole.jacobian.T @ whole.jacobian
    assert_allclose(whole.model.squares, squares, atol=1e-9 * np.abs(squares).max())


@pytest.mark.parametrize("heard", [None, (1,)])
def test_the_jacobian_is_what_every_unknown_changes(leaning: Bench, heard: tuple[int, ...] | None) -> None:
    """Each column anew by a step of its own, whether it is simulated, shifted or known beforehand."""
    bench = replace(leaning, counted_drives=heard)
    effect, d = Hypothesis(("tyre_damping",)), bench.d
    x = np.concatenate([bench.centre, [0.7]])
    x[d : d + bench.q] = 0.3 * bench.problem.nuisances.spread
    whole = bench.linearise(effect, x)
    steps = np.concatenate([np.full(d, 1e-3), bench.problem.nuisances.steps, [1e-2]])
    moved, failed = bench.residuals(effect, x[:, None] + np.diag(steps))
    assert not failed.any()
    columns = (moved - whole.residual[:, None]) / steps
    largest = np.maximum(np.abs(columns).max(axis=0), 1e-3)  # less is rounding
    assert_allclose(whole.jacobian / largest, columns / largest, atol=1e-6)
    plain = bench.problem.nuisances.plain
    assert 0 < plain.sum() < bench.q
    if heard is not None:
        assert not whole.jacobian[~np.isin(bench.whitener.drive, heard)].any()


def test_longer_steps_are_the_same_drives_to_what_the_model_leaves(leaning: Bench) -> None:
    """Whatever excites the vehicle: what is found in longer steps is looked at once more in the drives' own."""
    coarse, z = replace(leaning, step=2.5e-3), leaning.centre[:, None]
    for effects in ((), ("sensor_tilt",), ("payload",)):
        one, other = (b.excitation(0, effects) for b in (leaning, coarse))
        assert other.max_step == 2.5e-3
        assert other.road.shape[0] < 0.6 * one.road.shape[0]
        assert_allclose(other.x, one.x)
    signals, rougher = (np.concatenate(b.signals(BASELINE, z[: b.d], z[:0])[0]) for b in (leaning, coarse))
    off = np.sqrt(np.mean((rougher - signals) ** 2, axis=0) / np.mean(signals**2, axis=0))[:3]
    assert (off > 0.0).all()
    assert (off < 0.01).all()


@pytest.mark.long
def test_what_changed_is_told_from_what_was_there_before(make: Any) -> None:
    """A low-pass that the sensor always had makes a low-pass on the drives with the gap gain more than the late clock
    that came since."""
    low = EffectSpec(id="sensor_bandwidth", parameters={"cutoff": 16.0})
    twin, bags, reference = make("time_offset", {"offset": 0.009}, reference=True, always=(low,))
    effects = ("sensor_bandwidth", "time_offset", "strut_friction", "tyre_damping")
    document = diagnose(DiagnosisRequest(str(twin), tuple(bags), tuple(reference), effects=effects)).document
    assert document["combination"] == ["time_offset"], document["message"]
    assert document["causes"][0]["probability"] > 0.5
    assert all(c["probability"] < 0.1 for c in document["causes"][1:])
