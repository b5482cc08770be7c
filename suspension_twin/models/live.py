# SPDX-License-Identifier: Apache-2.0
"""The model one stamp at a time, for a twin that runs beside its vehicle.

The same compiled kernel as in a batch, fed with the same interval, so its numbers are those of
the batch bit for bit.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.models.candidate_road import RoadStretch, ahead_of, candidate_heights, reach_of
from suspension_twin.models.connectors import COLUMNS
from suspension_twin.models.constants import Conditions, Outside, constants
from suspension_twin.models.excitation import (
    MAX_GAP,
    MAX_STEP,
    check_step,
    earlier_pose,
    next_yaw_acceleration,
    substeps,
    walk,
)
from suspension_twin.models.parameters import layout, pack
from suspension_twin.models.registry import model_of
from suspension_twin.models.rows import STATES, WIDTH
from suspension_twin.models.sensor_chain import Chain
from suspension_twin.models.simulate import LaneBlocks, Stretch, observed
from suspension_twin.models.types import BodyMotion, HeightField, PoseSample, SensorReading, WheelMotion
from suspension_twin.vehicle.twin import Twin

__all__ = ["Following", "LiveModel", "LiveState", "LiveTwin", "live_twin"]


@dataclass(frozen=True, eq=False)
class LiveState(SensorReading[float], WheelMotion, BodyMotion[float]):
    """The twin at one stamp; fields as in :class:`Response`, one row of it.

    ``event`` says in a few words what was not an ordinary step: a fresh start, a gap, time
    running backwards, an unusable input. It is empty otherwise.
    """

    event: str = ""


class LiveModel(ABC):
    """A model that is given the locked pose stamp by stamp.

    A step never raises for what a message may hold, it says so in ``LiveState.event``.
    """

    twin: Twin
    _t = math.nan
    _last: LiveState | None = None

    @abstractmethod
    def _go_on(self, t: float, motion: PoseSample, interval: float, event: str) -> LiveState:
        """The state at ``t`` s, ``interval`` s after the last stamp; with an ``event`` from static equilibrium."""

    def reset(self) -> None:
        """Forget everything: the next step starts from static equilibrium."""
        self._t = math.nan
        self._last = None

    def step(self, t: float, motion: PoseSample) -> LiveState:
        """Go on to stamp ``t`` s, where base_link has this pose and planar motion.

        A pause longer than ``excitation.MAX_GAP`` or a stamp before the last one starts afresh; a
        repeated stamp and input that is not finite leave the twin where it is.
        """
        motion = PoseSample._make(
            map(float, motion)
        )  # an array of whole numbers would compile the kernel anew
        if not math.isfinite(t + sum(motion)):
            return self._same("input is not finite")
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
        self._last = self._go_on(t, motion, interval, event)
        self._t = t
        return self._last

    def _same(self, event: str) -> LiveState:
        if self._last is None:
            raise InputError("live twin", event, "and there was no usable one before it")
        return replace(self._last, event=event)


class Following(LiveModel):
    """A model of four wheels: from the pose to road heights, gaps, clock and sensor's chain. A subclass walks the
    interval."""

    def __init__(self, twin: Twin, road: HeightField, known: Outside, max_step: float) -> None:
        known.problems.raise_first()
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
        self._failure = ""  # why the model failed, in its own words, with a colon
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
        super().reset()
        self._restart()
        self._chain.reset()
        self._reference: Floats | None = None  # heights that a scale of the road leaves alone
        self._t0 = math.nan

    def _go_on(self, t: float, motion: PoseSample, interval: float, event: str) -> LiveState:
        n = 0 if event else substeps(interval, self.max_step)
        if not interval >= 0.0:  # the first stamp, or time went back
            self._t0 = t
        self._move(t, motion, interval, n)
        rows = max(n, 1)
        self._count[1] = n
        self._first[2] = 1 + rows
        if rows > self._paths.shape[1]:
            self._paths = np.zeros((2, rows, 4))
        wheel_x, wheel_y = self._paths[0, :rows], self._paths[1, :rows]
        x, y, yaw = self._pose
        walk(x, y, yaw, self._count, self._first, 1, 2, self._wheels, wheel_x, wheel_y)
        ground = np.asarray(self._road.heights(wheel_x, wheel_y), dtype=np.float64)
        if not math.isfinite(float(ground.sum())):
            event = "the road has no height under a wheel: last one held"
            ground = np.where(np.isfinite(ground), ground, self._ground)
        self._ground = ground[-1:]
        seen = self._seen(ground, n)
        if not self._advance(seen):
            event = f"diverged: {self._failure}started afresh"
            self._restart()
            self._count[1] = 0
            if not self._advance(seen[-1:]) and self._last is not None:
                return self._same("diverged: cannot start where it is")
        return self._state(t, event)

    def _move(self, t: float, motion: PoseSample, interval: float, n: int) -> None:
        """Pose and motion of the stamp to come, in ``n`` steps; what it was becomes the last one's."""
        pose, planar = self._pose, self._motion
        pose[:, 0] = pose[:, 1]
        planar[0] = planar[1]
        if self._known.clock is not None:
            delay, drift = self._known.clock.delay[0], self._known.clock.drift[0]
            motion = earlier_pose(motion, delay + drift * (t - self._t0))
        x, y, yaw, speed, lateral_speed, yaw_rate, ax, ay = motion
        step = yaw_acceleration = 0.0
        if n:
            yaw += 2 * math.pi * round((float(pose[2, 0]) - yaw) / (2 * math.pi))
            change = yaw_rate - float(planar[0, 3])
            step = interval / n
            yaw_acceleration = next_yaw_acceleration(float(planar[0, 4]), change, interval)
        planar[1] = (step, ax, ay, yaw_rate, yaw_acceleration, speed, lateral_speed)
        pose[:, 1] = (x, y, yaw)

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
        return candidate_heights(RoadStretch(around, ground, distance, self._reference), change, 0, 1)[0]

    def _state(self, t: float, event: str) -> LiveState:
        row = self._row()
        if self._chain:
            read = row[20:27].reshape(1, 7, 1)
            self._chain.process(read, np.array([t]), self._count[1:] == 0)
        values: dict[str, Any] = {name: row[at] for name, at in _VECTORS.items()}
        values |= {name: float(row[at]) for name, at in _SCALARS.items()}
        return LiveState(t=t, event=event, **values)


