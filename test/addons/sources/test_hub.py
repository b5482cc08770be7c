# SPDX-License-Identifier: Apache-2.0
"""What a device does to positions and velocities before they are handed on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from suspension_twin.addons.sources.common.hub import Device, Hub
from suspension_twin.addons.sources.common.sensor_logger import Phones
from suspension_twin.drive.types import FixData, ImuData, VelocityData

START = 1_700_000_000.0


def fix(t: float, latitude: float, altitude: float = 500.0) -> FixData:
    place = np.array([latitude]), np.array([11.0]), np.array([altitude])
    return FixData(np.array([t]), *place, np.zeros(1, dtype=np.int8), np.full((1, 3), 3.0))


def velocity(t: float, north: float, up: float = 0.0) -> VelocityData:
    return VelocityData(np.array([t]), np.array([[0.0, north, up]]))


@pytest.fixture
def hub() -> Hub:
    return Hub()


@pytest.fixture
def device(hub: Hub) -> Device:
    found = hub.device("receiver")
    assert found is not None
    return found


def taken(hub: Hub, stream: str) -> list[np.ndarray]:
    return [p.samples.t for p in hub.take() if p.stream == stream]


@pytest.mark.parametrize(("computed", "sent"), [(1, 10), (1, 5), (5, 25), (2, 50)])
def test_held_positions_are_handed_on_once(hub: Hub, device: Device, computed: int, sent: int) -> None:
    """With the velocities beside them; while it stands, at the receiver's own pace."""
    for i in range(30 * sent):
        t, own = START + i / sent, np.floor(i / sent * computed + 1e-9) / computed
        speed = 8.0 if own < 15 else 0.0
        device.fix(fix(t, 47.0 + 7e-5 * min(own, 15.0)), t)
        device.velocity(velocity(t, speed + (0.01 * (own % 2) if speed else 0.0)), t)
    packets = hub.take()
    t = np.concatenate([p.samples.t for p in packets if p.stream == "fix"]) - START
    later = t[t > 3 / computed]  # it has to see the receiver's pace first
    moving = later[later < 15]
    np.testing.assert_allclose(np.diff(moving), 1 / computed, atol=1e-6)
    assert np.diff(later).max() <= 1.5 / computed + 1 / sent
    assert sum(p.stream == "vel" for p in packets) == t.size
    assert device.counts["fixes that repeat the one before or are interpolated"] == 30 * sent - t.size


def test_a_receivers_own_positions_are_all_handed_on(hub: Hub, device: Device) -> None:
    for i in range(300):
        device.fix(fix(START + i / 10, 47.0 + 1e-6 * max(i - 100, 0) * (i < 200)), START + i / 10)
    assert len(taken(hub, "fix")) == 300


@pytest.mark.parametrize("batch", [1, 3, 4, 30])
@pytest.mark.parametrize("size", [1, 3, 5])
def test_samples_that_come_in_packets_with_one_stamp(hub: Hub, device: Device, size: int, batch: int) -> None:
    n = 600
    true = START + np.arange(n) / 100
    stamps = true[np.arange(n) // size * size]
    for i in range(0, n, batch):
        part = slice(i, i + batch)
        values = np.stack([np.arange(i, min(i + batch, n))] * 3, axis=1).astype(float)
        device.force(stamps[part], values, true[part][-1])
        device.rate(stamps[part], values, true[part][-1])
        device.flush(true[part][-1], complete=True)
    found = ImuData.joined([p.samples for p in hub.take() if isinstance(p.samples, ImuData)])
    later = found.select(found.t > START + 1.0)  # it has to see some packets first
    which = later.specific_force[:, 0]
    assert len(later) >= n - 101 - 2 * size
    np.testing.assert_allclose(later.t, true[which.round().astype(int)], atol=2e-3)
    np.testing.assert_allclose(np.diff(which), 1.0)


def test_an_epoch_counts_once(hub: Hub, device: Device) -> None:
    for i in (0, 1, 1, 2, 2, 2):
        device.fix(fix(START + i, 47.0 + 1e-4 * i), START + i)
        device.velocity(velocity(START + i, 11.0), START + i)
    packets = hub.take()
    for stream in ("fix", "vel"):
        assert [p.samples.t[0] - START for p in packets if p.stream == stream] == [0, 1, 2]


def test_what_is_not_known_loses_nothing_else(hub: Hub, device: Device) -> None:
    for i, altitude in enumerate((math.nan, 312.0, math.nan)):
        device.fix(fix(START + i, 47.0 + 1e-4 * i, altitude), START + i)
    assert device.place == (47.0002, 11.0, 312.0)  # a caster of corrections wants a number
    device.velocity(velocity(START, 11.0, math.nan), START)
    device.course(
        START + np.arange(1.0, 4.0), np.array([5.0, 5.0, 0.0]), np.array([90.0, -1.0, math.nan]), START
    )
    packets = hub.take()
    altitudes = [p.samples.altitude[0] for p in packets if isinstance(p.samples, FixData)]
    np.testing.assert_array_equal(altitudes, [math.nan, 312.0, math.nan])
    enu = np.concatenate([p.samples.enu for p in packets if isinstance(p.samples, VelocityData)])
    np.testing.assert_allclose(enu, [[0, 11, 0], [5, 0, 0], [0, 0, 0]], atol=1e-12)
    assert device.counts["velocities without a speed or a course"] == 1


def test_a_phone_that_does_not_give_its_altitude(hub: Hub) -> None:
    phones = Phones(hub, 0)
    place = '{"latitude": 47.0, "longitude": 11.0, "speed": 7.6, "bearing": 90.0, "horizontalAccuracy": 4}'
    reading = f'{{"name": "location", "time": {int(START)}000000000, "values": {place}}}'
    phones.feed(f'{{"messageId": 0, "sessionId": "s", "deviceId": "d", "payload": [{reading}]}}', START)
    (found,) = [p.samples for p in hub.take() if isinstance(p.samples, FixData)]
    assert np.isnan(found.altitude).all()


@pytest.mark.parametrize("times", [1, 2])
def test_dates_of_a_receiver_whose_week_number_began_again(times: int, hub: Hub, device: Device) -> None:
    now = hub.now()
    for i in range(3):
        device.fix(fix(now + i - times * 1024 * 604_800, 47.0 + 1e-4 * i), now + i)
    np.testing.assert_allclose(np.concatenate(taken(hub, "fix")), now + np.arange(3), atol=1e-3)
    assert any("1024 weeks" in finding.text for finding in hub.events())
    device.fix(fix(START + 1000, 47.1), now + 9)  # a recording that is played is no such case
    assert taken(hub, "fix")[0][0] < now - 1e6
