# SPDX-License-Identifier: Apache-2.0
"""The outside of a source: its URL, its connection, which is made again and again, and checked fields of messages."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import logging
import math
import time
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

import aiohttp

from suspension_twin.addons.sources.common.clock import Few
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.errors import InputError, nearest, shorter
from suspension_twin.files import Json

__all__ = [
    "Address",
    "PlainSource",
    "Stay",
    "fetch",
    "is_local",
    "keep_connected",
    "number",
    "parse_address",
    "read_object",
    "url_host",
]


@dataclass(frozen=True)
class Address:
    """A source's URL in its parts; ``port`` 0 where none is given, ``options`` those after the ``?``."""

    url: str
    scheme: str
    host: str
    port: int
    path: str
    user: str
    password: str
    options: dict[str, str]

    def __str__(self) -> str:
        """As much as may be shown: no password, no token."""
        return f"{self.scheme}:{self.where}"

    @property
    def where(self) -> str:
        """Host and port, or the path."""
        if not self.host:
            return self.path
        return f"//{url_host(self.host)}{f':{self.port}' if self.port else ''}{self.path}"

    def check_options(self, known: Collection[str]) -> None:
        """Raise InputError for an option that is not ``known``."""
        for name in self.options:
            if name not in known:
                there = f"; there are {', '.join(sorted(known))}" if known else ""
                raise InputError(str(self), f"unknown option {name}{nearest(name, known)}{there}")

    def number(self, name: str, default: float, low: float, high: float) -> float:
        """The option ``name`` as a number from ``low`` to ``high``; InputError otherwise."""
        text = self.options.get(name)
        if text is None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise InputError(str(self), name, f"must be a number from {low:g} to {high:g}, is '{text}'")
        return value


def parse_address(url: str) -> Address:
    """The parts of ``scheme://user:password@host:port/path?option=value`` or ``scheme:path?option=value``.

    Raises InputError, which names the URL without its secrets.
    """
    shown = url.partition("?")[0].rpartition("@")[2] or "''"
    scheme, colon, rest = url.partition(":")
    if not colon or not scheme.isalnum() or not rest:
        raise InputError(shown, "is no source: write SCHEME://HOST:PORT or SCHEME:DEVICE")
    try:
        parts = urlsplit(url)
        port = parts.port or 0
        query = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    except ValueError:
        raise InputError(shown, "is no URL that can be read: check host, port and options") from None
    options = dict(query)
    if len(options) < len(query):
        raise InputError(shown, "an option is given twice")
    return Address(
        url=url,
        scheme=scheme.lower(),
        host=parts.hostname or "",
        port=port,
        path=unquote(parts.path),
        user=unquote(parts.username or ""),
        password=unquote(parts.password or ""),
        options=options,
    )


#: Characters of what the other side says that are repeated (tolerance: a line of a terminal).
_WORDS = 80
#: s between attempts, at first and at most.
_FIRST, _LONGEST = 0.5, 0.8
#: s that a connection has to last for the next attempt to be a first one.
_GOOD = 5.0


class PlainSource:
    """A source with nothing to open or close: the other side may be started later."""

    notes: list[str]
    code = reached = ""

    async def start(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""

    async def stop(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""


def is_local(host: str) -> bool:
    """Whether only this machine reaches ``host``."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def url_host(host: str) -> str:
    """A host as it stands in a URL."""
    return f"[{host}]" if ":" in host else host


async def fetch(session: aiohttp.ClientSession, url: str, most: int) -> bytes:
    """The answer to a GET; InputError where it is no success or has more than ``most`` bytes."""
    async with session.get(url) as answer:
        if answer.status != 200:
            raise InputError(
                url.partition("?")[0], f"answers {answer.status} {shorter(answer.reason or '', _WORDS)}"
            )
        parts, size = [], 0
        async for part in answer.content.iter_chunked(65536):
            size += len(part)
            if size > most:
                raise InputError(url.partition("?")[0], f"answers with more than {most} bytes")
            parts.append(part)
        return b"".join(parts)


class _Seldom(logging.Filter):
    """Lets a few lines of a log pass, without tracebacks: whoever sends nonsense could fill a terminal with them."""

    def __init__(self) -> None:
        super().__init__()
        self._few = Few()

    def filter(self, record: logging.LogRecord) -> bool:
        """See the base class."""
        error = record.exc_info[1] if record.exc_info else None
        cause = "" if error is None else f" ({type(error).__name__}: {error})"
        record.msg, record.args, record.exc_info = shorter(record.getMessage() + cause, _WORDS), (), None
        return self._few.allows(record.name, record.msg)


# That of the event loops of all sources and servers.
logging.getLogger("asyncio").addFilter(_Seldom())


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
            hub.notify("error", f"refused {name}", f"{name}: {error}")
            await asyncio.Event().wait()
        except InputError as error:
            reason = str(error)
        except (OSError, EOFError, asyncio.TimeoutError, aiohttp.ClientError) as error:
            reason = _reason(error)
        except Exception as error:  # what a field holds that no reader expects
            reason = f"sends what cannot be read ({type(error).__name__})"
        if time.monotonic() - began > _GOOD:
            wait, told = _FIRST, ""
        if reason != told:
            hub.notify("warn", f"connection {name}", f"{name}: {reason}; trying again")
            told = reason
        await asyncio.sleep(wait)
        wait = min(2 * wait, _LONGEST)


def _reason(error: BaseException) -> str:
    if isinstance(error, asyncio.TimeoutError):
        return "no answer"
    if isinstance(error, aiohttp.ClientConnectorError):
        return f"cannot be reached ({error.os_error.strerror or error.os_error})"
    if isinstance(error, aiohttp.WSServerHandshakeError | aiohttp.ClientResponseError):
        return f"answers {error.status} {shorter(error.message, _WORDS)}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return shorter(str(error), _WORDS) or type(error).__name__


def read_object(text: bytes | str) -> Json:
    """A JSON object; InputError for anything else."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("message", "not JSON") from None
    if not isinstance(data, dict):
        raise InputError("message", "not a JSON object")
    return data


def number(value: Any) -> float:
    """A finite number of JSON; TypeError, ValueError or OverflowError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    found = float(value)
    if not math.isfinite(found):
        raise ValueError
    return found
