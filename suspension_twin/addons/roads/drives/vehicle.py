# SPDX-License-Identifier: Apache-2.0
"""Joint estimation of vehicle and road: parameters of a vehicle from drives over an unknown road, and their limits.

Three channels of every drive see two wheel paths, so that there are more equations than heights. With A
the whitened chain from the road (of unit variance) to the channels, J the derivatives of the channels with
respect to the vehicle's parameters over the road as it is estimated, and

    P = I - A (I + A^T A)^-1 A^T

P leaves the part of the channels that no road explains: P y is the remaining residual, and P J the part of a
parameter's effect that no change of the road makes. The step is a Gauss-Newton step on the part that is left
when P is applied twice,

    (J^T P^2 J + L) d = J^T P^2 y + L (c - z)

with the prior's precision L about c. P alone would weigh the prior of the road as if a vehicle that
amplifies more needed less of a road and were likelier for it.

The covariance of the parameters is the inverse of the matrix on the left; by the delta method it adds
-(I + A^T A)^-1 A^T J d to the error of the road.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from suspension_twin.addons.roads.drives.inverse import Inverse
from suspension_twin.addons.roads.drives.passes import banded
from suspension_twin.arrays import Floats
from suspension_twin.inference.priors import TABLES, TwinPrior, prior_of
from suspension_twin.models.parameters import Parameter, twin_value
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "PARAMETERS",
    "Direction",
    "VehicleEstimate",
    "VehicleStep",
    "scaled_twin",
    "vehicle_estimate",
    "vehicle_step",
]

#: Finite difference of a logarithm, and m of a length.
_STEP = 0.01
#: Largest step of a parameter, in its prior's standard deviations.
_FARTHEST = 1.5
#: A direction that keeps more than this share of the prior's standard deviation is not separable.
_OPEN = 0.7


def _of(key: str, prior: TwinPrior | None = None) -> Parameter:
    """A factor on the value behind a key, or an offset in m, by the prior that a calibration has for it."""
    prior = prior or prior_of(key)
    assert prior is not None
    return prior.about(key, 1.0 if prior.scale == "log" else 0.0)


#: By name; of a damper both directions. The mass is not among them: a common factor of it and all of these but the last
#: changes no motion on any road, so that they are found relative to the mass of the twin file.
PARAMETERS: Final[Mapping[str, Parameter]] = {
    "front springs": _of("vehicle.front.spring.force", TABLES.whole["spring"]),
    "rear springs": _of("vehicle.rear.spring.force", TABLES.whole["spring"]),
    "front dampers": _of("vehicle.front.damper_*.force", TABLES.whole["damper"]),
    "rear dampers": _of("vehicle.rear.damper_*.force", TABLES.whole["damper"]),
    "tyre stiffness": _of("vehicle.tyre.vertical_stiffness"),
    "front unsprung mass": _of("vehicle.front.unsprung_mass"),
    "rear unsprung mass": _of("vehicle.rear.unsprung_mass"),
    "pitch inertia": _of("vehicle.sprung_inertia.pitch"),
    "roll inertia": _of("vehicle.sprung_inertia.roll"),
    "centre of gravity": _of("vehicle.cog.0"),
}
_SPREAD: Final = np.array([p.prior.spread for p in PARAMETERS.values()])


def scaled_twin(twin: Twin, values: Floats) -> Twin:
    """The twin with each of PARAMETERS changed by its value (k,): the logarithm of a factor, or m."""
    changes: dict[str, object] = {}
    for parameter, value in zip(PARAMETERS.values(), values.tolist(), strict=True):
        for key in (parameter.key.replace("*", way) for way in ("push", "pull")):
            now = twin_value(twin, key)
            if isinstance(now, tuple):
                changes[key] = [float(v) * math.exp(value) for v in now]
            else:
                changes[key] = now * math.exp(value) if parameter.prior.log else now + value
    return twin.with_changes(changes)


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the drives do not separate: ``parts`` (name, share), ``left`` of its prior
    standard deviation, and ``amplitude``, by which the road's heights change with one standard deviation of it."""

    parts: tuple[tuple[str, float], ...]
    left: float
    amplitude: float


