# SPDX-License-Identifier: Apache-2.0
"""Timetables in ``.mat`` files of version 5, which SciPy hands on as opaque objects.

MATLAB keeps objects in a subsystem at the end of the file: a cell array whose first cell is a table
of names, classes, objects and properties, and whose other cells are the properties' values. Of that
only what a timetable of numbers over dates needs is read here. The layout is not documented by
MathWorks; it is described in mahalex/MatFileHandler, "Objects.md", and implemented in mat-io.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

__all__ = ["UnreadableObject", "timetables"]

_REFERENCE = 0xDD000000
_COMPRESSED, _MATRIX = 15, 14
_OPAQUE = 17
_LARGEST = 1 << 31

Words = NDArray[np.int32]


class UnreadableObject(ValueError):
    """The objects of this file are laid out in another way than is known here."""


def _elements(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Data elements (type, content) one after the other, small ones too."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind >> 16:  # type and size in one word, up to 4 bytes of content in the next
            yield kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)]
            at += 8
            continue
        yield kind, data[at + 8 : at + 8 + size]
        at += 8 + size
        if kind != _COMPRESSED:
            at += -size % 8


def _references(data: bytes) -> dict[str, int]:
    """Names of the variables that are objects, and the number of the object."""
    found = {}
    for kind, content in _elements(data[128:]):
        if kind == _COMPRESSED:
            content = zlib.decompressobj().decompress(content, _LARGEST)
            kind, content = next(_elements(content), (0, b""))
        parts = list(_elements(content)) if kind == _MATRIX else []
        if len(parts) < 5 or parts[0][1][:1] != bytes([_OPAQUE]):
            continue
        name = parts[1][1].decode("ascii", "replace")
        reference = list(_elements(parts[4][1]))
        number = _object_number(np.frombuffer(reference[-1][1], dtype="<u4")) if reference else None
        if name and number is not None:
            found[name] = number
    return found


def _object_number(words: Any) -> int | None:
    """Number of a single object from its reference, None if it is none."""
    words = np.asarray(words).ravel()
    if words.dtype.kind != "u" or words.size != 6 or words[0] != _REFERENCE or list(words[1:4]) != [2, 1, 1]:
        return None
    return int(words[4])


class _Subsystem:
    """Objects of one file by number."""

    def __init__(self, workspace: bytes) -> None:
        header = b"MATLAB 5.0 MAT-file".ljust(124, b" ") + b"\x00\x01IM"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            inner = scipy.io.loadmat(BytesIO(header + workspace[8:]))  # type: ignore[arg-type]
        holder = next(v for v in inner.values() if getattr(getattr(v, "dtype", None), "names", None))
        wrapper = np.asarray(holder["MCOS"][0, 0]).ravel()[0]
        self.cells: NDArray[Any] = wrapper[len(wrapper) - 1].ravel()
        table = self.cells[0].tobytes()
        version, count, *ends = (int(v) for v in np.frombuffer(table, dtype="<i4", count=10))
        if not 2 <= version <= 4:
            raise UnreadableObject(f"object table of version {version}")
        self.names = [name.decode("ascii", "replace") for name in table[40 : ends[0]].split(b"\0")[:count]]

        def region(i: int) -> Words:
            return np.frombuffer(table[ends[i] : ends[i + 1]], dtype="<i4")

        self.saved, self.objects, self.normal = region(1), region(2).reshape(-1, 6), region(3)

    def properties(self, number: int) -> dict[str, Any]:
        """Values of the properties of one object that are stored with it."""
        _, _, _, saved, normal, _ = self.objects[number]
        words, record = (self.saved, int(saved)) if saved else (self.normal, int(normal))
        at = 0
        for _ in range(record):
            at += 1 + 3 * int(words[at])
            at += at % 2
        triples = words[at + 1 : at + 1 + 3 * int(words[at])].reshape(-1, 3)
        # a property of kind 1 has its value in a cell, after the table and an empty one
        return {self.names[name - 1]: self.cells[2 + value] for name, kind, value in triples if kind == 1}

    def stamps(self, reference: Any) -> NDArray[np.datetime64] | NDArray[np.float64]:
        """Row times: dates as datetime64, durations in s."""
        number = _object_number(reference)
        if number is None:
            raise UnreadableObject("row times that are no dates")
        values = self.properties(number)
        if "millis" in values:
            return np.asarray(values["millis"], dtype=np.float64).ravel() * 1e-3
        data = np.asarray(values["data"]).ravel()
        whole = np.floor(data.real)
        # the imaginary part is what the milliseconds since 1970 were rounded by
        rest = np.rint((data.real - whole + data.imag) * 1e6)
        if not np.isfinite(whole + rest).all():
            raise UnreadableObject("row times that are missing")
        return np.asarray(whole.astype(np.int64) * 1_000_000 + rest.astype(np.int64), dtype="datetime64[ns]")

    def timetable(self, number: int) -> dict[str, Any]:
        """Columns of a timetable by lower-case name, its row times as ``timestamp``."""
        content = self.properties(number)["any"][0, 0]
        names = [str(np.asarray(name).ravel()[0]).lower() for name in content["varNames"].ravel()]
        columns = [np.asarray(column).ravel() for column in content["data"].ravel()]
        return {"timestamp": self.stamps(content["rowTimes"]), **dict(zip(names, columns, strict=True))}


def timetables(data: bytes, workspace: bytes) -> dict[str, dict[str, Any]]:
    """Timetables of a file by variable name; ``workspace`` is SciPy's ``__function_workspace__``.

    Objects of other classes are passed over. Raises UnreadableObject where there is no timetable.
    """
    tables: dict[str, dict[str, Any]] = {}
    problem = "no timetable"
    try:
        subsystem = _Subsystem(workspace)
        for name, number in _references(data).items():
            try:
                tables[name] = subsystem.timetable(number)
            except (UnreadableObject, KeyError, IndexError, ValueError, TypeError) as error:
                problem = f"{name}: {error}"
    except Exception as error:  # damage may show anywhere in so many levels
        problem = f"{type(error).__name__}: {error}"
    if not tables:
        raise UnreadableObject(problem)
    return tables
