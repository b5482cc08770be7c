# SPDX-License-Identifier: Apache-2.0
"""Work on several items at once."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from suspension_twin.inference.parallel import no_progress, one_blas_thread, side_by_side


def test_results_come_in_order_and_progress_is_told() -> None:
    told: list[tuple[float, int]] = []
    assert side_by_side(lambda i: i * i, range(5), lambda done, i: told.append((done, i))) == [0, 1, 4, 9, 16]
    assert told == [(i / 5, i) for i in range(5)]
    assert side_by_side(lambda i: i, []) == []


def test_work_inside_work_stays_on_its_thread() -> None:
    """Else every item would start threads of its own."""

    def outer(i: int) -> set[int]:
        return {threading.get_ident(), *side_by_side(lambda _: threading.get_ident(), range(4))}

    here = threading.get_ident()
    assert all(len(threads) == 1 and here not in threads for threads in side_by_side(outer, range(3)))


def test_the_first_item_that_fails_is_the_one_that_is_told() -> None:
    def work(i: int) -> int:
        if i:
            raise ValueError(str(i))
        return i

    with pytest.raises(ValueError, match="^1$"):
        side_by_side(work, range(6))
    with pytest.raises(ValueError, match="^1$"):
        side_by_side(work, [1])


def test_one_item_needs_no_thread_and_two_do() -> None:
    """Where a caller goes on meanwhile, each has a thread from a pool; afterwards the caller may ask again."""
    here = threading.get_ident()
    for count, inside in ((1, True), (2, False), (3, False), (2, False), (1, True)):
        threads = side_by_side(lambda _: threading.get_ident(), range(count))
        assert len(threads) == count and all((thread == here) == inside for thread in threads)


def test_a_serial_caller_is_told_as_well() -> None:
    told: list[tuple[float, int]] = []

    def outer(i: int) -> list[int]:
        return side_by_side(
            lambda k: 10 * i + k, range(4), lambda done, k: told.append((done, k)) if i else None
        )

    assert side_by_side(outer, range(2)) == [[0, 1, 2, 3], [10, 11, 12, 13]]
    assert told == [(k / 4, k) for k in range(4)]


def test_blas_has_one_thread_for_a_while() -> None:
    def threads() -> list[int]:
        return [m["num_threads"] for m in threadpool_info() if m["user_api"] == "blas"]

    np.ones((2, 2)) @ np.ones((2, 2))
    before = threads()
    with one_blas_thread():
        assert set(threads()) <= {1}
    assert threads() == before


def test_progress_may_be_told_to_nobody() -> None:
    assert no_progress(0.5, "item") is None
