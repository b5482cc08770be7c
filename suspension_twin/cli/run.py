# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin run``: the four nodes in one process, live or replaying a recording; or those of a fleet."""

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
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from suspension_twin.cli.common import Force, Outputs, SourceUrls
from suspension_twin.errors import InputError, WorkError

if TYPE_CHECKING:
    from suspension_twin.nodes.composed import Composed, Playback
    from suspension_twin.nodes.process import Stop

__all__ = ["command"]

#: Seconds before a recording begins, in which subscribers find the topics.
_DISCOVERY = 0.5
#: The same where a page is to be opened first.
_VIEWED = 3.0
#: s that a recording may take to be completed after Ctrl-C.
_RECORDED = 30.0
#: Pages of single twins that a fleet's page keeps open, and s that one may take to start.
_PAGES, _OPENED = 4, 30.0
#: s that the road of the last pass may take after Ctrl-C; a second one ends it.
_LEARNT = 120.0


class Page(NamedTuple):
    """Where the page is served, and what its address ends in for others than this machine."""

    host: str
    port: int
    token: str


def command(
    twin: Annotated[
        Path | None,
        typer.Option("--twin", help="The twin file.", metavar="TWIN.YAML", show_default=False),
    ] = None,
    fleet: Annotated[
        Path | None,
        typer.Option(
            "--fleet",
            help="Instead of one twin those of all vehicles of a manifest (docs/fleet.md), live, a namespace each.",
            metavar="MANIFEST",
            show_default=False,
        ),
    ] = None,
    processes: Annotated[
        int,
        typer.Option(
            "--processes",
            help="With --fleet: processes that share the twins.  [default: one a core]",
            metavar="N",
            min=0,
            show_default=False,
        ),
    ] = 0,
    bag: Annotated[
        Path | None,
        typer.Option(
            "--bag", help="Replay this recorded drive instead of listening to sensors.", metavar="BAG"
        ),
    ] = None,
    rate: Annotated[
        str,
        typer.Option(
            "--rate", help="Times real time; 'max' or 0: as fast as no message gets lost.", metavar="X"
        ),
    ] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="Begin the recording again at its end.")] = False,
    source: SourceUrls = None,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record", help="Record what the sources send into this bag.", metavar="BAG", show_default=False
        ),
    ] = None,
    learn_road: Annotated[
        Path | None,
        typer.Option(
            "--learn-road",
            help="Learn the road as it is driven over and load it for the next pass; written to this OpenCRG file.",
            metavar="ROAD",
            show_default=False,
        ),
    ] = None,
    force: Force = False,
    namespace: Annotated[
        str, typer.Option("--namespace", help="Put everything below this name.", metavar="NS")
    ] = "",
    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            help="Show the twin on a page in the browser: a port (8080), or HOST:PORT to let others look on.",
            metavar="[PORT]",
        ),
    ] = None,
    foxglove: Annotated[
        str | None,
        typer.Option(
            "--foxglove",
            help="Serve all topics to Foxglove or Lichtblick: a port (8765), or HOST:PORT for others.",
            metavar="[PORT]",
        ),
    ] = None,
    params: Annotated[
        Path | None,
        typer.Option("--params", help="Parameters of the nodes, a ROS 2 YAML file.", metavar="FILE"),
    ] = None,
    ros_args: Annotated[
        list[str] | None,
        typer.Argument(
            help="Arguments for ROS, after '--', such as -- --ros-args -r imu/data_raw:=/phone/imu",
            metavar="ROS_ARGS",
        ),
    ] = None,
) -> None:
    """The four nodes in one process, live or replaying a bag; with --fleet those of many vehicles. Ctrl-C ends them."""
    if fleet is not None:
        given = {
            "--twin": twin,
            "--bag": bag,
            "--loop": loop,
            "--source": source,
            "--record": record,
        }
        given["--rate"] = rate != "1"
        for option, value in given.items():
            if value:
                raise InputError(option, "goes without --fleet: the twins of a fleet are live, from topics")
        _fleet(fleet, namespace, processes, foxglove, view, params, list(ros_args or []))
        return
    if twin is None:
        raise InputError("--twin", "is needed: a twin file; or --fleet with a manifest")
    if processes:
        raise InputError("--processes", "needs --fleet: one twin is one process")
    speed = _speed(rate)
    urls = list(source or ())
    if bag is not None and urls:
        raise InputError("--source", "goes without --bag: a drive is replayed or followed live")
    if record is not None and not urls:
        raise InputError("--record", "needs --source: it records what live sources send")
    if bag is None and (loop or rate != "1"):
        raise InputError("--loop" if loop else "--rate", "needs --bag: only a recording can be replayed")
    # What is wrong with a file is to be said before ROS is started, which takes a second.
    from suspension_twin.vehicle.twin import load_twin

    loaded = load_twin(twin)
    if learn_road is not None and "front" not in loaded.axles:
        raise InputError("--learn-road", f"needs a car with axles, {twin} is of the model {loaded.model}")
    used = [twin, *([] if loaded.road is None else [loaded.road.file])]
    for path in _learnt_files(learn_road):
        if path.resolve() in [p.resolve() for p in used]:
            raise InputError(
                "--learn-road", f"would overwrite {path}, which the twin is made of: give another name"
            )
    page = None if view is None else _place("--view", view)
    bridge = None if foxglove is None else _bridge(foxglove)
    if urls:
        from suspension_twin.addons.sources import make_sources
        from suspension_twin.addons.sources.common.hub import Hub

        make_sources(urls, Hub())
    outputs = Outputs(*([record] if record else []), *_learnt_files(learn_road), force=force)
    outputs.announce()
    from suspension_twin.cli._status import say
    from suspension_twin.nodes.composed import Composed, check_namespace
    from suspension_twin.nodes.parameters import check_names, read_param_file
    from suspension_twin.nodes.process import check_arguments, ros_context, stopping

    check_namespace(namespace)
    wanted = {} if params is None else read_param_file(params)
    arguments = list(ros_args or [])
    check_arguments(arguments)
    if params is not None:
        arguments += ["--ros-args", "--params-file", str(params)]
    with stopping(_LEARNT if learn_road else _RECORDED if record else None) as stop:
        playback = None if bag is None else _playback(bag, speed, loop, page is not None)
        with ros_context(arguments) as context:
            composed = Composed(context, twin, namespace, playback, urls, learn_road)
            try:
                if params is not None:
                    check_names(params, wanted, composed.parameter_names())
                composed.settle_memory()
                for note in composed.notes:
                    say(note)
                with ExitStack() as stack:
                    if record is not None:
                        stack.enter_context(_recorded(composed, record, force))
                    if learn_road is not None:
                        stack.enter_context(_learnt(composed, learn_road, stop))
                    if page is not None:
                        values = page._asdict() | {"twin": str(twin), "bag": "" if bag is None else str(bag)}
                        stack.enter_context(_beside("viewer", values, namespace, arguments))
                    if bridge is not None:
                        values = {"host": bridge.host, "port": bridge.port, "use_sim_time": bag is not None}
                        stack.enter_context(_beside("foxglove_bridge", values, namespace, arguments))
                    _run(composed, lambda: stop.asked or not context.ok(), bag)
            finally:
                composed.close()


