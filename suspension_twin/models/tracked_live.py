# SPDX-License-Identifier: Apache-2.0
"""``tracked`` on a real way: the model beside its vehicle stamp by stamp, and over a recorded drive.

The plane of symmetry travels along the locked pose; each link is laid on the mean of the heights under
the two tracks, where the pose points when it is laid. A recorded drive is the live twin run over its
stamps, so both give the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, WorkError
from suspension_twin.models.excitation import MAX_GAP, MAX_STEP
from suspension_twin.models.live import LiveState, earlier_pose
from suspension_twin.models.tracked import (
    CONTACTS,
    SETTLE,
    STEP,
    changed_vehicle,
    pack_tracked,
    start_state,
    wheel_arc,
)
from suspension_twin.models.tracked_kernel import COLUMNS, PARAMETERS, first_index, walk_lane
from suspension_twin.models.types import Excitation, HeightField, Response
from suspension_twin.models.wheel_paths import next_yaw_acceleration
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.tracked import TrackedTwin

__all__ = ["LiveTracked", "simulate_tracked_drive"]


class LiveTracked:
    """As :class:`~suspension_twin.models.live.LiveTwin`, for a twin on tracks.

    Left and right road wheels move alike: arrays of a state hold the left side's wheels front to rear, then
    the right side's. ``deflection`` is an arm's turn in rad from its free angle, up positive; ``roll`` is 0.
    ``late`` s of the sensor's clock offset are in the poses already.
    """

    def __init__(
        self, twin: TrackedTwin, road: HeightField, max_step: float = MAX_STEP, late: float = 0.0
    ) -> None:
        self._late = twin.imu.latency - late
        vehicle = changed_vehicle(twin)
        self.twin = twin
        self._road = road
        self._step = min(STEP, max_step)
        self._p, self._stations, self._nodes = pack_tracked(vehicle)
        self._arc = wheel_arc(vehicle.wheel.radius)
        self._free, self._radius = vehicle.arm.free_angle, vehicle.wheel.radius
        self._cell = float(self._p[PARAMETERS.index("spacing")])
        # places counted from the centre of gravity: base_link's origin, the imu; and pivots for the wheels
        self._origin = np.array(
            [vehicle.stations[-1].x - vehicle.cog[0], vehicle.ground_height - vehicle.cog[1]]
        )
        position = np.array(twin.imu.position)
        self._imu = self._origin + position[[0, 2]]
        self._imu_y = float(position[1])
        self._arm = vehicle.arm.length
        self._side = vehicle.tread / 2
        self._out = np.zeros((2, COLUMNS + 2 * len(vehicle.stations)))
        self._counts = np.zeros(1, dtype=np.int64)
        self._height = self._standing()
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next step starts from static equilibrium."""
        self._t = math.nan
        self._last: LiveState | None = None
        self._s, self._pose = 0.0, (0.0, 0.0, 0.0)
        self._motion = (0.0, 0.0, 0.0, 0.0)  # speed, ax, yaw rate, yaw acceleration

    def step(
        self,
        t: float,
        x: float,
        y: float,
        yaw: float,
        speed: float,
        lateral_speed: float,
        yaw_rate: float,
        ax: float,
        ay: float,
    ) -> LiveState:
        """Go on to stamp ``t`` s with base_link's pose and planar motion; see LiveTwin.step."""
        if not math.isfinite(t + x + y + yaw + speed + lateral_speed + yaw_rate + ax + ay):
            return self._same("input is not finite")
        speed, ax = float(speed), float(ax)  # an array of whole numbers would compile the kernel anew
        interval = t - self._t
        if interval == 0.0:
            return self._same("stamp repeated")
        event = ""
        if math.isnan(interval):
            event = "start"
        elif interval < 0.0:
            event = f"time went back by {-interval:.3f} s: started afresh"
        elif interval > MAX_GAP:
            event = f"gap of {interval:.2f} s: started afresh"
        self._pose = earlier_pose(self._late, x, y, yaw, speed, lateral_speed, yaw_rate)
        self._t = t
        if event:
            sound = self._start()
            turning = 0.0
        else:
            before, push, turn, turning = self._motion
            turning = next_yaw_acceleration(turning, yaw_rate - turn, interval)
            sound, problem = self._go(interval, 0.5 * (before + speed) * interval, push, ax)
            event = problem
        if not sound:
            event = "diverged: started afresh"
            if not self._start():
                raise WorkError("tracked: the vehicle cannot stand: are its stiffnesses right?")
        self._motion = (speed, ax, yaw_rate, turning)
        self._last = self._state(event, ax, ay)
        return self._last

    def _heights(self, places: Floats, s: float) -> Floats:
        """Mean height of both tracks at places along the way, seen from the pose with the CoG at ``s``."""
        x, y, yaw = self._pose
        c, n = math.cos(yaw), math.sin(yaw)
        ahead = (places - s - self._origin[0])[:, None]
        side = np.array([[self._side, -self._side]])
        heights: Floats = np.asarray(self._road.heights(x + c * ahead - n * side, y + n * ahead + c * side))
        return np.asarray(heights.mean(axis=1))

    def _places(self, begin: int, end: int) -> Floats:
        """Where between nodes ``begin`` and ``end`` the ground is looked at, m along the way."""
        return (np.arange(begin * CONTACTS, end * CONTACTS) + 0.5) * self._cell / CONTACTS

    def _standing(self) -> float:
        """Height of the centre of gravity standing on level ground at 0, m."""
        self._hull, self._arms, self._track, self._mark = start_state(
            self._p, self._stations, self._nodes, 0.0
        )
        floor, steps = np.zeros(self._nodes * CONTACTS), round(SETTLE / self._step)
        if not self._walk(
            np.zeros(1), np.zeros(1), np.zeros(0), floor, int(self._mark[0]), steps, self._out[1:]
        ):
            raise InputError("twin", "vehicle", "cannot stand on level ground: are its stiffnesses right?")
        return float(self._hull[0])

    def _start(self) -> bool:
        self._s = 0.0
        lead = first_index(self._p, 0.0)
        heights = self._heights(self._places(lead, lead + self._nodes), 0.0)
        if not np.isfinite(heights).all():
            known = heights[np.isfinite(heights)]
            heights = np.where(np.isfinite(heights), heights, known.mean() if known.size else 0.0)
        self._reference = float(heights.mean())
        self._floor = heights - self._reference
        self._hull, self._arms, self._track, self._mark = start_state(
            self._p, self._stations, self._nodes, 0.0
        )
        self._hull[0] += self._floor.max()
        self._track[0] = self._floor.reshape(self._nodes, CONTACTS).max(axis=1)
        out = self._out[1:]
        return self._walk(
            np.zeros(1), np.zeros(1), np.zeros(0), self._floor, lead, round(SETTLE / self._step), out
        )

    def _go(self, interval: float, distance: float, push: float, ax: float) -> tuple[bool, str]:
        mark, travel = int(self._mark[0]), np.array([self._s, self._s + distance])
        lead = first_index(self._p, float(travel[1]))
        low, high = min(mark, lead), max(mark, lead)
        floor, problem = self._floor, ""
        if lead != mark:
            ahead = lead > mark
            begin, end = (mark + self._nodes, lead + self._nodes) if ahead else (lead, mark)
            new = self._heights(self._places(begin, end), float(travel[1])) - self._reference
            if not np.isfinite(new).all():
                problem = "the road has no height under a track: last one held"
                new = np.where(np.isfinite(new), new, floor[-1] if ahead else floor[0])
            floor = np.concatenate([floor, new] if ahead else [new, floor])
        self._counts[0] = max(1, math.ceil(interval / self._step - 1e-9))
        sound = self._walk(travel, np.array([push, ax]), np.array([interval]), floor, low, 0, self._out)
        self._s = float(travel[1])
        self._floor = floor[(lead - low) * CONTACTS :][: self._nodes * CONTACTS]
        return sound and high - low < 4 * self._nodes, problem

    def _walk(
        self,
        travel: Floats,
        accel: Floats,
        interval: Floats,
        floor: Floats,
        base: int,
        settle: int,
        out: Floats,
    ) -> bool:
        sound = walk_lane(
            self._p,
            self._stations,
            self._arc,
            floor,
            base * CONTACTS,
            CONTACTS,
            travel,
            accel,
            interval,
            self._counts[: interval.size],
            settle,
            self._step,
            self._hull,
            self._arms,
            self._track,
            self._mark,
            out,
        )
        return bool(sound) and bool(np.isfinite(out).all())

    def _state(self, event: str, ax: float, ay: float) -> LiveState:
        row = self._out[1]
        z, pitch, _, pv, za, pa = row[:6].tolist()
        c, s = math.cos(pitch), math.sin(pitch)
        stations = len(self._stations)
        phi, load = row[COLUMNS : COLUMNS + stations], row[COLUMNS + stations :]
        alpha = phi - pitch
        wheel = z - s * self._stations[:, 0] + c * self._stations[:, 1] - self._arm * np.sin(alpha)
        turn = self._arms[1] + pv
        _, _, yaw_rate, yaw_acceleration = self._motion
        # the imu's place, turned by the pitch, from the centre of gravity; from base_link's origin for the plane
        along, above = self._imu[0] * c + self._imu[1] * s, self._imu[1] * c - self._imu[0] * s
        out, left = float(self._imu[0] - self._origin[0]), self._imu_y
        forward = ax + above * pa - along * pv**2 - yaw_acceleration * left - yaw_rate**2 * out
        aside = ay + yaw_acceleration * out - yaw_rate**2 * left
        upward = za - along * pa - above * pv**2 + G
        base = z - s * self._origin[0] + c * self._origin[1]
        force = np.array([forward * c - upward * s, aside, forward * s + upward * c])
        return LiveState(
            t=self._t,
            heave=z - self._height + self._reference,
            roll=0.0,
            pitch=pitch,
            z=float(base + self._reference),
            wheel_z=np.tile(wheel + self._reference, 2),
            deflection=np.tile(self._free - phi, 2),
            deflection_rate=np.tile(-turn, 2),
            tyre_force=np.tile(load, 2),
            force=force,
            rate=np.array([-yaw_rate * s, pv, yaw_rate * c]),
            vertical_acceleration=float(force[2] - G * c),
            event=event,
        )

    def _same(self, event: str) -> LiveState:
        if self._last is None:
            raise InputError("live twin", event, "and there was no usable one before it")
        kept = {f.name: getattr(self._last, f.name) for f in fields(LiveState)}
        return LiveState(**{**kept, "event": event})


def simulate_tracked_drive(twin: TrackedTwin, excitation: Excitation) -> Response:
    """One twin over an excitation: the live twin over its stamps. Raises WorkError where it diverges."""
    live = LiveTracked(twin, excitation.ground, excitation.max_step, excitation.late)
    names = [f.name for f in fields(LiveState) if f.name not in ("t", "event")]
    columns: dict[str, list[object]] = {name: [] for name in names}
    motion = excitation.motion
    for k, t in enumerate(excitation.t):
        if excitation.substeps[k] == 0:
            live.reset()
        state = live.step(
            float(t),
            float(excitation.x[k]),
            float(excitation.y[k]),
            float(excitation.yaw[k]),
            float(motion[k, 5]),
            float(motion[k, 6]),
            float(motion[k, 3]),
            float(motion[k, 1]),
            float(motion[k, 2]),
        )
        if state.event.startswith("diverged"):
            raise WorkError(f"the simulation diverges by t = {t:.3f} s: are the road's heights in m?")
        for name in names:
            columns[name].append(getattr(state, name))
    arrays = {name: np.array(values, dtype=np.float64) for name, values in columns.items()}
    return Response(t=excitation.t, acceleration=np.zeros((len(excitation), 7)), **arrays)
