# SPDX-License-Identifier: Apache-2.0
"""The node that feeds the page on which a person watches the twin, in a process of its own.

The page is :mod:`suspension_twin.addons.view`. The node only listens: with three pages open the other nodes publish
as they do with one.
"""

from __future__ import annotations

import contextlib
import math
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import AccelStamped, PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters
from rclpy.action.client import ActionClient
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from suspension_twin.addons.nodes.view_guide import ViewGuide
from suspension_twin.addons.nodes.view_recorder import EVENTS, RECORDED, ViewRecorder
from suspension_twin.addons.view.live import LiveView, Status, advice
from suspension_twin.addons.view.server import Server
from suspension_twin.calibration.output import details_path
from suspension_twin.errors import InputError, SuspensionTwinError, WorkError
from suspension_twin.inference.prepare import road_of
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.parameters import TWIN, Param, Values, twin_of
from suspension_twin.nodes.process import run_alone
from suspension_twin.nodes.topics import NS, OK, SENSOR_QOS, STREAM_QOS, WARN, Embedding
from suspension_twin.road.road import Road
from suspension_twin.vehicle.twin import Twin
from suspension_twin_interfaces.action import Calibrate, Diagnose
from suspension_twin_interfaces.msg import Gap
from suspension_twin_interfaces.srv import LoadTwin

__all__ = ["ViewerNode", "main"]

#: s between two looks at what was asked for on the page, and for an answer.
_TICK, _PATIENCE = 0.05, 5.0
#: A page may miss a sample; a node must never wait for it.
_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
#: Unanswered for so long in s, a node is shown as gone.
_GONE = 4.0
#: s between two looks at a first drive.
_GUIDED = 0.25
#: s between two looks at what publishers of sensors offer (tolerance: missed of a best-effort one that appears).
_MATCHED = 0.5


