# SPDX-License-Identifier: Apache-2.0
"""The nodes of one twin or of many in one process, on one thread, handing on plain records.

All twins of a process share one executor. rclpy's usual ones look at every entity of every node whenever a message
comes, so that a message costs the more the more twins there are; its events executor takes what has come from a queue,
at the same cost for any number.
"""

from __future__ import annotations

import gc
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Protocol, cast

from rclpy.context import Context
from rclpy.exceptions import InvalidNamespaceException
from rclpy.executors import Executor, ShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.parameter import Parameter
from rclpy.validate_namespace import validate_namespace

from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError, SuspensionTwinError, WorkError
from suspension_twin.live.gap import GapNow
from suspension_twin.live.twin import DigitalTwin
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.player import BagPlayer
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.process import WAIT, events_executor, ros_context, stopping
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.nodes.topics import ERROR, Embedding, Outbox
from suspension_twin.registry import Registry

__all__ = ["LINKS", "Composed", "Condition", "Helpers", "Playback", "TwinFleet", "check_namespace"]

KINDS = {
    "imu_ingest": ImuIngestNode,
    "pose_injector": PoseInjectorNode,
    "suspension_model": SuspensionModelNode,
    "calibrator": CalibratorNode,
}
#: Topics passed on within the process, as plain records: topic, sender, receiver. No subscription is made for them,
#: so another publisher of the same topic is ignored.
LINKS = (
    ("imu/data", "imu_ingest", "pose_injector"),
    ("twin/odom", "pose_injector", "suspension_model"),
    ("imu/vertical_acceleration", "imu_ingest", "suspension_model"),
)
#: In a playback the player takes the place of the sensors.
PLAYED = (
    ("imu/data_raw", "bag_player", "imu_ingest"),
    ("fix", "bag_player", "pose_injector"),
    ("vel", "bag_player", "pose_injector"),
    ("heading", "bag_player", "pose_injector"),
)


#: And so does the node of live sources.
LIVE = tuple((topic, "source", receiver) for topic, _, receiver in PLAYED)
#: Inputs of the node that learns the road beside the others.
LEARNT = (("twin/odom", "pose_injector", "road_learner"),)
#: With live sources: s between the executor's turns, and s that one of its callbacks waits at most for a sample to come
#: first.
_SERVE_EVERY, _BEHIND = 0.05, 0.01


@dataclass(frozen=True)
class Playback:
    """A drive to play at ``rate`` times real time (``math.inf``: full speed), once or in a ``loop``, beginning
    after ``delay`` s. With ``stay`` it waits at the end to be sent back, and never finishes."""

    drive: Drive
    rate: float = 1.0
    loop: bool = False
    delay: float = 0.0
    stay: bool = False


@dataclass(frozen=True)
class Played:
    """How far a playback is: ``position`` and ``duration`` s, ``rounds`` done, whether it is ``waiting`` to begin."""

    position: float
    duration: float
    rounds: int
    waiting: bool = False


@dataclass(frozen=True)
class Condition:
    """State of a running twin.

    ``rates`` Hz by short name; ``gap`` of the sliding window, None while not known; ``complaints`` errors first,
    ``failing`` whether one is an error; ``played`` None when live; ``learning`` what is known of the road, if it is
    learnt."""

    rates: dict[str, float]
    samples: int
    answers: int
    gap: GapNow | None
    complaints: list[str]
    failing: bool
    played: Played | None = None
    learning: str | None = None


class LiveSources(Protocol):
    """The node of live sources, which receives and delivers while it is called."""

    notes: list[str]

    def run(self, seconds: float) -> None: ...

    def run_until_delivered(self, seconds: float) -> None: ...


class RoadLearner(Protocol):
    """The node that learns the road: ``pending`` while a pass is not part of the road yet, ``learnt``
    once there is a road, ``why`` there is none."""

    pending: bool
    learnt: bool
    why: str

    def close_pass(self) -> None: ...

    def condition(self) -> str: ...

    def summary(self) -> str: ...


#: Classes of nodes of add-ons, imported where they are asked for: what estimates a road takes half a second.
ADDED: Final = Registry[Any]("nodes", kind=type)


