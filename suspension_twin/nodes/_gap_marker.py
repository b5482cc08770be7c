# SPDX-License-Identifier: Apache-2.0
"""Where on the road the live gap lies: a marker with one tile for every metre driven."""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import TYPE_CHECKING, NamedTuple

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

if TYPE_CHECKING:
    from suspension_twin.nodes._base import TwinNode

__all__ = ["GapMarker", "GapTiles", "Tile"]

_NS = 1_000_000_000
#: Edge of a tile and how many of them are kept: the last two kilometres.
_EDGE, _MOST = 1.0, 2000
#: Fewer samples than this say nothing about a tile.
_FEW = 3
#: A gap this many times the floor is red.
_RED = 4.0


class Tile(NamedTuple):
    """Its middle in ``map`` in m and the rms gap in m/s² of the newest pass over it."""

    x: float
    y: float
    z: float
    rms: float


class GapTiles:
    """Gathers the gap sample by sample on a grid of ``map``; a new pass over a tile replaces the old one."""

    def __init__(self) -> None:
        self.tiles: OrderedDict[tuple[int, int], Tile] = OrderedDict()
        self._under: tuple[int, int] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.tiles.clear()
        self.leave()

    def leave(self) -> None:
        """What was gathered on the tile that the sensor is over does not count."""
        self._under = None
        self._count = 0
        self._squares = 0.0

    def push(self, x: float, y: float, z: float, difference: float) -> None:
        """One sample: the place in m, measured minus simulated in m/s²."""
        under = math.floor(x / _EDGE), math.floor(y / _EDGE)
        if under != self._under:
            self.leave()
            self._under = under
        self._count += 1
        self._squares += difference * difference
        if self._count < _FEW:
            return
        middle = (under[0] + 0.5) * _EDGE, (under[1] + 0.5) * _EDGE
        self.tiles[under] = Tile(*middle, z, math.sqrt(self._squares / self._count))
        self.tiles.move_to_end(under)
        if len(self.tiles) > _MOST:
            self.tiles.popitem(last=False)


class GapMarker:
    """``twin/gap_marker``, once a second: green where the gap is at its floor, over yellow to red at four times
    that. Without a floor that a calibration left, the median of the tiles takes its place."""

    def __init__(self, node: TwinNode, map_frame: str) -> None:
        self.tiles = GapTiles()
        self.floor = 0.0
        self._due = 0
        self._marker = Marker(ns="gap", type=Marker.CUBE_LIST, action=Marker.ADD)
        self._marker.header.frame_id = map_frame
        self._marker.pose.orientation.w = 1.0
        self._marker.scale.x = self._marker.scale.y = _EDGE
        self._marker.scale.z = 0.02
        self._out = node.offer(Marker, "twin/gap_marker")

    def reset(self) -> None:
        """Forget the road driven."""
        self.tiles.reset()
        self._due = 0

    def send(self, ns: int) -> None:
        """Publish what is known at stamp ``ns``, if it is due and anybody listens."""
        if ns < self._due:
            return
        self._due = ns + _NS
        if not (self._out.wanted and self.tiles.tiles):
            return
        marker, tiles = self._marker, list(self.tiles.tiles.values())
        marker.header.stamp.sec, marker.header.stamp.nanosec = divmod(ns, _NS)
        marker.points = [Point(x=t.x, y=t.y, z=t.z) for t in tiles]
        floor = self.floor or sorted(t.rms for t in tiles)[len(tiles) // 2]
        marker.colors = [colour(t.rms / floor if floor > 0 else 1.0) for t in tiles]
        self._out.send(marker)


def colour(times: float) -> ColorRGBA:
    """Green for a gap of once the floor or less, yellow half way, red for four ``times`` or more."""
    share = min(max((times - 1.0) / (_RED - 1.0), 0.0), 1.0)
    return ColorRGBA(r=min(2.0 * share, 1.0), g=min(2.0 - 2.0 * share, 1.0) * 0.85, b=0.1, a=0.8)
