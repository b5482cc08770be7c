# SPDX-License-Identifier: Apache-2.0
"""The live pose: every sample and measurement as it comes, a delayed one at its own stamp, an output without steps."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.pose import ekf
from suspension_twin.pose.alignment import LEVEL_WALK, MOVING_WALK, LiveInputs
from suspension_twin.pose.ekf import SPEED, YAW, X, Y
from suspension_twin.pose.history import History, Measurement
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.types import REVERSE_SPEED, REVERSE_TIME, VELOCITY_SHARE, PoseSettings, fix_sigma
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.clock import JUMP_BACK, MAX_STAMP
from suspension_twin.signals.imu import STANDSTILL_FILTER_DELAY
from suspension_twin.vehicle.twin import Datum, Place

__all__ = [
    "Blend",
    "PlanarMotion",
    "PlanarState",
    "PoseLock",
    "VelocityNoise",
]


class Blend:
    """Offsets between the output and the filter's state: x, y, yaw and speed.

    Each dies away like a critically damped second-order system of ``time`` s, so the output has no
    step in position and, from a correction of the speed, none in velocity. A correction of the
    position alone moves it at ``speed`` m/s at most; one beyond ``snap`` m is jumped at once.
    """

    def __init__(self, time: float, speed: float, snap: float) -> None:
        self._time = time
        self._speed = speed
        self._snap = snap
        self.clear()

    def clear(self) -> None:
        """The output is the filter's state."""
        self._offset = [0.0, 0.0, 0.0, 0.0]
        self._rate = [0.0, 0.0, 0.0]
        self._slow = self._time  # s, of the position
        self._t = math.nan

    def correct(self, before: Floats, after: Floats) -> None:
        """The filter's newest state was ``before`` (8,) and is now ``after`` (8,)."""
        offset = self._offset
        offset[0] += float(before[X] - after[X])
        offset[1] += float(before[Y] - after[Y])
        offset[2] += float(before[YAW] - after[YAW])
        offset[3] += float(before[SPEED] - after[SPEED])
        c0, s0 = math.cos(before[YAW]), math.sin(before[YAW])
        c1, s1 = math.cos(after[YAW]), math.sin(after[YAW])
        self._rate[0] += float(before[SPEED] * c0 - after[SPEED] * c1)
        self._rate[1] += float(before[SPEED] * s0 - after[SPEED] * s1)
        length = math.hypot(offset[0], offset[1])
        # The largest speed of the decay is offset / time / e.
        self._slow = max(self._time, length / (math.e * self._speed))
        if length > self._snap or abs(offset[2]) > 0.5:
            self.clear()

    def step(self, t: float) -> tuple[float, float, float, float]:
        """Offsets of x m, y m, yaw rad and speed m/s to add at ``t`` s."""
        dt = min(t - self._t, 0.2) if math.isfinite(self._t) else 0.0
        self._t = t
        if dt > 0.0:
            for k in range(3):
                w = 1.0 / (self._slow if k < 2 else self._time)
                x, v = self._offset[k], self._rate[k]
                fade = math.exp(-w * dt)
                linear = v + w * x
                self._offset[k] = (x + linear * dt) * fade
                self._rate[k] = (v - w * linear * dt) * fade
            self._offset[3] *= math.exp(-dt / self._time)
        x, y, yaw, v = self._offset
        return x, y, yaw, v


#: Velocities that an estimate rests on, at least and at most; the standard deviations of the least that it may be; and
#: m/s off the filter's, beyond which it is the filter that is wrong (tolerances, by hand).
_FEWEST, _MOST, _LARGEST, _WRONG = 10, 60, 10.0, 2.0


class VelocityNoise:
    """Innovation-based estimate of a velocity's standard deviation.

    Ahead, a velocity differs from the filter's by the noise of both: ``median |r| / 0.6745`` squared less the variance
    of the filter's speed is the receiver's variance. Across, slip would count as noise.

    Parameters
    ----------
    least : float
        m/s that a receiver is not better than.
    """

    def __init__(self, least: float) -> None:
        self._given = self._least = least
        self._off: deque[float] = deque(maxlen=_MOST)
        self._spread: deque[float] = deque(maxlen=_MOST)
        self.sigma = least

    def by_fixes(self, sigma: float) -> None:
        """The receiver's fixes have a standard deviation of ``sigma`` m: its velocities are not much better."""
        self._least = max(self._given, VELOCITY_SHARE * sigma)
        self.sigma = max(self.sigma, self._least)

    def see(self, state: Floats, covariance: Floats, row: Floats, z: Measurement) -> None:
        """A velocity ``z``, the filter's ``state`` (8,) and ``covariance`` (8, 8) before it, and its inputs ``row``."""
        yaw = float(state[ekf.YAW])
        expected = float(state[ekf.SPEED] + row[ekf.ANTENNA_VX])
        off = abs(z[0] * math.cos(yaw) + z[1] * math.sin(yaw) - expected)
        if off > _WRONG:
            return
        self._off.append(off)
        self._spread.append(float(covariance[ekf.SPEED, ekf.SPEED]))
        if len(self._off) >= _FEWEST:
            variance = (median(self._off) / 0.6745) ** 2 - median(self._spread)
            sigma = math.sqrt(max(variance, 0.0))
            self.sigma = min(max(sigma, self._least), _LARGEST * self._least)


