# SPDX-License-Identifier: Apache-2.0
"""The server of the page: static files, tiles of the road, and one WebSocket for each viewer.

A frame is made and encoded once, however many look on. A viewer that is too slow loses frames and gets everything
anew. Every request carries a token, in the address or in the cookie that the first one leaves, on this machine too:
others who work on it do not get in, nor does a website whose name was made to lead here. A page of another origin gets
no WebSocket, so that no website can press a button here.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import re
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future, TimeoutError as NoAnswer
from pathlib import Path
from queue import SimpleQueue
from typing import TypeVar

import numpy as np
from aiohttp import WSMsgType, web

from suspension_twin.addons.sources.common.connection import is_local, url_host
from suspension_twin.addons.sources.common.server import Listener
from suspension_twin.addons.view.live import LiveView
from suspension_twin.errors import InputError, SuspensionTwinError, WorkError
from suspension_twin.road.road import Road

__all__ = ["ACTIONS", "NODES", "SIDE", "TOKEN_VARIABLE", "Requests", "Server", "Site", "tile"]

_T = TypeVar("_T")

#: Buttons of a viewer, and whether a number comes with each.
ACTIONS = {
    "record": False,
    "stop": False,
    "mark": False,
    "guide": False,
    "calibrate": False,
    "load": False,
    "diagnose": False,
    "cancel": False,
    "pause": False,
    "play": False,
    "seek": True,
    "speed": True,
}
#: Frames a second, frames that may wait for a slow viewer, bytes of a request, viewers at a time.
_RATE, _WAITING, _LARGEST, _VIEWERS = 30.0, 60, 1024, 32
_CONNECTIONS = 6 * _VIEWERS  # as many a browser opens to one host
#: s that an answer to a button may take.
_PATIENCE = 6.0
_BEAT = 1.0  # s after which an empty frame says that the program is still there (tolerance, by hand)
_HERE = Path(__file__).parent
_FILES = frozenset(path.name for path in _HERE.iterdir() if path.suffix in (".css", ".js"))
_COOKIE = "suspension_twin"
#: The environment variable by which a process hands the token of a page to that of its node.
TOKEN_VARIABLE = "SUSPENSION_TWIN_VIEW_TOKEN"
#: A tile is a square of this side in m with this many heights along each edge, both ends included.
SIDE, NODES = 4.0, 41
#: Tiles are numbered up to this far from the datum in m.
_FARTHEST = 1e6
_POLICY = "default-src 'self'; connect-src 'self' ws: wss:; img-src 'self' data:; frame-ancestors 'none'"
#: A report holds its styles and pictures and no script; names of files and vehicles stand in it.
_REPORT_POLICY = (
    "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
)


def tile(road: Road | None, column: int, row: int) -> bytes:
    """Heights in m on the tile that begins at x ``column`` times, y ``row`` times :data:`SIDE`.

    float32, little-endian, rows of constant y one after the other. NaN where the road has no data; a plane where
    there is no road. Raises ValueError for a tile too far away.
    """
    if max(abs(column), abs(row)) * SIDE > _FARTHEST:
        raise ValueError("too far from the datum")
    if road is None:
        return np.zeros(NODES * NODES, dtype="<f4").tobytes()
    steps = np.linspace(0.0, SIDE, NODES)
    x, y = np.meshgrid(column * SIDE + steps, row * SIDE + steps)
    samples = road.sample(x.ravel(), y.ravel())
    return np.where(samples.inside, samples.z, np.nan).astype("<f4").tobytes()


class Site:
    """Serves a page from a thread of its own to who has the token: a new one where none is given.

    Raises InputError where it cannot listen on ``host`` and ``port``.
    """

    page = "index.html"

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080, token: str = "") -> None:
        self.host, self.token = host, token or secrets.token_urlsafe(16)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="view", daemon=True)
        self._thread.start()
        try:
            self.port: int = self._run(self._start(port))
        except OSError as error:
            self._end_thread()
            reason = error.strerror or str(error)
            raise InputError("view", f"cannot listen on {host}, port {port}: {reason}") from None

    @property
    def url(self) -> str:
        """The address to open."""
        return self.address()

    def address(self, path: str = "") -> str:
        """The address of a part of the page."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        return f"http://{url_host(host)}:{self.port}/{path}?token={self.token}"

    @property
    def _cookie(self) -> str:
        """Cookies are of a host, whatever the port: each page of it has one of its own."""
        return f"{_COOKIE}_{self.port}"

    def close(self) -> None:
        """Stop serving."""
        with contextlib.suppress(Exception):
            self._run(self._stop(), 2.0)
        self._end_thread()

    def _end_thread(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(2.0)

    def _run(self, work: Coroutine[None, None, _T], patience: float = 10.0) -> _T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(patience)

    async def _start(self, port: int) -> int:
        app = web.Application(middlewares=[self._guard], client_max_size=_LARGEST)
        app.router.add_get("/", self._index)
        app.router.add_get("/static/{name}", self._file)
        self._add_routes(app)
        self._listener = Listener(app, _CONNECTIONS, max_line_size=4096, max_field_size=4096)
        return await self._listener.start(self.host, port)

    def _add_routes(self, app: web.Application) -> None:
        """Add routes beside the page and its files."""

    async def _stop(self) -> None:
        await self._listener.stop()

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        given = request.query.get("token", "") or request.cookies.get(self._cookie, "")
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode()):
            raise web.HTTPForbidden(text="The address is not complete: it ends in ?token=...\n")
        if is_local(self.host) and not is_local(_name_of(request.host)):
            # a name of somebody else's that leads here: a website rebound to this machine
            raise web.HTTPForbidden(text="Open the address that the terminal shows.\n")
        self._listener.welcome(request)
        response = await handler(request)
        if not response.prepared:
            response.headers["X-Content-Type-Options"] = "nosniff"
            if request.path == "/":
                response.set_cookie(self._cookie, self.token, httponly=True, samesite="Strict")
        return response

    async def _index(self, _request: web.Request) -> web.StreamResponse:
        headers = {"Content-Security-Policy": _POLICY, "Cache-Control": "no-store"}
        return web.FileResponse(_HERE / self.page, headers=headers)

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in _FILES:
            raise web.HTTPNotFound
        return web.FileResponse(_HERE / name, headers={"Cache-Control": "no-cache"})


