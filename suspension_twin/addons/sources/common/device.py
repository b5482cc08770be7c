# SPDX-License-Identifier: Apache-2.0
"""One phone, receiver or IMU: accelerometer and gyroscope are paired, and its clock is watched."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from suspension_twin.addons.sources.common.clock import ArrivalClock
from suspension_twin.addons.sources.common.motion import MotionShift
from suspension_twin.arrays import Floats
from suspension_twin.drive.checks import measured
from suspension_twin.drive.types import FixData, HeadingData, ImuData, Samples, VelocityData

if TYPE_CHECKING:
    from suspension_twin.addons.sources.common.hub import Hub

__all__ = ["STREAMS", "Device", "Stream"]

Stream = Literal["imu", "fix", "vel", "heading"]
STREAMS: Final[dict[type, Stream]] = {
    ImuData: "imu",
    FixData: "fix",
    VelocityData: "vel",
    HeadingData: "heading",
}

#: A gyroscope sample further than this from an accelerometer sample, in s or periods, is not beside it (as imported).
_BESIDE, _BESIDE_PERIODS = 0.05, 2.5
#: A gyroscope is extrapolated by so many periods at the end of a batch rather than waited for.
_AHEAD = 1.05
#: Samples of one sensor that wait for the other, and s of past gyroscope samples that are kept.
_WAITING, _PAST = 4000, 2.0
#: Samples after which the period of a sensor is measured anew.
_MEASURED_EVERY = 25
#: s over which rates are counted.
_COUNTED_OVER = 2.0


class Device:
    """A device of a :class:`~suspension_twin.addons.sources.common.hub.Hub`.

    ``counts`` by kind: what was received, lost or refused. Stamps given to it are those of the device's clocks, of
    ``clock`` (IMU) and ``position_clock``; a source sets the latter to ``clock`` where it is the same one.
    """

    def __init__(self, hub: Hub, name: str, *, rank: int = 0, epoch: bool = True) -> None:
        self.hub = hub
        self.name = name
        self.rank = rank
        self.clock = ArrivalClock(epoch)
        self.own_position_clock = ArrivalClock()
        self.position_clock = self.own_position_clock
        self.counts: Counter[str] = Counter()
        #: Standard deviation east in m of the last fix, NaN while not known.
        self.accuracy = math.nan
        #: Latitude, longitude in degrees and height in m of the last fix.
        self.place: tuple[float, float, float] | None = None
        #: What the motion has said of its IMU's stamps.
        self.motion: MotionShift | None = None
        #: The host's time in s when it was first heard of.
        self.since = hub.now()
        self._force = _Buffer()
        self._rate = _Buffer()
        self._recent: dict[str, deque[tuple[float, int]]] = {}
        self._steps = 0

    # For sources

    def force(self, t: Floats, values: Floats, arrival: float, *, checked: bool = False) -> None:
        """Specific force (n, 3) in m/s² at stamps (n,) s; :meth:`flush` hands it on with the angular rate.

        ``checked`` where every number is known to be one that can be measured.
        """
        self._force.add(*((t, values) if checked else self._usable(t, values, "accelerometer")), arrival)

    def rate(self, t: Floats, values: Floats, arrival: float, *, checked: bool = False) -> None:
        """Angular rate (n, 3) in rad/s at stamps (n,) s."""
        self._rate.add(*((t, values) if checked else self._usable(t, values, "gyroscope")), arrival)

    def flush(self, arrival: float, *, complete: bool) -> None:
        """Hand on the specific forces that have an angular rate beside them.

        ``complete`` says that a batch has ended: then the last samples are not kept until the next batch for the sake
        of a fraction of a period.
        """
        force, rate = self._force, self._rate
        if not force.t.size or rate.t.size < 2:
            self._give_up()
            return
        period = rate.period
        reach = float(rate.t[-1]) + (_AHEAD * period if complete else 0.0)
        ready = int(np.searchsorted(force.t, reach, side="right"))
        if not ready:
            self._give_up()
            return
        t, values = force.take(ready)
        if t[-1] == rate.t[-1] and np.array_equal(t, rate.t[-ready:]):  # both of one chip's queue
            rates = rate.values[-ready:]
            rate.forget(float(rate.t[-1]) - _PAST)
            self._emit(t, values, rates, arrival)
            return
        after = np.minimum(np.maximum(np.searchsorted(rate.t, t), 1), rate.t.size - 1)
        t0, t1 = rate.t[after - 1], rate.t[after]
        weight = ((t - t0) / (t1 - t0))[:, None]
        rates = (1.0 - weight) * rate.values[after - 1] + weight * rate.values[after]
        beside = np.minimum(np.abs(t - t0), np.abs(t1 - t)) <= max(_BESIDE, _BESIDE_PERIODS * period)
        if not beside.all():
            self.counts["accelerometer samples without a gyroscope"] += int(beside.size - beside.sum())
            t, values, rates = t[beside], values[beside], rates[beside]
        rate.forget(float(rate.t[-1]) - _PAST)
        self._emit(t, values, rates, arrival)

    def imu(self, t: Floats, force: Floats, rate: Floats, arrival: float) -> None:
        """Both at the same stamps (n,) s."""
        good = np.isfinite(t) & measured(force) & measured(rate)
        self.counts["values that are no measurement"] += int(good.size - good.sum())
        self._emit(t[good], force[good], rate[good], arrival)

    def fix(self, fix: FixData, arrival: float) -> None:
        """Positions, stamped by ``position_clock``."""
        with np.errstate(invalid="ignore"):
            good = np.isfinite(fix.t) & (np.abs(fix.latitude) <= 90) & (np.abs(fix.longitude) <= 180)
            good &= ~((fix.latitude == 0) & (fix.longitude == 0))  # what phones report before their first fix
            good &= np.abs(fix.altitude) < 1e5
        self.counts["fixes that are no place"] += int(good.size - good.sum())
        fix = fix.select(good)
        if not len(fix):
            return
        self.accuracy = float(fix.sigma[-1, 0])
        self.place = float(fix.latitude[-1]), float(fix.longitude[-1]), float(fix.altitude[-1])
        self._send(fix, self.position_clock, arrival)

    def velocity(self, velocity: VelocityData, arrival: float) -> None:
        """Velocities, stamped by ``position_clock``."""
        velocity = velocity.select(np.isfinite(velocity.t) & measured(velocity.enu))
        self._send(velocity, self.position_clock, arrival)

    def heading(self, heading: HeadingData, arrival: float) -> None:
        """Headings, stamped by ``position_clock``."""
        heading = heading.select(np.isfinite(heading.t) & np.isfinite(heading.yaw))
        self._send(heading, self.position_clock, arrival)

    # For who watches

    def last_arrival(self, stream: str) -> float:
        """The host's time in s when something of this stream came last; minus infinity before."""
        recent = self._recent.get(stream)
        return recent[-1][0] if recent else -math.inf

    def frequency(self, stream: str, now: float) -> float:
        """Samples a second of a stream over the last two seconds, or since it has come (again)."""
        recent = list(self._recent.get(stream, ()))
        seconds = max(self.counted(stream, now), 0.25 * _COUNTED_OVER)
        return sum(n for at, n in recent if at > now - _COUNTED_OVER) / seconds

    def counted(self, stream: str, now: float) -> float:
        """s over which :meth:`frequency` counts: less than two where the stream has just begun, or begun again."""
        recent = self._recent.get(stream)
        return min(now - recent[0][0], _COUNTED_OVER) if recent else 0.0

    def sensor_age(self, now: float) -> tuple[float, float]:
        """s since accelerometer and gyroscope samples came, those that are given apart; infinite before."""
        start = self.since if self._force.arrival + self._rate.arrival > -math.inf else now
        ages = [now - max(buffer.arrival, start) for buffer in (self._force, self._rate)]
        return ages[0], ages[1]

    # Inner workings

    def _usable(self, t: Floats, values: Floats, what: str) -> tuple[Floats, Floats]:
        good = np.isfinite(t) & measured(values)
        if good.all():
            return t, values
        self.counts[f"{what} values that are no measurement"] += int(good.size - good.sum())
        return t[good], values[good]

    def _give_up(self) -> None:
        """Of a sensor whose partner is missing keep the newest."""
        lost = self._force.trim(_WAITING)
        self._rate.trim(_WAITING)
        if lost:
            self.counts["accelerometer samples without a gyroscope"] += lost

    def _emit(self, t: Floats, force: Floats, rate: Floats, arrival: float) -> None:
        if not t.size:
            return
        if t.size > 1 and (t[1:] < t[:-1]).any():
            order = np.argsort(t, kind="stable")
            t, force, rate = t[order], force[order], rate[order]
        self._send(ImuData(t, force, rate), self.clock, arrival)

    def _send(self, samples: Samples, clock: ArrivalClock, arrival: float) -> None:
        if not len(samples):
            return
        stream = STREAMS[type(samples)]
        self.counts[stream] += len(samples)
        recent = self._recent.setdefault(stream, deque())
        recent.append((arrival, len(samples)))
        while recent[0][0] < arrival - _COUNTED_OVER:
            recent.popleft()
        if stream == "imu" or (stream == "fix" and clock is not self.clock):
            steps = clock.steps
            steady = clock.push(samples.t, arrival)
            if clock.steps > steps:
                text = f"{self.name}: its clock stepped by {clock.last_step:+.2f} s, which is made up for"
                self.hub.say("warn", "clock step", text)
        else:
            steady = samples.t + clock.shift
        self.hub.put(self, replace(samples, t=steady), clock, arrival)


