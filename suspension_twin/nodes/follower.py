# SPDX-License-Identifier: Apache-2.0
"""The model at the stamps of the IMU: samples are paired with poses by stamp, the model follows the poses."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from suspension_twin.inference.observation import road_of
from suspension_twin.models.live import LiveState, live_twin
from suspension_twin.models.types import PlanarMotion
from suspension_twin.nodes.topics import NS
from suspension_twin.road.build import flat_road
from suspension_twin.road.road import Road
from suspension_twin.signals.checks import Finding
from suspension_twin.vehicle.twin import Twin

__all__ = ["Follower", "Paired", "Pairing", "PlanarRow"]

#: A sample waits this long for a pose, and a pose is kept this long for samples: ns of the stamps.
_LIMIT = 2 * NS
#: A pose further than this from where the speed leads to is a jump, not a movement: m and rad.
_JUMP = 0.5
_TURN = 0.3


class PlanarRow(NamedTuple):
    """Planar motion of ``base_link`` at a stamp in ns: m, rad, m/s, rad/s; ``known`` is False while the yaw is not
    yet determined."""

    ns: int
    x: float
    y: float
    yaw: float
    speed: float
    lateral_speed: float
    yaw_rate: float
    known: bool


class Paired(NamedTuple):
    """A sample with its pose: ``row.ns`` is its stamp, ``measured`` its value."""

    row: PlanarRow
    measured: float


class Pairing:
    """Pairs samples with poses, whatever order the two topics arrive in. A sample without a pose of its own stamp
    gets one interpolated between the two neighbours."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard everything that waits."""
        #: Samples that were dropped without a pose.
        self.lost = 0
        self._rows: deque[PlanarRow] = deque()
        self._samples: deque[tuple[int, float]] = deque()
        self._last_sample = 0

    def pose(self, row: PlanarRow) -> list[Paired]:
        """Add a pose; the samples that can be paired now, in the order of time."""
        rows = self._rows
        if rows and row.ns <= rows[-1].ns:
            return []
        rows.append(row)
        while row.ns - rows[0].ns > _LIMIT:
            rows.popleft()
        return self._pair()

    def sample(self, ns: int, value: float) -> list[Paired]:
        """Add a sample; the samples that can be paired now, in the order of time."""
        if ns <= self._last_sample:
            return []
        self._last_sample = ns
        self._samples.append((ns, value))
        if ns - self._samples[0][0] > _LIMIT:
            self._samples.popleft()
            self.lost += 1
        return self._pair()

    def _pair(self) -> list[Paired]:
        rows, samples, ready = self._rows, self._samples, []
        while samples and rows and samples[0][0] <= rows[-1].ns:
            ns, value = samples.popleft()
            if rows[-1].ns == ns:
                ready.append(Paired(rows[-1], value))
                continue
            while len(rows) > 1 and rows[1].ns <= ns:
                rows.popleft()
            if rows[0].ns > ns:
                self.lost += 1  # from before the first pose
            else:
                ready.append(Paired(_interpolated(rows[0], rows[1], ns), value))
        return ready


def _interpolated(a: PlanarRow, b: PlanarRow, ns: int) -> PlanarRow:
    if a.ns == ns:
        return a
    share = (ns - a.ns) / (b.ns - a.ns)
    b = b._replace(yaw=a.yaw + math.remainder(b.yaw - a.yaw, 2.0 * math.pi))
    between = (p + share * (q - p) for p, q in zip(a[1:-1], b[1:-1], strict=True))
    return PlanarRow._make((ns, *between, a.known and b.known))


class Follower:
    """Follows the locked pose with the model of a twin file; raises InputError for a wrong one.

    The planar acceleration is the derivative of the speeds, low-passed with the time constant
    ``acceleration_time`` s: an odometry message carries no acceleration.
    """

    def __init__(self, twin: Twin, acceleration_time: float = 0.1) -> None:
        self.twin = twin
        self.road: Road = flat_road() if twin.road is None else road_of(twin)
        self.acceleration_time = acceleration_time
        self._live = live_twin(twin, self.road)
        # compiled now, not at the first samples
        first, _ = (self._live.step(t, PlanarMotion(*[0.0] * 8)) for t in (0.0, 0.01))
        #: m/s² that the virtual sensor shows at standstill: a gain error multiplies gravity too. The filter of the
        #: measured signal removes this as a bias.
        self.standing_vertical = first.vertical_acceleration if twin.effects else 0.0
        self.reset()

    def reset(self) -> None:
        """Back to static equilibrium."""
        self._live.reset()
        self._t = math.nan
        self._row: PlanarRow | None = None
        self._rates = (0.0, 0.0)

    def step(self, t: float, row: PlanarRow) -> LiveState:
        """Go on to ``row`` at ``t`` s. After a jump of the pose the model restarts, as after a gap in time."""
        jump = self._jump(t, row)
        if jump:
            self._live.reset()
            self._rates = (0.0, 0.0)
        elif self._row is not None and t > self._t:
            self._differentiate(t - self._t, self._row, row)
        along, across = self._rates
        self._t, self._row = t, row
        ax = along - row.yaw_rate * row.lateral_speed
        ay = across + row.yaw_rate * row.speed
        state = self._live.step(t, PlanarMotion(*row[1:-1], ax, ay))
        return replace(state, event=jump) if jump else state

    def _differentiate(self, dt: float, before: PlanarRow, row: PlanarRow) -> None:
        """Low-passed derivatives of the two speeds."""
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
            return "heading determined: restarted"
        dt = t - self._t
        far = math.hypot(row.x - before.x, row.y - before.y)
        if far > _JUMP + 1.5 * max(abs(row.speed), abs(before.speed)) * max(dt, 0.0):
            return f"pose jumped by {far:.2f} m: restarted"
        turn = abs(math.remainder(row.yaw - before.yaw, 2.0 * math.pi))
        if turn > _TURN + 3.0 * max(dt, 0.0):
            return f"pose jumped by {math.degrees(turn):.0f}° in yaw: restarted"
        return ""

    @property
    def findings(self) -> list[Finding]:
        """A warning where wheels are beside the road, or where there is none."""
        row = self._row
        if self.twin.road is None:
            text = "the twin file names no road: the twin drives on a plane, and the gap is that of the whole road"
            return [Finding("warn", "no_road", text)]
        if row is None or not row.known:
            return []
        c, s = math.cos(row.yaw), math.sin(row.yaw)
        wheels = self.twin.vehicle.wheel_positions
        x = row.x + c * wheels[:, 0] - s * wheels[:, 1]
        y = row.y + s * wheels[:, 0] + c * wheels[:, 1]
        off = int(np.count_nonzero(~self.road.inside(x, y)))
        if not off:
            return []
        text = f"{off} of {len(wheels)} wheels are outside the road file: check the datum and the position of the road"
        return [Finding("warn", "off_road", text)]
