# SPDX-License-Identifier: Apache-2.0
"""OpenCRG files: reading them through the OpenCRG library, and writing them."""

from __future__ import annotations

import logging
import math
import os
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycrg
from pycrg import constants as c

from suspension_twin.errors import InputError
from suspension_twin.files import reading, replacing
from suspension_twin.road.crg_format import CrgText, examine
from suspension_twin.road.road import Borders, Road

__all__ = ["load_road", "write_road"]

_LOGGER = logging.getLogger("pycrg")


def load_road(path: str | os.PathLike[str]) -> Road:
    """Read an OpenCRG file, its modifiers and options honoured.

    A file without a ``$ROAD_CRG_MODS`` section gets OpenCRG's own default: the start of its reference line
    moves to x = y = z = 0 with heading 0. An empty section leaves everything where the file has it.

    Parameters
    ----------
    path : str or path-like
        The file.

    Returns
    -------
    Road
        ``notes`` holds the warnings of the OpenCRG library.

    Raises
    ------
    InputError
        One line that names the file and the fault.

    Examples
    --------
    >>> road = load_road("bags/bump_15kmh/road.crg")
    >>> round(road.length)
    80
    """
    path = Path(path)
    with reading(path, "an OpenCRG road"):
        return _load(path)


def _load(path: Path) -> Road:
    text = examine(path)
    with _quietly() as notes:
        try:
            with pycrg.DataSet.open(path) as data:
                road = _road(path, text, data)
        except (pycrg.OpenCRGError, OSError) as error:
            raise InputError(path, _one_line(str(error))) from error
    return replace(road, notes=tuple(dict.fromkeys(notes)))


def _road(path: Path, text: CrgText, data: pycrg.DataSet) -> Road:
    grid = data.grid()
    if grid.z.shape[0] != text.rows:
        raise InputError(
            path, "data", f"{text.rows} cross sections, the OpenCRG library read {grid.z.shape[0]}"
        )
    if not np.isfinite(grid.z).any():
        raise InputError(path, "data", "not one height: every value is missing")
    if not np.isfinite(grid.ref_z).all():
        raise InputError(path, "$ROAD_CRG_MODS", "the reference point lies where the file has no height")
    u_first, u_last = data.u_range()
    with data.create_contact_point() as point:
        borders = _borders(data, point, u_first, u_last, float(grid.v[0]))
        reach = 1.0
        if borders.close_span is not None:
            # Beyond its closing point a closed track is its other end.
            reach = 0.5 * min(u_first - borders.close_span[0], borders.close_span[1] - u_last, 2.0)
        headings = (
            _heading(point, u_first - reach, u_first, (grid.x[0], grid.y[0])),
            _heading(point, u_last + reach, u_last, (grid.x[-1], grid.y[-1])),
        )
    return Road(
        name=path.name,
        z=grid.z,
        v=grid.v,
        u_step=(u_last - u_first) / (grid.z.shape[0] - 1),
        x=grid.x,
        y=grid.y,
        ref_z=grid.ref_z,
        bank=grid.bank,
        headings=headings,
        u_first=u_first,
        borders=borders,
    )


def _heading(point: pycrg.ContactPoint, u: float, u_end: float, end: tuple[float, float]) -> float:
    """Direction in which the line goes on beyond one of its ends, asked of the library at u."""
    x, y = point.uv_to_xy(u, 0.0)
    along = math.copysign(1.0, u - u_end)
    seen = math.atan2(along * (y - end[1]), along * (x - end[0]))
    said = point.uv_to_pk(u, 0.0)[0]
    # The library's figure has all digits but may be the last segment's; then what it does counts.
    return said if abs(math.remainder(said - seen, 2.0 * math.pi)) < 1e-9 else seen


