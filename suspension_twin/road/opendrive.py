# SPDX-License-Identifier: Apache-2.0
"""The road surface of an OpenDRIVE file: a road's plan view and heights with its OpenCRG files.

ASAM OpenDRIVE 1.9, 10.6, ``<surface><CRG>``: in mode ``attached`` the grid of the OpenCRG file lies along the road's
own line, u = s - sOffset and v = t - tOffset, and its heights add to those of the road: elevation, lateral profile,
lane heights. ``attached0`` leaves the road's heights out; ``genuine`` puts the start of the OpenCRG file's line at the
road's (sOffset, tOffset), ``global`` at a place of its own. ``sStart`` and ``sEnd`` only limit.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError
from suspension_twin.files import read_bytes, reader
from suspension_twin.road.crg import load_road
from suspension_twin.road.road import ReferenceLine, Road

__all__ = ["read_opendrive"]

_LARGEST = 1 << 30  # bytes of a file


#: Numbers of a ``<CRG>`` and their defaults: limits and offsets in m, a heading in rad.
_NUMBERS = {"sStart": 0.0, "sEnd": math.inf, "zScale": 1.0} | dict.fromkeys(
    ("sOffset", "tOffset", "xOffset", "yOffset", "zOffset", "hOffset"), 0.0
)
#: Offsets that a mode has no use for (rules of 10.6.6).
_UNUSED = {
    "attached": ("xOffset", "yOffset", "hOffset"),
    "attached0": ("xOffset", "yOffset", "hOffset"),
    "genuine": ("xOffset", "yOffset"),
    "global": ("sOffset", "tOffset"),
}
_SIDES = {"left": 1.0, "right": -1.0}
_TRUE = ("true", "1")
#: Distance of long sections where a road is uneven across, m: half a narrow tyre's width.
_ACROSS = 0.1
#: Bytes that a point of a line or a grid takes while its height is computed: a dozen arrays.
_NODE = 96


@reader("an OpenDRIVE file")
def read_opendrive(path: Path, road_id: str | None = None) -> Road:
    """The surface of one road of an OpenDRIVE file.

    Parameters
    ----------
    path : Path
        The ``.xodr`` file; OpenCRG files are looked for relative to it.
    road_id : str, optional
        Id of the road; not needed where only one has an OpenCRG surface.

    Returns
    -------
    Road
        In the file's inertial axes, which are taken for ``map``.

    Raises
    ------
    InputError
        The file has no such surface, or one of a kind that is not read.

    Examples
    --------
    >>> read_opendrive(Path("missing.xodr"))
    Traceback (most recent call last):
    suspension_twin.errors.InputError: missing.xodr: No such file or directory
    """
    try:
        root = ElementTree.fromstring(read_bytes(path, _LARGEST))
    except ElementTree.ParseError as error:
        raise InputError(path, f"not XML: {error}") from None
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if root.tag != "OpenDRIVE":
        raise InputError(path, f"not OpenDRIVE: its root is <{root.tag}>")
    surfaces = {
        road.get("id", ""): (road, heights)
        for road in root.findall("road")
        if (heights := [c for c in road.findall("surface/CRG") if c.get("purpose") != "friction"])
    }
    if not surfaces:
        raise InputError(path, "no road has a <surface> with a <CRG> of heights")
    if road_id is None and len(surfaces) > 1:
        raise InputError(path, f"roads {', '.join(surfaces)} have surfaces: choose one with --road")
    chosen = next(iter(surfaces)) if road_id is None else road_id
    if chosen not in surfaces:
        raise InputError(
            path, f"road {chosen}", f"has no OpenCRG surface; those that have: {', '.join(surfaces)}"
        )
    road, crgs = surfaces[chosen]
    if len(crgs) > 1:
        raise InputError(path, f"road {chosen}", f"{len(crgs)} surfaces on one road are not read")
    return _surface(path, road, crgs[0])


def _surface(path: Path, road: ElementTree.Element, crg: ElementTree.Element) -> Road:
    field = f"road {road.get('id')}"
    mode = crg.get("mode", "attached")
    file = crg.get("file")
    if not file:
        raise InputError(path, field, "a <CRG> without a file")
    if mode not in _UNUSED:
        raise InputError(path, field, f"mode {mode!r} is not one of {', '.join(_UNUSED)}")
    if crg.get("orientation", "same") != "same":
        raise InputError(path, field, "an OpenCRG file of the opposite orientation is not read")
    place = {key: _number(path, crg, key, default) for key, default in _NUMBERS.items()}
    for key in _UNUSED[mode]:
        if place[key]:
            raise InputError(
                path, f"{field}, <CRG> {key}", f"is {place[key]:g}, has no meaning in mode {mode}"
            )
    surface = load_road(path.parent / file).scaled(place["zScale"])
    start, end = place["sStart"], min(place["sEnd"], _end(path, road))
    if mode.startswith("attached"):
        s = surface.u + place["sOffset"]
        surface = _between(path, field, surface, s, (start, end))
        return _attached(path, road, surface, place, mode == "attached")
    if mode == "genuine":
        at = np.full(1, place["sOffset"])
        x, y, heading = (float(a[0]) for a in _plan(path, road, at))
        x, y = x - math.sin(heading) * place["tOffset"], y + math.cos(heading) * place["tOffset"]
    else:
        x0, y0, heading = float(surface.x[0]), float(surface.y[0]), surface.headings[0]
        cos, sin = math.cos(place["hOffset"]), math.sin(place["hOffset"])
        x, y = place["xOffset"] + cos * x0 - sin * y0, place["yOffset"] + sin * x0 + cos * y0
    base = float(surface.ref_z[0]) + place["zOffset"]
    surface = surface.placed(x, y, heading + place["hOffset"], base)
    s = _line(path, road, surface.u_step).xy_to_uv(surface.x, surface.y)[0]
    return _between(path, field, surface, s, (start, end))


def _between(path: Path, field: str, surface: Road, s: Floats, limits: tuple[float, float]) -> Road:
    """The cross sections of a surface that lie at s (nu,) m within the limits."""
    rows = np.flatnonzero((s >= limits[0] - 1e-6) & (s <= limits[1] + 1e-6))
    if rows.size < 2:
        raise InputError(path, field, "no part of the OpenCRG file lies between sStart and sEnd")
    return surface if rows.size == s.size else surface.part(int(rows[0]), int(rows[-1]) + 1)


def _attached(
    path: Path, road: ElementTree.Element, surface: Road, place: dict[str, float], lifted: bool
) -> Road:
    """The heights of a surface over the road's own line, where ``lifted`` added to the road's own heights."""
    if surface.borders.begin or surface.borders.end or surface.borders.close:
        raise InputError(
            path, f"road {road.get('id')}", "an attached OpenCRG file that fades or closes is not read"
        )
    s, t = surface.u + place["sOffset"], surface.v + place["tOffset"]
    x, y, heading = _plan(path, road, s)
    z, ref, bank = surface.heights_grid, np.full(s.size, place["zOffset"]), np.zeros(s.size)
    if lifted:
        ref = ref + _cubics(path, road.findall("elevationProfile/elevation"), s)
        bank = np.tan(_cubics(path, road.findall("lateralProfile/superelevation"), s))
        if kinks := _kinks(path, road):
            nodes = [*t, *kinks, *np.arange(t[0], t[-1], _ACROSS)]
            fine = np.unique(np.round(np.clip(nodes, t[0], t[-1]), 6))
            Budget(path, z.nbytes).take(_NODE * fine.size * s.size)
            z, t = np.array([np.interp(fine, t, row) for row in z]), fine
            z = z + _lateral(path, road, s, t, bank)
    line = ReferenceLine(x, y, ref, bank, surface.u_step, (float(heading[0]), float(heading[-1])))
    return Road(surface.name, z, t, line)


def _kinks(path: Path, road: ElementTree.Element) -> list[float]:
    """t of kinks across a road, m; none where it is straight across."""
    if road.find("lateralProfile/crossSectionSurface") is not None:
        raise InputError(path, f"road {road.get('id')}", "a <crossSectionSurface> is not read")
    shapes, falls = (road.findall(f"lateralProfile/{tag}") for tag in ("shape", "crossfall"))
    lanes = road.findall("lanes/laneSection/*/lane")
    uneven = any(lane.find("height") is not None or lane.get("level") in _TRUE for lane in lanes)
    kinks = [0.0] if falls or uneven else []
    return kinks + [_number(path, shape, "t", 0.0) for shape in shapes]


def _lateral(path: Path, road: ElementTree.Element, s: Floats, t: Floats, bank: Floats) -> Floats:
    """Heights (n, m) m of a road at s (n,) and t (m,) over its elevation and its cross slope ``bank`` (n,)."""
    height, level = np.zeros((s.size, t.size)), np.tile(t, (s.size, 1))
    for side, sign in _SIDES.items():
        reach, raised = _lanes(path, road, s, t, side)
        level = sign * np.minimum(sign * level, reach[:, None])
        # OpenDRIVE 1.4, 5.3.6.2: a positive crossfall falls to the outer side.
        falls = [
            c for c in road.findall("lateralProfile/crossfall") if c.get("side", "both") in (side, "both")
        ]
        fall = np.tan(_cubics(path, falls, s))[:, None]
        height += raised - fall * np.clip(sign * t, 0.0, reach[:, None])
    height += bank[:, None] * (level - t)
    shapes: dict[float, list[ElementTree.Element]] = {}
    for shape in road.findall("lateralProfile/shape"):
        shapes.setdefault(_number(path, shape, "s", 0.0), []).append(shape)
    if shapes:
        # Between two cross sections the shape is linear along s (10.5.3); before the first it is zero.
        places = np.array(list(shapes))
        after = np.clip(np.searchsorted(places, s, side="right"), 1, places.size)
        before, after = after - 1, np.minimum(after, places.size - 1)
        share = np.clip((s - places[before]) / np.maximum(places[after] - places[before], 1e-9), 0.0, 1.0)
        across = np.array([_cubics(path, pieces, level, "t") for pieces in shapes.values()])
        rows = np.arange(s.size)
        mixed = (1.0 - share[:, None]) * across[before, rows] + share[:, None] * across[after, rows]
        height += np.where((s >= places[0] - 1e-9)[:, None], mixed, 0.0)
    return height


def _lanes(path: Path, road: ElementTree.Element, s: Floats, t: Floats, side: str) -> tuple[Floats, Floats]:
    """Lanes of one side at s (n,), t (m,) m: how far out the lateral profile goes (n,), and their heights (n, m), m.

    A lane with ``level`` and those beyond it are as high as its inner border (OpenDRIVE 1.9, 11.7.4).
    """
    reach, height = np.full(s.size, np.inf), np.zeros((s.size, t.size))
    sections = [
        section
        for section in road.findall("lanes/laneSection")
        if section.get("singleSide") not in _TRUE or section.find(side) is not None
    ]
    if not sections:
        return reach, height
    sign = _SIDES[side]
    at, ds = _within(path, sections, s)
    offset = sign * _cubics(path, road.findall("lanes/laneOffset"), s)
    for i in np.unique(at):
        here = at == i
        inner, along = offset[here], ds[here]
        lanes = sections[int(i)].findall(f"{side}/lane")
        for lane in sorted(lanes, key=lambda lane: abs(_number(path, lane, "id", None))):
            widths, borders, heights = (lane.findall(tag) for tag in ("width", "border", "height"))
            if lane.get("level") in _TRUE:
                reach[here] = np.minimum(reach[here], inner)
            if borders and not widths:
                outer = sign * _cubics(path, borders, along, "sOffset")
            else:
                outer = inner + _cubics(path, widths, along, "sOffset")
            if heights:
                ends = np.array([[_number(path, h, key, 0.0) for key in ("inner", "outer")] for h in heights])
                low, high = ends[_within(path, heights, along, "sOffset")[0]].T[:, :, None]
                out = sign * t - inner[:, None]
                width = (outer - inner)[:, None]
                inside = (out > 1e-6) & (out <= width + 1e-6)
                height[here] += np.where(inside, low + out / np.maximum(width, 1e-9) * (high - low), 0.0)
            inner = outer
    return reach, height


def _end(path: Path, road: ElementTree.Element) -> float:
    """s of the end of a road's line, m."""
    pieces = road.findall("planView/geometry")
    if not pieces:
        raise InputError(path, f"road {road.get('id')}", "has no plan view")
    return _number(path, pieces[-1], "s", 0.0) + _number(path, pieces[-1], "length", None)


