# SPDX-License-Identifier: Apache-2.0
"""Hypotheses are problems with more parameters: one that adds nothing is the baseline."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from suspension_twin.diagnosis.case import build, read_case
from suspension_twin.diagnosis.library import library
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.hypothesis import Hypothesis, combined
from suspension_twin.inference.problem import Problem, counting, whitener_of
from suspension_twin.inference.sensor_correction import SensorCorrection
from suspension_twin.models.hooks import turns_with, upright_with
from suspension_twin.vehicle.twin import EffectSpec, Twin


def problem_of(case: Any) -> Problem:
    twin, bags, reference = case
    read = read_case(
        DiagnosisRequest(str(twin), tuple(bags), tuple(reference)), lambda note: None, lambda: False
    )
    problem = build(read, lambda: False)
    return replace(problem, simulation=replace(problem.simulation, step=None))


def levelled(problem: Problem) -> Problem:
    """With zero static attitude of the vehicle."""
    return replace(problem, simulation=replace(problem.simulation, upright=True))


@pytest.fixture(scope="module")
def leaning(make: Any, car: Twin) -> Problem:
    """Of a car with an antenna on its roof and a sensor that leans by 2°: whether that is the vehicle matters."""
    high = car.model_copy(update={"gps": car.gps.model_copy(update={"position": (0.0, 0.0, 1.5)})})
    return problem_of(
        make("sensor_tilt", {"roll": 0.02, "pitch": 0.03, "yaw": 0.0}, reference=True, car=high)
    )


@pytest.mark.parametrize("level", [False, True], ids=["leaning", "level"])
def test_an_effect_of_no_severity_is_the_baseline(leaning: Problem, level: bool) -> None:
    """Whatever else is asked of the motion for its sake: else it starts behind by what the vehicle leans."""
    problem = levelled(leaning) if level else leaning
    z = problem.prior.centre[:, None]
    plain, _ = problem.residuals(z)
    tried = 0
    for effect, (first, *_) in library(problem.twin, True).items():
        severe = [p for p in EFFECTS[effect].parameters if p.name in EFFECTS[effect].severity]
        if turns_with([effect]) or (upright_with([effect]) and not level) or any(p.prior.log for p in severe):
            continue  # some say themselves what leans, others are never quite nothing
        found, _ = problem.having(first).residuals(np.concatenate([z, first.neutral()[:, None]]))
        assert np.abs(found - plain).max() < 1e-6 * np.abs(plain).max(), effect
        tried += 1
    assert tried > 10
    other, _ = (leaning if level else levelled(leaning)).residuals(z)
    assert np.abs(other - plain).max() > 0.01 * np.abs(plain).max()


@pytest.mark.parametrize("effect", ["time_offset", "sensor_scale"])
def test_a_shown_error_of_the_sensor_is_taken_out_by_hypotheses_of_that_error(
    leaning: Problem, effect: str
) -> None:
    """On drives with the gap, upright or not, and not on reference drives."""
    shown = SensorCorrection(turn=(0.0, 0.0, 0.0), gain=1.3, clock=0.5)
    parts = tuple(replace(part, reading=replace(part.source, shown=shown)) for part in leaning.data.parts)
    data = replace(leaning.data, parts=parts)
    problem = replace(leaning, likelihood=replace(leaning.likelihood, data=data))
    before = data.active.index(False)
    wanted = SensorCorrection(clock=0.5) if effect == "time_offset" else SensorCorrection(gain=1.3)
    for upright in (False, True):
        own = (levelled(problem) if upright else problem).having(Hypothesis((effect,)))
        known = parts[0].source.excitation(replace(wanted, upright=upright))
        assert own.excitation(0) is known
        assert known.late == wanted.clock
        plain = parts[before].source.excitation(SensorCorrection(upright=upright))
        assert own.excitation(before) is plain
    tilt = EffectSpec(id="sensor_tilt", parameters={"roll": 0.02, "pitch": 0.03, "yaw": 0.0})
    tilted = replace(problem, twin=problem.twin.model_copy(update={"effects": (tilt,)}))
    known = parts[0].source.excitation(replace(wanted, upright=True))
    assert tilted.having(Hypothesis((effect,))).excitation(0) is known


def test_the_prior_of_a_named_cause_is_as_wide_as_what_was_found(leaning: Problem) -> None:
    tilt = library(leaning.twin, True)["sensor_tilt"][0]
    wide = replace(leaning, prior=replace(leaning.prior, spread={tilt.keys[1]: 4.0}))
    (before, centre), (after, same) = (p.having(tilt).joint_prior() for p in (leaning, wide))
    row = leaning.shared + 1
    assert before[row, row] == 1.0 and after[row, row] == 1.0 / 16.0
    before[row, row] = after[row, row]
    assert np.array_equal(before, after) and np.array_equal(centre, same)
    assert np.array_equal(wide.joint_prior()[0], leaning.joint_prior()[0])


def test_an_effect_everywhere_is_one_of_the_vehicle(leaning: Problem) -> None:
    """On the drives from before as well, which else have no effect."""
    stiff = Hypothesis(("tyre_damping",))
    u, z = np.array([[0.7]]), leaning.prior.centre[:, None]
    twin = leaning.twin.model_copy(update={"effects": stiff.spec(stiff.values(u)[:, 0])})
    before = ~np.array(leaning.data.active)[whitener_of(leaning).drive]
    own, _ = replace(leaning, twin=twin).residuals(z)
    plain, _ = leaning.residuals(z)
    always, _ = leaning.having(stiff.on_all_drives()).residuals(np.concatenate([z, u]))
    shown, _ = leaning.having(stiff).residuals(np.concatenate([z, u]))
    assert_allclose(always, own, atol=1e-9)
    assert_allclose(shown[before], plain[before], atol=1e-9)
    assert_allclose(shown[~before], own[~before], atol=1e-9)
    assert np.abs(own - plain)[before].max() > 0.05
    both = combined(Hypothesis(("strut_friction",)), stiff.on_all_drives())
    assert both.on_reference() == stiff.on_all_drives() and both.rows(stiff) == [len(both) - 1]
    mixed, _ = leaning.having(both).residuals(np.concatenate([z, both.neutral()[:-1, None], u]))
    assert_allclose(mixed, own, atol=1e-9)


def test_known_columns_and_those_of_effects_are_the_whole_jacobian(leaning: Problem) -> None:
    effect = Hypothesis(("tyre_damping",))
    x = np.concatenate([leaning.prior.centre, [0.7]])
    problem = leaning.having(effect)
    whole = problem.linearise(x)
    residual, columns = problem.effect_columns(x)
    assert_allclose(residual, whole.residual, atol=1e-9)
    model = whole.first(leaning.shared).with_effects(residual, columns)
    for name in ("value", "squares", "slope"):
        found, expected = getattr(model, name), getattr(whole.model, name)
        assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    squares = whole.jacobian.T @ whole.jacobian
    assert_allclose(whole.model.squares, squares, atol=1e-9 * np.abs(squares).max())


@pytest.mark.parametrize("counted", [None, (1,)])
def test_the_jacobian_is_the_change_by_every_unknown(
    leaning: Problem, counted: tuple[int, ...] | None
) -> None:
    """Each column anew by a step of its own, whether it is simulated, shifted or known beforehand."""
    rows = np.isin(whitener_of(leaning).drive, (0, 1, 2) if counted is None else counted)
    effect, d = Hypothesis(("tyre_damping",)), leaning.d
    problem = counting(leaning, rows).having(effect)
    x = np.concatenate([problem.prior.centre, [0.7]])
    x[d : problem.shared] = 0.3 * problem.nuisances.spread
    whole = problem.linearise(x)
    steps = np.concatenate([np.full(d, 1e-3), problem.nuisances.steps, [1e-2]])
    moved, failed = problem.residuals(x[:, None] + np.diag(steps))
    assert not failed.any()
    columns = (moved - whole.residual[:, None]) / steps
    largest = np.maximum(np.abs(columns).max(axis=0), 1e-3)  # less is rounding
    assert_allclose(whole.jacobian / largest, columns / largest, atol=1e-6)
    plain = problem.nuisances.plain
    assert 0 < plain.sum() < problem.q
    if counted is not None:
        assert not whole.jacobian[~rows].any()


def test_longer_steps_are_the_same_drives_within_the_model_discrepancy(leaning: Problem) -> None:
    """However a drive is read: what is found in longer steps is refined in the drives' own."""
    coarse = replace(leaning, simulation=replace(leaning.simulation, step=2.5e-3))
    x = leaning.prior.centre[:, None]
    for effects in ((), ("sensor_tilt",), ("payload",)):
        one, other = (p.having(Hypothesis(effects)).excitation(0) for p in (leaning, coarse))
        assert other.max_step == 2.5e-3
        assert other.road.shape[0] < 0.6 * one.road.shape[0]
        assert_allclose(other.path.x, one.path.x)
    signals, rougher = (np.concatenate(p.signals(x)[0]) for p in (leaning, coarse))
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