def _borders(
    data: pycrg.DataSet, point: pycrg.ContactPoint, u_first: float, u_last: float, v: float
) -> Borders:
    def number(option: int) -> float:
        return point.option_get_double(option) or 0.0

    mode_u, mode_v = (point.option_get_int(o) for o in (c.CP_OPTION_BORDER_MODE_U, c.CP_OPTION_BORDER_MODE_V))
    begin, end = (point.option_get_double(o) for o in (c.CP_OPTION_SMOOTH_U_BEGIN, c.CP_OPTION_SMOOTH_U_END))
    _, closes, low, high = data.closed_track_data()
    return Borders(
        mode_u=c.BORDER_MODE_EX_KEEP if mode_u is None else mode_u,
        mode_v=c.BORDER_MODE_EX_KEEP if mode_v is None else mode_v,
        offset_u=number(c.CP_OPTION_BORDER_OFFSET_U),
        offset_v=number(c.CP_OPTION_BORDER_OFFSET_V),
        smooth_begin=begin,
        smooth_end=end,
        # At the very end a smoothing zone leaves nothing but the height that it fades to.
        base_begin=0.0 if begin is None else point.uv_to_z(u_first, v),
        base_end=0.0 if end is None else point.uv_to_z(u_last, v),
        close=point.option_get_int(c.CP_OPTION_REF_LINE_CONTINUE) == c.REF_LINE_CLOSE_TRACK,
        close_span=(low, high) if closes else None,
    )


def write_road(road: Road, path: str | os.PathLike[str], comment: str = "") -> None:
    """Write a road as OpenCRG (binary, double precision), to be read back equal.

    OpenCRG readers keep the heights in single precision (60 nm at 1 m). The file appears whole or not at
    all.

    Parameters
    ----------
    road : Road
        What to write.
    path : str or path-like
        The file.
    comment : str
        Text for its header.

    Raises
    ------
    InputError
        The format cannot hold the road.
    WorkError
        The file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from suspension_twin.road import bump_road, half_sine
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_road(bump_road(half_sine(0.9, 0.05)), f"{folder}/bump.crg")
    ...     round(float(load_road(f"{folder}/bump.crg").z.max()), 3)
    0.05
    """
    b = road.borders
    options: dict[str | int, float] = {}
    for key, value, default in (
        ("border_mode_u", b.mode_u, c.BORDER_MODE_EX_KEEP),
        ("border_mode_v", b.mode_v, c.BORDER_MODE_EX_KEEP),
        ("border_offset_u", b.offset_u, 0.0),
        ("border_offset_v", b.offset_v, 0.0),
        ("border_smooth_ubeg", b.smooth_begin, None),
        ("border_smooth_uend", b.smooth_end, None),
        ("refline_continuation", int(b.close), 0),
    ):
        if value is not None and value != default:
            options[key] = value
    slope = np.diff(road.ref_z) / road.u_step
    sloped = bool(np.any(road.ref_z != road.ref_z[0]))
    headings = np.arctan2(np.diff(road.y), np.diff(road.x))
    try:
        with replacing(path) as temporary, _quietly():
            pycrg.write(
                temporary,
                road.z,
                road.u_step,
                road.v,
                phi=road.headings[0] if road.straight else headings,
                u0=road.u_first,
                x0=float(road.x[0]),
                y0=float(road.y[0]),
                z0=float(road.ref_z[0]),
                slope=slope if sloped else None,
                banking=road.bank if road.bank.any() else None,
                fmt="KDBI",
                comment=_comment(comment or f"{road.name}, written by suspension_twin"),
                opts=options or None,
                mods={},
            )
    except ValueError as error:
        raise InputError(road.name, f"does not fit into an OpenCRG file: {_one_line(str(error))}") from error


def _comment(text: str) -> list[str]:
    """Comment lines within OpenCRG's 72 characters, none of which could start a section."""
    lines = (" ".join(line.split()) for line in text.encode("ascii", "replace").decode().splitlines())
    wrapped = (part for line in lines for part in textwrap.wrap(line, 70, break_long_words=True) or [""])
    return [f" {line}" if line.startswith("$") else line for line in wrapped]


@contextmanager
def _quietly() -> Iterator[list[str]]:
    """Collect what the library would log; it warns of things that are said better here."""
    heard: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.WARNING:
            heard.append(_one_line(record.getMessage()))
        return False

    _LOGGER.addFilter(collect)
    try:
        yield heard
    finally:
        _LOGGER.removeFilter(collect)


def _one_line(text: str) -> str:
    return " ".join(text.split())
