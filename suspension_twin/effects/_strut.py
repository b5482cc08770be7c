# SPDX-License-Identifier: Apache-2.0
"""What two effects of the struts share: one odd corner of an axle, and a stop at an end of the travel."""

from __future__ import annotations

from functools import partial

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral, per_corner
from suspension_twin.models.hooks import Hook

__all__ = ["odd_corner", "stop"]

_CORNERS = "0 front left, 1 front right, 2 rear left, 3 rear right"
#: Compression of a stop in m that doubles its stiffness' share in the force: progressive foam.
_DOUBLING = 0.02


def odd_corner(part: str, other: str, scale: int, usual: float, upright: bool = False) -> Effect:
    """One corner whose ``part`` (spring, damper) has another force; ``scale`` the first of the rows that multiply it,
    ``other`` the part that is easily confused with it, ``usual`` what new parts of one kind differ by."""
    parameters = (
        Parameter("corner", "", 0.0, 3.0, 0.0, 0.0, 3.0, _CORNERS, choices=(0.0, 1.0, 2.0, 3.0)),
        Parameter("change", "", -0.98, 2.0, 0.0, 0.0, 0.4, "of its force, as a share", usual=usual),
    )
    return Effect(
        id=f"corner_{part}",
        title=f"one odd {part}",
        where="strut",
        doc=f"The {part} of one corner has (1 + change) times the force of its axle's characteristic: worn, broken or "
        "the wrong part.",
        parameters=parameters,
        severity=("change",),
        excited_by=("one-sided bumps", "heave coupled with roll", "roll rate on a straight even road"),
        confused_with=(f"the axle's {part}", f"corner_{other}", "payload on one side", "lateral_offset"),
        hook=Hook(
            neutral(parameters), terms=partial(_scale_one, scale), models=("full_car",), upright=upright
        ),
    )


def _scale_one(scale: int, rows: Floats, p: Values) -> None:
    for corner in range(4):
        rows[scale + corner] += np.where(p["corner"] == corner, p["change"], 0.0)


def stop(
    name: str, travel: str, moves: str, valve: str, farthest: float, rows: tuple[int, int, int]
) -> Effect:
    """A progressive stop at the end of ``travel`` (jounce, rebound), at most ``farthest`` m away; ``rows`` the first of
    clearance, stiffness and its rise, ``moves`` what the strut does then, ``valve`` the damper's that is confused."""
    gap = ("m", 0.002, farthest, 0.06, 0.05, 2.0)
    parameters = (
        Parameter("front_clearance", *gap, f"{travel} at the wheel until it touches, front", log=True),
        Parameter("rear_clearance", *gap, "the same at the rear", log=True),
        # softer is what bushings and kinematics add to any spring as it is compressed, not a stop
        Parameter(
            "stiffness", "N/m", 0.0, 1.0e6, 0.0, 0.0, 8.0e4, "at first touch, at the wheel", usual=8.0e3
        ),
    )
    return Effect(
        id=f"{name}_stop",
        title=f"{name} stop",
        where="strut",
        doc=f"Beyond a clearance of {travel} from standing the strut {moves} against a stop: "
        "stiffness times its compression, twice that at 20 mm and growing with the square.",
        parameters=parameters,
        severity=("stiffness",),
        excited_by=(f"large {travel}", "bumps and potholes at speed"),
        confused_with=("the last points of the spring", f"{valve} at high velocity"),
        hook=Hook(neutral(parameters), terms=partial(_press, rows), models=("full_car",)),
    )


def _press(first: tuple[int, int, int], rows: Floats, p: Values) -> None:
    gap, rate, rise = first
    per_corner(rows, gap, p["front_clearance"], p["rear_clearance"])
    rows[rate : rate + 4] += p["stiffness"]
    rows[rise : rise + 4] += p["stiffness"] / _DOUBLING
