# SPDX-License-Identifier: Apache-2.0
"""What the four nodes have in common: parameters, inputs, outputs, diagnostics, starting afresh.

A message can be wrong in any way and the node lives on: whatever a handler raises becomes a
diagnostics entry, a count and one line in the log.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from collections.abc import Set as AbstractSet
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions

from suspension_twin.nodes._health import ERROR, OK, WARN, Health, InputState
from suspension_twin.nodes._input import SENSOR_QOS, STREAM_QOS, Embedding, Input
from suspension_twin.nodes._links import Outbox, Output
from suspension_twin.nodes._parameters import Param, ParameterSet, Values
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.clock import JUMP_BACK

__all__ = ["SENSOR_QOS", "STREAM_QOS", "Embedding", "Input", "TwinNode"]

_PERIOD = 1.0
_LEVELS = {"ok": OK, "warn": WARN, "error": ERROR}

COMMON = (
    Param(
        "silence_timeout",
        2.0,
        "Seconds without a message after which a topic is reported as silent.",
        0.1,
        3600.0,
    ),
    Param(
        "jump_back",
        JUMP_BACK,
        "A header stamp this many seconds behind the newest one starts the node afresh (a looped bag); "
        "one that is less behind is taken for a message that came late.",
        0.1,
        JUMP_BACK,
    ),
)


class TwinNode(Node):  # type: ignore[misc]
    """Base of the nodes. A subclass sets ``parameters``, makes its inputs and outputs, and may
    override ``check``, ``changed``, ``reset`` and ``report``."""

    parameters: tuple[Param, ...] = ()

    def __init__(self, name: str, embedding: Embedding | None = None) -> None:
        self.embedding = embedding or Embedding()
        super().__init__(
            name,
            context=self.embedding.context,
            namespace=self.embedding.namespace or None,
            parameter_overrides=list(self.embedding.parameters),
            use_global_arguments=self.embedding.use_global_arguments,
        )
        self.log: Any = Node.get_logger(self)
        self.outbox = self.embedding.outbox or Outbox()
        self.inputs: dict[str, Input] = {}
        self.outputs: dict[str, Output] = {}
        self.health = Health(self.get_fully_qualified_name().lstrip("/"), time.monotonic)
        self._findings: set[str] = set()
        self._set = ParameterSet(self, (*COMMON, *self.parameters), self.check, self._on_change)
        self.jump_back_ns = int(self.values["jump_back"] * 1e9)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._measured_at = time.monotonic()
        self._clock_at, self._clock_still = -1.0, 0.0
        self.create_timer(_PERIOD, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if self.embedding.clock_jumps:
            self._jumps = self.get_clock().create_jump_callback(
                JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False),
                post_callback=self._on_clock_jump,
            )

    @property
    def values(self) -> Values:
        """The parameters in force."""
        return self._set.values

    # What a subclass may override

    def check(self, values: Values) -> None:
        """Raise InputError where ``values`` cannot be used together."""

    def changed(self, names: AbstractSet[str]) -> None:
        """``names`` have new values."""

    def reset(self) -> None:
        """Forget everything that came in so far."""

    def report(self) -> None:
        """Bring ``health`` up to date; called before every diagnostics message."""

    # What a subclass uses

    def listen(
        self, kind: type, topic: str, handler: Callable[[Any, int], None], *, expected: bool = True
    ) -> Input:
        """Call ``handler(message, stamp in ns)`` for every message of ``topic``."""
        state = self.health.inputs[topic] = InputState(topic, expected)
        taken = self.inputs[topic] = Input(self, state, handler)
        if topic not in self.embedding.linked:
            self.create_subscription(
                kind,
                topic,
                taken.deliver,
                SENSOR_QOS,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
        return taken

    def offer(self, kind: type, topic: str) -> Output:
        """An output published on ``topic``."""
        options = QoSOverridingOptions.with_default_policies()
        publisher = self.create_publisher(kind, topic, STREAM_QOS, qos_overriding_options=options)
        out = self.outputs[topic] = Output(publisher, self.outbox)
        return out

    def note(self, code: str, level: bytes, text: str) -> None:
        """Count an event, show it in the diagnostics, and log it unless it was just logged."""
        if self.health.event(code, level, text):
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
        """A message is not in the frame that the twin file says; it is taken as if it were."""
        self.note(
            f"frame {topic}", WARN, f"{topic}: frame_id is '{got}', the twin's is '{wanted}': taken as that"
        )

    def show_findings(self, found: Iterable[Finding]) -> None:
        """Put ``found`` in the place of the findings shown before; log the new ones."""
        listed = {f"finding {f.code}": f for f in found}
        for code in self._findings - listed.keys():
            self.health.clear(code)
        for code, finding in listed.items():
            level = _LEVELS[finding.level]
            self.health.finding(code, level, finding.text)
            if code not in self._findings and level != OK:
                self.say(level, finding.text)
        self._findings = set(listed)

    def start_afresh(self, why: str, ns: int) -> None:
        """Time has gone back to ``ns``: forget what came after it."""
        for known in self.inputs.values():
            known.newest = min(known.newest, ns)
        self.reset()
        self.note("fresh start", OK, f"{why}: starting afresh")

    # Inner workings

    def _on_change(self, names: set[str]) -> None:
        self.jump_back_ns = int(self.values["jump_back"] * 1e9)
        self.changed(names)

    def _on_clock_jump(self, jump: TimeJump) -> None:
        # The stamps tell the same story; whichever tells it first is believed, and only once.
        now = self.get_clock().now().nanoseconds
        if now > 0 and any(known.newest > now + self.jump_back_ns for known in self.inputs.values()):
            self.start_afresh(f"the clock went back by {-jump.delta.nanoseconds / 1e9:.1f} s", now)

    def _diagnose(self) -> None:
        try:
            self._measure_inputs()
            self.report()
        except Exception as error:
            self.note("failed report", ERROR, f"{type(error).__name__}: {error}")
        message = DiagnosticArray(status=self.health.statuses())
        message.header.stamp = self.stamp_now()
        self._diagnostics.publish(message)

    def stamp_now(self) -> TimeMessage:
        """The node's time, simulated if ``use_sim_time`` is set."""
        return self.get_clock().now().to_msg()

    def _measure_inputs(self) -> None:
        """Rates in real time; silence in the node's own time, in which a paused replay is no silence."""
        wall = time.monotonic()
        interval, self._measured_at = wall - self._measured_at, wall
        now = self.get_clock().now().nanoseconds / 1e9
        self._watch_clock(now, interval)
        for name, known in self.inputs.items():
            state = known.state
            state.measure(now, interval)
            silent = state.expected and state.silent_for > self.values["silence_timeout"]
            if silent and not state.warned:
                self.log.warning(
                    f"{self.resolve_topic_name(name)} is silent: no message since {state.silent_for:.0f} s"
                )
            elif state.warned and not silent:
                self.log.info(f"{self.resolve_topic_name(name)} is back")
            state.warned = silent
            if name in self.embedding.linked and self.count_publishers(name) > 1:
                self.health.finding(
                    f"outside {name}",
                    WARN,
                    f"{name} is also published from outside, which is "
                    "not listened to here: run the nodes apart",
                )
            else:
                self.health.clear(f"outside {name}")

    def _watch_clock(self, now: float, interval: float) -> None:
        """Simulated time that stands still keeps every other watch from barking."""
        moved = now != self._clock_at
        self._clock_still = 0.0 if moved else self._clock_still + interval
        self._clock_at = now
        if self._clock_still > self.values["silence_timeout"]:
            text = f"use_sim_time is set, and /clock stands still for {self._clock_still:.0f} s"
            self.health.finding("clock", WARN, text)
        else:
            self.health.clear("clock")
