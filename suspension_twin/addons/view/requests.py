# SPDX-License-Identifier: Apache-2.0
"""Buttons of the page: pressed in the server's threads, answered in one of the node's."""

from __future__ import annotations

import queue
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer

from suspension_twin.errors import SuspensionTwinError, WorkError

__all__ = ["Requests"]

#: s that an answer may take.
_PATIENCE = 6.0


class Requests:
    """Hands the name and the number of a button to ``answer``, on the thread that calls :meth:`serve`."""

    def __init__(self, answer: Callable[[str, float | None], str]) -> None:
        self._answer = answer
        self._waiting: queue.SimpleQueue[tuple[str, float | None, Future[str]]] = queue.SimpleQueue()

    def ask(self, name: str, number: float | None) -> str:
        """The answer for who pressed the button. Raises the SuspensionTwinError of the other thread."""
        answered: Future[str] = Future()
        self._waiting.put((name, number, answered))
        try:
            return answered.result(_PATIENCE)
        except NoAnswer:
            raise WorkError(f"{name}: no answer") from None

    def serve(self) -> None:
        """Answer everything that waits."""
        while not self._waiting.empty():
            name, number, answered = self._waiting.get()
            try:
                answered.set_result(self._answer(name, number))
            except SuspensionTwinError as error:
                answered.set_exception(error)
            except Exception as error:  # the page gets an answer in any case
                answered.set_exception(WorkError(f"{name}: {type(error).__name__}: {error}"))