@dataclass(frozen=True, eq=False)
class VehicleEstimate:
    """The vehicle, estimated with the road.

    Parameters
    ----------
    values : (k,) array
        Of PARAMETERS about the twin that was given.
    covariance : (k, k) array
        Theirs.
    amplitude : float
        Relative standard deviation of the road's heights in the waves between 0.5 and 10 m due to the vehicle.
    open : tuple of Direction
        Combinations that cannot be separated from the road.
    twin : Twin
        With the values.
    """

    values: Floats
    covariance: Floats
    amplitude: float
    open: tuple[Direction, ...]
    twin: Twin

    @property
    def sigma(self) -> Floats:
        """(k,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)

    def as_list(self) -> list[dict[str, object]]:
        """Of each parameter its name, the factor (or m), the 90 % interval, and the remaining share of the prior's
        standard deviation."""
        rows: list[dict[str, object]] = []
        for i, (name, p) in enumerate(PARAMETERS.items()):
            low, middle, high = (float(self.values[i] + q * self.sigma[i]) for q in (-1.645, 0.0, 1.645))
            if p.prior.log:
                low, middle, high = math.exp(low), math.exp(middle), math.exp(high)
            left = float(self.sigma[i] / p.prior.spread)
            row = {"name": name, "unit": "" if p.prior.log else "m", "value": middle, "interval": [low, high]}
            rows.append({**row, "left_of_prior": left})
        return rows

    def not_separable(self) -> list[str]:
        """Sentences on what these drives do not determine."""
        lines = [
            "Not separable: a common factor of all masses, inertias, springs, dampers and the tyre changes no motion; "
            "they are found relative to the mass in the twin file."
        ]
        for way in self.open:
            parts = ", ".join(
                name if abs(share) > 0.95 else f"{name} {'+' if share > 0 else '-'}"
                for name, share in way.parts
            )
            lines.append(
                f"Hardly separable: {parts}; {100 * way.left:.0f} % of the prior's standard deviation is left, which "
                f"makes {100 * abs(way.amplitude):.1f} % of the road's heights."
            )
        lines.append(
            f"The road's heights (waves between 0.5 and 10 m) are known to {100 * self.amplitude:.1f} % (one standard "
            "deviation) as far as the vehicle goes."
        )
        return lines


@dataclass(frozen=True, eq=False)
class VehicleStep:
    """One step: the new ``values``, their ``covariance``, and ``roads`` (k, 2, lines, count), the change of the heights
    of mean and half difference with each parameter."""

    values: Floats
    covariance: Floats
    roads: Floats


def _unexplained(inverse: Inverse, white: Sequence[Floats]) -> tuple[list[Floats], Floats]:
    """P applied, and the unknowns of the inverse that explain the rest."""
    road = inverse.solve(white)
    return [w - a for w, a in zip(white, inverse.forward(road), strict=True)], road


def _dot(a: Sequence[Floats], b: Sequence[Floats]) -> float:
    return float(sum(np.vdot(x, y) for x, y in zip(a, b, strict=True)))


def vehicle_step(
    inverse: Inverse,
    residual: Sequence[Floats],
    simulate: Callable[[Floats], list[Floats]],
    values: Floats,
    repeats: float = 1.0,
) -> VehicleStep:
    """A Gauss-Newton step of the vehicle's parameters.

    Parameters
    ----------
    inverse : Inverse
        The linear inverse about the present road.
    residual : sequence of array
        P y: whitened channels that the road's posterior mean leaves.
    simulate : callable
        Channels (3, n) of every pass over the present road for values of PARAMETERS.
    values : (k,) array
        Of PARAMETERS, at present.
    repeats : float
        Samples for each independent one of the noise: the channels count as if there were so many times fewer.

    Returns
    -------
    VehicleStep
        New values, their covariance, and their effect on the road.
    """
    known = [np.zeros_like(k.target) for k in inverse.known]
    here, jacobian = simulate(values), []
    for row in _STEP * np.eye(len(PARAMETERS)):
        pairs = zip(inverse.linear, here, simulate(values + row), strict=True)
        jacobian.append([*(s.whiten((moved - at) / _STEP) for s, at, moved in pairs), *known])
    left = [_unexplained(inverse, column) for column in jacobian]
    again = _unexplained(inverse, residual)[0]
    gradient = np.array([_dot(column, again) for column in jacobian]) / repeats
    matrix = np.array([[_dot(a[0], b[0]) for b in left] for a in left]) / repeats
    precision = np.diag(_SPREAD**-2.0)
    covariance: Floats = np.asarray(np.linalg.inv(matrix + precision), dtype=np.float64)
    step = covariance @ (gradient - precision @ values)
    step *= min(1.0, _FARTHEST / float(np.abs(step / _SPREAD).max()))
    return VehicleStep(values + step, covariance, np.array([-inverse.heights(u) for _, u in left]))


def vehicle_estimate(
    twin: Twin,
    step: VehicleStep,
    heights: Floats,
    covered: NDArray[np.bool_],
    spacing: float,
    band: tuple[float, float],
) -> VehicleEstimate:
    """The vehicle after its last step, with the directions that cannot be separated.

    ``heights`` (2, count) m of mean and half difference every ``spacing`` m are compared where they are ``covered``, in
    the waves of ``band`` cycles/m; the step's roads are those of the same line.
    """
    mean = banded(heights, spacing, *band)[:, covered]
    power = max(float(np.vdot(mean, mean)), 1e-30)
    gains = np.array(
        [float(np.vdot(mean, banded(r, spacing, *band)[:, covered])) / power for r in step.roads]
    )
    # In units of the prior, eigenvectors with a large variance are not determined by the drives.
    variances, vectors = np.linalg.eigh(step.covariance / np.outer(_SPREAD, _SPREAD))
    names, found = list(PARAMETERS), []
    for variance, vector in sorted(zip(variances, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if math.sqrt(variance) < _OPEN:
            break
        order = np.argsort(-np.abs(vector))
        sign = math.copysign(1.0, vector[order[0]])
        parts = tuple((names[i], float(sign * vector[i])) for i in order[:4] if abs(vector[i]) > 0.3)
        amplitude = float(sign * math.sqrt(variance) * (gains * _SPREAD) @ vector)
        found.append(Direction(parts, math.sqrt(variance), amplitude))
    return VehicleEstimate(
        values=step.values,
        covariance=step.covariance,
        amplitude=float(math.sqrt(gains @ step.covariance @ gains)),
        open=tuple(found),
        twin=scaled_twin(twin, step.values),
    )
