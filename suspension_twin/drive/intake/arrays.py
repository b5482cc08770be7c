# SPDX-License-Identifier: Apache-2.0
"""NumPy arrays from files, of any name; nothing in them is ever executed."""

from __future__ import annotations

import math
from io import BytesIO

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, shown
from suspension_twin.files import reading

__all__ = ["MAGIC", "read_array"]

MAGIC = b"\x93NUMPY"


def read_array(data: bytes, label: str) -> Floats:
    """An array of at most two dimensions as (rows, columns); InputError where it is none."""
    if data.startswith(b"PK"):
        raise InputError(label, "an archive of arrays: take out the one to read")
    with reading(label, "a NumPy array of numbers"):
        file = BytesIO(data)
        version = np.lib.format.read_magic(file)
        header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, by_column, dtype = header(file)
        count, rest = math.prod(shape), len(data) - file.tell()
        if dtype.kind not in "biuf" or min(shape, default=0) < 0:
            raise InputError(label, f"not a NumPy array of numbers: holds {shown(str(dtype))}")
        if count * dtype.itemsize > rest:
            there = rest // dtype.itemsize
            raise InputError(
                label, f"not a NumPy array that is whole: {shown(count)} numbers declared, {there} there"
            )
        array = np.frombuffer(data, dtype, count, file.tell()).reshape(shape, order="F" if by_column else "C")
        numbers = array.astype(np.float64, order="C")
    if numbers.ndim > 2 or numbers.size == 0:
        raise InputError(label, f"an array of shape {numbers.shape}, not of rows and columns")
    return numbers.reshape(numbers.shape[0] if numbers.ndim else 1, -1)
