# SPDX-License-Identifier: Apache-2.0
"""Tiles of the road's surface for the picture in 3D."""

from __future__ import annotations

import numpy as np

from suspension_twin.road.road import Road

__all__ = ["NODES", "SIDE", "tile"]

#: A tile is a square of this side in m with this many heights along each edge, both ends included.
SIDE, NODES = 4.0, 41
#: Tiles are numbered up to this far from the datum in m.
_FARTHEST = 1e6


def tile(road: Road | None, column: int, row: int) -> bytes:
    """Heights in m on the tile that begins at x ``column`` times, y ``row`` times :data:`SIDE`.

    float32, little-endian, rows of constant y one after the other. NaN where the road has no data; a plane where
    there is no road. Raises ValueError for a tile too far away.
    """
    if max(abs(column), abs(row)) * SIDE > _FARTHEST:
        raise ValueError("too far from the datum")
    if road is None:
        return np.zeros(NODES * NODES, dtype="<f4").tobytes()
    steps = np.linspace(0.0, SIDE, NODES)
    x, y = np.meshgrid(column * SIDE + steps, row * SIDE + steps)
    samples = road.sample(x.ravel(), y.ravel())
    return np.where(samples.inside, samples.z, np.nan).astype("<f4").tobytes()
