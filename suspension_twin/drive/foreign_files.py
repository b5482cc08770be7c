# SPDX-License-Identifier: Apache-2.0
"""Files that other programs wrote: folders and archives, tables of text, NumPy arrays."""

from __future__ import annotations

import csv
import math
import re
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import IO, Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError, shown
from suspension_twin.files import open_file, read_bytes, reading

__all__ = ["DataTable", "RecordedFiles", "number", "read_array", "read_table"]

_LARGEST: Final = 2 << 30  # bytes of one file
_MOST_FILES: Final = 20_000
_PIECE: Final = 1 << 20  # bytes of a member of an archive that are unpacked at a time
_ITEM: Final = 48  # bytes of memory that a line of text, a list or an object takes beside its characters


def _decode_text(data: bytes) -> tuple[str, bool]:
    """Text of a file in UTF-8 or, by its mark, UTF-16; whether it had to be read as Latin-1."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", "replace"), False
    try:
        return data.decode("utf-8-sig"), False
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace"), True


class RecordedFiles:
    """The files of one recording as the user named it: a file, a folder or a zip archive.

    ``names`` are relative to it, with ``/``; of a single file, its name. Archives made on a Mac carry a shadow of each
    file, and some wrap everything in a folder: neither shows here. ``unread`` are those that nobody has read yet.
    """

    def __init__(self, path: str | Path) -> None:
        """Raises InputError if there is nothing at ``path`` or the archive is damaged."""
        self.path = Path(path)
        self._archive: zipfile.ZipFile | None = None
        self._budget = Budget(self.path, 0)
        with reading(self.path, "a recording"):
            if self.path.is_dir():
                self._members = self._folder()
            else:
                members = self._zip()
                self._members = self._file() if members is None else members
        self.unread = dict.fromkeys(self._members)
        if len(self._members) > _MOST_FILES:
            raise InputError(self.path, f"holds more than {_MOST_FILES} files: name one recording")

    def _folder(self) -> Mapping[str, str | Path]:
        members: dict[str, str | Path] = {}
        for path in sorted(self.path.rglob("*")):
            name = path.relative_to(self.path).as_posix()
            if path.is_file() and not _shadow(name):
                members[name] = path
            if len(members) > _MOST_FILES:
                break
        return members

    def _zip(self) -> Mapping[str, str | Path] | None:
        """Names of an archive's members; None where it is no archive."""
        file = open_file(self.path)
        try:
            if not zipfile.is_zipfile(file):
                file.close()
                return None
            self._archive = zipfile.ZipFile(file)
        except zipfile.BadZipFile:
            file.close()
            raise InputError(self.path, "the zip archive is damaged") from None
        self._budget = Budget(self.path, self.path.stat().st_size)
        entries = self._archive.infolist()
        names = [i.filename for i in entries if not i.is_dir() and not _shadow(i.filename)]
        wrapped = len({name.split("/", 1)[0] for name in names}) == 1 and all("/" in name for name in names)
        return {name.split("/", 1)[1] if wrapped else name: name for name in names}

    def _file(self) -> Mapping[str, str | Path]:
        with open_file(self.path) as file:
            if file.read(4) == b"PK\x03\x04":
                raise InputError(self.path, "the zip archive is cut off: copy it again")
        return {self.path.name: self.path}

    @property
    def name(self) -> str:
        """Name of the recording, without the archive's or file's ending."""
        return self.path.name if self.path.is_dir() else self.path.stem

    @property
    def names(self) -> list[str]:
        """Every file, relative to the recording."""
        return list(self._members)

    def find(self, *wanted: str) -> str | None:
        """The first of the names that there is, whatever its case, at any depth (the least deep)."""
        for name in map(str.lower, wanted):
            hits = [m for m in self._members if m.lower() == name or m.lower().endswith("/" + name)]
            if hits:
                return min(hits, key=lambda m: m.count("/"))
        return None

    def label(self, name: str) -> str:
        """How an error names one of the files."""
        return str(self.path) if self.path.name == name else f"{self.path}/{name}"

    def read(self, name: str) -> bytes:
        """Content of one file; InputError if it cannot be read, TooLarge if it unpacks to more than it may."""
        self.unread.pop(name, None)
        if isinstance(path := self._members[name], Path):
            return read_bytes(path, _LARGEST)
        pieces = []
        with (
            reading(self.label(name), "a file of an archive (or it is encrypted)"),
            self._open(name) as entry,
        ):
            while piece := entry.read(_PIECE):
                self._budget.take(len(piece) + _ITEM * sum(map(piece.count, (b"\n", b"[", b"{"))))
                pieces.append(piece)
        return b"".join(pieces)

    def text(self, name: str) -> str:
        """Content of one text file."""
        return _decode_text(self.read(name))[0]

    def head(self, name: str, size: int = 4096) -> bytes:
        """The first bytes of one file, empty if it cannot be read (used to recognise a format)."""
        try:
            with reading(self.label(name), "a file"), self._open(name) as entry:
                return entry.read(size)
        except InputError:
            return b""

    def _open(self, name: str) -> IO[bytes]:
        member = self._members[name]
        if isinstance(member, Path):
            return open_file(member)
        assert self._archive is not None
        return self._archive.open(member)


