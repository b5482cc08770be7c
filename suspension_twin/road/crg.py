# SPDX-License-Identifier: Apache-2.0
"""OpenCRG files: checked strictly, read through the OpenCRG library, written, and the record beside one.

The library takes from a damaged file as much as it can: a number that is none becomes its leading
digits, five bytes lost in the middle become ten thousand wrong heights, a file that refers to
itself ends the process. So every file is read here once against the format description
(ASAM OpenCRG 2.0), strictly, and a fault is refused with the line it stands in.
"""

from __future__ import annotations

import logging
import math
import os
import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pycrg
from pycrg import constants as c

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, shown
from suspension_twin.files import read_bytes, read_json, reader, replacing
from suspension_twin.road.road import Border, Borders, Fade, ReferenceLine, Road

__all__ = [
    "CrgFile",
    "comment_of",
    "examine",
    "load_road",
    "record_path",
    "scan_holes",
    "warning_of",
    "write_road",
]

_LOGGER = logging.getLogger("pycrg")


@reader("an OpenCRG road")
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
    file = examine(path)
    with _quietly() as notes:
        try:
            with pycrg.DataSet.open(path) as data:
                road = _road(path, file, data)
        except (pycrg.OpenCRGError, OSError) as error:
            raise InputError(path, _one_line(str(error))) from error
    return replace(road, notes=tuple(dict.fromkeys(notes)))


