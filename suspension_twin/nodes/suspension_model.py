# SPDX-License-Identifier: Apache-2.0
"""The node that is the twin: ``twin/odom`` over the road, into everything the twin says.

All that it knows about vehicles is :class:`~suspension_twin.models.live.LiveTwin`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Set as AbstractSet
from typing import Any

from geometry_msgs.msg import AccelStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from suspension_twin.errors import InputError
from suspension_twin.gap.sliding_window import GapNow
from suspension_twin.nodes._base import Embedding, TwinNode
from suspension_twin.nodes._files import FILTER, TWIN, filter_of, twin_of
from suspension_twin.nodes._follow import Follower
from suspension_twin.nodes._gap_parameters import GAP, beyond, gap_of, left_of
from suspension_twin.nodes._health import ERROR, OK, WARN
from suspension_twin.nodes._main import run_alone
from suspension_twin.nodes._pairing import Pairing, PlanarRow, Yielded
from suspension_twin.nodes._parameters import Param, Values
from suspension_twin.nodes._twin_out import TwinOut
from suspension_twin.nodes._warm_up import warm_up_low_pass
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.live import LiveLowPass
from suspension_twin_interfaces.srv import LoadTwin

__all__ = ["SuspensionModelNode", "main"]

#: Above this variance of the yaw (rad²) the heading is a guess and the road under the wheels too.
_YAW_KNOWN = 1.0
#: No vehicle is this far from its datum (m), moves or turns this fast (m/s, rad/s) or is shaken this hard (m/s²).
_FARTHEST, _FASTEST, _HARDEST = 1e8, 1e3, 1e5


class SuspensionModelNode(TwinNode):
    """``twin/odom`` and ``imu/vertical_acceleration`` in; the twin's motion, signals and gap out."""

    parameters = (
        TWIN,
        *FILTER,
        Param("map_frame", "map", "Frame that twin/odom is in.", read_only=True),
        Param("base_frame", "base_link", "Frame of the twin's body.", read_only=True),
        Param(
            "visual_rate",
            100.0,
            "Most messages a second on twin/pose, joint_states and /tf; every sample up to that.",
            0.1,
            2000.0,
        ),
        Param(
            "acceleration_time",
            0.1,
            "Time constant in s with which the planar acceleration is taken from the speeds of twin/odom.",
            0.0,
            2.0,
        ),
        *GAP,
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        self._prepared: tuple[Any, Follower | None] = (None, None)
        super().__init__("suspension_model", embedding)
        warm_up_low_pass()
        self._pairing = Pairing()
        self._out = TwinOut(self, self.values["map_frame"], self.values["base_frame"])
        self._start()
        self.listen(Odometry, "twin/odom", self._on_odom)
        self.listen(AccelStamped, "imu/vertical_acceleration", self._on_vertical)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(LoadTwin, "~/load_twin", self._on_load)

    def check(self, values: Values) -> None:
        """See the base class. The twin is made here, where a wrong one can still be refused."""
        gap_of(values)
        filter_of(values)
        twin = twin_of(values)
        if twin is not self._prepared[0]:
            self._prepared = (twin, None if twin is None else Follower(twin))

    def changed(self, names: AbstractSet[str]) -> None:
        """See the base class: whatever changes, the twin starts afresh with it."""
        if names & {p.name for p in self.parameters}:
            self._start()

    def _start(self) -> None:
        values = self.values
        self._follower = self._prepared[1]
        self._low_pass = LiveLowPass(filter_of(values))
        self._gap, self._left = gap_of(values), left_of(values)
        self._out.marker.floor = self._gap.floor
        self._out.configure(self._follower, values["visual_rate"], values["gap.rate"])
        if self._follower is None:
            self.health.finding("no twin", WARN, "no twin yet: set the parameter twin or call ~/load_twin")
        else:
            self._follower.acceleration_time = values["acceleration_time"]
            self.health.clear("no twin")
        self.reset()

    def reset(self) -> None:
        """See the base class: the twin stands still in its static equilibrium again."""
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
            raise InputError("twin/odom", "holds a number that is not finite or beyond belief: dropped")
        known = message.pose.covariance[35] < _YAW_KNOWN
        self._follow(self._pairing.pose(PlanarRow(ns, p.x, p.y, yaw, v.x, v.y, w, known)))

    def _on_vertical(self, message: AccelStamped, ns: int) -> None:
        measured = message.accel.linear.z
        if not abs(measured) < _HARDEST:
            raise InputError("imu/vertical_acceleration", "linear.z is not finite or beyond belief: dropped")
        self._follow(self._pairing.sample(ns, measured))

    def _follow(self, ready: list[Yielded]) -> None:
        if self._follower is None:
            return
        for number, (row, measured) in enumerate(ready):
            if number:
                self.outbox.flush()  # the messages are filled anew for every sample
            t = row.ns / 1e9
            state = self._follower.step(t, row)
            if state.event:
                self._tell(state.event)
                self._gap.restart(t)
            if not abs(state.vertical_acceleration) < _HARDEST:  # the poses were of no vehicle
                self._tell("diverged: starting afresh")
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

    def _tell(self, event: str) -> None:
        kind = event.partition(" ")[0].rstrip(":")
        if kind != "start":
            level = {"heading": OK, "diverged": ERROR}.get(kind, WARN)
            self.note(f"twin {kind}", level, f"twin: {event}")

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.reset()
        response.success, response.message = True, "the twin starts afresh from its static equilibrium"
        return response

    def _on_load(self, request: LoadTwin.Request, response: LoadTwin.Response) -> LoadTwin.Response:
        before = None if self._follower is None else self._follower.twin
        if not request.path:
            response.success, response.message = False, "path: is empty"
            return response
        self._prepared = (None, None)  # the same path again means: read the file again
        result = self.set_parameters([Parameter("twin", value=request.path)])[0]
        response.success, response.message = result.successful, result.reason
        if result.successful and self._follower is not None:
            twin = self._follower.twin
            response.message = f"follows with {twin.vehicle.name} ({twin.model})"
            moved = [k for k in ("imu", "gps", "datum") if before and getattr(before, k) != getattr(twin, k)]
            if moved:
                response.message += (
                    f"; {', '.join(moved)} differ: set the parameter twin of the other nodes too"
                )
        return response

    def gap_now(self) -> GapNow | None:
        """The live gap; None while there is too little to tell."""
        return self._gap.now()

    def report(self) -> None:
        """See the base class."""
        if self._pairing.lost:
            self.note("no pose", WARN, f"samples without a pose, not answered: {self._pairing.lost}")
            self._pairing.lost = 0
        found = [] if self._follower is None else self._follower.findings
        gap = self._gap.now()
        if gap is not None:
            self.health.values["gap (m/s²)"] = f"{gap.rms:.3f}"
            self.health.values["gap, normalised"] = f"{gap.normalised:.2f}"
        warning = beyond(gap, self._left, self.values["gap.warn"])
        self.show_findings([*found, *([Finding("warn", "gap", warning)] if warning else [])])


def main(args: list[str] | None = None) -> Any:
    """Run the node in a process of its own."""
    return run_alone(SuspensionModelNode, args)


if __name__ == "__main__":
    sys.exit(main())