def _line(path: Path, road: ElementTree.Element, step: float) -> Road:
    """A road's line as a level road whose u is s, with points ``step`` m apart or somewhat closer."""
    end = _end(path, road)
    Budget(path, path.stat().st_size).take(int(_NODE * min(abs(end) / step, 1e15)))
    s = np.linspace(0.0, end, math.ceil(end / step) + 1)
    x, y, heading = _plan(path, road, s)
    line = ReferenceLine.level(x, y, float(s[1]), (float(heading[0]), float(heading[-1])))
    return Road("plan view", np.zeros((s.size, 2)), np.array([-1.0, 1.0]), line)


def _plan(path: Path, road: ElementTree.Element, s: Floats) -> tuple[Floats, Floats, Floats]:
    """x, y and heading of a road's line at s (n,) m."""
    pieces = road.findall("planView/geometry")
    field = f"road {road.get('id')}"
    at, ds = _within(path, pieces, s)
    out = np.zeros((3, s.size))
    for i in np.unique(at):
        here = at == i
        out[:, here] = _piece(path, field, pieces[int(i)], ds[here])
    return out[0], out[1], out[2]


def _within(
    path: Path, pieces: list[ElementTree.Element], s: Floats, key: str = "s"
) -> tuple[NDArray[np.intp], Floats]:
    """Piece in which each s lies, m, and its distance from the start of that piece, its ``key``."""
    starts = np.array([_number(path, piece, key, 0.0) for piece in pieces])
    at = np.clip(np.searchsorted(starts, s + 1e-9, side="right") - 1, 0, len(pieces) - 1)
    return at, s - starts[at]


