# SPDX-License-Identifier: Apache-2.0
"""A receiver that sends NMEA sentences on a serial port."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from listening import Taken, listen
from receivers import Port, nmea_epochs, sentence, serve_lines

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.nmea import Nmea
from suspension_twin.drive.clocks import iso_to_posix
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError


def hear(parts: list[bytes], fixes: int, cut: int = 0) -> Taken:
    """What is heard of a receiver that sends these parts."""
    port = Port()

    async def play(sources, taken) -> None:
        while sources[0]._stream is None:
            await asyncio.sleep(0.01)
        await port.play(parts, cut=cut)
        while taken.count("fix") < fixes:
            await asyncio.sleep(0.01)

    taken = listen(f"nmea:{port.path}", play)
    port.close()
    return taken


def test_a_drive_arrives_as_it_was(bump: Drive) -> None:
    # In pieces that end anywhere, with a broken sentence among them.
    parts = nmea_epochs(bump, heading=90.0)
    parts[10] = b"\x00$GNGGA,rubbish*00\r\n$GNRMC,12" + parts[10]
    taken = hear(parts, len(bump.fix), cut=37)
    fix = taken.fix
    np.testing.assert_allclose(fix.t, bump.fix.t, atol=0.0051)  # as receivers round
    np.testing.assert_allclose(fix.latitude, bump.fix.latitude, atol=2e-9)
    np.testing.assert_allclose(fix.longitude, bump.fix.longitude, atol=2e-9)
    np.testing.assert_allclose(fix.altitude, bump.fix.altitude, atol=1e-4)
    np.testing.assert_allclose(fix.sigma, bump.fix.sigma, atol=1e-4)
    assert set(fix.status) == {2}
    np.testing.assert_allclose(taken.velocity.enu[:, :2], bump.velocity.enu[:, :2], atol=0.005)
    (heading,) = {round(float(p.samples.yaw[0]), 6) for p in taken.packets if p.stream == "heading"}
    assert heading == 0.0  # east
    assert taken.hub.devices["receiver " + Path(taken.packets[0].device.split()[1]).name].counts[
        "sentences that cannot be read"
    ]


def test_without_gst_and_over_tcp(bump: Drive) -> None:
    async def play(sources, taken) -> None:
        server, port, _ = await serve_lines(nmea_epochs(bump, quality=1, gst=False))
        sources[0].address = replace(sources[0].address, port=port)
        while sources[0]._stream is None:
            await asyncio.sleep(0.01)
        sources[0]._stream.write(b"\n")
        while taken.count("fix") < len(bump.fix) - 1:  # the last epoch ends with the next
            await asyncio.sleep(0.01)
        server.close()

    taken = listen("nmea://127.0.0.1:1", play)
    assert np.isnan(taken.fix.sigma).all() and set(taken.fix.status) == {0}


def test_epochs_without_a_fix_give_none(bump: Drive) -> None:
    parts = nmea_epochs(bump, quality=0)[:20] + nmea_epochs(bump)[20:]
    taken = hear(parts, len(bump.fix) - 20)
    assert len(taken.fix) == len(bump.fix) - 20
    assert taken.fix.t[0] == pytest.approx(bump.fix.t[20], abs=0.006)


@pytest.mark.parametrize("order", [("GGA", "RMC"), ("RMC", "GGA")])
@pytest.mark.parametrize("rate", [1, 5, 10])
@pytest.mark.parametrize("early", [-0.4, 0.1, 3.0])
def test_midnight(order: tuple[str, str], rate: int, early: float) -> None:
    """The date comes once a second, with RMC, and behind the position of its epoch or before it."""
    midnight = iso_to_posix("2024-05-01T00:00:00")
    hub = Hub()
    (source,) = make_sources(["nmea://127.0.0.1:9"], hub)
    assert isinstance(source, Nmea)
    times = midnight + np.arange(-3 * rate, 3 * rate) / rate
    for k, t in enumerate(times.tolist()):
        at = datetime.fromtimestamp(round(t, 2), timezone.utc)
        clock = f"{at:%H%M%S}.{at.microsecond // 10_000:02d}"
        bodies = {"GGA": f"GPGGA,{clock},4700.{k:04d},N,01100.0000,E,1,12,0.8,,M,,M,,"}
        if k % rate == 0:
            bodies["RMC"] = f"GPRMC,{clock},A,4700.0000,N,01100.0000,E,10.0,90.0,{at:%d%m%y},,,A"
        for kind in order:
            if kind in bodies:
                source.feed(sentence(bodies[kind]), t + early)
    found = [p.samples for p in hub.take() if p.stream == "fix"]
    t = np.concatenate([fix.t for fix in found])
    np.testing.assert_allclose(t, times[: t.size], atol=1e-6)
    assert t.size >= times.size - 1
    assert np.isnan(np.concatenate([fix.altitude for fix in found])).all()  # it was not given


def test_a_wrong_speed_is_doubted() -> None:
    port = Port()

    async def play(sources, taken) -> None:
        while sources[0]._stream is None:
            await asyncio.sleep(0.01)
        await port.play([bytes(range(128, 255)) * 20])
        while not any("try another ?baud=" in text for text in taken.said):
            await asyncio.sleep(0.01)

    listen(f"nmea:{port.path}?baud=4800", play)
    port.close()


def test_a_receiver_that_is_unplugged_and_plugged_in_again(bump: Drive, tmp_path: Path) -> None:
    link, first, second = tmp_path / "gps", Port(), Port()
    link.symlink_to(first.path)
    parts = nmea_epochs(bump)

    async def play(sources, taken) -> None:
        while sources[0]._stream is None:
            await asyncio.sleep(0.01)
        await first.play(parts[:30])
        first.close()
        link.unlink()
        while not any("trying again" in text for text in taken.said):
            await asyncio.sleep(0.01)
        link.symlink_to(second.path)
        while sources[0]._stream is None:
            await asyncio.sleep(0.01)
        await second.play(parts[40:])
        while taken.count("fix") < len(parts) - 12:
            await asyncio.sleep(0.01)

    taken = listen(f"nmea:{link}", play)
    second.close()
    assert np.diff(taken.fix.t).min() > 0 and math.isclose(np.diff(taken.fix.t).max(), 1.1, abs_tol=0.15)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("nmea:/no/such/port", "No such file"),
        ("nmea:LOG", "is no serial port"),
        ("nmea:/dev/null?baud=1234", "baud: must be"),
        ("nmea:/dev/null?baud=12345", "baud: must be one of"),
        ("nmea://host", "has no port"),
    ],
)
def test_wrong_urls(url: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "log").write_text("$GNGGA")

    async def work() -> None:
        for source in make_sources([url.replace("LOG", str(tmp_path / "log"))], Hub()):
            await source.start()

    with pytest.raises(InputError, match=words):
        asyncio.run(work())
