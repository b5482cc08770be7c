# SPDX-License-Identifier: Apache-2.0
"""Live phones, receivers and IMUs, without ROS: bytes in, samples out.

A source is a module, found by the scheme of its URL: a file of this folder, or a module of an installed package that
its entry point in the group ``suspension_twin.sources`` names. It has ``TITLE`` (the name that a user knows),
``EXAMPLE`` (a URL) and ``make(address, hub, rank)``, which returns a :class:`LiveSource` or raises InputError for an
address that it cannot use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol, runtime_checkable

from suspension_twin.addons.sources.common.connection import Address, parse_address
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.errors import InputError
from suspension_twin.registry import Registry

__all__ = ["SOURCES", "LiveSource", "SourceModule", "make_sources"]


class LiveSource(Protocol):
    """One open source. All of it runs on one event loop."""

    #: What to tell the user, a line each: where to send to, what to set.
    notes: list[str]
    #: How to set up what is connected, a line each.
    steps: Sequence[str]
    #: What a QR code shows for it, once it is open; empty: none.
    code: str
    #: Who else than this machine can send to it, which the first line of a command says; empty: nobody.
    reached: str

    async def start(self) -> None:
        """Open what can fail for good: InputError for a port that is taken, a device that is not there."""
        ...

    async def run(self) -> None:
        """Receive until cancelled. What is lost is reconnected to."""
        ...

    async def stop(self) -> None:
        """Close everything; called once, also where ``start`` failed."""
        ...


@runtime_checkable
class SourceModule(Protocol):
    """The contents of a source's module."""

    TITLE: str
    EXAMPLE: str

    #: The source at an address, not yet open: ``make(address, hub, rank)``.
    make: Callable[[Address, Hub, int], LiveSource]


#: Modules of sources by scheme.
SOURCES: Final = Registry[SourceModule](
    "sources",
    {
        scheme: f"{__name__}.{scheme}"
        for scheme in (
            "sensorlogger",
            "sensorserver",
            "phyphox",
            "mqtt",
            "nmea",
            "ubx",
            "gpsd",
            "ntrip",
            "iio",
        )
    },
    kind=SourceModule,
)


def make_sources(urls: Sequence[str], hub: Hub) -> list[LiveSource]:
    """The sources of these URLs, not yet open. Of a stream that two of them have, the last one's is taken.

    Raises InputError for a URL that is none or that the source cannot use.
    """
    if not urls:
        raise InputError("source", "none is given")
    addresses = [parse_address(url) for url in urls]
    return [SOURCES.named(a.scheme, "source").make(a, hub, rank) for rank, a in enumerate(addresses)]
