# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin connect``: what is found, how a phone is connected, and what is said of what arrives."""

from __future__ import annotations

import asyncio
import io
import signal
from dataclasses import replace
from pathlib import Path

import aiohttp
import numpy as np
import pytest
from listening import listen
from rich.console import Console
from sensor_logger_app import SensorLoggerApp
from test_record import free_port, start, wait_for_port

from suspension_twin.addons.cli.connect import _experiment
from suspension_twin.addons.cli.live_lines import show_guide
from suspension_twin.addons.sources import SOURCES, make_sources
from suspension_twin.addons.sources.common.assess import assess, verdict
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.report import discover, findings, serial_ports
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.signals.checks import Finding


@pytest.mark.long
def test_it_tells_what_arrives(bump: Drive) -> None:
    port = free_port()
    process = start("connect", f"sensorlogger://127.0.0.1:{port}")
    wait_for_port(port, process)
    asyncio.run(SensorLoggerApp(bump).push(f"http://127.0.0.1:{port}/", 2.0))
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "On this machine" in out
    assert f"Sensor Logger: push to http://127.0.0.1:{port}/" in out and "  1. Phone and laptop" in out
    assert "IMU: 100" in out and "no gaps" in out and "units: m/s²; gravity 9." in out
    assert "mounting: " in out and "standard deviation 0.0" in out
    assert "for a calibration: yes" in out


def test_nothing_arrived_is_said() -> None:
    process = start("connect", "sensorlogger://127.0.0.1:0", "--seconds", "0.2")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors == "suspension-twin: nothing arrived within 0.2 s\n"


def at_rest(seconds: float = 5.0) -> ImuData:
    """A phone that lies face up on a desk."""
    rng, n = np.random.default_rng(1), int(100 * seconds)
    force = rng.normal(0.0, 0.02, (n, 3))
    force[:, 2] += 9.81
    return ImuData(1.7e9 + np.arange(n) / 100.0, force, rng.normal(0.0, 1e-3, (n, 3)))


def judged(drive: Drive, **changes) -> dict[str, Finding]:
    parts = {"imu": drive.imu, "fix": drive.fix, "velocity": drive.velocity} | changes
    found = assess(parts["imu"], parts["fix"], parts["velocity"])
    return {f.code: f for f in [*found, verdict(found)]}


def test_a_good_set_up_will_do(bump: Drive) -> None:
    found = judged(bump)
    assert found["verdict"].text == "for a calibration: yes"
    assert all(f.level == "ok" for f in found.values())


def test_a_phone_s_own_positions_do_for_a_smooth_road(bump: Drive) -> None:
    rough = replace(bump.fix, sigma=np.full((len(bump.fix), 3), 3.0))
    found = judged(bump, fix=rough)
    assert "standard deviation 3 m" in found["accuracy"].text
    assert found["verdict"].level == "warn" and "RTK would" in found["verdict"].text


def test_without_positions_not_yet(bump: Drive) -> None:
    found = judged(bump, fix=FixData.empty(), velocity=VelocityData.empty())
    assert found["verdict"].text == "for a calibration: not yet, no position; the IMU will do"


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        (lambda imu: imu.select(slice(0, None, 4)), "rate_low", "too slow for wheel hop"),
        (
            lambda imu: replace(imu, specific_force=imu.specific_force * 3.0),
            "units_unknown",
            "neither 9.81 m/s²",
        ),
        (
            lambda imu: replace(imu, angular_rate=0.0 * imu.angular_rate),
            "gyro_dead",
            "the gyro gives nothing",
        ),
        (lambda imu: imu.select(slice(0, 10)), "no_imu", "no samples"),
    ],
)
def test_what_will_not_do_is_told(bump: Drive, change, code: str, words: str) -> None:
    found = judged(bump, imu=change(bump.imu))
    assert words in found[code].text
    assert found["verdict"].level == "error" and found["verdict"].text.startswith("for a calibration: no, ")


@pytest.mark.parametrize(
    ("axes", "words", "rpy"),
    [
        ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], "mounting: upright", "[1.57"),
        ([[1, 0, 0], [0, -1, 0], [0, 0, -1]], "mounting: lying face down", ""),
        ([[0, 0, -1], [0, 1, 0], [1, 0, 0]], "mounting: on its left side", ""),
    ],
)
def test_the_mounting_is_told(bump: Drive, axes, words: str, rpy: str) -> None:
    imu = at_rest()
    turned = ImuData(imu.t, imu.specific_force @ np.array(axes, dtype=float), imu.angular_rate)
    text = judged(bump, imu=turned, velocity=VelocityData.empty())["mounting"].text
    assert text.startswith(words) and f"imu.rpy: {rpy}" in text


