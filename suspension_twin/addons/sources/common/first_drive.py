# SPDX-License-Identifier: Apache-2.0
"""The first drive with a new vehicle: what has to be driven before a calibration, and how far it is done.

Stand still, drive off, pass the bump. :class:`FirstDrive` is given the samples as they come, live or from a recording,
and tells the step that is next: it measures bias, tilt and noise while the vehicle stands, and recognises each pass of
the bump of the twin's road by its position.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import FixData, ImuData, Samples, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.inference.excited_segments import TrimSettings
from suspension_twin.inference.observation import road_of
from suspension_twin.models.registry import model_of
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road.road import Road
from suspension_twin.road.roughness import profile_events
from suspension_twin.signals.attitude import level_rpy, rpy_matrix
from suspension_twin.signals.checks import Finding, check_mounting
from suspension_twin.signals.imu import ImuSettings, standstill_mask, white_noise
from suspension_twin.units import STANDARD_GRAVITY
from suspension_twin.vehicle.twin import Datum, Twin

__all__ = ["PASSES", "FirstDrive", "Pass", "Standstill", "Step", "excited_part"]

#: Passes of the bump that are asked for: the bundled drive has as many, and identifies half of the dampers' points.
PASSES = 3
#: s of standstill that are asked for, and that are looked at for it. White noise of a phone's gyroscope (0.003 rad/s at
#: 100 Hz) leaves 2e-4 rad/s of the bias then.
_STILL, _WINDOW = 3.0, 4.0
#: Numerics of the look for a standstill: s of samples between two looks, samples of a look at least, and s between two
#: samples of one standstill at most.
_LOOK_EVERY, _FEWEST, _GAP = 0.5, 50, 0.25
_BACK = 1.0  # s by which stamps of one drive may go back: the same as for the nodes
_MEMORY = 120.0  # s of samples that are kept
_SETTINGS = TrimSettings()


@dataclass(frozen=True, eq=False)
class Standstill:
    """Readings of the IMU at rest.

    Parameters
    ----------
    end : float
        Stamp of its last sample in s.
    rate_bias : (3,) array
        Mean angular rate in rad/s, in the sensor's axes.
    force : (3,) array
        Mean specific force in m/s², by the twin file in axes of ``base_link``.
    force_noise : float
        Standard deviation of the white noise on an axis, m/s².
    mounting : Finding, optional
        What is wrong with the mounting by the twin file, or None.
    """

    end: float
    rate_bias: Floats
    force: Floats
    force_noise: float
    mounting: Finding | None

    def __str__(self) -> str:
        roll, pitch, _ = np.degrees(level_rpy(self.force))
        bias = float(np.linalg.norm(self.rate_bias))
        return (
            f"gyroscope bias {math.degrees(bias):.2f} °/s, tilt {roll:+.1f}° roll {pitch:+.1f}° pitch, "
            f"noise {self.force_noise:.3f} m/s²"
        )


@dataclass(frozen=True)
class Pass:
    """One pass of the bump: ``start`` and ``end`` s, ``speed`` m/s, and ``shock`` m/s², the largest deviation of the
    specific force from gravity."""

    start: float
    end: float
    speed: float
    shock: float

    def __str__(self) -> str:
        return f"{3.6 * self.speed:.1f} km/h, shock {self.shock:.1f} m/s²"


@dataclass(frozen=True)
class Step:
    """One step for the driver: ``state`` of it, and what to do or what came out of it."""

    name: Literal["stand", "drive", "bump"]
    title: str
    state: Literal["done", "now", "later"]
    text: str


def excited_part(road: Road, sides: tuple[float, ...] = (0.0,)) -> tuple[float, float]:
    """Where along a road its events (bumps, holes) begin and end.

    Parameters
    ----------
    road : Road
        The road.
    sides : tuple of float
        Lateral offsets v of the wheel paths in m.

    Returns
    -------
    tuple of float
        First and last place u in m; those of the whole road if no event stands out of its roughness.

    Raises
    ------
    InputError
        The road is level, or too short.

    Examples
    --------
    >>> from suspension_twin.road import bump_road, half_sine
    >>> first, last = excited_part(bump_road(half_sine(0.9, 0.05), at=20.0, length=40.0))
    >>> 19.0 < first < last < 21.0
    True
    """
    at = np.arange(road.u_first, road.u_last, road.u_step)
    profiles = [road.heights_uv(at, np.full_like(at, v)) for v in sides]
    if all(float(np.ptp(z)) == 0.0 for z in profiles):
        raise InputError("road", f"{road.name} is level: there is nothing on it that excites a suspension")
    events = [event for z in profiles for event in profile_events(z, road.u_step, road.u_first)]
    if not events:
        return float(road.u_first), float(road.u_last)
    return min(e.start for e in events), max(e.end for e in events)


class FirstDrive:
    """The state of a first drive, from its samples.

    Parameters
    ----------
    twin : Twin
        Places of the sensors, datum, road and wheels.
    passes : int
        Passes of the bump that are asked for.

    Raises
    ------
    InputError
        The twin is none that is driven on a road, or its road cannot be used.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> guide = FirstDrive(load_twin("bags/bump_15kmh/twin.yaml"))
    >>> drive = read_drive("bags/bump_15kmh")
    >>> for samples in (drive.fix, drive.velocity, drive.imu):
    ...     guide.add(samples)
    >>> guide.done, [round(3.6 * p.speed) for p in guide.passes]
    (True, [15, 15, 15])
    """

    def __init__(self, twin: Twin, passes: int = PASSES) -> None:
        if model_of(twin).recordings != "drive":
            raise InputError("twin", "model", f"{twin.model} is not driven on a road with an IMU")
        self._twin, self._wanted = twin, passes
        self._road = road_of(twin)
        wheels = np.array([joint.origin for joint in twin.joints])
        self._length = float(np.ptp(wheels[:, 0]))
        self._first, self._last = excited_part(self._road, tuple(sorted(set(wheels[:, 1].tolist()))))
        self._datum = twin.datum
        self._turn = rpy_matrix(twin.imu.rpy)
        self._begin()

    def _begin(self) -> None:
        """Nothing has been driven yet."""
        self._window: list[ImuData] = []
        self._lengths: deque[tuple[Floats, Floats]] = deque()  # stamps and lengths of the specific force
        self._speeds: deque[tuple[Floats, Floats]] = deque()
        self._looked = self._newest = -math.inf
        self._still_for = 0.0
        self._course = math.nan
        self._seen: tuple[float, float] | None = None  # and the position that it is taken from
        self._side, self._left = 0, math.nan  # of the bump on which the vehicle last was, and until when
        self._crossed: list[tuple[float, float]] = []
        self._distance = math.nan
        #: What the standstill showed, once it is over.
        self.standstill: Standstill | None = None
        #: Passes so far.
        self.passes: list[Pass] = []
        #: Standard deviation in m of the last position, NaN while unknown.
        self.position_sigma = math.nan

    @property
    def done(self) -> bool:
        """All has been driven, and the oscillation behind the last pass has had time to decay."""
        return len(self.passes) >= self._wanted and self._newest > self.passes[-1].end + _SETTINGS.after

    @property
    def moved(self) -> bool:
        """The vehicle has driven off after its standstill."""
        if self.standstill is None:
            return False
        end = self.standstill.end
        return bool(self.passes) or any(
            bool(np.any((t > end) & (v > _SETTINGS.slowest))) for t, v in self._speeds
        )

    @property
    def speed(self) -> float:
        """Speed over ground in m/s, NaN while unknown."""
        return float(self._speeds[-1][1][-1]) if self._speeds else math.nan

    def steps(self) -> tuple[Step, Step, Step]:
        """The steps in their order, each with what to do or what came out of it."""
        still, moved, left = self.standstill, self.moved, self._wanted - len(self.passes)
        times = "once" if self._wanted == 1 else f"{self._wanted} times"
        passed = "; ".join(map(str, self.passes))
        where = _away(self._distance)
        speed = f", {3.6 * self.speed:.0f} km/h" if math.isfinite(self.speed) else ""
        return (
            Step(
                "stand",
                "Stand still",
                "now" if still is None else "done",
                f"{self._still_for:.1f} of {_STILL:g} s" if still is None else str(still),
            ),
            Step(
                "drive",
                "Drive off",
                "done" if moved else "later" if still is None else "now",
                "the vehicle has moved" if moved else f"towards the bump, {where}{speed}",
            ),
            Step(
                "bump",
                f"Pass the bump {times}",
                "done" if left <= 0 else "now" if moved else "later",
                (f"pass {len(self.passes) + 1}: {where}{speed}" if moved else "straight, at constant speed")
                + (f"; done: {passed}" if passed else "")
                if left > 0
                else passed,
            ),
        )

    def add(self, samples: Samples) -> None:
        """Take samples of any kind. Each kind comes in the order of its stamps; IMU samples may come first or last."""
        if isinstance(samples, ImuData):
            good = np.isfinite(samples.t) & np.isfinite(samples.specific_force).all(axis=1)
            imu = samples.select(np.flatnonzero(good & np.isfinite(samples.angular_rate).all(axis=1)))
            ends = np.flatnonzero(np.diff(np.floor(imu.t / _LOOK_EVERY)) > 0) + 1
            for rows in np.split(np.arange(len(imu)), ends):
                if rows.size:
                    self._add_imu(imu.select(rows))
        elif isinstance(samples, VelocityData):
            self._add_velocity(samples.select(np.flatnonzero(np.isfinite(samples.enu[:, :2]).all(axis=1))))
        elif isinstance(samples, FixData):
            known = np.isfinite(samples.latitude) & np.isfinite(samples.longitude)
            self._add_fix(samples.select(np.flatnonzero(known & (samples.status >= 0))))
        self._count_passes()

    # Inner workings

    def _add_imu(self, imu: ImuData) -> None:
        """At most half a second of samples. Stamps that go back begin anew: a recording that is played again."""
        if imu.t[-1] < self._newest - _BACK:
            self._begin()
        self._newest = max(self._newest, float(imu.t[-1]))
        self._lengths.append((imu.t, np.linalg.norm(imu.specific_force, axis=1)))
        while self._lengths[0][0][-1] < self._newest - _MEMORY:
            self._lengths.popleft()
        if self.standstill is not None:
            return
        self._window = [part for part in self._window if part.t[-1] > self._newest - _WINDOW] + [imu]
        if self._newest >= self._looked + _LOOK_EVERY:
            self._looked = self._newest
            self._look(ImuData.joined(self._window))

    def _look(self, imu: ImuData) -> None:
        """Whether the vehicle has stood long enough."""
        imu = imu.select(np.argsort(imu.t, kind="stable"))
        period = float(np.median(np.diff(imu.t))) if len(imu) >= _FEWEST else 0.0
        if not period > 0.0:
            return
        force, rate, settings = imu.specific_force @ self._turn.T, imu.angular_rate, ImuSettings()
        speed = None
        if self._speeds:
            times, speeds = (np.concatenate(columns) for columns in zip(*self._speeds, strict=True))
            speed = np.interp(imu.t, times, speeds)
        still = standstill_mask(1.0 / period, force, rate, settings.still, speed)
        steps = np.diff(imu.t, prepend=imu.t[0])
        self._still_for = min(float(steps[still & (steps < _GAP)].sum()), _STILL)
        if self._still_for < _STILL:
            return
        mean = force[still].mean(axis=0)
        self.standstill = Standstill(
            end=float(imu.t[still][-1]),
            rate_bias=rate[still].mean(axis=0),
            force=mean,
            force_noise=white_noise(force[still]),
            mounting=check_mounting(mean, self._twin.imu.rpy, settings.max_bias / STANDARD_GRAVITY),
        )
        self._window = []

    def _add_velocity(self, velocity: VelocityData) -> None:
        if not len(velocity):
            return
        speed = np.hypot(velocity.enu[:, 0], velocity.enu[:, 1])
        self._speeds.append((velocity.t, speed))
        while self._speeds[0][0][-1] < velocity.t[-1] - _MEMORY:
            self._speeds.popleft()

    def _add_fix(self, fix: FixData) -> None:
        if not len(fix):
            return
        if self._datum is None:  # as a calibration does it
            self._datum = Datum(
                latitude=float(fix.latitude[0]),
                longitude=float(fix.longitude[0]),
                altitude=float(np.nan_to_num(fix.altitude[0])),
            )
        altitude = np.where(np.isfinite(fix.altitude), fix.altitude, self._datum.altitude)
        x, y, _ = LocalMap(self._datum).to_map(fix.latitude, fix.longitude, altitude).T
        sigma = np.nan_to_num(fix.sigma[:, :2]).max(axis=1)
        self.position_sigma = float(fix.sigma[-1, :2].max())
        forward, left = self._twin.gps.position[:2]
        for t, east, north, wide in zip(fix.t.tolist(), x.tolist(), y.tolist(), sigma.tolist(), strict=True):
            self._see_course(east, north)
            if math.isfinite(self._course):
                c, s = math.cos(self._course), math.sin(self._course)
                east, north = east - c * forward + s * left, north - s * forward - c * left
            u, v = (float(value) for value in self._road.xy_to_uv(east, north))
            beside = max(float(self._road.v[0]) - v, v - float(self._road.v[-1]), 0.0)
            before, behind = self._first - self._length - u, u - self._last - self._length
            self._distance = math.hypot(max(self._first - u, u - self._last, 0.0), beside)
            side = -1 if before > 0.0 else 1 if behind > 0.0 else 0
            if side:
                if self._side == -side:
                    self._crossed.append((self._left, t))
                self._side, self._left = side, t
            elif beside > 2.0 * wide:  # past the bump beside the road
                self._side = 0

    def _see_course(self, east: float, north: float) -> None:
        """The direction from the last position that is a vehicle's length away: where the antenna's arm points."""
        x, y = self._seen or (east, north)
        if math.hypot(east - x, north - y) >= self._length:
            self._course = math.atan2(north - y, east - x)
            self._seen = None
        self._seen = self._seen or (east, north)

    def _count_passes(self) -> None:
        """Passes of which all samples have come; those before the standstill do not count."""
        while self._crossed and self._newest >= self._crossed[0][1]:
            start, end = self._crossed.pop(0)
            if self.standstill is None or start < self.standstill.end:
                continue
            gravity = float(np.linalg.norm(self.standstill.force))
            shock = [np.abs(f[(t >= start) & (t <= end)] - gravity) for t, f in self._lengths]
            speeds = [v[(t >= start) & (t <= end)] for t, v in self._speeds]
            known = np.concatenate(speeds) if speeds else np.empty(0)
            way = self._last - self._first + 2.0 * self._length
            speed = float(np.median(known)) if known.size else way / max(end - start, 1e-3)
            self.passes.append(Pass(start, end, speed, float(np.concatenate(shock).max(initial=0.0))))


def _away(distance: float) -> str:
    """How far the bump is, in m."""
    if math.isnan(distance):
        return "waiting for positions"
    return f"{distance:.0f} m away" if distance < 1e3 else f"{distance / 1e3:.0f} km away"
