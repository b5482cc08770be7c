# SPDX-License-Identifier: Apache-2.0
"""The node that learns the road as the vehicle drives: a second pass over the same place has a twin.

The sensors' samples are kept and cut into passes where the vehicle comes back to where it was. After
each pass the road is estimated in a worker process; what comes out is written and loaded into
``suspension_model``.
"""

from __future__ import annotations

import math
import tempfile
import time
from array import array
from collections.abc import Callable, Set as AbstractSet
from pathlib import Path
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import QuaternionStamped, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.task import Future
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.addons.roads.drives.learning import (
    Laps,
    Lesson,
    Span,
    learn_road,
    read_lesson,
    twin_path,
    write_lesson,
)
from suspension_twin.drive.checks import clean_drive
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.files import check_writable
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.jobs import Job, Outcome, Worker
from suspension_twin.nodes.messages import read_fix, read_odometry, read_velocity, yaw_of
from suspension_twin.nodes.parameters import FOLDERS, TWIN, Param, Values, twin_of
from suspension_twin.nodes.topics import OK, WARN, Embedding
from suspension_twin_interfaces.srv import LoadTwin

__all__ = ["RoadLearnerNode", "run_lesson"]

#: Period in s at which the worker's messages are read.
_TICK = 0.1
#: Passes that a road is learnt from, the newest: one more takes as long as the first and adds less.
_MOST = 4
#: Samples of a receiver that are joined at a time; of an IMU that a record holds, 56 MB.
_JOINED, _HELD = 500, 1_000_000


def run_lesson(job: Job, on_progress: Callable[[tuple[str, float | None]], None], _stop: object) -> Outcome:
    """Learn the road in this process; the request is the path of a lesson."""
    return learn_road(read_lesson(Path(job.request)), lambda text, share: on_progress((text, share)))