#: Columns of the fields of a LiveState.
_VECTORS = {name: at for name, at in COLUMNS.items() if isinstance(at, slice) and name != "acceleration"}
_SCALARS = {name: at for name, at in COLUMNS.items() if isinstance(at, int)}


class LiveTwin(Following):
    """A twin of the kernels ``full_car`` and ``msd`` that is given the locked pose stamp by stamp.

    Raises InputError at construction for a twin that cannot be simulated, naming the key.
    """

    def __init__(self, twin: Twin, road: HeightField, max_step: float = MAX_STEP) -> None:
        known = constants(pack(twin)[:, None], layout(twin), Conditions(check_step(max_step)))
        known.problems.raise_first()
        self._constants = known
        self._fresh, self._blocks = LaneBlocks(known), LaneBlocks(known)
        self._radius = twin.vehicle.tyre.radius
        self._signals = np.zeros((1, 7, WIDTH))
        self._states = np.zeros((1, STATES, WIDTH))
        super().__init__(twin, road, known, max_step)

    def _restart(self) -> None:
        self._blocks.restart(self._fresh)

    def _advance(self, seen: Floats) -> bool:
        self._blocks.walk(Stretch(self._count, self._motion, 1, 2, seen), self._signals, self._states)
        return not self._blocks.failed[0]

    def _row(self) -> Floats:
        row: Floats = observed(self._constants, self._states, self._signals, self._radius)[0]
        return row


def live_twin(twin: Twin, road: HeightField) -> LiveModel:
    """The model of a twin that follows its vehicle stamp by stamp; InputError where the model cannot."""
    live = model_of(twin).live
    if live is None:
        raise InputError("twin", "model", f"{twin.model} follows no vehicle on a road")
    model: LiveModel = live(twin, road)
    return model