def check_namespace(namespace: str) -> None:
    """Raise InputError for an invalid namespace."""
    try:
        validate_namespace(f"/{namespace.strip('/')}")
    except InvalidNamespaceException as error:
        reason = " ".join(str(error).split()).partition(": ")[2]
        raise InputError("--namespace", reason or str(error)) from None


class Composed:
    """All nodes of one twin, with a ``playback`` or with live ``sources`` (URLs) if it is given any, and with one that
    learns the road into the file ``learn``. Call :meth:`step` until :attr:`finished`, then :meth:`close`. One of many
    twins gets the ``executor`` that serves them all and is spun by its owner; such a twin has no calibrator. Others may
    name files in further ``folders``, see the parameter of this name."""

    def __init__(
        self,
        context: Context,
        twin_file: Path | str,
        namespace: str = "",
        playback: Playback | None = None,
        sources: Sequence[str] = (),
        learn: Path | None = None,
        *,
        executor: Executor | None = None,
        folders: Sequence[Path] = (),
    ) -> None:
        #: The live twin, whose stages the nodes hold.
        self.twin = DigitalTwin()
        outbox = Outbox()
        sensed = PLAYED if playback else LIVE if sources else ()
        links = sensed
        if learn is not None:
            links += LEARNT + tuple((topic, sender, "road_learner") for topic, sender, _ in sensed)
        self._shared = executor is not None
        self.executor = executor or SingleThreadedExecutor(context=context)
        self.nodes: dict[str, TwinNode] = {}
        self._serve_at = 0.0
        self.player: BagPlayer | None = None
        parameters = [Parameter("twin", value=str(twin_file))]
        named = [*folders, *([] if learn is None else [learn.absolute().parent])]
        if named:
            places = [Path.cwd(), Path(twin_file).absolute().parent, *named]
            parameters.append(Parameter("folders", value=os.pathsep.join(map(str, places))))
        if playback:
            parameters.append(Parameter("use_sim_time", value=True))
        try:
            out = {} if learn is None else {"road_learner": Parameter("out", value=str(learn))}
            added = () if learn is None else ("road_learner",)
            for name, kind in (KINDS | {name: ADDED.named(name, "nodes") for name in added}).items():
                if self._shared and name == "calibrator":
                    continue
                linked = frozenset(topic for topic, _, receiver in LINKS + links if receiver == name)
                embedding = Embedding(
                    context,
                    namespace,
                    (*parameters, *([out[name]] if name in out else [])),
                    linked,
                    outbox,
                    clock_jumps=playback is None,
                    bare=self._shared,
                    twin=self.twin,
                )
                self.nodes[name] = kind(embedding)
                self.executor.add_node(self.nodes[name])
            self._connect()
            if sources:
                urls = Parameter("sources", value=" ".join(sources))
                embedding = Embedding(context, namespace, (*parameters, urls), outbox=outbox)
                self.nodes["source"] = ADDED.named("source", "nodes")(embedding, driven=True)
                self.executor.add_node(self.nodes["source"])
            senders: dict[str, TwinNode | BagPlayer] = dict(self.nodes)
            if playback:
                embedding = Embedding(context, namespace, outbox=outbox)
                self.player = senders["bag_player"] = BagPlayer(
                    playback.drive, playback.rate, playback.loop, embedding, playback.delay, playback.stay
                )
                self.player.watched = [o.publisher for n in self.nodes.values() for o in n.outputs.values()]
                self.executor.add_node(self.player)
            for topic, sender, receiver in links:
                senders[sender].outputs[topic].links.append(self.nodes[receiver].inputs[topic].deliver)
            for node in self.nodes.values():
                node.bring_up()
        except BaseException:
            self.close()
            raise

    def _connect(self) -> None:
        """Put the stages of the nodes into one twin: a sample goes through all of them at once."""
        ingest, injector, model = (self.nodes[name] for name in list(KINDS)[:3])
        assert isinstance(ingest, ImuIngestNode) and isinstance(injector, PoseInjectorNode)
        assert isinstance(model, SuspensionModelNode)
        self.ingest, self.model = ingest, model
        #: Called with what every sample gives and its stamp in ns.
        self.outlets = self.ingest.outlets
        self.outlets[:0] = [self.model.take, injector.take]
        self.ingest.oriented.append(injector.others.on_orientation)
        for node in (self.ingest, injector, self.model):
            node.companions = (self.ingest, injector, self.model)
        if self._shared:
            for node in (self.ingest, injector):
                node.diagnostics_links.append(self.model.on_diagnostics)

    @property
    def finished(self) -> bool:
        """Whether a playback has reached its end."""
        return self.player is not None and self.player.done

    def step(self, most: float = WAIT) -> None:
        """Play the messages that are due and serve one callback; returns after ``most`` s at the latest."""
        pause = math.inf
        if self.player is not None:
            pause = self.player.play()
            for node in self.nodes.values():
                node.clock_rests = self.player.resting
        if self.source is not None:
            self._step_live(self.source, most)
        elif not self._serve_ready() and pause > 0.0:
            self.executor.spin_once(timeout_sec=min(most, pause))

    def serve(self) -> None:
        """Serve one callback and play nothing: what is under way comes to its end."""
        self.executor.spin_once(timeout_sec=WAIT)

    def _serve_ready(self) -> bool:
        """Serve one callback of those that are ready; whether there was one.

        The executor goes through all that are ready before it looks again, but begins anew, with its first node, where
        it is asked with another patience. The patience of a playback is another one each time: where the processor is
        busy, the last nodes would wait for ever.
        """
        try:
            handler, _, _ = self.executor.wait_for_ready_callbacks(timeout_sec=0.0)
        except (TimeoutException, ShutdownException):
            return False
        handler()
        error = handler.exception()
        if error is not None:
            raise error
        return True

    def _step_live(self, source: LiveSources, most: float) -> None:
        """Deliver samples as they come, and let the executor serve timers and services at times in between.

        A look at the wait set and a callback take a millisecond or two each. They are done one by one, each just behind
        a sample: the next one is then furthest away.
        """
        source.run(min(most, self._serve_at - time.monotonic()))
        if time.monotonic() < self._serve_at:
            return
        source.run_until_delivered(_BEHIND)
        if not self._serve_ready():
            self._serve_at = time.monotonic() + _SERVE_EVERY

    @property
    def source(self) -> LiveSources | None:
        """The node of live sources, if there is one."""
        return cast("LiveSources | None", self.nodes.get("source"))

    @property
    def learner(self) -> RoadLearner | None:
        """The node that learns the road, if there is one."""
        return cast("RoadLearner | None", self.nodes.get("road_learner"))

    @property
    def notes(self) -> list[str]:
        """Lines of the live sources for the user."""
        return [] if self.source is None else self.source.notes

    def parameter_names(self) -> dict[str, list[str]]:
        """The names of all parameters, by node."""
        return {name: node.list_parameters([], 0).names for name, node in self.nodes.items()}

    def condition(self) -> Condition:
        """The present state; the rates are those of the last second."""
        model, ingest = self.model, self.ingest
        inputs = {t: i.state for node in self.nodes.values() for t, i in node.inputs.items()}
        shown = {"imu": "imu/data_raw", "fix": "fix", "vel": "vel", "twin": "twin/odom"}
        complaints = [
            (level, f"{n}: {text}") for n, o in self.nodes.items() for level, text in o.health.complaints()
        ]
        complaints.sort(key=lambda c: c[0], reverse=True)
        player = self.player
        return Condition(
            rates={short: inputs[topic].rate for short, topic in shown.items()},
            samples=ingest.inputs["imu/data_raw"].state.received,
            answers=model.outputs["twin/vertical_acceleration"].sent,
            gap=model.gap_now(),
            complaints=[text for _, text in complaints],
            failing=any(level == ERROR for level, _ in complaints),
            played=None
            if player is None
            else Played(player.position, player.duration, player.loops, player.waiting),
            learning=None if self.learner is None else self.learner.condition(),
        )

    def settle_memory(self) -> None:
        """Exclude the objects loaded so far from garbage collection, whose runs would take tens of milliseconds
        during a drive."""
        gc.collect()
        gc.freeze()

    def close(self) -> None:
        """Shut everything down."""
        if not self._shared:
            self.executor.shutdown()
        for node in (*self.nodes.values(), *([self.player] if self.player else [])):
            if self._shared:
                self.executor.remove_node(node)
            node.destroy_node()
        self.nodes.clear()


