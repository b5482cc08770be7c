# SPDX-License-Identifier: Apache-2.0
"""Work on several items at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from suspension_twin.models.blocks import cores

__all__ = ["quietly", "side_by_side"]

Item = TypeVar("Item")
Found = TypeVar("Found")


def quietly(done: float, item: object) -> None:
    """Tells nobody how far the work is."""


def side_by_side(
    work: Callable[[Item], Found], items: Sequence[Item], tell: Callable[[float, Item], None]
) -> list[Found]:
    """``work`` on every item, as many at once as there are cores; each by itself, so their number changes nothing."""
    found = []
    with ThreadPoolExecutor(cores(), thread_name_prefix="effects") as pool:
        waiting = [pool.submit(work, item) for item in items]
        try:
            for number, (item, future) in enumerate(zip(items, waiting, strict=True)):
                tell(number / len(items), item)
                found.append(future.result())
        finally:
            pool.shutdown(cancel_futures=True)
    return found
