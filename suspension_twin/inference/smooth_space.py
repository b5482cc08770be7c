# SPDX-License-Identifier: Apache-2.0
"""Smooth changes of characteristics that have many points.

A curve of n points has n log slopes. Their change from the nominal ones is interpolated linearly between a few knots,
spread evenly over its points, so that the number of unknowns does not grow with n:

    z_i = z0_i + sum_k W_ik a_k,   W (n, K) the interpolation from K knots.

The amplitudes a have the prior of the log slopes of a curve of K points. This is the Gaussian-process prior of the
change, conditioned on K inducing points. A step of a simulation costs as much as the curves have points, so that a few
of the curve's own points are simulated: those at the knots, and those that follow its nominal shape best (Douglas and
Peucker 1973).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.inference.priors import TABLES
from suspension_twin.inference.space import CURVES, FEW_POINTS, Space, curve_keys
from suspension_twin.models.parameters import Parameter, twin_value
from suspension_twin.vehicle.twin import Twin

__all__ = ["KNOTS", "SmoothSpace", "smooth_space"]

#: As many as a curve of the car paper's Table 2 has points.
KNOTS: Final = len(TABLES.table_2["spring"].x)


def smooth_space(twin: Twin, space: Space) -> Space:
    """``space`` itself where no curve of the twin has many points, else the smooth space of the same parameters."""
    sizes = [len(curve_keys(twin, [curve])) for curve in CURVES]
    return SmoothSpace(twin, space.parameters) if max(sizes) > FEW_POINTS else space


@dataclass(frozen=True, eq=False)
class _Shape:
    """The change of one curve: rows ``points`` (n,) among the parameters, ``knots`` (K,) among the coordinates, and the
    interpolation ``weights`` (n, K)."""

    points: NDArray[np.intp]
    knots: NDArray[np.intp]
    weights: Floats


class SmoothSpace(Space):
    """A space in which a curve of many points, all of them free, has ``KNOTS`` coordinates.

    Values (d, L), bounds and unit coordinates are those of the parameters, one a point. Slope coordinates (c, L) with
    c = ``len(space)`` are fewer. The vehicle is that of the twin that the space was made for.
    """

    def __init__(self, twin: Twin, parameters: Sequence[Parameter]) -> None:
        self._shapes: tuple[_Shape, ...] = ()
        super().__init__(twin, parameters)
        self._slopes = self.z0
        many = [c for c in self.curves if c.x.size > FEW_POINTS and min(c.rows) >= 0]
        on_many = {row for curve in many for row in curve.rows}
        self._rest = np.array([r for r in range(len(self.keys)) if r not in on_many], dtype=np.intp)
        names, shapes = [self.keys[r] for r in self._rest], []
        for curve in many:
            knots = np.arange(len(names), len(names) + KNOTS)
            shapes.append(_Shape(np.array(curve.rows), knots, _interpolation(curve.x.size)))
            names += [f"{curve.key}.knot.{i}" for i in range(KNOTS)]
        self._shapes, self.names = tuple(shapes), tuple(names)
        self.z0 = self.to_slopes(self.nominal)
        self._simulate_few(twin)

    def __len__(self) -> int:
        return len(self.names)

    def from_slopes(self, z: Floats) -> Floats:
        """Values (d,) or (d, L) for slope coordinates (c,) or (c, L)."""
        full = np.empty((len(self.keys), *z.shape[1:]))
        full[self._rest] = z[: self._rest.size]
        for shape in self._shapes:
            nominal = self._slopes[shape.points].reshape(-1, *(1,) * (z.ndim - 1))
            full[shape.points] = nominal + shape.weights @ z[shape.knots]
        return super().from_slopes(full)

    def to_slopes(self, values: Floats) -> Floats:
        """Slope coordinates of values; of a curve of many points those of the nearest smooth change."""
        full = super().to_slopes(values)
        if not self._shapes:
            return full
        z = np.empty((len(self), *full.shape[1:]))
        z[: self._rest.size] = full[self._rest]
        for shape in self._shapes:
            nominal = self._slopes[shape.points].reshape(-1, *(1,) * (full.ndim - 1))
            z[shape.knots] = np.linalg.pinv(shape.weights) @ (full[shape.points] - nominal)
        return z

    def shifted(self, z: Floats, springs: float, dampers: float) -> Floats:
        """Coordinates with these numbers added to the logarithms of all slopes of springs and of dampers."""
        out = z.copy()
        of_rest = {int(row): at for at, row in enumerate(self._rest)}
        for curve in self.curves:
            at = [of_rest[r] for r in curve.rows if r in of_rest]
            out[at] += springs if curve.part == "spring" else dampers
        for shape in self._shapes:
            spring = ".spring." in self.keys[shape.points[0]]
            out[shape.knots] += springs if spring else dampers
        return out

    def prior_precision(self, correlation: float = 0.8) -> Floats:
        """(c, c) inverse covariance of the slope coordinates; neighbouring knots have the ``correlation``."""
        covariance = np.zeros((len(self), len(self)))
        own = np.ix_(self._rest, self._rest)
        covariance[: self._rest.size, : self._rest.size] = self.prior_covariance(correlation)[own]
        apart = np.abs(np.subtract.outer(np.arange(KNOTS), np.arange(KNOTS)))
        for shape in self._shapes:
            spread = float(self._spread[shape.points].max())
            covariance[np.ix_(shape.knots, shape.knots)] = spread**2 * correlation**apart
        return np.asarray(np.linalg.inv(covariance))

    def simulated(self, twin: Twin) -> Twin:
        """``twin`` with the vehicle of few points."""
        return twin.model_copy(update={"vehicle": self._vehicle})

    def simulated_values(self, z: Floats) -> Floats:
        """Values (k, L) of ``simulated_keys`` for slope coordinates (c, L)."""
        return self.from_slopes(z)[self._simulated_rows]

    def _simulate_few(self, twin: Twin) -> None:
        """Choose the points that are simulated of every curve of many points that is free or frozen as a whole."""
        free = {curve.key: curve for curve in self.curves}
        place: dict[str, str | None] = {}
        changes: dict[str, object] = {}
        for key in CURVES:
            own = curve_keys(twin, [key])
            curve = free.get(key)
            if len(own) <= FEW_POINTS or (curve is not None and min(curve.rows) < 0):
                continue
            x, force = twin_value(twin, key).points if curve is None else (curve.x, curve.force)
            kept = _followed(x, force, () if curve is None else _knots(x.size))
            place |= dict.fromkeys(own)
            place |= {own[i]: own[j] for j, i in enumerate(kept)}
            changes[f"{key}.{'compression' if key.endswith('spring') else 'velocity'}"] = tuple(
                x[kept].tolist()
            )
            changes[f"{key}.force"] = tuple(force[kept].tolist())
        rows = [row for row, key in enumerate(self.keys) if place.get(key, key) is not None]
        self._vehicle = twin.with_changes(changes).vehicle  # type: ignore[attr-defined]
        self._simulated_rows = np.array(rows, dtype=np.intp)
        self.simulated_keys = tuple(str(place.get(self.keys[row], self.keys[row])) for row in rows)


def _knots(points: int) -> tuple[int, ...]:
    """The points of a curve nearest to its knots."""
    return tuple(np.round(np.linspace(0, points - 1, KNOTS)).astype(int).tolist())


def _interpolation(points: int) -> Floats:
    """(n, K) linear interpolation from knots that are spread evenly over ``points`` points."""
    at = np.linspace(0.0, points - 1.0, KNOTS)
    return interpolated(np.arange(points, dtype=np.float64), at, np.eye(KNOTS))


def _followed(x: Floats, force: Floats, wanted: Sequence[int]) -> list[int]:
    """At most ``FEW_POINTS`` points of a curve: those ``wanted``, the last, and one by one the point that lies furthest
    from the line through the chosen ones."""
    kept = sorted({*wanted, x.size - 1})
    while len(kept) < FEW_POINTS:
        line = np.interp(x, np.concatenate([[0.0], x[kept]]), np.concatenate([[0.0], force[kept]]))
        off = np.abs(force - line)
        furthest = int(np.argmax(off))
        if off[furthest] <= 1e-12 * force[-1]:
            break
        kept = sorted({*kept, furthest})
    return kept