def _fleet(
    manifest: Path,
    namespace: str,
    processes: int,
    foxglove: str | None,
    view: str | None,
    params: Path | None,
    ros_args: list[str],
) -> None:
    """The twins of a fleet, and Foxglove's WebSocket and a page for all of them where they are wanted."""
    bridge = None if foxglove is None else _bridge(foxglove)
    page = None if view is None else _place("--view", view)
    from suspension_twin.addons.cli.live_fleet import run_fleet
    from suspension_twin.nodes.parameters import read_param_file
    from suspension_twin.nodes.process import check_arguments

    wanted = {} if params is None else read_param_file(params)
    check_arguments(ros_args)
    arguments = [*ros_args, *(["--ros-args", "--params-file", str(params)] if params is not None else [])]
    beside = []
    if bridge is not None:
        values = {"host": bridge.host, "port": bridge.port}
        beside.append(_beside("foxglove_bridge", values, namespace, arguments))
    pages = None if page is None else partial(_fleet_pages, page, arguments)
    run_fleet(manifest, namespace, processes, params, wanted, arguments, beside, pages)


@contextmanager
def _fleet_pages(
    page: Page, arguments: list[str], twins: Mapping[str, str]
) -> Iterator[Callable[[Mapping[str, Mapping[str, Any]]], None]]:
    """The page of a fleet; that of a twin, a process of its own, is there from when it is first asked for."""
    from suspension_twin.addons.view.fleet import FleetServer

    opened: dict[str, tuple[int, ExitStack]] = {}

    def open_page(name: str) -> int:
        if name in opened:
            port, own = opened.pop(name)
        else:
            while len(opened) >= _PAGES:  # the one that was not asked for for the longest time
                opened.pop(next(iter(opened)))[1].close()
            place = _place("--view", f"[{page.host}]:0" if ":" in page.host else f"{page.host}:0")
            values = {"host": place.host, "port": place.port, "token": page.token, "twin": twins[name]}
            own = ExitStack()
            own.enter_context(_beside("viewer", values, name, arguments))
            _await_listener(place)
            port = place.port
        opened[name] = port, own
        return port

    server = FleetServer(list(twins), open_page, **page._asdict())
    try:
        print(f"Watch on {server.url}", file=sys.stderr, flush=True)
        yield server.tell
    finally:
        server.close()
        for _, own in opened.values():
            own.close()


