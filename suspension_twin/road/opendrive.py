# SPDX-License-Identifier: Apache-2.0
"""The road surface of an OpenDRIVE file: a road's plan view and elevation with its OpenCRG files.

ASAM OpenDRIVE 1.8, ``<surface><CRG>``: in mode ``attached`` the reference line of the OpenCRG file is
replaced by the road's, with its elevation and superelevation; ``attached0`` leaves those out;
``genuine`` and ``global`` keep the line of the OpenCRG file.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import read_bytes
from suspension_twin.road.crg import load_road
from suspension_twin.road.road import ReferenceLine, Road

__all__ = ["read_opendrive"]

_LARGEST = 1 << 30  # bytes of a file


#: Attributes of a ``<CRG>`` in the order of a place, and their defaults.
_OFFSETS = {"sStart": 0.0, "sEnd": math.inf, "sOffset": 0.0, "tOffset": 0.0, "zOffset": 0.0, "zScale": 1.0}


@dataclass(frozen=True)
class _Place:
    """Place of a ``<CRG>``: along the road from ``start`` to ``end`` m, and offsets in m."""

    start: float
    end: float
    along: float
    across: float
    up: float
    scale: float


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
    surface = load_road(path.parent / file)
    place = _Place(*(_number(path, crg, key, default) for key, default in _OFFSETS.items()))
    scaled = surface.scaled(place.scale)
    if mode == "global":
        return scaled
    if crg.get("orientation", "same") != "same":
        raise InputError(path, field, "an OpenCRG file of the opposite orientation is not read")
    if mode == "genuine":
        start = np.full(1, place.start, dtype=np.float64)
        x, y, heading = (float(a[0]) for a in _plan(path, road, start))
        turned = heading + _number(path, crg, "hOffset", 0.0)
        x -= math.sin(heading) * place.across
        y += math.cos(heading) * place.across
        base = float(_cubics(path, road, "elevationProfile/elevation", start)[0])
        return scaled.placed(x, y, turned, base + place.up)
    if mode not in ("attached", "attached0"):
        raise InputError(path, field, f"mode {mode!r} is not one of attached, attached0, genuine, global")
    return _attached(path, road, scaled, place, mode == "attached")


def _attached(path: Path, road: ElementTree.Element, surface: Road, place: _Place, lifted: bool) -> Road:
    """The heights of a surface over the road's own line: u = s - sStart + sOffset, v = t - tOffset."""
    field = f"road {road.get('id')}"
    end = min(place.end, _number(path, road, "length", math.inf))
    u = surface.u
    s = place.start + (u - surface.u_first) - place.along
    kept = (s >= place.start - 1e-9) & (s <= end + 1e-9)
    if kept.sum() < 2:
        raise InputError(path, field, "no part of the OpenCRG file lies between sStart and sEnd")
    s = s[kept]
    x, y, heading = _plan(path, road, s)
    ref = np.full(s.size, place.up, dtype=np.float64)
    bank = np.zeros(s.size)
    if lifted:
        ref = ref + _cubics(path, road, "elevationProfile/elevation", s)
        bank = np.tan(_cubics(path, road, "lateralProfile/superelevation", s))
    z = surface.z + surface.bank[:, None] * surface.v + surface.ref_z[:, None] - surface.ref_z[0]
    line = ReferenceLine(x, y, ref, bank, surface.u_step, (float(heading[0]), float(heading[-1])))
    return Road(surface.name, z[kept], surface.v + place.across, line)


def _plan(path: Path, road: ElementTree.Element, s: Floats) -> tuple[Floats, Floats, Floats]:
    """x, y and heading of a road's line at s (n,) m."""
    pieces = road.findall("planView/geometry")
    field = f"road {road.get('id')}"
    if not pieces:
        raise InputError(path, field, "has no plan view")
    at, ds = _within(path, pieces, s)
    out = np.zeros((3, s.size))
    for i in np.unique(at):
        here = at == i
        out[:, here] = _piece(path, field, pieces[int(i)], ds[here])
    return out[0], out[1], out[2]


def _within(path: Path, pieces: list[ElementTree.Element], s: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Piece in which each s (n,) m lies, and its distance from the start of that piece."""
    starts = np.array([_number(path, piece, "s", 0.0) for piece in pieces])
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


def _cubics(path: Path, road: ElementTree.Element, tag: str, s: Floats) -> Floats:
    """Values of a road's piecewise cubics a + b ds + c ds² + d ds³ at s (n,)."""
    pieces = road.findall(tag)
    if not pieces:
        return np.zeros(s.size)
    at, ds = _within(path, pieces, s)
    powers = np.array([[_number(path, piece, key, 0.0) for key in "abcd"] for piece in pieces])[at]
    return np.asarray(((powers[:, 3] * ds + powers[:, 2]) * ds + powers[:, 1]) * ds + powers[:, 0])


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
