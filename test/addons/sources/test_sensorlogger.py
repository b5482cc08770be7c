# SPDX-License-Identifier: Apache-2.0
"""Phones with Sensor Logger push a drive: what arrives is the drive."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import threading
from dataclasses import replace

import aiohttp
import numpy as np
import pytest
from listening import Taken, listen, same_drive
from sensor_logger_app import SensorLoggerApp

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.runner import SourceLoop
from suspension_twin.addons.sources.common.sensor_logger import parse_message
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.errors import InputError

LOCAL = "sensorlogger://127.0.0.1:0"
IPHONE = ("accelerometer", "gravity", "gyroscope", "location")


def whole(drive: Drive):
    """Until everything of the drive is there."""
    return lambda taken: taken.count("imu") >= len(drive.imu) and taken.count("vel") >= len(drive.velocity)


@pytest.mark.parametrize(
    "phone",
    [
        {},
        {"sensors": IPHONE},
        {"platform": "ios", "sensors": IPHONE},
        {"platform": "ios", "sensors": IPHONE, "standardise": True},
        {"platform": "ios", "sensors": ("accelerometeruncalibrated", "gyroscope", "location")},
    ],
    ids=lambda p: "-".join(map(str, p.values())) or "android",
)
@pytest.mark.long
def test_a_drive_arrives_as_it_was(bump: Drive, phone: dict) -> None:
    app = SensorLoggerApp(bump, **phone)
    taken = listen(LOCAL, lambda sources, _: app.push(sources[0].server.url(), 20.0), whole(bump))
    same_drive(taken, bump)
    assert set(app.answers) == {200}


def in_a_bend(mount: str, turn: float) -> Drive:
    """24 s at 8 m/s, a bend after 10 s; ``mount``: the phone's axis that points up."""
    t = 1.7e9 + 0.02 * np.arange(1200)
    turning = np.where((t > t[0] + 10.0) & (t < t[0] + 16.0), turn, 0.0)
    course = np.cumsum(turning) * 0.02
    force = np.stack([0.0 * t, 8.0 * turning, 9.80665 + 0.0 * t], axis=1)
    rate = np.stack([0.0 * t, 0.0 * t, turning], axis=1)
    axis, sign = "xyz".index(mount[1]), 1.0 if mount[0] == "+" else -1.0
    turned = np.roll(np.eye(3), axis - 2, axis=0)  # z to the axis
    turned = turned if sign > 0 else turned @ np.diag([1.0, -1.0, -1.0])
    at = np.arange(0, 1200, 50)
    place = np.cumsum(np.stack([np.cos(course), np.sin(course)], axis=1) * 8.0 * 0.02, axis=0)[at]
    fix = FixData(
        t[at],
        47.0 + np.degrees(place[:, 1] / 6.37e6),
        11.0 + np.degrees(place[:, 0] / (6.37e6 * np.cos(np.radians(47.0)))),
        np.full(at.size, 600.0),
        np.zeros(at.size, dtype=np.int8),
        np.full((at.size, 3), 3.0),
    )
    enu = 8.0 * np.stack([np.cos(course), np.sin(course), 0.0 * course], axis=1)[at]
    imu = ImuData(t, force @ turned.T, rate @ turned.T, None, "")
    return Drive("bend", imu, fix, VelocityData(t[at], enu))


@pytest.mark.parametrize(
    ("mount", "turn"), [("+x", 0.2), ("-x", -0.2), ("+y", -0.3), ("-y", 0.3), ("+z", -0.2), ("-z", 0.3)]
)
@pytest.mark.parametrize(
    "phone", [{"sea_level": True}, {"platform": "ios"}, {"platform": "ios", "standardise": True}], ids=str
)
def test_the_first_bend_shows_where_up_is(phone: dict, mount: str, turn: float) -> None:
    drive = in_a_bend(mount, turn)
    messages = SensorLoggerApp(drive, sensors=IPHONE, **phone).messages()

    async def play(sources, taken) -> None:
        start = taken.hub.now()
        for due, message in messages:
            sources[0].phones.feed(json.dumps(message), start + due + 0.01)
            sources[0].phones.tick(start + due + 0.01)
            taken.take()

    taken = listen(LOCAL, play, lambda taken: taken.count("imu") == len(drive.imu))
    after = taken.imu.t > drive.imu.t[0] + 18.0
    np.testing.assert_allclose(taken.imu.specific_force[after], drive.imu.specific_force[after], atol=1e-6)
    if phone == {"sea_level": True} and mount in ("+x", "-x", "+y", "+z"):  # nor before it
        np.testing.assert_allclose(taken.imu.specific_force, drive.imu.specific_force, atol=1e-6)


