# SPDX-License-Identifier: Apache-2.0
"""The HTTP and WebSocket server that phones push to: loopback unless asked, a token, limits on size and rate.

Nothing that a sender gives becomes a path, a name of a file or a part of a page.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import logging
import os
import secrets
import socket
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from aiohttp import WSMsgType, web

from suspension_twin.addons.sources.common.clock import host_time
from suspension_twin.addons.sources.common.connection import Address, is_local, url_host
from suspension_twin.errors import InputError
from suspension_twin.files import read_text

__all__ = ["Limits", "Listener", "PushServer", "kept_token", "network_address"]

_TOKEN_LENGTH: Final = 8  # the shortest that is taken
_PEERS: Final = 256


@dataclass(frozen=True)
class Limits:
    """Limits of a sender: ``body`` bytes of a message, ``rate`` bytes/s of one sender and ``burst`` bytes at once,
    ``connections`` in all, ``attempts`` with a wrong token within a minute, ``patience`` s for a body.

    Four phones at 400 Hz send 2 MB/s together; a phone that was ten seconds without a network sends them at once.
    """

    body: int = 4_000_000
    rate: float = 4e6
    burst: float = 24e6
    connections: int = 64
    attempts: int = 20
    patience: float = 10.0


def network_address() -> str:
    """This machine's address in its network; ``127.0.0.1`` without one. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # of TEST-NET-1, RFC 5737
        return str(probe.getsockname()[0])
    return "127.0.0.1"


