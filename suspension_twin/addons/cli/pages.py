# SPDX-License-Identifier: Apache-2.0
"""Companions of ``suspension-twin run`` in processes of their own: the page, Foxglove's WebSocket, a fleet's pages."""

from __future__ import annotations

import json
import math
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

from suspension_twin.addons.sources.common.connection import url_host
from suspension_twin.addons.view.fleet import FleetServer, TwinRow
from suspension_twin.addons.view.server import TOKEN_VARIABLE
from suspension_twin.cli._status import say
from suspension_twin.cli.run import Companion
from suspension_twin.errors import InputError, WorkError

if TYPE_CHECKING:
    from suspension_twin.cli.run import RosSettings, RunSettings
    from suspension_twin.nodes.composed import Composed
    from suspension_twin.nodes.process import Stop

__all__ = ["Foxglove", "Viewer", "fleet_pages", "foxglove_address", "free_address", "node_process"]

#: Pages of single twins that a fleet's page keeps open, and s that one may take to start.
_PAGES, _OPENED = 4, 30.0


class ListenAddress(NamedTuple):
    """Where something listens; ``token`` is the end of the address."""

    host: str
    port: int
    token: str


def free_address(option: str, given: str) -> ListenAddress:
    """The place that ``PORT`` or ``HOST:PORT`` names; InputError for a wrong or taken one."""
    host, _, number = given.rpartition(":")
    host = host.strip("[]") or "127.0.0.1"
    if not (number.isdecimal() and int(number) < 65536):
        raise InputError(option, f"must be a port or HOST:PORT, is '{given}'")
    port = int(number)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, port), family=family) as taken:
            port = taken.getsockname()[1]
    except OSError as error:
        raise InputError(option, f"cannot listen on {host}, port {port}: {error.strerror or error}") from None
    return ListenAddress(host, port, secrets.token_urlsafe(16))


def foxglove_address(given: str) -> ListenAddress:
    """As :func:`free_address`; InputError where Foxglove's library is missing."""
    if find_spec("foxglove") is None:
        raise InputError("--foxglove", 'needs foxglove-sdk: pip install "suspension-twin[foxglove]"')
    return free_address("--foxglove", given)


@contextmanager
def node_process(
    node: str, values: Mapping[str, object], namespace: str, arguments: Sequence[str]
) -> Iterator[None]:
    """A node of the add-ons in a process of its own, with less priority than the others; it ends with this one.

    Its token goes by the environment: everybody on the machine sees the arguments of a process.
    """
    values = {**values, "parent": os.getpid()}
    environment = {**os.environ, TOKEN_VARIABLE: str(values.pop("token", ""))}
    given = [w for name, value in values.items() for w in ("-p", f"{name}:={json.dumps(value)}")]
    place = ["-r", f"__ns:=/{namespace.strip('/')}"] if namespace else []
    module = f"suspension_twin.addons.nodes.{node}"
    command = [sys.executable, "-m", module, *arguments, "--ros-args", *place, *given]
    command = ["nice", "-n", "5", *command] if shutil.which("nice") else command
    process = subprocess.Popen(command, env=environment)
    try:
        yield
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(1.0)


class Viewer(Companion):
    """``--view``: the page of one twin."""

    node = "viewer"

    def __init__(self, given: str, settings: RunSettings) -> None:
        self._ros = settings.ros
        bag = "" if settings.replay.bag is None else str(settings.replay.bag)
        self._place = free_address("--view", given)
        self._values = self._place._asdict() | {"twin": str(settings.twin), "bag": bag}

    @contextmanager
    def beside(self, composed: Composed, stop: Stop) -> Iterator[None]:
        """See ``Companion``. A replay waits for its page, which cannot be opened before its process listens."""
        with node_process(self.node, self._values, self._ros.namespace, self._ros.arguments):
            if composed.player is not None:
                composed.player.reset(math.inf)
                if not _listens(self._place, lambda: stop.asked, composed.step):
                    say(f"{self.node} has not started within {_OPENED:.0f} s")
            yield


class Foxglove(Viewer):
    """``--foxglove``: all topics on Foxglove's WebSocket."""

    node = "foxglove_bridge"

    def __init__(self, given: str, settings: RunSettings) -> None:
        self._place, self._ros = foxglove_address(given), settings.ros
        replayed = settings.replay.bag is not None
        self._values = {"host": self._place.host, "port": self._place.port, "use_sim_time": replayed}


@contextmanager
def fleet_pages(
    place: ListenAddress, ros: RosSettings, twins: Mapping[str, str]
) -> Iterator[Callable[[Mapping[str, TwinRow]], None]]:
    """The page of a fleet; that of a twin, a process of its own, is there from when it is first asked for."""
    opened: dict[str, tuple[int, ExitStack]] = {}

    def open_page(name: str) -> int:
        if name in opened:
            port, own = opened.pop(name)
        else:
            while len(opened) >= _PAGES:  # the one that was not asked for for the longest time
                opened.pop(next(iter(opened)))[1].close()
            free = free_address("--view", f"{url_host(place.host)}:0")
            port, own = free.port, ExitStack()
            values = {"host": place.host, "port": port, "token": place.token, "twin": twins[name]}
            own.enter_context(node_process("viewer", values, name, ros.arguments))
            if not _listens(free):
                raise WorkError("--view: the page of this twin did not start")
        opened[name] = port, own
        return port

    server = FleetServer(list(twins), open_page, **place._asdict())
    try:
        print(f"Watch on {server.url}", file=sys.stderr, flush=True)
        yield server.update
    finally:
        server.close()
        for _, own in opened.values():
            own.close()


def _listens(
    place: ListenAddress,
    given_up: Callable[[], bool] = lambda: False,
    meanwhile: Callable[[], None] = lambda: time.sleep(0.1),
) -> bool:
    """Whether something listens there: waits for it until it does, or nobody waits any more, at most ``_OPENED`` s."""
    until = time.monotonic() + _OPENED
    while time.monotonic() < until and not given_up():
        with suppress(OSError), socket.create_connection((place.host, place.port), timeout=1.0):
            return True
        meanwhile()
    return False
