# SPDX-License-Identifier: Apache-2.0
"""The four nodes in one process, in a ROS context of their own, and what they publish while a drive is replayed."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from suspension_twin.arrays import Floats
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError, WorkError, nearest
from suspension_twin.nodes.composed import Composed, Playback, check_namespace
from suspension_twin.nodes.process import WAIT, ros_context
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

__all__ = ["TOPICS", "Received", "RunningTwin", "running_twin"]

#: Topics that a replay keeps where none are named.
TOPICS = (
    "imu/vertical_acceleration",
    "twin/vertical_acceleration",
    "twin/odom",
    "twin/pose",
    "twin/gap",
)
#: Discovery is off and the domain differs by process: no other program on the network takes part.
_DOMAINS = 102
#: Messages kept until they are fetched, and s between two times of fetching.
_DEPTH, _FETCH_EVERY = 50_000, 0.1
#: s that publishers and subscribers of one process are given to find each other.
_PATIENCE = 20.0


@dataclass(frozen=True, eq=False)
class Received:
    """The messages of one topic, in the order in which they came.

    Parameters
    ----------
    topic : str
        Name of the topic as it was asked for.
    messages : list
        The n messages.

    Examples
    --------
    >>> from geometry_msgs.msg import AccelStamped
    >>> message = AccelStamped()
    >>> message.header.stamp.sec, message.accel.linear.z = 7, 1.5
    >>> received = Received("twin/vertical_acceleration", [message])
    >>> received.t, received["accel.linear.z"]
    (array([7.]), array([1.5]))
    """

    topic: str
    messages: list[Any]

    def __len__(self) -> int:
        return len(self.messages)

    def __repr__(self) -> str:
        return f"{self.topic}: {len(self)} messages"

    @property
    def t(self) -> Floats:
        """(n,) s, the stamps of the headers."""
        return np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in self.messages])

    def __getitem__(self, field: str) -> NDArray[Any]:
        """(n, ...) a field of every message by its dotted name, such as ``pose.pose.position.x``."""
        return np.array([attrgetter(field)(message) for message in self.messages])


class RunningTwin:
    """A twin's nodes, ready for replays; from :func:`running_twin`.

    Parameters
    ----------
    context : rclpy.context.Context
        The ROS context of all nodes, for nodes of a test's own.
    twin : Path
        The twin file.
    namespace : str
        Namespace of the twin's nodes.

    Examples
    --------
    >>> with running_twin("bags/crg_road/twin.yaml") as nodes:
    ...     nodes.twin.name
    'twin.yaml'
    """

    def __init__(self, context: Context, twin: Path, namespace: str = "") -> None:
        self.context, self.twin, self.namespace = context, twin, namespace
        self._listener = rclpy.create_node("listener", context=context, namespace=namespace)
        self._own: list[Node] = []

    def add(self, node: Node) -> Node:
        """Serve a node of the test's own, made in this ``context``, during replays; it is destroyed at the end.

        A replay at full speed sends some hundred messages before the node gets its turn: the depth of its
        subscriptions should hold them.
        """
        self._own.append(node)
        return node

    def replay(
        self, drive: Drive | str | Path, topics: Sequence[str] = TOPICS, rate: float = math.inf
    ) -> dict[str, Received]:
        """Play a drive through the four nodes and return what came out, by topic.

        Every replay has nodes of its own: nothing of one is left for the next.

        Parameters
        ----------
        drive : Drive, str or Path
            The recording.
        topics : sequence of str
            Names relative to the namespace; absolute ones begin with a slash. Any topic that the nodes publish.
        rate : float
            Times real time; as fast as no message is lost by default.

        Returns
        -------
        dict of str to Received
            The messages of every topic asked for, with its own header stamps.

        Raises
        ------
        InputError
            The recording or the twin file cannot be read, or nobody publishes a topic.
        WorkError
            A topic was not connected in time.
        """
        drive = drive if isinstance(drive, Drive) else read_drive(drive)
        composed = Composed(self.context, self.twin, self.namespace, Playback(drive, rate))
        try:
            out = {topic: Received(topic, []) for topic in topics}
            kept = [(self._listen(topic), received.messages) for topic, received in out.items()]
            for node in self._own:
                composed.executor.add_node(node)
            until = time.monotonic() + _PATIENCE
            while not all(subscription.get_publisher_count() for subscription, _ in kept):
                if time.monotonic() > until:
                    raise WorkError(f"the topics were not connected within {_PATIENCE:g} s")
                composed.serve()
            fetch_at = 0.0
            while not composed.finished:
                composed.step()
                if time.monotonic() >= fetch_at:
                    _fetch(kept)
                    fetch_at = time.monotonic() + _FETCH_EVERY
            if self._own:
                _settle(composed)
            _fetch(kept)
        finally:
            for node in self._own:
                composed.executor.remove_node(node)
            composed.close()
            for subscription in list(self._listener.subscriptions):
                self._listener.destroy_subscription(subscription)
        return out

    def _listen(self, topic: str) -> Subscription:
        name = topic if topic.startswith("/") else f"/{self.namespace.strip('/')}/{topic}".replace("//", "/")
        publishers = self._listener.get_publishers_info_by_topic(name)
        if not publishers:
            known = [other for other, _ in self._listener.get_topic_names_and_types()]
            raise InputError(topic, f"no node publishes it{nearest(name, known)}")
        package, folder, kind = publishers[0].topic_type.split("/")
        message = getattr(import_module(f"{package}.{folder}"), kind)
        durability = publishers[0].qos_profile.durability  # a latched topic has its message already
        quality = QoSProfile(depth=_DEPTH, durability=durability)
        return self._listener.create_subscription(message, name, lambda _: None, quality)

    def close(self) -> None:
        """Destroy the listener and the test's own nodes."""
        for node in (self._listener, *self._own):
            node.destroy_node()


