# SPDX-License-Identifier: Apache-2.0
"""Base of the nodes: parameters, inputs, outputs, diagnostics, reset.

No message stops a node: an exception in a handler becomes a diagnostics entry, a count and one line
in the log.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Set as AbstractSet
from copy import copy
from dataclasses import dataclass, field
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Parameter as ParameterMessage, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter_service import ParameterService
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.subscription import Subscription

from suspension_twin.errors import InputError
from suspension_twin.files import Folders, for_peers, reading
from suspension_twin.live.twin import DigitalTwin
from suspension_twin.nodes.aside import Aside
from suspension_twin.nodes.parameters import TWIN, NamedTwin, Param, ParameterSet, Values, read_named
from suspension_twin.nodes.process import run_alone
from suspension_twin.nodes.topics import (
    ERROR,
    OK,
    SENSOR_QOS,
    STALE,
    STREAM_QOS,
    WARN,
    Embedding,
    Input,
    InputState,
    Message,
    Outbox,
    Output,
    type_name,
)
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.clock import JUMP_BACK

__all__ = ["COMMON", "HARDWARE", "Health", "TwinNode"]

_LEVELS = {"ok": OK, "warn": WARN, "error": ERROR}
#: Beginning of every hardware id; the frame of the sensor follows where the status is about one.
HARDWARE = "suspension_twin"
#: Seconds for which a past event stays in the diagnostics message.
RECENT = 5.0

COMMON = (
    Param(
        "silence_timeout",
        2.0,
        "Time in s without a message after which a topic is reported as silent.",
        0.1,
        3600.0,
    ),
    Param(
        "jump_back",
        JUMP_BACK,
        "A header stamp that is older than the newest one by more than this time in s resets the node (a looped bag); "
        "one that is less old is treated as a late message.",
        0.1,
        JUMP_BACK,
    ),
    Param(
        "max_backlog",
        2.0,
        "Time in s that a message may wait for a node on a computer that is too slow; then the node goes on with the "
        "newest message and warns. With use_sim_time nothing is skipped.",
        0.1,
        3600.0,
    ),
)


@dataclass
class _Event:
    text: str
    level: bytes
    count: int = 0
    at: float = -math.inf


@dataclass
class Health:
    """The condition of a node: ``values`` shown in the diagnostics, ``things`` with a status of their own, findings
    that hold until they are cleared, events that are counted. ``name`` is the node's, ``clock`` gives s."""

    name: str
    clock: Callable[[], float]
    inputs: dict[str, InputState] = field(default_factory=dict)
    values: dict[str, str] = field(default_factory=dict)
    things: dict[str, DiagnosticStatus] = field(default_factory=dict)
    findings: dict[str, tuple[bytes, str]] = field(default_factory=dict)
    events: dict[str, _Event] = field(default_factory=dict)

    def event(self, code: str, level: bytes, text: str, times: int = 1) -> bool:
        """Count an event and report it for a few seconds. True if it is to be logged: the first time, and
        when it comes again after a pause."""
        event = self.events.setdefault(code, _Event(text, level))
        now = self.clock()
        fresh = now - event.at > RECENT
        event.text, event.level, event.at = text, level, now
        event.count += times
        return fresh

    def count(self, code: str) -> int:
        """How often the event ``code`` has happened."""
        return self.events[code].count if code in self.events else 0

    def complaints(self) -> list[tuple[bytes, str]]:
        """Level and text of every present warning and error, errors first."""
        now = self.clock()
        found = [(level, text) for level, text in self.findings.values() if level != OK]
        for state in self.inputs.values():
            if state.warned:
                found.append((WARN, f"no message on {state.topic} for {state.silent_for:.0f} s{state.why}"))
        for event in self.events.values():
            if now - event.at <= RECENT and event.level != OK:
                times = f" ({event.count} times)" if event.count > 1 else ""
                found.append((event.level, event.text + times))
        return sorted(found, key=lambda entry: entry[0], reverse=True)

    def thing(self, name: str, level: bytes, message: str, hardware: str = "", **values: float) -> None:
        """Give a thing (a rate, a datum, the gap) its own status; ``hardware`` is the frame of its sensor, numbers that
        are not known are left out."""
        shown = {key.replace("_", " "): f"{v:.4g}" for key, v in values.items() if math.isfinite(v)}
        self.things[name] = _status(f"{self.name}: {name}", [(level, message)], shown, hardware)

    def statuses(self) -> list[DiagnosticStatus]:
        """One status of the node, one of each thing, one of each subscribed topic."""
        counts = {f"{code} (count)": str(event.count) for code, event in self.events.items()}
        out = [_status(self.name, self.complaints(), self.values | counts)]
        out += self.things.values()
        for state in self.inputs.values():
            about = [(STALE, f"no message for {state.silent_for:.0f} s{state.why}")] if state.warned else []
            rate = "" if math.isnan(state.rate) else f"{state.rate:.1f}"
            values = {"messages": str(state.received), "rate (Hz)": rate}
            out.append(_status(f"{self.name}: {state.topic}", about, values, state.frame))
        return out


