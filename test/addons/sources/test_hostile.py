# SPDX-License-Identifier: Apache-2.0
"""What a phone, receiver or broker may send: a source goes on, and a terminal is not filled."""

from __future__ import annotations

import asyncio
import logging
import socket
import struct

import pytest
from listening import listen

from suspension_twin.addons.sources.common.connection import keep_connected
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.cli.main import main

GOOD = b"$GPGGA,120000.00,4724.150,N,01917.040,E,1,10,1.0,100.0,M,40.0,M,,*5D\r\n"


def framed(text: str) -> bytes:
    code = 0
    for byte in text.encode():
        code ^= byte
    return f"${text}*{code:02X}\r\n".encode()


def ubx(payload: bytes) -> bytes:
    body, a, b = b"\x01\x07" + struct.pack("<H", len(payload)) + payload, 0, 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes([a, b])


@pytest.mark.parametrize(
    ("scheme", "sent"),
    [
        ("nmea", framed("GPRMC,120000.00") + framed("GPGGA,120001.00") + framed("GPGGA,120002.00")),
        ("nmea", framed("GPRMC,120000.00,A") * 3 + framed("GPGST,120001.00,1") * 2),
        ("ubx", ubx(bytes(4) + struct.pack("<HBBBBBB", 60000, 13, 40, 25, 61, 61, 7) + bytes(80)) * 3),
        ("ubx", ubx(bytes(10)) * 3),
        ("gpsd", b'{"class":"TPV","mode":3,"time":"9999-99-99","lat":[],"lon":{}}\n' + b"[" * 60_000 + b"\n"),
    ],
)
def test_a_receiver_that_sends_wrong_contents_stays_connected(scheme, sent):
    connections = []

    async def play(sources, taken):
        async def serve(reader, writer):
            connections.append(writer)
            for _ in range(5):
                writer.write(sent)
                await writer.drain()
                await asyncio.sleep(0.05)

        server = await asyncio.start_server(serve, "127.0.0.1", port)
        await asyncio.sleep(1.2)
        server.close()

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    said = listen(f"{scheme}://127.0.0.1:{port}", play).said
    assert len(connections) == 1
    assert not any("started again" in line or "cannot be read (" in line for line in said), said


def test_whatever_a_session_raises_is_one_line_and_tried_again():
    async def work():
        hub, tries = Hub(), []

        async def session():
            tries.append(1)
            raise TypeError(f"unhashable {'x' * 10_000} {len(tries)}")

        running = asyncio.ensure_future(keep_connected(hub, "phone", session))
        await asyncio.sleep(1.2)
        running.cancel()
        return len(tries), [finding.text for finding in hub.events()]

    tries, said = asyncio.run(work())
    assert tries >= 2 and said == ["phone: sends what cannot be read (TypeError); trying again"]


def test_of_a_kind_of_event_a_few_are_shown_and_all_are_short():
    hub = Hub()
    for number in range(1000):
        hub.notify("warn", "connection", f"answers {number} {'x' * 10_000}\n{number}")
    said = [finding.text for finding in hub.events()]
    assert 1 <= len(said) <= 5 and max(map(len, said)) <= 300 and all(text.isprintable() for text in said)


def test_the_log_of_asyncio_is_a_few_lines(caplog):
    log = logging.getLogger("asyncio")
    for number in range(1000):
        try:
            raise ValueError("y" * 5000)
        except ValueError:
            log.exception("Error %d on transport", number)
    assert len(caplog.records) <= 5 and "Traceback" not in caplog.text and len(caplog.text) < 1000


@pytest.mark.parametrize("command", ["record", "connect"])
def test_who_else_can_send_is_the_first_line(command, tmp_path, capfd):
    out = ["--out", str(tmp_path / "bag"), "--source"] if command == "record" else []
    assert main([command, *out, "sensorlogger://0.0.0.0:0?token=12345678", "--seconds", "0.2"]) == 1
    said, errors = capfd.readouterr()
    assert errors.startswith("Listens on 0.0.0.0, which others reach") and "Listens" not in said
