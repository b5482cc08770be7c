# SPDX-License-Identifier: Apache-2.0
"""The findings of recalibration: characteristics and numbers of the twin file that moved beyond their uncertainty.

A characteristic moved if the 90 % interval of its change excludes zero, over draws of the vehicle's coordinates about
their fit without any effect, and of the values before by the standard deviations that the twin file states of them. The
covariance of the fit (``cross_validation.covariance_of``) is that beside the usual errors of every car: a little dry
friction, which the vehicle here does not have, moves the dampers that fit best by a few per cent.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.labels import parameter_label, parameter_unit
from suspension_twin.calibration.uncertainty import INTERVAL
from suspension_twin.diagnosis.answer import rounded
from suspension_twin.diagnosis.judge import Judged
from suspension_twin.diagnosis.shrink import gap_rows
from suspension_twin.diagnosis.usual_errors import UsualErrors
from suspension_twin.errors import InputError
from suspension_twin.files import Json
from suspension_twin.inference.cross_validation import covariance_of
from suspension_twin.inference.fit import linearised_fit, twin_of
from suspension_twin.inference.hypothesis import BASELINE
from suspension_twin.inference.posterior import DRAWS, Travel, drawn_curve, forces_at, span_of, travel
from suspension_twin.inference.space import Curve, Space
from suspension_twin.models.parameters import twin_value
from suspension_twin.vehicle.twin import Twin

__all__ = ["recalibrated"]


@dataclass(frozen=True, eq=False)
class _Change:
    """A characteristic or number: the rows of its parameters in the space, ``before`` and ``after`` in ``unit``, and
    ``draws`` (N,) of its change, relative to what it was where ``relative``."""

    name: str
    rows: tuple[int, ...]
    before: float
    after: float
    unit: str
    relative: bool
    draws: Floats

    @property
    def interval(self) -> tuple[float, float]:
        """90 % interval of the change."""
        low, high = np.quantile(self.draws, INTERVAL)
        return float(low), float(high)

    @property
    def moved(self) -> bool:
        """Whether the interval excludes zero."""
        low, high = self.interval
        return low > 0.0 or high < 0.0

    @property
    def change(self) -> float:
        """The change of what is reported."""
        return (self.after / self.before - 1.0) if self.relative else self.after - self.before


def recalibrated(judged: Judged, given: Twin, seed: int, usual: UsualErrors | None = None) -> list[Json]:
    """List the values that recalibration moved, the largest ``share`` of the gap first.

    Parameters
    ----------
    judged : Judged
        The fits; those of the vehicle alone are used.
    given : Twin
        The twin as given.
    seed : int
        Seed of the draws.
    usual : UsualErrors
        What every car has; without it nothing is taken to stand beside the vehicle.

    Returns
    -------
    list
        A mapping for each: ``characteristic``, ``keys`` of the twin file, ``before`` and ``after`` in ``unit``,
        ``change`` with its 90 % ``interval`` (relative, or in ``unit`` where the number may be zero: ``relative``), and
        the ``share`` of the gap's mean square, of what recalibration closes, that it closes alone, and whether the twin
        file had ``stated`` how sure it was of each value: then it has changed since.
    """
    problem, fit = judged.problem, judged.base.found.fit
    space, d = problem.space, problem.d
    if not d:  # held as the reference shows it
        return []
    try:
        known = np.array([float(twin_value(given, key)) for key in space.keys])
    except InputError:  # the fit has points that the given file has not
        return []
    at = linearised_fit(problem.having(BASELINE), fit.x)
    beside = None if usual is None else usual.columns
    covariance = covariance_of(problem, at, judged.search.blocks, judged.scale.temper, beside)[:d, :d]
    # not wider than the prior, which the division by the temper may exceed where the drives say nothing
    prior = np.diag(np.linalg.inv(problem.having(BASELINE).joint_prior()[0]))[:d]
    narrower = np.minimum(np.sqrt(prior / np.diag(covariance)), 1.0)
    root = np.linalg.cholesky(covariance * np.outer(narrower, narrower) + 1e-14 * np.eye(d))
    random = np.random.default_rng(seed)
    draws = space.from_slopes(fit.x[:d, None] + root @ random.standard_normal((d, DRAWS)))
    sigma = np.array([given.deviation(key) for key in space.keys])
    earlier = known[:, None] + sigma[:, None] * random.standard_normal((known.size, DRAWS))
    after = twin_of(problem, fit)
    changes = [
        *_of_curves(space, (given, after), travel(after, problem), (earlier, draws)),
        *_of_numbers(space, given, space.from_slopes(fit.x[:d]), (known, earlier, draws)),
    ]
    moved = [change for change in changes if change.moved]
    shares = _shares(judged, space.to_slopes(np.clip(known, space.lower, space.upper)), moved)
    found = [
        {
            "characteristic": one.name,
            "keys": sorted({re.sub(r"(\.force)\.\d+$", r"\1", space.keys[r]) for r in one.rows}),
            "before": rounded(one.before),
            "after": rounded(one.after),
            "unit": one.unit,
            "change": rounded(one.change),
            "interval": [rounded(end) for end in one.interval],
            "relative": one.relative,
            "share": rounded(share),
            "stated": bool(np.all(sigma[list(one.rows)] > 0.0)),
        }
        for one, share in zip(moved, shares, strict=True)
    ]
    return sorted(found, key=lambda one: -one["share"])


#: Twins and draws of their values (d, N), before and after.
_Twins = tuple[Twin, Twin]
_Draws = tuple[Floats, Floats]


def _of_curves(space: Space, twins: _Twins, where: Travel, draws: _Draws) -> list[_Change]:
    """The change of each spring and damper in the range that the drives excited; both directions of a damper together
    where they changed alike."""
    found: list[_Change] = []
    for curve in space.curves:
        low, high = span_of(curve, where)
        if not np.isfinite(high) or high <= low:
            continue
        one = _of_spring(curve, twins, where, (low, high), draws)
        if curve.part != "spring":
            one = _of_damper(curve, twins, high, draws)
        if not one.before > 0.0:
            continue
        pair = found[-1] if found and curve.part == "damper_pull" else None
        if pair is not None and pair.name == f"{_axle(curve)}damper, push" and _alike(pair, one):
            found[-1] = _Change(
                f"{_axle(curve)}damper, both ways",
                pair.rows + one.rows,
                0.5 * (pair.before + one.before),
                0.5 * (pair.after + one.after),
                one.unit,
                True,
                (pair.before * pair.draws + one.before * one.draws) / (pair.before + one.before),
            )
        else:
            found.append(one)
    return found


def _axle(curve: Curve) -> str:
    return f"{curve.axle} " if curve.axle else ""


def _alike(one: _Change, other: _Change) -> bool:
    """Whether two changes are of one sign, each beyond its uncertainty."""
    return one.moved and other.moved and one.change * other.change > 0.0


def _of_spring(
    curve: Curve, twins: _Twins, where: Travel, span: tuple[float, float], draws: _Draws
) -> _Change:
    """The mean rate of a spring over the excited travel about the standing car, where each curve bears the load."""
    (_, earlier), (x, forces) = (drawn_curve(curve, t, d) for t, d in zip(twins, draws, strict=True))
    static = where.static[curve.axle]
    middle = twin_value(twins[1], curve.key).points[1][:, None]
    load = float(forces_at(static, x, middle)[0])

    def rate(x: Floats, force: Floats, standing: float) -> Floats:
        low, high = (standing + end - static for end in span)
        return np.asarray((forces_at(high, x, force) - forces_at(low, x, force)) / (high - low))

    x0, force0 = twin_value(twins[0], curve.key).points
    standing = float(np.interp(load, np.append(0.0, force0), np.append(0.0, x0)))
    before = float(rate(x0, force0[:, None], standing)[0])
    after = float(rate(x, middle, static)[0])
    own = tuple(r for r in curve.rows if r >= 0)
    change = rate(x, forces, static) / rate(x0, earlier, standing) - 1.0
    return _Change(f"{_axle(curve)}spring rate", own, before, after, "N/m", True, change)


def _of_damper(curve: Curve, twins: _Twins, reached: float, draws: _Draws) -> _Change:
    """The mean force of a damper over the velocities that the drives reached."""
    places = np.linspace(0.0, reached, 9)[1:]

    def force(x: Floats, values: Floats) -> Floats:
        return np.asarray(np.mean(forces_at(places, x, values), axis=0))

    before, after = (
        float(force(x, values[:, None])[0]) for x, values in (twin_value(t, curve.key).points for t in twins)
    )
    (x0, earlier), (x, forces) = (drawn_curve(curve, t, d) for t, d in zip(twins, draws, strict=True))
    way = curve.part.removeprefix("damper_")
    own = tuple(r for r in curve.rows if r >= 0)
    return _Change(
        f"{_axle(curve)}damper, {way}",
        own,
        before,
        after,
        "N",
        True,
        force(x, forces) / np.maximum(force(x0, earlier), 1e-9) - 1.0,
    )


def _of_numbers(
    space: Space, given: Twin, found: Floats, values: tuple[Floats, Floats, Floats]
) -> list[_Change]:
    """The change of every parameter that is no point of a characteristic; ``values`` (d,) are those of the file, then
    draws (d, N) of these and of what was ``found`` (d,)."""
    known, earlier, draws = values
    on_curve = {r for curve in space.curves for r in curve.rows}
    changes = []
    for row, parameter in enumerate(space.parameters):
        if row in on_curve:
            continue
        before, after = float(known[row]), float(found[row])
        relative = bool(parameter.prior.log and before > 0.0)
        change = draws[row] / earlier[row] - 1.0 if relative else draws[row] - earlier[row]
        name, unit = parameter_label(given, parameter.key), parameter_unit(parameter.key)
        changes.append(_Change(name, (row,), before, after, unit, relative, change))
    return changes


def _shares(judged: Judged, given: Floats, moved: Sequence[_Change]) -> list[float]:
    """The share of the gap that recalibration closes which each change closes alone, of its mean square in the main
    channel: with the nuisance parameters as fitted."""
    problem, x = judged.problem.having(BASELINE), judged.base.found.fit.x
    lanes = np.repeat(x[:, None], 1 + len(moved), axis=1)
    lanes[: problem.d] = given[:, None]
    for lane, one in enumerate(moved, 1):
        lanes[list(one.rows), lane] = x[list(one.rows)]
    rows = gap_rows(problem)
    compared = problem.compared(np.concatenate([lanes, x[:, None]], axis=1))[rows, 0]
    gap = np.mean((compared - problem.measured.values[rows, 0][:, None]) ** 2, axis=0)
    closed = float(gap[0] - gap[-1])
    if not closed > 0.0:
        return [0.0] * len(moved)
    return [float(np.clip((gap[0] - value) / closed, 0.0, 1.0)) for value in gap[1:-1]]
