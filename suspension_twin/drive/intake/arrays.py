# SPDX-License-Identifier: Apache-2.0
"""NumPy arrays from files, of any name; nothing in them is ever executed."""

from __future__ import annotations

from io import BytesIO

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = ["MAGIC", "read_array"]

MAGIC = b"\x93NUMPY"


def read_array(data: bytes, label: str) -> Floats:
    """An array of at most two dimensions as (rows, columns); InputError where it is none."""
    try:
        array = np.load(BytesIO(data), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise InputError(label, "an archive of arrays: take out the one to read")
        numbers = np.asarray(array, dtype=np.float64)
    except (ValueError, TypeError, EOFError, OSError, SyntaxError):
        raise InputError(label, "not a NumPy array of numbers, or cut off") from None
    if numbers.ndim > 2 or numbers.size == 0:
        raise InputError(label, f"an array of shape {numbers.shape}, not of rows and columns")
    return numbers.reshape(numbers.shape[0] if numbers.ndim else 1, -1)