def kept_token() -> str:
    """A token for this user, the same each time, so that a phone's settings stay valid; made when it is asked for
    first and kept readable for the user alone."""
    base = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    path = Path(base) / "suspension_twin" / "token"
    with contextlib.suppress(InputError):
        token = read_text(path).strip()
        if (
            len(token) >= _TOKEN_LENGTH
            and token.isascii()
            and token.replace("-", "").replace("_", "").isalnum()
        ):
            return token
    token = secrets.token_urlsafe(12)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        path.unlink(missing_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(token + "\n")
    return token


def _silent() -> logging.Logger:
    """For the server's traces of requests that are none: a sender could fill a terminal or a disk with them."""
    logger = logging.getLogger(__name__)
    logger.addHandler(logging.NullHandler())
    logger.propagate = False
    return logger


class _Bucket:
    """Allows ``rate`` a second, ``burst`` at once."""

    def __init__(self, rate: float, burst: float) -> None:
        self.rate, self.burst, self.left, self.at = rate, burst, burst, host_time()

    def take(self, amount: float) -> bool:
        now = host_time()
        self.left = min(self.burst, self.left + (now - self.at) * self.rate)
        self.at = now
        if amount > self.left:
            return False
        self.left -= amount
        return True


class _Peer:
    def __init__(self, limits: Limits) -> None:
        self.bytes = _Bucket(limits.rate, limits.burst)
        self.wrong = _Bucket(limits.attempts / 60.0, limits.attempts)


class Listener:
    """Accepts connections for an aiohttp application: so many at a time, and none for long that shows no token.

    While all places are taken nothing is accepted: what waits then does so in the kernel. A place is taken back from
    who has shown no token for ``deadline`` s, or for ``soon`` s where somebody waits for it.
    """

    deadline, soon = 10.0, 1.0  # s (tolerances, by hand: a phone in a poor network sends its headers within)
    #: s that requests under way have to end in when the program ends (tolerance, by hand: one of 4 MB takes a tenth).
    ending = 0.5

    def __init__(self, app: web.Application, connections: int, **options: Any) -> None:
        self._runner = web.AppRunner(
            app, logger=_silent(), access_log=None, shutdown_timeout=self.ending, **options
        )
        self._most = connections
        self._since: dict[asyncio.BaseProtocol, float] = {}
        self._known: set[asyncio.BaseProtocol] = set()
        self._tasks: list[asyncio.Task[None]] = []
        self._socket: socket.socket | None = None
        #: Connections that were closed to make place, or for want of a token.
        self.dropped = 0

    async def start(self, host: str, port: int) -> int:
        """Listen; the port. Raises OSError where the address cannot be had."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.create_server((host, port), family=family, backlog=128)
        self._socket.setblocking(False)
        await self._runner.setup()
        self._tasks = [asyncio.ensure_future(work) for work in (self._accept(self._socket), self._watch())]
        return int(self._socket.getsockname()[1])

    def welcome(self, request: web.Request) -> None:
        """Somebody has shown the token: the connection stays."""
        if request.protocol is not None:
            self._known.add(request.protocol)

    @property
    def present(self) -> set[asyncio.BaseProtocol]:
        """The connections that are open."""
        return set() if self._runner.server is None else set(self._runner.server.connections)

    async def stop(self) -> None:
        """Close everything."""
        for task in self._tasks:
            task.cancel()
        if self._socket is not None:
            self._socket.close()
        await self._runner.cleanup()

    async def _accept(self, listening: socket.socket) -> None:
        loop, server = asyncio.get_running_loop(), self._runner.server
        assert server is not None
        while True:
            while len(self.present) >= self._most:
                await asyncio.sleep(0.0 if self._drop(self.soon, 1) else 0.05)
            try:
                accepted, _ = await loop.sock_accept(listening)
                _, protocol = await loop.connect_accepted_socket(server, accepted)
                self._since[protocol] = host_time()
            except OSError:  # it has gone, or there are no more descriptors
                await asyncio.sleep(0.05)

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(self.soon)
            self._drop(self.deadline)

    def _drop(self, age: float, most: int | None = None) -> bool:
        """Close connections of that ``age`` in s that have shown no token, the oldest first; whether there were any."""
        present, now = self.present, host_time()
        self._since = {c: at for c, at in self._since.items() if c in present}
        self._known &= present
        idle = [c for c, at in self._since.items() if c not in self._known and now - at >= age][:most]
        for connection in idle:
            self._since.pop(connection)
            assert isinstance(connection, web.RequestHandler)
            connection.force_close()
            if connection.transport is not None:
                connection.transport.abort()
        self.dropped += len(idle)
        return bool(idle)


class PushServer:
    """Serves ``on_message(body, arrival)``, which raises InputError for what it does not take.

    Raises InputError for an address that is open to a network with a token that is too short. ``page`` is what a
    browser gets that shows the token.
    """

    def __init__(
        self,
        address: Address,
        on_message: Callable[[bytes | str, float], object],
        limits: Limits | None = None,
    ) -> None:
        self.host = address.host or "127.0.0.1"
        self.port = address.port
        self.open = not is_local(self.host)
        self.token = address.options.get("token", kept_token() if self.open else "")
        if (self.open or self.token) and len(self.token) < _TOKEN_LENGTH:
            raise InputError(str(address), "token", f"must have {_TOKEN_LENGTH} characters at least")
        if not self.token.isascii() or not self.token.isprintable():
            raise InputError(str(address), "token", "must be of printable ASCII characters")
        self.page: Callable[[], str] = lambda: ""
        #: Files for a phone, by path: type and content.
        self.files: dict[str, tuple[str, bytes]] = {}
        self.limits = limits or Limits()
        #: Whether a message, as ``on_message`` returned it, is of no use now: then the sender's next one waits for
        #: those of others.
        self.is_spare: Callable[[object], bool] = lambda _taken: False
        self.refused = 0
        self._address = address
        self._on_message = on_message
        self._peers: OrderedDict[str, _Peer] = OrderedDict()
        self._spare: set[asyncio.BaseProtocol] = set()
        self._turn = asyncio.Lock()
        self._listener: Listener | None = None

    def url(self, path: str = "/") -> str:
        """The address that a phone sends to."""
        host = network_address() if self.host in ("0.0.0.0", "::") else self.host
        token = f"?token={self.token}" if self.token else ""
        return f"http://{url_host(host)}:{self.port}{path}{token}"

    async def start(self) -> None:
        """Listen; InputError where the address cannot be had."""
        app = web.Application(client_max_size=self.limits.body)
        app.router.add_route("*", "/{path:.*}", self._handle)
        listener = Listener(
            app,
            self.limits.connections,
            auto_decompress=False,
            max_line_size=4096,
            max_field_size=4096,
            keepalive_timeout=75,
        )
        try:
            self.port = await listener.start(self.host, self.port)
        except OSError as error:
            taken = error.errno == errno.EADDRINUSE
            reason = "the port is in use by another program" if taken else os.strerror(error.errno or 0)
            raise InputError(str(self._address), f"cannot listen: {reason}") from None
        self._listener = listener

    async def stop(self) -> None:
        """Close everything."""
        if self._listener is not None:
            await self._listener.stop()

    # Connections

    def _peer(self, request: web.Request) -> _Peer:
        name = request.remote or ""
        peer = self._peers.pop(name, None) or _Peer(self.limits)
        self._peers[name] = peer
        while len(self._peers) > _PEERS:
            self._peers.popitem(last=False)
        return peer

    def _knows_token(self, request: web.Request) -> bool:
        if not self.token:
            return True
        given = request.query.get("token", "") or request.headers.get("Authorization", "").removeprefix(
            "Bearer "
        )
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    # Requests

    async def _handle(self, request: web.Request) -> web.StreamResponse:
        arrival = host_time()
        peer = self._peer(request)
        if not self._knows_token(request):
            self.refused += 1
            status = 401 if peer.wrong.take(1.0) else 429
            return self._answer(status, "the token is missing or wrong", close=True)
        if not self.token and "Origin" in request.headers:
            # A page that the user has open in a browser reaches loopback, too; phones and programs have no origin.
            self.refused += 1
            return self._answer(403, "pages of other sites may not send", close=True)
        if self._listener is not None:
            self._listener.welcome(request)
        if request.method == "POST":
            return await self._post(request, peer, arrival)
        if request.method == "GET":
            if request.headers.get("Upgrade", "").lower() == "websocket":
                return await self._socket(request, peer)
            if request.path in self.files:
                kind, content = self.files[request.path]
                return web.Response(body=content, content_type=kind)
            return web.Response(
                text=self.page() or "ready", content_type="text/html" if self.page() else "text/plain"
            )
        return self._answer(405, "send by POST or by WebSocket", close=True)

    async def _post(self, request: web.Request, peer: _Peer, arrival: float) -> web.Response:
        if request.headers.get("Content-Encoding", "identity") != "identity":
            return self._answer(415, "send it without compression", close=True)
        if (request.content_length or 0) > self.limits.body:
            return self._answer(413, "too large", close=True)
        try:
            if request.content.is_eof():  # as most are: nothing to wait for
                body = await request.read()
            else:
                body = await asyncio.wait_for(request.read(), self.limits.patience)
        except web.HTTPRequestEntityTooLarge:
            return self._answer(413, "too large", close=True)
        except asyncio.TimeoutError:
            return self._answer(408, "too slow", close=True)
        if not peer.bytes.take(len(body)):
            return self._answer(429, "too much at once", close=False)
        try:
            await self._take(request, body, arrival)
        except InputError as error:
            self.refused += 1
            return self._answer(400, str(error), close=False)
        return web.Response(text="ok")

    async def _socket(self, request: web.Request, peer: _Peer) -> web.StreamResponse:
        socket_ = web.WebSocketResponse(max_msg_size=self.limits.body, heartbeat=20.0, compress=False)
        if not socket_.can_prepare(request).ok:
            return self._answer(400, "not a WebSocket handshake", close=True)
        await socket_.prepare(request)
        async for message in socket_:
            if message.type not in (WSMsgType.TEXT, WSMsgType.BINARY):
                continue
            if not peer.bytes.take(len(message.data)):
                self.refused += 1
                continue
            try:
                await self._take(request, message.data, host_time())
            except InputError:
                self.refused += 1
        return socket_

    async def _take(self, request: web.Request, body: bytes | str, arrival: float) -> None:
        """Hand a message on; after those that are under way or come meanwhile, if the sender's last was of no use."""
        sender = request.protocol
        if sender in self._spare:
            async with self._turn:  # one after the other, and between two of them all that has come
                for _ in range(2):  # to read it, and to handle it
                    await asyncio.sleep(0)
        spare = self.is_spare(self._on_message(body, arrival))
        if sender is not None and self._listener is not None and spare != (sender in self._spare):
            (self._spare.add if spare else self._spare.discard)(sender)
            self._spare &= self._listener.present

    def _answer(self, status: int, text: str, *, close: bool) -> web.Response:
        response = web.Response(status=status, text=text)
        if close:
            response.force_close()
        return response