class _Buffer:
    """Samples of one sensor in rising order of their stamps."""

    def __init__(self) -> None:
        self.t = np.empty(0)
        self.values = np.empty((0, 3))
        self.period = 0.0
        self.arrival = -math.inf
        self._unmeasured = 0

    def add(self, t: Floats, values: Floats, arrival: float) -> None:
        if not t.size:
            return
        self.arrival = arrival
        rising = not self.t.size or t[0] > self.t[-1]
        rising &= t.size == 1 or bool((t[1:] > t[:-1]).all())
        new = int(t.size)
        t, values = np.concatenate([self.t, t]), np.concatenate([self.values, values])
        if not rising:
            order = np.argsort(t, kind="stable")
            fresh = np.diff(t[order], prepend=-math.inf) > 0
            t, values = t[order][fresh], values[order][fresh]
        self.t, self.values = t, values
        self._unmeasured += new
        if t.size > 1 and (self._unmeasured >= _MEASURED_EVERY or not self.period):
            self._unmeasured = 0
            self.period = float(np.median(np.diff(t[-2 * _MEASURED_EVERY :])))

    def take(self, count: int) -> tuple[Floats, Floats]:
        t, values = self.t[:count], self.values[:count]
        self.t, self.values = self.t[count:], self.values[count:]
        return t, values

    def forget(self, before: float) -> None:
        if self.t[0] < before:
            self.take(min(int(np.searchsorted(self.t, before)), self.t.size - 2))

    def trim(self, most: int) -> int:
        lost = max(self.t.size - most, 0)
        if lost:
            self.take(lost)
        return lost