LATE = 0.5  # s from its stamp to its arrival, from which a fix is late
AHEAD = 5.0  # s that a fix may be ahead of the IMU and still wait for it
PAUSE = 60.0  # s after which nothing is left of the pose
MAX_FORCE, MAX_TURN = 2000.0, 200.0  # m/s² and rad/s that no sensor of a vehicle sends


class PlanarMotion(NamedTuple):
    """Motion in the plane, axes of ``base_link``: speeds m/s, yaw rate rad/s, accelerations of the path m/s², NaN where
    they are not known."""

    speed: float = 0.0
    lateral_speed: float = 0.0
    yaw_rate: float = 0.0
    ax: float = 0.0
    ay: float = 0.0


class PlanarState(NamedTuple):
    """The pose of ``base_link`` in ``map`` at ``t`` s: m, rad. ``aligned`` False while the yaw is not known, ``valid``
    False then and while no fix supports the pose; ``covariance``: the upper triangle xx, xy, x-yaw, yy, y-yaw,
    yaw-yaw in m², m rad, rad²."""

    t: float
    x: float
    y: float
    yaw: float
    motion: PlanarMotion
    aligned: bool
    valid: bool
    covariance: tuple[float, float, float, float, float, float]


class PoseLock:
    """The live pose: GNSS and IMU fused to x, y and yaw of ``base_link`` at the rate of the IMU.

    Give it every sample of ``imu/data`` and every fix, velocity and heading, in any order of arrival. A
    delayed fix is used at its own stamp; the output takes corrections over gradually. A stamp set back by
    more than a second resets everything. No message raises an error.

    Parameters
    ----------
    settings : PoseSettings, optional
        Noise, gates and time constants.
    gps_place : Place, optional
        Position of the antenna in ``base_link``.
    datum : Datum, optional
        Origin of ``map``; the first fix by default.
    imu_place : Place, optional
        Position and mounting of the IMU.
    imu_turn : tuple of float, optional
        Roll, pitch and yaw in rad by which the sensor is turned beyond its mounting.
    imu_gain : float
        Gain of the specific force that it reads.

    Examples
    --------
    >>> lock = PoseLock()
    >>> lock.on_fix(0.0, 47.4, 19.2, 110.0)
    >>> states = [lock.on_imu(0.01 * k, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)) for k in range(1, 50)]
    >>> states[-1].valid  # not before the vehicle has moved: its yaw is not known
    False
    """

    def __init__(
        self,
        settings: PoseSettings | None = None,
        gps_place: Place | None = None,
        datum: Datum | None = None,
        imu_place: Place | None = None,
        imu_turn: tuple[float, float, float] | None = None,
        imu_gain: float = 1.0,
    ) -> None:
        self.settings = settings or PoseSettings()
        self._gps = gps_place or Place(frame="gps_link")
        self._imu = imu_place or Place()
        self._turn = None if imu_turn is None else rpy_matrix(imu_turn)
        self._gain = imu_gain
        self._given_datum = datum
        self._filter_delay = self.settings.imu_delay + STANDSTILL_FILTER_DELAY
        self._walk = max(self.settings.force_bias_walk, LEVEL_WALK)
        self._history = History(self.settings.history, self.settings.noise())
        self.reset()

    def reset(self) -> None:
        """Forget everything but the settings and a datum given."""
        self.counts: Counter[str] = Counter()
        self._map = LocalMap(self._given_datum) if self._given_datum else None
        self._live = LiveInputs(self._imu, self._gps)
        self._blend = Blend(self.settings.blend, self.settings.blend_speed, self.settings.snap)
        self._noise = VelocityNoise(self.settings.velocity_sigma)
        self._history.clear()
        self._aligned = False
        self._waiting: list[tuple[float, int, Measurement]] = []
        self._refused = 0
        self._refused_since = math.nan
        self._misled = 0
        self._backwards_since = math.nan
        self._last_good_fix = -math.inf
        self._last_fix = -math.inf
        self._place: tuple[float, float, float, float] | None = None
        self._fix_latency = math.nan
        #: Standard deviation in m of the newest fix, NaN before it.
        self.fix_accuracy = math.nan
        #: s by which the receiver is late beyond its stamps.
        self.lateness = 0.0

    @property
    def datum(self) -> Datum | None:
        """The origin of ``map``: as given, else the first fix, else None."""
        return self._map.datum if self._map else None

    def set_datum(self, datum: Datum) -> None:
        """Move the origin of ``map``; the lock starts anew."""
        self._given_datum = datum
        self.reset()

    @property
    def latency(self) -> float:
        """How old fixes are when they arrive, in s on the IMU's clock, averaged; NaN before the first."""
        return self._fix_latency

    @property
    def fix_age(self) -> float:
        """Seconds from the newest fix to the newest IMU sample; inf where there is none."""
        return self._now() - self._last_fix if self._history.head >= 0 else math.inf

    @property
    def aligned(self) -> bool:
        """Whether the yaw is known."""
        return self._aligned

    @property
    def standing(self) -> bool:
        """Whether the vehicle stands."""
        return self._live.standing

    @property
    def findings(self) -> list[Finding]:
        """Reasons why the pose is not locked or not reliable."""
        if self._history.head < 0:
            return [Finding("warn", "no_imu", "no IMU samples yet: is imu/data published?")]
        found = []
        if not math.isfinite(self._last_fix):
            text = "no GPS fix yet: is fix published, does the receiver see the sky?"
            found.append(Finding("warn", "no_fix", text))
        elif self._aligned and self._now() - self._last_good_fix > self.settings.outage:
            gone = self._now() - self._last_good_fix
            found.append(Finding("error", "fix_lost", f"no usable GPS fix for {gone:.1f} s: the pose drifts"))
        if math.isfinite(self._last_fix) and not self._aligned:
            text = "the yaw is not known yet: drive off, or publish heading"
            found.append(Finding("warn", "not_aligned", text))
        ahead = f"fixes were stamped {AHEAD:g} s or more ahead of the IMU: do the clocks agree?"
        for count, code, text in (
            ("refused", "outliers", "fixes or velocities were refused as outliers"),
            ("too_late", "too_late", "fixes came too late to be used"),
            ("from_the_future", "from_the_future", ahead),
        ):
            if self.counts[count]:
                found.append(Finding("warn", code, f"{self.counts[count]} {text}"))
        if self._fix_latency > LATE:
            found.append(
                Finding("warn", "latency", f"fixes come {self._fix_latency:.2f} s after their stamps")
            )
        return found

    # -- what comes in ------------------------------------------------------------------------

    def on_imu(self, t: float, force: Sequence[float], rate: Sequence[float]) -> PlanarState | None:
        """One filtered sample in ``base_link`` axes, gravity kept. None before the first fix, and for a
        sample that is late, repeated or not finite."""
        # Each on its own: max() passes over a NaN that does not come first.
        usable = all(abs(f) < MAX_FORCE for f in force) and all(abs(w) < MAX_TURN for w in rate)
        if not (usable and abs(t) < MAX_STAMP):
            self.counts["invalid"] += 1
            return None
        if self._turn is not None:
            force, rate = (self._turn @ force).tolist(), (self._turn @ rate).tolist()
        if self._gain != 1.0:  # the excess of its vertical has gone with the bias at rest
            force = (force[0] / self._gain, force[1] / self._gain, force[2])
        t -= self._filter_delay  # what the low-passes let out now happened that long ago
        history = self._history
        if history.head >= 0:
            dt = t - history.stamp(history.head)
            if dt < -JUMP_BACK or dt > PAUSE:
                self.reset()
                self.counts["resets"] += 1
            elif dt <= 0.0:
                self.counts["late"] += 1
                return None
        own = None
        if self._aligned:
            before = history.state(history.head)
            own = float(before[ekf.SPEED]), float(before[ekf.ACCELERATION])
        row = history.append(t)
        if self._live.row(t, force, rate, own, row):
            self.counts["gaps"] += 1
            if self._aligned and not self._live.levelled:
                history.forget_bias(self._live.pull)
        history.let_bias_walk(self._walk if self._live.levelled else MOVING_WALK)
        if self._aligned:
            history.step()
            self._face_forward(t)
        self._relevel()
        if self._waiting:
            ready = sorted(w for w in self._waiting if w[0] <= t)
            self._waiting = [w for w in self._waiting if w[0] > t]
            for stamp, kind, z in ready:
                self._take(stamp, kind, z)
        state = self._output()
        if state is not None and not math.isfinite(state.x + state.y + state.yaw + sum(state.motion)):
            self.reset()
            self.counts["not_finite"] += 1
            return None
        return state

    def on_fix(
        self,
        t: float,
        latitude: float,
        longitude: float,
        altitude: float,
        status: int = 0,
        *sigmas: float,
    ) -> None:
        """One GPS fix: degrees, m; ``sigmas`` east and north in m, NaN or 0 where the receiver gives none."""
        sigma = fix_sigma(self.settings, status, *sigmas or (math.nan, math.nan))
        numbers = (t, latitude, longitude, sigma)
        if not all(map(math.isfinite, numbers)) or abs(latitude) > 90 or abs(longitude) > 180:
            self.counts["unusable"] += 1
            return
        if self._map is None:
            height = altitude if math.isfinite(altitude) and -1000 <= altitude <= 20_000 else 0.0
            self._map = LocalMap(Datum(latitude=latitude, longitude=longitude, altitude=height))
        height = altitude if math.isfinite(altitude) else self._map.datum.altitude
        east, north, _ = (float(c) for c in self._map.to_map(latitude, longitude, height))
        self.on_position(t, east, north, sigma)

    def on_position(self, t: float, east: float, north: float, sigma: float) -> None:
        """One position of the antenna in ``map`` in m, with a standard deviation of ``sigma`` m."""
        if not all(map(math.isfinite, (t, east, north, sigma))):
            self.counts["unusable"] += 1
            return
        if self._history.head >= 0:
            age = self._now() - t
            self._fix_latency = (
                age if math.isnan(self._fix_latency) else self._fix_latency + 0.1 * (age - self._fix_latency)
            )
        self._last_fix = max(self._last_fix, t)
        self.fix_accuracy = sigma
        self._noise.by_fixes(sigma)
        self._arrive(t - self.lateness, ekf.FIX, (east, north, sigma))

    def on_velocity(self, t: float, east: float, north: float) -> None:
        """One GPS velocity of the antenna in m/s."""
        if not all(map(math.isfinite, (t, east, north))) or math.hypot(east, north) > 150.0:
            self.counts["unusable"] += 1
            return
        self._arrive(t - self.lateness, ekf.VELOCITY, (east, north, self._noise.sigma))

    def on_heading(self, t: float, yaw: float, sigma: float = 0.0) -> None:
        """One heading: yaw of ``base_link`` in ``map`` in rad, with its standard deviation, 0 where it is not known."""
        if not (math.isfinite(t) and math.isfinite(yaw)):
            self.counts["unusable"] += 1
            return
        self._arrive(t, ekf.HEADING, (yaw, 0.0, sigma or self.settings.heading_sigma))

    # -- what it does -------------------------------------------------------------------------

    def _now(self) -> float:
        """The newest IMU stamp."""
        return self._history.stamp(self._history.head) + self._filter_delay

    def _arrive(self, t: float, kind: int, z: Measurement) -> None:
        head = self._history.head
        if head >= 0 and t <= self._history.stamp(head):
            self._take(t, kind, z)
        elif head < 0 or t - self._history.stamp(head) < AHEAD:
            # Ahead of the IMU: it waits for the samples.
            self._waiting = [*self._waiting[-63:], (t, kind, z)]
        else:
            self.counts["from_the_future"] += 1

    def _take(self, t: float, kind: int, z: Measurement) -> None:
        if kind == ekf.VELOCITY:
            self._live.note_velocity(t, *z)
            self._live.level(t, *z)
        elif kind == ekf.FIX and not (self._aligned and self._live.levelled):
            self._live.note_fix(t, *z)
        self._relevel()
        if not self._aligned:
            self._align(t, kind, z)
            return
        history = self._history
        first = history.before(t)
        if first < 0 or history.stamp(history.head) - t > self.settings.history:
            self.counts["too_late"] += 1
            return
        if kind == ekf.FIX and self._refused >= 3 and t - self._refused_since >= 1.0:
            kind = ekf.RESET  # refused for so long, it is the pose that is wrong
        elif kind == ekf.VELOCITY:
            state, row = history.state(first), history.inputs(first)
            self._live.learn_sway(state, row, z)
            self._noise.see(state, history.covariance(first), row, z)
        before = history.state(history.head).copy()
        weight = history.take(first, t, kind, z)
        self._blend.correct(before, history.state(history.head))
        self.counts["refused"] += weight == 0.0
        if kind == ekf.VELOCITY:
            self._misled = 0 if weight > 0.0 else self._misled + 1
            return
        if kind == ekf.HEADING:
            return
        if kind == ekf.RESET and self._misled >= 3:
            # Neither place nor velocity was right: the yaw is not.
            self._begin_again()
        if weight > 0.0:
            self._refused = 0
            self._last_good_fix = max(self._last_good_fix, t)
            self.counts["relocated"] += kind == ekf.RESET
        else:
            self._refused_since = t if self._refused == 0 else self._refused_since
            self._refused += 1

    def _align(self, t: float, kind: int, z: Measurement) -> None:
        """Wait for a fix and a yaw: from a heading, from the course, or from fixes apart."""
        if kind == ekf.HEADING:
            self._live.note_heading(t, z[0])
        elif kind == ekf.FIX:
            self._place = (t, *z)
        found = self._live.course(self.settings.align_speed)
        if self._place is None or found is None:
            return
        when, east, north, sigma = self._place
        history = self._history
        first = history.before(min(t, when))
        if first < 0:
            return
        yaw, yaw_sigma, speed, speed_sigma = found
        # A course is the antenna's, which turns about the rear axle; a heading is the vehicle's.
        if speed != 0.0 and not self._live.has_heading:
            yaw -= math.asin(max(-0.5, min(0.5, float(history.inputs(first)[7]) / speed)))
        c, s = math.cos(yaw), math.sin(yaw)
        ahead, left = history.inputs(first)[4:6]
        back = history.stamp(first) - when
        x = np.zeros(ekf.STATES)
        x[ekf.X] = east - (ahead * c - left * s) + back * speed * c
        x[ekf.Y] = north - (ahead * s + left * c) + back * speed * s
        x[ekf.YAW] = yaw
        x[ekf.SPEED] = speed
        place = sigma + 2.0 * speed_sigma * abs(back)
        history.state(first)[:] = x
        history.covariance(first)[:] = np.diag(
            np.array(
                [place, place, yaw_sigma, speed_sigma, max(1.0, self._live.pull), 0.1, 0.01, self._live.pull]
            )
            ** 2
        )
        self._aligned = True
        self._last_good_fix = when
        history.run(first)
        self._blend.clear()

    def _relevel(self) -> None:
        """Take a vertical that has just been confirmed into what the filter remembers."""
        change, history = self._live.take_change(), self._history
        if change is None or not self._aligned:
            return
        before = history.state(history.head).copy()
        history.let_bias_walk(self._walk)
        force, ahead, left = change.tolist()
        history.relevel(force, ahead, left, self._live.pull)
        self._blend.correct(before, history.state(history.head))

    def _face_forward(self, t: float) -> None:
        """Nothing on the road reverses this fast for this long: it was aligned the wrong way round."""
        if self._history.state(self._history.head)[ekf.SPEED] > -REVERSE_SPEED:
            self._backwards_since = math.nan
        elif math.isnan(self._backwards_since):
            self._backwards_since = t
        elif t - self._backwards_since > REVERSE_TIME:
            self._begin_again()

    def _begin_again(self) -> None:
        """The yaw proved wrong: wait for a new one."""
        self._aligned = False
        self._place = None
        self._misled = 0
        self._backwards_since = math.nan
        self._live.forget_course()
        self.counts["turned_round"] += 1

    def _output(self) -> PlanarState | None:
        history, delay = self._history, self._filter_delay
        t = history.stamp(history.head)
        if not self._aligned:
            if self._place is None:
                return None
            _, x, y, sigma = self._place
            unknown = (sigma**2, 0.0, 0.0, sigma**2, 0.0, math.pi**2)
            return PlanarState(t + delay, x, y, 0.0, PlanarMotion(), False, False, unknown)
        x, y, yaw, v, acceleration, side, gyro, _ = history.state(history.head).tolist()
        u = history.inputs(history.head)
        omega = 0.0 if u[2] > 0.5 else float(u[10]) - gyro
        dx, dy, dyaw, dv = self._blend.step(t)
        yaw += delay * omega + dyaw
        c, s = math.cos(yaw), math.sin(yaw)
        speed = v + delay * acceleration + dv
        p = history.covariance(history.head)
        return PlanarState(
            t + delay,
            x + delay * (v * c - side * s) + dx,
            y + delay * (v * s + side * c) + dy,
            yaw,
            PlanarMotion(speed, side, omega, acceleration, speed * omega),
            True,
            t - self._last_good_fix <= self.settings.outage,
            (
                float(p[0, 0]),
                float(p[0, 1]),
                float(p[0, 2]),
                float(p[1, 1]),
                float(p[1, 2]),
                float(p[2, 2]),
            ),
        )
