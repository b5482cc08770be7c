# SPDX-License-Identifier: Apache-2.0
"""Vehicle and road at once: what drives over an unknown road say of the vehicle, and what they cannot.

Three channels of every drive see two wheel paths, so that there are more equations than heights. With A
the whitened chain from the road (of unit variance) to the channels, J the derivatives of the channels with
respect to the vehicle's parameters over the road as it is estimated, and

    P = I - A (I + A^T A)^-1 A^T

P leaves of the channels what no road explains. P y is the remaining residual and P J what of a parameter's
effect no other road could make. The step is a Gauss-Newton step on the part that is left when P is applied
twice,

    (J^T P^2 J + L) d = J^T P^2 y + L (c - z)

with the prior's precision L about c. P alone would weigh the prior of the road as if a vehicle that
amplifies more needed less of a road and were likelier for it.

The covariance of the parameters is the inverse of the matrix on the left; by the delta method the error of
the road gets what it makes of the road, -(I + A^T A)^-1 A^T J d.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspension_twin.addons.roads.drives.alignment import banded
from suspension_twin.addons.roads.drives.inverse import Inverse, Unknown
from suspension_twin.addons.roads.drives.passes import Pass
from suspension_twin.arrays import Floats
from suspension_twin.inference.priors import prior_of
from suspension_twin.road.road import Road
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "PARAMETERS",
    "Direction",
    "Scaled",
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
#: A direction of which the drives leave more than this share of the prior's standard deviation is not separable.
_OPEN = 0.7


@dataclass(frozen=True)
class Scaled:
    """A factor on the values of ``keys`` (a distance in m where not ``log``), with the ``spread`` of its prior: the
    standard deviation of its logarithm."""

    name: str
    keys: tuple[str, ...]
    spread: float
    log: bool = True


def _of(name: str, *keys: str) -> Scaled:
    """With the prior that a calibration has for the first key."""
    prior = prior_of(keys[0])
    assert prior is not None
    return Scaled(name, keys, prior.spread, prior.log)


#: The mass is not among them: a common factor of it and all of these but the last changes no motion on any road, so
#: that they are found relative to the mass of the twin file.
#: Springs and dampers as a whole have priors from what passenger cars are like (Gillespie, Fundamentals of Vehicle
#: Dynamics, 1992, chapter 5): ride frequencies of 1 to 1.5 Hz, which is about 20 % in stiffness; damping ratios of 0.2
#: to 0.4, and a worn damper less.
PARAMETERS = (
    Scaled("front springs", ("vehicle.front.spring.force",), 0.2),
    Scaled("rear springs", ("vehicle.rear.spring.force",), 0.2),
    Scaled("front dampers", ("vehicle.front.damper_push.force", "vehicle.front.damper_pull.force"), 0.4),
    Scaled("rear dampers", ("vehicle.rear.damper_push.force", "vehicle.rear.damper_pull.force"), 0.4),
    _of("tyre stiffness", "vehicle.tyre.vertical_stiffness"),
    _of("front unsprung mass", "vehicle.front.unsprung_mass"),
    _of("rear unsprung mass", "vehicle.rear.unsprung_mass"),
    _of("pitch inertia", "vehicle.sprung_inertia.pitch"),
    _of("roll inertia", "vehicle.sprung_inertia.roll"),
    _of("centre of gravity", "vehicle.cog.0"),
)


def scaled_twin(twin: Twin, values: Floats) -> Twin:
    """The twin with each of PARAMETERS changed by its value (k,): the logarithm of a factor, or m."""
    changes: dict[str, Any] = {}
    for parameter, value in zip(PARAMETERS, values.tolist(), strict=True):
        for key in parameter.keys:
            node: Any = twin
            for part in key.split("."):
                node = node[int(part)] if part.isdigit() else getattr(node, part)
            if not parameter.log:
                changes[key] = node + value
            elif isinstance(node, tuple):
                changes[key] = [float(v) * math.exp(value) for v in node]
            else:
                changes[key] = node * math.exp(value)
    return twin.with_changes(changes)


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the drives leave open: ``parts`` (name, share), ``left`` of its prior standard
    deviation, and ``amplitude``, by which the road's heights change with one standard deviation of it."""

    parts: tuple[tuple[str, float], ...]
    left: float
    amplitude: float