def test_the_accuracy_of_a_sensor_comes_from_android() -> None:
    """Even of one that hangs upside down; on no platform else do sensors give it."""
    drive = in_a_bend("-y", 0.0)

    async def play(sources, taken) -> None:
        for _, message in SensorLoggerApp(drive, sensors=IPHONE, sea_level=True).messages()[:20]:
            message["payload"] = [r | {"accuracy": 3} for r in message["payload"]]
            sources[0].phones.feed(json.dumps(message), taken.hub.now())

    taken = listen(LOCAL, play, lambda taken: taken.count("imu") > 150)
    np.testing.assert_allclose(taken.imu.specific_force[:, 1], -9.80665, atol=1e-6)


def test_by_websocket(bump: Drive) -> None:
    app = SensorLoggerApp(bump)
    taken = listen(LOCAL, lambda sources, _: app.send(sources[0].server.url(), 20.0), whole(bump))
    same_drive(taken, bump)


def test_messages_out_of_order_and_repeated(bump: Drive) -> None:
    messages = [json.dumps(message) for _, message in SensorLoggerApp(bump).messages()]
    order = list(range(len(messages)))
    shuffled = random.Random(1)
    for i in range(0, len(order) - 1, 2):
        if shuffled.random() < 0.5:
            order[i], order[i + 1] = order[i + 1], order[i]
    order[10:10] = order[6:9]

    async def play(sources, taken) -> None:
        for number in order:
            sources[0].phones.feed(messages[number], taken.hub.now())

    taken = listen(LOCAL, play, whole(bump))
    same_drive(taken, bump)
    assert taken.hub.devices["phone 5f0c1a7e"].counts["repeated messages"] == 3


def test_a_lost_message_is_not_waited_for_long(bump: Drive) -> None:
    messages = [json.dumps(message) for _, message in SensorLoggerApp(bump).messages()]
    del messages[5]

    async def play(sources, taken) -> None:
        for message in messages:
            sources[0].phones.feed(message, taken.hub.now())

    taken = listen(LOCAL, play, lambda taken: taken.count("imu") >= len(bump.imu) - 25, seconds=3.0)
    assert taken.hub.devices["phone 5f0c1a7e"].counts["lost messages"] == 1
    assert np.diff(taken.imu.t).min() > 0


def test_a_clock_that_is_set_back_is_made_up_for(bump: Drive) -> None:
    """In the middle of the drive the phone's clock goes back by 5 s; the stamps go on."""
    app = SensorLoggerApp(bump, sensors=("totalacceleration", "gyroscope"), batch=0.1)
    stepped = replace(app, shift=-5.0).messages()
    messages = app.messages()
    messages[50:] = stepped[50:]

    async def play(sources, taken) -> None:
        start = taken.hub.now()
        for due, message in messages:  # at real pace, on the paper
            sources[0].phones.feed(json.dumps(message), start + due + 0.01)

    taken = listen(LOCAL, play, lambda taken: taken.count("imu") >= len(bump.imu))
    # The first sample after the step is taken for a period later than the last one before it.
    np.testing.assert_allclose(taken.imu.t, bump.imu.t, atol=0.006)
    assert any("stepped by -5.0" in text for text in taken.said)


def test_two_phones_at_once_one_is_followed(bump: Drive) -> None:
    first, second = SensorLoggerApp(bump), SensorLoggerApp(bump, device="another-phone")

    async def play(sources, _) -> None:
        url = sources[0].server.url()
        await asyncio.gather(first.push(url, 20.0), second.push(url, 20.0))

    taken = listen(LOCAL, play, whole(bump))
    same_drive(taken, bump)
    assert set(taken.hub.devices) == {"phone 5f0c1a7e", "phone another-"}
    assert any("not used" in text for text in taken.said)
    one = listen(f"{LOCAL}?device=another", play, whole(bump))
    assert set(one.hub.devices) == {"phone another-"}


