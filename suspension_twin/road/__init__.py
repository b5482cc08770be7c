# SPDX-License-Identifier: Apache-2.0
"""Roads: OpenCRG files, bumps, random roads, smoothing, checks, meshes and pictures."""

from __future__ import annotations

from suspension_twin.road.build import (
    add_bump,
    bump_road,
    circular,
    curved_road,
    flat_road,
    grid_road,
    half_sine,
    trapezoid,
)
from suspension_twin.road.crg import load_road, write_road
from suspension_twin.road.road import (
    Border,
    Borders,
    Fade,
    Outside,
    ReferenceLine,
    Road,
    RoadHeights,
)

__all__ = [
    "Border",
    "Borders",
    "Fade",
    "Outside",
    "ReferenceLine",
    "Road",
    "RoadHeights",
    "add_bump",
    "bump_road",
    "circular",
    "curved_road",
    "flat_road",
    "grid_road",
    "half_sine",
    "load_road",
    "trapezoid",
    "write_road",
]
