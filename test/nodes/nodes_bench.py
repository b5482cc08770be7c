# SPDX-License-Identifier: Apache-2.0
"""A bench to put nodes on, and what the tests of the nodes share beside it."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.parameters import FOLDERS
from suspension_twin.nodes.topics import NS, Embedding

#: ROS arguments of a context whose nodes skip no message that had to wait.
PATIENT = ["--ros-args", "-p", "max_backlog:=3600.0"]


class Bench:
    """Nodes under test and a node beside them that talks to them, on one thread."""

    def __init__(self, context: rclpy.Context) -> None:
        self.context = context
        self.executor = SingleThreadedExecutor(context=context)
        self.nodes: list[Node] = []
        self.side = self.add(rclpy.create_node("side", context=context))

    def add(self, node: Any) -> Any:
        """Have ``node`` served."""
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def make(self, kind: Callable[..., TwinNode], *args: Any, namespace: str = "", **parameters: Any) -> Any:
        """A node with these parameters (``__`` for a dot), which serves files of this repository and of the tests."""
        if FOLDERS in getattr(kind, "parameters", ()):
            places = Path(__file__).parents[2], tempfile.gettempdir()
            parameters = {"folders": os.pathsep.join(map(str, places)), **parameters}
        given = tuple(Parameter(k.replace("__", "."), value=v) for k, v in parameters.items())
        node = self.add(kind(Embedding(self.context, namespace, given), *args))
        node.bring_up()
        return node

    def until(
        self, condition: Callable[[], Any], what: str | Callable[[], str] = "", seconds: float = 20.0
    ) -> Any:
        """Serve until ``condition`` holds; fail after ``seconds``. Returns what it gave."""
        began = now = time.monotonic()
        turns, longest = 0, 0.0
        while not (found := condition()):
            turns, longest, now = turns + 1, max(longest, time.monotonic() - now), time.monotonic()
            if now > began + seconds:
                name = what() if callable(what) else what or condition
                pytest.fail(
                    f"waited {now - began:.1f} s for {name} ({turns} turns, the longest {longest:.1f} s)"
                )
            self.executor.spin_once(timeout_sec=0.05)
        return found

    def spin(self, seconds: float) -> None:
        """Serve for so long."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def hear(self, kind: type, topic: str, depth: int = 10_000) -> list[Any]:
        """A list that fills with the messages of ``topic``, connected to whoever publishes it."""
        heard: list[Any] = []
        subscription = self.side.create_subscription(kind, topic, heard.append, QoSProfile(depth=depth))
        if any(topic.lstrip("/") in out.publisher.topic_name for n in self.nodes for out in _outputs(n)):
            self.until(subscription.get_publisher_count, f"a publisher of {topic}")
        return heard

    def speak(self, kind: type, topic: str) -> Callable[[Any], None]:
        """A function that publishes on ``topic``, connected to whoever listens."""
        publisher = self.side.create_publisher(kind, topic, QoSProfile(depth=10_000))
        self.until(publisher.get_subscription_count, f"a subscriber of {topic}")
        return publisher.publish

    def call(self, kind: type, name: str, request: Any) -> Any:
        """The response of a service."""
        client = self.side.create_client(kind, name)
        self.until(client.service_is_ready, f"the service {name}")
        future = client.call_async(request)
        self.until(future.done, f"an answer of {name}", 120.0)  # a twin's first one waits for a compiler
        self.side.destroy_client(client)
        return future.result()

    def remove(self, node: Any) -> None:
        """Take a node down."""
        self.nodes.remove(node)
        self.executor.remove_node(node)
        node.destroy_node()

    def close(self) -> None:
        """Take everything down."""
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()


class Client:
    """A client of an action on the bench; ``feedback`` fills with what it is told."""

    def __init__(self, bench: Bench, kind: Any, name: str) -> None:
        self.bench = bench
        self.feedback: list[Any] = []
        self.action = ActionClient(bench.side, kind, name)
        bench.until(self.action.server_is_ready, "the action server")

    def send(self, goal: Any) -> Any:
        """The goal's handle, accepted or not."""
        future = self.action.send_goal_async(
            goal, feedback_callback=lambda m: self.feedback.append(m.feedback)
        )
        self.bench.until(future.done, "the goal's acceptance")
        return future.result()

    def result(self, handle: Any, seconds: float = 60.0) -> tuple[int, Any]:
        """Status and result of an accepted goal."""
        future = handle.get_result_async()
        self.bench.until(future.done, "the result", seconds)
        return future.result().status, future.result().result


def _outputs(node: Any) -> list[Any]:
    return list(getattr(node, "outputs", {}).values())


def worst(node: TwinNode) -> tuple[int, str]:
    """Level and message of the node's own status as it would be published now."""
    node._diagnose()
    status = node.health.statuses()[0]
    return status.level[0], status.message


def put_stamp(message: Any, t: float) -> Any:
    """The message with its header's stamp at ``t`` s."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(t * 1e9), NS)
    return message


def stamp_of(message: Any) -> int:
    """Header stamp in ns."""
    return int(message.header.stamp.sec * NS + message.header.stamp.nanosec)


class PlainPage:
    """A report page that is only there."""

    def write(self, path):
        path.write_text("page")
