# SPDX-License-Identifier: Apache-2.0
"""A phone with phyphox and remote access: what is read of it is the drive, through a lost network, too."""

from __future__ import annotations

import asyncio
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from listening import Taken, listen
from phyphox_app import PhyphoxApp

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError


@pytest.fixture
def experiment(repository: Path) -> Path:
    return repository / "config" / "phyphox" / "suspension_twin.phyphox"


def hear(drive: Drive, experiment: Path, during=None, until=None, **options) -> tuple[Taken, PhyphoxApp]:
    """What is heard of the app."""
    apps = []

    async def play(sources, taken) -> None:
        app = PhyphoxApp(drive, experiment, **options)
        apps.append(app)
        async with app:
            sources[0]._base = f"http://127.0.0.1:{app.port}"
            await (app.done.wait() if during is None else during(app, taken))
            while until is not None and not until(taken):
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.2)

    return listen("phyphox://127.0.0.1:1?period=0.05", play), apps[0]


def test_a_drive_arrives_as_it_was(bump: Drive, experiment: Path) -> None:
    taken, app = hear(bump, experiment)
    # What was there before the first question is not asked for.
    imu, fix = taken.imu, taken.fix
    assert imu.t[0] - bump.imu.t[0] < 2.0 and imu.t[-1] == pytest.approx(bump.imu.t[-1], abs=1e-6)
    assert fix.t[0] - bump.fix.t[0] < 2.5 and fix.t[-1] == pytest.approx(bump.fix.t[-1], abs=1e-6)
    at = np.searchsorted(bump.imu.t, imu.t - 1e-4)
    np.testing.assert_array_equal(np.diff(at), 1)  # every sample once
    np.testing.assert_allclose(imu.t, bump.imu.t[at], atol=1e-6)
    np.testing.assert_allclose(imu.specific_force, bump.imu.specific_force[at], atol=1e-6)
    np.testing.assert_allclose(imu.angular_rate, bump.imu.angular_rate[at], atol=1e-6)
    at = np.searchsorted(bump.fix.t, fix.t - 1e-4)
    assert np.diff(at).tolist() == [1] * (len(fix) - 1)
    np.testing.assert_allclose(fix.latitude, bump.fix.latitude[at], atol=2e-8)  # 2 mm
    np.testing.assert_allclose(fix.longitude, bump.fix.longitude[at], atol=2e-8)
    np.testing.assert_allclose(fix.altitude, bump.fix.altitude[at], atol=1e-4)
    np.testing.assert_allclose(fix.sigma, bump.fix.sigma[at], atol=1e-6)
    assert app.requests.count("/control?cmd=start") == 1
    assert any("measurement was started" in text for text in taken.said)


def test_what_was_measured_without_a_network_is_asked_for_afterwards(bump: Drive, experiment: Path) -> None:
    async def during(app: PhyphoxApp, taken: Taken) -> None:
        while taken.count("imu") < 100:
            await asyncio.sleep(0.01)
        app.silent = True
        await asyncio.sleep(0.1)
        app.silent = False
        await app.done.wait()

    taken, _ = hear(bump, experiment, during, lambda t: t.imu.t[-1] > bump.imu.t[-1] - 1e-3)
    assert any("answers 503" in text for text in taken.said)
    np.testing.assert_array_equal(np.diff(np.searchsorted(bump.imu.t, taken.imu.t - 1e-4)), 1)


@pytest.mark.long
def test_a_cleared_experiment_begins_again(bump: Drive, experiment: Path) -> None:
    async def during(app: PhyphoxApp, taken: Taken) -> None:
        await app.done.wait()
        before = taken.count("imu")
        app.buffers = {name: [] for name in app.buffers}
        app.events.clear()
        app.measuring, app.later = False, 100.0
        app._start()
        while taken.count("imu") < before + 100:
            await asyncio.sleep(0.01)

    hear(bump, experiment, during, speed=2.0)  # it takes two seconds to see that nothing newer comes


def test_an_experiment_without_the_sensors_is_told(bump: Drive, tmp_path: Path) -> None:
    path = tmp_path / "other.phyphox"
    path.write_text(
        "<phyphox><data-containers><container size='0'>lin_time</container></data-containers>"
        "<input><sensor type='linear_acceleration'><output component='t'>lin_time</output></sensor></input></phyphox>"
    )

    async def during(app: PhyphoxApp, taken: Taken) -> None:
        while not any(
            "no accelerometer and no gyroscope (open that of config/phyphox)" in t for t in taken.said
        ):
            await asyncio.sleep(0.01)

    hear(bump, path, during)


@pytest.mark.parametrize(
    "answer", ["", "[]", "{}", '{"inputs": 3}', '{"inputs": [{"source": "accelerometer"}]}']
)
def test_another_server_is_no_trouble(answer: str) -> None:
    from aiohttp import web

    async def play(sources, taken) -> None:
        app = web.Application()
        app.router.add_get("/{path:.*}", respond)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        sources[0]._base = f"http://127.0.0.1:{runner.addresses[0][1]}"
        while sum("trying again" in text for text in taken.said) < 2:
            await asyncio.sleep(0.01)
        await runner.cleanup()

    async def respond(request: web.Request) -> web.Response:
        return web.Response(text=answer)

    assert not listen("phyphox://127.0.0.1:1", play).packets


def test_the_experiment_names_only_buffers_that_it_has(experiment: Path) -> None:
    root = ElementTree.parse(experiment).getroot()
    there = {c.text for c in root.iter("container")}
    named = {
        e.text for e in root.iter() if e.tag in ("input", "output", "data") and e.text and e.text.strip()
    }
    assert named == there


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("phyphox:///", "names no host"),
        ("phyphox://phone?period=0", "period: must be a number from 0.02 to 5"),
    ],
)
def test_wrong_urls(url: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make_sources([url], Hub())
