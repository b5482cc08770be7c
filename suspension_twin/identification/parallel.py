# SPDX-License-Identifier: Apache-2.0
"""Work on several items at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from suspension_twin.models.blocks import cores

__all__ = ["one_blas_thread", "quietly", "side_by_side"]

Item = TypeVar("Item")
Found = TypeVar("Found")

_here = threading.local()


def one_blas_thread() -> Any:
    """A context in which BLAS uses one thread: work is shared out by items, and the bits are the same whatever else the
    machine does."""
    return threadpool_limits(1, "blas")


def quietly(done: float, item: object) -> None:
    """Tells nobody how far the work is."""


def side_by_side(
    work: Callable[[Item], Found], items: Sequence[Item], tell: Callable[[float, Item], None] = quietly
) -> list[Found]:
    """``work`` on every item, as many at once as there are cores; each by itself, so their number changes nothing.
    Work that is one of several itself does its own one after the other."""
    if getattr(_here, "one_of_several", False) or len(items) < 2:
        found = []
        for number, item in enumerate(items):
            tell(number / len(items), item)
            found.append(work(item))
        return found
    with ThreadPoolExecutor(cores(), "effects", _begin) as pool:
        waiting = [pool.submit(work, item) for item in items]
        found = []
        try:
            for number, (item, future) in enumerate(zip(items, waiting, strict=True)):
                tell(number / len(items), item)
                found.append(future.result())
        finally:
            pool.shutdown(cancel_futures=True)
    return found


def _begin() -> None:
    _here.one_of_several = True
