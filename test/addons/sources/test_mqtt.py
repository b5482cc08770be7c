# SPDX-License-Identifier: Apache-2.0
"""Sensor Logger's messages by way of a real MQTT broker."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
from contextlib import asynccontextmanager

import pytest
from amqtt.broker import Broker
from listening import Taken, listen, same_drive
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion
from sensor_logger_app import SensorLoggerApp

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError

logging.getLogger("amqtt").setLevel(logging.CRITICAL)
logging.getLogger("transitions").setLevel(logging.CRITICAL)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@asynccontextmanager
async def broker(port: int):
    """A broker on this port, open to everyone."""
    config = {
        "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}},
        "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    }
    made = Broker(config)
    await made.start()
    try:
        yield made
    finally:
        await made.shutdown()


async def publish(port: int, messages: list[bytes], topic: str = "sensor-logger") -> None:
    """As the app does: one after the other, at most once each."""
    client = Client(CallbackAPIVersion.VERSION2)
    await asyncio.to_thread(client.connect, "127.0.0.1", port)
    client.loop_start()
    for message in messages:
        sent = client.publish(topic, message, qos=0)
        await asyncio.to_thread(sent.wait_for_publish, 10.0)
        await asyncio.sleep(0.005)
    client.disconnect()
    client.loop_stop()


def bodies(app: SensorLoggerApp) -> list[bytes]:
    return [json.dumps(message).encode() for _, message in app.messages()]


async def connected(taken: Taken, times: int = 1) -> None:
    while sum(text.endswith(": connected") and "broker" in text for text in taken.said) < times:
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.2)  # until the subscription has arrived


@pytest.mark.long
def test_a_drive_arrives_as_it_was(bump: Drive) -> None:
    port = free_port()

    async def play(sources, taken) -> None:
        async with broker(port):
            await connected(taken)
            await publish(port, [b"not a message", *bodies(SensorLoggerApp(bump))])
            while taken.count("imu") < len(bump.imu) or taken.count("vel") < len(bump.velocity):
                await asyncio.sleep(0.01)
            assert sources[0].refused == 1

    same_drive(listen(f"mqtt://127.0.0.1:{port}/sensor-logger", play), bump)


@pytest.mark.long
def test_a_broker_that_is_restarted(bump: Drive) -> None:
    port = free_port()
    messages = bodies(SensorLoggerApp(bump))

    async def settled(taken) -> None:
        """Wait until half a second brings nothing more."""
        before = -1
        while before != taken.count("imu"):
            before = taken.count("imu")
            await asyncio.sleep(0.5)

    async def play(_, taken) -> None:
        async with broker(port):
            await connected(taken)
            await asyncio.sleep(1.0)  # what is published before the subscription is there is lost, at QoS 0
            await publish(port, messages[:10], "car/phone")
            await settled(taken)
        async with broker(port):
            await connected(taken, 2)
            await asyncio.sleep(1.0)
            await publish(port, messages[12:], "car/phone")
            await settled(taken)

    taken = listen(f"mqtt://127.0.0.1:{port}/car/phone", play, seconds=30.0)
    # of quality 0 a busy broker may lose more, of which no sample is missed in silence
    lost = taken.hub.devices["phone 5f0c1a7e"].counts["lost messages"]
    each = -(-len(bump.imu) // len(messages))
    assert 2 <= lost < len(messages) // 2
    assert len(bump.imu) - (lost + 1) * each <= taken.count("imu") <= len(bump.imu)


def test_no_broker_is_told(bump: Drive) -> None:
    async def play(_, taken) -> None:
        while not any("cannot be reached" in text for text in taken.said):
            await asyncio.sleep(0.01)

    listen(f"mqtt://127.0.0.1:{free_port()}/", play)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("mqtt:///topic", "names no broker"),
        ("mqtt://a/b?transport=udp", "transport: must be tcp or websockets"),
        ("mqtt://user:secret@a/b?axes=no", "axes: must be one of"),
    ],
)
def test_wrong_urls(url: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make_sources([url], Hub())
    assert "secret" not in str(caught.value)
