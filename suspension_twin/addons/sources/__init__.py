# SPDX-License-Identifier: Apache-2.0
"""Live phones, receivers and IMUs, without ROS: bytes in, samples out.

A source is one file of this folder, found by the scheme of its URL. It has ``TITLE`` (what a user calls it),
``EXAMPLE`` (a URL) and ``make(address, hub, rank)``, which returns a :class:`Source` or raises InputError for an
address that it cannot use. To add one, put its file here and its name into :data:`SOURCES`.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Protocol, cast

from suspension_twin.addons.sources.common.address import Address, parse_address
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.errors import InputError, nearest

__all__ = ["SOURCES", "Source", "SourceModule", "load_source", "make_sources"]

#: Schemes, each with the file of its name.
SOURCES = ("sensorlogger", "sensorserver", "phyphox", "mqtt", "nmea", "ubx", "gpsd", "ntrip", "iio")


class Source(Protocol):
    """One open source. All of it runs on one event loop."""

    #: What to tell the user, a line each: where to send to, what to set.
    notes: list[str]
    #: How to set up what is connected, a line each.
    steps: Sequence[str]
    #: What a QR code shows for it, once it is open; empty: none.
    code: str

    async def start(self) -> None:
        """Open what can fail for good: InputError for a port that is taken, a device that is not there."""
        ...

    async def run(self) -> None:
        """Receive until cancelled. What is lost is reconnected to."""
        ...

    async def stop(self) -> None:
        """Close everything; called once, also where ``start`` failed."""
        ...


class SourceModule(Protocol):
    """What a module of this folder holds."""

    TITLE: str
    EXAMPLE: str

    def make(self, address: Address, hub: Hub, rank: int) -> Source:
        """The source at an address, not yet open."""
        ...


def load_source(scheme: str) -> SourceModule:
    """The module of a scheme; InputError for one that is not there."""
    if scheme not in SOURCES:
        known = ", ".join(SOURCES)
        raise InputError("source", scheme, f"is not known{nearest(scheme, SOURCES)}; there are {known}")
    return cast(SourceModule, import_module(f"{__name__}.{scheme}"))


def make_sources(urls: Sequence[str], hub: Hub) -> list[Source]:
    """The sources of these URLs, not yet open. Of a stream that two of them have, the last one's is taken.

    Raises InputError for a URL that is none or that the source cannot use.
    """
    if not urls:
        raise InputError("source", "none is given")
    addresses = [parse_address(url) for url in urls]
    return [load_source(a.scheme).make(a, hub, rank) for rank, a in enumerate(addresses)]
