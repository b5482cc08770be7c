# SPDX-License-Identifier: Apache-2.0
"""Fixtures for pytest, which finds them by the entry point ``pytest11``. Loading them imports no ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from suspension_twin.drive.types import Drive
    from suspension_twin.testing.running import Received, RunningTwin
    from suspension_twin.vehicle.twin import Twin

__all__ = ["replayed", "running_twin"]


@pytest.fixture
def running_twin() -> Iterator[Callable[..., RunningTwin]]:
    """``running_twin(twin)``: a twin's nodes in this process, taken down after the test.

    Arguments as :func:`suspension_twin.testing.running.running_twin` takes them.
    """
    from suspension_twin.testing import running

    with ExitStack() as stack:
        yield lambda *given, **options: stack.enter_context(running.running_twin(*given, **options))


@pytest.fixture
def replayed(
    running_twin: Callable[..., RunningTwin],
) -> Callable[..., dict[str, Received]]:
    """``replayed(twin, drive)``: what a twin's nodes publish while a drive is replayed, by topic."""

    def replay(
        twin: Twin | Path | str, drive: Drive | Path | str, topics: Sequence[str] = ()
    ) -> dict[str, Received]:
        from suspension_twin.testing.running import TOPICS

        return running_twin(twin).replay(drive, topics or TOPICS)

    return replay
