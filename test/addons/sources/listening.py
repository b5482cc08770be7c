# SPDX-License-Identifier: Apache-2.0
"""Listening to sources in tests: what a hub gives, and whether it is the drive that was played."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable

import numpy as np

from suspension_twin.addons.sources import LiveSource, make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.runner import running
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData


class Taken:
    """Everything that a hub has given."""

    def __init__(self, hub: Hub) -> None:
        self.hub = hub
        self.packets = []
        self.said: list[str] = []

    def take(self) -> None:
        self.packets += self.hub.take()
        self.said += [finding.text for finding in self.hub.events()]

    def _of(self, stream: str) -> list:
        return [p.samples for p in self.packets if p.stream == stream]

    @property
    def imu(self) -> ImuData:
        return ImuData.joined(self._of("imu"))

    @property
    def fix(self) -> FixData:
        return FixData.joined(self._of("fix"))

    @property
    def velocity(self) -> VelocityData:
        return VelocityData.joined(self._of("vel"))

    def count(self, stream: str) -> int:
        return sum(len(samples) for samples in self._of(stream))


def listen(
    url: str | list[str],
    play: Callable[[list[LiveSource], Taken], Awaitable[object]],
    until: Callable[[Taken], bool] | None = None,
    seconds: float = 20.0,
) -> Taken:
    """Open the sources, have ``play`` send, and take until ``until`` holds."""

    async def work() -> Taken:
        hub = Hub()
        taken = Taken(hub)
        sources = make_sources([url] if isinstance(url, str) else url, hub)
        async with running(sources, hub):
            player = asyncio.ensure_future(play(sources, taken))
            end = time.monotonic() + seconds
            while not (player.done() and (until is None or until(taken))):
                assert time.monotonic() < end, f"waited {seconds} s; heard {taken.said}"
                await asyncio.sleep(0.01)
                taken.take()
            player.result()
        taken.take()
        return taken

    return asyncio.run(work())


def same_drive(taken: Taken, drive: Drive, *, force: float = 1e-6) -> None:
    """The samples taken are those of the drive."""
    np.testing.assert_allclose(taken.imu.t, drive.imu.t, rtol=0, atol=1e-6)
    np.testing.assert_allclose(taken.imu.specific_force, drive.imu.specific_force, atol=force)
    np.testing.assert_allclose(taken.imu.angular_rate, drive.imu.angular_rate, atol=1e-6)
    np.testing.assert_allclose(taken.fix.t, drive.fix.t, rtol=0, atol=1e-6)
    np.testing.assert_allclose(taken.fix.latitude, drive.fix.latitude, atol=1e-9)
    np.testing.assert_allclose(taken.fix.longitude, drive.fix.longitude, atol=1e-9)
    np.testing.assert_allclose(taken.fix.sigma, drive.fix.sigma, atol=1e-9)
    np.testing.assert_allclose(taken.velocity.enu[:, :2], drive.velocity.enu[:, :2], atol=0.01)