def test_the_phone_that_is_followed_is_served_before_the_others(bump: Drive) -> None:
    """Of requests that wait together its own is answered first, whenever it came."""
    names = ("followed", "second", "third")
    bodies = {
        name: [json.dumps(message).encode() for _, message in SensorLoggerApp(bump, device=name).messages()]
        for name in names
    }
    answered: list[str] = []

    async def play(sources, _) -> None:
        phones = {name: await asyncio.open_connection("127.0.0.1", sources[0].server.port) for name in names}

        async def answer(name: str) -> None:
            assert (await phones[name][0].readuntil(b"ok")).startswith(b"HTTP/1.1 200")
            answered.append(name)

        async def post(number: int, *order: str) -> None:
            for name in order:  # all are there before one is read
                body = bodies[name][number]
                head = f"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n"
                phones[name][1].write(head.encode() + body)
            await asyncio.gather(*map(answer, order))

        for name in names:
            for number in range(3):  # which shows who is followed
                await post(number, name)
        answered.clear()
        for number in range(3, 8):
            await post(number, "second", "third", "followed")
        for _, writer in phones.values():
            writer.close()

    listen(LOCAL, play)
    assert answered[::3] == ["followed"] * 5
    assert answered.count("second") == answered.count("third") == 5


def test_who_drives_the_sources_has_time_behind_a_sample(bump: Drive) -> None:
    """Not only after the seconds for which it would have received."""
    hub = Hub()
    loop = SourceLoop([LOCAL], hub)
    hub.wake = loop.delivered
    url = loop.sources[0].server.url()

    def send() -> None:
        with contextlib.suppress(aiohttp.ClientError):  # the receiver ends before the phone
            asyncio.run(SensorLoggerApp(bump).push(url, 1.0))

    sender = threading.Thread(target=send, daemon=True)
    try:
        loop.run_until_delivered(0.01)
        assert not hub.take()
        sender.start()
        for _ in range(3):
            loop.run_until_delivered(60.0)
            assert hub.take() or hub.events()
    finally:
        loop.close()


def test_acceleration_without_gravity_is_told(bump: Drive) -> None:
    app = SensorLoggerApp(bump, sensors=("accelerometer", "gyroscope"))

    async def play(sources, taken) -> None:
        for _, message in app.messages():
            sources[0].phones.feed(json.dumps(message), taken.hub.now())
        sources[0].phones.tick(taken.hub.now() + 4.0)  # the time that is waited for gravity

    taken = listen(LOCAL, play)
    assert taken.count("imu") == 0
    assert taken.hub.devices["phone 5f0c1a7e"].counts["accelerations without gravity"] > 100


# Security


async def statuses(sources, requests: list[tuple[str, dict]]) -> list[int]:
    found = []
    async with aiohttp.ClientSession() as session:
        for url, arguments in requests:
            async with session.post(url, **arguments) as answer:
                found.append(answer.status)
    return found


def ask(url: str, requests) -> list[int]:
    found: list[int] = []

    async def play(sources, taken: Taken) -> None:
        server = sources[0].server
        found.extend(await statuses(sources, requests(f"http://127.0.0.1:{server.port}/")))

    listen(url, play)
    return found


def test_an_open_port_wants_its_token() -> None:
    good = {"data": json.dumps({"messageId": 0, "sessionId": "s", "deviceId": "d", "payload": []})}
    found = ask(
        "sensorlogger://0.0.0.0:0?token=secret-secret",
        lambda u: [
            (u, good),
            (f"{u}?token=wrong-wrong", good),
            (f"{u}?token=secret-secret", good),
            (u, good | {"headers": {"Authorization": "Bearer secret-secret"}}),
        ],
    )
    assert found == [401, 401, 200, 200]


def test_a_page_in_the_browser_cannot_send_to_loopback() -> None:
    good = {"data": json.dumps({"messageId": 0, "sessionId": "s", "deviceId": "d", "payload": []})}
    found = ask(
        LOCAL, lambda u: [(u, good), (u, good | {"headers": {"Origin": "https://elsewhere.example"}})]
    )
    assert found == [200, 403]


