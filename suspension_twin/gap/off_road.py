# SPDX-License-Identifier: Apache-2.0
"""A drive that leaves the road: which part of it, and what heights the twin gets there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.road import Outside, Road

__all__ = ["Ground", "OffRoad", "off_road", "policy_of"]

#: Border modes of OpenCRG in words.
_MODES = ("error", "zero", "hold", "repeat", "reflect")
_WORDS = {
    "hold": "the heights of its border are held",
    "zero": "the height is 0",
    "repeat": "the road repeats itself",
    "reflect": "the road is mirrored",
}


def policy_of(road: Road, outside: Outside) -> str:
    """What positions beyond the road get, by name; for ``road`` what its file says, along and across."""
    if outside != "road":
        return outside
    along, across = (_MODES[int(mode)] for mode in (road.borders.mode_u, road.borders.mode_v))
    return along if along == across else f"{along} along, {across} across"


@dataclass(frozen=True)
class OffRoad:
    """Where a drive had not all wheels on the road.

    ``policy`` names what the twin got there: hold, zero, repeat, reflect, or one along and one across.
    ``share`` of the drive's time, ``stretches`` (start, end) s since the epoch.
    """

    road: str = ""
    policy: str = "hold"
    share: float = 0.0
    stretches: tuple[tuple[float, float], ...] = ()

    @property
    def seconds(self) -> float:
        """Time off the road."""
        return float(sum(end - start for start, end in self.stretches))

    def as_dict(self) -> dict[str, Any]:
        """As results hold it."""
        stretches = [{"start": start, "end": end} for start, end in self.stretches]
        return {"policy": self.policy, "share": self.share, "seconds": self.seconds, "stretches": stretches}

    def sentence(self, begin: float) -> str:
        """One line for people, times counted from ``begin`` s; empty where the road was never left."""
        if not self.stretches:
            return ""
        start, end = self.stretches[0]
        more = f" and {len(self.stretches) - 1} times more" if len(self.stretches) > 1 else ""
        words = _WORDS.get(self.policy, f"the road's file says {self.policy}")
        span = f"from {start - begin:.1f} to {end - begin:.1f} s{more}"
        return (
            f"off the road {self.road} for {self.seconds:.1f} s ({self.share:.0%} of the drive), {span}: "
            f"there {words}, and nothing is compared"
        )


def off_road(name: str, t: Floats, inside: NDArray[np.bool_], road: Road, outside: Outside) -> OffRoad:
    """Where a drive with stamps ``t`` (n,) left the road; ``inside`` (n,) all wheels have a height under them.

    Raises InputError that names the drive where it did and the policy, or the road's file, refuses that.
    """
    edges = np.diff(np.concatenate([[0], (~inside).astype(np.int8), [0]]))
    first, past = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    last = np.minimum(past, t.size - 1)
    stretches = tuple((float(t[i]), float(t[j])) for i, j in zip(first, last, strict=True))
    policy = policy_of(road, outside)
    if stretches and "error" in policy:
        start, end = stretches[0]
        by = "the policy" if outside == "error" else "the road's file"
        raise InputError(
            name,
            f"leaves the road {road.name} from {start - t[0]:.2f} to {end - t[0]:.2f} s after its start, and {by} "
            "has no height there",
        )
    return OffRoad(road.name, policy, float(np.mean(~inside)) if inside.size else 0.0, stretches)


@dataclass(frozen=True, eq=False)
class Ground:
    """The road with a policy for what lies beyond it, as the models ask for heights.

    A policy or a file that refuses is asked about the drive by :func:`off_road`; whoever looks farther,
    as a candidate whose map is shifted, gets the border held.
    """

    road: Road
    outside: Outside

    def heights(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Heights in m at ``map`` positions."""
        refuses = "error" in policy_of(self.road, self.outside)
        return self.road.heights(x, y, "hold" if refuses else self.outside)