class _Record:
    """The samples of a drive so far."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._imu = array("d")
        self._fix: list[FixData] = []
        self._velocity: list[VelocityData] = []
        self._heading = array("d")

    @property
    def full(self) -> bool:
        return len(self._imu) >= 7 * _HELD

    def imu(self, t: float, message: Imu) -> None:
        a, w = message.linear_acceleration, message.angular_velocity
        self._imu.extend((t, a.x, a.y, a.z, w.x, w.y, w.z))

    def fix(self, message: NavSatFix) -> None:
        self._fix.append(read_fix([message]))
        if len(self._fix) > _JOINED:
            self._fix = [FixData.joined(self._fix)]

    def velocity(self, message: TwistStamped) -> None:
        self._velocity.append(read_velocity([message]))
        if len(self._velocity) > _JOINED:
            self._velocity = [VelocityData.joined(self._velocity)]

    def heading(self, t: float, yaw: float) -> None:
        self._heading.extend((t, yaw))

    def drive(self) -> Drive:
        """The samples so far as a recorded drive."""
        rows = np.array(self._imu, dtype=np.float64).reshape(-1, 7)
        headings = np.array(self._heading, dtype=np.float64).reshape(-1, 2)
        drive = Drive(
            self.name,
            ImuData(rows[:, 0].copy(), rows[:, 1:4].copy(), rows[:, 4:].copy()),
            FixData.joined(self._fix) if self._fix else FixData.empty(),
            VelocityData.joined(self._velocity) if self._velocity else VelocityData.empty(),
            HeadingData(headings[:, 0], headings[:, 1]) if headings.size else None,
        )
        return clean_drive(drive)


class _Kept(NamedTuple):
    """A pass and the record that it lies in."""

    record: _Record
    span: Span


class RoadLearnerNode(TwinNode):
    """Sensors and poses in; a road file, and the twin on it in ``suspension_model``."""

    parameters = (
        TWIN,
        FOLDERS,
        Param("out", "", "OpenCRG file that the learnt road is written to, again after each pass.", read_only=True),
    )  # fmt: skip

    def __init__(self, embedding: Embedding | None = None, work: Callable[..., Outcome] = run_lesson) -> None:
        super().__init__("road_learner", embedding)
        #: What the worker process does with a lesson, and what makes the process.
        self.work, self.worker = work, Worker
        self._out = Path(self.values["out"])
        self._twin_file = self.values["twin"]
        self._laps = Laps()
        self._record = _Record("drive 1")
        self._records = 1
        self._passes: list[_Kept] = []
        self._waiting = False
        self._worker: Worker | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="suspension_twin_")
        self._started = 0.0
        self._step = ""
        self._taught: Outcome | None = None
        self._news: Outcome | None = None  # what is to be loaded
        #: Why there is no road, or why not that of all passes.
        self.why = "no pass was long enough"
        self.listen(Imu, "imu/data_raw", self._on_imu)
        self.listen(NavSatFix, "fix", lambda message, _: self._record.fix(message))
        self.listen(TwistStamped, "vel", lambda message, _: self._record.velocity(message))
        self.listen(QuaternionStamped, "heading", self._on_heading, expected=False)
        self.listen(Odometry, "twin/odom", self._on_odom)
        self._loader = self.create_client(LoadTwin, "suspension_model/load_twin")
        self._asker = self.create_client(GetParameters, "suspension_model/get_parameters")
        self._asked: Future | None = None
        self.create_timer(_TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def check(self, values: Values) -> None:
        """See the base class."""
        if not values["out"]:
            raise InputError("road_learner", "out", "is empty: give the path of the road to write")
        if Path(values["out"]).suffix.lower() != ".crg":
            raise InputError(values["out"], "a road is written as .crg; name the file so")
        check_writable(values["out"])
        twin = twin_of(values)
        if twin is not None and "front" not in twin.axles:
            raise InputError(
                "twin", "model", f"a road is learnt with the axles of a car, {twin.model} has none"
            )

    def changed(self, names: AbstractSet[str]) -> None:
        """See the base class."""
        if "twin" in names:
            self._twin_file = self.values["twin"]

    def destroy_node(self) -> None:
        """See the base class; a running estimate is ended."""
        if self._worker is not None:
            self._worker.kill()
            self._worker = None
        self._folder.cleanup()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def reset(self) -> None:
        """See the base class: another drive begins, since the clock has jumped back or the record is full."""
        self.close_pass()
        self._records += 1
        self._record = _Record(f"drive {self._records}")

    # What the sensors say

    def _on_imu(self, message: Imu, ns: int) -> None:
        if self._record.full:
            self.reset()
        self._record.imu(ns / 1e9, message)

    def _on_heading(self, message: QuaternionStamped, ns: int) -> None:
        self._record.heading(ns / 1e9, yaw_of(message.quaternion))

    def _on_odom(self, message: Odometry, ns: int) -> None:
        pose = read_odometry(message, ns / 1e9)
        sigma = math.sqrt(max(pose.covariance[0], 0.0))
        if pose.aligned and math.isfinite(sigma):
            self._take(self._laps.push(pose.t, pose.x, pose.y, pose.yaw, pose.motion.speed, sigma))

    def close_pass(self) -> None:
        """The present pass ends here; nothing where it is too short."""
        self._take(self._laps.close())

    def _take(self, span: Span | None) -> None:
        if span is None:
            return
        self._passes = [*self._passes, _Kept(self._record, span)][-_MOST:]
        self._waiting = True

    # The worker

    @property
    def pending(self) -> bool:
        """Whether there is a pass that the road does not have in it yet."""
        return self._waiting or self._worker is not None or self._news is not None

    def _tick(self) -> None:
        if self._worker is not None:
            self._follow(self._worker)
        elif self._asked is None and (self._waiting or self._news is not None):
            self._ask()

    def _ask(self) -> None:
        """Which twin the model has: another one may have been loaded since."""
        if not self._asker.service_is_ready():
            self._go_on("")
            return
        self._asked = self._asker.call_async(GetParameters.Request(names=["twin"]))
        self._asked.add_done_callback(self._on_answer)

    def _on_answer(self, future: Future) -> None:
        self._asked = None
        values = future.result().values if future.exception() is None else []
        self._go_on(values[0].string_value if values else "")

    def _go_on(self, path: str) -> None:
        """Load what was learnt, or begin; ``path`` is that of the model's twin, empty if it is not known."""
        other = bool(path) and Path(path).absolute() not in (
            twin_path(self._out).absolute(),
            Path(self._twin_file).absolute(),
        )
        if other:
            self._twin_file = path
        news, self._news = self._news, None
        if news is not None and not other:
            self._load(news["twin"])
        elif news is not None:
            self._waiting = True
            self.note(
                "roads learnt anew", OK, f"{path} was loaded meanwhile: the road is learnt anew with it"
            )
        elif self._worker is None and self._waiting:
            self._begin()

    def _begin(self) -> None:
        self._waiting = False
        if not self._twin_file:
            self.why = "no twin is loaded"
            self.note("roads not learnt", WARN, f"the road could not be learnt: {self.why}")
            return
        records = list(dict.fromkeys(kept.record for kept in self._passes))
        passes = tuple((records.index(kept.record), kept.span.start, kept.span.end) for kept in self._passes)
        drives = tuple(record.drive() for record in records)
        lesson = Lesson(self._twin_file, str(self._out), drives, passes, self._datum(drives[-1]))
        # By a file: through the pipe of a new process, megabytes would wait for it to start.
        temporary = Path(self._folder.name) / "lesson.npz"
        try:
            write_lesson(lesson, temporary)
        except SuspensionTwinError as error:
            self.why = str(error)
            self.note("roads not learnt", WARN, f"the road could not be learnt: {self.why}")
            return
        self._worker = self.worker(self.work, Job(str(temporary), str(self._out)))
        self._started, self._step = time.monotonic(), "starting"

    def _datum(self, drive: Drive) -> tuple[float, float, float] | None:
        """The first usable fix, which the poses count from if the twin file has no datum."""
        fix = drive.fix
        good = np.flatnonzero((fix.status >= 0) & np.isfinite(fix.latitude) & np.isfinite(fix.longitude))
        if not good.size:
            return None
        i = int(good[0])
        altitude = float(fix.altitude[i])
        return float(fix.latitude[i]), float(fix.longitude[i]), altitude if math.isfinite(altitude) else 0.0

    def _follow(self, worker: Worker) -> None:
        for news in worker.news():
            if news.kind == "progress":
                self._step = news.content[0]
                continue
            self._worker = None
            worker.kill()
            if news.kind == "failed":
                self.why = news.content.text
                self.note("roads not learnt", WARN, f"the road could not be learnt: {self.why}")
                if news.content.whole:
                    self.own_log.warning(news.content.whole)
                return
            self._taught = news.content
            self.say(OK, f"road learnt: {self._known()}, written to {self._out}")
            for warning in news.content["warnings"]:
                self.note("roads learnt with a warning", OK, warning)
            self._news = news.content
            return

    def _load(self, path: str) -> None:
        if not self._loader.service_is_ready():
            self.note("roads not loaded", WARN, "no suspension_model is there to load the learnt road")
            return
        self._loader.call_async(LoadTwin.Request(path=path)).add_done_callback(self._on_loaded)

    def _on_loaded(self, future: Future) -> None:
        error = future.exception()
        if error is None and future.result().success:
            return
        why = str(error) if error is not None else future.result().message
        self.note("roads not loaded", WARN, f"the learnt road was not loaded: {why}")

    # What it says of itself

    @property
    def learnt(self) -> bool:
        """Whether there is a road."""
        return self._taught is not None

    def summary(self) -> str:
        """The road that was written, in a line."""
        return f"road: {self._known()}, written to {self._out}; the twin on it: {twin_path(self._out)}"

    def _known(self) -> str:
        if self._taught is None:
            return "nothing yet"
        count = self._taught["passes"]
        return f"{self._taught['length']:.0f} m from {count} pass{'' if count == 1 else 'es'}"

    def condition(self) -> str:
        """In a few words: what is known of the road, and what is being done."""
        if self._worker is not None:
            doing = f"{self._step}, {time.monotonic() - self._started:.0f} s"
        else:
            doing = f"pass now {self._laps.length:.0f} m"
        return f"road: {self._known()} | {doing}"

    def report(self) -> None:
        """See the base class."""
        values = self.health.values
        values["road"] = self._known()
        values["passes kept"] = str(len(self._passes))
        values["present pass (m)"] = f"{self._laps.length:.0f}"
        values["state"] = self._step if self._worker is not None else "collecting"
