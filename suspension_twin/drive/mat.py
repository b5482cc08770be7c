# SPDX-License-Identifier: Apache-2.0
"""MATLAB files (versions 5 to 7.3), read by mat-io in a process with limits.

mat-io reads timetables and version 7.3, unlike SciPy, but checks no size that a file declares: that is done here first.
"""

from __future__ import annotations

import math
import struct
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Final, TypeVar

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.foreign_files import DataTable
from suspension_twin.drive.unpack import Budget, within_limits
from suspension_twin.errors import InputError, printable
from suspension_twin.files import read_bytes

__all__ = ["MAT_MAGIC", "MatTable", "fields_of", "mat_table", "of_mat", "variables_of"]

MAT_MAGIC: Final = b"MATLAB "
_V73: Final = b"MATLAB 7.3"
#: Type of a compressed element (miCOMPRESSED, MAT-File Format, table 1-1); bytes that are unpacked at a time, and of a
#: file (tolerances).
_COMPRESSED: Final = 15
_PIECE: Final = 1 << 20
_LARGEST: Final = 2 << 30
_DEEP: Final = 6  # structs within structs: Simulink's have three

Found = TypeVar("Found")


def of_mat(function: Callable[[str, Budget], Found], data: bytes, label: str) -> Found:
    """``function`` of the path of a file with these bytes and of its budget, in a process of its own."""
    if find_spec("matio") is None:
        raise InputError(label, "a .mat file can be read with Python 3.11 and later alone")
    budget = Budget(label, len(data))
    with tempfile.NamedTemporaryFile(suffix=".mat") as file:
        file.write(data)
        file.flush()
        return within_limits(function, file.name, budget, budget=budget, kind="a .mat file", module="matio")


def variables_of(path: str, budget: Budget) -> dict[str, Any]:
    """Variables of a file by name, as mat-io reads them."""
    import matio

    data = read_bytes(path, _LARGEST)
    if data.startswith(_V73):
        _check_hdf5(path, budget)
    else:
        _check_compressed(data, budget)
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # of variables that it cannot read, which are not those that are wanted
        variables: dict[str, Any] = matio.load_from_mat(path)
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def fields_of(value: Any) -> dict[str, Any]:
    """Fields of a struct or columns of a timetable, its stamps as ``Timestamp``; empty for anything else."""
    if hasattr(value, "columns") and hasattr(value, "index"):  # a timetable, as a pandas.DataFrame
        columns = {str(name): value[name].to_numpy() for name in value.columns}
        return {"Timestamp": value.index.to_numpy(), **columns}
    names = getattr(getattr(value, "dtype", None), "names", None)
    return {name: value[name].ravel()[0] for name in names} if names and value.size == 1 else {}


@dataclass
class MatTable(DataTable):
    """The numbers of a file: vectors by ``variable`` or ``struct.field``, columns of a matrix as ``variable.0``."""

    arrays: Mapping[str, Floats] = field(default_factory=dict)

    def text(self, key: str | int) -> tuple[str, ...]:
        """A variable holds no text here."""
        raise InputError(self.label, f"column {key}", "is read as numbers")

    def numbers(self, key: str | int) -> Floats:
        """A vector (n,) of the file, each of its own length."""
        if key in self.arrays:
            return self.arrays[str(key)]
        if isinstance(key, int):
            raise InputError(self.label, f"column {key}", f"name one of {', '.join(self.names[:40])}")
        return self.arrays[self.names[self.index(key)]]

    def vector(self, keys: Sequence[str | int]) -> Floats:
        """Vectors of one length side by side (n, len(keys))."""
        columns = [self.numbers(key) for key in keys]
        if len({column.size for column in columns}) > 1:
            raise InputError(self.label, ", ".join(map(str, keys)), "are of different lengths")
        return np.stack(columns, axis=1)


def mat_table(data: bytes, label: str) -> MatTable:
    """The numbers of a MATLAB file from its bytes; InputError where it cannot be read."""
    arrays = of_mat(_arrays, data, label)
    return MatTable(label, list(arrays), arrays=arrays)


def _arrays(path: str, budget: Budget) -> dict[str, Floats]:
    found = dict(_vectors("", variables_of(path, budget), _DEEP))
    if not found:
        raise InputError(budget.source, "holds no vectors of numbers")
    return found


def _vectors(prefix: str, values: Mapping[str, Any], deep: int) -> Iterator[tuple[str, Floats]]:
    for name, value in values.items():
        fields = fields_of(value)
        if fields and deep:
            yield from _vectors(f"{prefix}{name}.", fields, deep - 1)
            continue
        array = np.asarray(value)
        if array.dtype.kind in "mM":  # durations, and dates as POSIX times
            array = array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64) * 1e-9
        if array.dtype.kind not in "fiub" or array.ndim > 2 or array.size < 2:
            continue
        plain = array.astype(np.float64)
        if plain.ndim == 1 or 1 in plain.shape:
            yield f"{prefix}{name}", plain.ravel()
        else:
            yield from ((f"{prefix}{name}.{i}", column) for i, column in enumerate(plain.T))


def _check_compressed(data: bytes, budget: Budget) -> None:
    """Unpack the compressed variables of a file of version 5 within ``budget``, and forget them.

    Format: "MAT-File Format", The MathWorks: 128 bytes, then elements of u32 type, u32 size and content.
    """
    order = ">" if data[126:128] == b"MI" else "<"
    at = 128
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        at += 8
        if kind == _COMPRESSED:
            stream, piece = zlib.decompressobj(), data[at : at + size]
            while piece and not stream.eof:
                budget.take(len(stream.decompress(piece, _PIECE)))
                piece = stream.unconsumed_tail
        at += size if kind == _COMPRESSED else -(-size // 8) * 8


def _check_hdf5(path: str, budget: Budget) -> None:
    """Count the bytes that a file of version 7.3 declares: a dataset may declare anything and store nothing.

    Links that lead elsewhere by a name, within the file or out of it, and data in other files are refused: no program
    of MathWorks writes them.
    """
    import h5py  # comes with mat-io

    def elsewhere(name: str, link: object) -> str | None:
        return None if isinstance(link, h5py.HardLink) else name

    def count(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            if item.external or item.is_virtual:
                raise InputError(budget.source, "keeps its data in another file")
            budget.take(math.prod(item.shape or ()) * item.dtype.itemsize)

    with h5py.File(path) as file:
        if name := file.visititems_links(elsewhere):
            raise InputError(budget.source, printable(name[:80]), "is a link that leads elsewhere")
        file.visititems(count)
