# SPDX-License-Identifier: Apache-2.0
"""The node of live phones, receivers and IMUs: their samples on ``imu/data_raw``, ``fix``, ``vel``, ``heading``.

What they are, how they are reached and how their clocks are brought together is
:mod:`suspension_twin.addons.sources`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from suspension_twin.addons.sources.common.clock import host_time
from suspension_twin.addons.sources.common.hub import Hub, Packet
from suspension_twin.addons.sources.common.report import device_line, device_values, findings
from suspension_twin.addons.sources.common.runner import SourceLoop, SourceThread
from suspension_twin.drive.checks import nanoseconds
from suspension_twin.drive.types import FixData, ImuData
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.messages import SENSORS
from suspension_twin.nodes.parameters import FOLDERS, TWIN, Param, twin_of
from suspension_twin.nodes.topics import ERROR, NS, OK, WARN, Embedding, Output

__all__ = ["SourceNode"]

_LEVELS = {"ok": OK, "warn": WARN, "error": ERROR}


class SourceNode(TwinNode):
    """Live sources in; messages of sensors out.

    Alone, its sources have a thread of their own, and the executor delivers what they hand over. A node that is
    ``driven`` receives and delivers while :meth:`run` is called, on the caller's thread: neither a change of threads
    nor an executor's wait set lies between a sample and the twin.
    """

    parameters = (
        TWIN,
        FOLDERS,
        Param(
            "sources",
            "",
            "URLs of the sources, separated by spaces, such as sensorlogger://0.0.0.0:8000 ubx:/dev/ttyACM0.",
            read_only=True,
        ),
    )

    def __init__(self, embedding: Embedding | None = None, *, driven: bool = False) -> None:
        super().__init__("source", embedding)
        twin = twin_of(self.values)
        self._frames = ("imu_link", "gps_link") if twin is None else (twin.imu.frame, twin.gps.frame)
        self._ways: dict[str, tuple[Output, Any, Callable[[Any, Any, int], None]]] = {
            stream: (self.offer(kind, topic), kind(), fill) for stream, (kind, topic, fill) in SENSORS.items()
        }
        #: What has been received is handed to this, too, if it is set: a recorder.
        self.tap: Callable[[Packet], None] | None = None
        wake = self.deliver if driven else self.create_guard_condition(self.deliver).trigger
        self.hub = Hub(wake=wake)
        try:
            self._receiver = (SourceLoop if driven else SourceThread)(
                self.values["sources"].split(), self.hub
            )
        except BaseException:
            self.destroy_node()
            raise
        if not driven:
            reached = [s.reached for s in self._receiver.sources if s.reached]
            for note in (*reached, *self._receiver.notes):
                # not by the log, which goes out on /rosout: there is a token in it
                print(note, file=sys.stderr, flush=True)

    @property
    def notes(self) -> list[str]:
        """Addresses and settings for the user, a line each."""
        return self._receiver.notes

    def end(self) -> None:
        """Stop the sources, and deliver what they have received."""
        self._receiver.close()
        self.deliver()

    def destroy_node(self) -> None:
        """Stop the sources, then as in the base class."""
        if hasattr(self, "_receiver"):
            self._receiver.close()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def run(self, seconds: float) -> None:
        """Receive and deliver for so long; for a node that is driven."""
        assert isinstance(self._receiver, SourceLoop)
        self._receiver.run(seconds)

    def run_until_delivered(self, seconds: float) -> None:
        """Receive and deliver until samples have been delivered, for so long at most; for a node that is driven."""
        assert isinstance(self._receiver, SourceLoop)
        self._receiver.run_until_delivered(seconds)

    def deliver(self) -> None:
        """Publish what has come."""
        for finding in self.hub.events():
            self.note(
                f"{finding.code}: {finding.text.partition(':')[0]}", _LEVELS[finding.level], finding.text
            )
        for packet in self.hub.take():
            if self.tap is not None:
                self.tap(packet)
            samples, (output, message, fill) = packet.samples, self._ways[packet.stream]
            if isinstance(samples, ImuData):
                samples = replace(samples, frame=self._frames[0])
            elif isinstance(samples, FixData):
                samples = replace(samples, frame=self._frames[1])
            stamp = message.header.stamp
            for i, ns in enumerate(nanoseconds(samples.t).tolist()):
                self.outbox.enter()
                try:
                    stamp.sec, stamp.nanosec = divmod(ns, NS)
                    fill(samples, message, i)
                    output.send(message)
                finally:
                    self.outbox.leave()
            if isinstance(self._receiver, SourceLoop):
                self._receiver.delivered()

    def report(self) -> None:
        """See the base class."""
        now = host_time()
        self.show_findings(findings(self.hub, now))
        values = self.health.values
        if self.hub.dropped:
            values["samples dropped, this process was too slow"] = str(self.hub.dropped)
        for stream, device in list(self.hub.chosen.items()):
            values[f"{stream} from"] = device.name
        for device in list(self.hub.devices.values()):
            values[device.name] = device_line(device, now)
            for name, value in device_values(device, now).items():
                values[f"{device.name}: {name}"] = value