def test_a_seventeenth_phone_is_told_once(bump: Drive) -> None:
    async def play(sources, taken) -> None:
        for k in range(60):
            body = {"messageId": k // 20, "sessionId": "s", "deviceId": f"{k % 20:02}-phone", "payload": []}
            sources[0].phones.feed(json.dumps(body), taken.hub.now())

    taken = listen(LOCAL, play)
    assert len(taken.hub.devices) == 16
    assert sorted(text for text in taken.said if "not taken" in text) == [  # a few of a kind at a time
        f"phone {k}-phone: not taken, there are 16 devices already" for k in range(16, 19)
    ]


def test_guessing_is_slowed_down() -> None:
    found = ask(
        "sensorlogger://0.0.0.0:0?token=secret-secret",
        lambda u: [(f"{u}?token={i:010}", {}) for i in range(30)],
    )
    assert found.count(401) == 20 and found.count(429) == 10


def test_what_is_too_large_or_packed_or_no_message_is_refused() -> None:
    found = ask(
        LOCAL,
        lambda u: [
            (u, {"data": b"x" * 5_000_000}),
            (u, {"data": b"x", "headers": {"Content-Encoding": "gzip"}}),
            (u, {"data": b"[" * 100_000}),
            (u, {"data": b"\xff\xfe"}),
            (u, {"data": b"[]"}),
            (u, {"data": b'{"messageId": true, "payload": []}'}),
            (u, {"data": b'{"messageId": 1, "payload": {}}'}),
        ],
    )
    assert found == [413, 415, 400, 400, 400, 400, 400]


def test_too_much_at_once_is_refused() -> None:
    found = ask(LOCAL, lambda u: [(u, {"data": b" " * 3_900_000}) for _ in range(10)])
    assert found.count(429) >= 2


def test_loopback_is_the_default_and_needs_no_token() -> None:
    (source,) = make_sources(["sensorlogger://:8123"], Hub())
    assert source.server.host == "127.0.0.1" and source.server.token == ""


def test_an_open_port_without_a_token_gets_one_that_stays(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    tokens = {make_sources(["sensorlogger://0.0.0.0:8000"], Hub())[0].server.token for _ in range(2)}
    assert len(tokens) == 1 and len(tokens.pop()) >= 16
    (path,) = tmp_path.rglob("token")
    assert path.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("sensorlogger://0.0.0.0:1?token=short", "token: must have 8 characters"),
        ("sensorlogger://0.0.0.0:1?tokn=secret-secret", "unknown option tokn, did you mean token"),
        ("sensorlogger://127.0.0.1:1?axes=windows", "axes: must be one of"),
        ("sensorlogger://127.0.0.1:99999", "no URL"),
        ("sensorlogger://127.0.0.1:1/a", "has a path"),
        ("sensorloger://127.0.0.1:1", "did you mean sensorlogger"),
        ("nothing", "is no source"),
    ],
)
def test_a_wrong_url_is_one_line(url: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make_sources([url], Hub())
    assert "secret" not in str(caught.value)


def test_a_port_in_use_is_said() -> None:
    async def play(sources, _) -> None:
        port = sources[0].server.port
        (second,) = make_sources([f"sensorlogger://127.0.0.1:{port}"], Hub())
        with pytest.raises(InputError, match="in use"):
            await second.start()

    listen(LOCAL, play)


@pytest.mark.parametrize(
    "reading",
    [
        None,
        7,
        {},
        {"name": 3},
        {"name": "gyroscope", "time": 1, "values": {"x": 0, "y": 0, "z": 0}},
        {"name": "gyroscope", "time": True, "values": {"x": 0, "y": 0, "z": 0}},
        {"name": "gyroscope", "time": 1.7e18, "values": {"x": None, "y": 0, "z": 0}},
        {"name": "gyroscope", "time": 1.7e18, "values": {"x": 10**400, "y": 0, "z": 0}},
        {"name": "gyroscope", "time": 1.7e18, "values": [0, 0, 0]},
        {"name": "gyroscope", "time": 1.7e18, "values": {"x": "0", "y": 0, "z": 0}},
        {"name": "gyroscope", "time": "9" * 24, "values": {"x": 0, "y": 0, "z": 0}},
        {"name": "location", "time": 1.7e18, "values": {"latitude": 1.0}},
    ],
    ids=str,
)
def test_a_reading_with_a_wrong_field_is_left_out(reading) -> None:
    good = {"name": "gyroscope", "time": 1_700_000_000_000_000_000, "values": {"x": 1, "y": 2.0, "z": 3}}
    message = parse_message(json.dumps({"messageId": 0, "payload": [reading, good]}))
    assert message.refused == 1
    assert message.rows["gyroscope"].tolist() == [[1.7e9, 1.0, 2.0, 3.0]]
    assert message.rows.keys() == {"gyroscope"}


def test_a_name_is_fit_for_a_terminal() -> None:
    message = parse_message(
        json.dumps({"messageId": 0, "deviceId": "../\x1b[31m\n" + "x" * 500, "payload": []})
    )
    assert message.device.startswith("31mx") and len(message.device) <= 64
