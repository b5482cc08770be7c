# SPDX-License-Identifier: Apache-2.0
"""Work on several items at once."""

from __future__ import annotations

import threading

import pytest

from suspension_twin.identification.parallel import side_by_side


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
