# SPDX-License-Identifier: Apache-2.0
"""From a cloud's own coordinates to ``map``: axes, unit, and a coordinate reference system with the twin's datum."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, shown
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road.profile import UNITS
from suspension_twin.vehicle.twin import Datum

__all__ = ["SCAN_UNITS", "Placing", "parse_axes", "placing_of"]

#: m for one of a unit in which clouds come; the US survey foot is 1200/3937 m (NIST SP 811).
SCAN_UNITS: dict[str, float] = {**{k: UNITS[k] for k in ("m", "cm", "mm", "ft")}, "us-ft": 1200.0 / 3937.0}


def parse_axes(text: str) -> tuple[tuple[int, float], ...]:
    """Column and sign of east, north and up, from ``xyz``, ``yxz`` or ``x-zy``; InputError for other texts."""
    parts = re.findall(r"(-?)([xyz])", text)
    if "".join(sign + axis for sign, axis in parts) != text or sorted(a for _, a in parts) != ["x", "y", "z"]:
        raise InputError("--axes", f"{shown(text)} are not x, y and z in an order, such as yxz or x-zy")
    return tuple(("xyz".index(axis), -1.0 if sign else 1.0) for sign, axis in parts)


@dataclass(frozen=True, eq=False)
class Placing:
    """How a cloud lies in ``map``.

    ``axes`` columns and signs of x, y, z; ``unit`` m for one of the horizontal unit, ``up`` for one of the vertical;
    ``crs`` a pyproj.CRS to be taken to ``map`` by ``datum``, or None where the coordinates are metres of a plane: those
    of ``map`` after a ``turn`` in rad about the vertical and a ``move`` (east, north) in m.
    """

    axes: tuple[tuple[int, float], ...] = ((0, 1.0), (1, 1.0), (2, 1.0))
    unit: float = 1.0
    up: float = 1.0
    crs: Any = None
    datum: Datum | None = None
    turn: float = 0.0
    move: tuple[float, float] = (0.0, 0.0)

    def to_map(self, points: Floats) -> Floats:
        """Positions (n, 3) in ``map``, m, of points (n, 3) in the cloud's coordinates."""
        p = np.column_stack([sign * points[:, column] for column, sign in self.axes])
        p[:, 2] *= self.up
        if self.crs is None:
            p[:, :2] *= self.unit
            if self.turn or any(self.move):
                p[:, :2] = p[:, :2] @ self._rotation.T + self.move
            return p
        assert self.datum is not None
        longitude, latitude = self._to_geodetic.transform(p[:, 0], p[:, 1])
        return LocalMap(self.datum).to_map(latitude, longitude, p[:, 2])

    def box(self, x: Floats, y: Floats, margin: float) -> tuple[Floats, Floats] | None:
        """Lowest and highest (2,) cloud coordinates, axes turned, that hold map positions and ``margin`` m around."""
        if self.crs is None:
            own = (np.column_stack([x, y]) - self.move) @ self._rotation
            return (own.min(axis=0) - margin) / self.unit, (own.max(axis=0) + margin) / self.unit
        assert self.datum is not None
        e, n = np.meshgrid([x.min() - margin, x.max() + margin], [y.min() - margin, y.max() + margin])
        geodetic = LocalMap(self.datum).to_geodetic(np.column_stack([e.ravel(), n.ravel(), np.zeros(4)]))
        a, b = self._to_geodetic.transform(geodetic[:, 1], geodetic[:, 0], direction="INVERSE")
        corners = np.column_stack([a, b])
        if not np.isfinite(corners).all():
            return None
        slack = 0.05 * np.ptp(corners, axis=0)  # what a grid's lines bend within the box
        return corners.min(axis=0) - slack, corners.max(axis=0) + slack

    def within(self, points: Floats, box: tuple[Floats, Floats] | None) -> Floats:
        """The points (n, 3) whose horizontal coordinates lie in a box."""
        if box is None:
            return points
        keep = np.ones(points.shape[0], dtype=np.bool_)
        for k in (0, 1):
            column, sign = self.axes[k]
            c = points[:, column] if sign > 0.0 else -points[:, column]
            keep &= (c >= box[0][k]) & (c <= box[1][k])
        return points[keep]

    @property
    def _rotation(self) -> Floats:
        c, s = math.cos(self.turn), math.sin(self.turn)
        return np.array([[c, -s], [s, c]])

    @property
    def _to_geodetic(self) -> Any:
        from pyproj import Transformer

        return Transformer.from_crs(self.crs.to_2d(), "EPSG:4326", always_xy=True)

    def altered(self, **changes: Any) -> Placing:
        """The same with other values."""
        return replace(self, **changes)


def placing_of(
    path: Path, crs: Any, named: str | None, axes: str, unit: str | None, datum: Datum | None
) -> tuple[Placing, str]:
    """How a cloud lies in ``map``, and that in words.

    ``crs`` is what the file says, ``named`` what the user says. Without a datum the cloud's coordinates are ``map``.
    """
    order = parse_axes(axes)
    if unit is not None and unit not in SCAN_UNITS:
        raise InputError("--unit", f"{shown(unit)} is not one of {', '.join(SCAN_UNITS)}")
    if named is not None:
        try:
            from pyproj import CRS
            from pyproj.exceptions import CRSError
        except ImportError:
            raise InputError("--crs", 'needs pyproj: pip install "suspension-twin[scan]"') from None
        try:
            crs = CRS.from_user_input(named)
        except CRSError:
            raise InputError(
                "--crs", f"{shown(named)} is no coordinate reference system that PROJ knows"
            ) from None
        if datum is None:
            raise InputError("--crs", "needs a datum: --datum, a twin file with one, or a drive as the path")
    scales = _units(crs) if crs is not None else None
    if unit is not None:
        scales = (SCAN_UNITS[unit],) * 2
    if crs is not None and datum is not None:
        up = scales[1] if scales else 1.0
        return Placing(order, 1.0, up, crs, datum), f"{crs.name} to map by the datum"
    if crs is not None and crs.is_geographic:
        raise InputError(path, f"is in {crs.name}: give a datum with --datum or a twin file")
    h, up = scales or (1.0, 1.0)
    words = "the cloud's own coordinates are map"
    if crs is not None:
        words += f" ({crs.name}, without a datum)"
    return Placing(order, h, up), words


def _units(crs: Any) -> tuple[float, float]:
    """m for one of the horizontal and of the vertical unit of a CRS; a height without a unit has the horizontal one."""
    factors = [(a.direction, float(a.unit_conversion_factor), a.unit_name) for a in crs.axis_info]
    flat = [f for direction, f, name in factors if direction not in ("up", "down") and "degree" not in name]
    high = [f for direction, f, _ in factors if direction in ("up", "down")]
    horizontal = flat[0] if flat else 1.0
    return horizontal, high[0] if high else horizontal
