# SPDX-License-Identifier: Apache-2.0
"""The node that simulates the twin: ``twin/odom`` over the road to the twin's motion, signals and gap.

The vehicle model is :class:`~suspension_twin.models.live.LiveTwin`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Set as AbstractSet
from functools import cache, partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import AccelStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from suspension_twin.errors import InputError
from suspension_twin.inference.sliding_window import GapNow
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.follower import Follower, Paired, Pairing, PlanarRow
from suspension_twin.nodes.live_gap import GAP, calibration_gap, gap_of, gap_warning
from suspension_twin.nodes.parameters import (
    FILTER,
    LOW_PASS,
    TWIN,
    Param,
    Values,
    filter_of,
    low_pass_text,
    twin_of,
)
from suspension_twin.nodes.process import run_alone
from suspension_twin.nodes.topics import ERROR, OK, WARN, Embedding
from suspension_twin.nodes.twin_outputs import TwinOutputs
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.filters import FilterSpec, LiveLowPass
from suspension_twin_interfaces.srv import LoadTwin

__all__ = ["SuspensionModelNode", "main"]

#: The nodes whose low-pass has to be that of this one.
FILTERING = ("imu_ingest", "pose_injector")
#: Above this variance of the yaw (rad²) the heading and the road under the wheels are unknown.
_YAW_KNOWN = 1.0
#: Limits of plausible input: distance from the datum (m), speeds (m/s, rad/s), acceleration (m/s²).
_FARTHEST, _FASTEST, _HARDEST = 1e8, 1e3, 1e5


class SuspensionModelNode(TwinNode):
    """``twin/odom`` and ``imu/vertical_acceleration`` in; the twin's motion, signals and gap out."""

    parameters = (
        TWIN,
        *FILTER,
        Param("map_frame", "map", "Frame of twin/odom.", read_only=True),
        Param("base_frame", "base_link", "Frame of the vehicle's body.", read_only=True),
        Param(
            "visual_rate",
            100.0,
            "Largest rate in Hz of twin/pose, joint_states and /tf; up to it there is one message per sample.",
            0.1,
            2000.0,
        ),
        Param(
            "acceleration_time",
            0.1,
            "Time constant in s of the planar acceleration, the low-passed derivative of the speeds in twin/odom.",
            0.0,
            2.0,
        ),
        *GAP,
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        self._prepared: tuple[Any, Follower | None] = (None, None)
        self._programs: tuple[Path, ...] | None = None  # any, while the node is started
        super().__init__("suspension_model", embedding)
        started = self._prepared[0]
        self._programs = () if started is None or started.program is None else (started.program,)
        _compile()
        self._pairing = Pairing()
        self._out = TwinOutputs(self, self.values["map_frame"], self.values["base_frame"])
        self._start()
        self.listen(Odometry, "twin/odom", self._on_odom)
        self.listen(AccelStamped, "imu/vertical_acceleration", self._on_vertical)
        # All twins write to this topic: of many in one process, each is told by its own nodes alone.
        if not self.embedding.bare:
            self.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, 100)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(LoadTwin, "~/load_twin", self._on_load)

    def check(self, values: Values) -> None:
        """See the base class. The model is made here, where a wrong twin can still be refused."""
        gap_of(values)
        filter_of(values)
        twin = twin_of(values)
        if twin is not self._prepared[0]:
            if (
                twin is not None
                and self._programs is not None
                and twin.program not in (None, *self._programs)
            ):
                text = f"{twin.model} runs a program: name it when the node is started, not by a request"
                raise InputError(values["twin"], "model", text)
            self._prepared = (twin, None if twin is None else Follower(twin))

    def changed(self, names: AbstractSet[str]) -> None:
        """See the base class: any new setting resets the node."""
        if names & {p.name for p in self.parameters}:
            self._start()

    def _start(self) -> None:
        values = self.values
        self._follower = self._prepared[1]
        self._low_pass = LiveLowPass(filter_of(values))
        self._gap, self._expected = gap_of(values), calibration_gap(values)
        self._out.marker.floor = self._gap.floor
        self._out.configure(self._follower, values["visual_rate"], values["gap.rate"])
        if self._follower is None:
            text = "no twin loaded: set the parameter twin or call ~/load_twin"
            if "no twin" not in self.health.findings:
                self.say(WARN, text)
            self.health.findings["no twin"] = WARN, text
        else:
            self._follower.acceleration_time = values["acceleration_time"]
            self.health.findings.pop("no twin", None)
        self.reset()

    def reset(self) -> None:
        """See the base class: the twin is back in static equilibrium."""
        self._pairing.reset()
        self._low_pass.reset()
        self._gap.reset()
        self._out.reset()
        if self._follower is not None:
            self._follower.reset()

    def _on_odom(self, message: Odometry, ns: int) -> None:
        if message.header.frame_id != self._out.map_frame:
            self.note_frame("twin/odom", message.header.frame_id, self._out.map_frame)
        pose, twist = message.pose.pose, message.twist.twist
        q, p = pose.orientation, pose.position
        yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
        v, w = twist.linear, twist.angular.z
        near = abs(p.x) < _FARTHEST and abs(p.y) < _FARTHEST
        if not (
            near and abs(v.x) < _FASTEST and abs(v.y) < _FASTEST and abs(w) < _FASTEST and math.isfinite(yaw)
        ):
            raise InputError("twin/odom", "message dropped: a value is not finite or out of range")
        known = message.pose.covariance[35] < _YAW_KNOWN
        self._follow(self._pairing.pose(PlanarRow(ns, p.x, p.y, yaw, v.x, v.y, w, known)))

    def _on_vertical(self, message: AccelStamped, ns: int) -> None:
        measured = message.accel.linear.z
        if not abs(measured) < _HARDEST:
            raise InputError(
                "imu/vertical_acceleration", "message dropped: linear.z is not finite or out of range"
            )
        self._follow(self._pairing.sample(ns, measured))

    def _follow(self, ready: list[Paired]) -> None:
        if self._follower is None:
            return
        for number, (row, measured) in enumerate(ready):
            if number:
                self.outbox.flush()  # the same message objects are filled for the next sample
            t = row.ns / 1e9
            state = self._follower.step(t, row)
            if state.event:
                self._note_event(state.event)
                self._gap.restart(t)
            if not abs(state.vertical_acceleration) < _HARDEST:  # impossible poses
                self._note_event("diverged: restarted")
                self._follower.reset()
                self._low_pass.reset()
                self._gap.restart(t)
                continue
            filtered = self._low_pass.push(t, state.vertical_acceleration - self._follower.standing_vertical)
            self._out.send_acceleration(row.ns, filtered)
            self._gap.push(t, measured, filtered, row.speed)
            if row.known and self._gap.settled:
                self._out.locate(row, state.z, measured - filtered)
            self._out.send_rest(row, state, self._gap)

    def _note_event(self, event: str) -> None:
        kind = event.removeprefix("the ").partition(" ")[0].rstrip(":")
        if kind != "start":
            level = {"heading": OK, "diverged": ERROR}.get(kind, WARN)
            self.note(f"simulation events: {kind}", level, f"simulation: {event}")

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.reset()
        response.success, response.message = True, "the simulation restarts from static equilibrium"
        return response

    def _on_load(self, request: LoadTwin.Request, response: LoadTwin.Response) -> LoadTwin.Response:
        before = None if self._follower is None else self._follower.twin
        if not request.path:
            response.success, response.message = False, "path: is empty, give the path of a twin file"
            return response
        self._prepared = (None, None)  # the file is read again even if the path is the same
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
        """Rms of the gap in m/s² since the twin was loaded; NaN while nothing was simulated."""
        return self._gap.whole_rms

    def gap_now(self) -> GapNow | None:
        """The live gap; None while the window holds fewer than two samples."""
        return self._gap.now()

    def report(self) -> None:
        """See the base class."""
        if self._pairing.lost:
            text = "samples without a pose of the same time on twin/odom, not simulated"
            self.note(text, WARN, text, self._pairing.lost)
            self._pairing.lost = 0
        self.health.values[LOW_PASS] = low_pass_text(self.values)
        found = [] if self._follower is None else self._follower.findings
        gap = self._gap.now()
        if gap is not None:
            self.health.values["gap, rms (m/s²)"] = f"{gap.rms:.3f}"
            self.health.values["gap, normalised"] = f"{gap.normalised:.2f}"
        warning = gap_warning(gap, self._expected, self.values["gap.warn"])
        self.show_findings([*found, *([Finding("warn", "gap", warning)] if warning else [])])


@cache
def _compile() -> None:
    """Compile before the first message: a few samples, one of them missing."""
    low_pass = LiveLowPass(FilterSpec())
    for k in (0, 1, 2, 4):
        low_pass.push(1.0 + 0.01 * k, 0.0)


main = partial(run_alone, SuspensionModelNode)

if __name__ == "__main__":
    sys.exit(main())
