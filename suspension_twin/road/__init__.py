# SPDX-License-Identifier: Apache-2.0
"""Roads: OpenCRG files, bumps, random roads, smoothing, checks, meshes and pictures."""

from __future__ import annotations

from suspension_twin.road.build import curved_road, flat_road, grid_road, join
from suspension_twin.road.bumps import add_bump, bump_road, circular, half_sine, measured, trapezoid
from suspension_twin.road.crg import load_road, write_road
from suspension_twin.road.road import Borders, Outside, Road, RoadTracker, Samples

__all__ = [
    "Borders",
    "Outside",
    "Road",
    "RoadTracker",
    "Samples",
    "add_bump",
    "bump_road",
    "circular",
    "curved_road",
    "flat_road",
    "grid_road",
    "half_sine",
    "join",
    "load_road",
    "measured",
    "trapezoid",
    "write_road",
]