def _await_listener(place: Page) -> None:
    """Until a page answers on a port; raises WorkError where it does not."""
    until = time.monotonic() + _OPENED
    while time.monotonic() < until:
        with suppress(OSError), socket.create_connection((place.host, place.port), timeout=1.0):
            return
        time.sleep(0.1)
    raise WorkError("--view: the page of this twin did not start")


@contextmanager
def _recorded(composed: Composed, path: Path, force: bool) -> Iterator[None]:
    """What the sources send goes into a recording, which is complete at the end, whatever ends it."""
    from suspension_twin.addons.sources.common.recorder import Recorder
    from suspension_twin.cli._status import say
    from suspension_twin.addons.nodes.source import SourceNode

    source = composed.nodes["source"]
    assert isinstance(source, SourceNode)
    try:
        with Recorder(path, overwrite=force) as recorder:
            source.tap = lambda packet: recorder.write([packet])
            yield
    finally:
        source.tap = None
        if path.exists():
            say(f"{recorder.counts['imu']} IMU samples, {recorder.counts['fix']} positions written to {path}")


def _learnt_files(road: Path | None) -> list[Path]:
    """The road that is learnt, its record, and the twin on it."""
    if road is None:
        return []
    from suspension_twin.addons.roads.drives.learning import twin_path
    from suspension_twin.road.origin import record_path

    if road.suffix.lower() != ".crg":
        raise InputError(road, "a road is written as .crg; name the file so")
    return [road, record_path(road), twin_path(road)]


@contextmanager
def _learnt(composed: Composed, road: Path, stop: Stop) -> Iterator[None]:
    """At the end, whatever ends it, the road of what was driven last is learnt as well."""
    from suspension_twin.cli._status import Status, say

    try:
        yield
    finally:
        learner = composed.learner
        assert learner is not None
        learner.close_pass()
        if learner.pending:
            say("learning the road of the last pass; Ctrl-C ends this")
            with suppress(KeyboardInterrupt), stop.again(), Status(composed) as status:
                while learner.pending:
                    composed.serve()
                    status.show()
        say(
            learner.summary()
            if learner.learnt
            else f"no road was learnt, {road} is not written: {learner.why}"
        )


def _speed(rate: str) -> float:
    if rate == "max":
        return math.inf
    try:
        number = float(rate)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number >= 0):
        raise InputError("--rate", f"must be a number above 0, or 'max', is '{rate}'")
    return number or math.inf


def _place(option: str, given: str) -> Page:
    """Where to listen; raises InputError for a wrong or taken place."""
    from suspension_twin.addons.view.server import is_local

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
    return Page(host, port, "" if is_local(host) else secrets.token_urlsafe(9))


def _bridge(given: str) -> Page:
    """Where Foxglove's WebSocket is to be; raises InputError where its library is missing."""
    from importlib.util import find_spec

    if find_spec("foxglove") is None:
        raise InputError("--foxglove", 'needs foxglove-sdk: pip install "suspension-twin[foxglove]"')
    return _place("--foxglove", given)


@contextmanager
def _beside(node: str, values: dict[str, Any], namespace: str, arguments: list[str]) -> Iterator[None]:
    """A node in a process of its own, which computes when the others do not, and ends with this one."""
    values = values | {"parent": os.getpid()}
    given = [w for name, value in values.items() for w in ("-p", f"{name}:={json.dumps(value)}")]
    place = ["-r", f"__ns:=/{namespace.strip('/')}"] if namespace else []
    command = [
        sys.executable,
        "-m",
        f"suspension_twin.nodes.{node}",
        *arguments,
        "--ros-args",
        *place,
        *given,
    ]
    process = subprocess.Popen(["nice", "-n", "5", *command] if shutil.which("nice") else command)
    try:
        yield
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(1.0)


def _playback(bag: Path, speed: float, loop: bool, stay: bool) -> Playback:
    from suspension_twin.cli._status import say
    from suspension_twin.drive.read import read_drive
    from suspension_twin.nodes.composed import Playback

    drive = read_drive(bag)
    for warning in drive.warnings:
        say(f"{bag}: {warning}")
    return Playback(drive, speed, loop, _VIEWED if stay else _DISCOVERY, stay)


def _run(composed: Composed, stop_asked: Callable[[], bool], bag: Path | None) -> None:
    from suspension_twin.cli._status import Status

    with Status(composed) as status:
        while not (stop_asked() or composed.finished):
            composed.step()
            status.show()
        until = time.monotonic() + 0.2
        while composed.finished and not stop_asked() and time.monotonic() < until:
            composed.step()
        end = composed.condition()
        if composed.finished and not end.answers:
            why = f": {end.complaints[0]}" if end.complaints else ""
            raise WorkError(f"{bag}: the twin answered none of {end.samples} IMU samples{why}")
        status.conclude()
