# SPDX-License-Identifier: Apache-2.0
"""Input and output of a vehicle model as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats

__all__ = [
    "BodyMotion",
    "Excitation",
    "HeightField",
    "LaneResponse",
    "PlanarPath",
    "PoseSample",
    "RepeatedRun",
    "Response",
    "SensorReading",
    "WheelMotion",
]

Ints = NDArray[np.int64]
#: A number at one stamp, or (n,) at n.
Value = TypeVar("Value", float, Floats)


class HeightField(Protocol):
    """Anything that gives the height of the ground."""

    def heights(self, x: Floats, y: Floats) -> Floats:
        """Heights in m at ``map`` positions x, y in m, arrays of any one shape."""
        ...


class PoseSample(NamedTuple):
    """Pose and planar motion of ``base_link`` at one stamp, as in :class:`~suspension_twin.pose.types.Trajectory`: m,
    rad, m/s, rad/s, m/s²."""

    x: float
    y: float
    yaw: float
    speed: float
    lateral_speed: float
    yaw_rate: float
    ax: float
    ay: float


@dataclass(frozen=True, eq=False)
class PlanarPath:
    """The path of the vehicle over the ground: what the road heights of an excitation were looked up for.

    ``x``, ``y`` m and ``yaw`` rad (n,) of base_link in ``map``, ``wheels`` (4, 2) m the wheel centres in base_link.
    ``antenna`` m is the height of the antenna that the path is of, 0 where it is the path of base_link: static roll
    and pitch displace an antenna against the wheels.
    """

    x: Floats
    y: Floats
    yaw: Floats
    wheels: Floats
    ground: HeightField
    antenna: float = 0.0


@dataclass(frozen=True, eq=False)
class Excitation:
    """Input of a model: planar motion at n stamps, road heights under the wheels in between.

    The interval that ends at stamp ``k`` is walked in ``substeps[k]`` equal steps of ``step[k]``
    seconds; ``substeps[k] == 0`` marks a fresh start from static equilibrium (the first stamp,
    and every stamp after a gap). Road heights are given at the end of every step, one row for a
    fresh start: interval ``k`` owns ``road[first[k]:first[k + 1]]``.

    ``t`` (n,) s; ``substeps`` (n,); ``first`` (n + 1,); ``road`` (m, 4) m, corners in the usual
    order; ``motion`` (n, 7): the step in s, ``ax``, ``ay`` m/s² in base_link's axes of the point above
    its origin at the height of the centre of gravity, ``yaw_rate`` rad/s, ``yaw_acceleration`` rad/s²,
    ``speed`` and ``lateral_speed`` m/s; where there are actuators (n, 8), with the force in N that one in every strut
    pushes body and wheel apart with, linear between the stamps;
    ``max_step`` s is the largest step that any interval may take. ``path`` is where the road heights were looked up.
    ``late`` s is the clock offset of the sensor's stamps that has been taken off already.
    """

    t: Floats
    substeps: Ints
    first: Ints
    road: Floats
    motion: Floats
    max_step: float
    path: PlanarPath
    late: float = 0.0

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def step(self) -> Floats:
        """(n,) s length of the steps of each interval."""
        return self.motion[:, 0]

    @property
    def ax(self) -> Floats:
        """(n,) m/s² acceleration along base_link's x, above its origin at the height of the centre of gravity."""
        return self.motion[:, 1]

    @property
    def yaw_rate(self) -> Floats:
        """(n,) rad/s."""
        return self.motion[:, 3]

    @property
    def speed(self) -> Floats:
        """(n,) m/s forward speed of base_link's origin."""
        return self.motion[:, 5]


@dataclass(frozen=True, eq=False)
class RepeatedRun(Excitation):
    """A program that was run before: ``missed`` (n, C) is what the model was short of then in some ``channels``.

    It is added to what the sensors see, so that a low-pass or a gain since then acts on it as on all else.
    """

    channels: tuple[str, ...] = ()
    missed: Floats = field(default_factory=lambda: np.empty((0, 0)))


@dataclass(frozen=True, eq=False)
class SensorReading(Generic[Value]):
    """Readings of the virtual sensor; see :class:`Response`."""

    force: Floats
    rate: Floats
    vertical_acceleration: Value


@dataclass(frozen=True, eq=False)
class WheelMotion:
    """Motion and forces of the wheels; see :class:`Response`."""

    wheel_z: Floats
    deflection: Floats
    deflection_rate: Floats
    tyre_force: Floats


@dataclass(frozen=True, eq=False)
class BodyMotion(Generic[Value]):
    """Motion of the sprung mass at the time ``t``; see :class:`Response`."""

    t: Value
    heave: Value
    roll: Value
    pitch: Value
    z: Value


@dataclass(frozen=True, eq=False)
class Response(SensorReading[Floats], WheelMotion, BodyMotion[Floats]):
    """Response of one twin at the n stamps of its excitation: body, wheels and virtual sensor.

    Parameters
    ----------
    t : (n,) array
        s.
    heave : (n,) array
        Height in m of the sprung centre of gravity above its place on a level road at height 0.
    roll, pitch : (n,) array
        rad, left side up and nose down positive.
    z : (n,) array
        Height in m of the origin of ``base_link``.
    wheel_z : (n, 4) array
        Heights of the wheel centres in m; corners in the order front left, front right, rear left, rear
        right.
    deflection, deflection_rate : (n, 4) array
        Compression of the springs from their free length in m, and m/s.
    tyre_force : (n, 4) array
        N.
    force : (n, 3) array
        Specific force in m/s² at the IMU's place in ``base_link`` axes.
    rate : (n, 3) array
        Angular rate in rad/s.
    vertical_acceleration : (n,) array
        m/s², ``force`` z without gravity.
    acceleration : (n, 7) array
        Second derivatives of heave, roll, pitch and the four wheel heights.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.inference.simulated import simulate_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> result = simulate_drive(read_drive("bags/crg_road"), load_twin("bags/crg_road/twin.yaml"))
    >>> result.response.force.shape == (result.response.t.size, 3)
    True
    """

    acceleration: Floats


@dataclass(frozen=True, eq=False)
class LaneResponse:
    """Sensor signals of L candidates: ``signals`` (n, C, L) in SI units, in the order of the channels' ``names``.

    ``failed`` (L,) marks candidates that diverged or have no static equilibrium; their signals are zero and
    their cost is to be taken as infinite.
    """

    t: Floats
    names: tuple[str, ...]
    signals: Floats
    failed: NDArray[np.bool_]

    def channel(self, name: str) -> Floats:
        """(n, L) one channel."""
        return self.signals[:, self.names.index(name)]

    def stacked(self, names: Sequence[str]) -> Floats:
        """(n, len(names), L) some channels in the order asked for."""
        return np.take(self.signals, [self.names.index(name) for name in names], axis=1)

    @property
    def force(self) -> Floats:
        """(n, 3, L) specific force of a car's sensor in m/s²; no components where only the vertical was asked for."""
        return self.signals[:, :3] if self.signals.shape[1] > 1 else self.signals[:, :0]

    @property
    def rate(self) -> Floats:
        """(n, 3, L) angular rate of a car's sensor in rad/s."""
        return self.signals[:, 3:6]

    @property
    def vertical_acceleration(self) -> Floats:
        """(n, L) of a car's sensor in m/s², without gravity's part."""
        return self.channel("vertical_acceleration")