#: s between two reports of a helper process, and between two looks at whether it is still wanted.
_REPORT, _LOOK = 1.0, 0.1
#: s that a helper process may take to import everything and to make its twins, at least and for each twin.
_STARTING, _EACH = 60.0, 2.0


class TwinFleet:
    """Twins in one process, on one thread. ``twins`` maps a namespace to a twin file."""

    def __init__(self, context: Context, twins: Mapping[str, str]) -> None:
        self.executor = events_executor(context)
        self.twins: dict[str, Composed] = {}
        try:
            for namespace, file in twins.items():
                self.twins[namespace] = Composed(context, file, namespace, executor=self.executor)
        except BaseException:
            self.close()
            raise

    def step(self, most: float = WAIT) -> None:
        """Serve one callback; returns after ``most`` s at the latest."""
        self.executor.spin_once(timeout_sec=most)

    def conditions(self) -> dict[str, Condition]:
        """The present state of every twin, by namespace."""
        return {namespace: twin.condition() for namespace, twin in self.twins.items()}

    def parameter_names(self) -> dict[str, list[str]]:
        """The names of all parameters, by node."""
        return next(iter(self.twins.values())).parameter_names()

    def settle_memory(self) -> None:
        """See :meth:`Composed.settle_memory`."""
        next(iter(self.twins.values())).settle_memory()

    def close(self) -> None:
        """Shut everything down."""
        for twin in self.twins.values():
            twin.close()
        self.twins.clear()
        self.executor.shutdown()


