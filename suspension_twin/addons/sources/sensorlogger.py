# SPDX-License-Identifier: Apache-2.0
"""``sensorlogger://HOST:PORT``: phones with the app Sensor Logger push to this address, over HTTP or a WebSocket.

Options: ``token`` (needed where the address is open to a network; made and kept if it is not given), ``axes``
(``android`` or ``ios``, found out by itself otherwise), ``device`` (the beginning of the one deviceId to be taken).
"""

from __future__ import annotations

import html
from collections.abc import Sequence

from suspension_twin.addons.sources.common.connection import Address, PlainSource
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.sensor_logger import Phones, axes_of
from suspension_twin.addons.sources.common.server import PushServer
from suspension_twin.errors import InputError

__all__ = ["EXAMPLE", "TITLE", "SensorLogger", "make"]

TITLE = "Sensor Logger"
EXAMPLE = "sensorlogger://0.0.0.0:8000"


class SensorLogger(PlainSource):
    """The server and its phones."""

    steps: Sequence[str] = (
        "Phone and laptop are in one network, such as the phone's hotspot.",
        "In Sensor Logger: Settings > Data Streaming > HTTP Push: on; batch period: the shortest.",
        "Push URL: the address above; the QR code opens it in the phone's browser, to be copied.",
        "Tap to Test Pushing: it must say that the message was sent.",
        "Sensors: Accelerometer, Gravity (Android: Total Acceleration as well), Gyroscope, Location; 50 Hz or more.",
        "Mount the phone rigidly, start recording, and keep the app in front.",
    )

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        address.check_options(("token", "axes", "device"))
        if address.path.strip("/"):
            raise InputError(str(address), "has a path: write sensorlogger://HOST:PORT")
        self.phones = Phones(hub, rank, axes=axes_of(address), only=address.options.get("device", ""))
        self.server = PushServer(address, self.phones.feed)
        self.server.page = self._page
        self.server.is_spare = self.phones.is_spare
        self.notes = []
        if self.server.open:
            where = f"Listens on {self.server.host}, which others reach"
            self.reached = f"{where}: who has the address with its token can send"

    async def start(self) -> None:
        """Listen; InputError where the port is taken."""
        await self.server.start()
        self.code = self.server.url()
        self.notes = [f"Sensor Logger: push to {self.code}"]

    def _page(self) -> str:
        """The page for the phone's browser: the address to copy, and the steps of the set-up."""
        steps = "".join(f"<li>{html.escape(step)}</li>" for step in self.steps)
        return (
            "<!doctype html><meta name=viewport content='width=device-width'><title>suspension_twin</title>"
            "<body style='font: 1.2em sans-serif; margin: 1em'><p>Push URL:</p>"
            f"<p><input readonly style='width: 100%; font-size: 1em' value='{html.escape(self.code)}' "
            f"onclick='this.select(); document.execCommand(\"copy\")'></p><ol>{steps}</ol>"
        )

    async def run(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        await self.phones.run()

    async def stop(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        await self.server.stop()
        self.phones.finish()


#: See ``SourceModule``.
make = SensorLogger
