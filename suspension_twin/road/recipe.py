# SPDX-License-Identifier: Apache-2.0
"""A road from a few numbers: a random profile and single features, as a command line states them.

A feature is written ``SIZE@PLACE[:SIDE]``. ``SIZE`` is its dimensions in m with ``x`` between them,
``PLACE`` the u in m at which it starts, ``SIDE`` ``left``, ``right`` or ``LOW..HIGH``, the v in m
between which it lies; without it, it crosses the whole road.

| feature | size | shape |
| --- | --- | --- |
| bump | length x height | half sine |
| hump | length x height, or length x height x top | segment of a circle; trapezoid with a level top |
| plank | length x height | level top, walls of a hundredth of the length |
| pothole | length x depth | flat floor, walls over an eighth of the length each |
| ramp | length x rise | even climb, at a constant height from there on |

Sizes by tape measure are known to some millimetres. The header of a road file says so in its comment, a line for each
feature, ``taped to 0.005 m, places to 0.02 m: bump 0.9x0.05@40``; a calibration then finds the errors of the tape with
the vehicle (:class:`Taped`). A surveyed road has no such line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np

from suspension_twin.arrays import Floats, interpolated
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
from suspension_twin.road.crg import comment_of
from suspension_twin.road.road import Road

__all__ = [
    "FIRST_AT",
    "TAPE",
    "TAPED_PLACE",
    "Feature",
    "Kind",
    "Taped",
    "make_road",
    "parse_feature",
    "shape_of",
    "taped_features",
]

Kind = Literal["bump", "hump", "plank", "pothole", "ramp"]

#: Standard deviations in m of a size by tape and level, which are read to 5 mm, and of the distance between two bumps
#: by a tape of 30 m that lies on the ground.
TAPE, TAPED_PLACE = 0.005, 0.02
#: m from the start of a road to its first feature, where nobody says: 40 m of lane lie before it.
FIRST_AT = 40.0
_SIZES = {"bump": (2,), "hump": (2, 3), "plank": (2,), "pothole": (2,), "ramp": (2,)}
_WORDS = {
    "bump": "LENGTHxHEIGHT@U",
    "hump": "LENGTHxHEIGHT[xTOP]@U",
    "plank": "LENGTHxHEIGHT@U",
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

    def __str__(self) -> str:
        """As :func:`parse_feature` reads it, after its kind."""
        edges = self.v_low, self.v_high
        sides = {(-math.inf, math.inf): "", (0.0, math.inf): ":left", (-math.inf, 0.0): ":right"}
        side = sides.get(edges, f":{self.v_low:.9g}..{self.v_high:.9g}")
        place = "" if math.isnan(self.at) else f"@{self.at:.9g}"
        return f"{self.kind} {'x'.join(f'{s:.9g}' for s in self.size)}{place}{side}"


@dataclass(frozen=True)
class Taped:
    """Features of a road that were measured by tape: standard deviations in m of their ``sizes``, and of the ``places``
    of all but the first against it, whose own place the positions of a drive give."""

    features: tuple[Feature, ...]
    sizes: float = TAPE
    places: float = TAPED_PLACE

    @property
    def errors(self) -> tuple[tuple[str, float], ...]:
        """Name and standard deviation in m of every error: of the height and of the length of each feature, and of the
        place of all but the first."""
        kinds = (("height", self.sizes), ("length", self.sizes), ("place", self.places))
        return tuple(
            (f"tape.{k}.{name}", sigma)
            for k in range(len(self.features))
            for name, sigma in kinds[: 2 if k == 0 else 3]
        )

    @property
    def comment(self) -> str:
        """The lines of a road file's comment that say so."""
        accuracy = f"taped to {self.sizes:g} m, places to {self.places:g} m"
        return "\n".join(f"{accuracy}: {feature}" for feature in self.features)

    def changed(self, road: Road, errors: Floats) -> Road:
        """The road where the tape was wrong by ``errors`` (k,) m: features higher, longer about their middles, and
        farther along by these."""
        found = dict(zip((name for name, _ in self.errors), errors, strict=True))
        z = road.z.copy()
        for k, feature in enumerate(self.features):
            height, length, along = (found.get(f"tape.{k}.{n}", 0.0) for n in ("height", "length", "place"))
            if height or length or along:
                own = _added(road.with_heights(np.zeros_like(road.z)), feature).z
                middle = feature.at + 0.5 * feature.size[0]
                u = middle + (road.u - along - middle) * feature.size[0] / (feature.size[0] + length)
                moved = interpolated(u, road.u, own)
                z += (1.0 + height / feature.size[1]) * moved - own
        return road.with_heights(z)


def taped_features(path: Path) -> Taped | None:
    """The features of a road file that were measured by tape, as its comment says; None of a surveyed road.

    Raises
    ------
    InputError
        A line of the comment that says so cannot be read.
    """
    found = [m for line in comment_of(path) if (m := _TAPED.fullmatch(line.strip()))]
    if not found:
        return None
    features = [parse_feature(cast(Kind, m[3]), m[4]) for m in found]
    sizes, places = (max(_number(str(path), m[i]) for m in found) for i in (1, 2))
    return Taped(tuple(features), sizes, places)


_TAPED = re.compile(rf"taped to (\S+) m, places to (\S+) m: ({'|'.join(get_args(Kind))}) (\S+)")


def parse_feature(kind: Kind, text: str, placed: bool = True) -> Feature:
    """Read a feature from its words.

    Parameters
    ----------
    kind : str
        bump, hump, plank, pothole or ramp.
    text : str
        ``SIZE@PLACE[:SIDE]``, in m.
    placed : bool
        Refuse a text without ``@PLACE``.

    Returns
    -------
    Feature
        The feature; at NaN m where its place is not given.

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
    found = re.fullmatch(r"\s*([^@:]+)(?:@([^@:]+))?(?::([^@:]+))?\s*", text)
    if found is None or (placed and found[2] is None):
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
    at = math.nan if found[2] is None else _number(option, found[2])
    return Feature(kind, size, at, low, high)


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
        Bumps, humps, planks, potholes and ramps; heights add up where they overlap.
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
        from suspension_twin.road.roughness import iso8608_road  # half a second of imports (scipy.signal)

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
        road = _added(road, feature)
    return road


def _added(road: Road, feature: Feature) -> Road:
    """The road with one more feature."""
    if feature.kind == "ramp":
        return _ramp(road, feature)
    return add_bump(road, shape_of(feature), feature.at, v_low=feature.v_low, v_high=feature.v_high)


def shape_of(feature: Feature) -> Bump:
    """The shape of a bump, a hump, a plank or a pothole; raises InputError for an impossible size."""
    size = feature.size
    if feature.kind == "bump":
        return half_sine(*size)
    if feature.kind == "hump":
        return trapezoid(*size) if len(size) == 3 else circular(*size)
    length, depth = size
    if feature.kind == "plank":
        return replace(trapezoid(length, depth, 0.98 * length), name="plank")
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
