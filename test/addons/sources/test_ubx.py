# SPDX-License-Identifier: Apache-2.0
"""A u-blox receiver in its binary protocol."""

from __future__ import annotations

import asyncio
import math
import struct

import numpy as np
import pytest
from listening import Taken, listen
from receivers import Port, nmea_epochs, ubx_epochs

from suspension_twin.drive.types import Drive


def hear(parts: list[bytes], fixes: int, options: str = "", cut: int = 0) -> tuple[Taken, Port]:
    """What is heard of a receiver that sends these parts."""
    port = Port()

    async def play(sources, taken) -> None:
        while sources[0]._stream is None:
            await asyncio.sleep(0.01)
        await port.play(parts, cut=cut)
        while taken.count("fix") < fixes:
            await asyncio.sleep(0.01)

    taken = listen(f"ubx:{port.path}{options}", play)
    port.listen()
    port.close()
    return taken, port


def test_a_drive_arrives_as_it_was(bump: Drive) -> None:
    parts = ubx_epochs(bump)
    broken = bytearray(parts[5])
    broken[20] ^= 1
    parts[5:5] = [bytes(broken), b"\xb5\x62\x01\x07\xff\xff", nmea_epochs(bump)[5]]
    taken, _ = hear(parts, len(bump.fix), cut=41)
    fix = taken.fix
    assert len(fix) == len(bump.fix)
    np.testing.assert_allclose(fix.t, bump.fix.t, atol=1e-6)
    # The precise part of the first epoch is not waited for: nothing tells yet that it comes.
    np.testing.assert_allclose(fix.latitude[1:], bump.fix.latitude[1:], atol=6e-10)
    np.testing.assert_allclose(fix.longitude[1:], bump.fix.longitude[1:], atol=6e-10)
    np.testing.assert_allclose(fix.altitude[1:], bump.fix.altitude[1:], atol=1e-4)
    np.testing.assert_allclose(fix.sigma[1:], bump.fix.sigma[1:], atol=1e-4)
    np.testing.assert_allclose(taken.velocity.enu, bump.velocity.enu, atol=6e-4)
    assert set(fix.status) == {2}
    (device,) = taken.hub.devices.values()
    assert device.counts["frames with a wrong checksum"] >= 1


def test_without_the_precise_position_it_is_that_of_pvt(bump: Drive) -> None:
    taken, _ = hear(ubx_epochs(bump, precise=False), len(bump.fix))
    np.testing.assert_allclose(taken.fix.latitude, bump.fix.latitude, atol=1.01e-7)
    assert np.abs(taken.fix.latitude - bump.fix.latitude).max() > 1e-8


@pytest.mark.parametrize(("option", "yaw"), [("", None), ("?heading=0", 60.0), ("?heading=90", 150.0)])
def test_a_second_antenna_gives_the_heading_where_it_is_asked_for(
    bump: Drive, option: str, yaw: float | None
) -> None:
    taken, _ = hear(ubx_epochs(bump, heading=30.0)[:20], 20, option)
    headings = {round(math.degrees(p.samples.yaw[0]), 3) for p in taken.packets if p.stream == "heading"}
    assert headings == ({yaw} if yaw is not None else set())


def test_a_rate_sets_the_receiver_up(bump: Drive) -> None:
    _, port = hear(ubx_epochs(bump)[:5], 5, "?rate=10")
    start = port.heard.index(b"\xb5\x62\x06\x8a")  # CFG-VALSET
    size = int.from_bytes(port.heard[start + 4 : start + 6], "little")
    payload = port.heard[start + 6 : start + 6 + size]
    assert payload[1] == 1  # the layer that is lost when the receiver is switched off, alone
    pairs = {}
    at = 4
    while at < len(payload):
        (key,) = struct.unpack_from("<I", payload, at)
        width = {1: 1, 2: 1, 3: 2, 4: 4}[key >> 28 & 7]
        pairs[key] = int.from_bytes(payload[at + 4 : at + 4 + width], "little")
        at += 4 + width
    assert pairs[0x30210001] == 100  # CFG-RATE-MEAS in ms
    assert pairs[0x20910009] == 1  # CFG-MSGOUT-UBX_NAV_PVT_USB


def test_a_receiver_that_sends_nmea_alone_is_told(bump: Drive) -> None:
    port = Port()

    async def play(sources, taken) -> None:
        while sources[0]._stream is None:
            await asyncio.sleep(0.01)
        await port.play(nmea_epochs(bump)[:20])
        while not any("read it as nmea:" in text for text in taken.said):
            await asyncio.sleep(0.01)

    listen(f"ubx:{port.path}", play)
    port.close()
