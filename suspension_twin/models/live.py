# SPDX-License-Identifier: Apache-2.0
"""The model one stamp at a time, for a twin that runs beside its vehicle.

The same compiled kernel as in a batch, fed with the same interval, so its numbers are those of
the batch bit for bit.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.models.candidate_road import ahead_of, candidate_heights, reach_of
from suspension_twin.models.connectors import OBSERVED, observe
from suspension_twin.models.constants import Constants, constants
from suspension_twin.models.excitation import MAX_STEP, check_step, next_yaw_acceleration, substeps, walk
from suspension_twin.models.parameters import layout, pack
from suspension_twin.models.registry import model_of
from suspension_twin.models.rows import STATES, WIDTH
from suspension_twin.models.sensor_chain import Chain
from suspension_twin.models.simulate import LaneBlocks
from suspension_twin.models.types import HeightField
from suspension_twin.vehicle.twin import Twin

__all__ = ["Following", "LiveState", "LiveTwin", "earlier_pose", "live_twin"]


@dataclass(frozen=True, eq=False)
class LiveState:
    """The twin at one stamp; fields as in Response, one row of it.

    ``event`` says in a few words what was not an ordinary step: a fresh start, a gap, time
    running backwards, an unusable input. It is empty otherwise.
    """

    t: float
    heave: float
    roll: float
    pitch: float
    z: float
    wheel_z: Floats
    deflection: Floats
    deflection_rate: Floats
    tyre_force: Floats
    force: Floats
    rate: Floats
    vertical_acceleration: float
    event: str = ""


class Following(ABC):
    """A model of four wheels that is given the locked pose stamp by stamp: pose to road heights, gaps, clock, sensor's
    chain. A subclass walks the interval.

    A step never raises for what a message may hold, it says so in ``LiveState.event``.
    """

    def __init__(self, twin: Twin, road: HeightField, known: Constants, max_step: float) -> None:
        known.raise_first()
        self.twin = twin
        self.max_step = max_step
        self._road = road
        self._known = known
        self._chain = Chain(known)
        self._wheels = twin.vehicle.wheel_positions
        # stamp 0 is the last one, stamp 1 the one to come
        self._pose = np.zeros((3, 2))
        self._motion = np.zeros((2, 7))
        self._count = np.zeros(2, dtype=np.int64)
        self._first = np.array([0, 1, 2])
        self._paths = np.zeros((2, 16, 4))
        self._ground = np.zeros((1, 4))
        self._reference: Floats | None = None  # heights that a scale of the road leaves alone
        self._failure = ""  # what the model itself says of why it failed, with a colon
        self.reset()

    @abstractmethod
    def _restart(self) -> None:
        """Static equilibrium at the next stamp."""

    @abstractmethod
    def _advance(self, seen: Floats) -> bool:
        """Walk to stamp 1 over the heights (rows, 4) m; False where the model diverges or fails."""

    @abstractmethod
    def _row(self) -> Floats:
        """(OBSERVED,) the model at stamp 1, the sensor an ideal one."""

    def reset(self) -> None:
        """Forget everything: the next step starts from static equilibrium."""
        self._restart()
        self._chain.reset()
        self._reference = None
        self._t = self._t0 = math.nan
        self._last: LiveState | None = None

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
        """Go on to stamp ``t`` s, where base_link has this pose and planar motion (as in Trajectory).

        A pause longer than ``excitation.MAX_GAP`` or a stamp before the last one starts afresh; a
        repeated stamp and input that is not finite leave the twin where it is.
        """
        event = ""
        if not math.isfinite(t + x + y + yaw + speed + lateral_speed + yaw_rate + ax + ay):
            return self._same("input is not finite")
        interval = t - self._t
        if interval == 0.0:
            return self._same("stamp repeated")
        n = 0
        if math.isnan(interval):
            event = "start"
        elif interval < 0.0:
            event = f"time went back by {-interval:.3f} s: started afresh"
        else:
            n = substeps(interval, self.max_step)
            if n == 0:
                event = f"gap of {interval:.2f} s: started afresh"
        if not interval >= 0.0:  # the first stamp, or time went back
            self._t0 = t
        pose, motion = self._pose, self._motion
        pose[:, 0] = pose[:, 1]
        motion[0] = motion[1]
        if self._known.clock is not None:
            offset = self._known.clock.delay[0] + self._known.clock.drift[0] * (t - self._t0)
            x, y, yaw = earlier_pose(offset, x, y, yaw, speed, lateral_speed, yaw_rate)
        if n:
            yaw += 2 * math.pi * round((float(pose[2, 0]) - yaw) / (2 * math.pi))
            rate = next_yaw_acceleration(float(motion[0, 4]), yaw_rate - float(motion[0, 3]), interval)
            motion[1] = (interval / n, ax, ay, yaw_rate, rate, speed, lateral_speed)
        else:
            motion[1] = (0.0, ax, ay, yaw_rate, 0.0, speed, lateral_speed)
        pose[:, 1] = (x, y, yaw)
        rows = max(n, 1)
        self._count[1] = n
        self._first[2] = 1 + rows
        if rows > self._paths.shape[1]:
            self._paths = np.zeros((2, rows, 4))
        wheel_x, wheel_y = self._paths[0, :rows], self._paths[1, :rows]
        walk(pose[0], pose[1], pose[2], self._count, self._first, 1, 2, self._wheels, wheel_x, wheel_y)
        ground = np.asarray(self._road.heights(wheel_x, wheel_y), dtype=np.float64)
        if not math.isfinite(float(ground.sum())):
            event = "the road has no height under a wheel: last one held"
            ground = np.where(np.isfinite(ground), ground, self._ground)
        self._t = t
        self._ground = ground[-1:]
        seen = self._seen(ground, n)
        if not self._advance(seen):
            event = f"diverged: {self._failure}started afresh"
            self._restart()
            self._count[1] = 0
            if not self._advance(seen[-1:]) and self._last is not None:
                return self._same("diverged: cannot start where it is")
        self._last = self._state(t, event)
        return self._last

    def _seen(self, ground: Floats, n: int) -> Floats:
        """(rows, 4) heights that the twin sees of the ``ground``, where effects change that."""
        change = self._known.road
        if change is None:
            return ground
        (x0, x1), (y0, y1), (_, yaw) = self._pose.tolist()
        if n == 0:
            x0, y0 = x1, y1
        length = math.hypot(x1 - x0, y1 - y0)
        distance = np.arange(1, max(n, 1) + 1) / max(n, 1) * length
        around = ahead_of((x0, x1), (y0, y1), yaw, reach_of(change), self._wheels, self._road)
        if self._reference is None:
            self._reference = ground[0].copy()
        return candidate_heights(around, change, 0, 1, ground, distance, self._reference)[0]

    def _state(self, t: float, event: str) -> LiveState:
        row = self._row()
        if self._chain:
            read = row[20:27].reshape(1, 7, 1)
            self._chain.process(read, np.array([t]), self._count[1:] == 0)
        heave, roll, pitch, z = row[:4].tolist()
        return LiveState(
            t,
            heave,
            roll,
            pitch,
            z,
            row[4:8],
            row[8:12],
            row[12:16],
            row[16:20],
            row[20:23],
            row[23:26],
            float(row[26]),
            event,
        )

    def _same(self, event: str) -> LiveState:
        if self._last is None:
            raise InputError("live twin", event, "and there was no usable one before it")
        return replace(self._last, event=event)


class LiveTwin(Following):
    """A twin of the kernels ``full_car`` and ``msd`` that is given the locked pose stamp by stamp.

    Raises InputError at construction for a twin that cannot be simulated, naming the key.
    """

    def __init__(self, twin: Twin, road: HeightField, max_step: float = MAX_STEP) -> None:
        known = constants(pack(twin)[:, None], layout(twin), check_step(max_step))
        known.raise_first()
        self._values = known.values[:, 0].copy()
        self._fresh, self._blocks = LaneBlocks(known), LaneBlocks(known)
        self._radius = twin.vehicle.tyre.radius
        self._signals = np.zeros((1, 7, WIDTH))
        self._states = np.zeros((1, STATES, WIDTH))
        super().__init__(twin, road, known, max_step)

    def _restart(self) -> None:
        self._blocks.restart(self._fresh)

    def _advance(self, seen: Floats) -> bool:
        self._blocks.walk(seen, None, self._count, self._motion, 1, 2, self._signals, self._states)
        return not self._blocks.failed[0]

    def _row(self) -> Floats:
        out = np.empty((1, OBSERVED))
        observe(self._states, self._signals, self._values, self._radius, self.twin.model == "msd", out)
        row: Floats = out[0]
        return row


def earlier_pose(
    seconds: float, x: float, y: float, yaw: float, speed: float, lateral_speed: float, yaw_rate: float
) -> tuple[float, float, float]:
    """x, y in m and yaw in rad ``seconds`` before a pose, at the velocity of now: where a sensor was when it took a
    sample that comes so much later."""
    x -= seconds * (speed * math.cos(yaw) - lateral_speed * math.sin(yaw))
    y -= seconds * (speed * math.sin(yaw) + lateral_speed * math.cos(yaw))
    return x, y, yaw - seconds * yaw_rate


def live_twin(twin: Twin, road: HeightField) -> Following:
    """The model of a twin that follows its vehicle stamp by stamp; InputError where the model cannot."""
    live = model_of(twin).live
    if live is None:
        raise InputError("twin", "model", f"{twin.model} follows no vehicle on a road")
    model: Following = live(twin, road)
    return model
