# SPDX-License-Identifier: Apache-2.0
"""The model at the stamps of the IMU: it follows the locked poses and is compared with the measured acceleration."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.inference.observation import road_of
from suspension_twin.live.gap import CalibrationGap, GapTiles, RunningGap, gap_warning
from suspension_twin.models.live import LiveState, live_twin
from suspension_twin.models.types import PoseSample
from suspension_twin.pose.ekf import planar_acceleration
from suspension_twin.pose.lock import PlanarMotion, PlanarState
from suspension_twin.pose.types import STANDING_SPEED
from suspension_twin.road.build import flat_road
from suspension_twin.road.road import Road
from suspension_twin.signals.attitude import Quaternion, quaternion, quaternion_product, rpy_matrix
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.filters import FilterSpec, LiveLowPass
from suspension_twin.vehicle.twin import Twin

__all__ = ["BodyAcceleration", "FollowSettings", "Followed", "Follower", "Pairing", "VirtualImu"]

#: A sample waits this long for a pose, and a pose is kept this long for samples: ns of the stamps.
_LIMIT = 2_000_000_000
#: A pose further than this from where the speed leads to is a jump, not a movement: m and rad.
_JUMP, _TURN = 0.5, 0.3
#: s between two looks at whether the wheels are on the road: a wheel's length at 30 km/h.
_LOOK = 0.1
#: m that a tyre's contact is long (prior: 4 kN over 220 kPa and a width of 0.16 m): shorter waves are felt little, at
#: any speed. Standard deviations of a place that are likely (prior).
_CONTACT, _LIKELY = 0.114, 3.0
#: m/s²: no vehicle's body; beyond it the model has diverged.
_HARDEST = 1e5
#: s, time constant of the crossover at 0.4 Hz from the acceleration of the path to that of the IMU.
_CROSSOVER = 1.0 / (2.0 * math.pi * 0.4)
#: Bandwidth of braking, steering, pitch and roll; above it a mount rings, which offline a Wiener filter removes.
#: A lower one delays the pitch, a higher one adds to the gap: at 3 Hz 4 % less error of the pitch and 0.4 % more gap
#: (measured on the bundled drives, against offline).
_PLANAR = FilterSpec(2, 2.5)

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class FollowSettings:
    """Comparison of the twin with its vehicle.

    ``filter`` is the low-pass of the simulated signal, that of the measured one; ``window`` s and ``edges`` Hz of the
    live gap and its bands; ``floor``, the residual of the calibration; ``warn``, the ratio to it from which there is a
    warning. ``acceleration_time`` s is the time constant with which the speeds of an odometry without accelerations are
    differentiated.
    """

    filter: FilterSpec = FilterSpec()
    window: float = 10.0
    edges: tuple[float, ...] = (0.5, 3.0, 8.0, 20.0)
    floor: CalibrationGap = CalibrationGap(0.0, 0.0)
    warn: float = 5.0
    acceleration_time: float = 0.1

    def gap(self) -> RunningGap:
        """A live gap as set. Raises InputError."""
        return RunningGap(self.window, self.edges, self.floor.rms)


class BodyAcceleration(NamedTuple):
    """Acceleration at the IMU's place in ``base_link`` axes, low-passed, gravity removed: ``linear`` m/s², ``angular``
    rad/s²."""

    linear: Vector
    angular: Vector = (0.0, 0.0, 0.0)


class Followed(NamedTuple):
    """The twin at one sample: the ``pose`` that it was given and the planar ``acceleration`` that excites it, its
    ``state``, the ``measured`` vertical acceleration and its own ``vertical_acceleration`` through the same low-pass,
    m/s², NaN where the model has diverged; ``event`` names a restart or a gap, else empty."""

    pose: PlanarState
    acceleration: tuple[float, float]
    state: LiveState
    measured: float
    vertical_acceleration: float
    event: str

    @property
    def orientation(self) -> Quaternion:
        """Of the body in ``map``."""
        return quaternion(self.state.roll, self.state.pitch, self.pose.yaw)


class VirtualImu(NamedTuple):
    """The virtual sensor, unfiltered, in the sensor's axes: m/s² with gravity, rad/s; ``orientation`` in ``map``."""

    force: Vector
    rate: Vector
    orientation: Quaternion


