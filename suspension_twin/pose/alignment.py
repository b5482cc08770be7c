# SPDX-License-Identifier: Apache-2.0
"""Alignment of the live filter: the vertical, standstill, the first yaw, and the planar inputs of each sample."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.pose.ekf import (
    ANTENNA_X,
    ANTENNA_Y,
    FORWARD_FORCE,
    LATERAL_SPEED,
    SPEED,
    YAW,
    planar_row,
)
from suspension_twin.pose.types import SLOPE_TIME, SWAY_SIGMA
from suspension_twin.signals.attitude import up_step
from suspension_twin.signals.imu import (
    MAX_TILT_DIFFERENCE,
    StillLimits,
    standstill_filter_step,
)
from suspension_twin.vehicle.twin import Place

__all__ = [
    "LEVEL_PULL",
    "LEVEL_WALK",
    "MOVING_PULL",
    "MOVING_WALK",
    "LiveInputs",
    "MovingLevel",
]

#: m/s²: what braking and bends add to gravity where the specific force of a moving vehicle is taken for the vertical,
#: and what an alignment leaves of it (0.02 rad). Priors, by hand: ordinary driving; the bias that was assumed before.
MOVING_PULL, LEVEL_PULL = 3.0, 0.2
#: (m/s²)²/s by which that wanders in body axes: a vertical that is off stays behind while the vehicle turns, here by
#: 0.4 rad/s.
MOVING_WALK = (0.4 * MOVING_PULL) ** 2
#: s that an alignment takes: bumps average out, and the gyro's bias does not show yet; and its velocities at least.
#: Tolerances, by hand.
_SHORTEST, _LONGEST = 1.0, 20.0
_FEWEST = 4
_STEP = 0.005  # s between the stamps at which the integrals are kept (tolerance, by hand)
_LENGTH = 0.2  # of gravity by which the result may miss it (tolerance, by hand)


class MovingLevel:
    """The vertical in body axes, from the specific force, the gyro and velocities over ground.

    In the axes that the body had when it began, the integral of the specific force is the gain of velocity and
    gravity's reaction: ``∫ R f dt = v(t) - v(0) + g up t``. A straight line through its difference from the measured
    velocities has the slope ``g up``; the residuals give the standard deviation of the velocities.

    Parameters
    ----------
    arm : (3,) array
        From the IMU to the antenna in body axes, m.
    """

    def __init__(self, arm: Floats) -> None:
        self._arm = arm
        self.begin()

    def begin(self) -> None:
        """Forget everything."""
        self._turn = np.eye(3)  # from body axes to those when it began
        self._pull = np.zeros(3)  # integral of the IMU's specific force in these, m/s
        self._kept: deque[tuple[float, Floats, Floats]] = deque()
        self._seen: deque[_Velocity] = deque()

    def add(self, t: float, sample: Floats, dt: float) -> None:
        """A sample (6,), specific force m/s² and angular rate rad/s in body axes, ``dt`` s after the last."""
        self._turn = self._turn @ Rotation.from_rotvec(sample[3:] * dt).as_matrix()
        self._pull = self._pull + self._turn @ sample[:3] * dt
        if not self._kept or t - self._kept[-1][0] >= _STEP:
            # turning, the antenna moves against the IMU
            swing = self._turn @ np.cross(sample[3:], self._arm)
            self._kept.append((t, self._pull + swing, self._turn))
            while t - self._kept[0][0] > _LONGEST:
                self._kept.popleft()

    def velocity(self, t: float, east: float, north: float, sigma: float, gravity: float) -> Floats | None:
        """A velocity in m/s, ``sigma`` m/s its standard deviation at least. Up (3,) in the body
        axes of the newest sample once it is known, else None. Velocities come in the order of their stamps."""
        here = self._at(t)
        if here is None or (self._seen and t <= self._seen[-1].t):
            return None
        self._seen.append(_Velocity(t, east, north, sigma, *here))
        while t - self._seen[0].t > _LONGEST:
            self._seen.popleft()
        if len(self._seen) < _FEWEST or t - self._seen[0].t < _SHORTEST:
            return None
        level, spread = _line(self._seen)
        length = float(np.linalg.norm(level))
        if spread > 0.5 * LEVEL_PULL or not abs(length / gravity - 1.0) < _LENGTH:
            return None
        found: Floats = self._turn.T @ level / length
        return found

    def _at(self, t: float) -> tuple[Floats, Floats] | None:
        """The integral and the turn at ``t`` s, None before the first sample."""
        if not self._kept or t < self._kept[0][0] - _STEP:
            return None
        after = next((k for k, kept in enumerate(self._kept) if kept[0] >= t), None)
        if after is None or after == 0:
            _, pull, turn = self._kept[-1 if after is None else 0]
            return pull, turn
        (t0, pull0, turn0), (t1, pull1, turn1) = self._kept[after - 1], self._kept[after]
        share = (t - t0) / (t1 - t0)
        return pull0 + share * (pull1 - pull0), turn0 if share < 0.5 else turn1


class _Velocity(NamedTuple):
    """A velocity over ground, m/s, with the integral (3,) and the turn (3, 3) of its time."""

    t: float
    east: float
    north: float
    sigma: float
    pull: Floats
    turn: Floats


def _line(seen: Sequence[_Velocity]) -> tuple[Floats, float]:
    """Slope (3,) of the line, m/s², and the standard deviation of its horizontal parts."""
    t = np.array([v.t for v in seen])
    over_ground = np.array([complex(v.east, v.north) for v in seen])
    pull, nose = np.array([v.pull for v in seen]), np.array([v.turn[:, 0] for v in seen])
    t = t - t.mean()
    level = t @ pull / (t @ t)
    for _ in range(3):  # where ahead and left lie depends on up a little
        up = level / np.linalg.norm(level)
        x = np.array([1.0, 0.0, 0.0]) - up[0] * up
        x /= np.linalg.norm(x)
        y = np.cross(up, x)
        turned = nose @ x + 1j * (nose @ y)
        yaw = np.sum(over_ground * turned.conj())
        ahead = over_ground * (yaw.conj() / max(abs(yaw), 1e-9))  # in the axes when it began
        rest = pull - np.outer(ahead.real, x) - np.outer(ahead.imag, y)
        level = t @ rest / (t @ t)
    off = (rest - rest.mean(axis=0) - np.outer(t, level)) @ np.array([x, y]).T
    sigma = max(math.sqrt(np.sum(off**2) / (2 * len(seen) - 4)), *(v.sigma for v in seen))
    return level, sigma / math.sqrt(t @ t)


GRAVITY = 9.81  # imu/data is free of bias to a few mm/s²; what is left goes to the filter's bias
#: s and rad between two fixes that a course is taken from, at most (tolerances, by hand: old enough that a receiver
#: with 2.5 m finds a car at 2 m/s, and so short a bend that it is an arc).
_COURSE_TIME, _COURSE_TURN = 10.0, 0.5
UP_TIME = 8.0  # s, the accelerometer's time constant against the gyro
#: (m/s²)²/s by which the accelerometer's bias wanders with a vertical that is off by ``LEVEL_PULL`` for ``UP_TIME``:
#: the density of a first-order Markov process, 2 σ² / τ.
LEVEL_WALK = 2.0 * LEVEL_PULL**2 / UP_TIME


@compiled
def _live_row(
    up: Floats,
    slow_up: Floats,
    up_bias: Floats,
    soft: Floats,
    mean: Floats,
    sample: Floats,
    speed: float,
    acceleration: float,
    sway: float,
    dt: float,
    gain: float,
    imu: Floats,
    antenna: Floats,
    out: Floats,
) -> None:  # pragma: no cover - compiled
    """Low-pass ``sample`` (6,), update ``up`` by the result less the vehicle's own planar acceleration, fill
    ``out`` (11,): the planar inputs, the antenna's sway in m/s, and the yaw rate without the low-pass; update
    the running mean and variance ``mean`` (12,) that standstill is judged by."""
    last = soft[2].copy()
    standstill_filter_step(soft, sample, dt)
    now = soft[2]
    faster = np.zeros(3)
    if dt > 0.0:
        for k in range(3):
            faster[k] = (now[3 + k] - last[3 + k]) / dt
    own = now[0:3].copy()
    turn = now[5] - up_bias[2]
    own[0] -= acceleration - turn * turn * imu[0] - faster[2] * imu[1]
    own[1] -= speed * turn + faster[2] * imu[0] - turn * turn * imu[1]
    up_step(up, up_bias, own, now[3:6], dt, GRAVITY, gain, 0.02)
    slow = min(1.0, dt / SLOPE_TIME)
    for k in range(3):
        slow_up[k] += slow * (up[k] - slow_up[k])
    rate = now[3:6] - up_bias
    planar_row(now[0:3], rate, faster, up, slow_up, sway, GRAVITY, imu, antenna, out)
    out[8], out[9] = rate[1] * antenna[2], -rate[0] * antenna[2]
    out[10] = 0.0
    for k in range(3):
        out[10] += (sample[3 + k] - up_bias[k]) * up[k]
    share = min(1.0, dt / 0.25)
    for k in range(6):
        off = now[k] - mean[k]
        mean[k] += share * off
        mean[6 + k] += share * (off * off - mean[6 + k])


class LiveInputs:
    """Turns samples into the planar filter's inputs and remembers what the first yaw needs."""

    def __init__(self, imu_place: Place, gps_place: Place) -> None:
        self._imu = np.array(imu_place.position)
        self._antenna = np.array(gps_place.position)
        self._limits = StillLimits()
        self._up = np.array([0.0, 0.0, 1.0])
        self._slow_up = self._up.copy()
        self._up_bias = np.zeros(3)
        #: Whether a standstill or an alignment in motion has shown the vertical since the last long gap.
        self.levelled = False
        self._moving_level = MovingLevel(self._antenna - self._imu)
        self._change: Floats | None = None
        self._sway_weight = 1.0 / SWAY_SIGMA**2
        self._sway_sum = self._sway_weight
        self._mean = np.zeros(12)
        self._soft = np.zeros((3, 6))
        self._t = math.nan
        self._omega = 0.0
        self._quiet_since = math.nan
        self.standing = False
        self._imu_speed = 0.0  # forward speed since standstill by integrating the accelerometer, m/s
        self._stood = -math.inf  # when it last stood, s
        self._velocity: tuple[float, float, float] | None = None
        self._velocity_sigma = math.nan
        self._heading: tuple[float, float] | None = None
        self._turned = 0.0  # rad since the start, by the gyro
        #: Fixes without a velocity: s, east and north m, standard deviation m, and how far the vehicle had turned, rad.
        self._fixes: deque[tuple[float, float, float, float, float]] = deque()
        self._fixed_course: tuple[float, float, float, float] | None = None

    def row(
        self,
        t: float,
        force: Sequence[float],
        rate: Sequence[float],
        own: tuple[float, float] | None,
        out: Floats,
    ) -> bool:
        """Fill ``out`` (11,) for a sample; ``own`` are speed m/s and acceleration m/s² by the filter, None while it is
        not aligned. True after a gap."""
        speed, acceleration = own or (0.0, 0.0)
        known = own is not None
        sample = np.array((*force, *rate), dtype=np.float64)
        dt = t - self._t
        gap = not dt < 0.25
        if gap:
            # The accelerometer sets the vertical anew, unless the gyro has carried it well so far.
            if not math.isfinite(dt) or dt > 2.0:
                aside = speed * sample[5] if known else 0.0
                self._set_up(sample[:3] - (0.0, aside, 0.0))
                self._begin_level()
            self._mean[:6] = self._soft[:] = sample
            self._mean[6:] = 1.0
            self._quiet_since = math.nan
            self._fixes.clear()  # how far it turned meanwhile is not known
        step = min(dt, 0.25) if math.isfinite(dt) else 0.0
        gain = (10.0 if self.standing else 1.0) / UP_TIME
        _live_row(
            self._up,
            self._slow_up,
            self._up_bias,
            self._soft,
            self._mean,
            sample,
            speed,
            acceleration,
            self._sway_sum / self._sway_weight,
            step,
            gain,
            self._imu,
            self._antenna,
            out,
        )
        if not self.levelled:
            self._moving_level.add(t, self._soft[2], step)
        self._t = t
        self._judge(t, speed, known)
        # The filter turns by the mean over the interval.
        omega = float(out[0])
        out[0] = omega if gap else 0.5 * (omega + self._omega)
        self._omega = omega
        self._turned += float(out[10]) * step
        out[2] = 1.0 if self.standing else 0.0
        out[3] = 1000.0 if gap else 1.0
        self._imu_speed = 0.0 if self.standing else self._imu_speed + float(out[1]) * step
        self._stood = t if self.standing else self._stood
        return gap

    def _judge(self, t: float, speed: float, known: bool) -> None:
        """Standing: quiet for half a second, no specific force off the vertical, and slow as far as known. One loud
        sample ends it. At the start it takes some three seconds: the variances have to become small first."""
        mean, limits = self._mean.tolist(), self._limits
        variance = max(mean[6], mean[7], mean[8])
        turning = max(mean[9], mean[10], mean[11])
        quiet = variance < limits.force**2 and turning < limits.rate**2
        quiet = quiet and max(abs(mean[3]), abs(mean[4]), abs(mean[5])) < limits.turn
        soft = self._soft[2].tolist()
        quiet = (
            quiet
            and abs(soft[0] - mean[0]) < 3.0 * limits.force
            and abs(soft[5] - mean[5]) < 2.5 * limits.rate
        )
        up = self._up.tolist()
        tilted = math.hypot(mean[0] / GRAVITY - up[0], mean[1] / GRAVITY - up[1]) >= MAX_TILT_DIFFERENCE
        # A vertical that nothing has confirmed may be wrong: then the velocity alone decides that the vehicle stands.
        recent = self._velocity is not None and t - self._velocity[0] <= 1.5
        doubtful = tilted and recent and not self.levelled
        quiet = quiet and (doubtful or not tilted) and (not known or abs(speed) < 0.3) and self._gps_slow(t)
        if not quiet:
            self._quiet_since = math.nan
            self.standing = False
        elif math.isnan(self._quiet_since):
            self._quiet_since = t
        else:
            self.standing = t - self._quiet_since >= limits.window
            if self.standing and doubtful:
                self._confirm(self._mean[:3])
            self.levelled |= self.standing

    def _gps_slow(self, t: float) -> bool:
        if self._velocity is None:
            return True
        at, east, north = self._velocity
        return t - at > 1.5 or math.hypot(east, north) < 0.3

    def learn_sway(self, state: Floats, row: Floats, z: tuple[float, float, float]) -> None:
        """Estimate the share of the antenna's sway (lever arm times roll and pitch rate) in its velocity ``z``: a
        receiver that averages shows less than all of it. ``state`` (8,), ``row`` (10,) at its stamp."""
        s = row[8:10].tolist()
        if math.hypot(*s) < 0.05:
            return
        yaw, speed, side = float(state[YAW]), float(state[SPEED]), float(state[LATERAL_SPEED])
        c, sn = math.cos(yaw), math.sin(yaw)
        share = self._sway_sum / self._sway_weight
        ahead = z[0] * c + z[1] * sn - speed - float(row[6]) + share * s[0]
        left = z[1] * c - z[0] * sn - side - float(row[7]) + share * s[1]
        if math.hypot(ahead, left) > 0.5 + 2.0 * math.hypot(*s):
            return
        variance = z[2] ** 2 + 0.05**2
        self._sway_weight += (s[0] ** 2 + s[1] ** 2) / variance
        self._sway_sum += (s[0] * ahead + s[1] * left) / variance
        self._sway_sum = min(max(self._sway_sum, 0.0), 1.2 * self._sway_weight)

    # -- the first vertical -------------------------------------------------------------------

    @property
    def pull(self) -> float:
        """Standard deviation in m/s² of the forward specific force, by the vertical's."""
        return LEVEL_PULL if self.levelled else MOVING_PULL

    def level(self, t: float, east: float, north: float, sigma: float) -> None:
        """Find the vertical by a velocity in m/s, ``sigma`` m/s its standard deviation at least."""
        if self.levelled:
            return
        up = self._moving_level.velocity(t, east, north, sigma, GRAVITY)
        if up is not None:
            self._confirm(GRAVITY * up)

    def take_change(self) -> Floats | None:
        """(3,): what a vertical confirmed since the last call adds to the forward specific force, m/s², and to the
        antenna's place ahead and to the left, m; None where none was."""
        change, self._change = self._change, None
        return change

    def _begin_level(self) -> None:
        """The vertical is the specific force of a vehicle that may move."""
        self.levelled = False
        self._moving_level.begin()

    def _set_up(self, direction: Floats) -> None:
        """The vertical is along ``direction`` (3,), unless that is next to nothing."""
        length = float(np.linalg.norm(direction))
        if length > 1.0:
            self._up[:] = self._slow_up[:] = direction / length

    def _confirm(self, force: Floats) -> None:
        """The vertical is along ``force`` (3,), for good."""
        before = self._planar()
        self._set_up(force)
        self._change = (self._planar() - before)[[FORWARD_FORCE, ANTENNA_X, ANTENNA_Y]]
        self.levelled = True

    def _planar(self) -> Floats:
        """(8,) planar row of the low-passed sample under the vertical as it is."""
        row = np.zeros(8)
        share = self._sway_sum / self._sway_weight
        soft = self._soft[2]
        still = np.zeros(3)
        planar_row(
            soft[:3], soft[3:], still, self._up, self._slow_up, share, GRAVITY, self._imu, self._antenna, row
        )
        return row

    # -- the first yaw ------------------------------------------------------------------------

    def note_velocity(self, t: float, east: float, north: float, sigma: float = 0.05) -> None:
        """A GPS velocity in m/s and its standard deviation."""
        self._velocity = (t, east, north)
        self._velocity_sigma = sigma

    def forget_course(self) -> None:
        """Discard what gave the yaw so far: wait for new velocities."""
        self._velocity = None
        self._heading = None
        self._fixes.clear()
        self._fixed_course = None
        self._stood = -math.inf
        self._begin_level()

    @property
    def has_heading(self) -> bool:
        """Whether the first yaw is a heading's, and no course's."""
        return self._heading is not None

    def note_heading(self, t: float, yaw: float) -> None:
        """A heading in rad."""
        self._heading = (t, yaw)

    def note_fix(self, t: float, east: float, north: float, sigma: float) -> None:
        """A fix in m. Where no velocities come, the newest earlier one that is far enough away gives the course, which
        has turned on by half of the gyro's angle since then, and the speed."""
        fixes = self._fixes
        if self._velocity is not None or (fixes and t <= fixes[-1][0]):
            return
        while fixes and (self.standing or t - fixes[0][0] > _COURSE_TIME):
            fixes.popleft()
        for at, x, y, before, turned in reversed(fixes):
            dx, dy, spread = east - x, north - y, math.hypot(sigma, before)
            turn = self._turned - turned
            if abs(turn) > _COURSE_TURN:
                break
            far, time = math.hypot(dx, dy), t - at
            if far > max(1.0, 6.0 * spread):
                # an arc over its chord, for the speed
                arc = far * (0.5 * turn / math.sin(0.5 * turn) if abs(turn) > 1e-6 else 1.0)
                course = math.atan2(dy, dx) + 0.5 * turn
                self._fixed_course = (course, spread / far + 0.05, arc / time, spread / time + 0.5)
                speed = arc / (time * far)  # along the chord, half way
                self.level(0.5 * (at + t), speed * dx, speed * dy, spread / time)
                break
        fixes.append((t, east, north, sigma, self._turned))

    def course(self, least_speed: float) -> tuple[float, float, float, float] | None:
        """Yaw rad and its standard deviation, the signed speed m/s and its own, once they are known."""
        fixed = self._fixed_course
        if self._heading is not None:
            yaw = self._heading[1]
            if self._velocity is not None:
                _, east, north = self._velocity
                return yaw, 0.05, east * math.cos(yaw) + north * math.sin(yaw), 0.5
            if self.standing:
                return yaw, 0.05, 0.0, 0.5
            if fixed is not None:
                return yaw, 0.05, fixed[2] * math.cos(fixed[0] - yaw), fixed[3]
            return self._heading_alone(yaw)
        if self._velocity is not None:
            _, east, north = self._velocity
            speed = math.hypot(east, north)
            if speed < least_speed:
                return None
            course, sigma_yaw, sigma_speed = (
                math.atan2(north, east),
                2.0 * self._velocity_sigma / speed + 0.02,
                0.5,
            )
        elif fixed is not None:
            course, sigma_yaw, speed, sigma_speed = fixed
        else:
            return None
        # By the accelerometer the speed since a recent standstill is negative: the vehicle reverses.
        if self._t - self._stood < 10.0 and self._imu_speed < -0.4 * speed:
            return course + math.pi, sigma_yaw, -speed, sigma_speed
        return course, sigma_yaw, speed, sigma_speed

    def _heading_alone(self, yaw: float) -> tuple[float, float, float, float] | None:
        """Yaw by the heading, and the speed by fixes too close for a course; None before there are two."""
        if len(self._fixes) < 2:
            return None
        (t0, x0, y0, s0, _), (t1, x1, y1, s1, _) = self._fixes[0], self._fixes[-1]
        speed = ((x1 - x0) * math.cos(yaw) + (y1 - y0) * math.sin(yaw)) / (t1 - t0)
        return yaw, 0.05, speed, math.hypot(s0, s1) / (t1 - t0) + 0.5
