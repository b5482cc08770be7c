# SPDX-License-Identifier: Apache-2.0
"""Longitudinal profiles: lines of heights along a road, read from CSV and ERD files and made into a road.

ERD (University of Michigan, Engineering Research Division): the header is text: ``ERDFILEV2.00``; a line of the
numbers of channels, samples, records and bytes, the kind of the data, and the step; lines that begin with a keyword
of eight characters, one of ``&1000`` going on with the line before; ``END``. Text data follow. Binary data (2-byte
integers, kind 0, or 4-byte floats, kind 1; all channels of a sample together) follow too, or lie in a file
of the same name with ``.bin`` added.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError
from suspension_twin.files import read_bytes, reader
from suspension_twin.road.build import grid_road
from suspension_twin.road.road import Road

__all__ = ["UNITS", "Profile", "profile_road", "read_profile", "together", "unit_of"]

#: m for one unit of length.
UNITS: dict[str, float] = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "km": 1e3,
    "in": 0.0254,
    "mil": 2.54e-5,
    "ft": 0.3048,
    "yd": 0.9144,
    "mi": 1609.344,
}
_ALIASES: dict[str, str] = {
    "metre": "m",
    "metres": "m",
    "meter": "m",
    "meters": "m",
    "inch": "in",
    "inches": "in",
    '"': "in",
    "feet": "ft",
    "foot": "ft",
    "'": "ft",
    "mils": "mil",
    "miles": "mi",
    "mile": "mi",
    "µm": "um",
    "μm": "um",
}
_LARGEST = 1 << 30  # bytes of a file
#: Bytes that a height takes until its road is written: up to three long sections, and copies of them.
_SAMPLE = 64
#: A wheel path is as high as its line this far to its left and right, m: a tyre's width and the driver's wander.
_HELD = 0.35


@dataclass(frozen=True, eq=False)
class Profile:
    """Lines along a road: ``z`` (lines, n) m every ``step`` m, their ``names``, and ``v`` m of each, if known."""

    name: str
    step: float
    z: Floats
    names: tuple[str, ...]
    v: tuple[float, ...] | None = None

    @property
    def length(self) -> float:
        """m from the first to the last point."""
        return self.step * (int(self.z.shape[1]) - 1)


def unit_of(text: str, source: Path, field: str) -> float:
    """m for one of a unit of length, by its name; raises InputError for another unit."""
    metres = _metres(text)
    if metres is None:
        raise InputError(source, field, f"{text.strip()!r} is not a length; known are {', '.join(UNITS)}")
    return metres


def _metres(text: str) -> float | None:
    word = text.strip().strip(".").lower()
    return UNITS.get(_ALIASES.get(word, word))


@reader("a profile")
def read_profile(path: Path, unit: str | None = None) -> Profile:
    """Read a profile file: ERD by its first line, otherwise CSV.

    Parameters
    ----------
    path : Path
        The file. CSV: the distance, then the heights of one line or more; comma, semicolon, tab or
        blanks between; a heading may name the columns, with a unit in brackets.
    unit : str, optional
        Unit of the heights where the file names none (m).

    Returns
    -------
    Profile
        Evenly spaced, heights in m.

    Raises
    ------
    InputError
        The file cannot be read as a profile; the line names the fault.

    Examples
    --------
    >>> import tempfile
    >>> from suspension_twin.files import write_text
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "a.csv"
    ...     write_text(file, "distance [m],left [mm],right [mm]\\n" + "\\n".join(f"{i},{i},0" for i in range(9)))
    ...     read_profile(file).z[:, 3].round(6).tolist()
    [0.003, 0.0]
    """
    raw = read_bytes(path, _LARGEST)
    if raw[:3].upper() == b"ERD":
        return _read_erd(path, raw)
    if raw[:4] == b"PPF\x00" or path.suffix.lower() == ".ppf":
        raise InputError(path, "PPF (ASTM E2560) is not read; export it from ProVAL as ERD")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "neither ERD nor a text file") from None
    return _read_csv(path, text, unit)


def _read_csv(path: Path, text: str, unit: str | None) -> Profile:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(path, "is empty")
    # A decimal comma goes with semicolons; blanks separate where nothing else does.
    mark = next((m for m in (";", "\t", ",") if m in lines[-1]), None)
    rows = (
        list(csv.reader(io.StringIO("\n".join(lines)), delimiter=mark))
        if mark
        else [s.split() for s in lines]
    )
    comma = mark == ";" and any("," in cell for cell in rows[-1])
    numbers = [[_csv_number(cell.replace(",", ".") if comma else cell) for cell in row] for row in rows]
    head = [cell.strip() for cell in rows[0]] if None in numbers[0] else []
    first = 1 if head else 0
    width = len(head or numbers[0])
    if width < 2 or len(numbers) - first < 2:
        raise InputError(path, "needs a column of distances, one of heights or more, and two rows or more")
    for i, row in enumerate(numbers[first:], start=first):
        if len(row) != width:
            raise InputError(path, f"row {i + 1}", f"has {len(row)} columns instead of {width}")
        if None in row:
            j = row.index(None)
            raise InputError(path, f"row {i + 1}, column {j + 1}", f"{rows[i][j].strip()!r} is not a number")
    names, scales = _columns(path, head or ["distance", *[f"line {j}" for j in range(1, width)]], unit)
    table = np.array(numbers[first:], dtype=np.float64) * scales
    places = [re.fullmatch(r"v?\s*=?\s*([-+]?\d+(?:\.\d*)?)(?:\s*m)?", name) for name in names[1:]]
    v = tuple(float(p[1]) for p in places if p) if head and all(places) else None
    return replace(_even(path, table[:, 0], table[:, 1:].T), names=tuple(names[1:]), v=v)


def _csv_number(cell: str) -> float | None:
    """A cell as a number, NaN where it is empty, None where it is another word."""
    try:
        return float(cell) if cell.strip() else math.nan
    except ValueError:
        return None


def _columns(path: Path, head: Sequence[str], unit: str | None) -> tuple[list[str], Floats]:
    """Names without their units, and m for one of each column."""
    fallback = 1.0 if unit is None else unit_of(unit, path, "--unit")
    names, scales = [], []
    for j, cell in enumerate(head):
        found = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*)\s*[\])]\s*", cell)
        names.append((found[1] if found else cell).strip())
        known = unit_of(found[2], path, f"column {cell!r}") if found else (1.0 if j == 0 else fallback)
        scales.append(known)
    return names, np.array(scales)


def _even(path: Path, s: Floats, z: Floats) -> Profile:
    """Lines (lines, n) over rising distances, on even steps."""
    if not np.isfinite(s).all():
        raise InputError(path, "distance", "is missing in a row")
    step = np.diff(s)
    if not (step > 0.0).all():
        i = int(np.flatnonzero(~(step > 0.0))[0])
        raise InputError(path, "distance", f"must rise; after {s[i]:g} m comes {s[i + 1]:g} m")
    if np.isinf(z).any() or np.isnan(z).all():
        raise InputError(path, "heights", "none that is finite" if np.isnan(z).all() else "one is infinite")
    typical = float(np.median(step))
    if float(np.ptp(step)) <= 2e-3 * typical:
        return Profile(path.name, float(s[-1] - s[0]) / (s.size - 1), z, ())
    # Uneven: the finest of the usual steps, linear between the points of each line.
    fine = float(np.quantile(step, 0.1))
    Budget(path, z.nbytes).take(int(_SAMPLE * z.shape[0] * min(np.ptp(s) / fine, 1e15)))
    at = np.arange(s[0], s[-1] + 1e-9, fine)
    lines = []
    for line in z:
        good = np.isfinite(line)
        if good.sum() < 2:
            raise InputError(path, "heights", "a line has fewer than two")
        lines.append(np.interp(at, s[good], line[good]))
    return Profile(path.name, fine, np.array(lines), ())


# ERD files

_ERD_TEXT = 5
_ERD_KINDS = {0: "<i2", 1: "<f4"}
_ERD_WIDTHS = {"SHORTNAM": 8, "UNITSNAM": 8, "LONGNAME": 32, "GENNAME": 32}


def _read_erd(path: Path, raw: bytes) -> Profile:
    """The channels of an ERD file that are heights, in m; raises InputError."""
    if not raw.upper().startswith(b"ERDFILEV2.00"):
        raise InputError(path, "line 1", "ERDFILEV2.00 is read, this is another version")
    end = re.search(rb"(?m)^END[ \t]*\r?\n", raw)
    if end is None:
        raise InputError(path, "has no line END after its header")
    header = raw[: end.start()].decode("latin-1").splitlines()
    channels, samples, kind, step = _erd_sizes(path, header)
    words = _erd_keywords(header[2:])
    body = raw[end.end() :]
    beside = path.with_name(path.name + ".bin")
    if kind != _ERD_TEXT and not body.strip() and beside.is_file():
        body = read_bytes(beside, _LARGEST)
    values = _erd_data(path, body, channels, kind)
    if samples > 0 and values.shape[0] != samples:
        raise InputError(path, "data", f"{values.shape[0]} samples, the header says {samples}")
    gains, offsets = (_erd_numbers(path, words, key, channels) for key in ("GAINS", "OFFSETS"))
    values = values * (1.0 if gains is None else gains) + (0.0 if offsets is None else offsets)
    names = _erd_fields(words.get("LONGNAME") or words.get("SHORTNAM", ""), 32 if "LONGNAME" in words else 8)
    names = [*names, *[f"channel {i + 1}" for i in range(len(names), channels)]][:channels]
    units = [*_erd_fields(words.get("UNITSNAM", ""), 8), *["m"] * channels][:channels]
    along = unit_of(words.get("XUNITS", "").strip() or "m", path, "XUNITS")
    # other channels are slopes, accelerations, speeds
    heights = {i: scale for i, unit in enumerate(units) if (scale := _metres(unit or "m")) is not None}
    if not heights:
        raise InputError(path, "UNITSNAM", f"no channel is a height: {', '.join(units)}")
    z = np.array([values[:, i] * scale for i, scale in heights.items()])
    if not np.isfinite(z).all():
        raise InputError(path, "data", "hold a value that is not finite")
    return Profile(path.name, step * along, z, tuple(names[i] for i in heights))


def _erd_sizes(path: Path, header: list[str]) -> tuple[int, int, int, float]:
    """Channels, samples, kind of data, and step."""
    parts = re.split(r"[,\s]+", header[1].strip().rstrip(",")) if len(header) > 1 else []
    try:
        channels, samples, kind, step = int(parts[0]), int(parts[1]), int(parts[4]), float(parts[5])
    except (ValueError, IndexError):
        raise InputError(
            path, "line 2", "needs numbers of channels, samples, records, bytes, kind, step"
        ) from None
    if channels < 1 or not (np.isfinite(step) and step > 0.0):
        raise InputError(path, "line 2", f"{channels} channels with a step of {step:g}")
    if kind not in (*_ERD_KINDS, _ERD_TEXT):
        raise InputError(
            path, "line 2", f"data of kind {kind}; read are 0 (2-byte integers), 1 (floats), 5 (text)"
        )
    return channels, samples, kind, step


def _erd_keywords(lines: list[str]) -> dict[str, str]:
    words: dict[str, str] = {}
    last = ""
    for line in lines:
        key, rest = line[:8].strip().upper(), line[8:]
        if key.startswith("&") and last:
            words[last] += rest
        elif key:
            last = key
            words[key] = rest
            if key in _ERD_WIDTHS:
                # A field may be cut off at the end of its line.
                words[key] = rest.ljust(-(-len(rest) // _ERD_WIDTHS[key]) * _ERD_WIDTHS[key])
    return words


def _erd_fields(text: str, width: int) -> list[str]:
    return [text[i : i + width].strip() for i in range(0, len(text.rstrip()), width)]


def _erd_numbers(path: Path, words: dict[str, str], key: str, channels: int) -> Floats | None:
    if key not in words:
        return None
    try:
        values = np.array([float(part) for part in re.split(r"[,\s]+", words[key].strip(" ,"))])
    except ValueError:
        raise InputError(path, key, f"{words[key].strip()!r} are not numbers") from None
    if values.size != channels:
        raise InputError(path, key, f"{values.size} numbers for {channels} channels")
    return values


def _erd_data(path: Path, body: bytes, channels: int, kind: int) -> Floats:
    """The samples (n, channels) of text or binary data."""
    if kind == _ERD_TEXT:
        try:
            flat = np.array(body.replace(b",", b" ").split(), dtype=np.float64)
        except ValueError:
            raise InputError(path, "data", "hold a word that is not a number") from None
    else:
        dtype = np.dtype(_ERD_KINDS[kind])
        if len(body) % dtype.itemsize:
            raise InputError(path, "data", f"{len(body)} bytes are no whole number of values")
        flat = np.frombuffer(body, dtype=dtype).astype(np.float64)
    if flat.size < 2 * channels or flat.size % channels:
        raise InputError(path, "data", f"{flat.size} values for {channels} channels")
    return flat.reshape(-1, channels)


# A road of profiles


def together(profiles: Sequence[Profile]) -> Profile:
    """The lines of several files of the same step, side by side, as long as the shortest; raises InputError."""
    first = profiles[0]
    if len(profiles) == 1:
        return first
    for other in profiles[1:]:
        if not math.isclose(other.step, first.step, rel_tol=1e-3):
            raise InputError(other.name, f"has a step of {other.step:g} m, {first.name} of {first.step:g} m")
    count = min(p.z.shape[1] for p in profiles)
    places = [p.v for p in profiles]
    v = None if any(p is None for p in places) else tuple(at for p in places if p is not None for at in p)
    single = all(p.z.shape[0] == 1 for p in profiles)
    names = [Path(p.name).stem for p in profiles] if single else [name for p in profiles for name in p.names]
    return Profile(first.name, first.step, np.vstack([p.z[:, :count] for p in profiles]), tuple(names), v)


def profile_road(
    profile: Profile,
    *,
    track: float = 1.5,
    width: float = 4.0,
    v: Sequence[float] | None = None,
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
) -> Road:
    """A straight road of a profile.

    Parameters
    ----------
    profile : Profile
        One line: the same across the whole road. Two: the left and the right wheel path, in that
        order or as their names say. More: at the places ``v`` or that the file gives.
    track : float
        Distance of the two wheel paths in m.
    width : float
        Of the road in m; beyond the outermost lines their heights are held.
    v : sequence of float, optional
        Lateral place of each line in m, positive to the left.
    x, y, heading : float
        Start in ``map`` in m, and direction in rad.

    Returns
    -------
    Road
        Each of two wheel paths is level across 0.35 m on both sides of its line, and the road
        linear between them.

    Raises
    ------
    InputError
        The places do not fit the lines.

    Examples
    --------
    >>> import numpy as np
    >>> road = profile_road(Profile("a", 0.1, np.array([[0.0, 0.0], [0.02, 0.02]]), ("left", "right")))
    >>> road.heights_uv(0.0, [1.0, 0.0, -1.0]).round(3).tolist()
    [0.0, 0.01, 0.02]
    """
    z = profile.z
    count = z.shape[0]
    places = _places(profile, track, v)
    if not width > 0.0:
        raise InputError(profile.name, "width", f"must be above 0 m, is {width}")
    order = np.argsort(places)
    at, lines = np.array(places)[order], z[order]
    half = 0.5 * width
    if count == 1:
        grid, heights = np.array([-half, half]), np.repeat(lines, 2, axis=0)
    else:
        if (np.diff(at) <= 0.0).any():
            raise InputError(profile.name, "v", "two lines lie at the same place")
        if count == 2:
            held = min(_HELD, 0.4 * float(at[1] - at[0]))
            spread = np.array([-held, held])
            grid, heights = (at[:, None] + spread).ravel(), np.repeat(lines, 2, axis=0)
        else:
            grid, heights = at, lines
        low, high = int(-half < grid[0] - 1e-6), int(half > grid[-1] + 1e-6)
        grid = np.concatenate([[-half] * low, grid, [half] * high])
        heights = np.concatenate([heights[:1]] * low + [heights] + [heights[-1:]] * high)
    return grid_road(heights.T, profile.step, grid, x=x, y=y, heading=heading, name=profile.name)


def _places(profile: Profile, track: float, v: Sequence[float] | None) -> list[float]:
    """v of each line in m."""
    count = profile.z.shape[0]
    given = profile.v if v is None else tuple(v)
    if given is not None:
        if len(given) != count:
            raise InputError(profile.name, "--v", f"{len(given)} places for {count} lines")
        return list(given)
    if count == 1:
        return [0.0]
    sides = {"l": 0.5, "c": 0.0, "m": 0.0, "r": -0.5}
    named = [sides.get(name[:1].lower()) for name in profile.names]
    words = [side for side in named if side is not None]
    plain = all(re.match(r"l[^i]|r|c|m", name.lower()) for name in profile.names)
    if plain and len(words) == count and len(set(words)) == count:
        return [track * side for side in words]
    if count == 2:
        return [0.5 * track, -0.5 * track]
    raise InputError(
        profile.name, f"{count} lines ({', '.join(profile.names)}): --v says where each of them lies across"
    )