def _road(path: Path, file: CrgFile, data: pycrg.DataSet) -> Road:
    grid = data.grid()
    if grid.z.shape[0] != file.rows:
        raise InputError(
            path, "data", f"{file.rows} cross sections, the OpenCRG library read {grid.z.shape[0]}"
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
    u_step = (u_last - u_first) / (grid.z.shape[0] - 1)
    line = ReferenceLine(grid.x, grid.y, grid.ref_z, grid.bank, u_step, headings, u_first)
    return Road(path.name, grid.z, grid.v, line, borders)


def _heading(point: pycrg.ContactPoint, u: float, u_end: float, end: tuple[float, float]) -> float:
    """Direction in which the line goes on beyond one of its ends, asked of the library at u."""
    x, y = point.uv_to_xy(u, 0.0)
    along = math.copysign(1.0, u - u_end)
    seen = math.atan2(along * (y - end[1]), along * (x - end[0]))
    exact = point.uv_to_pk(u, 0.0)[0]
    # The library's figure has all digits but may be the last segment's; then the direction of the line counts.
    return exact if abs(math.remainder(exact - seen, 2.0 * math.pi)) < 1e-9 else seen


def _borders(
    data: pycrg.DataSet, point: pycrg.ContactPoint, u_first: float, u_last: float, v: float
) -> Borders:
    def border(mode: int, offset: int) -> Border:
        chosen = point.option_get_int(mode)
        return Border(
            c.BORDER_MODE_EX_KEEP if chosen is None else chosen, point.option_get_double(offset) or 0.0
        )

    def fade(zone: int, u: float) -> Fade | None:
        length = point.option_get_double(zone)
        # At the very end a smoothing zone leaves nothing but the height that it fades to.
        return None if length is None else Fade(length, point.uv_to_z(u, v))

    _, closes, low, high = data.closed_track_data()
    return Borders(
        u=border(c.CP_OPTION_BORDER_MODE_U, c.CP_OPTION_BORDER_OFFSET_U),
        v=border(c.CP_OPTION_BORDER_MODE_V, c.CP_OPTION_BORDER_OFFSET_V),
        begin=fade(c.CP_OPTION_SMOOTH_U_BEGIN, u_first),
        end=fade(c.CP_OPTION_SMOOTH_U_END, u_last),
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
        The road.
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
    begin, end = (None if fade is None else fade.length for fade in (b.begin, b.end))
    stated = (
        ("border_mode_u", b.u.mode, c.BORDER_MODE_EX_KEEP),
        ("border_mode_v", b.v.mode, c.BORDER_MODE_EX_KEEP),
        ("border_offset_u", b.u.offset, 0.0),
        ("border_offset_v", b.v.offset, 0.0),
        ("border_smooth_ubeg", begin, None),
        ("border_smooth_uend", end, None),
        ("refline_continuation", int(b.close), 0),
    )
    options: dict[str | int, float] = {k: v for k, v, default in stated if v is not None and v != default}
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
            _check_written(road, temporary)
    except ValueError as error:
        raise InputError(road.name, f"does not fit into an OpenCRG file: {_one_line(str(error))}") from error


def _check_written(road: Road, path: Path) -> None:
    """Raise InputError where this package would refuse to read what was written."""
    if not np.isfinite(road.z).any():
        raise InputError(road.name, "not one height: every value is missing")
    try:
        examine(path)
    except InputError as error:
        fault = str(error).removeprefix(f"{path}: ")
        raise InputError(road.name, f"is no road that can be read back: {fault}") from error


def _comment(text: str) -> list[str]:
    """Comment lines within OpenCRG's 72 characters, none of which could start a section."""
    lines = (" ".join(line.split()) for line in text.encode("ascii", "replace").decode().splitlines())
    wrapped = (part for line in lines for part in textwrap.wrap(line, 70, break_long_words=True) or [""])
    return [f" {line}" if line.startswith("$") else line for line in wrapped]


@contextmanager
def _quietly() -> Iterator[list[str]]:
    """Collect the library's log messages, of which this package gives clearer ones."""
    messages: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.WARNING:
            messages.append(_one_line(record.getMessage()))
        return False

    _LOGGER.addFilter(collect)
    try:
        yield messages
    finally:
        _LOGGER.removeFilter(collect)


def _one_line(text: str) -> str:
    return " ".join(text.split())


# Strict reading of the format

_SECTIONS = {
    "$ROAD_CRG_MODS": "mods",
    "$ROAD_CRG_OPTS": "opts",
    "$ROAD_CRG_FILE": "file",
    "$ROAD_CRG_MPRO": "mpro",
    "$ROAD_CRG": "road",
    "$CT": "comment",
    "$KD_DEFINITION": "definition",
    "$$$$": "data",
}
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?")
_FORMATS = {"KRBI": 4, "KDBI": 8, "LRFI": 10, "LDFI": 20}  # bytes or characters of a value
_RECORD = 80
#: Heights, slopes and headings beyond these are no road; bytes out of step look like this.
_PLAUSIBLE = {"long section": 1e4, "phi": 1e3, "banking": 10.0, "slope": 100.0}
#: Points 1 µm apart are finer than any scan; a section spans no more than 10 km across, and steps of 10 km along it
#: leave no road. A file of 1 GiB holds 300 km of the finest scans.
_FINEST, _WIDEST, _LONGEST = 1e-6, 1e4, 1e4
_LARGEST = 1 << 30


@dataclass(frozen=True)
class CrgFile:
    """An examined file: the values of its ``$ROAD_CRG`` header, of its modifiers (None: no such section), its cross
    sections and the share of heights that are missing."""

    road: dict[str, float]
    mods: dict[str, float] | None
    rows: int
    missing: float


@dataclass
class _Header:
    """The header of one file: its ``values`` by section, its data format and channels, the file that it refers to
    for its data, or the byte and the line at which they begin."""

    path: Path
    values: dict[str, dict[str, float]] = field(default_factory=lambda: {"road": {}})
    format: str = ""
    channels: list[str] = field(default_factory=list)
    refers_to: Path | None = None
    data_at: int | None = None
    lines: int = 0

    def fault(self, *parts: str) -> InputError:
        """An error that names the file."""
        return InputError(self.path, *parts)


@reader("an OpenCRG road")
def examine(path: Path) -> CrgFile:
    """Read a file strictly; its data section may stand in a file that it refers to.

    The modifiers are the outer file's where it has such a section. Raises InputError
    naming the file, the line or field, and the fault.
    """
    headers: list[_Header] = []
    here: Path | None = path
    while here is not None:
        if any(here.resolve() == header.path.resolve() for header in headers):
            raise headers[-1].fault("$ROAD_CRG_FILE", f"refers to {here.name[:80]}, which refers back to it")
        raw = _bytes(here)
        header = _read_header(here, raw)
        headers.append(header)
        here = header.refers_to
        if here is not None and not here.is_file():
            raise header.fault("$ROAD_CRG_FILE", f"refers to {str(here)[:200]}, which does not exist")
    if header.data_at is None:
        raise header.fault("no data section (no line of $$$$): not an OpenCRG file, or cut off")
    _check_header(header)
    values = _checked_data(header, raw[header.data_at :])
    sections = [name.startswith("long section") for name in header.channels]
    mods = next((h.values["mods"] for h in headers if "mods" in h.values), None)
    return CrgFile(header.values["road"], mods, values.shape[0], float(np.isnan(values[:, sections]).mean()))


def comment_of(path: Path) -> list[str]:
    """The lines of the comment in the header of a road file."""
    head = _bytes(path).split(b"\n$$$$", 1)[0].decode("latin-1").splitlines()
    begin = next((i + 1 for i, line in enumerate(head) if line.upper().startswith("$CT")), len(head))
    end = next((i for i in range(begin, len(head)) if head[i].startswith("$")), len(head))
    return head[begin:end]


def _bytes(path: Path) -> bytes:
    if not path.exists():
        raise InputError(path, "no such file")
    if path.is_dir():
        raise InputError(path, "is a folder, not an OpenCRG file")
    raw = read_bytes(path, _LARGEST)
    if not raw:
        raise InputError(path, "is empty")
    return raw


def _read_header(path: Path, raw: bytes) -> _Header:
    header = _Header(path)
    section: str | None = None
    reference: str | None = None
    at = 0
    while at < len(raw):
        end = raw.find(b"\n", at)
        end = len(raw) if end < 0 else end
        line = raw[at:end].decode("latin-1").rstrip("\r")
        at, header.lines = end + 1, header.lines + 1
        content = line.split("!", 1)[0].strip()
        if line.startswith("$") and section is not None:
            section = None
        elif line.startswith("$"):
            section = next((s for key, s in _SECTIONS.items() if line.upper().startswith(key)), None)
            if section == "data":
                header.data_at = at
                break
            if section in ("opts", "mods"):
                header.values[section] = {}
        elif section is None:
            if header.lines == 1 and "\0" in line:
                raise header.fault("is not an OpenCRG file: it starts with binary data")
        elif not content or content.startswith("*"):
            continue
        elif section == "file":
            reference = (reference or "") + content.split(" ", 1)[0]
        elif section == "definition":
            _definition(header, content)
        elif section in ("road", "opts", "mods"):
            key, value = _entry(header, content)
            header.values[section][key] = value
    if reference is not None:
        header.refers_to = _resolve(path, reference)
    return header


def _entry(header: _Header, content: str) -> tuple[str, float]:
    key, equals, value = (part.strip() for part in content.partition("="))
    where = f"line {header.lines}"
    if not equals or not key:
        raise header.fault(where, f"expected a line of the form name = number, found {shown(content)}")
    where = f"{where}: {key.lower()[:40]}"
    if not _NUMBER.fullmatch(value):
        raise header.fault(where, f"{shown(value)} is not a number")
    if not math.isfinite(result := _number(value)):
        raise header.fault(where, f"{shown(value)} is too large")
    return key.lower(), result


def _number(text: str) -> float:
    """A number as Fortran writes it, too."""
    return float(text.lower().replace("d", "e"))


def _definition(header: _Header, content: str) -> None:
    where = f"line {header.lines}"
    if content.startswith("#:"):
        header.format = content[2:].strip().upper()[:4]
        if header.format not in _FORMATS:
            raise header.fault(where, f"data format {shown(header.format)} is none of {', '.join(_FORMATS)}")
    elif content[:2].upper() == "D:":
        name = " ".join(content[2:].lower().split())
        if not name.startswith(("long section", "reference line")):
            raise header.fault(where, f"unknown channel {shown(content[2:].strip())}")
        if "," not in name:
            raise header.fault(where, f"channel {shown(content[2:].strip())} has no unit")
        header.channels.append(name)


def _resolve(path: Path, reference: str) -> Path:
    """The file referred to, as the OpenCRG library finds it: from here, else from beside the file."""
    target = Path(os.path.expandvars(reference))
    if target.is_absolute() or target.is_file():
        return target
    return Path(os.path.normpath(path.parent / target))


def _check_header(header: _Header) -> None:
    field = "$KD_DEFINITION"
    if not header.format:
        raise header.fault(field, "names no data format (no line #:KRBI or the like)")
    sections = [name for name in header.channels if name.startswith("long section")]
    if len(sections) < 2:
        raise header.fault(field, f"needs 2 long sections or more, has {len(sections)}")
    placed = [" at v" in name for name in sections]
    if any(placed) and not all(placed):
        raise header.fault(field, "some long sections say their v and some do not")
    if not all(placed):
        _check_increment(header, "long_section_v_increment", _WIDEST / (len(sections) - 1))
    elif not all("=" in name and _NUMBER.search(name.split("=", 1)[1]) for name in sections):
        raise header.fault(field, "a long section's v is not a number")
    # Channels of x, y or u in the data are older than the format; the increment rules.
    _check_increment(header, "reference_line_increment", _LONGEST)


def _check_increment(header: _Header, key: str, most: float) -> None:
    value = header.values["road"].get(key, 0.0)
    if value <= 0.0:
        raise header.fault(key, "must be given and above 0 m")
    if not _FINEST <= value <= most:
        spacing = "far apart" if value > 1.0 else "close"
        raise header.fault(key, f"is {value:g} m: no road has its points so {spacing}")


def _checked_data(header: _Header, payload: bytes) -> Floats:
    """The data (cross sections, channels), NaN where a height is missing."""
    values = (_binary if header.format.startswith("K") else _formatted)(header, payload)
    rows = values.shape[0]
    if rows < 2:
        raise header.fault("data", f"{rows} cross sections; a road needs 2 or more")
    expected = _expected_rows(header)
    if expected is not None and expected != rows:
        raise header.fault(
            "data",
            f"{rows} cross sections where the header (reference_line_start_u, _end_u and "
            f"_increment) says {expected}: cut off or damaged",
        )
    for name, data in zip(header.channels, values.T, strict=True):
        kind = next((k for k in _PLAUSIBLE if k in name), "")
        # The heading and slope of the first cross section are not used and often not given.
        first = 1 if kind in ("phi", "slope") else 0
        used, channel = data[first:], name.split(",")[0]
        unknown = np.flatnonzero(~np.isfinite(used))
        if name.startswith("reference line") and unknown.size:
            raise header.fault("data", f"{channel} has no value in cross section {unknown[0] + first + 1}")
        wild = np.flatnonzero(np.isinf(used) | (np.abs(used) > _PLAUSIBLE.get(kind, 1e9)))
        if wild.size:
            raise header.fault(
                "data",
                f"{channel} is {used[wild[0]]:.4g} in cross section {wild[0] + first + 1}: no road is, the data "
                "are damaged or out of step",
            )
    return values


def _expected_rows(header: _Header) -> int | None:
    road = header.values["road"]
    if "reference_line_end_u" not in road:
        return None
    span = road["reference_line_end_u"] - road.get("reference_line_start_u", 0.0)
    rows = span / road["reference_line_increment"] + 1.0
    if not 2.0 <= rows + 1e-3 < 1e9:
        raise header.fault("reference_line_end_u", f"{rows:.6g} cross sections follow from it")
    return round(rows)


def _binary(header: _Header, payload: bytes) -> Floats:
    size, width = _FORMATS[header.format], len(header.channels)
    rows = _expected_rows(header)
    if rows is None:
        # Without an end the last record is filled with NaN: fewer than a record's worth.
        rows = len(payload) // (size * width)
    exact = rows * width * size
    whole = -(-exact // _RECORD) * _RECORD
    if len(payload) not in (exact, whole):
        missing = (whole if len(payload) < whole else exact) - len(payload)
        fault = f"{missing} bytes are missing" if missing > 0 else f"{-missing} bytes too many"
        raise header.fault(
            "data",
            f"{fault}: {rows} cross sections of {width} values in records of {_RECORD} bytes take {whole} "
            f"bytes, there are {len(payload)}",
        )
    values = np.frombuffer(payload, dtype=f">f{size}", count=rows * width)
    return values.astype(np.float64).reshape(rows, width)


def _formatted(header: _Header, payload: bytes) -> Floats:
    width, count = _FORMATS[header.format], len(header.channels)
    per_line = _RECORD // width
    lines_a_row = -(-count // per_line)
    lines = enumerate(payload.decode("latin-1").splitlines(), start=1 + header.lines)
    numbered = [(number, line) for number, line in lines if line.strip()]
    rows, rest = divmod(len(numbered), lines_a_row)
    if rest:
        fault = f"the last cross section is cut off: {rest} of {lines_a_row} lines"
        raise header.fault(f"line {numbered[-1][0]}", fault)
    values = np.empty((rows, count))
    for i, (number, line) in enumerate(numbered):
        row, part = divmod(i, lines_a_row)
        begin = part * per_line
        here = min(per_line, count - begin)
        if len(line.rstrip()) > here * width:
            raise header.fault(f"line {number}", f"more than {here} values of {width} characters")
        for k in range(here):
            content = line[k * width : (k + 1) * width]
            where = f"line {number}: value {k + 1}"
            if len(content) < width:
                fault = f"cut off: it takes {width} characters, the line has {len(content)} for it"
                raise header.fault(where, fault)
            values[row, begin + k] = _cell(header, where, content)
    return values


def _cell(header: _Header, where: str, content: str) -> float:
    """A value of formatted data; NaN where it is missing."""
    text = content.strip()
    if text.startswith("*"):
        return 0.0 if text == "**unused**" else math.nan
    if not _NUMBER.fullmatch(text):
        raise header.fault(where, f"{shown(content)} is not a number")
    return _number(text)


# The record beside a road file, of the data that it was made from: road.json beside road.crg


def record_path(road: Path) -> Path:
    """Path of the record of a road file."""
    return road.with_suffix(".json")


def scan_holes(road: Path) -> list[dict[str, float]]:
    """Places of a road from a scan where nothing was measured and its file has heights all the same; m."""
    record = _record(road, "scan")
    holes = [] if record is None else record.get("bridged", [])
    keys = {"u_low", "u_high", "v_low", "v_high", "nodes"}
    if not isinstance(holes, list):
        return []
    return [h for h in holes if isinstance(h, dict) and keys <= set(h)]


def _record(road: Path, origin: str) -> dict[str, object] | None:
    try:
        record = read_json(record_path(road))
    except InputError:
        return None
    return record if isinstance(record, dict) and record.get("origin") == origin else None


def warning_of(road: Path) -> str | None:
    """Limits of a comparison on this road in one line; None where there are none."""
    record = _record(road, "drives")
    if record is None:
        return None
    drives = record.get("drives")
    names = ", ".join(str(d.get("name", "?")) for d in (drives if isinstance(drives, list) else []))
    return (
        f"{road.name} was estimated from drives ({names}): it has absorbed whatever of vehicle and sensor was the "
        "same in them; only what changed since shows as a gap"
    )