def _shadow(name: str) -> bool:
    parts = PurePosixPath(name).parts
    return "__MACOSX" in parts or parts[-1].startswith("._") or parts[-1] == ".DS_Store"


# Tables of text

_NUMBER: Final = re.compile(
    r"\s*([-+]?(\d+([.,]\d*)?|[.,]\d+)(e[-+]?\d+)?|[-+]?(nan|inf(inity)?))\s*$", re.IGNORECASE
)
_COMMA_NUMBER: Final = re.compile(r"^\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*$")
_SAMPLE_LINES: Final = 50
_LONGEST: Final = 1 << 18  # characters of a line
_ARRAY_MAGIC: Final = b"\x93NUMPY"


@dataclass
class DataTable:
    """Columns of one file, of text or, where every field of it is one, of numbers (rows, columns).

    ``label`` names it in errors; ``lines`` are those that ``values`` were parsed from, if any.
    """

    label: str
    names: list[str]
    columns: list[tuple[str, ...]] = field(default_factory=list)
    decimal_comma: bool = False
    values: Floats | None = None
    lines: Sequence[str] = ()
    delimiter: str = ","
    warnings: list[str] = field(default_factory=list)

    @property
    def rows(self) -> int:
        """Number of rows."""
        if self.values is not None:
            return int(self.values.shape[0])
        return len(self.columns[0]) if self.columns else 0

    def index(self, key: str | int) -> int:
        """Number of the column of this name (whatever its case) or number; InputError if none."""
        if isinstance(key, int):
            width = len(self.columns) if self.values is None else int(self.values.shape[1])
            if not 0 <= key < width:
                raise InputError(self.label, f"column {key}", f"there are {width}, counted from 0")
            return key
        names = [name.casefold() for name in self.names]
        if (wanted := key.strip().casefold()) in names:
            return names.index(wanted)
        known = _some(self.names) if self.names else "none: the file has no header, give numbers from 0"
        raise InputError(self.label, f"column {key}", f"is not there; the columns are {known}")

    def has(self, *keys: str) -> bool:
        """Whether all of these columns are there, whatever their case."""
        return {key.casefold() for key in keys} <= {name.casefold() for name in self.names}

    def text(self, key: str | int) -> tuple[str, ...]:
        """A column as it stands."""
        i = self.index(key)
        if not self.columns and not self.lines:
            raise InputError(self.label, f"column {key}", "an array of numbers holds no text")
        if not self.columns:
            self.columns = list(zip(*_split(self.lines, self.delimiter), strict=True))
        return self.columns[i]

    def numbers(self, key: str | int) -> Floats:
        """A column as numbers (rows,); NaN where a field is empty or no number."""
        if self.values is not None:
            return self.values[:, self.index(key)]
        column = self.text(key)
        if self.decimal_comma:
            column = tuple(value.replace(",", ".") for value in column)
        try:
            return np.array(column, dtype=np.float64)
        except ValueError:
            return np.array([number(value) for value in column], dtype=np.float64)

    def numbers_or_nan(self, key: str) -> Floats:
        """As :meth:`numbers`; all NaN where there is no such column."""
        return self.numbers(key) if self.has(key) else np.full(self.rows, np.nan)

    def vector(self, keys: Sequence[str | int]) -> Floats:
        """Columns side by side (rows, len(keys))."""
        return np.stack([self.numbers(key) for key in keys], axis=1)


def _some(names: Sequence[str]) -> str:
    """Names to choose from, the first of many."""
    more = f" and {len(names) - 40} more" if len(names) > 40 else ""
    return ", ".join(name[:40] for name in names[:40]) + more