class PlanarAcceleration:
    """Complementary filter of the planar acceleration that excites the model, as offline: below 0.4 Hz the path's,
    above it the IMU's, taken to the height of the centre of gravity. ``lever`` m from there to the sensor.

    The IMU's is limited to the bandwidth of the body: the mount of a sensor on a roof rings above it, and the lever
    makes of every rad/s² as many m/s² as it is long.
    """

    def __init__(self, lever: tuple[float, float, float]) -> None:
        self._lever = lever
        self._bandwidth = LiveLowPass(_PLANAR), LiveLowPass(_PLANAR)
        self.reset()

    def reset(self) -> None:
        """Begin anew with the path's."""
        self._t = math.nan
        self._before: Vector | None = None
        self._offset: tuple[float, float] | None = None
        for one in self._bandwidth:
            one.reset()

    def step(
        self, t: float, sensed: BodyAcceleration, motion: PlanarMotion, path: tuple[float, float]
    ) -> tuple[float, float]:
        """m/s² ahead and to the left at ``t`` s, by the IMU, the yaw rate of the ``motion``, and the path's; the path's
        alone after a pause and while the vehicle stands, when the IMU has but noise."""
        dt, before = t - self._t, self._before
        self._t, self._before = t, sensed.linear
        if before is None or not 0.0 < dt < 0.25 or abs(motion.speed) < STANDING_SPEED:
            self._offset = None
            return path
        # the angular acceleration is that of the middle between two samples
        middle = 0.5 * (before[0] + sensed.linear[0]), 0.5 * (before[1] + sensed.linear[1])
        planar = planar_acceleration(middle, (0.0, 0.0, motion.yaw_rate), sensed.angular, self._lever)
        x, y = (one.push(t, value) for one, value in zip(self._bandwidth, planar, strict=True))
        ahead, left = self._offset or (path[0] - x, path[1] - y)
        share = dt / (_CROSSOVER + dt)
        ahead, left = ahead + share * (path[0] - x - ahead), left + share * (path[1] - y - left)
        self._offset = ahead, left
        return x + ahead, y + left


