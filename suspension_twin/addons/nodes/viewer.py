# SPDX-License-Identifier: Apache-2.0
"""The node that feeds the page on which a person watches the twin, in a process of its own.

The page is :mod:`suspension_twin.addons.view`. The node only listens: with three pages open the other nodes publish
as they do with one. The buttons lead a recorder, a first drive, jobs of the calibrator and the player of a bag.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Set as AbstractSet
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import AccelStamped, PoseStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from suspension_twin.addons.nodes.view_actions import ViewGuide, ViewJob, ViewJobs, ViewPlayer
from suspension_twin.addons.nodes.view_recorder import ViewRecorder
from suspension_twin.addons.view.live import LiveView, NodeStatus, advice
from suspension_twin.addons.view.server import TOKEN_VARIABLE, Requests, Server
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.inference.observation import road_of
from suspension_twin.nodes.base import HARDWARE, TwinNode
from suspension_twin.nodes.messages import read_odometry
from suspension_twin.nodes.parameters import FOLDERS, TWIN, Param, Values, twin_of
from suspension_twin.nodes.suspension_model import WHOLE_GAP
from suspension_twin.nodes.topics import NS, Embedding
from suspension_twin.vehicle.twin import Twin
from suspension_twin_interfaces.msg import Gap

__all__ = ["ViewerNode"]

#: s between two looks at the buttons of the page.
_TICK = 0.05
#: A page may miss a sample; a node must never wait for it. The queue holds 10 s of 400 samples a second: a page that
#: gets too little of the processor shows late what it got, rather than curves with holes (tolerance, by hand).
_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=4000, reliability=ReliabilityPolicy.BEST_EFFORT)
#: Unanswered for so long in s, a node is shown as gone.
_GONE = 4.0
#: s between two looks at what publishers of sensors offer (tolerance: missed of a best-effort one that appears).
_MATCHED = 0.5


class ViewerNode(TwinNode):
    """Topics of a running twin in; a page on ``host`` and ``port`` out."""

    events = True  # many topics, at many times the rate of a drive that is replayed quickly
    parameters = (
        TWIN,
        FOLDERS,
        Param(
            "host",
            "127.0.0.1",
            "Address to listen on.",
            read_only=True,
        ),
        Param("port", 8080, "Port to listen on; 0: any free one.", 0, 65535, read_only=True),
        Param(
            "token",
            "",
            "What the address must end in (?token=...) to get in; empty: a new one for each start, which is printed.",
            read_only=True,
        ),
        Param("folder", ".", "Folder for recordings, calibrated twins and diagnoses.", read_only=True),
        Param(
            "bag",
            "",
            "Recording that is being replayed, for a calibration before anything was recorded.",
            read_only=True,
        ),
        Param("parent", 0, "Process whose end ends this one; 0: none.", 0, 2**31 - 1, read_only=True),
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        super().__init__("viewer", embedding)
        self.view = LiveView()
        self._twin: Twin | None = None
        self._seen: dict[str, float] = {}
        self._motion: dict[str, object] = {"speed": None, "level": 1, "advice": advice(math.nan, True)[1]}
        self._match_due = 0.0
        self._requests = Requests(self._answer)
        self.server = Server(
            self.view,
            self._requests.ask,
            host=self.values["host"],
            port=self.values["port"],
            token=self.values["token"] or os.environ.get(TOKEN_VARIABLE, ""),
        )
        self._load()
        self.recorder = ViewRecorder(self, self.view)
        self.jobs = ViewJobs(self, self.view, self.recorder, self._on_job_end)
        self.guide = ViewGuide(self, self.view, self.recorder, self.jobs)
        self.player = ViewPlayer(self, self.view)
        for kind, topic, handler in (
            (PoseStamped, "twin/pose", self._on_pose),
            (JointState, "joint_states", self._on_joints),
            (AccelStamped, "imu/vertical_acceleration", self._on_measured),
            (AccelStamped, "twin/vertical_acceleration", self._on_simulated),
            (Odometry, "twin/odom", self._on_odometry),
            (Gap, "twin/gap", self._on_gap),
            (DiagnosticArray, "/diagnostics", self._on_diagnostics),
        ):
            self.create_subscription(kind, topic, handler, _QOS)
        self.create_timer(_TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        print(f"Watch on {self.server.url}", file=sys.stderr, flush=True)

    def check(self, values: Values) -> None:
        """See the base class."""
        twin_of(values)
        if not Path(values["folder"]).is_dir():
            raise InputError("viewer", "folder", f"{values['folder']} is no folder")

    def changed(self, names: AbstractSet[str]) -> None:
        """See the base class: another twin is drawn."""
        if "twin" in names:
            self._load()

    def _load(self) -> None:
        self._twin = twin_of(self.values)
        if self._twin is not None:
            self.server.road = None if self._twin.road is None else road_of(self._twin)
            self.view.show(self._twin)

    def destroy_node(self) -> None:
        """See the base class; an open recording is finished."""
        self.server.close()
        if self.recorder.bag is not None:
            with suppress(SuspensionTwinError):
                self.recorder.bag.close()
        self.jobs.close()
        super().destroy_node()  # type: ignore[no-untyped-call]

    # Topics of the other nodes

    def _on_pose(self, message: PoseStamped) -> None:
        p, q = message.pose.position, message.pose.orientation
        self.view.pose(_ns(message), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))

    def _on_joints(self, message: JointState) -> None:
        self.view.joints(_ns(message), message.position)

    def _on_measured(self, message: AccelStamped) -> None:
        self.view.measured(_ns(message), message.accel.linear.z)

    def _on_simulated(self, message: AccelStamped) -> None:
        self.view.simulated(_ns(message), message.accel.linear.z)

    def _on_odometry(self, message: Odometry) -> None:
        try:
            pose = read_odometry(message, 0.0)
        except InputError:  # a value out of range
            return
        sigma = math.sqrt(max(pose.covariance[0], pose.covariance[3], 0.0)) if pose.aligned else math.nan
        level, words = advice(round(sigma, 2), self._twin is None or self._twin.road is not None)
        self._motion = {"speed": round(pose.motion.speed, 2), "level": level, "advice": words}

    def _on_gap(self, message: Gap) -> None:
        bands = zip(message.band_low_hz, message.band_high_hz, message.band_rms, strict=True)
        floor = message.rms / message.normalised if message.normalised > 0 else math.nan
        self.view.update(
            "gap",
            {
                "rms": message.rms,
                "measured": message.measured_rms,
                "normalised": message.normalised,
                "floor": floor,
                "calibrated": floor != message.noise_rms and abs(floor - message.noise_rms) > 1e-9,
                "window": message.window,
                "bands": [list(band) for band in bands],
            },
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        own = self.get_namespace().strip("/")
        for status in message.status:
            name = status.name.removeprefix(f"{own}/") if own else status.name
            if own and name == status.name and status.hardware_id.startswith(HARDWARE):
                continue  # of another twin
            level = int.from_bytes(status.level, "little")
            values = {pair.key: pair.value for pair in status.values}
            if name == "bag_player":
                self.player.show(values)
                continue
            if WHOLE_GAP in values:
                self.view.update("driven", float(values[WHOLE_GAP]))
            self._seen[name] = now
            self.view.health(NodeStatus(name, level, status.message, values))
        for name, seen in list(self._seen.items()):
            if now - seen > _GONE:
                del self._seen[name]
                self.view.health(NodeStatus(name, 3, "nothing heard of it for some seconds", {}))

    # The page

    def _answer(self, name: str, number: float | None) -> str:
        """A button of the page; the answer is shown to who pressed it."""
        answers: dict[str, Callable[[], str]] = {
            "record": self.recorder.start,
            "stop": self._stop,
            "mark": self.recorder.mark,
            "guide": self._toggle_guide,
            "calibrate": self.jobs.calibrate,
            "diagnose": self.jobs.diagnose,
            "cancel": self.jobs.cancel,
            "load": self.jobs.load,
            "pause": partial(self.player.set, paused=True),
            "play": partial(self.player.set, paused=False),
            "seek": partial(self.player.seek, number),
            "speed": partial(self.player.speed, number),
        }
        return answers[name]()

    def _toggle_guide(self) -> str:
        """Begin a first drive, or end the one that is under way."""
        if not self.guide.active:
            return self.guide.start(self._twin)
        self.guide.end()
        return self.recorder.stop() if self.recorder.bag is not None else ""

    def _stop(self) -> str:
        self.guide.end(driving=True)
        return self.recorder.stop()

    def _on_job_end(self, job: ViewJob, done: bool, message: str) -> None:
        if job.report:
            self.server.report = job.output
        self.guide.job_ended(job, done, message)

    def _tick(self) -> None:
        self._requests.serve()
        now = time.monotonic()
        if now > self._match_due:
            self._match_due = now + _MATCHED
            self.recorder.match()
            self.jobs.watch(now)
        self.view.update("motion", self._motion)
        self.recorder.flush(now)
        self.guide.lead(now)
        if self.server.watched:
            self.player.begin()
        self.player.forget(now - _GONE)
        parent = self.values["parent"]
        if parent and os.getppid() != parent:
            raise KeyboardInterrupt  # as a signal would end it

    def report(self) -> None:
        """See the base class."""
        self.health.values["address"] = self.server.url.partition("?")[0]


def _ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * NS + stamp.nanosec)


if __name__ == "__main__":
    sys.exit(ViewerNode.main())
