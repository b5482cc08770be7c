# SPDX-License-Identifier: Apache-2.0
"""How this package's and the pose's kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from numba import njit

__all__ = ["compiled"]

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile on first call, without fast-math and without the GIL, and keep the machine code on disk.

    Numba drops code on disk when the function's own file has changed; here it is dropped when any
    file of the two packages has, since kernels call each other across files. Where no folder can be
    written (no home, read-only installation) every process compiles anew instead of failing.
    """
    try:
        out: Any = njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # numba: "no locator available"
        out = njit(nogil=True, error_model="numpy")(function)
    file = getattr(getattr(out, "_cache", None), "_cache_file", None)
    if file is not None and hasattr(file, "_source_stamp"):
        file._source_stamp = _sources_stamp()
    return out  # type: ignore[no-any-return]


@lru_cache(maxsize=1)
def _sources_stamp() -> tuple[tuple[str, float, int], ...]:
    """Name, time and size of every module whose code may end up in a kernel."""
    here = Path(__file__).parent
    stamp = []
    for file in sorted([*here.glob("*.py"), *(here.parent / "pose").glob("*.py")]):
        status = file.stat()
        stamp.append((file.name, status.st_mtime, status.st_size))
    return tuple(stamp)