def test_in_a_bend_there_is_no_advice_on_the_mounting(bump: Drive) -> None:
    imu = at_rest()
    force = imu.specific_force + [0.0, 3.0, 0.0] + 0.3 * np.sin(9.0 * imu.t)[:, None]
    text = judged(bump, imu=replace(imu, specific_force=force), velocity=VelocityData.empty())[
        "mounting"
    ].text
    assert text == "mounting: lying face up"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda imu: replace(imu, specific_force=imu.specific_force / 9.80665),
            "units: g; gravity 1.00 g on +z",
        ),
        (lambda imu: replace(imu, specific_force=imu.specific_force - [0.0, 0.0, 9.81]), "no gravity"),
    ],
)
def test_gravity_is_said_in_its_own_unit(bump: Drive, change, words: str) -> None:
    found = judged(bump, imu=change(at_rest()), velocity=VelocityData.empty())
    assert words in found["gravity"].text and ("mounting" in found) == ("g;" in words)


def test_a_sensor_that_is_off_is_named() -> None:
    nothing = ImuData(np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    why = "its acceleration is without gravity: switch the sensor Gravity (or Total Acceleration) on, too"
    (text,) = [
        f.text for f in assess(nothing, FixData.empty(), VelocityData.empty(), why) if f.code == "no_imu"
    ]
    assert text == f"IMU: no samples; {why}"


def test_a_phone_at_rest_tells_its_noise(bump: Drive) -> None:
    assert (
        "standing still: noise 0.02"
        in judged(bump, imu=at_rest(), velocity=VelocityData.empty())["still"].text
    )


@pytest.mark.parametrize(("rate", "slow"), [(400.0, False), (40.0, True)])
def test_a_rate_is_judged_once_a_stream_has_come_for_a_second(rate: float, slow: bool) -> None:
    """A phone that comes back after a minute is not slow in its first moment."""
    hub = Hub()
    phone = hub.device("phone")
    assert phone is not None

    def send(first: float, seconds: float) -> bool:
        for k in range(int(seconds * rate)):
            t = first + k / rate
            phone.imu(np.array([1.7e9 + t]), np.array([[0.0, 0.0, 9.8]]), np.zeros((1, 3)), phone.since + t)
        said = findings(hub, phone.since + first + seconds + 1.0)
        return any("too slow for wheel hop" in finding.text for finding in said)

    assert send(0.0, 8.0) == slow
    assert not send(70.0, 0.5)
    assert send(70.5, 2.0) == slow


@pytest.mark.parametrize("name", SOURCES)
def test_every_source_says_how_it_is_set_up(name: str) -> None:
    assert all(step.endswith(".") and len(step) < 120 for step in SOURCES[name].make.steps)


def test_on_a_terminal_the_address_is_a_qr_code(monkeypatch: pytest.MonkeyPatch) -> None:
    file = io.StringIO()
    console = Console(file=file, width=100, force_terminal=True, color_system=None)

    async def play(sources, _) -> None:
        await show_guide(console, sources, ["sensorlogger://0.0.0.0:8000"])

    listen("sensorlogger://127.0.0.1:0?token=secret-secret", play)
    shown = file.getvalue()
    assert "▀" in shown and "token=secret-secret" in shown
    assert "Record: suspension-twin record --source 'sensorlogger://0.0.0.0:8000' --out drive" in shown


def test_the_phone_s_browser_gets_the_address_to_copy() -> None:
    pages = []

    async def play(sources, _) -> None:
        async with aiohttp.ClientSession() as session, session.get(sources[0].code) as answer:
            pages.append((answer.content_type, await answer.text(), sources[0].code))

    listen("sensorlogger://127.0.0.1:0?token=secret-secret", play)
    ((kind, page, code),) = pages
    assert kind == "text/html" and f"value='{code}'" in page and "<li>" in page


def test_phyphox_gets_its_experiment_by_qr_code(repository: Path, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))

    async def work() -> bytes:
        sources = make_sources(["phyphox://127.0.0.1:1"], Hub())
        async with _experiment(sources):
            code = sources[0].code
            assert code.startswith("phyphox://") and "token=" in code
            async with (
                aiohttp.ClientSession() as session,
                session.get(f"http{code.removeprefix('phyphox')}") as answer,
            ):
                return await answer.read()

    assert asyncio.run(work()) == (repository / "config" / "phyphox" / "suspension_twin.phyphox").read_bytes()


def test_serial_ports_are_found_by_what_they_call_themselves(tmp_path: Path) -> None:
    (tmp_path / "serial" / "by-id").mkdir(parents=True)
    for name in ("ttyACM0", "ttyUSB1", "tty1"):
        (tmp_path / name).touch()
    (tmp_path / "serial" / "by-id" / "usb-u-blox_AG_ZED-F9P-if00").symlink_to("../../ttyACM0")
    found = serial_ports(tmp_path)
    assert [(Path(path).name, name) for path, name in found] == [
        ("ttyACM0", "u-blox_AG_ZED-F9P-if00"),
        ("ttyUSB1", ""),
    ]
    assert discover()[0].startswith(("network: this machine is ", "no network: "))
