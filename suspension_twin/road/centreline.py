# SPDX-License-Identifier: Apache-2.0
"""A reference line with even steps through given points in ``map``, and a road over it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.road import Road

__all__ = ["Centreline", "road_over"]


class Centreline:
    """A polyline in ``map`` with points ``step`` m of arc apart.

    Parameters
    ----------
    x, y : (n,) array
        Points in m, in the order in which they are passed.
    step : float
        Distance of the resulting points in m.

    Raises
    ------
    InputError
        Fewer than two points, or none a step from the first.

    Examples
    --------
    >>> line = Centreline([0.0, 3.0, 3.0], [0.0, 0.0, 4.0], 0.5)
    >>> float(line.length)
    7.0
    """

    def __init__(self, x: ArrayLike, y: ArrayLike, step: float) -> None:
        px, py = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        if (
            px.ndim != 1
            or px.shape != py.shape
            or px.size < 2
            or not (np.isfinite(px) & np.isfinite(py)).all()
        ):
            raise InputError("centreline", "needs two points or more, all finite")
        moved = np.concatenate([[True], np.hypot(np.diff(px), np.diff(py)) > 1e-9])
        px, py = px[moved], py[moved]
        s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(px), np.diff(py)))])
        count = math.floor(s[-1] / step + 1e-9)
        if count < 1:
            raise InputError("centreline", f"is {s[-1]:.3g} m long, shorter than its step of {step:g} m")
        self.step = step
        at = step * np.arange(count + 1)
        self.x: Floats = np.interp(at, s, px)
        self.y: Floats = np.interp(at, s, py)

    @property
    def length(self) -> float:
        """m from the first point to the last."""
        return self.step * (self.x.size - 1)

    @property
    def headings(self) -> tuple[float, float]:
        """Direction of the first and of the last segment, rad."""
        first, last = (
            math.atan2(self.y[i + 1] - self.y[i], self.x[i + 1] - self.x[i]) for i in (0, self.x.size - 2)
        )
        return first, last


def road_over(line: Centreline, z: ArrayLike, v: ArrayLike, name: str) -> Road:
    """A road of heights ``z`` (nu, nv) m over a centreline, one cross section a point, at ``v`` (nv,) m."""
    heights = np.asarray(z, dtype=np.float64).astype(np.float32).astype(np.float64)
    zero = np.zeros(line.x.size)
    return Road(
        name=name,
        z=heights,
        v=np.asarray(v, dtype=np.float64),
        u_step=line.step,
        x=line.x,
        y=line.y,
        ref_z=zero,
        bank=zero,
        headings=line.headings,
    )
