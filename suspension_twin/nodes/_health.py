# SPDX-License-Identifier: Apache-2.0
"""What a node knows about its own condition, and how it says so on ``/diagnostics``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

__all__ = ["ERROR", "OK", "WARN", "Health", "InputState"]

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
_RANK = {OK: 0, WARN: 1, ERROR: 2}

#: Seconds for which something that happened once is still told as the state of things.
RECENT = 5.0


@dataclass
class InputState:
    """How one subscribed topic fares. ``expected`` inputs are missed when they stay silent."""

    topic: str
    expected: bool
    received: int = 0
    rate: float = math.nan
    silent_for: float = 0.0
    warned: bool = False
    _counted: int = 0
    _heard: float = math.nan

    def measure(self, now: float, interval: float) -> None:
        """Update rate and silence; ``now`` and ``interval`` in s of a clock that only this uses."""
        new = self.received - self._counted
        self._counted = self.received
        self.rate = new / interval if interval > 0 else math.nan
        if new or math.isnan(self._heard) or now < self._heard:
            self._heard = now
        self.silent_for = now - self._heard


@dataclass
class _Event:
    text: str
    level: bytes
    count: int = 0
    at: float = -math.inf


@dataclass
class Health:
    """Collects findings and events; ``statuses`` turns them into diagnostics."""

    name: str
    clock: Callable[[], float]
    inputs: dict[str, InputState] = field(default_factory=dict)
    values: dict[str, str] = field(default_factory=dict)
    _standing: dict[str, tuple[bytes, str]] = field(default_factory=dict)
    _events: dict[str, _Event] = field(default_factory=dict)

    def finding(self, code: str, level: bytes, text: str) -> None:
        """Something that holds until it is cleared."""
        self._standing[code] = (level, text)

    def clear(self, code: str) -> None:
        """What ``finding`` said under this code no longer holds."""
        self._standing.pop(code, None)

    def event(self, code: str, level: bytes, text: str) -> bool:
        """Something that happened; counted for ever, told for a few seconds. True the first time
        and whenever it comes back after a pause: the moment to log it."""
        event = self._events.setdefault(code, _Event(text, level))
        now = self.clock()
        fresh = now - event.at > RECENT
        event.text, event.level, event.at = text, level, now
        event.count += 1
        return fresh

    def count(self, code: str) -> int:
        """How often the event ``code`` has happened."""
        return self._events[code].count if code in self._events else 0

    def complaints(self) -> list[tuple[bytes, str]]:
        """What is not as it should be now, worst first."""
        now = self.clock()
        found = [(level, text) for level, text in self._standing.values() if level != OK]
        for state in self.inputs.values():
            if state.warned:
                found.append((WARN, f"{state.topic} is silent for {state.silent_for:.0f} s"))
        for event in self._events.values():
            if now - event.at <= RECENT and event.level != OK:
                times = f" ({event.count} times)" if event.count > 1 else ""
                found.append((event.level, event.text + times))
        return sorted(found, key=lambda entry: -_RANK[entry[0]])

    def statuses(self) -> list[DiagnosticStatus]:
        """One status for the node, one for each topic that it listens to."""
        complaints = self.complaints()
        values: dict[str, Any] = dict(self.values)
        values |= {f"count of {code}": event.count for code, event in self._events.items()}
        out = [_status(self.name, complaints, values)]
        for state in self.inputs.values():
            about = [(WARN, f"silent for {state.silent_for:.0f} s")] if state.warned else []
            rate = "" if math.isnan(state.rate) else f"{state.rate:.1f}"
            out.append(
                _status(f"{self.name}: {state.topic}", about, {"messages": state.received, "rate (Hz)": rate})
            )
        return out


def _status(name: str, complaints: Iterable[tuple[bytes, str]], values: dict[str, Any]) -> DiagnosticStatus:
    listed = list(complaints)
    status = DiagnosticStatus(name=name, hardware_id="suspension_twin")
    status.level = listed[0][0] if listed else OK
    status.message = "; ".join(text for _, text in listed) or "ok"
    status.values = [KeyValue(key=k, value=str(v)) for k, v in values.items()]
    return status
