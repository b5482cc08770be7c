# SPDX-License-Identifier: Apache-2.0
"""The node that simulates the twin: ``twin/odom`` over the road to the twin's motion, signals and gap.

The vehicle model is :class:`~suspension_twin.models.live.LiveTwin`.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import AccelStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from suspension_twin.errors import InputError
from suspension_twin.live.follow import BodyAcceleration, Follower, FollowSettings, Pairing
from suspension_twin.live.gap import GapNow, calibration_gap
from suspension_twin.live.twin import Update, compile_stages, delay_of
from suspension_twin.nodes.lifecycle import ManagedNode
from suspension_twin.nodes.messages import read_odometry
from suspension_twin.nodes.parameters import (
    FILTER,
    FOLDERS,
    LOW_PASS,
    TWIN,
    NamedTwin,
    Param,
    Values,
    filter_of,
    low_pass_text,
    named_twin,
    twin_of,
)
from suspension_twin.nodes.topics import ERROR, OK, STALE, WARN, Embedding
from suspension_twin.nodes.twin_outputs import TwinOutputs
from suspension_twin.pose.lock import PlanarState
from suspension_twin.vehicle.twin import Twin
from suspension_twin_interfaces.srv import LoadTwin

__all__ = ["WHOLE_GAP", "SuspensionModelNode"]

#: Key of the gap over all driving in the diagnostics.
WHOLE_GAP = "live gap over all driving, rms (m/s²)"

NO_TWIN = "no twin loaded: set the parameter twin or call ~/load_twin"
#: The nodes whose low-pass has to be that of this one.
FILTERING = ("imu_ingest", "pose_injector")
#: Samples over which their age is averaged.
_AGES = 50
#: Times the noise at standstill below which the gap says nothing of the suspension.
_EXCITED = 3.0
_HARDEST = 1e5  # m/s², more than any vehicle's body
GAP = (
    Param("gap.window", 10.0, "Sliding window of the live gap in s.", 0.5, 600.0),
    Param("gap.rate", 5.0, "Messages per second on twin/gap.", 0.1, 100.0),
    Param(
        "gap.floor",
        0.0,
        "Residual of the calibration in m/s², reference of the normalised gap; 0: from the details beside a "
        "calibrated twin file, else the noise at standstill.",
        0.0,
        100.0,
    ),
    Param(
        "gap.warn",
        5.0,
        "Ratio of the gap to the residual of the calibration from which there is a warning. Position errors of a few "
        "centimetres alone make it two or three.",
        1.0,
        1000.0,
    ),
    Param(
        "gap.bands",
        [0.5, 3.0, 8.0, 20.0],
        "Edges in Hz of the adjoining frequency bands of the live gap.",
        0.0,
        800.0,
    ),
)


class SuspensionModelNode(ManagedNode):
    """``twin/odom`` and ``imu/vertical_acceleration`` in; the twin's motion, signals and gap out."""

    parameters = (
        TWIN,
        FOLDERS,
        *FILTER,
        Param("map_frame", "map", "Frame of twin/odom.", read_only=True),
        Param("base_frame", "base_link", "Frame of the vehicle's body.", read_only=True),
        Param(
            "visual_rate",
            60.0,
            "Largest rate in Hz of twin/pose, joint_states and /tf, evenly spaced; up to it there is one message per "
            "sample. 2000: every sample, for a recording.",
            0.1,
            2000.0,
        ),
        Param(
            "acceleration_time",
            0.1,
            "Time constant in s of the planar acceleration, the low-passed derivative of the speeds in twin/odom; "
            "above 0.4 Hz it is the IMU's. A pose_injector in the same process gives the accelerations itself.",
            0.0,
            2.0,
        ),
        *GAP,
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        #: That of the present values, and that of the twin which a service has named last.
        self._prepared: Follower | None = None
        self._named: Follower | None = None
        self._programs: tuple[Path, ...] | None = None  # any, while the node is started
        super().__init__("suspension_model", embedding)
        named = _named(self.values)
        program = None if named is None else named.program
        self._programs = () if program is None else (program,)
        compile_stages()
        self._pairing = Pairing()
        #: Mean age in ns of the samples by their stamps, when they have been answered.
        self._age = 0.0
        self._out = TwinOutputs(self, self.values["map_frame"], self.values["base_frame"])
        self._follower: Follower | None = None
        self._out.configure(None, self.values["visual_rate"], self.values["gap.rate"])
        if self.active:
            self.start()
        self.listen(Odometry, "twin/odom", self._on_odom)
        self.listen(AccelStamped, "imu/vertical_acceleration", self._on_vertical)
        # All twins write to this topic: of many in one process, each gets the status of its own nodes alone.
        if not self.embedding.bare:
            self.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, 100)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(LoadTwin, "~/load_twin", self._on_load)

    def check(self, values: Values) -> None:
        """See the base class. The model is made here, where a wrong twin can still be refused."""
        settings, twin = _settings(values), twin_of(values)
        settings.gap()
        if twin is None:
            self._prepared = None
        elif self._named is not None and self._named.twin is twin:
            self._prepared = self._named
        elif self._prepared is None or twin is not self._prepared.twin:
            self._check_program(values["twin"], twin)
            self._prepared = Follower(twin, settings)

    def _check_program(self, path: str, twin: Twin) -> None:
        if self._programs is not None and twin.program not in (None, *self._programs):
            text = f"{twin.model} runs a program: name it when the node is started, not by a request"
            raise InputError(path, "model", text)

    def prepare(self, values: Values, named: NamedTwin) -> None:
        """See the base class."""
        self._check_program(values["twin"], named.twin)
        self._named = Follower(named.twin, _settings(values), named.road)

    def start(self) -> None:
        """See the base class."""
        values = self.values
        follower = self._follower = self.twin.follower = self._prepared
        self._out.configure(follower, values["visual_rate"], values["gap.rate"])
        if follower is None:
            if "no twin" not in self.health.findings:
                self.say(WARN, NO_TWIN)
            self.health.findings["no twin"] = WARN, NO_TWIN
        else:
            follower.configure(_settings(values))
            self.health.findings.pop("no twin", None)
        self.reset()

    def lacks(self) -> str:
        """See the base class."""
        return "" if self._prepared else NO_TWIN

    def stop(self) -> None:
        """See the base class."""
        self.twin.follower = self._follower = None

    def reset(self) -> None:
        """See the base class: the twin is back in static equilibrium."""
        self._pairing.reset()
        self._out.reset()
        if self._follower is not None:
            self._follower.reset()

    def _on_odom(self, message: Odometry, ns: int) -> None:
        if message.header.frame_id != self._out.map_frame:
            self.note_frame("twin/odom", message.header.frame_id, self._out.map_frame)
        self._follow(self._pairing.pose(ns, read_odometry(message, ns / 1e9)))

    def _on_vertical(self, message: AccelStamped, ns: int) -> None:
        linear, angular = message.accel.linear, message.accel.angular
        measured = BodyAcceleration((linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z))
        if not all(abs(value) < _HARDEST for vector in measured for value in vector):
            text = "message dropped: a value is not finite or out of range"
            raise InputError("imu/vertical_acceleration", text)
        self._follow(self._pairing.sample(ns, measured))

    def _follow(self, ready: list[tuple[int, PlanarState, BodyAcceleration]]) -> None:
        for number, (ns, pose, measured) in enumerate(ready):
            if number:
                self.outbox.flush()  # the same message objects are filled for the next sample
            self.publish(Update(None, pose, self.twin.follow(ns / 1e9, pose, measured)), ns)

    def take(self, update: Update, ns: int) -> None:
        """Publish what the twin makes of a sample that has gone through all stages in this process."""
        if not self.active:
            return
        self.inputs["imu/vertical_acceleration"].arrived(ns)
        if update.pose is not None:
            self.inputs["twin/odom"].arrived(ns)
        self.publish(update, ns)

    def publish(self, update: Update, ns: int) -> None:
        """Publish the twin's motion, signals and gap."""
        at, follower = update.followed, self._follower
        if at is None or follower is None:
            return
        if at.event:
            self._note_event(at.event)
        if not math.isnan(at.vertical_acceleration):
            self._out.send(at, follower, ns)
            self._age += (time.time_ns() - ns - self._age) / _AGES

    def _note_event(self, event: str) -> None:
        kind = event.removeprefix("the ").partition(" ")[0].rstrip(":")
        if kind != "start":
            level = {"heading": OK, "diverged": ERROR}.get(kind, WARN)
            self.note(f"simulation events: {kind}", level, f"simulation: {event}")

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.reset()
        response.success, response.message = True, "the simulation restarts from static equilibrium"
        return response

    async def _on_load(self, request: LoadTwin.Request, response: LoadTwin.Response) -> LoadTwin.Response:
        if not request.path:
            response.success, response.message = False, "path: is empty, give the path of a twin file"
            return response
        try:
            await self.read_named(request.path)
        except InputError as error:
            response.success, response.message = False, str(error)
            return response
        before = None if self._follower is None else self._follower.twin
        result = self.set_parameters([Parameter("twin", value=request.path)])[0]
        response.success, response.message = result.successful, result.reason
        if result.successful and self._follower is not None:
            twin = self._follower.twin
            response.message = f"loaded {twin.vehicle.name} ({twin.model})"
            moved = [k for k in ("imu", "gps", "datum") if before and getattr(before, k) != getattr(twin, k)]
            if moved:
                names = ", ".join(moved)
                response.message += f"; {names} changed: set the parameter twin of the other nodes as well"
        return response

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Compare the low-pass of the other nodes of this twin with the own: measured and simulated signals that went
        through different ones differ, and that is no gap."""
        own = self.health.values.get(LOW_PASS)
        for status in message.status:
            name = status.name.rpartition("/")[2]
            if name not in FILTERING or self.frame(name) != status.name:
                continue
            other = next((pair.value for pair in status.values if pair.key == LOW_PASS), own)
            text = (
                f"the low-pass is {own} here and {other} in {name}: set filter.order and filter.cutoff alike"
            )
            self._find(f"low-pass of {name}", own is not None and other != own, text)

    def whole_gap(self) -> float:
        """The gap in m/s² over all driving on the road since the twin was loaded; NaN before."""
        return math.nan if self._follower is None else self._follower.gap.driving_rms

    def gap_now(self) -> GapNow | None:
        """The live gap; None while the window holds fewer than two samples."""
        return None if self._follower is None else self._follower.gap.now()

    def report(self) -> None:
        """See the base class."""
        super().report()
        lost = self._pairing.lost
        self._pairing.lost = 0
        if self._follower is not None:
            lost, self._follower.lost = lost + self._follower.lost, 0
        if lost:
            text = "samples without a pose of the same time on twin/odom, not simulated"
            self.note(text, WARN, text, lost)
        self.health.values[LOW_PASS] = low_pass_text(self.values)
        gap = self.gap_now()
        if gap is not None:
            self.health.values["gap now, rms (m/s²)"] = f"{gap.rms:.3f}"
            self.health.values["gap now, normalised"] = f"{gap.normalised:.2f}"
            self.health.values[WHOLE_GAP] = f"{self.whole_gap():.3f}"
        self._show_gap(gap)
        self._show_latency()
        self.show_findings([] if self._follower is None else self._follower.findings)

    def _show_gap(self, gap: GapNow | None) -> None:
        """The gap and what excites the suspension, each with its own status."""
        show = self.health.thing
        if gap is None or self._follower is None:
            for name in ("gap", "excitation"):
                show(name, STALE, "nothing compared yet")
            return
        settings = self._follower.settings
        grown = self._follower.gap_warning()
        text = grown or f"{gap} in the last {settings.window:g} s"
        level, whole = WARN if grown else OK, self.whole_gap()
        show("gap", level, text, now=gap.rms, over_all_driving=whole, normalised=gap.normalised)
        quiet = gap.measured_rms < _EXCITED * gap.noise_rms
        text = "hardly any: standing, or a smooth road" if quiet else f"{gap.measured_rms:.2f} m/s² measured"
        show("excitation", OK, text, measured=gap.measured_rms, noise=gap.noise_rms)

    def _show_latency(self) -> None:
        """By how much the answers are behind the car, and why; in a replay the age of a stamp means nothing."""
        if self._follower is None or not self._age or self.simulated_time:
            return
        delay, late = 1e3 * delay_of(filter_of(self.values)), 1e3 * self._follower.twin.imu.latency
        age = self._age / 1e6
        text = (
            f"{age + delay + late:.1f} ms behind the car: {age:.1f} ms from a sample's stamp to its answer, "
            f"{delay:.1f} ms by the low-pass, {late:.1f} ms by the sensor (imu.latency)"
        )
        self.health.thing("latency", OK, text, age_ms=age, low_pass_ms=delay, sensor_ms=late)


def _named(values: Values) -> Twin | None:
    """The twin that was named when the node was started; None where it cannot be read, which is said later."""
    try:
        return twin_of(values)
    except InputError:
        return None


def _settings(values: Values) -> FollowSettings:
    """Low-pass and gap as the parameters describe them. Raises InputError."""
    named, given = named_twin(values), values["gap.floor"]
    return FollowSettings(
        filter=filter_of(values),
        window=values["gap.window"],
        edges=tuple(values["gap.bands"]),
        floor=named.floor if named and not given else calibration_gap(given, values["twin"]),
        warn=values["gap.warn"],
        acceleration_time=values["acceleration_time"],
    )
