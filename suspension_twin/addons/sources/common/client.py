# SPDX-License-Identifier: Apache-2.0
"""Sources that connect to something: again and again, as phones leave networks and programs are restarted."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable

import aiohttp

from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.errors import InputError

__all__ = ["Stay", "fetch", "keep_connected", "url_host"]

#: s between attempts, at first and at most.
_FIRST, _LONGEST = 0.5, 0.8
#: s that a connection has to last for the next attempt to be a first one.
_GOOD = 5.0


def url_host(host: str) -> str:
    """A host as it stands in a URL."""
    return f"[{host}]" if ":" in host else host


async def fetch(session: aiohttp.ClientSession, url: str, most: int) -> bytes:
    """The answer to a GET; InputError where it is no success or has more than ``most`` bytes."""
    async with session.get(url) as answer:
        if answer.status != 200:
            raise InputError(url.partition("?")[0], f"answers {answer.status} {answer.reason}")
        parts, size = [], 0
        async for part in answer.content.iter_chunked(65536):
            size += len(part)
            if size > most:
                raise InputError(url.partition("?")[0], f"answers with more than {most} bytes")
            parts.append(part)
        return b"".join(parts)


class Stay(Exception):
    """Raised by a session that is not to be tried again: the other side has refused it for good."""


async def keep_connected(hub: Hub, name: str, session: Callable[[], Awaitable[None]]) -> None:
    """Run ``session`` again whenever it ends or fails by its connection; told once, until it has lasted."""
    wait, told = _FIRST, ""
    while True:
        began = time.monotonic()
        try:
            await session()
            reason = "the connection was closed"
        except Stay as error:
            hub.say("error", f"refused {name}", f"{name}: {error}")
            await asyncio.Event().wait()
        except InputError as error:
            reason = str(error)
        except (OSError, EOFError, asyncio.TimeoutError, aiohttp.ClientError) as error:
            reason = _reason(error)
        if time.monotonic() - began > _GOOD:
            wait, told = _FIRST, ""
        if reason != told:
            hub.say("warn", f"connection {name}", f"{name}: {reason}; trying again")
            told = reason
        await asyncio.sleep(wait)
        wait = min(2 * wait, _LONGEST)


def _reason(error: BaseException) -> str:
    if isinstance(error, asyncio.TimeoutError):
        return "no answer"
    if isinstance(error, aiohttp.ClientConnectorError):
        return f"cannot be reached ({error.os_error.strerror or error.os_error})"
    if isinstance(error, aiohttp.WSServerHandshakeError | aiohttp.ClientResponseError):
        return f"answers {error.status} {error.message}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__
