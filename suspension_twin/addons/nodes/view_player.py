# SPDX-License-Identifier: Apache-2.0
"""The player of a recording, as the page shows and leads it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import TypedDict

from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from suspension_twin.addons.view.live import LiveView
from suspension_twin.errors import InputError
from suspension_twin.nodes.base import TwinNode

__all__ = ["ViewPlayer"]


class PlayerState(TypedDict):
    """Length and position in s, times real time (None: full speed)."""

    duration: float
    position: float
    rate: float | None
    paused: bool
    ended: bool


class ViewPlayer:
    """Known while it says how it is: ``state`` is None without one."""

    def __init__(self, node: TwinNode, view: LiveView) -> None:
        self.state: PlayerState | None = None
        self.client = node.create_client(SetParameters, "bag_player/set_parameters")
        self._view, self._seen = view, 0.0

    def show(self, values: Mapping[str, str]) -> None:
        """Values of its diagnostics."""
        self._seen = time.monotonic()
        rate = float(values["rate"])
        self._view.count_from(int(values["start (ns)"]))
        self.state = {
            "duration": float(values["duration"]),
            "position": round(float(values["position"]), 1),
            "rate": rate if math.isfinite(rate) else None,
            "paused": values["paused"] == "True",
            "ended": values["ended"] == "True",
        }
        self._view.tell("player", self.state)

    def forget(self, before: float) -> None:
        """It is gone where it was last heard of before that time."""
        if self.state is not None and self._seen < before:
            self.state = None
            self._view.tell("player", None)

    def pause(self, _number: float | None) -> str:
        """Stand still."""
        return self._set(paused=True)

    def play(self, _number: float | None) -> str:
        """Go on."""
        return self._set(paused=False)

    def seek(self, number: float | None) -> str:
        """Go on from so many s of the recording, or its end."""
        most = math.inf if self.state is None else self.state["duration"]
        said = self._set(seek=min(max(number or 0.0, 0.0), most), paused=False)
        self._view.clear()
        return said

    def speed(self, number: float | None) -> str:
        """Times real time; InputError beyond 0.01 to 100."""
        if self.state is not None and not 0.01 <= (number or 0.0) <= 100.0:
            raise InputError("speed", "must be from 0.01 to 100 times real time")
        return self._set(rate=number)

    def _set(self, **values: object) -> str:
        if self.state is None or not self.client.service_is_ready():
            raise InputError("player", "no recording is being replayed")
        wanted = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        self.client.call_async(SetParameters.Request(parameters=wanted))
        return ""
