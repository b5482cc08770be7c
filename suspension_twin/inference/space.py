# SPDX-License-Identifier: Apache-2.0
"""The search space of a calibration: free parameters, their bounds and two sets of coordinates.

``Space`` maps search coordinates to the values of the twin file and back, in such a way that
every characteristic stays monotone by construction:

- *unit* coordinates, 0 to 1 between the bounds, for the genetic algorithm and the pattern search.
  A curve's points are made to rise by a running maximum (with bounds that do not overlap, as in
  Table 2 of the car paper, that changes nothing);
- *slope* coordinates, the logarithm of the slope of the segment that ends at a point, for
  Gauss-Newton and CMA-ES. The static force of a spring follows from the load whatever the curve, so
  that the data determine the slopes of the excited segments; any value of a logarithm is a rising curve.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.priors import TABLES
from suspension_twin.models.parameters import Parameter, twin_value
from suspension_twin.vehicle.twin import Suspension, Twin

__all__ = ["CURVES", "Curve", "Space", "curve_keys", "is_fine"]

#: The six characteristics of a car, in the order of the car paper's Table 2, and the three of a single corner.
CURVES = (
    "vehicle.front.spring",
    "vehicle.rear.spring",
    "vehicle.front.damper_push",
    "vehicle.front.damper_pull",
    "vehicle.rear.damper_push",
    "vehicle.rear.damper_pull",
    "vehicle.spring",
    "vehicle.damper_push",
    "vehicle.damper_pull",
)
_POINT = re.compile(r"^(vehicle\.(?:(?:front|rear)\.)?(?:spring|damper_push|damper_pull))\.force\.(\d+)$")

# Keeps exp() finite whatever a search proposes.
_LARGEST_LOG = 40.0
# Distance in m of the points of a spring in the car paper's Table 2, for which the correlation of slopes is stated.
_APART = 0.2
# Least slope of a segment as a share of the mean slope of its curve: a flat segment has no logarithm.
_FLAT = 1e-3


@dataclass(frozen=True, eq=False)
class Curve:
    """A characteristic with at least one free point: ``x`` (k,), nominal ``force`` (k,), and for
    each point the row of its parameter in the space, -1 where the point is frozen.

    ``standing`` is the compression in m and the load in N of a spring that carries the standing vehicle, whatever its
    slopes: of a spring with points enough about it, all of them free.
    """

    key: str
    x: Floats
    force: Floats
    rows: tuple[int, ...]
    standing: tuple[float, float] | None = None

    @property
    def axle(self) -> str:
        """``front`` of ``vehicle.front.spring``, nothing of ``vehicle.spring``."""
        return self.key.removeprefix("vehicle.").rpartition(".")[0]

    @property
    def part(self) -> str:
        """``spring``, ``damper_push`` or ``damper_pull``."""
        return self.key.rpartition(".")[2]

    @property
    def unit(self) -> str:
        return "m" if self.key.endswith("spring") else "m/s"


def curve_keys(twin: Twin, curves: Sequence[str] = CURVES) -> tuple[str, ...]:
    """The dotted keys of every point of those of the given characteristics that the twin has."""
    keys: list[str] = []
    for curve in curves:
        try:
            points = twin_value(twin, f"{curve}.force")
        except InputError:  # a vehicle without axles, or with some
            continue
        keys.extend(f"{curve}.force.{i}" for i in range(len(points)))
    return tuple(keys)


class Space:
    """The free parameters of one calibration.

    Arrays of values and coordinates are (d,) or (d, L), the row order that of ``parameters``.
    """

    def __init__(self, twin: Twin, parameters: Sequence[Parameter]) -> None:
        self.parameters = tuple(parameters)
        self.keys = tuple(p.key for p in self.parameters)
        if len(set(self.keys)) != len(self.keys):
            twice = next(k for k in self.keys if self.keys.count(k) > 1)
            raise InputError("free parameters", twice, "is listed twice")
        self.nominal = np.array([p.prior.typical for p in self.parameters])
        self.lower = np.array([p.lower for p in self.parameters])
        self.upper = np.array([p.upper for p in self.parameters])
        self._log = np.array([p.prior.log for p in self.parameters], dtype=bool)
        self._spread = np.array([p.prior.deviation for p in self.parameters])
        self.curves = self._find_curves(twin)
        self._on_curve = np.zeros(len(self.keys), dtype=bool)
        for curve in self.curves:
            self._on_curve[[r for r in curve.rows if r >= 0]] = True
        self._check()
        #: Names of the slope coordinates, and keys of the values that are simulated.
        self.names = self.simulated_keys = self.keys
        self.z0 = self.to_slopes(self.nominal)

    def __len__(self) -> int:
        """How many slope coordinates there are."""
        return len(self.parameters)

    def _find_curves(self, twin: Twin) -> tuple[Curve, ...]:
        rows: dict[str, dict[int, int]] = {}
        for row, key in enumerate(self.keys):
            match = _POINT.match(key)
            if match:
                rows.setdefault(match[1], {})[int(match[2])] = row
        curves = []
        for key in sorted(rows, key=CURVES.index):
            x, force = twin_value(twin, key).points
            for index in rows[key]:
                if index >= x.size:
                    raise InputError(
                        "free parameters", f"{key}.force.{index}", f"the curve has {x.size} points"
                    )
            force = force.copy()
            for index, row in rows[key].items():
                force[index] = self.nominal[row]
            places = tuple(rows[key].get(i, -1) for i in range(x.size))
            curves.append(Curve(key, x, force, places, _standing(twin, key, places)))
        return tuple(curves)

    def _check(self) -> None:
        for p in self.parameters:
            if not (np.isfinite(p.lower) and np.isfinite(p.upper) and p.lower < p.upper):
                raise InputError(
                    "bounds", p.key, f"the lower must be below the upper, are {p.lower:g}:{p.upper:g}"
                )
            if p.prior.log and p.lower <= 0 and not _POINT.match(p.key):
                raise InputError("bounds", p.key, f"must be above 0, lower is {p.lower:g}")
        lower, upper = self.lower.copy(), self.upper.copy()
        for curve in self.curves:
            low, high = 0.0, np.inf
            for i, row in enumerate(curve.rows):
                low = max(low, lower[row] if row >= 0 else curve.force[i])
                if row >= 0:
                    lower[row] = low
            for i in reversed(range(len(curve.rows))):
                row = curve.rows[i]
                high = min(high, upper[row] if row >= 0 else curve.force[i])
                if row >= 0:
                    upper[row] = high
                    if lower[row] > high:
                        raise InputError(
                            "bounds",
                            self.keys[row],
                            f"leave no rising curve: from {lower[row]:g} to {high:g} N",
                        )
        self.lower, self.upper = lower, upper
        self.nominal = np.clip(self.nominal, lower, upper)

    # -- unit coordinates ----------------------------------------------------------------------

    def from_unit(self, u: Floats) -> Floats:
        """Values for unit coordinates (d,) or (d, L); clipped to 0..1, curves made to rise."""
        u = np.clip(u, 0.0, 1.0)
        shape = (-1,) + (1,) * (u.ndim - 1)
        low, high = self.lower.reshape(shape), self.upper.reshape(shape)
        values = low + u * (high - low)
        geometric = self._log & ~self._on_curve
        if geometric.any():
            ratio = (self.upper / np.where(geometric, self.lower, 1.0))[geometric].reshape(shape)
            values[geometric] = self.lower[geometric].reshape(shape) * ratio ** u[geometric]
        for curve in self.curves:
            free = [r for r in curve.rows if r >= 0]
            values[free] = np.maximum.accumulate(values[free], axis=0)
        return np.asarray(values)

    def to_unit(self, values: Floats) -> Floats:
        """Unit coordinates of values, clipped into the bounds; the inverse of ``from_unit``."""
        shape = (-1,) + (1,) * (values.ndim - 1)
        low, high = self.lower.reshape(shape), self.upper.reshape(shape)
        inside = np.clip(values, low, high)
        u = (inside - low) / np.where(high > low, high - low, 1.0)
        geometric = self._log & ~self._on_curve
        if geometric.any():
            g_low, g_high = low[geometric], high[geometric]
            u[geometric] = np.log(inside[geometric] / g_low) / np.log(g_high / g_low)
        return np.asarray(u)

    # -- slope coordinates ---------------------------------------------------------------------

    def from_slopes(self, z: Floats) -> Floats:
        """Values for slope coordinates (d,) or (d, L), clipped to the bounds, curves rising."""
        single = z.ndim == 1
        z2 = z[:, None] if single else z
        values = np.empty_like(z2, dtype=float)
        grows = np.exp(np.clip(z2, -_LARGEST_LOG, _LARGEST_LOG))
        for curve in self.curves:
            if curve.standing is not None:
                free = list(curve.rows)
                forces = _about_standing(curve.x, curve.standing, grows[free])
                forces = np.clip(forces, self.lower[free, None], self.upper[free, None])
                values[free] = np.maximum.accumulate(forces, axis=0)
                continue
            force = np.zeros(z2.shape[1])
            before = 0.0
            for i, row in enumerate(curve.rows):
                if row < 0:
                    force = np.full(z2.shape[1], curve.force[i])
                else:
                    force = force + grows[row] * (curve.x[i] - before)
                    force = np.clip(force, self.lower[row], self.upper[row])
                    values[row] = force
                before = curve.x[i]
        other = ~self._on_curve
        if other.any():
            low, high = self.lower[other, None], self.upper[other, None]
            scale = self._spread[other, None]
            plain = self.nominal[other, None] + scale * z2[other]
            scaled = self.nominal[other, None] * grows[other]
            values[other] = np.clip(np.where(self._log[other, None], scaled, plain), low, high)
        return values[:, 0] if single else values

    def to_slopes(self, values: Floats) -> Floats:
        """Slope coordinates of values (d,) or (d, L); a flat segment counts as nearly flat."""
        single = values.ndim == 1
        v2 = values[:, None] if single else values
        z = np.empty_like(v2, dtype=float)
        for curve in self.curves:
            last = v2[curve.rows[-1]] if curve.rows[-1] >= 0 else np.full(v2.shape[1], curve.force[-1])
            flat = _FLAT * np.maximum(last, 1.0) / curve.x[-1]
            force, before = np.zeros(v2.shape[1]), 0.0
            for i, row in enumerate(curve.rows):
                here = v2[row] if row >= 0 else np.full(v2.shape[1], curve.force[i])
                if row >= 0:
                    z[row] = np.log(np.maximum((here - force) / (curve.x[i] - before), flat))
                force, before = here, curve.x[i]
        other = ~self._on_curve
        if other.any():
            nominal = self.nominal[other, None]
            log = self._log[other, None]
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.log(np.where(log, v2[other] / np.where(log, nominal, 1.0), 1.0))
            z[other] = np.where(log, ratio, (v2[other] - nominal) / self._spread[other, None])
        return z[:, 0] if single else z

    def shifted(self, z: Floats, springs: float, dampers: float) -> Floats:
        """Coordinates (d,) with these numbers added to the logarithms of all slopes of springs and of dampers."""
        out = z.copy()
        for curve in self.curves:
            out[[r for r in curve.rows if r >= 0]] += springs if curve.part == "spring" else dampers
        return out

    def simulated(self, twin: Twin) -> Twin:
        """The twin of ``simulated_keys``: ``twin`` itself, or one with fewer points a curve."""
        return twin

    def simulated_values(self, z: Floats) -> Floats:
        """Values (k, L) of ``simulated_keys`` for slope coordinates (d, L)."""
        return self.from_slopes(z)

    def prior_precision(self, correlation: float = 0.8) -> Floats:
        """(d, d) inverse of ``prior_covariance``."""
        return np.asarray(np.linalg.inv(self.prior_covariance(correlation)))

    def prior_covariance(self, correlation: float) -> Floats:
        """(d, d) prior covariance of the log slopes around the nominal ones.

        The log slopes of neighbouring segments have the ``correlation``, so that segments that a drive does not excite
        follow the excited ones, relative to the preset. Segments of a spring that end less than ``_APART`` from each
        other have more of it: the rate of a spring changes as much over the same travel however finely it is divided.
        """
        covariance = np.diag(np.where(self._on_curve | self._log, self._spread**2, 1.0))
        for curve in self.curves:
            apart = np.arange(curve.x.size, dtype=np.float64)
            if curve.part == "spring":
                apart[1:] = np.cumsum(np.minimum(np.diff(curve.x) / _APART, 1.0))
            free = [(i, r) for i, r in enumerate(curve.rows) if r >= 0]
            for i, a in free:
                for j, b in free:
                    covariance[a, b] = (
                        self._spread[a] * self._spread[b] * correlation ** abs(apart[i] - apart[j])
                    )
        return np.asarray(covariance)

    def stated_precision(self, twin: Twin, times: float) -> Floats:
        """(d, d) information on the slope coordinates in what the twin file states of its values (``uncertainty``), if
        those lie ``times`` the stated deviations from the true ones.

        Points of a characteristic share their errors: n of them count as one value.
        """
        sigma = np.array([twin.deviation(key) for key in self.keys])
        points = np.ones(sigma.size)
        for curve in self.curves:
            points[[r for r in curve.rows if r >= 0]] = len(curve.rows)
        known, step = sigma > 0.0, float(np.cbrt(np.finfo(np.float64).eps))
        far = self.z0[:, None] + step * np.hstack([np.eye(len(self)), -np.eye(len(self))])
        ahead, behind = np.hsplit(self.from_slopes(far)[known], 2)
        slopes = (ahead - behind) / (2.0 * step)
        surest = np.maximum(
            times * np.sqrt(points[known]) * sigma[known], _SUREST * np.linalg.norm(slopes, axis=1)
        )
        slopes /= surest[:, None]
        return np.asarray(slopes.T @ slopes)

    def on_bound(self, values: Floats, share: float = 1e-3) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """(d,) True where a value lies within ``share`` of the bounds' distance from one."""
        u = self.to_unit(values)
        return np.asarray((u <= share) | (u >= 1 - share))

    def applied(self, twin: Twin, values: Floats) -> Twin:
        """A checked copy of ``twin`` with the values (d,) in it."""
        changes: dict[str, Any] = {}
        effects = {spec.id: dict(spec.parameters) for spec in twin.effects}
        for key, value in zip(self.keys, values, strict=True):
            if key.startswith("effects."):
                _, name, parameter = key.split(".")
                effects[name][parameter] = float(value)
            else:
                changes[key] = float(value)
        if effects:
            changes["effects"] = [{"id": name, "parameters": p} for name, p in effects.items()]
        return twin.with_changes(changes)


