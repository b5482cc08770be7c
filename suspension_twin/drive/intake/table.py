# SPDX-License-Identifier: Apache-2.0
"""Tables of text: delimiter, decimal comma and header recognised, columns by name or number."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.intake.source import decode_text
from suspension_twin.errors import InputError
from suspension_twin.files import reading

__all__ = ["Table", "number", "read_table"]

_NUMBER = re.compile(
    r"\s*([-+]?(\d+([.,]\d*)?|[.,]\d+)(e[-+]?\d+)?|[-+]?(nan|inf(inity)?))\s*$", re.IGNORECASE
)
_COMMA_NUMBER = re.compile(r"^\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*$")
_SAMPLE_LINES = 50
_LONGEST = 1 << 18  # characters of a line


@dataclass
class Table:
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

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.values.shape[1]) if self.values is not None else len(self.columns)

    def index(self, key: str | int) -> int:
        """Number of the column of this name (whatever its case) or number; InputError if none."""
        if isinstance(key, int):
            if not 0 <= key < self.width:
                raise InputError(self.label, f"column {key}", f"there are {self.width}, counted from 0")
            return key
        wanted = key.strip().casefold()
        for i, name in enumerate(self.names):
            if name.casefold() == wanted:
                return i
        known = _some(self.names) if self.names else "none: the file has no header, give numbers from 0"
        raise InputError(self.label, f"column {key}", f"is not there; the columns are {known}")

    def has(self, *keys: str) -> bool:
        """Whether all of these columns are there, whatever their case."""
        names = {name.casefold() for name in self.names}
        return all(key.casefold() in names for key in keys)

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
) -> Table:
    """Parse one file.

    ``header``: True if the first row names the columns, False if there are no names, a number of
    rows to skip before the row of names, None to see. ``delimiter`` and ``decimal`` are recognised
    where None. Rows of another width than the table (a first or last line that is partial) are
    dropped and counted. Raises InputError if there is no table.
    """
    with reading(label, "a table"):
        return _read_table(data, label, header, delimiter, decimal, comment)


def _read_table(
    data: bytes,
    label: str,
    header: bool | int | None,
    delimiter: str | None,
    decimal: str | None,
    comment: str,
) -> Table:
    text, legacy = decode_text(data)
    if "\0" in text[:4096]:
        raise InputError(label, "not a text file")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith(comment)]
    if not lines:
        raise InputError(label, "empty")
    if max(map(len, lines)) > _LONGEST:
        raise InputError(label, f"holds a line of {max(map(len, lines))} characters: not a table")
    if isinstance(header, int) and not isinstance(header, bool):
        lines = lines[header:]
        header = True
        if not lines:
            raise InputError(label, "holds no row of names after those to skip")
    sample = lines[:_SAMPLE_LINES]
    if delimiter is None:
        delimiter = _delimiter(sample)
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
    table = Table(label, names, decimal_comma=comma, delimiter=delimiter)
    if legacy:
        table.warnings.append(f"{label}: not UTF-8, read as Latin-1")
    table.values = _quick(lines, delimiter, comma, len(names) or _width(rows))
    if table.values is not None:
        table.lines = lines
        return table
    rows = _split(lines, delimiter)
    width = len(names) or _width(rows)
    whole = [row[:width] for row in rows if len(row) >= width and not any(row[width:])]
    if not whole:
        raise InputError(label, "holds no rows of data")
    table.columns = list(zip(*whole, strict=True))
    if len(whole) < len(rows):
        dropped = len(rows) - len(whole)
        table.warnings.append(
            f"{label}: {dropped} {'line is' if dropped == 1 else 'lines are'} not whole: left out"
        )
    return table


def _quick(lines: Sequence[str], delimiter: str, comma: bool, width: int) -> Floats | None:
    """All rows by NumPy's parser; None where they are not that plain, or the parser finds them so."""
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
    """The number of fields that most rows have, 0 without rows."""
    counts: dict[int, int] = {0: 0}
    for row in rows:
        counts[len(row)] = counts.get(len(row), 0) + 1
    return max(counts, key=lambda width: (counts[width], width))


def _delimiter(sample: Sequence[str]) -> str:
    """The delimiter that splits the sample into the same number of fields; ``;`` before ``,``, since
    a comma may be the decimal sign."""
    for delimiter in (";", "\t", ","):
        rows = _split(sample, delimiter)
        width = _width(rows)
        if width > 1 and sum(len(row) == width for row in rows) >= 0.8 * len(rows):
            return delimiter
    return " " if any(" " in line.strip() for line in sample) else ","
