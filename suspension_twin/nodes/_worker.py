# SPDX-License-Identifier: Apache-2.0
"""A long computation in a process of its own, so that the node beside it keeps answering.

Spawned, never forked: a child that inherits the middleware's threads hangs. The child takes less of
the processor than the live twin, ignores the terminal's Ctrl-C, which is its parent's to act on,
and does not outlive its parent.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from typing import Any, Literal, NamedTuple

from suspension_twin.errors import SuspensionTwinError

__all__ = ["News", "Work", "Worker"]

#: What runs in the child: the job, a function that sends word, a function that says when to stop.
Work = Callable[[Any, Callable[[Any], None], Callable[[], bool]], Any]


class News(NamedTuple):
    """What the child says: progress on the way, and in the end what came out or one line of what went
    wrong."""

    kind: Literal["progress", "done", "failed"]
    content: Any


class Worker:
    """``work(job, progress, should_stop)`` in a child; ``work`` and ``job`` are pickled."""

    def __init__(self, work: Work, job: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._here, there = context.Pipe(duplex=False)
        self._stop = context.Event()
        self._process = context.Process(target=_run, args=(work, job, there, self._stop), daemon=True)
        self._process.start()
        there.close()

    def news(self) -> list[News]:
        """What has been said since the last call; a child that died says so."""
        found = []
        try:
            while self._here.poll():
                found.append(self._here.recv())
        except (EOFError, OSError):
            self._process.join(0.1)
            found.append(News("failed", f"the worker process ended (exit status {self._process.exitcode})"))
        return found

    def stop(self) -> None:
        """Ask it to come to an end with what it has."""
        self._stop.set()

    def kill(self) -> None:
        """End it now."""
        self._process.kill()
        self._process.join(1.0)
        self._here.close()


def _run(work: Work, job: Any, out: Connection, stop: Event) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(10)
    parent = multiprocessing.parent_process()

    def should_stop() -> bool:
        if parent is not None and not parent.is_alive():
            os._exit(1)
        return stop.is_set()

    def progress(content: Any) -> None:
        out.send(News("progress", content))

    try:
        result = News("done", work(job, progress, should_stop))
    except SuspensionTwinError as error:
        result = News("failed", str(error))
    except Exception as error:
        result = News("failed", f"unexpected error, {type(error).__name__}: {error}")
    with contextlib.suppress(OSError):  # nobody is listening any more
        out.send(result)
        out.close()