class Server(Site):
    """The page of one twin: serves ``view``.

    ``on_action(name, number)`` is called for a button, in the server's thread; what it returns or raises (a
    :class:`SuspensionTwinError`) is shown to the viewer who pressed it. ``report`` is the folder of the last
    diagnosis, if any.
    """

    def __init__(
        self,
        view: LiveView,
        on_action: Callable[[str, float | None], str],
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        token: str = "",
        road: Road | None = None,
    ) -> None:
        self.view, self.road = view, road
        self.report: Path | None = None
        self._on_action = on_action
        self._queues: set[asyncio.Queue[str]] = set()
        super().__init__(host=host, port=port, token=token)

    @property
    def watched(self) -> bool:
        """Whether somebody looks on."""
        return bool(self._queues)

    def _add_routes(self, app: web.Application) -> None:
        app.router.add_get("/ws", self._socket)
        app.router.add_get(r"/road/{column:-?\d{1,7}}/{row:-?\d{1,7}}", self._tile)
        app.router.add_get("/report", self._report)

    async def _start(self, port: int) -> int:
        found = await super()._start(port)
        self._ticker = asyncio.ensure_future(self._tick())
        return found

    async def _stop(self) -> None:
        self._ticker.cancel()
        await super()._stop()

    async def _tick(self) -> None:
        sent = self._loop.time()
        while True:
            await asyncio.sleep(1.0 / _RATE)
            frame = self.view.frame()
            if not self._queues or not (frame or self._loop.time() - sent >= _BEAT):
                continue
            sent = self._loop.time()
            text = encoded(frame)
            whole: str | None = None
            for queue in list(self._queues):
                if queue.qsize() >= _WAITING:
                    while not queue.empty():
                        queue.get_nowait()
                    whole = whole or encoded(self.view.snapshot())
                    queue.put_nowait(whole)
                else:
                    queue.put_nowait(text)

    async def _tile(self, request: web.Request) -> web.StreamResponse:
        column, row = (int(request.match_info[k]) for k in ("column", "row"))
        try:
            body = await asyncio.to_thread(tile, self.road, column, row)
        except ValueError as error:
            raise web.HTTPNotFound(text=str(error)) from None
        return web.Response(body=body, content_type="application/octet-stream")

    async def _report(self, _request: web.Request) -> web.StreamResponse:
        page = None if self.report is None else self.report / "report.html"
        if page is None or not page.is_file():
            raise web.HTTPNotFound(text="There is no diagnosis yet.\n")
        headers = {"Content-Security-Policy": _REPORT_POLICY, "Cache-Control": "no-store"}
        return web.FileResponse(page, headers=headers)

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        check_origin(request)
        if len(self._queues) >= _VIEWERS:
            raise web.HTTPServiceUnavailable(text="Too many viewers.\n")
        # Not compressed: aiohttp compresses in a task of its own, whose failure at a lost connection nobody can catch.
        socket = web.WebSocketResponse(max_msg_size=_LARGEST, heartbeat=20.0, compress=False)
        try:
            await socket.prepare(request)
        except ConnectionError:  # given up before it was answered
            return web.Response()
        queue: asyncio.Queue[str] = asyncio.Queue()
        queue.put_nowait(encoded(self.view.snapshot()))
        self._queues.add(queue)
        sender = asyncio.ensure_future(_send(socket, queue))
        try:
            async for message in socket:
                if message.type is WSMsgType.TEXT:
                    await self._answer(message.data, queue)
        finally:
            self._queues.discard(queue)
            sender.cancel()
        return socket

    async def _answer(self, text: str, queue: asyncio.Queue[str]) -> None:
        try:
            name, number = parse_action(text)
            said = await asyncio.to_thread(self._on_action, name, number)
            queue.put_nowait(encoded({"said": said, "wrong": False}))
        except SuspensionTwinError as error:
            queue.put_nowait(encoded({"said": str(error), "wrong": True}))


