# SPDX-License-Identifier: Apache-2.0
"""What is wrong with an OpenCRG file, said before the OpenCRG library sees it.

The library takes what it can from a damaged file: a number that is none becomes its leading
digits, five bytes lost in the middle become ten thousand wrong heights, a file that refers to
itself ends the process. So every file is read here once against the format description
(ASAM OpenCRG 2.0), strictly, and what does not fit is refused with the line it stands in.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from suspension_twin.errors import InputError, shown
from suspension_twin.files import read_bytes

__all__ = ["CrgText", "examine"]

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


@dataclass
class CrgText:
    """What one file says: header values by section, its channels, where its data begin."""

    path: Path
    road: dict[str, float] = field(default_factory=dict)
    opts: dict[str, float] | None = None
    mods: dict[str, float] | None = None
    format: str | None = None
    channels: list[str] = field(default_factory=list)
    refers_to: Path | None = None
    comment: list[str] = field(default_factory=list)
    data_at: int | None = None
    before: int = 0  # lines before the data
    rows: int = 0
    missing: float = 0.0  # share of the heights


def examine(path: Path) -> CrgText:
    """Read a file strictly; its data section may stand in a file that it refers to.

    The options and modifiers are the outer file's where it has such sections. Raises InputError
    naming the file, the line or field, and the fault.
    """
    texts = [_examine_one(path, ())]
    while texts[-1].refers_to is not None:
        seen = tuple(t.path for t in texts)
        texts.append(_examine_one(texts[-1].refers_to, seen))
    inner = texts[-1]
    for outer in reversed(texts[:-1]):
        inner.opts = outer.opts if outer.opts is not None else inner.opts
        inner.mods = outer.mods if outer.mods is not None else inner.mods
    return inner


def _examine_one(path: Path, seen: tuple[Path, ...]) -> CrgText:
    if seen and any(path.resolve() == s.resolve() for s in seen):
        raise InputError(seen[-1], "$ROAD_CRG_FILE", f"refers to {path.name[:80]}, which refers back to it")
    raw = _bytes(path)
    text = _header(path, raw)
    if text.refers_to is not None:
        if not text.refers_to.is_file():
            raise InputError(
                path, "$ROAD_CRG_FILE", f"refers to {str(text.refers_to)[:200]}, which does not exist"
            )
        return text
    if text.data_at is None:
        raise InputError(path, "no data section (no line of $$$$): not an OpenCRG file, or cut off")
    _check_header(text)
    _check_data(text, raw[text.data_at :])
    return text


def _bytes(path: Path) -> bytes:
    if not path.exists():
        raise InputError(path, "no such file")
    if path.is_dir():
        raise InputError(path, "is a folder, not an OpenCRG file")
    raw = read_bytes(path, _LARGEST)
    if not raw:
        raise InputError(path, "is empty")
    return raw


def _header(path: Path, raw: bytes) -> CrgText:
    text = CrgText(path)
    section: str | None = None
    reference = ""
    at = 0
    number = 0
    while at < len(raw):
        end = raw.find(b"\n", at)
        end = len(raw) if end < 0 else end
        line = raw[at:end].decode("latin-1").rstrip("\r")
        at, number = end + 1, number + 1
        if section is not None and line.startswith("$"):
            if section == "file":
                text.refers_to = _resolve(path, reference)
            section = None
            continue
        if section is None:
            if line.startswith("$"):
                section = next((s for key, s in _SECTIONS.items() if line.upper().startswith(key)), None)
                if section == "data":
                    text.data_at, text.before = at, number
                    return text
                if section == "opts":
                    text.opts = {}
                elif section == "mods":
                    text.mods = {}
            elif number == 1 and "\0" in line:
                raise InputError(path, "is not an OpenCRG file: it starts with binary data")
            continue
        if section == "comment":
            text.comment.append(line)
            continue
        content = line.split("!", 1)[0].strip()
        if not content or content.startswith("*"):
            continue
        if section == "file":
            reference += content.split(" ", 1)[0]
        elif section == "definition":
            _definition(text, content, number)
        elif section in ("road", "opts", "mods"):
            key, value = _entry(path, content, number)
            target = {"road": text.road, "opts": text.opts, "mods": text.mods}[section]
            assert target is not None
            target[key] = value
    if section == "file" and reference:
        text.refers_to = _resolve(path, reference)
    return text


def _entry(path: Path, content: str, number: int) -> tuple[str, float]:
    key, equals, value = (part.strip() for part in content.partition("="))
    where = f"line {number}"
    if not equals or not key:
        raise InputError(path, where, f"expected a line of the form name = number, found {shown(content)}")
    if not _NUMBER.fullmatch(value):
        raise InputError(path, f"{where}: {key.lower()[:40]}", f"{shown(value)} is not a number")
    result = float(value.lower().replace("d", "e"))
    if not np.isfinite(result):
        raise InputError(path, f"{where}: {key.lower()[:40]}", f"{shown(value)} is too large")
    return key.lower(), result


def _definition(text: CrgText, content: str, number: int) -> None:
    where = f"line {number}"
    if content.startswith("#:"):
        text.format = content[2:].strip().upper()[:4]
        if text.format not in _FORMATS:
            raise InputError(
                text.path, where, f"data format {shown(text.format)} is none of {', '.join(_FORMATS)}"
            )
    elif content[:2].upper() == "D:":
        name = " ".join(content[2:].lower().split())
        if not name.startswith(("long section", "reference line")):
            raise InputError(text.path, where, f"unknown channel {shown(content[2:].strip())}")
        if "," not in name:
            raise InputError(text.path, where, f"channel {shown(content[2:].strip())} has no unit")
        text.channels.append(name)


def _resolve(path: Path, reference: str) -> Path:
    """The file referred to, as the OpenCRG library finds it: from here, else from beside the file."""
    target = Path(os.path.expandvars(reference))
    if target.is_absolute() or target.is_file():
        return target
    return Path(os.path.normpath(path.parent / target))


def _check_header(text: CrgText) -> None:
    if text.format is None:
        raise InputError(text.path, "$KD_DEFINITION", "names no data format (no line #:KRBI or the like)")
    sections = [c for c in text.channels if c.startswith("long section")]
    if len(sections) < 2:
        raise InputError(text.path, "$KD_DEFINITION", f"needs 2 long sections or more, has {len(sections)}")
    placed = [" at v" in c for c in sections]
    if any(placed) and not all(placed):
        raise InputError(text.path, "$KD_DEFINITION", "some long sections say their v and some do not")
    if all(placed):
        positions = [_NUMBER.search(c.split("=", 1)[-1]) for c in sections]
        if any("=" not in c or p is None for c, p in zip(sections, positions, strict=True)):
            raise InputError(text.path, "$KD_DEFINITION", "a long section's v is not a number")
    else:
        _check_increment(text, "long_section_v_increment", _WIDEST / (len(sections) - 1))
    # Channels of x, y or u in the data are older than the format; the increment rules.
    _check_increment(text, "reference_line_increment", _LONGEST)


def _check_increment(text: CrgText, key: str, most: float) -> None:
    value = text.road.get(key, 0.0)
    if value <= 0.0:
        raise InputError(text.path, key, "must be given and above 0 m")
    if not _FINEST <= value <= most:
        spacing = "far apart" if value > 1.0 else "close"
        raise InputError(text.path, key, f"is {value:g} m: no road has its points so {spacing}")


def _check_data(text: CrgText, payload: bytes) -> None:
    assert text.format is not None
    if text.format.startswith("K"):
        values = _binary(text, payload)
    else:
        values = _formatted(text, payload)
    text.rows = values.shape[0]
    if text.rows < 2:
        raise InputError(text.path, "data", f"{text.rows} cross sections; a road needs 2 or more")
    sections = [name.startswith("long section") for name in text.channels]
    text.missing = float(np.isnan(values[:, sections]).mean())
    expected = _expected_rows(text)
    if expected is not None and expected != text.rows:
        raise InputError(
            text.path,
            "data",
            f"{text.rows} cross sections where the header (reference_line_start_u, _end_u and "
            f"_increment) says {expected}: cut off or damaged",
        )
    for column, name in enumerate(text.channels):
        kind = next((k for k in _PLAUSIBLE if k in name), "")
        limit = _PLAUSIBLE.get(kind, 1e9)
        data = values[:, column]
        # The heading and slope of the first cross section are not used and often not given.
        used = data[1:] if kind in ("phi", "slope") else data
        if name.startswith("reference line") and not np.isfinite(used).all():
            row = int(np.flatnonzero(~np.isfinite(used))[0]) + (data.size - used.size)
            raise InputError(
                text.path, "data", f"{name.split(',')[0]} has no value in cross section {row + 1}"
            )
        wild = np.isinf(used) | (np.abs(used) > limit)
        if wild.any():
            row = int(np.flatnonzero(wild)[0]) + (data.size - used.size)
            raise InputError(
                text.path,
                "data",
                f"{name.split(',')[0]} is {data[row]:.4g} in cross section {row + 1}: no road is, the data "
                "are damaged or out of step",
            )


def _expected_rows(text: CrgText) -> int | None:
    road = text.road
    if "reference_line_end_u" not in road:
        return None
    span = road["reference_line_end_u"] - road.get("reference_line_start_u", 0.0)
    rows = span / road["reference_line_increment"] + 1.0
    if not 2.0 <= rows + 1e-3 < 1e9:
        raise InputError(text.path, "reference_line_end_u", f"{rows:.6g} cross sections follow from it")
    return round(rows)


def _binary(text: CrgText, payload: bytes) -> NDArray[np.float64]:
    assert text.format is not None
    size = _FORMATS[text.format]
    width = len(text.channels)
    rows = _expected_rows(text)
    if rows is None:
        # Without an end the last record is filled with NaN: fewer than a record's worth.
        rows = len(payload) // (size * width)
    exact = rows * width * size
    whole = -(-exact // _RECORD) * _RECORD
    if len(payload) not in (exact, whole):
        missing = (whole if len(payload) < whole else exact) - len(payload)
        fault = f"{missing} bytes are missing" if missing > 0 else f"{-missing} bytes too many"
        raise InputError(
            text.path,
            "data",
            f"{fault}: {rows} cross sections of {width} values in records of {_RECORD} bytes take {whole} "
            f"bytes, there are {len(payload)}",
        )
    dtype = ">f4" if size == 4 else ">f8"
    values = np.frombuffer(payload, dtype=dtype, count=rows * width).astype(np.float64)
    return values.reshape(rows, width)


def _formatted(text: CrgText, payload: bytes) -> NDArray[np.float64]:
    assert text.format is not None
    width = _FORMATS[text.format]
    count = len(text.channels)
    per_line = _RECORD // width
    lines_a_row = -(-count // per_line)
    first_line = 1 + text.before
    lines = payload.decode("latin-1").splitlines()
    numbered = [(first_line + i, line) for i, line in enumerate(lines) if line.strip()]
    rows, rest = divmod(len(numbered), lines_a_row)
    if rest:
        raise InputError(
            text.path,
            f"line {numbered[-1][0]}",
            f"the last cross section is cut off: {rest} of {lines_a_row} lines",
        )
    values = np.empty((rows, count))
    for i, (number, line) in enumerate(numbered):
        row, part = divmod(i, lines_a_row)
        begin = part * per_line
        here = min(per_line, count - begin)
        fields = [line[k * width : (k + 1) * width] for k in range(here)]
        if len(line.rstrip()) > here * width:
            raise InputError(text.path, f"line {number}", f"more than {here} values of {width} characters")
        for k, content in enumerate(fields):
            stripped = content.strip()
            where = f"line {number}: value {k + 1}"
            if len(content) < width:
                fault = f"cut off: it takes {width} characters, the line has {len(content)} for it"
                raise InputError(text.path, where, fault)
            if stripped.startswith("*"):
                values[row, begin + k] = 0.0 if stripped == "**unused**" else np.nan
            elif _NUMBER.fullmatch(stripped):
                values[row, begin + k] = float(stripped.lower().replace("d", "e"))
            else:
                raise InputError(text.path, where, f"{shown(content)} is not a number")
    return values
