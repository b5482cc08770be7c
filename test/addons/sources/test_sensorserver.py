# SPDX-License-Identifier: Apache-2.0
"""A phone with SensorServer: what it streams is the drive, through a lost connection, too."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest
from listening import Taken, listen
from sensor_server_app import SensorServerApp

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError


def hear(app: SensorServerApp, until) -> Taken:
    """What is heard of the app."""

    async def play(sources, taken) -> None:
        async with app:
            sources[0]._base = f"ws://127.0.0.1:{app.port}"
            await app.play()
            while not until(taken):
                await asyncio.sleep(0.01)

    return listen("sensorserver://127.0.0.1:1", play)


def test_a_drive_arrives_as_it_was(bump: Drive) -> None:
    taken = hear(
        SensorServerApp(bump),
        lambda t: t.count("imu") >= len(bump.imu) and t.count("vel") >= len(bump.velocity),
    )
    np.testing.assert_allclose(taken.imu.specific_force, bump.imu.specific_force, atol=1e-6)
    np.testing.assert_allclose(taken.imu.angular_rate, bump.imu.angular_rate, atol=1e-6)
    np.testing.assert_allclose(taken.fix.latitude, bump.fix.latitude, atol=1e-9)
    # The stamps are those of the phone since its boot: now is when the first of them came.
    shift = taken.imu.t[0] - bump.imu.t[0]
    np.testing.assert_allclose(taken.imu.t - shift, bump.imu.t, atol=1e-6)
    np.testing.assert_allclose(taken.fix.t - shift, bump.fix.t, atol=1e-6)
    assert abs(taken.imu.t[0] - taken.hub.now()) < 60.0


def test_a_lost_connection_is_made_again(bump: Drive) -> None:
    app = SensorServerApp(bump, drop_after=500)
    taken = hear(app, lambda t: t.count("imu") > len(bump.imu) - 60)
    assert np.diff(taken.imu.t).min() > 0
    assert any("connection was closed; trying again" in text for text in taken.said)


def test_old_androids_stamp_positions_in_utc(bump: Drive) -> None:
    short = replace(bump, imu=bump.imu.select(slice(0, 300)), fix=bump.fix.select(slice(0, 30)))
    taken = hear(SensorServerApp(short, android=7), lambda t: t.count("fix") >= 30)
    np.testing.assert_allclose(taken.fix.t, short.fix.t, atol=1e-3)


def test_a_missing_sensor_is_told_and_not_asked_for_again(bump: Drive) -> None:
    app = SensorServerApp(bump, has=("android.sensor.accelerometer",))

    async def play(sources, taken) -> None:
        async with app:
            sources[0]._base = f"ws://127.0.0.1:{app.port}"
            while not any("lacks the sensor" in text for text in taken.said):
                await asyncio.sleep(0.01)

    listen("sensorserver://127.0.0.1:1", play)


@pytest.mark.parametrize(
    "message",
    [
        "",
        "[]",
        "{}",
        '{"values": [1, 2], "timestamp": 1, "type": "android.sensor.gyroscope"}',
        '{"values": [1, 2, null], "timestamp": 1, "type": "android.sensor.gyroscope"}',
        '{"values": [1, 2, NaN], "timestamp": 1, "type": "android.sensor.gyroscope"}',
        '{"values": 3, "timestamp": 1, "type": "android.sensor.gyroscope"}',
        '{"values": [1, 2, 3], "timestamp": -1, "type": "android.sensor.gyroscope"}',
    ],
)
def test_a_message_with_a_wrong_field_is_left_out(message: str) -> None:
    from aiohttp import web

    async def serve(request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        await socket.send_str(message)
        async for _ in socket:
            pass
        return socket

    async def play(sources, taken) -> None:
        app = web.Application()
        app.router.add_get("/{path:.*}", serve)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        sources[0]._base = f"ws://127.0.0.1:{runner.addresses[0][1]}"
        while not sources[0].device.counts["messages with a wrong field"]:
            await asyncio.sleep(0.01)
        await runner.cleanup()

    taken = listen("sensorserver://127.0.0.1:1", play)
    assert not taken.packets


def test_wrong_urls() -> None:
    for url, words in (("sensorserver:", "is no source"), ("sensorserver:///x", "names no host")):
        with pytest.raises(InputError, match=words):
            make_sources([url], Hub())
