# SPDX-License-Identifier: Apache-2.0
"""How messages come into a node, and how a node is put into a process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from suspension_twin.errors import InputError
from suspension_twin.nodes._health import ERROR, WARN, InputState
from suspension_twin.nodes._links import Outbox

__all__ = ["SENSOR_QOS", "STREAM_QOS", "Embedding", "Input"]

#: As qos_profile_sensor_data, but deep enough to ride out a pause of the process at 1.6 kHz.
SENSOR_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT
)
#: Reliable, since game engines and dashboards connect to nothing else.
STREAM_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE)

_NS = 1_000_000_000


class Receiver(Protocol):
    """What an input needs of its node."""

    outbox: Outbox
    jump_back_ns: int

    def note(self, code: str, level: bytes, text: str) -> None:
        """Count an event and show it."""

    def start_afresh(self, why: str, ns: int) -> None:
        """Time has gone back to ``ns``."""


@dataclass(frozen=True)
class Embedding:
    """How a node is put into a process: all default for a process of its own.

    ``linked`` names the inputs that another node of the process delivers, so that no subscription
    is made for them; ``outbox`` is shared by all nodes of the process. ``clock_jumps``: start afresh when
    the clock goes back; not where the stamps are handed over directly and the clock limps behind.
    """

    context: Context | None = None
    namespace: str = ""
    parameters: tuple[Parameter, ...] = ()
    linked: frozenset[str] = frozenset()
    outbox: Outbox | None = None
    use_global_arguments: bool = True
    clock_jumps: bool = True


class Input:
    """One topic that a node listens to. ``deliver`` takes a message from wherever it comes."""

    def __init__(self, node: Receiver, state: InputState, handler: Callable[[Any, int], None]) -> None:
        self.state = state
        self.newest = 0
        self._node = node
        self._outbox = node.outbox
        self._handler = handler

    def deliver(self, message: Any) -> None:
        """Handle one message; never raises because of it."""
        node = self._node
        self.state.received += 1
        self._outbox.enter()
        try:
            stamp = message.header.stamp
            ns = stamp.sec * _NS + stamp.nanosec
            if ns <= 0:
                raise InputError(self.state.topic, "header.stamp is zero: the message was dropped")
            if ns < self.newest - node.jump_back_ns:
                node.start_afresh(f"{self.state.topic} went back by {(self.newest - ns) / 1e9:.1f} s", ns)
            if ns > self.newest:
                self.newest = ns
            self._handler(message, ns)
        except InputError as error:
            node.note(f"refused {self.state.topic}", WARN, str(error))
        except Exception as error:  # whatever a message causes, the next one is to be handled
            node.note(
                f"failed {self.state.topic}", ERROR, f"{self.state.topic}: {type(error).__name__}: {error}"
            )
        finally:
            self._outbox.leave()
