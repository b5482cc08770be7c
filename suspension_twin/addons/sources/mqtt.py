# SPDX-License-Identifier: Apache-2.0
"""``mqtt://HOST:PORT/TOPIC``: Sensor Logger's messages from an MQTT broker.

The app publishes (QoS 0) to brokers by WebSocket alone; this end takes them from the same broker over TCP, or by
WebSocket with ``transport=websockets``. The topic is ``sensor-logger`` where none is given. User and password as in any
URL; ``tls=1`` encrypts. Options ``axes`` and ``device`` as of ``sensorlogger``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Final, Literal

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.reasoncodes import ReasonCode

from suspension_twin.addons.sources.common.clock import host_time
from suspension_twin.addons.sources.common.connection import Address, PlainSource
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.sensor_logger import Phones, axes_of
from suspension_twin.errors import InputError

__all__ = ["EXAMPLE", "TITLE", "Mqtt", "make"]

TITLE = "MQTT broker"
EXAMPLE = "mqtt://localhost/sensor-logger"

_PORTS: Final = {
    ("tcp", False): 1883,
    ("tcp", True): 8883,
    ("websockets", False): 8000,
    ("websockets", True): 8884,
}
_LARGEST: Final = 4_000_000  # bytes of a message
_PACKET: Final = _LARGEST + (1 << 16)  # with its topic
_WAITING: Final = 1000  # messages that the event loop may be behind


class _Client(Client):
    """A client that gives a connection up whose broker announces more than a message may have: paho waits for it."""

    def _packet_read(self) -> MQTTErrorCode:
        found = super()._packet_read()
        return MQTTErrorCode.MQTT_ERR_PROTOCOL if self._in_packet["remaining_length"] > _PACKET else found


class Mqtt(PlainSource):
    """One topic of one broker. The client has a thread of its own, which hands messages to the event loop."""

    steps: Sequence[str] = (
        "In Sensor Logger: Settings > Data Streaming > MQTT: on; the broker's address and its WebSocket port.",
        "The topic is the one above; batch period: the shortest. Tap to Test Publish.",
        "Sensors: Accelerometer, Gravity (Android: Total Acceleration as well), Gyroscope, Location; 50 Hz or more.",
        "Mount the phone rigidly, start recording, and keep the app in front.",
    )

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        address.check_options(("transport", "tls", "axes", "device"))
        if not address.host:
            raise InputError(str(address), "names no broker: write mqtt://HOST/TOPIC")
        transport = address.options.get("transport", "tcp")
        if transport not in ("tcp", "websockets"):
            raise InputError(str(address), "transport", f"must be tcp or websockets, is '{transport}'")
        way: Literal["tcp", "websockets"] = "websockets" if transport == "websockets" else "tcp"
        tls = bool(address.number("tls", 0, 0, 1))
        self._topic = address.path.strip("/") or "sensor-logger"
        self._hub, self._name = hub, f"broker {address.host}"
        self._where = address.host, address.port or _PORTS[way, tls]
        self.phones = Phones(hub, rank, axes=axes_of(address), only=address.options.get("device", ""))
        self.refused = 0
        self.notes = [f"MQTT: topic {self._topic} of {self._where[0]}:{self._where[1]}"]
        self._pending = 0
        self._client = _Client(CallbackAPIVersion.VERSION2, transport=way)
        self._client.reconnect_delay_set(1, 5)
        if address.user:
            self._client.username_pw_set(address.user, address.password or None)
        if tls:
            self._client.tls_set()
        self._client.on_connect = self._on_connect
        self._client.on_connect_fail = self._on_connect_fail
        self._client.on_disconnect = self._on_disconnect
        self._client.on_message = self._on_message

    async def start(self) -> None:
        """Nothing can fail for good: the broker may be started later."""
        self._loop = asyncio.get_running_loop()
        self._client.connect_async(*self._where, keepalive=15)
        self._client.loop_start()

    async def run(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        await self.phones.run()

    async def stop(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        self._client.disconnect()
        await asyncio.to_thread(self._client.loop_stop)
        self.phones.finish()

    # On the client's thread

    def _on_connect(
        self, client: Client, _data: object, _flags: object, reason: ReasonCode, _props: object
    ) -> None:
        if reason.is_failure:
            self._hub.notify(
                "error", f"refused {self._name}", f"{self._name}: refuses the connection, {reason}"
            )
        else:
            client.subscribe(self._topic, qos=0)
            self._hub.notify("ok", f"connection {self._name}", f"{self._name}: connected")

    def _on_connect_fail(self, _client: Client, _data: object) -> None:
        self._hub.notify("warn", f"connection {self._name}", f"{self._name}: cannot be reached; trying again")

    def _on_disconnect(
        self, _client: Client, _data: object, _flags: object, reason: ReasonCode, _props: object
    ) -> None:
        if reason.is_failure:
            text = f"{self._name}: the connection was lost ({reason}); trying again"
            self._hub.notify("warn", f"connection {self._name}", text)

    def _on_message(self, _client: Client, _data: object, message: MQTTMessage) -> None:
        if self._pending >= _WAITING or len(message.payload) > _LARGEST:
            self.refused += 1
            return
        self._pending += 1
        self._loop.call_soon_threadsafe(self._feed, bytes(message.payload), host_time())

    # On the event loop

    def _feed(self, body: bytes, arrival: float) -> None:
        self._pending -= 1
        try:
            self.phones.feed(body, arrival)
        except InputError:
            self.refused += 1


#: See ``SourceModule``.
make = Mqtt
