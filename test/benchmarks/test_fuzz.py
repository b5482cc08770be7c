# SPDX-License-Identifier: Apache-2.0
"""Mutated requests do not kill or block a source: some of those of ``benchmarks/fuzz.py``, in process."""

from __future__ import annotations

import asyncio
from typing import Any

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.runner import running


def test_every_request_is_answered_and_untouched_ones_arrive() -> None:
    import fuzz

    async def work() -> tuple[dict[str, Any], int, list[str]]:
        hub = Hub()
        sources = make_sources([f"sensorlogger://127.0.0.1:0?token={fuzz.TOKEN}&device=good"], hub)
        async with running(sources, hub):
            port = sources[0].server.port
            found = await fuzz.attack(port, 1500, 7, lambda done: None)
        imu = [p.samples for p in hub.take() if p.stream == "imu"]
        return found, sum(map(len, imu)), [f.text for f in hub.events() if f.level == "error"]

    found, arrived, errors = asyncio.run(work())
    assert found["unanswered"] == 0
    assert found["untouched"] == {"200": 15}
    assert arrived == found["sent_samples"] == 150
    assert errors == []
    assert found["outcomes"]["message: 400"] > 200 and found["outcomes"]["message: 200"] > 200


def test_parsers_take_anything() -> None:
    import fuzz

    taken = fuzz.attack_parsers(500, 7)
    assert taken == {"Nmea": 500, "Ubx": 500, "Gpsd": 500, "SensorServer": 1000}