def _settle(composed: Composed) -> None:
    """Serve what nodes have received, until for a whole wait there was nothing to serve."""
    until = time.monotonic() + _PATIENCE
    began = time.monotonic()
    while began < until:
        composed.serve()
        began, before = time.monotonic(), began
        if began - before >= WAIT:
            return


def _fetch(kept: Sequence[tuple[Subscription, list[Any]]]) -> None:
    """Move what has arrived from the subscriptions to their lists; no executor waits for each message."""
    for subscription, messages in kept:
        with subscription.handle:
            while (taken := subscription.handle.take_message(subscription.msg_type, False)) is not None:
                messages.append(taken[0])


@contextmanager
def running_twin(
    twin: str | Path | Twin,
    *,
    namespace: str = "",
    parameters: Mapping[str, bool | float | str] | None = None,
) -> Iterator[RunningTwin]:
    """The four nodes of a twin in this process, in a ROS context and domain of their own.

    Parameters
    ----------
    twin : str, Path or Twin
        The twin.
    namespace : str
        Namespace of the nodes.
    parameters : mapping of str to bool, float or str, optional
        Parameters of the nodes, see ``docs/parameters.md``; ``node:name`` sets that of one node alone. No node skips a
        message that had to wait (``max_backlog``) unless it is given here.

    Returns
    -------
    context manager of RunningTwin
        ``replay`` plays a drive through the nodes.

    Raises
    ------
    InputError
        The twin file or the namespace cannot be used.

    Examples
    --------
    >>> with running_twin("bags/crg_road/twin.yaml") as nodes:
    ...     out = nodes.replay("bags/crg_road", ["twin/vertical_acceleration"])
    >>> twin = out["twin/vertical_acceleration"]
    >>> twin.t.shape == twin["accel.linear.z"].shape
    True
    """
    check_namespace(namespace)
    arguments = ["--ros-args"]
    for name, value in {"max_backlog": 3600.0, **(parameters or {})}.items():
        arguments += ["-p", f"{name}:={json.dumps(value)}"]
    isolated = {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF",
        "ROS_DOMAIN_ID": str(os.getpid() % _DOMAINS),
    }
    with tempfile.TemporaryDirectory(prefix="suspension_twin_") as folder, patch.dict(os.environ, isolated):
        if isinstance(twin, Twin):
            save_twin(twin, Path(folder) / "twin.yaml")
            twin = Path(folder) / "twin.yaml"
        load_twin(twin)
        with ros_context(arguments) as context:
            nodes = RunningTwin(context, Path(twin), namespace)
            try:
                yield nodes
            finally:
                nodes.close()
