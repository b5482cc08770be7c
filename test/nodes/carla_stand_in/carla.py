# SPDX-License-Identifier: Apache-2.0
"""Stand-in for CARLA's Python module: the names that a mirror of the twin needs, and a world that draws by itself.

A transform is seen from the next frame on, as in CARLA. When the vehicle is destroyed, all that was drawn is written to
the file that the environment variable ``CARLA_STAND_IN`` names: a row of wall time, location and rotation a frame.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

#: Frames a second: neither the rate of the IMU nor that of the messages.
RATE = 47.0


class Location(NamedTuple):
    """m; x forward, y right, z up."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Rotation(NamedTuple):
    """Degrees."""

    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


class Transform(NamedTuple):
    location: Location = Location()
    rotation: Rotation = Rotation()


class Timestamp(NamedTuple):
    frame: int
    delta_seconds: float


class WorldSnapshot(NamedTuple):
    timestamp: Timestamp


class Vehicle:
    """One that stands where it is put, and falls unless its physics are off."""

    def __init__(self, at: Transform) -> None:
        self._wanted, self._physics = at, True
        self._drawn: list[list[float]] = []

    def set_simulate_physics(self, enabled: bool) -> None:
        self._physics = enabled

    def set_transform(self, transform: Transform) -> None:
        assert not self._physics
        self._wanted = transform

    def draw(self) -> None:
        self._drawn.append([time.time(), *self._wanted.location, *self._wanted.rotation])

    def destroy(self) -> bool:
        Path(os.environ["CARLA_STAND_IN"]).write_text(json.dumps(self._drawn), encoding="utf-8")
        return True


class World:
    def __init__(self) -> None:
        self._callbacks: dict[int, Callable[[WorldSnapshot], None]] = {}
        self._vehicles: list[Vehicle] = []
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        for frame in range(10**6):
            for vehicle in self._vehicles:
                vehicle.draw()
            for callback in list(self._callbacks.values()):
                callback(WorldSnapshot(Timestamp(frame, 1.0 / RATE)))
            time.sleep(1.0 / RATE)

    def get_blueprint_library(self) -> World:
        return self

    def filter(self, pattern: str) -> list[str]:
        return [pattern.replace("*", "stand_in")]

    def get_map(self) -> World:
        return self

    def get_spawn_points(self) -> list[Transform]:
        return [Transform()]

    def spawn_actor(self, blueprint: str, transform: Transform) -> Vehicle:
        self._vehicles.append(Vehicle(transform))
        return self._vehicles[-1]

    def on_tick(self, callback: Callable[[WorldSnapshot], None]) -> int:
        self._callbacks[len(self._callbacks)] = callback
        return len(self._callbacks) - 1

    def remove_on_tick(self, callback_id: int) -> None:
        del self._callbacks[callback_id]


class Client:
    def __init__(self, host: str, port: int) -> None:
        assert host and port == 2000

    def set_timeout(self, seconds: float) -> None:
        assert seconds > 0.0

    def get_world(self) -> World:
        return World()