def number(text: str) -> float:
    """A field as a number, NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def read_table(
    data: bytes,
    label: str,
    *,
    header: bool | int | None = None,
    delimiter: str | None = None,
    decimal: str | None = None,
    comment: str = "#",
) -> DataTable:
    """Parse one file.

    ``header``: True if the first row names the columns, False if there are no names, a number of lines of the file,
    empty ones too, to skip before the row of names, None to see (a NumPy array has none). ``delimiter`` and ``decimal``
    are recognised where None. Rows of another width than the table (a first or last line that is partial) are
    dropped and counted. Raises InputError if there is no table.
    """
    if data.startswith(_ARRAY_MAGIC):
        return DataTable(label, [], values=read_array(data, label))
    with reading(label, "a table"):
        text, legacy = _decode_text(data)
        if isinstance(header, int) and not isinstance(header, bool):
            text, header = "\n".join(text.splitlines()[header:]), True
            if not text.strip():
                raise InputError(label, "holds no row of names after the lines to skip")
        lines = _table_lines(text, label, comment)
        sample = lines[:_SAMPLE_LINES]
        delimiter = delimiter or _delimiter(sample)
        rows = _split(sample, delimiter)
        if header is None:
            header = not any(_NUMBER.match(value) for value in rows[0])
        names: list[str] = []
        if header:
            names = [name.strip().strip('"').strip() for name in rows[0]]
            while names and not names[-1]:  # a delimiter at the end of each line
                names.pop()
            lines, rows = lines[1:], rows[1:]
        comma = decimal == ","
        if decimal is None:
            comma = any(_COMMA_NUMBER.match(value) for row in rows for value in row)
        table = DataTable(label, names, decimal_comma=comma, delimiter=delimiter)
        if legacy:
            table.warnings.append(f"{label}: not UTF-8, read as Latin-1")
        table.values = _parsed_at_once(lines, delimiter, comma, len(names) or _width(rows))
        if table.values is not None:
            table.lines = lines
            return table
        rows = _split(lines, delimiter)
        width = len(names) or _width(rows)
        whole = [row[:width] for row in rows if len(row) >= width and not any(row[width:])]
        if not whole:
            below = f" as wide as its names: {_some(names)}" if rows else ""
            raise InputError(label, f"holds no rows of data{below}")
        table.columns = list(zip(*whole, strict=True))
        if dropped := len(rows) - len(whole):
            lost = "1 line is" if dropped == 1 else f"{dropped} lines are"
            table.warnings.append(f"{label}: {lost} not whole: left out")
        return table


def _table_lines(text: str, label: str, comment: str) -> list[str]:
    """Lines that are neither empty nor a comment; InputError where they are no table."""
    if "\0" in text[:4096]:
        raise InputError(label, "not a text file")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith(comment)]
    if not lines:
        raise InputError(label, "empty")
    if (longest := max(map(len, lines))) > _LONGEST:
        raise InputError(label, f"holds a line of {longest} characters: not a table")
    return lines


def _parsed_at_once(lines: Sequence[str], delimiter: str, comma: bool, width: int) -> Floats | None:
    """All rows by NumPy's parser, which is fast; None where one of them is not plain numbers."""
    if not lines or width == 0 or (comma and delimiter == ","):
        return None
    if comma:
        lines = [line.replace(",", ".") for line in lines]
    try:
        between = None if delimiter == " " else delimiter
        values = np.loadtxt(lines, delimiter=between, comments=None, quotechar='"', ndmin=2)
    except ValueError:
        return None
    return values if values.shape[1] == width else None


def _split(lines: Sequence[str], delimiter: str) -> list[list[str]]:
    if delimiter == " ":
        return [line.split() for line in lines]
    try:
        return list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True))
    except csv.Error:
        return [line.split(delimiter) for line in lines]


def _width(rows: Sequence[Sequence[str]]) -> int:
    """The number of fields that most rows have (the larger of two), 0 without rows."""
    counts = Counter(map(len, rows))
    return max(counts, key=lambda width: (counts[width], width), default=0)


def _delimiter(sample: Sequence[str]) -> str:
    """The delimiter that splits the sample into the same number of fields; ``;`` before ``,``, since
    a comma may be the decimal sign."""
    for delimiter in (";", "\t", ","):
        rows = _split(sample, delimiter)
        width = _width(rows)
        if width > 1 and sum(len(row) == width for row in rows) >= 0.8 * len(rows):
            return delimiter
    return " " if any(" " in line.strip() for line in sample) else ","


# NumPy arrays


def read_array(data: bytes, label: str) -> Floats:
    """An array of at most two dimensions as (rows, columns); InputError where it is none."""
    if data.startswith(b"PK"):
        raise InputError(label, "an archive of arrays: take out the one to read")
    with reading(label, "a NumPy array of numbers"):
        file = BytesIO(data)
        form = np.lib.format
        first = form.read_magic(file) == (1, 0)
        header = form.read_array_header_1_0 if first else form.read_array_header_2_0
        shape, by_column, dtype = header(file)
        count, rest = math.prod(shape), len(data) - file.tell()
        if dtype.kind not in "biuf" or min(shape, default=0) < 0:
            raise InputError(label, f"not a NumPy array of numbers: holds {shown(str(dtype))}")
        if count * dtype.itemsize > rest:
            there = f"{shown(count)} numbers declared, {rest // dtype.itemsize} there"
            raise InputError(label, f"not a NumPy array that is whole: {there}")
        array = np.frombuffer(data, dtype, count, file.tell()).reshape(shape, order="F" if by_column else "C")
        numbers = array.astype(np.float64, order="C")
    if numbers.ndim > 2 or numbers.size == 0:
        raise InputError(label, f"an array of shape {numbers.shape}, not of rows and columns")
    return numbers.reshape(numbers.shape[0] if numbers.ndim else 1, -1)
