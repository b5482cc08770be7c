# SPDX-License-Identifier: Apache-2.0
"""WGS 84 to ``map`` and back: east, north, up at the datum (pymap3d)."""

from __future__ import annotations

import numpy as np
import pymap3d  # type: ignore[import-untyped]
from numpy.typing import ArrayLike

from suspension_twin.arrays import Floats
from suspension_twin.vehicle.twin import Datum

__all__ = ["LocalMap"]


class LocalMap:
    """The tangent plane at ``datum``. Exact: no flat-earth shortcut, so ``up`` falls away with the
    square of the distance and a height above the datum is tilted outwards by the earth's curvature."""

    def __init__(self, datum: Datum) -> None:
        self.datum = datum

    def to_map(self, latitude: ArrayLike, longitude: ArrayLike, altitude: ArrayLike) -> Floats:
        """(..., 3) east, north, up in m of points on WGS 84, degrees and m above the ellipsoid."""
        d = self.datum
        enu = pymap3d.geodetic2enu(
            np.asarray(latitude, dtype=np.float64),
            np.asarray(longitude, dtype=np.float64),
            np.asarray(altitude, dtype=np.float64),
            d.latitude,
            d.longitude,
            d.altitude,
        )
        return np.stack([np.asarray(c, dtype=np.float64) for c in enu], axis=-1)

    def to_geodetic(self, xyz: ArrayLike) -> Floats:
        """(..., 3) latitude, longitude in degrees and altitude in m of ``xyz`` (..., 3) in ``map``."""
        d = self.datum
        p = np.asarray(xyz, dtype=np.float64)
        lla = pymap3d.enu2geodetic(p[..., 0], p[..., 1], p[..., 2], d.latitude, d.longitude, d.altitude)
        return np.stack([np.asarray(c, dtype=np.float64) for c in lla], axis=-1)
