# SPDX-License-Identifier: Apache-2.0
"""Evidence beside what every car has.

Every car has a little friction, a sensor a few centimetres from where its file says, a tyre a few per cent off: each
effect of the library at its usual size. Together they make a part of what the twin of a sound car leaves, and a cause
that is not there imitates that part. A hypothesis is therefore judged beside all of them. With the whitened residual r
and the Jacobian J at its fit, and the changes D that the effects make at their usual sizes, the residual is

    r + J s + D w,   w ~ N(0, 1), w >= 0 of an effect that has one sign,

and the evidence is that of this linear problem with the tempered likelihood (Laplace's method). What a little of
everything explains as well is no evidence of one cause.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.inference.fit import LinearisedFit
from suspension_twin.inference.gauss_newton import bounded_step
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.problem import Problem, whitener_of

__all__ = ["UsualErrors", "usual_errors"]


@dataclass(frozen=True, eq=False)
class UsualErrors:
    """Changes ``columns`` (R, n) of the whitened residuals by effects at their usual sizes, ``low`` (n,) bounds of
    their coordinates (0 where an effect has one sign), and the ``effects`` (n,) that each belongs to."""

    columns: Floats
    low: Floats
    effects: tuple[str, ...]

    def log_evidence(self, problem: Problem, fit: LinearisedFit, temper: float) -> float:
        """Nats of a ``fit`` beside the usual errors of all effects but its own."""
        others = [i for i, effect in enumerate(self.effects) if effect not in fit.hypothesis.effects]
        columns, low = self.columns[:, others], self.low[others]
        given, centre = problem.having(fit.hypothesis).joint_prior()
        p, n = len(given), len(others)
        precision, away = np.eye(p + n), np.zeros(p + n)
        precision[:p, :p], away[:p] = given, fit.x - centre
        model = fit.at.with_effects(fit.at.residual, columns)
        hessian = temper * model.squares + precision
        gradient = temper * model.slope + precision @ away
        ends = problem.having(fit.hypothesis).room(fit.x)
        step = bounded_step(
            hessian,
            gradient[:, None],
            np.concatenate([ends[0], low]),
            np.concatenate([ends[1], np.full(n, np.inf)]),
        )[:, 0]
        cost = 0.5 * (temper * model.value + away @ precision @ away)
        cost += float(gradient @ step + 0.5 * step @ hessian @ step)
        occam = 0.5 * (np.linalg.slogdet(hessian)[1] - np.linalg.slogdet(precision)[1])
        return -float(cost + occam)


def usual_errors(
    problem: Problem, x: Floats, library: Mapping[str, Sequence[Hypothesis]], everywhere: bool
) -> UsualErrors:
    """The usual errors of the effects of a ``library`` on the vehicle of the fit ``x`` (d + q,) without any effect.

    Those of a twin file are there before and after a change: with a reference (``everywhere``) they act on all drives.
    A tone has no usual phase and is left out.
    """
    found: list[tuple[Floats, float, str]] = []
    for effect, variants in library.items():
        for v in variants:
            hypothesis, sizes = (
                v.on_all_drives() if everywhere else v,
                v.at_usual_sizes(problem.twin.vehicle.mass),
            )
            if sizes:
                points = [np.concatenate([x, at]) for pair in sizes for at in pair[:2]]
                residual, failed = problem.having(hypothesis).residuals(np.stack(points, axis=1))
                found += [
                    (residual[:, 2 * i] - residual[:, 2 * i + 1], 0.0 if one_sided else -np.inf, effect)
                    for i, (_, _, one_sided) in enumerate(sizes)
                    if not failed[2 * i : 2 * i + 2].any()
                ]
    none = np.zeros((whitener_of(problem).row.size, 0))
    columns = np.stack([change for change, _, _ in found], axis=1) if found else none
    return UsualErrors(columns, np.array([low for _, low, _ in found]), tuple(e for _, _, e in found))
