# SPDX-License-Identifier: Apache-2.0
"""Segments of a drive off the road, and the height policy there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from suspension_twin.arrays import Floats, runs
from suspension_twin.errors import InputError
from suspension_twin.files import Json
from suspension_twin.road.road import Outside, Road

__all__ = ["OFF_ROAD", "Ground", "OffRoad", "off_road", "policy_of"]

#: Border modes of OpenCRG in words.
_MODES = ("error", "zero", "hold", "repeat", "reflect")
#: With what the sentence of a drive that leaves its road begins.
OFF_ROAD = "off the road"
_WORDS = {
    "hold": "the heights of its border are held",
    "zero": "the height is 0",
    "repeat": "the road repeats itself",
    "reflect": "the road is mirrored",
}


def policy_of(road: Road, outside: Outside) -> str:
    """Name of the height policy beyond the road; for ``road`` that of its file, along and across."""
    if outside != "road":
        return outside
    along, across = (_MODES[int(mode)] for mode in (road.borders.u.mode, road.borders.v.mode))
    return along if along == across else f"{along} along, {across} across"


@dataclass(frozen=True)
class OffRoad:
    """Segments of a drive where not all wheels were on the road.

    ``policy`` names the heights used there: hold, zero, repeat, reflect, or one along and one across.
    ``share`` of the drive's time, ``segments`` (start, end) s since the epoch.
    """

    road: str = ""
    policy: str = "hold"
    share: float = 0.0
    segments: tuple[tuple[float, float], ...] = ()

    @property
    def seconds(self) -> float:
        """Time off the road."""
        return float(sum(end - start for start, end in self.segments))

    def as_dict(self) -> Json:
        """As results hold it."""
        segments = [{"start": start, "end": end} for start, end in self.segments]
        return {"policy": self.policy, "share": self.share, "seconds": self.seconds, "stretches": segments}

    def sentence(self, begin: float) -> str:
        """One line for people, times counted from ``begin`` s; empty where the road was never left."""
        if not self.segments:
            return ""
        start, end = self.segments[0]
        more = f" and {len(self.segments) - 1} times more" if len(self.segments) > 1 else ""
        words = _WORDS.get(self.policy, f"the road's file says {self.policy}")
        span = f"from {start - begin:.1f} to {end - begin:.1f} s{more}"
        return (
            f"{OFF_ROAD} {self.road} for {self.seconds:.1f} s ({self.share:.0%} of the drive), {span}: "
            f"there {words}, and nothing is compared"
        )


def off_road(name: str, t: Floats, inside: NDArray[np.bool_], road: Road, outside: Outside) -> OffRoad:
    """Find where a drive with stamps ``t`` (n,) left the road; ``inside`` (n,): all wheels have a height under them.

    Raises InputError that names the drive where it did and the policy, or the road's file, refuses that.
    """
    segments = tuple((float(t[i]), float(t[min(j, t.size - 1)])) for i, j in runs(~inside))
    policy = policy_of(road, outside)
    if segments and "error" in policy:
        start, end = segments[0]
        by = "the policy" if outside == "error" else "the road's file"
        raise InputError(
            name,
            f"leaves the road {road.name} from {start - t[0]:.2f} to {end - t[0]:.2f} s after its start, and {by} "
            "has no height there",
        )
    return OffRoad(road.name, policy, float(np.mean(~inside)) if inside.size else 0.0, segments)


@dataclass(frozen=True, eq=False)
class Ground:
    """The road with a policy for what lies beyond it, as the models ask for heights.

    The policy ``error`` is applied to the recorded drive by :func:`off_road`; a candidate with a shifted map that
    leaves the road gets the heights of its border."""

    road: Road
    outside: Outside

    def heights(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Heights in m at ``map`` positions."""
        refuses = "error" in policy_of(self.road, self.outside)
        return self.road.heights(x, y, "hold" if refuses else self.outside)