def _piece(path: Path, field: str, piece: ElementTree.Element, ds: Floats) -> Floats:
    """x, y and heading (3, n) at distances within one geometry."""
    x0, y0, h0 = (_number(path, piece, key, None) for key in ("x", "y", "hdg"))
    length = _number(path, piece, "length", None)
    shape = next(iter(piece), None)
    kind = "" if shape is None else shape.tag
    if shape is None or kind not in ("line", "arc", "spiral", "paramPoly3"):
        raise InputError(path, field, f"a geometry <{kind}> is not read")
    if kind == "paramPoly3":
        normalised = shape.get("pRange", "normalized") == "normalized"
        p = np.linspace(0.0, 1.0 if normalised else length, 2001)
        a, b, c, d = ([_number(path, shape, f"{k}{axis}", 0.0) for axis in "UV"] for k in "abcd")
        local = np.array([a[i] + b[i] * p + c[i] * p**2 + d[i] * p**3 for i in (0, 1)])
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(local, axis=1)))])
        q = np.interp(ds, arc, p)
        along, across = (a[i] + b[i] * q + c[i] * q**2 + d[i] * q**3 for i in (0, 1))
        turn = np.arctan2(*(b[i] + 2 * c[i] * q + 3 * d[i] * q**2 for i in (1, 0)))
    else:
        first = _number(path, shape, {"line": "-", "arc": "curvature", "spiral": "curvStart"}[kind], 0.0)
        last = _number(path, shape, "curvEnd", 0.0) if kind == "spiral" else first
        rate = (last - first) / length
        turn = first * ds + 0.5 * rate * ds**2
        # The line as an integral of its direction: Gauss-Legendre with 20 nodes a point.
        nodes, weights = np.polynomial.legendre.leggauss(20)
        t = 0.5 * ds[:, None] * (nodes + 1.0)
        angle = first * t + 0.5 * rate * t**2
        along, across = (0.5 * ds * (f(angle) @ weights) for f in (np.cos, np.sin))
    cos, sin = math.cos(h0), math.sin(h0)
    return np.array([x0 + cos * along - sin * across, y0 + sin * along + cos * across, h0 + turn])


def _cubics(path: Path, pieces: list[ElementTree.Element], s: Floats, key: str = "s") -> Floats:
    """Values of piecewise cubics a + b ds + c ds² + d ds³ at s; 0 before the first."""
    if not pieces:
        return np.zeros(s.shape)
    at, ds = _within(path, pieces, s, key)
    a, b, c, d = (np.array([_number(path, piece, letter, 0.0) for piece in pieces])[at] for letter in "abcd")
    return np.where(ds < -1e-6, 0.0, ((d * ds + c) * ds + b) * ds + a)


def _number(path: Path, element: ElementTree.Element, key: str, default: float | None) -> float:
    text = element.get(key)
    if text is None:
        if default is None:
            raise InputError(path, f"<{element.tag}> without {key}")
        return default
    try:
        value = float(text)
    except ValueError:
        raise InputError(path, f"<{element.tag}> {key}", f"{text!r} is not a number") from None
    if not math.isfinite(value):
        raise InputError(path, f"<{element.tag}> {key}", "is not finite")
    return value