@dataclass(frozen=True, eq=False)
class VehicleEstimate:
    """``values`` (k,) of PARAMETERS about the twin that was given, their ``covariance`` (k, k) and ``prior`` standard
    deviations (k,); ``amplitude`` relative standard deviation of the road's heights in the waves between 0.5 and 10 m
    that comes of it; ``open`` directions that cannot be separated from the road; ``twin`` with the values."""

    values: Floats
    covariance: Floats
    prior: Floats
    amplitude: float
    open: tuple[Direction, ...]
    twin: Twin

    @property
    def sigma(self) -> Floats:
        """(k,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)

    def as_list(self) -> list[dict[str, Any]]:
        """Of each parameter its name, the factor (or m), the 90 % interval, and which share of the prior's standard
        deviation is left."""
        rows = []
        for i, p in enumerate(PARAMETERS):
            low, middle, high = (float(self.values[i] + q * self.sigma[i]) for q in (-1.645, 0.0, 1.645))
            if p.log:
                low, middle, high = math.exp(low), math.exp(middle), math.exp(high)
            rows.append(
                {
                    "name": p.name,
                    "unit": "" if p.log else "m",
                    "value": middle,
                    "interval": [low, high],
                    "left_of_prior": float(self.sigma[i] / self.prior[i]),
                }
            )
        return rows

    def not_separable(self) -> list[str]:
        """In sentences, what these drives leave open."""
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
    """One step: the new ``values``, their ``covariance``, and ``roads`` (k, 2, count), the change of the heights of
    mean and half difference with each parameter."""

    values: Floats
    covariance: Floats
    roads: Floats


def _derivatives(
    passes: Sequence[Pass], inverse: Inverse, shifts: Sequence[Floats], twin: Twin, values: Floats, road: Road
) -> list[list[Floats]]:
    """Of each parameter the whitened change of every channel, over the road and of known heights (none)."""

    def driven(numbers: Floats) -> list[Floats]:
        other = scaled_twin(twin, numbers)
        return [p.simulated(other, road, s) for p, s in zip(passes, shifts, strict=True)]

    zero = [np.zeros_like(k.target) for k in inverse.known]
    here, out = driven(values), []
    for row in _STEP * np.eye(len(PARAMETERS)):
        pairs = zip(inverse.seen, here, driven(values + row), strict=True)
        out.append([*(s.whiten((moved - at) / _STEP) for s, at, moved in pairs), *zero])
    return out


def _left(inverse: Inverse, white: Sequence[Floats]) -> tuple[list[Floats], Unknown]:
    """P applied, and the road (of unit variance) that explains the rest."""
    road = inverse.solve(white)
    return [w - a for w, a in zip(white, inverse.forward(road), strict=True)], road


def _dot(a: Sequence[Floats], b: Sequence[Floats]) -> float:
    return float(sum(np.vdot(x, y) for x, y in zip(a, b, strict=True)))


def vehicle_step(
    passes: Sequence[Pass],
    inverse: Inverse,
    residual: Sequence[Floats],
    shifts: Sequence[Floats],
    twin: Twin,
    values: Floats,
    road: Road,
    repeats: float = 1.0,
) -> VehicleStep:
    """A Gauss-Newton step of the vehicle's parameters.

    Parameters
    ----------
    passes : sequence of Pass
        The drives.
    inverse : Inverse
        The linear inverse about ``road``.
    residual : sequence of array
        P y: whitened channels that the road's posterior mean leaves.
    shifts : sequence of array
        Of each pass along the road.
    twin : Twin
        The twin that was given.
    values : (k,) array
        Of PARAMETERS, at present.
    road : Road
        The road as it is known.
    repeats : float
        How often the noise says the same: the channels count as if there were so many times fewer.

    Returns
    -------
    VehicleStep
        New values, their covariance, and what they make of the road.
    """
    spread = np.array([p.spread for p in PARAMETERS])
    precision = np.diag(spread**-2.0)
    jacobian = _derivatives(passes, inverse, shifts, twin, values, road)
    left = [_left(inverse, column) for column in jacobian]
    again = _left(inverse, residual)[0]
    gradient = np.array([_dot(column, again) for column in jacobian]) / repeats
    matrix = np.array([[_dot(a[0], b[0]) for b in left] for a in left]) / repeats
    covariance: Floats = np.asarray(np.linalg.inv(matrix + precision), dtype=np.float64)
    step = covariance @ (gradient - precision @ values)
    step *= min(1.0, _FARTHEST / float(np.abs(step / spread).max()))
    roads = np.array([-inverse.prior.heights(u.road) for _, u in left])
    return VehicleStep(values + step, covariance, roads)


def vehicle_estimate(
    twin: Twin,
    step: VehicleStep,
    heights: Floats,
    covered: NDArray[np.bool_],
    spacing: float,
    band: tuple[float, float],
) -> VehicleEstimate:
    """What a step came to, with what cannot be separated; ``heights`` (2, count) m of mean and half difference every
    ``spacing`` m, compared where they are ``covered`` in the waves of ``band`` cycles/m."""
    spread = np.array([p.spread for p in PARAMETERS])
    mean = banded(heights, spacing, *band)[:, covered]
    power = max(float(np.vdot(mean, mean)), 1e-30)
    gains = np.array(
        [float(np.vdot(mean, banded(r, spacing, *band)[:, covered])) / power for r in step.roads]
    )
    # In units of the prior, eigenvectors with a large variance are what the drives leave open.
    scaled = step.covariance / np.outer(spread, spread)
    variances, vectors = np.linalg.eigh(scaled)
    found = []
    for variance, vector in sorted(zip(variances, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if math.sqrt(variance) < _OPEN:
            break
        order = np.argsort(-np.abs(vector))
        sign = math.copysign(1.0, vector[order[0]])
        parts = tuple(
            (PARAMETERS[i].name, float(sign * vector[i])) for i in order[:4] if abs(vector[i]) > 0.3
        )
        amplitude = float(sign * math.sqrt(variance) * (gains * spread) @ vector)
        found.append(Direction(parts, math.sqrt(variance), amplitude))
    return VehicleEstimate(
        values=step.values,
        covariance=step.covariance,
        prior=spread,
        amplitude=float(math.sqrt(gains @ step.covariance @ gains)),
        open=tuple(found),
        twin=scaled_twin(twin, step.values),
    )