class Helpers:
    """Processes that hold a share of the twins each, and report their conditions every second.

    ``shares`` has the twins of each process, ``arguments`` are those for ROS. Raises what a process raises while it
    starts. A context manager: at its end the processes end.
    """

    def __init__(self, shares: Sequence[Mapping[str, str]], arguments: Sequence[str]) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._known: dict[str, Condition] = {}
        self._processes: list[tuple[Any, Connection]] = []
        for share in shares:
            here, there = spawn.Pipe()
            process = spawn.Process(target=_help, args=(there, dict(share), list(arguments)), daemon=True)
            process.start()
            there.close()
            self._processes.append((process, here))
        self._until = time.monotonic() + _STARTING + _EACH * max(map(len, shares), default=0)

    def __enter__(self) -> Helpers:
        return self

    def __exit__(self, *exception: object) -> None:
        for process, connection in self._processes:
            connection.close()  # by which it knows
            process.join(1.0)
            if process.is_alive():
                process.kill()

    @property
    def pids(self) -> list[int]:
        """Ids of the processes."""
        return [process.pid for process, _ in self._processes]

    def wait(self, going_on: Callable[[], bool]) -> None:
        """Wait until every process has made its twins, while ``going_on``."""
        for process, connection in self._processes:
            while not connection.poll(WAIT):
                if not going_on():
                    return
                if time.monotonic() > self._until or not process.is_alive():
                    raise WorkError("a process of the fleet did not start")
            self._take(connection)

    def conditions(self) -> dict[str, Condition]:
        """The state of every twin by its last report, by namespace.

        Raises WorkError where a process has ended."""
        for process, connection in self._processes:
            try:
                while connection.poll():
                    self._take(connection)
            except (EOFError, OSError):
                raise WorkError(
                    f"a process of the fleet has ended (exit status {process.exitcode})"
                ) from None
        return dict(self._known)

    def _take(self, connection: Connection) -> None:
        report = connection.recv()
        if isinstance(report, SuspensionTwinError):
            raise report
        self._known.update(report)


def _help(connection: Connection, twins: dict[str, str], arguments: list[str]) -> None:
    """One process of :class:`Helpers`: ends when the other end of the connection is closed."""
    with stopping():
        try:
            with ros_context(arguments) as context:
                fleet = TwinFleet(context, twins)
                try:
                    fleet.settle_memory()
                    report = look = 0.0
                    while context.ok():
                        now = time.monotonic()
                        if now >= report:
                            connection.send(fleet.conditions())
                            report = now + _REPORT
                        if now >= look:
                            look = now + _LOOK
                            if connection.poll():
                                break
                        fleet.step()
                finally:
                    fleet.close()
        except SuspensionTwinError as error:
            connection.send(error)
        except (EOFError, OSError):
            pass
    os._exit(0)  # the regular exit takes half a second with a compiler loaded
