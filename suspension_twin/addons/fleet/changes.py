# SPDX-License-Identifier: Apache-2.0
r"""Whether and when a quantity of a vehicle changed: one step in a series of estimates with intervals.

Of n estimates in the order of their dates, :math:`y_i` is the logarithm and :math:`s_i` the standard deviation that
follows from its 90 % interval. The model of a step before estimate k is

.. math:: y_i = \mu + \delta\,[i \ge k] + e_i, \qquad e_i \sim N(0, s_i^2 + \tau^2)

with a flat prior of :math:`\mu`, :math:`\delta \sim N(0, d^2)`, and the drive-to-drive scatter :math:`\tau`
marginalised on a grid. With a prior probability that there is a step, equal for all k, Bayes' rule gives the
probability of a step and the distribution of its place (A. F. M. Smith, "A Bayesian approach to inference about a
change-point in a sequence of random variables", Biometrika 62, 1975).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from suspension_twin.arrays import Floats

__all__ = ["NAMED", "ChangePoint", "QuantitySeries", "find_changes", "step_in"]

#: A change is named from this probability on.
NAMED = 0.95
#: Prior that one quantity of one vehicle changes within a series: a prior, one vehicle in ten with several quantities.
_PRIOR = 0.02
#: Prior standard deviation of a step's logarithm: a third up or down, as worn dampers and soft tyres have.
_STEP = 0.3
#: Scatter from drive to drive beyond the intervals, as a share; log-uniform.
_SCATTER = np.geomspace(0.003, 0.3, 25)
#: Estimates on either side of a step: a single one that is off is an outlier as well.
_SIDE = 2
_INTERVAL = 2.0 * 1.6448536269514722  # standard deviations that a 90 % interval spans
_TAIL = 0.05


@dataclass(frozen=True)
class QuantitySeries:
    """Estimates of one quantity of one vehicle.

    Parameters
    ----------
    vehicle, quantity, unit : str
        Names.
    dates : tuple of str
        In order.
    values, sigma : tuple of float
        Estimates above 0, and their standard deviations.
    """

    vehicle: str
    quantity: str
    unit: str
    dates: tuple[str, ...]
    values: tuple[float, ...]
    sigma: tuple[float, ...]


@dataclass(frozen=True)
class ChangePoint:
    """Whether one quantity of one vehicle changed.

    Parameters
    ----------
    series : QuantitySeries
        The estimates.
    probability : float
        That there was a step.
    date : str
        Of the first drive after the likeliest step.
    earliest, latest : str
        Dates between which the step lies with 90 % probability, if there was one.
    before, after : float
        The quantity on either side of the likeliest step.
    ratio : tuple of float
        After over before, and the ends of its 90 % interval.
    """

    series: QuantitySeries
    probability: float
    date: str
    earliest: str
    latest: str
    before: float
    after: float
    ratio: tuple[float, float, float]

    @property
    def named(self) -> bool:
        """Whether it is sure enough to be reported as a change."""
        return self.probability >= NAMED

    def as_row(self) -> dict[str, object]:
        """A row of ``changes.parquet``."""
        own = {k: v for k, v in vars(self).items() if k not in ("series", "ratio")}
        names = {name: getattr(self.series, name) for name in ("vehicle", "quantity", "unit")}
        ratio = dict(zip(("ratio", "ratio_low", "ratio_high"), self.ratio, strict=True))
        return {**names, **own, **ratio, "drives": len(self.series.values)}


def find_changes(health: Iterable[Mapping[str, Any]]) -> list[ChangePoint]:
    """Look for a step in every series.

    Parameters
    ----------
    health : iterable of mapping
        Rows of ``health.parquet``: ``vehicle``, ``quantity``, ``date``, ``value``, ``low``, ``high``, ``unit``,
        ``identified``.

    Returns
    -------
    list of ChangePoint
        Of every series that is long enough, the surest first.

    Examples
    --------
    >>> find_changes([])
    []
    """
    usable = [
        r
        for r in health
        if r["identified"] and r["date"] and (r["value"] or 0.0) > 0.0 and None not in (r["low"], r["high"])
    ]
    usable.sort(key=lambda r: (r["vehicle"], r["quantity"], r["date"]))
    found = []
    for (vehicle, quantity), group in groupby(usable, key=lambda r: (r["vehicle"], r["quantity"])):
        rows = list(group)
        estimates = [(r["date"], r["value"], (r["high"] - r["low"]) / _INTERVAL) for r in rows]
        found.append(
            step_in(QuantitySeries(vehicle, quantity, rows[0]["unit"], *zip(*estimates, strict=True)))
        )
    changes = [change for change in found if change is not None]
    return sorted(changes, key=lambda c: (-c.probability, c.series.vehicle, c.series.quantity))


def step_in(series: QuantitySeries) -> ChangePoint | None:
    """Probability, place and size of a step in one series.

    Parameters
    ----------
    series : QuantitySeries
        Estimates of one quantity.

    Returns
    -------
    ChangePoint or None
        None where there are fewer than two estimates on either side of any step.

    Examples
    --------
    >>> values = (*[100.0] * 4, *[70.0] * 4)
    >>> step_in(QuantitySeries("car", "force", "N", tuple("abcdefgh"), values, (2.0,) * 8)).date
    'e'
    """
    n, dates = len(series.values), series.dates
    if n < 2 * _SIDE:
        return None
    y = np.log(np.asarray(series.values, dtype=np.float64))
    s = np.asarray(series.sigma, dtype=np.float64) / np.asarray(series.values, dtype=np.float64)
    places = np.arange(_SIDE, n - _SIDE + 1)
    weights = 1.0 / (s**2 + _SCATTER[:, None] ** 2)
    none, evidence, means, variances = _evidence(y, weights, np.arange(n) >= places[:, None])
    prior = np.log([1.0 - _PRIOR, *np.full(places.size, _PRIOR / places.size)])
    joint = np.column_stack([none, evidence]) + prior
    step = logsumexp(joint[:, 1:])
    at = np.exp(logsumexp(joint[:, 1:], axis=0) - step)
    best = int(np.argmax(at))
    low, high = (int(np.searchsorted(np.cumsum(at), share)) for share in (_TAIL, 1.0 - _TAIL))
    share = np.exp(joint[:, best + 1] - logsumexp(joint[:, best + 1]))
    mean = float(share @ means[:, best])
    spread = math.sqrt(float(share @ (variances[:, best] + (means[:, best] - mean) ** 2)))
    weight = share @ weights
    first = int(places[best])
    before, after = (
        float(np.exp(np.average(y[part], weights=weight[part])))
        for part in (slice(0, first), slice(first, n))
    )
    reach = _INTERVAL / 2.0 * spread
    return ChangePoint(
        series,
        probability=float(np.exp(step - logsumexp(joint))),
        date=dates[first],
        earliest=dates[int(places[low])],
        latest=dates[int(places[min(high, places.size - 1)])],
        before=before,
        after=after,
        ratio=(math.exp(mean), math.exp(mean - reach), math.exp(mean + reach)),
    )


def _evidence(y: Floats, weights: Floats, steps: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats, Floats]:
    """Logarithms of the marginal likelihoods without a step (T,) and with each of K steps (K, n) (T, K), the mean
    integrated out, for T rows of weights (T, n); then mean and variance of the steps' logarithms, both (T, K)."""
    total = weights.sum(axis=1)
    centred = y - (weights @ y / total)[:, None]
    none = 0.5 * (np.log(weights).sum(axis=1) - np.log(total) - (weights * centred**2).sum(axis=1))
    after = weights @ steps.T  # (T, K)
    precision = after - after**2 / total[:, None] + _STEP**-2
    mean = (weights * centred) @ steps.T / precision
    gain = 0.5 * (mean**2 * precision - np.log(precision * _STEP**2))
    return none, none[:, None] + gain, mean, 1.0 / precision