class Follower:
    """Follows the locked pose with the model of a twin file, and compares; raises InputError for a wrong file.

    Parameters
    ----------
    twin : Twin
        The twin; without a road it drives on a plane.
    settings : FollowSettings, optional
        Low-pass and live gap.
    road : Road, optional
        The road that the twin file names, where it has been read.
    """

    def __init__(self, twin: Twin, settings: FollowSettings | None = None, road: Road | None = None) -> None:
        self.twin = twin
        self.road: Road = road or (flat_road() if twin.road is None else road_of(twin))
        self._live = live_twin(twin, self.road)
        # compiled now, not at the first samples
        first, _ = (self._live.step(t, PoseSample(*[0.0] * 8)) for t in (0.0, 0.01))
        # The filter of the measured signal removes as a bias what a gain error makes of gravity.
        self._standing_vertical = first.vertical_acceleration if twin.effects else 0.0
        self._to_sensor: list[list[float]] = rpy_matrix(twin.imu.rpy).T.tolist()
        self._mounting = quaternion(*twin.imu.rpy)
        x, y, z = twin.imu.position
        self._planar = PlanarAcceleration((x, y, z - twin.cog_height))
        self.configure(settings or FollowSettings())

    def configure(self, settings: FollowSettings) -> None:
        """Take other settings; the twin starts anew."""
        self.settings = settings
        self.gap = settings.gap()
        self.tiles = GapTiles()
        self._low_pass = LiveLowPass(settings.filter)
        # Offline the low-pass runs forwards and backwards. Once more forwards it has the same gain at every frequency.
        self._again = LiveLowPass(settings.filter), LiveLowPass(settings.filter)
        #: Samples without a pose, which were not simulated.
        self.lost = 0
        self.reset()

    def reset(self) -> None:
        """Back to static equilibrium."""
        self._live.reset()
        self._reset_filters()
        self.gap.reset()
        self.tiles.reset()
        self._forget()

    def _reset_filters(self) -> None:
        for low_pass in (self._low_pass, *self._again):
            low_pass.reset()

    def _forget(self) -> None:
        self._t = math.nan
        self._pose: PlanarState | None = None
        self._rates = (0.0, 0.0)
        self._off, self._looked = 0, -math.inf
        #: When the place was last too uncertain for a comparison, and the m to which it was known, at worst.
        self._open = -math.inf, 0.0
        self._planar.reset()

    def step(self, t: float, pose: PlanarState, measured: BodyAcceleration) -> Followed:
        """Go on to ``pose`` at ``t`` s, ``measured`` by the IMU. After a jump of the pose the model
        restarts, as after a gap in time."""
        jump = self._jump(t, pose)
        if jump:
            self._live.reset()
            self._forget()
        speed, lateral_speed, yaw_rate, _, _ = pose.motion
        ax, ay = self._planar.step(t, measured, pose.motion, self._path(t, pose))
        self._t, self._pose = t, pose
        vertical = measured.linear[2]
        state = self._live.step(
            t, PoseSample(pose.x, pose.y, pose.yaw, speed, lateral_speed, yaw_rate, ax, ay)
        )
        event = jump or state.event
        if event:
            self.gap.restart(t)
        if not abs(state.vertical_acceleration) < _HARDEST:  # impossible poses
            self._live.reset()
            self._reset_filters()
            self.gap.restart(t)
            self._forget()
            return Followed(pose, (ax, ay), state, vertical, math.nan, "diverged: restarted")
        filtered = self._low_pass.push(t, state.vertical_acceleration - self._standing_vertical)
        again, once_more = self._again
        gap = again.push(t, vertical), once_more.push(t, filtered)
        self.gap.push(t, gap[0], gap[1], speed, self._on_road(t, pose))
        if pose.aligned and self.gap.settled:
            ahead, left, _ = self.twin.imu.position
            c, s = math.cos(pose.yaw), math.sin(pose.yaw)
            x, y = pose.x + c * ahead - s * left, pose.y + s * ahead + c * left
            self.tiles.push(x, y, state.z, vertical - filtered)
        return Followed(pose, (ax, ay), state, vertical, filtered, event)

    def _path(self, t: float, pose: PlanarState) -> tuple[float, float]:
        """Acceleration of the path in m/s²; where a pose has none, by the low-passed derivatives of its speeds."""
        motion, before = pose.motion, self._pose
        if not math.isnan(motion.ax):
            return motion.ax, motion.ay
        along, across = self._rates
        if before is not None and t > self._t:
            dt = t - self._t
            share = dt + self.settings.acceleration_time
            along += (motion.speed - before.motion.speed - along * dt) / share
            across += (motion.lateral_speed - before.motion.lateral_speed - across * dt) / share
            self._rates = along, across
        turn = motion.yaw_rate
        return along - turn * motion.lateral_speed, across + turn * motion.speed

    def _on_road(self, t: float, pose: PlanarState) -> bool:
        """Whether the pose is known and all wheels have a road under them, looked at ten times a second."""
        if not 0.0 <= t - self._looked < _LOOK:
            self._off, self._looked = self._wheels_off(pose), t
            self._look_at_place(t, pose)
        return pose.aligned and not self._off

    def _look_at_place(self, t: float, pose: PlanarState) -> None:
        """Note where the place along the road is not known to what the comparison resolves: three standard deviations
        beyond half the shortest wave."""
        xx, xy, _, yy, _, _ = pose.covariance
        c, s = math.cos(pose.yaw), math.sin(pose.yaw)
        sigma = math.sqrt(max(xx * c * c + 2.0 * xy * c * s + yy * s * s, 0.0))
        wave, (since, worst) = abs(pose.motion.speed) / self.settings.filter.cutoff, self._open
        if abs(pose.motion.speed) > STANDING_SPEED and _LIKELY * sigma > 0.5 * max(wave, _CONTACT):
            self._open = t, max(sigma, worst if t - since < self.settings.window else 0.0)

    def gap_warning(self) -> str:
        """The warning of a gap that has grown; else empty."""
        since, sigma = self._open
        place = sigma if self._t - since < self.settings.window else 0.0
        return gap_warning(self.gap.now(), self.settings.floor, self.settings.warn, place)

    def _wheels_off(self, pose: PlanarState) -> int:
        c, s = math.cos(pose.yaw), math.sin(pose.yaw)
        wheels = self.twin.vehicle.wheel_positions
        x = pose.x + c * wheels[:, 0] - s * wheels[:, 1]
        y = pose.y + s * wheels[:, 0] + c * wheels[:, 1]
        return int(np.count_nonzero(~self.road.inside(x, y)))

    def _jump(self, t: float, pose: PlanarState) -> str:
        before = self._pose
        if before is None:
            return ""
        if pose.aligned and not before.aligned:
            return "heading determined: restarted"
        dt = t - self._t
        far = math.hypot(pose.x - before.x, pose.y - before.y)
        if far > _JUMP + 1.5 * max(abs(pose.motion.speed), abs(before.motion.speed)) * max(dt, 0.0):
            return f"pose jumped by {far:.2f} m: restarted"
        turn = abs(math.remainder(pose.yaw - before.yaw, 2.0 * math.pi))
        if turn > _TURN + 3.0 * max(dt, 0.0):
            return f"pose jumped by {math.degrees(turn):.0f}° in yaw: restarted"
        return ""

    def virtual_imu(self, at: Followed) -> VirtualImu:
        """The sensor of the twin, at the place of the real one."""
        force, rate = self._in_sensor(at.state.force), self._in_sensor(at.state.rate)
        return VirtualImu(force, rate, quaternion_product(at.orientation, self._mounting))

    def _in_sensor(self, vector: Floats) -> Vector:
        (x, y, z), (a, b, c) = vector.tolist(), self._to_sensor
        return (
            a[0] * x + a[1] * y + a[2] * z,
            b[0] * x + b[1] * y + b[2] * z,
            c[0] * x + c[1] * y + c[2] * z,
        )

    @property
    def findings(self) -> list[Finding]:
        """Wheels beside the road, no road, a gap that has grown."""
        found, pose = [], self._pose
        if self.twin.road is None:
            text = "the twin file names no road: the twin drives on a plane, and the gap is that of the whole road"
            found.append(Finding("warn", "no_road", text))
        elif pose is not None and pose.aligned:
            off = self._wheels_off(pose)
            count = f"{off} of {len(self.twin.vehicle.wheel_positions)} wheels"
            text = f"{count} are outside the road file: check the datum and the position of the road"
            found += [Finding("warn", "off_road", text)] if off else []
        grown = self.gap_warning()
        return [*found, Finding("warn", "gap", grown)] if grown else found


