# SPDX-License-Identifier: Apache-2.0
"""The live gap between vehicle and twin: its parameters, the warning beside the calibration, its marker on the road."""

from __future__ import annotations

import math
from collections import OrderedDict
from pathlib import Path
from typing import NamedTuple

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from suspension_twin.calibration.output import details_path
from suspension_twin.errors import InputError
from suspension_twin.files import read_yaml, reading
from suspension_twin.inference.sliding_window import GapNow, RunningGap
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.parameters import Param, Values
from suspension_twin.nodes.topics import NS

__all__ = [
    "GAP",
    "CalibrationGap",
    "GapMarker",
    "GapTiles",
    "Tile",
    "calibration_gap",
    "gap_of",
    "gap_warning",
]

#: Edge of a tile in m and the number of tiles kept: the last two kilometres.
_EDGE, _MOST = 1.0, 2000
#: Samples from which a tile is shown.
_FEW = 3
#: A gap this many times the floor is red.
_RED = 4.0

GAP = (
    Param("gap.window", 10.0, "Sliding window of the live gap in s.", 0.5, 600.0),
    Param("gap.rate", 5.0, "Messages per second on twin/gap.", 0.1, 100.0),
    Param(
        "gap.floor",
        0.0,
        "Residual of the calibration in m/s², reference of the normalised gap; 0: from the details beside a "
        "calibrated twin file, else the noise at standstill.",
        0.0,
        100.0,
    ),
    Param(
        "gap.warn",
        5.0,
        "Ratio of the gap to the residual of the calibration from which there is a warning. Position errors of a few "
        "centimetres alone make it two or three.",
        1.0,
        1000.0,
    ),
    Param(
        "gap.bands",
        [0.5, 3.0, 8.0, 20.0],
        "Edges in Hz of the adjoining frequency bands of the live gap.",
        0.0,
        800.0,
    ),
)


class CalibrationGap(NamedTuple):
    """The residual of a calibration on its worst drive: rms in m/s², and as a ``share`` of the measured rms, which
    scales it to a rougher road. Both 0 where not known."""

    rms: float
    share: float


def calibration_gap(values: Values) -> CalibrationGap:
    """The residual of the calibration: the parameter ``gap.floor``, else from the details beside the twin file.

    Raises InputError for details that cannot be read.
    """
    given, twin_file = values["gap.floor"], values["twin"]
    if given or not twin_file:
        return CalibrationGap(given, 0.0)
    with reading(twin_file, "a twin file"):
        details = details_path(Path(twin_file))
        if not details.is_file():
            return CalibrationGap(given, 0.0)
    try:
        drives = read_yaml(details)["drives"]
        # The live gap includes clock, gain and tilt errors: the larger of the two values is to be expected.
        residuals = [
            max(d["gap_after"]["rms"], d["residual_with_nuisances_corrected"] or 0.0) for d in drives
        ]
        shares = [math.sqrt(1.0 - min(abs(d["correlation"] or 1.0), 1.0) ** 2) for d in drives]
    except (InputError, ValueError, KeyError, TypeError):
        raise InputError(details, "drives", "has no residual of the calibration") from None
    finite = filter(math.isfinite, residuals)
    return CalibrationGap(max(finite, default=0.0), max(shares, default=0.0))


def gap_of(values: Values) -> RunningGap:
    """The live gap that the parameters describe. Raises InputError."""
    return RunningGap(values["gap.window"], values["gap.bands"], calibration_gap(values).rms)


def gap_warning(gap: GapNow | None, expected: CalibrationGap, ratio: float) -> str:
    """The warning of a gap of more than ``ratio`` times the residual of the calibration, scaled to the roughness of
    the present road; empty if there is nothing to warn of."""
    if gap is None or not expected.rms:
        return ""
    residual = max(expected.rms, expected.share * gap.measured_rms)
    if gap.rms <= ratio * residual:
        return ""
    return (
        f"the gap is {gap.rms:.3g} m/s², {gap.rms / residual:.1f} times the residual of the calibration "
        f"({residual:.3g} m/s²): run a diagnosis"
    )


class Tile(NamedTuple):
    """Its centre in ``map`` in m and the rms gap in m/s² of the newest pass over it."""

    x: float
    y: float
    z: float
    rms: float


class GapTiles:
    """Collects the gap sample by sample on a grid of ``map``; a new pass over a tile replaces the old one."""

    def __init__(self) -> None:
        self.tiles: OrderedDict[tuple[int, int], Tile] = OrderedDict()
        self.reset()

    def reset(self) -> None:
        """Discard everything."""
        self.tiles.clear()
        self._under: tuple[int, int] | None = None
        self._count, self._squares = 0, 0.0

    def push(self, x: float, y: float, z: float, difference: float) -> None:
        """One sample: the position in m, measured minus simulated in m/s²."""
        under = math.floor(x / _EDGE), math.floor(y / _EDGE)
        if under != self._under:
            self._under, self._count, self._squares = under, 0, 0.0
        self._count += 1
        self._squares += difference * difference
        if self._count < _FEW:
            return
        centre = (under[0] + 0.5) * _EDGE, (under[1] + 0.5) * _EDGE
        self.tiles[under] = Tile(*centre, z, math.sqrt(self._squares / self._count))
        self.tiles.move_to_end(under)
        if len(self.tiles) > _MOST:
            self.tiles.popitem(last=False)


class GapMarker:
    """``twin/gap_marker``, once a second: one tile for every metre driven, green where the gap is at its floor,
    over yellow to red at four times that. Without a calibration the floor is the median of the tiles."""

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
        """Discard the road driven so far."""
        self.tiles.reset()
        self._due = 0

    def send(self, ns: int) -> None:
        """Publish the tiles at stamp ``ns``, if they are due and there is a subscriber."""
        if ns < self._due:
            return
        self._due = ns + NS
        if not (self._out.wanted and self.tiles.tiles):
            return
        marker, tiles = self._marker, list(self.tiles.tiles.values())
        marker.header.stamp.sec, marker.header.stamp.nanosec = divmod(ns, NS)
        marker.points = [Point(x=t.x, y=t.y, z=t.z) for t in tiles]
        floor = self.floor or sorted(t.rms for t in tiles)[len(tiles) // 2]
        marker.colors = [colour(t.rms / floor if floor > 0 else 1.0) for t in tiles]
        self._out.send(marker)


def colour(ratio: float) -> ColorRGBA:
    """Green for a gap of at most the floor, yellow half way, red for a ``ratio`` of four or more."""
    share = min(max((ratio - 1.0) / (_RED - 1.0), 0.0), 1.0)
    return ColorRGBA(r=min(2.0 * share, 1.0), g=min(2.0 - 2.0 * share, 1.0) * 0.85, b=0.1, a=0.8)
