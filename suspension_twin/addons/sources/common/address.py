# SPDX-License-Identifier: Apache-2.0
"""URLs of sources."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from urllib.parse import parse_qsl, unquote, urlsplit

from suspension_twin.errors import InputError, nearest

__all__ = ["Address", "parse_address"]


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
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"//{host}{f':{self.port}' if self.port else ''}{self.path}"

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