class Pairing:
    """Pairs samples with poses by their stamps in ns, whatever order the two arrive in. A sample without a pose of its
    own stamp gets one interpolated between the two neighbours."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard everything that waits."""
        #: Samples that were dropped without a pose.
        self.lost = 0
        self._poses: deque[tuple[int, PlanarState]] = deque()
        self._samples: deque[tuple[int, BodyAcceleration]] = deque()
        self._last_sample = 0

    def pose(self, ns: int, pose: PlanarState) -> list[tuple[int, PlanarState, BodyAcceleration]]:
        """Add a pose; stamp, pose and value of the samples that can be paired now, in the order of time."""
        poses = self._poses
        if poses and ns <= poses[-1][0]:
            return []
        poses.append((ns, pose))
        while ns - poses[0][0] > _LIMIT:
            poses.popleft()
        return self._pair()

    def sample(self, ns: int, value: BodyAcceleration) -> list[tuple[int, PlanarState, BodyAcceleration]]:
        """Add a sample; as :meth:`pose`."""
        if ns <= self._last_sample:
            return []
        self._last_sample = ns
        self._samples.append((ns, value))
        if ns - self._samples[0][0] > _LIMIT:
            self._samples.popleft()
            self.lost += 1
        return self._pair()

    def _pair(self) -> list[tuple[int, PlanarState, BodyAcceleration]]:
        poses, samples, ready = self._poses, self._samples, []
        while samples and poses and samples[0][0] <= poses[-1][0]:
            ns, value = samples.popleft()
            if poses[-1][0] == ns:
                ready.append((ns, poses[-1][1], value))
                continue
            while len(poses) > 1 and poses[1][0] <= ns:
                poses.popleft()
            if poses[0][0] > ns:
                self.lost += 1  # from before the first pose
            else:
                ready.append((ns, _interpolated(poses[0], poses[1], ns), value))
        return ready


def _interpolated(before: tuple[int, PlanarState], after: tuple[int, PlanarState], ns: int) -> PlanarState:
    (start, a), (end, b) = before, after
    if start == ns:
        return a
    share = (ns - start) / (end - start)
    yaw = a.yaw + math.remainder(b.yaw - a.yaw, 2.0 * math.pi)
    ends = zip((a.x, a.y, a.yaw, *a.motion), (b.x, b.y, yaw, *b.motion), strict=True)
    x, y, yaw, *motion = (p + share * (q - p) for p, q in ends)
    known, sound = a.aligned and b.aligned, a.valid and b.valid
    return PlanarState(ns / 1e9, x, y, yaw, PlanarMotion(*motion), known, sound, a.covariance)
