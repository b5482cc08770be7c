# SPDX-License-Identifier: Apache-2.0
"""Parallel work on several items."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from suspension_twin.models.simulate import cores

__all__ = ["no_progress", "one_blas_thread", "side_by_side"]

Item = TypeVar("Item")
Found = TypeVar("Found")

_thread = threading.local()


def one_blas_thread() -> Any:
    """A context in which BLAS uses one thread: items are parallel, and results do not depend on the load."""
    return threadpool_limits(1, "blas")


def no_progress(done: float, item: object) -> None:
    """Tells nobody how far the work is."""


def side_by_side(
    work: Callable[[Item], Found],
    items: Sequence[Item],
    on_progress: Callable[[float, Item], None] = no_progress,
) -> list[Found]:
    """Results of ``work`` on every item, in parallel on all cores; nested calls run serially.

    ``on_progress`` gets the finished share (0 to 1) and the item that comes next.
    """
    if getattr(_thread, "in_pool", False) or len(items) < 2:
        found = []
        for number, item in enumerate(items):
            on_progress(number / len(items), item)
            found.append(work(item))
        return found
    with ThreadPoolExecutor(cores(), "effects", _begin) as pool:
        waiting = [pool.submit(work, item) for item in items]
        found = []
        try:
            for number, (item, future) in enumerate(zip(items, waiting, strict=True)):
                on_progress(number / len(items), item)
                found.append(future.result())
        finally:
            pool.shutdown(cancel_futures=True)
    return found


def _begin() -> None:
    _thread.in_pool = True