class ViewerNode(TwinNode):
    """Topics of a running twin in; a page on ``host`` and ``port`` out."""

    parameters = (
        TWIN,
        Param(
            "host",
            "127.0.0.1",
            "Address to listen on; others than this machine get in only with a token.",
            read_only=True,
        ),
        Param("port", 8080, "Port to listen on; 0: any free one.", 0, 65535, read_only=True),
        Param(
            "token",
            "",
            "What the address must end in (?token=...) to get in; empty: nothing.",
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
        self._recorder: ViewRecorder | None = None
        self._guide: ViewGuide | None = None
        self._recorded: list[Path] = [Path(self.values["bag"])] if self.values["bag"] else []
        self._result: Path | None = None
        self._job: Job | None = None
        self._asked: queue.Queue[Request] = queue.Queue()
        self._seen: dict[str, float] = {}
        self._motion: dict[str, Any] = {"speed": None, "level": 1, "advice": advice(math.nan, True)[1]}
        self._player_seen, self._flush_due, self._guide_due = 0.0, 0.0, 0.0
        self._player: dict[str, Any] | None = None
        self.server = Server(
            self.view,
            self._ask,
            host=self.values["host"],
            port=self.values["port"],
            token=self.values["token"],
        )
        self._load()
        self._events = self.create_publisher(String, EVENTS, 10)
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
        self._sensors: dict[str, Subscription] = {}
        self._match_due = 0.0
        for kind, topic, _ in RECORDED:
            self._listen(kind, topic, STREAM_QOS)
        self._actions = {
            "calibrate": ActionClient(self, Calibrate, "calibrate"),
            "diagnose": ActionClient(self, Diagnose, "diagnose"),
        }
        self._loader = self.create_client(LoadTwin, "suspension_model/load_twin")
        self._others = [
            self.create_client(SetParameters, f"{name}/set_parameters")
            for name in ("imu_ingest", "pose_injector", "calibrator")
        ]
        self._set_player = self.create_client(SetParameters, "bag_player/set_parameters")
        self._show_record()
        self.view.tell("job", None)
        self.view.tell("guide", None)
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
            self.server.road = _road(self._twin)
            self.view.show(self._twin)

    def destroy_node(self) -> None:
        """See the base class; an open recording is finished."""
        self.server.close()
        if self._recorder is not None:
            with contextlib.suppress(SuspensionTwinError):
                self._recorder.close()
        for client in self._actions.values():
            client.destroy()
        super().destroy_node()  # type: ignore[no-untyped-call]

    # What comes from the other nodes

    def _listen(self, kind: type, topic: str, qos: QoSProfile) -> None:
        """Subscribe to what is recorded: reliably, for nothing may be missing from it, until a best-effort publisher
        is met, which a reliable subscription does not match."""
        self._sensors[topic] = self.create_subscription(
            kind, topic, partial(self._on_sensor, topic), qos, raw=True
        )

    def _match(self) -> None:
        """Go on at best effort where a publisher offers no more."""
        for kind, topic, _ in RECORDED:
            if self._sensors[topic].qos_profile.reliability != ReliabilityPolicy.RELIABLE:
                continue
            offered = self.get_publishers_info_by_topic(topic)
            if any(p.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for p in offered):
                self.destroy_subscription(self._sensors[topic])
                self._listen(kind, topic, SENSOR_QOS)

    def _on_sensor(self, topic: str, data: bytes) -> None:
        if self._recorder is not None:
            self._recorder.add(topic, data)

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
        covariance = message.pose.covariance
        sigma = math.sqrt(max(covariance[0], covariance[7], 0.0)) if covariance[35] < 1.0 else math.nan
        level, words = advice(round(sigma, 2), self._twin is None or self._twin.road is not None)
        self._motion = {"speed": round(message.twist.twist.linear.x, 2), "level": level, "advice": words}

    def _on_gap(self, message: Gap) -> None:
        bands = zip(message.band_low_hz, message.band_high_hz, message.band_rms, strict=True)
        floor = message.rms / message.normalised if message.normalised > 0 else math.nan
        self.view.tell(
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
            if own and name == status.name and status.hardware_id == "suspension_twin":
                continue  # of another twin
            level = int.from_bytes(status.level, "little")
            values = {pair.key: pair.value for pair in status.values}
            if name == "bag_player":
                self._show_player(values)
                continue
            self._seen[name] = now
            self.view.health(Status(name, level, status.message, values))
        for name, seen in list(self._seen.items()):
            if now - seen > _GONE:
                del self._seen[name]
                self.view.health(Status(name, 3, "nothing heard of it for some seconds", {}))

    # What comes from the page

    def _ask(self, name: str, number: float | None) -> str:
        """In the server's threads: hand the request to the node's and wait for its answer."""
        request = Request(name, number)
        self._asked.put(request)
        if not request.done.wait(_PATIENCE + 1.0):
            raise WorkError(f"{name}: no answer")
        if request.error is not None:
            raise request.error
        return request.said

    def _tick(self) -> None:
        while True:
            try:
                request = self._asked.get_nowait()
            except queue.Empty:
                break
            try:
                request.said = self._do(request.name, request.number)
            except SuspensionTwinError as error:
                request.error = error
            except Exception as error:  # the page gets an answer in any case
                request.error = WorkError(f"{request.name}: {type(error).__name__}: {error}")
            request.done.set()
        now = time.monotonic()
        if now > self._match_due:
            self._match_due = now + _MATCHED
            self._match()
            self._watch_job(now)
        self.view.tell("motion", self._motion)
        if self._recorder is not None and now > self._flush_due:
            self._flush_due = now + 1.0
            try:
                self._recorder.flush()
            except Exception as error:
                self.note("recording failed", WARN, f"recording: {error}")
            self._show_record()
        if self._guide is not None and now > self._guide_due:
            self._guide_due = now + _GUIDED
            self._lead_drive(self._guide)
        self._watch_player()
        parent = self.values["parent"]
        if parent and os.getppid() != parent:
            raise KeyboardInterrupt  # as a signal would end it

    def _do(self, name: str, number: float | None) -> str:
        if name == "record":
            return self._record()
        if name == "stop":
            return self._stop()
        if name == "mark":
            return self._mark()
        if name == "guide":
            return self._start_guide()
        if name == "calibrate":
            return self._calibrate()
        if name == "diagnose":
            return self._diagnose_drives()
        if name == "cancel":
            return self._cancel()
        if name == "load":
            return self._load_result()
        value = {
            "pause": ("paused", True),
            "play": ("paused", False),
            "seek": ("seek", number),
            "speed": ("rate", number),
        }
        return self._lead_player(*value[name], go_on=name in ("seek", "play"))

    def _record(self) -> str:
        if self._recorder is not None:
            raise InputError("record", "is running already")
        path = _free(Path(self.values["folder"]) / time.strftime("drive_%Y%m%d_%H%M%S"))
        self._recorder = ViewRecorder(path)
        self._show_record()
        return f"Recording into {path}"

    # The first drive

    def _start_guide(self) -> str:
        """Begin a first drive, or end the one that is under way."""
        if self._guide is not None:
            self._end_guide()
            return self._stop() if self._recorder is not None else ""
        if self._twin is None:
            raise InputError("twin", "is not known to the page: start it with the parameter twin")
        if not self._actions["calibrate"].server_is_ready():
            raise WorkError("first drive: the node calibrator is not there")
        if self._job is not None and self._job.running:
            raise InputError("first drive", "a calibration or diagnosis is running")
        guide = ViewGuide(self, self._twin)
        if self._recorder is None:
            self._record()
        self._guide = guide
        self._show_guide(guide)
        return "Stand still, with the engine as it is when driving"

    def _lead_drive(self, guide: ViewGuide) -> None:
        """Show how far the drive is, and calibrate when it is done."""
        if guide.calibration:
            return
        try:
            guide.take()
            if guide.drive.done:
                guide.close()
                self._stop_recording()
                self._calibrate()
                guide.calibration = "calibrating"
            self._show_guide(guide)
        except SuspensionTwinError as error:
            self._end_guide()
            with contextlib.suppress(SuspensionTwinError):
                self._stop_recording()
            self.view.tell("guide", [{"title": "First drive", "state": "failed", "text": str(error)}])

    def _show_guide(self, guide: ViewGuide) -> None:
        self.view.tell("guide", guide.shown())

    def _end_guide(self) -> None:
        if self._guide is not None:
            self._guide.close()
            self._guide = None
            self.view.tell("guide", None)

    def _guided_result(self, guide: ViewGuide, job: Job, done: bool, message: str) -> None:
        """The last step: the gap before and after, and the calibrated twin takes over."""
        guide.calibration, guide.calibrated = message, done
        if done:
            guide.calibration = _gap_of(job.output) or message
            with contextlib.suppress(SuspensionTwinError):
                self._load_result()
        self._show_guide(guide)

    def _stop(self) -> str:
        if self._guide is not None and not self._guide.calibration:
            self._end_guide()
        return self._stop_recording()

    def _stop_recording(self) -> str:
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            raise InputError("stop", "nothing is being recorded")
        try:
            recorder.close()
        finally:
            self._show_record()
        self._recorded = [recorder.path]
        return f"Recorded {recorder.seconds:.0f} s into {recorder.path}: {_counted(recorder.counts)}"

    def _show_record(self) -> None:
        recorder = self._recorder
        on = recorder is not None
        seconds = round(recorder.seconds, 1) if recorder else 0.0
        self.view.tell(
            "record", {"on": on, "seconds": seconds, "path": str(recorder.path) if recorder else ""}
        )

    def _mark(self) -> str:
        text = time.strftime("mark %H:%M:%S")
        self.view.mark(text)
        self._events.publish(String(data=text))
        if self._recorder is not None:
            self._recorder.mark(text)
        return "Marked" + (" and recorded" if self._recorder is not None else "")

    def _drives(self) -> list[str]:
        if self._recorder is not None:
            raise InputError("record", "is still running: stop it first")
        if not self._recorded:
            raise InputError("calibrate", "nothing was recorded yet: record a drive first")
        return [str(path.resolve()) for path in self._recorded]

    def _calibrate(self) -> str:
        bags = self._drives()
        folder = Path(self.values["folder"])
        output = _free(folder / f"{Path(bags[0]).name}_calibrated.yaml").resolve()
        goal = Calibrate.Goal(twin=str(self._own_twin()), bags=bags, output=str(output), preset="fast")
        self._begin("calibrate", goal, output)
        return f"Calibrating on {Path(bags[0]).name}"

    def _diagnose_drives(self) -> str:
        bags = self._drives()
        output = _free(Path(self.values["folder"]) / f"{Path(bags[0]).name}_diagnosis").resolve()
        self._begin(
            "diagnose", Diagnose.Goal(twin=str(self._own_twin()), bags=bags, output=str(output)), output
        )
        return f"Diagnosing {Path(bags[0]).name}"

    def _own_twin(self) -> Path:
        if not self.values["twin"]:
            raise InputError("twin", "is not known to the page: start it with the parameter twin")
        return Path(self.values["twin"]).resolve()

    def _begin(self, name: str, goal: Any, output: Path) -> None:
        if self._job is not None and self._job.running:
            raise InputError(name, "a calibration or diagnosis is running already")
        client = self._actions[name]
        if not client.server_is_ready():
            raise WorkError(f"{name}: the node calibrator is not there")
        self._job = job = Job(name, output)
        self._show_job(f"{name}: starting")
        sent = client.send_goal_async(goal, feedback_callback=partial(self._on_feedback, job))
        sent.add_done_callback(partial(self._on_accepted, job))

    def _on_feedback(self, job: Job, message: Any) -> None:
        feedback = message.feedback
        left = feedback.seconds_left
        rest = f", about {left:.0f} s left" if math.isfinite(left) else ""
        elapsed = time.monotonic() - job.began
        job.progress = elapsed / (elapsed + left) if math.isfinite(left) and elapsed + left > 0 else None
        cost = getattr(feedback, "best_cost", math.nan)
        so_far = f", best cost {cost:.4g}" if math.isfinite(cost) and cost > 0 else ""
        self._show_job(f"{job.name}: {feedback.stage}{so_far}{rest}")

    def _cancel(self) -> str:
        """A cancelled calibration hands over its best so far, a diagnosis nothing."""
        job = self._job
        if job is None or not job.running or job.handle is None:
            raise InputError("cancel", "nothing is running that could be cancelled")
        job.handle.cancel_goal_async()
        return f"Cancelling: {job.name}"

    def _watch_job(self, now: float) -> None:
        """Give up a goal whose node is gone, or that is not answered: the middleware loses an answer to a client it has
        not found yet. A late answer is taken up."""
        job = self._job
        if job is None or not job.running:
            return
        if not self._actions[job.name].server_is_ready():
            self._end_job(job, False, "the node calibrator ended before the result was there")
        elif job.handle is None and now - job.began > _PATIENCE:
            self._end_job(job, False, "the node calibrator did not answer")

    def _on_accepted(self, job: Job, future: Any) -> None:
        handle = future.result()
        if handle is None or not handle.accepted:
            self._end_job(job, False, "the node calibrator refused, another goal is running")
            return
        job.handle, job.running = handle, True
        handle.get_result_async().add_done_callback(partial(self._on_result, job))

    def _on_result(self, job: Job, future: Any) -> None:
        answer = future.result()
        done = bool(answer.result.success)  # also of a cancelled calibration, with its best so far
        if done:
            self._result = job.output / "twin.yaml" if job.name == "diagnose" else job.output
            if job.name == "diagnose":
                self.server.report = job.output
                job.report = True
        self._end_job(job, done, answer.result.message)

    def _end_job(self, job: Job, done: bool, message: str) -> None:
        """Say on the page and in the health what became of a goal."""
        job.running = False
        self.note(f"goals of {job.name}", OK if done else WARN, f"{job.name}: {message}")
        self._show_job(f"{job.name}: {message}")
        if self._guide is not None and self._guide.calibration and job.name == "calibrate":
            self._guided_result(self._guide, job, done, message)

    def _show_job(self, text: str) -> None:
        job = self._job
        if job is not None:
            found = self._result is not None and self._result.exists()
            shown = {"text": text, "running": job.running, "progress": job.progress, "report": job.report}
            self.view.tell("job", shown | {"result": found and not job.running})

    def _load_result(self) -> str:
        path = self._result
        if path is None or not path.exists():
            raise InputError("load", "there is no result yet: calibrate or diagnose first")
        if not self._loader.service_is_ready():
            raise WorkError("load: the node suspension_model is not there")
        future = self._loader.call_async(LoadTwin.Request(path=str(path)))
        future.add_done_callback(partial(self._on_loaded, path))
        return f"Loading {path.name}"

    def _on_loaded(self, path: Path, future: Any) -> None:
        answer = future.result()
        if not answer.success:
            self._show_job(f"load: {answer.message}")
            return
        # the sensor's place and clock offset are the other nodes' concern, too
        value = Parameter("twin", value=str(path)).to_parameter_msg()
        for client in self._others:
            if client.service_is_ready():
                client.call_async(SetParameters.Request(parameters=[value]))
        self.set_parameters([Parameter("twin", value=str(path))])
        others = all(client.service_is_ready() for client in self._others)
        self._show_job(answer.message.partition(";")[0] if others else answer.message)

    # The player of a bag

    def _show_player(self, values: dict[str, str]) -> None:
        self._player_seen = time.monotonic()
        rate = float(values["rate"])
        self.view.count_from(int(values["start (ns)"]))
        self._player = {
            "duration": float(values["duration"]),
            "position": round(float(values["position"]), 1),
            "rate": rate if math.isfinite(rate) else None,
            "paused": values["paused"] == "True",
            "ended": values["ended"] == "True",
        }
        self.view.tell("player", self._player)

    def _watch_player(self) -> None:
        if self._player is not None and time.monotonic() - self._player_seen > _GONE:
            self._player = None
            self.view.tell("player", None)

    def _lead_player(self, name: str, value: Any, go_on: bool) -> str:
        if self._player is None or not self._set_player.service_is_ready():
            raise InputError("player", "no recording is being replayed")
        if name == "seek":
            value = min(max(float(value), 0.0), self._player["duration"])
        elif name == "rate" and not 0.01 <= value <= 100.0:
            raise InputError("speed", "must be from 0.01 to 100 times real time")
        given = [Parameter(name, value=value)]
        if go_on and name == "seek":
            given.append(Parameter("paused", value=False))
        wanted = [p.to_parameter_msg() for p in given]
        self._set_player.call_async(SetParameters.Request(parameters=wanted))
        if name == "seek":
            self.view.clear()
        return ""

    def report(self) -> None:
        """See the base class."""
        self.health.values["address"] = self.server.url.partition("?")[0]


class Request:
    """One thing asked for on the page, and its answer."""

    def __init__(self, name: str, number: float | None) -> None:
        self.name, self.number = name, number
        self.done = threading.Event()
        self.said = ""
        self.error: SuspensionTwinError | None = None


class Job:
    """A calibration or diagnosis asked for on the page."""

    def __init__(self, name: str, output: Path) -> None:
        self.name, self.output = name, output
        self.running = True
        self.handle: Any = None
        self.report = False
        self.progress: float | None = None
        self.began = time.monotonic()


def _ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * NS + stamp.nanosec)


def _road(twin: Twin) -> Road | None:
    return None if twin.road is None else road_of(twin)


def _names(path: Path) -> Iterator[Path]:
    yield path
    for number in range(2, 1000):
        yield path.with_name(f"{path.stem}_{number}{path.suffix}")


def _free(path: Path) -> Path:
    """The path, or one with a number that nothing has yet."""
    return next(name for name in _names(path) if not name.exists())


def _gap_of(twin: Path) -> str:
    """The gap of the first drive before and after a calibration, from the file beside its result; empty without."""
    import yaml

    try:
        drive = yaml.safe_load(details_path(twin).read_text(encoding="utf-8"))["drives"][0]
        before, after = (float(drive[name]["rms"]) for name in ("gap_before", "gap_after"))
    except (OSError, ValueError, KeyError, IndexError, TypeError, yaml.YAMLError):
        return ""
    return f"gap {before:.3f} m/s² before, {after:.3f} after; the twin is {twin}"


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} on {topic}" for topic, count in counts.items() if count)


# many topics at many times the rate of a drive that is replayed quickly
main: Callable[..., Any] = partial(run_alone, ViewerNode, events=True)

if __name__ == "__main__":
    sys.exit(main())
