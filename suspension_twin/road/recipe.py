# SPDX-License-Identifier: Apache-2.0
"""A road from a few numbers: a random profile and single features, as a command line states them.

A feature is written ``SIZE@PLACE[:SIDE]``. ``SIZE`` is its dimensions in m with ``x`` between them,
``PLACE`` the u in m at which it starts, ``SIDE`` ``left``, ``right`` or ``LOW..HIGH``, the v in m
between which it lies; without it, it crosses the whole road.

| feature | size | shape |
| --- | --- | --- |
| bump | length x height | half sine |
| hump | length x height, or length x height x top | segment of a circle; trapezoid with a level top |
| pothole | length x depth | flat floor, walls over an eighth of the length each |
| ramp | length x rise | even climb, at a constant height from there on |
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.build import (
    Bump,
    add_bump,
    circular,
    grid_road,
    half_sine,
    lateral_grid,
    trapezoid,
)
from suspension_twin.road.road import Road
from suspension_twin.road.roughness import iso8608_road

__all__ = ["Feature", "Kind", "make_road", "parse_feature", "shape_of"]

Kind = Literal["bump", "hump", "pothole", "ramp"]

_SIZES = {"bump": (2,), "hump": (2, 3), "pothole": (2,), "ramp": (2,)}
_WORDS = {
    "bump": "LENGTHxHEIGHT@U",
    "hump": "LENGTHxHEIGHT[xTOP]@U",
    "pothole": "LENGTHxDEPTH@U",
    "ramp": "LENGTHxRISE@U",
}


@dataclass(frozen=True)
class Feature:
    """One feature: its ``kind``, ``size`` m, start ``at`` m, and the ``v_low`` to ``v_high`` m that it covers."""

    kind: Kind
    size: tuple[float, ...]
    at: float
    v_low: float = -math.inf
    v_high: float = math.inf


def parse_feature(kind: Kind, text: str) -> Feature:
    """Read a feature from its words.

    Parameters
    ----------
    kind : str
        bump, hump, pothole or ramp.
    text : str
        ``SIZE@PLACE[:SIDE]``, in m.

    Returns
    -------
    Feature
        The feature.

    Raises
    ------
    InputError
        The text is no feature.

    Examples
    --------
    >>> parse_feature("bump", "0.9x0.05@40:left")
    Feature(kind='bump', size=(0.9, 0.05), at=40.0, v_low=0.0, v_high=inf)
    """
    option = f"--{kind}"
    found = re.fullmatch(r"\s*([^@:]+)@([^@:]+)(?::([^@:]+))?\s*", text)
    if found is None:
        raise InputError(option, f"is written {_WORDS[kind]}[:SIDE] such as 0.9x0.05@40:left, not {text!r}")
    size = tuple(_number(option, part) for part in found[1].split("x"))
    if len(size) not in _SIZES[kind]:
        raise InputError(option, f"needs {_WORDS[kind]}, not {text!r}")
    low, high = -math.inf, math.inf
    side = (found[3] or "").strip()
    if side == "left":
        low = 0.0
    elif side == "right":
        high = 0.0
    elif side:
        edges = side.split("..")
        if len(edges) != 2:
            raise InputError(option, f"a side is left, right or LOW..HIGH in m, not {side!r}")
        low, high = (_number(option, part) for part in edges)
        if not low < high:
            raise InputError(option, f"{side}: the second v must be above the first")
    return Feature(kind, size, _number(option, found[2]), low, high)


def make_road(
    length: float = 200.0,
    width: float = 6.0,
    *,
    features: Sequence[Feature] = (),
    iso: str | None = None,
    seed: int = 0,
    step: float = 0.02,
    v_step: float = 0.1,
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
    name: str = "road",
) -> Road:
    """Make a straight road: a random ISO 8608 profile, or a level plane, with features added to it.

    Parameters
    ----------
    length, width : float
        m.
    features : sequence of Feature
        Bumps, humps, potholes and ramps; heights add up where they overlap.
    iso : str, optional
        Class "A" to "H".
    seed : int
        Seed of the random profile.
    step, v_step : float
        Distance of the nodes along and across in m.
    x, y, heading : float
        Start in ``map`` in m, and direction in rad.
    name : str
        Name of the road.

    Returns
    -------
    Road
        The road.

    Raises
    ------
    InputError
        A feature does not lie on the road, or a number is impossible.

    Examples
    --------
    >>> road = make_road(100.0, features=[parse_feature("ramp", "10x0.5@40")])
    >>> round(float(road.heights(60.0, 0.0)), 3)
    0.5
    """
    for option, value in (("length", length), ("step", step)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"--{option}", f"must be above 0 m, is {value}")
    if length / step > 2e6:
        raise InputError("--step", f"{length:g} m at {step:g} m are too many cross sections")
    if iso is not None:
        road = iso8608_road(
            iso,
            length,
            width=width,
            seed=seed,
            step=step,
            v_step=v_step,
            x=x,
            y=y,
            heading=heading,
            name=name,
        )
    else:
        v = lateral_grid(width, v_step)
        level = np.zeros((round(length / step) + 1, v.size))
        road = grid_road(level, step, v, x=x, y=y, heading=heading, name=name)
    for feature in features:
        if feature.kind == "ramp":
            road = _ramp(road, feature)
        else:
            extent = {"v_low": feature.v_low, "v_high": feature.v_high}
            road = add_bump(road, shape_of(feature), feature.at, **extent)
    return road


def shape_of(feature: Feature) -> Bump:
    """The shape of a bump, a hump or a pothole; raises InputError for an impossible size."""
    size = feature.size
    if feature.kind == "bump":
        return half_sine(*size)
    if feature.kind == "hump":
        return trapezoid(*size) if len(size) == 3 else circular(*size)
    length, depth = size
    if not depth > 0.0:
        raise InputError("--pothole", f"the depth must be above 0 m, is {depth}")
    return replace(trapezoid(length, -depth, 0.75 * length), name="pothole")


def _ramp(road: Road, feature: Feature) -> Road:
    length, rise = feature.size
    if not (length >= 2.0 * road.u_step and rise != 0.0):
        raise InputError("--ramp", f"needs a length of {2 * road.u_step:g} m or more and a rise other than 0")
    if not road.u_first <= feature.at <= road.u_last - length:
        raise InputError("--ramp", f"{feature.at:g} to {feature.at + length:g} m is off the road")
    across = (road.v >= feature.v_low) & (road.v <= feature.v_high)
    if not across.any():
        raise InputError("--ramp", "no long section lies within its v")
    climb: Floats = rise * np.clip((road.u - feature.at) / length, 0.0, 1.0)
    z = road.z + np.where(across, climb[:, None], 0.0)
    return road.with_heights(z)


def _number(option: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise InputError(option, f"{text.strip()!r} is not a number") from None
    if not math.isfinite(value):
        raise InputError(option, f"{text.strip()!r} is not a finite number")
    return value
