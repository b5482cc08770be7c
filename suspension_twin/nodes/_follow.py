# SPDX-License-Identifier: Apache-2.0
"""The live twin on its road, fed with what an odometry message can tell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from suspension_twin.gap.prepare import road_of
from suspension_twin.models.live import LiveState, live_twin
from suspension_twin.nodes._pairing import PlanarRow
from suspension_twin.road.build import flat_road
from suspension_twin.road.road import Road
from suspension_twin.signals.checks import Finding
from suspension_twin.vehicle.twin import Twin

__all__ = ["Follower"]

#: A pose that is off by more than this, against where the speed would have brought it, is another
#: place, not a movement: m and rad.
_JUMP = 0.5
_TURN = 0.3


class Follower:
    """Follows the locked pose with the model of a twin file; raises InputError for a wrong one.

    ``acceleration_time`` s smooths the planar acceleration, which is the change of the speeds:
    an odometry message carries none.
    """

    def __init__(self, twin: Twin, acceleration_time: float = 0.1) -> None:
        self.twin = twin
        self.road: Road = flat_road() if twin.road is None else road_of(twin)
        self.acceleration_time = acceleration_time
        self._live = live_twin(twin, self.road)
        # compiles now what would else be compiled at the first samples
        first, _ = (self._live.step(t, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0) for t in (0.0, 0.01))
        #: m/s² that the sensor shows standing: a gain multiplies gravity too. The IMU's filter takes it for a bias.
        self.standing_vertical = first.vertical_acceleration if twin.effects else 0.0
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next step starts from static equilibrium."""
        self._live.reset()
        self._t = math.nan
        self._row: PlanarRow | None = None
        self._rates = (0.0, 0.0)

    def step(self, t: float, row: PlanarRow) -> LiveState:
        """Go on to ``row`` at ``t`` s. A pose that jumps starts afresh, as a gap in time does."""
        jump = self._jump(t, row)
        if jump:
            self._live.reset()
            self._rates = (0.0, 0.0)
        elif self._row is not None and t > self._t:
            self._differentiate(t - self._t, self._row, row)
        along, across = self._rates
        self._t, self._row = t, row
        state = self._live.step(
            t,
            row.x,
            row.y,
            row.yaw,
            row.speed,
            row.lateral_speed,
            row.yaw_rate,
            along - row.yaw_rate * row.lateral_speed,
            across + row.yaw_rate * row.speed,
        )
        return replace(state, event=jump) if jump else state

    def _differentiate(self, dt: float, before: PlanarRow, row: PlanarRow) -> None:
        """Low-passed differences of the two speeds."""
        along, across = self._rates
        share = dt + self.acceleration_time
        self._rates = (
            along + (row.speed - before.speed - along * dt) / share,
            across + (row.lateral_speed - before.lateral_speed - across * dt) / share,
        )

    def _jump(self, t: float, row: PlanarRow) -> str:
        before = self._row
        if before is None:
            return ""
        if row.known and not before.known:
            return "heading found: started afresh"
        dt = t - self._t
        far = math.hypot(row.x - before.x, row.y - before.y)
        allowed = _JUMP + 1.5 * max(abs(row.speed), abs(before.speed)) * max(dt, 0.0)
        if far > allowed:
            return f"pose jumped by {far:.2f} m: started afresh"
        turn = abs(math.remainder(row.yaw - before.yaw, 2.0 * math.pi))
        if turn > _TURN + 3.0 * max(dt, 0.0):
            return f"pose turned by {math.degrees(turn):.0f} degrees at once: started afresh"
        return ""

    @property
    def findings(self) -> list[Finding]:
        """What is odd about the place."""
        row = self._row
        if row is None or not row.known or self.twin.road is None:
            return []
        c, s = math.cos(row.yaw), math.sin(row.yaw)
        wheels = self.twin.vehicle.wheel_positions
        x = row.x + c * wheels[:, 0] - s * wheels[:, 1]
        y = row.y + s * wheels[:, 0] + c * wheels[:, 1]
        off = 4 - int(np.count_nonzero(self.road.inside(x, y)))
        if not off:
            return []
        text = f"{off} of 4 wheels are beside the road of the twin file: check the datum and the road's place"
        return [Finding("warn", "off_road", text)]
