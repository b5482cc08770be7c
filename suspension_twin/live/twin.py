# SPDX-License-Identifier: Apache-2.0
"""The twin that follows its vehicle, without ROS: push samples, get all that the nodes publish."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from suspension_twin.drive.checks import nanoseconds
from suspension_twin.drive.received import LivePlaces
from suspension_twin.drive.types import Drive
from suspension_twin.inference.sensor_correction import SensorCorrection
from suspension_twin.live.felt import FeltPosition, FeltSettings, felt_stage
from suspension_twin.live.follow import BodyAcceleration, Followed, Follower, FollowSettings
from suspension_twin.pose.lock import PlanarState, PoseLock
from suspension_twin.pose.types import PoseSettings
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.clock import JUMP_BACK, MAX_STAMP
from suspension_twin.signals.filters import FilterSpec, LiveLowPass
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.signals.ingest import ImuIngest, IngestOutput, Vector
from suspension_twin.vehicle.twin import Datum, Place, Twin

__all__ = [
    "DigitalTwin",
    "Update",
    "compile_stages",
    "delay_of",
    "digital_twin",
    "ingest_stage",
    "lock_stage",
    "replay",
    "schedule",
]

#: Hz at which the delay of the low-pass is computed: it hardly depends on the sample rate.
_FAST = 20_000.0


class Update(NamedTuple):
    """Answer to one IMU sample: the filtered ``sample``, the locked ``pose`` and the twin that has ``followed`` it.
    None for a stage that is not there, and for a pose before the first fix."""

    sample: IngestOutput | None
    pose: PlanarState | None = None
    followed: Followed | None = None


@dataclass
class DigitalTwin:
    """The three stages of a live twin: the IMU's ``ingest``, the ``lock`` of the pose, and the ``follower``.

    Push every sample and every fix, velocity and heading in the order of their arrival. A stamp that is set back by
    more than a second (a looped bag) resets everything. A stage may be replaced at any time; one that is None is
    passed over.

    Parameters
    ----------
    ingest : ImuIngest, optional
        Samples to filtered signals in ``base_link`` axes.
    lock : PoseLock, optional
        These and the receiver's messages to the locked pose.
    follower : Follower, optional
        The model that follows that pose, and the live gap.
    felt : FeltPosition, optional
        Moves the pose along the road to where the vehicle is felt to be.

    Examples
    --------
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = digital_twin(load_twin("bags/crg_road/twin.yaml"))
    >>> twin.push_fix(0.0, 47.4025, 19.284, 0.0)
    >>> updates = [twin.push_imu(0.01 * k, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)) for k in range(1, 50)]
    >>> updates[-1].pose.aligned  # its yaw is not known before it has moved
    False
    """

    ingest: ImuIngest | None = None
    lock: PoseLock | None = None
    follower: Follower | None = None
    felt: FeltPosition | None = None
    _places: LivePlaces = field(default_factory=LivePlaces, init=False, repr=False)
    _newest: dict[str, float] = field(default_factory=dict, repr=False)

    def push_imu(self, t: float, force: Vector, rate: Vector) -> Update | None:
        """One sample at ``t`` s in the sensor's axes: specific force m/s², angular rate rad/s. None while the rate of
        the samples is not known, and for one that was dropped."""
        self.rest()
        self._follow_clock("imu", t)
        sample = None if self.ingest is None else self.ingest.push(t, force, rate)
        if sample is None:
            return None
        pose = self.locate(t, sample.force, sample.rate)
        measured = BodyAcceleration(sample.acceleration, sample.angular_acceleration)
        return Update(sample, pose, self.follow(t, pose, measured))

    def locate(self, t: float, force: Vector, rate: Vector) -> PlanarState | None:
        """The pose by a filtered sample in ``base_link`` axes, gravity kept, moved to where the place is felt."""
        lock, felt = self.lock, self.felt
        pose = None if lock is None else lock.on_imu(t, force, rate)
        if lock is None or felt is None or pose is None:
            return pose
        moved = felt.step(pose, force, rate[1], lock.fix_accuracy)
        lock.lateness = felt.lateness
        return moved

    def take_velocity(self, t: float, east: float, north: float) -> None:
        """One velocity of the antenna for the pose, as :meth:`push_velocity`."""
        if self.lock is not None:
            self.lock.on_velocity(t, east, north)
        if self.felt is not None:
            self.felt.heed_velocity(t, east, north)

    def rest(self) -> None:
        """Do the work that may wait until the answer to a sample is out; else it is done before the next one."""
        if self.felt is not None:
            self.felt.rest()

    def is_held(self, t: float, latitude: float, longitude: float, status: int) -> bool:
        """Whether a fix at ``t`` s repeats the place of the one before it although the receiver had computed none; to
        be asked once for each."""
        return self._places.repeats(t, (latitude, longitude, float(status)))

    def push_fix(
        self, t: float, latitude: float, longitude: float, altitude: float, status: int = 0, *sigmas: float
    ) -> None:
        """One fix at ``t`` s: degrees, m; ``status`` as in sensor_msgs/NavSatStatus, ``sigmas`` east and north in m
        (none: not known). It is passed over where the receiver only holds it until it has computed another."""
        self._follow_clock("fix", t)
        if self.lock is not None and not self.is_held(t, latitude, longitude, status):
            self.lock.on_fix(t, latitude, longitude, altitude, status, *sigmas)

    def push_velocity(self, t: float, east: float, north: float) -> None:
        """One velocity of the antenna at ``t`` s in m/s."""
        self._follow_clock("velocity", t)
        if self.ingest is not None:
            self.ingest.heed_velocity(t, east, north)
        self.take_velocity(t, east, north)

    def push_heading(self, t: float, yaw: float) -> None:
        """One heading at ``t`` s: yaw of ``base_link`` in ``map`` in rad."""
        self._follow_clock("heading", t)
        if self.lock is not None:
            self.lock.on_heading(t, yaw)

    def follow(self, t: float, pose: PlanarState | None, measured: BodyAcceleration) -> Followed | None:
        """The twin at a ``pose`` of the lock or of an odometry, and the filtered ``measured`` acceleration."""
        if self.follower is None:
            return None
        if pose is None:
            self.follower.lost += 1
            return None
        return self.follower.step(t, pose, measured)

    def _follow_clock(self, kind: str, t: float) -> None:
        """Reset everything where the stamps of a ``kind`` jump back."""
        newest = self._newest.get(kind, t)
        if t < newest - JUMP_BACK:
            self.reset()
            newest = t
        if abs(t) < MAX_STAMP:
            self._newest[kind] = max(newest, t)

    def reset(self) -> None:
        """Forget everything but settings and datum."""
        self._newest.clear()
        self._places = LivePlaces()
        for stage in (self.ingest, self.lock, self.felt, self.follower):
            if stage is not None:
                stage.reset()

    @property
    def findings(self) -> list[Finding]:
        """Oddities of the samples, the pose and the comparison, stage by stage."""
        stages = (self.ingest, self.lock, self.follower)
        return [finding for stage in stages if stage is not None for finding in stage.findings]


def digital_twin(
    twin: Twin,
    imu: ImuSettings | None = None,
    pose: PoseSettings | None = None,
    follow: FollowSettings | None = None,
    felt: FeltSettings | None = None,
) -> DigitalTwin:
    """Make the live twin of a twin file, which follows its vehicle sample by sample.

    Parameters
    ----------
    twin : Twin
        The twin; without a road it drives on a plane.
    imu : ImuSettings, optional
        How the IMU is treated; its low-pass is that of the simulated signal too.
    pose : PoseSettings, optional
        Noise and gates of the pose, and the delay of that low-pass.
    follow : FollowSettings, optional
        The live gap, and that low-pass.
    felt : FeltSettings, optional
        How the pose of a poor receiver is moved to the felt place, and that low-pass.

    Returns
    -------
    DigitalTwin
        Standing in static equilibrium, before its first sample.

    Raises
    ------
    InputError
        Naming the key of a twin file that cannot be simulated.

    Examples
    --------
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> digital_twin(load_twin("bags/crg_road/twin.yaml")).follower.gap.now() is None
    True
    """
    imu = imu or ImuSettings()
    pose = pose or PoseSettings(imu_delay=delay_of(imu.filter))
    follow = follow or FollowSettings(filter=imu.filter)
    place = felt_stage(twin, felt or FeltSettings(filter=imu.filter))
    return DigitalTwin(
        ingest_stage(twin, imu), lock_stage(twin, pose, twin.datum), Follower(twin, follow), place
    )


def schedule(drive: Drive) -> tuple[NDArray[np.int64], NDArray[np.int8], NDArray[np.int64]]:
    """Stamps in ns, kinds (0 IMU, 1 fix, 2 velocity, 3 heading) and indices of all samples of a drive in the order in
    which they are sent: by stamp, late ones late."""
    heading = np.empty(0) if drive.heading is None else drive.heading.t
    ns = [nanoseconds(t) for t in (drive.imu.t, drive.fix.t, drive.velocity.t, heading)]
    when = [np.maximum.accumulate(part) if part.size else part for part in ns]
    kind = np.concatenate([np.full(part.size, k, dtype=np.int8) for k, part in enumerate(ns)])
    index = np.concatenate([np.arange(part.size) for part in ns])
    # The slower topics first: a fix belongs before the sample of the same stamp.
    order = np.lexsort((-kind, np.concatenate(when)))
    return np.concatenate(ns)[order], kind[order], index[order]


def replay(drive: Drive, twin: DigitalTwin) -> Iterator[Update]:
    """Push a recorded drive into a live twin, in the order of its stamps.

    Parameters
    ----------
    drive : Drive
        The recording.
    twin : DigitalTwin
        From :func:`digital_twin`.

    Returns
    -------
    iterator of Update
        One for every sample from the 17th on, where the sample rate is known.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = digital_twin(load_twin("bags/crg_road/twin.yaml"))
    >>> len(list(replay(read_drive("bags/crg_road"), twin)))
    2411
    """
    imu, fix, velocity, heading = drive.imu, drive.fix, drive.velocity, drive.heading
    for ns, kind, i in zip(*(column.tolist() for column in schedule(drive)), strict=True):
        t = ns / 1e9
        if kind == 0:
            force, rate = imu.specific_force[i].tolist(), imu.angular_rate[i].tolist()
            update = twin.push_imu(t, force, rate)
            if update is not None:
                yield update
        elif kind == 1:
            place = float(fix.latitude[i]), float(fix.longitude[i]), float(fix.altitude[i])
            twin.push_fix(t, *place, int(fix.status[i]), *fix.sigma[i, :2].tolist())
        elif kind == 2:
            twin.push_velocity(t, *velocity.enu[i, :2].tolist())
        elif heading is not None:
            twin.push_heading(t, float(heading.yaw[i]))


def ingest_stage(twin: Twin | None, settings: ImuSettings) -> ImuIngest:
    """The first stage, for the IMU of a twin file."""
    return ImuIngest(settings, Place() if twin is None else twin.imu)


def lock_stage(twin: Twin | None, settings: PoseSettings, datum: Datum | None) -> PoseLock:
    """The second stage, for the sensors of a twin file; the first fix is the datum where there is none."""
    if twin is None:
        return PoseLock(settings, datum=datum)
    known = SensorCorrection.of_twin(twin)
    return PoseLock(settings, twin.gps, datum, twin.imu, known.turn, known.gain)


def delay_of(spec: FilterSpec) -> float:
    """Delay in s of a low-pass, as good as independent of the rate of the samples."""
    return spec.delay(_FAST)


@cache
def compile_stages() -> None:
    """Compile before the first message: a second of driving east, with every kind of message, one sample missing."""
    lock = lock_stage(None, PoseSettings(), Datum(latitude=0.0, longitude=0.0))
    twin = DigitalTwin(ingest_stage(None, ImuSettings()), lock)
    low_pass = LiveLowPass(FilterSpec())
    for k in range(120):
        t = 1.0 + 0.01 * k
        if k % 10 == 0:
            twin.push_fix(t - 0.025, 0.0, 10.0 * t / 111_319.5, 0.0, 2)
            twin.push_velocity(t - 0.025, 10.0, 0.0)
            twin.push_heading(t - 0.025, 0.0)
        if k != 110:
            twin.push_imu(t, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
            low_pass.push(t, 0.0)
