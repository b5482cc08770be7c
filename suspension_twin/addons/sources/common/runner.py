# SPDX-License-Identifier: Apache-2.0
"""Sources on an event loop: of the caller, or of a thread beside a program that has none."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

from suspension_twin.addons.sources import LiveSource, make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.errors import InputError

__all__ = ["SourceLoop", "SourceThread", "running"]

#: s before a source that has failed is run again.
_AGAIN = 1.0
#: s after which a source that goes on is told again to end: a tolerance, as long as one may take to close.
_STOPPED = 1.0


@asynccontextmanager
async def running(sources: Sequence[LiveSource], hub: Hub) -> AsyncIterator[None]:
    """The sources receive within. Raises InputError where one cannot be opened."""
    tasks: list[asyncio.Task[None]] = []
    try:
        for source in sources:
            await source.start()
        tasks = [asyncio.create_task(_keep_running(source, hub)) for source in sources]
        yield
    finally:
        # once is not enough: until Python 3.12 asyncio.wait_for may lose a cancellation to a result that comes with it
        while pending := [task for task in tasks if not task.done()]:
            for task in pending:
                task.cancel()
            await asyncio.wait(pending, timeout=_STOPPED)
        for source in sources:
            with contextlib.suppress(Exception):
                await source.stop()


async def _keep_running(source: LiveSource, hub: Hub) -> None:
    """Whatever a sender causes, the source goes on."""
    while True:
        try:
            await source.run()
        except Exception as error:
            text = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            hub.notify("error", "source failed", f"a source failed and is started again: {text}")
        await asyncio.sleep(_AGAIN)


def _report_unhandled(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report an exception that no task has taken; a Ctrl-C that met one is no error."""
    if not isinstance(context.get("exception"), KeyboardInterrupt):
        loop.default_exception_handler(context)


class SourceLoop:
    """Sources that receive while their owner calls :meth:`run`, on the owner's thread.

    Raises InputError for a URL that is none and for a source that cannot be opened.
    """

    def __init__(self, urls: Sequence[str], hub: Hub) -> None:
        self.sources = make_sources(urls, hub)
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(_report_unhandled)
        self._came = asyncio.Event()
        self._open = running(self.sources, hub)
        try:
            self._loop.run_until_complete(self._open.__aenter__())
        except BaseException:
            self._loop.close()
            raise

    @property
    def notes(self) -> list[str]:
        """Addresses and settings for the user, a line each."""
        return [note for source in self.sources for note in source.notes]

    def run(self, seconds: float) -> None:
        """Receive for so long."""
        self._loop.run_until_complete(asyncio.sleep(max(seconds, 0.0)))

    def run_until_delivered(self, seconds: float) -> None:
        """Receive until :meth:`delivered` is called and what arrived with that sample is handled, for so long at
        most."""
        self._came.clear()
        self._loop.run_until_complete(self._wait(seconds))

    def delivered(self) -> None:
        """Samples were handed on: until the next ones come there is time for other work."""
        self._came.set()

    async def _wait(self, seconds: float) -> None:
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._came.wait(), seconds)

    def close(self) -> None:
        """Stop the sources."""
        if not self._loop.is_closed():
            self._loop.run_until_complete(self._open.__aexit__(None, None, None))
            self._loop.close()


class SourceThread(SourceLoop):
    """Sources that receive on a thread of their own, once they have been opened on the caller's."""

    def __init__(self, urls: Sequence[str], hub: Hub) -> None:
        super().__init__(urls, hub)
        self._thread = threading.Thread(target=self._loop.run_forever, name="sources", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the sources and the thread."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(5.0)
        if not self._loop.is_running():
            super().close()
