# SPDX-License-Identifier: Apache-2.0
"""The server of the page: who gets in, what a viewer may ask for, and viewers that are slow or many."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import re
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from aiohttp import ClientSession, WSServerHandshakeError

from suspension_twin.addons.sources.common.server import Listener
from suspension_twin.addons.view import server as server_module
from suspension_twin.addons.view.live import LiveView
from suspension_twin.addons.view.server import ACTIONS, Server, parse_action
from suspension_twin.errors import InputError, WorkError


@pytest.fixture
def serve() -> Iterator[Callable[..., Server]]:
    """Makes a server on a free port, with a list ``asked`` of what was asked for."""
    made: list[Server] = []

    def make(**options) -> Server:
        asked: list[tuple[str, float | None]] = []

        def on_action(name: str, number: float | None) -> str:
            asked.append((name, number))
            if name == "diagnose":
                raise WorkError("no drive was recorded")
            return f"done: {name}"

        server = Server(LiveView(), on_action, port=0, **options)
        server.asked = asked  # type: ignore[attr-defined]
        made.append(server)
        return server

    yield make
    for server in made:
        server.close()


def status(url: str, **headers: str) -> int:
    async def get() -> int:
        async with ClientSession() as session, session.get(url, headers=headers) as answer:
            return answer.status

    return asyncio.run(get())


def test_the_page_and_all_it_refers_to_come_from_here(serve):
    server = serve()

    async def get() -> None:
        async with ClientSession() as session:
            async with session.get(server.url) as answer:
                text = await answer.text()
                assert (
                    answer.status == 200 and "default-src 'self'" in answer.headers["Content-Security-Policy"]
                )
            folder = Path(server_module.__file__).parent
            files = {file.name for file in (*folder.glob("*.js"), *folder.glob("*.css"))}
            for name in re.findall(r'"static/([\w.]+)"', text):
                assert name in files
            for name in sorted(files):
                async with session.get(server.address(f"static/{name}")) as answer:
                    text += re.sub(r"^/\*!.*?\*/", "", await answer.text())  # whose it is
                    assert answer.status == 200
            async with session.get(server.address("road/-1/2")) as answer:
                assert len(await answer.read()) == 4 * 41 * 41
            assert "https://" not in text and "http://" not in text, "works without a network"

    asyncio.run(get())


@pytest.mark.parametrize(
    "path", ["static/../server.py", "static/%2e%2e/server.py", "road/a/b", "report", "road/9999999/0"]
)
def test_nothing_else_is_served(serve, path):
    assert status(serve().address(path)) in (403, 404)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_nobody_gets_in_without_the_token(serve, host):
    assert len({serve(host=host).token for _ in range(3)}) == 3, "a new one for each"
    server = serve(host=host, token="a-secret")
    base = f"http://127.0.0.1:{server.port}/"
    assert status(base) == status(f"{base}static/app.js") == status(f"{base}?token=b-secret") == 403
    assert status(f"{base}ws") == status(f"{base}?token=é") == 403

    async def get() -> int:
        async with ClientSession() as session:
            async with session.get(f"{base}?token=a-secret") as answer:
                cookie = answer.cookies[f"suspension_twin_{server.port}"]
                assert cookie["samesite"] == "Strict" and cookie["httponly"]
            async with session.get(f"{base}static/app.js", cookies={cookie.key: cookie.value}) as answer:
                return answer.status

    assert asyncio.run(get()) == 200


#: Names that lead to this machine, as programs that test for DNS rebinding use them (rbndr, nip.io, sslip.io,
#: Singularity of Origin), and hosts that are none.
REBOUND = (
    *(
        "evil.example:80",
        "127.0.0.1.nip.io",
        "127-0-0-1.sslip.io",
        "7f000001.c0a80001.rbndr.us",
        "localtest.me",
    ),
    *(
        "127.0.0.1.evil.example",
        "127.evil.example",
        "localhost.evil.example",
        "s-127.0.0.1-1-fs-e.d.rebind.it",
        "lvh.me",
    ),
    *(
        "localhost@evil.example",
        "127.0.0.1@evil.example",
        "evil.example#127.0.0.1",
        "0.0.0.0",
        "[::]",
        "10.0.0.1",
    ),
    *(
        "127.1",
        "2130706433",
        "0x7f.1",
        "0177.0.0.1",
        "[::1",
        "[::1].evil.example",
        "",
        "%6cocalhost.evil.example",
    ),
)


@pytest.mark.parametrize("name", REBOUND)
def test_a_name_that_leads_here_is_refused(serve, name):
    server = serve()
    assert status(server.url, Host=name) in (400, 403)
    assert status(f"http://127.0.0.1:{server.port}/", Host=name) in (400, 403)


def test_this_machine_has_some_names(serve):
    server = serve()
    for name in ("localhost", "LOCALHOST", "127.0.0.1", "127.8.8.8", "[::1]"):
        assert status(server.url, Host=f"{name}:{server.port}") == 200


def test_a_report_can_neither_run_nor_load_anything(serve, tmp_path):
    server = serve()
    server.report = tmp_path
    (tmp_path / "report.html").write_text("<script>alert(1)</script>")

    async def policy() -> str:
        async with ClientSession() as session, session.get(server.address("report")) as answer:
            return answer.headers["Content-Security-Policy"]

    found = asyncio.run(policy())
    assert "sandbox;" in found and "default-src 'none'" in found and "script-src" not in found


def test_another_sites_page_gets_no_websocket(serve):
    server = serve()

    async def connect(origin: str) -> None:
        async with (
            ClientSession() as session,
            session.ws_connect(server.address("ws"), origin=origin) as socket,
        ):
            await socket.receive_json(timeout=5.0)

    with pytest.raises(WSServerHandshakeError):
        asyncio.run(connect("http://evil.example"))
    asyncio.run(connect(f"http://127.0.0.1:{server.port}"))
    for origin in (
        "null",
        "http://[",
        f"http://127.0.0.1:{server.port + 1}",
        f"http://127.0.0.1:{server.port}@evil.example",
    ):
        with pytest.raises(WSServerHandshakeError):
            asyncio.run(connect(origin))


def test_a_viewer_gets_everything_then_what_is_new_and_answers(serve):
    server = serve()
    server.view.update("gap", {"rms": 0.5})

    async def watch() -> None:
        async with ClientSession() as session, session.ws_connect(server.address("ws")) as socket:
            first = await socket.receive_json(timeout=5.0)
            assert first["reset"] and first["gap"] == {"rms": 0.5}
            server.view.update("gap", {"rms": 0.7})
            while (await socket.receive_json(timeout=5.0)).get("gap") != {"rms": 0.7}:
                pass
            for asked, said, wrong in (
                ('{"do": "mark"}', "done: mark", False),
                ('{"do": "seek", "value": 12.5}', "done: seek", False),
                ('{"do": "diagnose"}', "no drive was recorded", True),
                ('{"do": "format the disk"}', "request: asks for something unknown", True),
            ):
                await socket.send_str(asked)
                while "said" not in (frame := await socket.receive_json(timeout=5.0)):
                    pass
                assert frame == {"said": said, "wrong": wrong}

    asyncio.run(watch())
    assert server.asked == [("mark", None), ("seek", 12.5), ("diagnose", None)]


def test_a_viewer_that_does_not_read_costs_no_memory_and_the_others_nothing(serve, monkeypatch):
    monkeypatch.setattr("suspension_twin.addons.view.server._RATE", 400.0)
    server = serve()
    news = [{"k": k, "text": "x" * 300_000} for k in range(120)]

    async def watch() -> int:
        async with (
            ClientSession() as session,
            session.ws_connect(server.address("ws"), max_msg_size=0) as sleeper,
        ):
            await sleeper.receive_json(timeout=5.0)
            async with session.ws_connect(server.address("ws"), max_msg_size=0) as reader:
                for note in news:
                    server.view.update("note", note)
                    while (await reader.receive_json(timeout=10.0)).get("note") != note:
                        pass
                return max(queue.qsize() for queue in server._queues)

    assert asyncio.run(watch()) <= 61


def test_half_open_connections_do_not_keep_the_page_from_others(serve, monkeypatch, capfd):
    """Each sends a part of a request, or nothing, and stays; then requests that are none."""
    monkeypatch.setattr(Listener, "soon", 0.2)
    server = serve()
    idle: list[socket.socket] = []
    try:
        for k in range(400):
            one = socket.socket()
            one.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                one.connect(("127.0.0.1", server.port))
            idle.append(one)
            if k % 2:
                with contextlib.suppress(OSError):
                    one.send(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ")
        assert status(server.url) == 200
        assert len(server._listener.present) <= 192
    finally:
        for one in idle:
            one.close()
    for words in (
        b"\x16\x03\x01\x02\x00",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET / HTTP/1.1\r\nA" + b"a" * 10_000,
        b"\0" * 99,
    ):
        with socket.create_connection(("127.0.0.1", server.port), timeout=5.0) as one:
            one.sendall(words + b"\r\n\r\n")
            with contextlib.suppress(OSError):
                one.recv(1000)
    assert status(server.url) == 200
    assert capfd.readouterr().err == "", "nothing of it reaches the terminal"


def test_who_shows_no_token_is_sent_away(serve, monkeypatch):
    monkeypatch.setattr(Listener, "soon", 0.1)
    monkeypatch.setattr(Listener, "deadline", 0.3)
    server = serve()
    idle = socket.create_connection(("127.0.0.1", server.port), timeout=5.0)
    with idle, contextlib.suppress(ConnectionError):
        assert idle.recv(1) == b""

    async def stay() -> bool:
        async with ClientSession() as session, session.ws_connect(server.address("ws")) as viewer:
            await asyncio.sleep(1.0)
            return not viewer.closed

    assert asyncio.run(stay())


def test_the_port_that_is_taken_is_named(serve):
    server = serve()
    with pytest.raises(InputError, match=f"port {server.port}"):
        Server(LiveView(), lambda *_: "", port=server.port)


def test_no_request_is_taken_for_what_it_is_not():
    assert parse_action('{"do": "speed", "value": 2}') == ("speed", 2.0)
    chance = random.Random(0)
    for text in (
        "",
        "null",
        "[]",
        '{"do": 3}',
        '{"do": "seek"}',
        '{"do": "seek", "value": true}',
        '{"do": ["mark"]}',
    ):
        with pytest.raises(InputError):
            parse_action(text)
    for value in ("NaN", "1e999", "-1e12", '"1"', "[1]"):
        with pytest.raises(InputError):
            parse_action(f'{{"do": "seek", "value": {value}}}')
    whole = json.dumps({"do": "seek", "value": 1.5})
    for _ in range(3000):
        letters = list(whole)
        for _ in range(chance.randint(1, 6)):
            letters[chance.randrange(len(letters))] = chr(chance.randrange(1, 0x250))
        try:
            name, value = parse_action("".join(letters))
        except InputError:
            continue
        assert name in ACTIONS and (value is None or abs(value) < 1e9)
