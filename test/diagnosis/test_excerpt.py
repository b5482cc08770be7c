# SPDX-License-Identifier: Apache-2.0
"""The excerpt that a first search goes over has the unknowns, the noise and the motion of the whole drives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis import excerpt as module
from suspension_twin.diagnosis.case import build, read_case
from suspension_twin.diagnosis.excerpt import excerpt_of
from suspension_twin.diagnosis.library import library
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.inference.problem import Problem


@pytest.fixture(scope="module")
def whole(make) -> Problem:
    twin, bags, before = make("strut_friction", {"front_force": 150.0, "rear_force": 150.0}, reference=True)
    case = read_case(
        DiagnosisRequest(twin=str(twin), bags=tuple(bags), reference=tuple(before)),
        lambda text: None,
        lambda: False,
    )
    problem = build(case, lambda: False)
    return problem.with_planar_response(problem.prior.centre)


def signals(problem: Problem, x: np.ndarray) -> Any:
    return problem.signals(x[:, None])[0]


@pytest.mark.parametrize("level", [False, True])
def test_it_moves_as_the_whole_drive_does(whole, level, monkeypatch):
    monkeypatch.setattr(module, "SECONDS", 1.5)
    upright = replace(whole, simulation=replace(whole.simulation, upright=True))
    problem = upright if level else whole
    x = problem.prior.centre
    found = excerpt_of(problem, x)
    assert found is not None
    part = found.problem
    assert part.nuisances.names == problem.nuisances.names
    assert 0.2 < found.share < 0.9
    pairs = zip(problem.data.parts, signals(problem, x), strict=True)
    few = zip(part.data.parts, signals(part, x), part.data.rows, strict=True)
    for (one, long), (other, short, rows) in zip(pairs, few, strict=True):
        assert other.t[-1] - other.t[0] < 0.6 * (one.t[-1] - one.t[0])
        for c in range(long.shape[1]):
            same = np.interp(other.t[rows], one.t, long[:, c, 0])
            assert np.std(short[rows, c, 0] - same) < 0.03 * np.std(same)


def test_every_effect_can_be_searched_on_it(whole, monkeypatch):
    monkeypatch.setattr(module, "SECONDS", 1.5)
    found = excerpt_of(whole, whole.prior.centre)
    assert found is not None
    for first, *_ in library(whole.twin, True, drives=3).values():
        x = np.concatenate([whole.prior.centre, first.neutral()])
        residual, failed = found.problem.having(first).residuals(x[:, None])
        assert np.isfinite(residual).all() and not failed.any()


def test_there_is_none_where_it_would_save_little(whole):
    assert excerpt_of(whole, whole.prior.centre) is None


def test_there_is_none_where_unknowns_go_with_the_length(whole, monkeypatch):
    monkeypatch.setattr(module, "SECONDS", 1.5)
    nuisances = whole.data.nuisances(whole.nuisances.priors, (0.0, 1.0, 0.0))
    wandering = replace(whole, likelihood=replace(whole.likelihood, nuisances=nuisances))
    assert excerpt_of(wandering, whole.prior.centre) is None