def _name_of(host: str) -> str:
    """Name or number of a host in a header, without its port; empty where it is none."""
    found = re.fullmatch(r"(\[[^\[\]]*\]|[^\[\]:]*)(:\d*)?", host)
    return found[1].strip("[]").lower() if found else ""


def check_origin(request: web.Request) -> None:
    """Refuse what the page of another website asks for."""
    origin = request.headers.get("Origin")
    if origin is not None and origin.partition("://")[2] != request.host:
        raise web.HTTPForbidden(text="Another page's request is refused.\n")


async def _send(socket: web.WebSocketResponse, queue: asyncio.Queue[str]) -> None:
    with contextlib.suppress(ConnectionError, RuntimeError):
        while True:
            await socket.send_str(await queue.get())


def encoded(frame: dict[str, object]) -> str:
    """A frame as JSON."""
    return json.dumps(frame, separators=(",", ":"), allow_nan=False)


def parse_action(text: str) -> tuple[str, float | None]:
    """Name and number of a request ``{"do": name, "value": number}``. Raises InputError for any other text."""
    try:
        asked = json.loads(text)
        name, value = asked["do"], asked.get("value")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        raise InputError("request", "is not understood") from None
    if not isinstance(name, str) or name not in ACTIONS:
        raise InputError("request", "asks for something unknown")
    if not ACTIONS[name]:
        return name, None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e9:
        raise InputError("request", f"{name} needs a number")
    return name, float(value)


class Requests:
    """Hands the name and the number of a button to ``answer``, on the thread that calls :meth:`serve`."""

    def __init__(self, answer: Callable[[str, float | None], str]) -> None:
        self._answer = answer
        self._waiting: SimpleQueue[tuple[str, float | None, Future[str]]] = SimpleQueue()

    def ask(self, name: str, number: float | None) -> str:
        """The answer for who pressed the button. Raises the SuspensionTwinError of the other thread."""
        answered: Future[str] = Future()
        self._waiting.put((name, number, answered))
        try:
            return answered.result(_PATIENCE)
        except NoAnswer:
            raise WorkError(f"{name}: no answer") from None

    def serve(self) -> None:
        """Answer everything that waits."""
        while not self._waiting.empty():
            name, number, answered = self._waiting.get()
            try:
                answered.set_result(self._answer(name, number))
            except SuspensionTwinError as error:
                answered.set_exception(error)
            except Exception as error:  # the page gets an answer in any case
                answered.set_exception(WorkError(f"{name}: {type(error).__name__}: {error}"))