#: In slope coordinates, a thousandth of a value: nothing is held more surely, whatever a file states (numerics).
_SUREST = 1e-3
#: Curves with at most so many points change point by point: the second smallest kernel is for eight points.
FEW_POINTS: Final = 8


def is_fine(suspension: Suspension) -> bool:
    """Whether a spring has points enough about the standing vehicle, one of them below."""
    x, static, about = suspension.part.spring.points[0], suspension.static_compression, TABLES.refined_spring
    return bool((np.abs(x - static) <= about.near).sum() >= about.enough and x[0] < static < x[-1])


def _standing(twin: Twin, key: str, rows: tuple[int, ...]) -> tuple[float, float] | None:
    """Compression and load of a fine spring, all of whose points are free."""
    axle, _, part = key.removeprefix("vehicle.").rpartition(".")
    suspension = twin.axles.get(axle) if part == "spring" and min(rows) >= 0 else None
    if suspension is None or not is_fine(suspension) or len(rows) > FEW_POINTS:
        return None  # the corners of a curve of many points are too small to be in the way
    return suspension.static_compression, suspension.load


def _about_standing(x: Floats, standing: tuple[float, float], slopes: Floats) -> Floats:
    """(k, L) forces at the points ``x`` (k,) of a spring that carries its load at the same compression whatever the
    ``slopes`` (k, L) of its segments are. That of the first segment, from the free length on, follows from the others.
    """
    static, load = standing
    at = int(np.searchsorted(x, static))  # x[at - 1] < static <= x[at]
    steps = slopes * np.diff(x, prepend=0.0)[:, None]
    out = np.empty_like(steps)
    out[at:] = load + slopes[at] * (x[at] - static) + np.cumsum(steps[at:], axis=0) - steps[at]
    below = load - slopes[at] * (static - x[at - 1])
    out[at - 1] = below
    out[: at - 1] = below - np.cumsum(steps[at - 1 : 0 : -1], axis=0)[::-1]
    return out


def bounds_of(bounds: Mapping[str, tuple[float, float]], key: str) -> tuple[float, float] | None:
    """The bounds given for a key, or for the curve it belongs to."""
    if key in bounds:
        return bounds[key]
    match = _POINT.match(key)
    return bounds.get(match[1]) if match else None
