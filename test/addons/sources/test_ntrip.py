# SPDX-License-Identifier: Apache-2.0
"""Corrections of an NTRIP caster are passed on to the receivers of the same command."""

from __future__ import annotations

import asyncio
import os
from dataclasses import replace

import pytest
from listening import Taken, listen
from receivers import Caster, Port, nmea_epochs

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError

PARTS = [b"\xd3\x00" + bytes([number] * 90) for number in range(20)]


def correct(
    caster: Caster,
    until,
    url: str = "ntrip://user:secret@127.0.0.1:1/NEAR",
    drive: Drive | None = None,
    connected: bool = False,
):
    """A receiver that is corrected until ``until(port, taken)``; the port and what was heard. ``connected``: the drive
    begins once the caster is there."""
    port = Port()

    async def play(sources, taken) -> None:
        async with caster:
            sources[1]._address = replace(sources[1]._address, port=caster.port)
            if drive is not None:
                while sources[0]._stream is None or (connected and not caster.connections):
                    await asyncio.sleep(0.01)
                await port.play(nmea_epochs(drive)[:5])
            while not until(port, taken):
                await asyncio.sleep(0.01)

    taken = listen([f"ubx:{port.path}" if drive is None else f"nmea:{port.path}", url], play)
    port.close()
    return port, taken


@pytest.mark.parametrize("version", [1, 2])
def test_every_byte_reaches_the_receiver(version: int) -> None:
    port, taken = correct(Caster(PARTS, version), lambda port, _: len(port.listen()) >= len(b"".join(PARTS)))
    assert port.heard == b"".join(PARTS)
    assert any("corrections come" in text for text in taken.said)


def test_a_caster_that_closes_is_connected_to_again() -> None:
    caster = Caster(PARTS, close_after=5)
    port, taken = correct(
        caster, lambda port, _: len(port.listen()) >= len(b"".join(PARTS)) + 5 * len(PARTS[0])
    )
    assert port.heard == b"".join(PARTS[:5] + PARTS)
    assert any("closed the connection; trying again" in text for text in taken.said)


def test_the_caster_is_told_the_position(bump: Drive) -> None:
    caster = Caster(PARTS)
    correct(caster, lambda _port, _taken: caster.positions, drive=bump)
    fields = caster.positions[0].decode().split(",")
    assert fields[0] == "$GPGGA" and fields[3] == "N" and fields[5] == "E"
    assert float(fields[2][:2]) + float(fields[2][2:]) / 60.0 == pytest.approx(bump.fix.latitude[4], abs=1e-6)
    assert float(fields[4][:3]) + float(fields[4][3:]) / 60.0 == pytest.approx(
        bump.fix.longitude[4], abs=1e-6
    )


def test_a_caster_that_sends_nothing_before_a_position_gets_one(bump: Drive) -> None:
    """A virtual reference station has no corrections before it knows where."""
    caster = Caster([])
    correct(caster, lambda _port, _taken: caster.positions, drive=bump, connected=True)
    assert caster.connections == 1


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ntrip://user:wrong@127.0.0.1:1/NEAR", "user or password are wrong"),
        ("ntrip://user:secret@127.0.0.1:1/FAR", "has no mountpoint FAR"),
    ],
)
def test_what_another_attempt_would_not_change_is_told_once(url: str, words: str) -> None:
    caster = Caster(PARTS)
    _, taken = correct(caster, lambda _, taken: any(words in text for text in taken.said), url)
    assert caster.connections == 1
    assert not any("secret" in text or "wrong@" in text for text in taken.said)


def test_a_port_that_takes_nothing_makes_nothing_queue_up() -> None:
    """Nobody reads the other end of the port: what does not fit is dropped, and counted."""
    many = [os.urandom(4000) for _ in range(50)]
    port = Port()

    async def play(sources, taken: Taken) -> None:
        async with Caster(many) as caster:
            sources[1]._address = replace(sources[1]._address, port=caster.port)
            while sources[1].received < 199_000:
                await asyncio.sleep(0.01)

    taken = listen([f"ubx:{port.path}", "ntrip://user:secret@127.0.0.1:1/NEAR"], play)
    (device,) = taken.hub.devices.values()
    assert device.counts["bytes of corrections lost"] > 100_000
    port.close()


@pytest.mark.parametrize(
    ("urls", "words"),
    [
        (["ntrip://user:secret@caster/NEAR"], "there is no receiver to correct"),
        (["ntrip://caster/"], "names no mountpoint"),
        (["ntrip://caster/a%0d%0ab"], "has no blanks"),
    ],
)
def test_wrong_urls(urls: list[str], words: str) -> None:
    async def work() -> None:
        for source in make_sources(urls, Hub()):
            await source.start()

    with pytest.raises(InputError, match=words) as caught:
        asyncio.run(work())
    assert "secret" not in str(caught.value)
