# SPDX-License-Identifier: Apache-2.0
"""The order in which messages are handed on and published."""

from __future__ import annotations

from suspension_twin.nodes.topics import Outbox, Output


class FakePublisher:
    """Writes down what is published."""

    def __init__(self, name: str, log: list[str], listeners: int = 1) -> None:
        self.name, self.log, self.listeners = name, log, listeners
        self.handle = self

    def get_subscription_count(self) -> int:
        return self.listeners

    def publish(self, message: str) -> None:
        self.log.append(f"{self.name} published {message}")


def test_links_come_first_and_urgent_messages_before_everything_that_waits():
    log: list[str] = []
    outbox = Outbox()
    first = Output(FakePublisher("first", log), outbox)
    second = Output(FakePublisher("second", log), outbox)
    third = Output(FakePublisher("third", log), outbox)
    first.links.append(lambda m: (log.append(f"linked {m}"), second.send("b"), third.send("c", urgent=True)))
    outbox.enter()
    first.send("a")
    outbox.leave()
    assert log == ["linked a", "third published c", "second published b", "first published a"]


def test_outside_of_a_callback_a_message_goes_out_at_once():
    log: list[str] = []
    Output(FakePublisher("only", log), Outbox()).send("a")
    assert log == ["only published a"]


def test_nothing_is_published_to_nobody_but_links_are_served():
    log: list[str] = []
    out = Output(FakePublisher("lonely", log, listeners=0), Outbox())
    assert not out.wanted
    out.links.append(log.append)
    assert out.wanted
    out.send("a")
    out.send("b", urgent=True)
    assert log == ["a", "b"]
    assert out.sent == 2