def _status(
    name: str, complaints: list[tuple[bytes, str]], values: dict[str, str], hardware: str = ""
) -> DiagnosticStatus:
    return DiagnosticStatus(
        name=name,
        hardware_id=f"{HARDWARE}: {hardware}" if hardware else HARDWARE,
        level=complaints[0][0] if complaints else OK,
        message="; ".join(text for _, text in complaints) or "ok",
        values=[KeyValue(key=k, value=v) for k, v in values.items()],
    )


class _ParameterServices(ParameterService):  # type: ignore[misc]
    """The services of rclpy; a twin that they name is read beside the node, and then set."""

    async def _set(self, parameters: list[ParameterMessage]) -> SetParametersResult:
        node: TwinNode = self._get_node()  # type: ignore[no-untyped-call]
        try:
            for given in parameters:
                if given.name == TWIN.name and TWIN.name in node.values and given.value.string_value:
                    await node.read_named(given.value.string_value)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        request = SetParametersAtomically.Request(parameters=parameters)
        answer = SetParametersAtomically.Response()
        super()._set_parameters_atomically_callback(request, answer)  # type: ignore[no-untyped-call]
        return answer.result

    async def _set_parameters_callback(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        response.results = [await self._set([given]) for given in request.parameters]
        return response

    async def _set_parameters_atomically_callback(
        self, request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> SetParametersAtomically.Response:
        response.result = await self._set(list(request.parameters))
        return response


class TwinNode(Node):  # type: ignore[misc]
    """Base of the nodes. A subclass sets ``parameters``, makes its inputs and outputs, and may override
    ``check``, ``start``, ``reset`` and ``report``."""

    common: tuple[Param, ...] = COMMON
    parameters: tuple[Param, ...] = ()
    #: Whether rclpy's events executor serves the node in a process of its own.
    events = False
    #: Whether it works; what comes otherwise is dropped.
    active = True

    @classmethod
    def main(cls, args: list[str] | None = None) -> int:
        """Run the node in this process until it is asked to stop; return the exit status."""
        return run_alone(cls, args, cls.events)

    def __init__(self, name: str, embedding: Embedding | None = None) -> None:
        self.embedding = embedding or Embedding()
        #: What services do beside the node's work.
        self.aside = Aside(self)
        super().__init__(
            name,
            context=self.embedding.context,
            namespace=self.embedding.namespace or None,
            parameter_overrides=list(self.embedding.parameters),
            start_parameter_services=False,
        )
        self._parameter_services = _ParameterServices(self)  # type: ignore[no-untyped-call]
        self.log: RcutilsLogger = Node.get_logger(self)
        #: For what others may not know: on the terminal and in the log file, not on /rosout.
        self.own_log = get_logger(f"{HARDWARE}.{name}")
        self.outbox = self.embedding.outbox or Outbox()
        self.twin = self.embedding.twin or DigitalTwin()
        #: The nodes whose stages are in one twin: they are reset together.
        self.companions: tuple[TwinNode, ...] = (self,)
        self.inputs: dict[str, Input] = {}
        self.outputs: dict[str, Output] = {}
        self.health = Health(self.get_fully_qualified_name().lstrip("/"), time.monotonic)
        self._shown: set[str] = set()
        self._counted: dict[str, int] = {}
        try:
            self._set = ParameterSet(self, (*self.common, *self.parameters), self.checked, self._on_change)
            self._read_limits()
        except InputError:
            Node.destroy_node(self)  # else at some garbage collection, which DDS may hold up for good
            raise
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        #: Called with every diagnostics message, beside the topic.
        self.diagnostics_links: list[Callable[[DiagnosticArray], None]] = []
        self._measured_at = time.monotonic()
        self._clock_at, self._clock_still = -1.0, 0.0
        #: Whether the clock stands still because somebody paused the replay.
        self.clock_rests = False
        self.create_timer(1.0, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if self.embedding.clock_jumps:
            self._jumps = self.get_clock().create_jump_callback(
                JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False),
                post_callback=self._on_clock_jump,
            )

    @property
    def values(self) -> Values:
        """The present values of the parameters."""
        return self._set.values

    @property
    def folders(self) -> Folders:
        """The folders in which others may have this node read and write files."""
        return self._set.folders

    @property
    def simulated_time(self) -> bool:
        """Whether ``use_sim_time`` is set: a replay, in which being late does no harm."""
        return bool(self.get_parameter("use_sim_time").value)

    # What a subclass may override

    def check(self, values: Values) -> None:
        """Raise InputError for ``values`` that cannot be used together."""

    def checked(self, values: Values) -> None:
        """:meth:`check` values that are to be taken."""
        self.check(values)

    def bring_up(self) -> None:
        """Begin to work, once the node is whole."""

    def changed(self, names: AbstractSet[str]) -> None:
        """The parameters ``names`` have new values: with one of the node's own it starts anew."""
        if names & {p.name for p in self.parameters}:
            self.start()

    def prepare(self, _values: Values, _named: NamedTwin) -> None:
        """Make what takes long of a twin that is to be taken with these values, on a thread beside the node."""

    def start(self) -> None:
        """Take the present values of the parameters, and discard all data received so far."""

    def reset(self) -> None:
        """Discard all data received so far."""

    def report(self) -> None:
        """Bring ``health`` up to date; called before every diagnostics message."""

    # What a subclass uses

    def frame(self, name: str) -> str:
        """The frame ``name`` of this vehicle: the namespace comes before it, for all twins share one ``/tf``. A name
        with a slash is taken as it is."""
        own = self.get_namespace().strip("/")
        return f"{own}/{name}" if own and "/" not in name else name

    def is_frame(self, got: str, wanted: str) -> bool:
        """Whether ``got`` is the frame ``wanted``, with or without the namespace."""
        return got in (wanted, self.frame(wanted))

    def create_publisher(self, *args: Any, **keywords: Any) -> Publisher:
        """As in the base class, without events of the quality of service, which rclpy handles in Python at every
        callback: half of its time. Of incompatible profiles the node at the other end warns."""
        events = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(*args, event_callbacks=events, **keywords)

    def create_subscription(self, *args: Any, **keywords: Any) -> Subscription:
        """As in the base class, without events of the quality of service unless they are asked for, see
        :meth:`create_publisher`."""
        keywords.setdefault("event_callbacks", SubscriptionEventCallbacks(use_default_callbacks=False))
        return super().create_subscription(*args, **keywords)

    def create_service(self, *args: Any, **keywords: Any) -> Service:
        """As in the base class; a callback may be a coroutine that waits for what is done :attr:`aside`."""
        return super().create_service(*args, callback_group=self.aside.group, **keywords)

    async def read_named(self, path: str) -> None:
        """Have the twin at ``path``, which somebody elsewhere names, read and made ready before a callback asks for it.

        Raises InputError for a path that may not be named, and for its files, with what others may know of them.
        """
        with reading("twin", "a path"), for_peers(self.own_log.warning):
            self._set.check_twin(path)
            values = {**self.values, "twin": path}
            await self.aside.do(lambda: self.prepare(values, read_named(path)))

    def listen(
        self, kind: type, topic: str, handler: Callable[[Message, int], None], *, expected: bool = True
    ) -> Input:
        """Call ``handler(message, stamp in ns)`` for every message of ``topic``."""
        state = self.health.inputs[topic] = InputState(topic, expected)
        taken = self.inputs[topic] = Input(self, state, handler)
        if topic not in self.embedding.linked:
            options = QoSOverridingOptions.with_default_policies()
            receive = taken.receive_bare if self.embedding.bare else taken.receive
            # rclpy writes an override into the profile that it is given
            profile = copy(SENSOR_QOS)
            taken.subscription = self.create_subscription(
                kind, topic, receive, profile, qos_overriding_options=options
            )
        return taken

    def offer(self, kind: type, topic: str, qos: QoSProfile = STREAM_QOS) -> Output:
        """An output published on ``topic``."""
        options = QoSOverridingOptions.with_default_policies()
        publisher = self.create_publisher(kind, topic, copy(qos), qos_overriding_options=options)
        out = self.outputs[topic] = Output(publisher, self.outbox)
        return out

    def note(self, code: str, level: bytes, text: str, times: int = 1) -> None:
        """Count an event, show it in the diagnostics, and log it unless it was just logged."""
        if self.health.event(code, level, text, times):
            self.say(level, text)

    def say(self, level: bytes, text: str) -> None:
        """Log a line. (rclpy refuses two severities from one place in the code.)"""
        if level == ERROR:
            self.log.error(text)
        elif level == WARN:
            self.log.warning(text)
        else:
            self.log.info(text)

    def note_frame(self, topic: str, got: str, wanted: str) -> None:
        """Warn of a message that is not in the frame of the twin file; it is used as if it were."""
        text = f"{topic}: frame_id is '{got}', expected '{wanted}' from the twin file: used as '{wanted}'"
        self.note(f"wrong frame_id on {topic}", WARN, text)

    def note_counts(self, counts: Mapping[str, int], texts: Mapping[str, str]) -> None:
        """Warn of every counter that has grown since the last call; ``texts`` are the warnings."""
        for code, text in texts.items():
            new = counts[code] - self._counted.get(code, 0)
            if new > 0:
                self.note(text, WARN, text, new)
            self._counted[code] = counts[code]

    def show_findings(self, found: Iterable[Finding]) -> None:
        """Replace the findings shown before by ``found``; log the new ones."""
        listed = {f"finding {f.code}": f for f in found}
        for code in self._shown - listed.keys():
            del self.health.findings[code]
        for code, finding in listed.items():
            level = _LEVELS[finding.level]
            self.health.findings[code] = level, finding.text
            if code not in self._shown and level != OK:
                self.say(level, finding.text)
        self._shown = set(listed)

    def reset_to(self, why: str, ns: int) -> None:
        """Reset the node and its companions: time has jumped back to ``ns``."""
        self.twin.reset()
        for node in self.companions:
            for known in node.inputs.values():
                known.newest = min(known.newest, ns)
            node.reset()
            node.note("resets after a jump back in time", OK, f"{why}: the node is reset")

    def stamp_now(self) -> TimeMessage:
        """The node's time, simulated if ``use_sim_time`` is set."""
        return self.get_clock().now().to_msg()

    # Inner workings

    def _on_change(self, names: set[str]) -> None:
        self._read_limits()
        self.changed(names)

    def _read_limits(self) -> None:
        self.jump_back_ns = int(self.values["jump_back"] * 1e9)
        self.max_backlog_ns = int(self.values["max_backlog"] * 1e9)

    def _on_clock_jump(self, jump: TimeJump) -> None:
        # The stamps jump as the clock does; the node is reset by whichever comes first, and only once.
        now = self.get_clock().now().nanoseconds
        if now > 0 and any(known.newest > now + self.jump_back_ns for known in self.inputs.values()):
            self.reset_to(f"the ROS clock jumped back by {-jump.delta.nanoseconds / 1e9:.1f} s", now)

    def _diagnose(self) -> None:
        try:
            self._measure_inputs()
            self.report()
        except Exception as error:
            self.note("errors in the diagnostics", ERROR, f"{type(error).__name__}: {error}")
        message = DiagnosticArray(status=self.health.statuses())
        message.header.stamp = self.stamp_now()
        self._diagnostics.publish(message)
        for link in self.diagnostics_links:
            link(message)

    def _find(self, code: str, holds: bool, text: str) -> None:
        """Show a warning while it holds, and log it when it begins."""
        if holds:
            if code not in self.health.findings:
                self.say(WARN, text)
            self.health.findings[code] = WARN, text
        else:
            self.health.findings.pop(code, None)

    def _why_silent(self, topic: str, known: Input) -> str:
        """In words, if somebody publishes the topic in a way that cannot be taken."""
        if known.subscription is None:
            return ""
        wanted = type_name(known.subscription.msg_type)
        reliable = known.subscription.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        for publisher in self.get_publishers_info_by_topic(topic):
            if publisher.topic_type != wanted:
                return f": {publisher.topic_type} comes there from {publisher.node_name}, and {wanted} is expected"
            if reliable and publisher.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT:
                return (
                    f": {publisher.node_name} publishes it best effort, and the subscription is set to reliable "
                    "(qos_overrides)"
                )
        return f", expected as {wanted}"

    def _measure_inputs(self) -> None:
        """Rates in real time; silence in the node's own time, in which a paused replay is no silence."""
        wall = time.monotonic()
        interval, self._measured_at = wall - self._measured_at, wall
        now = self.get_clock().now().nanoseconds / 1e9
        timeout = self.values["silence_timeout"]
        self._clock_still = 0.0 if now != self._clock_at else self._clock_still + interval
        self._clock_at = now
        still = f"use_sim_time is true, but /clock has not advanced for {self._clock_still:.0f} s"
        self._find("clock", self._clock_still > timeout and not self.clock_rests, still)
        for name, known in self.inputs.items():
            state, resolved = known.state, self.resolve_topic_name(name)
            state.measure(now, interval)
            silent = state.expected and state.silent_for > timeout
            state.why = self._why_silent(resolved, known) if silent else ""
            if silent and not state.warned:
                self.log.warning(f"no message on {resolved} for {state.silent_for:.0f} s{state.why}")
            elif state.warned and not silent:
                self.log.info(f"messages on {resolved} again")
            state.warned = silent
            foreign = name in self.embedding.linked and self.count_publishers(name) > 1
            text = (
                f"another publisher on {resolved} is ignored: nodes of one process pass this topic on directly; "
                "start them as separate processes to use it"
            )
            self._find(f"foreign publisher on {name}", foreign, text)
