# SPDX-License-Identifier: Apache-2.0
"""Evidence beside the usual errors of every car."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from test_hypothesis_problem import problem_of

from suspension_twin.diagnosis.library import DECOYS, decoys, library
from suspension_twin.diagnosis.usual_errors import UsualErrors, usual_errors
from suspension_twin.inference.cross_validation import Blocks, covariance_of
from suspension_twin.inference.fit import LinearisedFit
from suspension_twin.inference.hypothesis import BASELINE
from suspension_twin.inference.problem import Linearised, Problem
from suspension_twin.vehicle.twin import Twin


@pytest.fixture(scope="module")
def problem(make: Any) -> Problem:
    return problem_of(make("strut_friction", {"front_force": 30.0, "rear_force": 0.0}))


@pytest.fixture(scope="module")
def errors(problem: Problem) -> UsualErrors:
    offered = {**library(problem.twin, True), **decoys(problem.twin, True)}
    return usual_errors(problem, problem.prior.centre, offered, False)


def at(problem: Problem, residual: np.ndarray, jacobian: np.ndarray) -> LinearisedFit:
    x = problem.prior.centre
    return LinearisedFit(BASELINE, x, 0.0, Linearised(x, residual, jacobian))


def test_every_effect_of_a_usual_size_has_its_columns(problem: Problem, errors: UsualErrors) -> None:
    assert {"strut_friction", "tyre_damping", "tyre_envelope", "sensor_offset", *DECOYS[:1]} <= set(
        errors.effects
    )
    assert not {"wheel_imbalance", "engine_order", "sensor_clipping"} & set(errors.effects)
    assert errors.effects.count("corner_spring") == 4 and errors.effects.count("sensor_offset") == 3
    ends = dict(zip(errors.effects, errors.low.tolist(), strict=True))
    assert ends["strut_friction"] == ends["tyre_envelope"] == 0.0  # nobody has less than none
    assert ends["road_scale"] == ends["sensor_scale"] == -np.inf
    acting = np.abs(errors.columns).max(axis=0) > 0.0  # stops that are not touched do nothing
    assert np.isfinite(errors.columns).all() and np.count_nonzero(~acting) <= 2


def test_a_usual_size_is_that_of_the_prior(problem: Problem, car: Twin) -> None:
    friction = library(car, True)["strut_friction"][0]
    sizes = friction.at_usual_sizes(car.vehicle.mass)
    assert [friction.values(u[:, None])[:, 0].tolist() for u, _, _ in sizes] == [[10.0, 0.0], [0.0, 10.0]]
    payload = library(car, True)["payload"][0]
    ((u, nothing, one_sided),) = payload.at_usual_sizes(1500.0)
    assert payload.values(u[:, None])[0, 0] == pytest.approx(60.0) and one_sided
    assert payload.values(nothing[:, None])[0, 0] == 0.0


def test_the_evidence_is_the_marginal_likelihood_of_the_linear_problem(problem: Problem) -> None:
    """Where no bound is near, that of a normal vector of covariance 1 / temper + J P^-1 J^T + D D^T."""
    rng, rows, temper = np.random.default_rng(4), 90, 0.4
    p = problem.shared
    jacobian, columns = 0.01 * rng.standard_normal((rows, p)), 0.3 * rng.standard_normal((rows, 3))
    prior, _ = problem.joint_prior()
    spread = np.eye(rows) / temper + jacobian @ np.linalg.inv(prior) @ jacobian.T
    free = UsualErrors(columns, np.full(3, -np.inf), ("payload", "payload", "spring_sag"))
    none = UsualErrors(columns[:, :0], np.zeros(0), ())
    nats, expected = [], []
    for residual in 0.01 * rng.standard_normal((2, rows)):
        fit = at(problem, residual, jacobian)
        nats += [free.log_evidence(problem, fit, temper), none.log_evidence(problem, fit, temper)]
        expected += [
            multivariate_normal(cov=spread + columns @ columns.T).logpdf(residual),
            multivariate_normal(cov=spread).logpdf(residual),
        ]
    assert np.subtract(nats, nats[0]) == pytest.approx(np.subtract(expected, expected[0]), abs=1e-6)


def test_what_a_little_of_everything_explains_is_no_evidence(problem: Problem, errors: UsualErrors) -> None:
    """A residual of twice the usual friction is worth far fewer nats beside usual errors than without them; the
    hypothesis of friction itself is not judged beside its own."""
    friction = library(problem.twin, True)["strut_friction"][0]
    of_friction = errors.columns[:, errors.effects.index("strut_friction")]
    jacobian = np.zeros((of_friction.size, problem.shared))
    left = at(problem, -2.0 * of_friction, jacobian)
    gone = at(problem, np.zeros_like(of_friction), jacobian)
    none = UsualErrors(errors.columns[:, :0], np.zeros(0), ())
    plain, beside = (
        known.log_evidence(problem, gone, 1.0) - known.log_evidence(problem, left, 1.0)
        for known in (none, errors)
    )
    assert 0.0 < beside < min(2.1, 0.5 * plain)
    whole = problem.having(friction)
    u = friction.neutral()
    x = np.concatenate([problem.prior.centre, u])
    own = LinearisedFit(
        friction,
        x,
        0.0,
        Linearised(x, -2.0 * of_friction, np.zeros((of_friction.size, x.size))),
    )
    others = [i for i, e in enumerate(errors.effects) if e != "strut_friction"]
    fewer = replace(
        errors,
        columns=errors.columns[:, others],
        low=errors.low[others],
        effects=tuple(errors.effects[i] for i in others),
    )
    assert errors.log_evidence(whole, own, 1.0) == pytest.approx(fewer.log_evidence(whole, own, 1.0))


def test_what_every_car_may_have_widens_what_looks_like_it_and_nothing_else(problem: Problem) -> None:
    """An error that acts like the first unknown at s times its unit adds s^2 to its variance, as far as the unknown's
    prior leaves it free; one that acts like none adds nothing."""
    rng, rows, temper, s = np.random.default_rng(5), 400, 0.4, 0.7
    p = problem.shared
    basis, _ = np.linalg.qr(rng.standard_normal((rows, p + 1)))
    fit = at(problem, rng.standard_normal(rows), 1e3 * basis[:, :p])
    blocks = Blocks(np.arange(rows), np.arange(rows), rows)

    def variance(beside: np.ndarray | None) -> np.ndarray:
        return np.diag(covariance_of(problem, fit, blocks, temper, beside))

    plain, like, unlike = (variance(b) for b in (None, s * fit.at.jacobian[:, :1], 3.0 * basis[:, p:]))
    prior = problem.joint_prior()[0][0, 0]
    assert like[0] == pytest.approx(plain[0] + 1.0 / (1.0 / s**2 + temper * prior), rel=1e-3)
    assert like[1:] == pytest.approx(plain[1:], rel=1e-3)
    assert unlike == pytest.approx(plain, rel=1e-6)
