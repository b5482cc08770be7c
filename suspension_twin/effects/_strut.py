# SPDX-License-Identifier: Apache-2.0
"""Effects of the struts that come in pairs: one odd corner of an axle, and a stop at an end of the travel."""

from __future__ import annotations

from typing import Literal

import numpy as np

from suspension_twin.effects.base import (
    CORNER,
    WIDTH,
    CornerChange,
    Effect,
    Fields,
    Floats,
    Hook,
    KernelTerms,
    Parameter,
    Prior,
    Values,
    Variant,
    axles,
    by_corner,
    changed,
    fma,
    inlined,
    of_one_corner,
    of_wheel,
)

__all__ = ["odd_corner", "stop"]

_CORNERS = "0 front left, 1 front right, 2 rear left, 3 rear right"
#: Compression of a stop in m that doubles its stiffness' share in the force: progressive foam.
_DOUBLING = 0.02

_FIELDS = Fields()
_CLEARANCE = _FIELDS.add(CORNER)  # travel from static until the stop touches, m
_STIFFNESS = _FIELDS.add(CORNER)  # of the stop at first touch, N/m
_RISE = _FIELDS.add(CORNER)  # growth of its force with the square of its compression, N/m²


def odd_corner(
    part: Literal["spring", "damper"], other: str, usual: float, order: int, upright: bool = False
) -> Effect:
    """One corner whose ``part`` has another force; ``other`` is the part that is easily confused with it, ``usual``
    what new parts of one kind differ by."""
    parameters = (
        Parameter("corner", (0.0, 3.0), Prior(0.0, 3.0), "", _CORNERS, choices=(0.0, 1.0, 2.0, 3.0)),
        Parameter("change", (-0.98, 2.0), Prior(0.0, 0.4, usual=usual), "", "of its force, as a share"),
    )

    def corners(change: CornerChange, p: Values) -> None:
        for corner, share in enumerate(getattr(change, part)):
            share += np.where(p["corner"] == corner, p["change"], 0.0)

    def every_corner(change: CornerChange, p: Values) -> None:
        getattr(change, part)[:] += p["change"]

    return Effect(
        id=f"corner_{part}",
        title=f"one odd {part}",
        where="strut",
        doc=f"The {part} of one corner has (1 + change) times the force of its axle's characteristic: worn, broken or "
        "the wrong part.",
        parameters=parameters,
        order=order,
        severity=("change",),
        excited_by=("one-sided bumps", "heave coupled with roll", "roll rate on a straight even road"),
        confused_with=(f"the axle's {part}", f"corner_{other}", "payload on one side", "lateral_offset"),
        hook=Hook(corners=corners, upright=upright),
        variants={"quarter_car": Variant(parameters[1:], Hook(corners=every_corner, upright=upright))},
        finding=lambda p: f"{of_wheel(p, part)} {changed(p['change'], 'force')}",
    )


@inlined
def _jounce(w: Floats, e: int, c: int, i: int, x: float) -> tuple[float, float]:
    """Force in N and stiffness in N/m of the stop of a strut that is compressed by x m from static."""
    y = x - w[(e + _CLEARANCE + c) * WIDTH + i]
    y = y if y > 0.0 else 0.0
    rate, rise = w[(e + _STIFFNESS + c) * WIDTH + i], w[(e + _RISE + c) * WIDTH + i]
    return y * fma(rise, y, rate), (rate + 2.0 * rise * y if y > 0.0 else 0.0)


@inlined
def _rebound(w: Floats, e: int, c: int, i: int, x: float) -> tuple[float, float]:
    """The same at the other end of the travel."""
    force, stiffness = _jounce(w, e, c, i, -x)
    return -force, stiffness


def stop(
    name: str, end: Literal["jounce", "rebound"], moves: str, valve: str, farthest: float, order: int
) -> Effect:
    """A progressive stop at one ``end`` of the travel, at most ``farthest`` m away; ``moves`` is what the strut does
    then, ``valve`` the damper's that is confused with it."""
    gap = ((0.002, farthest), Prior(0.05, 2.0, "factor"), "m")
    parameters = (
        Parameter("front_clearance", *gap, f"{end} at the wheel until it touches, front", neutral=0.06),
        Parameter("rear_clearance", *gap, "the same at the rear", neutral=0.06),
        # softer is what bushings and kinematics add to any spring as it is compressed, not a stop
        Parameter(
            "stiffness", (0.0, 1.0e6), Prior(0.0, 8.0e4, usual=8.0e3), "N/m", "at first touch, at the wheel"
        ),
    )
    law = {"jounce": _jounce, "rebound": _rebound}[end]
    return Effect(
        id=f"{name}_stop",
        title=f"{name} stop",
        where="strut",
        doc=f"Beyond a clearance of {end} from standing the strut {moves} against a stop: "
        "stiffness times its compression, twice that at 20 mm and growing with the square.",
        parameters=parameters,
        order=order,
        severity=("stiffness",),
        excited_by=(f"large {end}", "bumps and potholes at speed"),
        confused_with=("the last points of the spring", f"{valve} at high velocity"),
        hook=Hook(
            kernel=KernelTerms(
                _FIELDS,
                lambda p: {
                    _CLEARANCE: by_corner(p["front_clearance"], p["rear_clearance"]),
                    _STIFFNESS: p["stiffness"],
                    _RISE: p["stiffness"] / _DOUBLING,
                },
                elastic=(law, CORNER),
                stiffness=(_STIFFNESS,),
            )
        ),
        variants={"quarter_car": Variant(of_one_corner(parameters))},
        finding=lambda p: (
            f"the struts hit their {name} stops: they touch after {axles(p, '_clearance', 'm')}"
        ),
    )
