# SPDX-License-Identifier: Apache-2.0
"""A recorded drive in memory: measurements with their own stamps in SI units; parts of drives and drives joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.display import axes_or_new, bulleted, table
from suspension_twin.errors import InputError

__all__ = [
    "Drive",
    "FixData",
    "HeadingData",
    "ImuData",
    "Samples",
    "VelocityData",
    "concatenate",
    "cut",
    "deviations",
]

if TYPE_CHECKING:
    from typing import Self  # of Python 3.11

    from matplotlib.axes import Axes
    from pandas import DataFrame


@dataclass(frozen=True, eq=False, repr=False)
class _Samples:
    """Arrays with one row a sample, ``t`` (n,) s among them."""

    t: Floats

    def __len__(self) -> int:
        return int(self.t.size)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} samples)"

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        """These rows of every array; ``rows`` is a mask (n,) or indices."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{k: v[rows] for k, v in arrays.items() if isinstance(v, np.ndarray)})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """One after the other; an optional array is kept where all of them have it."""
        columns = {f.name: [getattr(part, f.name) for part in parts] for f in fields(cls)}
        whole: dict[str, Any] = {}
        for name, values in columns.items():
            if all(isinstance(value, np.ndarray) for value in values):
                whole[name] = np.concatenate(values)
            else:
                whole[name] = None if any(value is None for value in values) else values[0]
        return cls(**whole)


@dataclass(frozen=True, eq=False, repr=False)
class ImuData(_Samples):
    """IMU samples in the sensor's own axes, in the order in which they were recorded.

    Parameters
    ----------
    t : (n,) array
        Header stamps, s since the epoch.
    specific_force : (n, 3) array
        m/s²; at rest, upright, z = +9.81.
    angular_rate : (n, 3) array
        rad/s.
    orientation : (n, 4) array, optional
        Quaternion x, y, z, w of the sensor in ``map``, or None.
    frame : str
        ``frame_id`` of the messages.

    Examples
    --------
    >>> import numpy as np
    >>> len(ImuData(np.array([0.0]), np.array([[0.0, 0.0, 9.81]]), np.zeros((1, 3))))
    1
    """

    specific_force: Floats
    angular_rate: Floats
    orientation: Floats | None = None
    frame: str = "imu_link"


def deviations(variance: Floats, known: NDArray[np.bool_]) -> Floats:
    """(k, 3) m of the diagonal (k, 3) m² of covariances that are ``known`` (k,); NaN where nothing is stated: a height
    of variance 0 beside a place that has one is none, as of a receiver that states horizontal accuracy alone."""
    stated = known[:, None] & np.isfinite(variance) & (variance >= 0)
    stated[:, 2] &= (variance[:, 2] > 0) | (variance[:, :2] <= 0).all(axis=1)
    return np.sqrt(np.where(stated, variance, np.nan))


@dataclass(frozen=True, eq=False, repr=False)
class FixData(_Samples):
    """GNSS positions.

    Parameters
    ----------
    t : (m,) array
        s since the epoch.
    latitude, longitude : (m,) array
        Degrees on WGS 84.
    altitude : (m,) array
        m.
    status : (m,) array of int8
        Of ``sensor_msgs/NavSatStatus``; -1 is no fix.
    sigma : (m, 3) array
        Standard deviations east, north, up in m; NaN where the receiver gave no covariance.
    frame : str
        ``frame_id`` of the messages.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> read_drive("bags/bump_15kmh").fix.sigma.shape[1]
    3
    """

    latitude: Floats
    longitude: Floats
    altitude: Floats
    status: NDArray[np.int8]
    sigma: Floats
    frame: str = "gps_link"

    @classmethod
    def empty(cls) -> FixData:
        """No fix."""
        none = np.empty(0)
        return cls(none, none, none, none, np.empty(0, dtype=np.int8), np.empty((0, 3)))


@dataclass(frozen=True, eq=False, repr=False)
class VelocityData(_Samples):
    """GNSS velocities of the antenna.

    Parameters
    ----------
    t : (k,) array
        s since the epoch.
    enu : (k, 3) array
        East, north, up in m/s.

    Examples
    --------
    >>> import numpy as np
    >>> len(VelocityData(np.array([0.0]), np.array([[10.0, 0.0, 0.0]])))
    1
    """

    enu: Floats

    @classmethod
    def empty(cls) -> VelocityData:
        """No velocity."""
        return cls(np.empty(0), np.empty((0, 3)))


@dataclass(frozen=True, eq=False, repr=False)
class HeadingData(_Samples):
    """Headings: ``t`` (k,) s, ``yaw`` (k,) rad from east, counter-clockwise."""

    yaw: Floats


#: Measurements of one kind.
Samples: TypeAlias = ImuData | FixData | VelocityData | HeadingData


@dataclass(frozen=True, eq=False)
class Drive:
    """One recorded drive in SI units. Topics that are absent are empty arrays, but for ``heading``.

    Parameters
    ----------
    name : str
        Name of the recording.
    imu : ImuData
        Samples of the IMU.
    fix : FixData
        Positions of the receiver.
    velocity : VelocityData
        Velocities of the receiver.
    heading : HeadingData, optional
        Headings, or None.
    warnings : tuple of str
        One line for everything that was lost or repaired while reading.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(0.0, 1.0, 0.01)
    >>> at_rest = ImuData(t, np.tile([0.0, 0.0, 9.81], (100, 1)), np.zeros((100, 3)))
    >>> len(at_rest)
    100
    """

    name: str
    imu: ImuData
    fix: FixData
    velocity: VelocityData
    heading: HeadingData | None = None
    warnings: tuple[str, ...] = field(default=())

    def __str__(self) -> str:
        from suspension_twin.drive.checks import summarise

        return bulleted(f"Drive {self.name}", summarise(self).lines(), self.warnings)

    __repr__ = __str__

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the specific force in m/s² over the time in s since the first sample; returns the axes."""
        ax = axes_or_new(ax, "time [s]", "specific force [m/s²]", self.name)
        for axis, values in zip("xyz", self.imu.specific_force.T, strict=True):
            ax.plot(self.imu.t - self.imu.t[0], values, label=axis, linewidth=0.8)
        ax.legend(loc="upper right")
        return ax

    def to_frame(self) -> DataFrame:
        """The IMU's samples as a table of pandas: force m/s² and rate rad/s by axis, over the stamp ``t`` s."""
        vectors = {"force": self.imu.specific_force, "rate": self.imu.angular_rate}
        columns = {f"{name}_{k}": v[:, i] for name, v in vectors.items() for i, k in enumerate("xyz")}
        return table({"t": self.imu.t, **columns}, "t")


def cut(drive: Drive, start: float, stop: float) -> Drive:
    """Cut a piece out of a drive.

    Parameters
    ----------
    drive : Drive
        The recording.
    start, stop : float
        Stamps in s since the epoch; samples with ``start`` <= t < ``stop`` are kept.

    Returns
    -------
    Drive
        The piece; it may be empty.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> drive = read_drive("bags/bump_15kmh")
    >>> begin = drive.imu.t[0]
    >>> piece = cut(drive, begin + 10.0, begin + 20.0)
    >>> 990 < len(piece.imu) <= 1001
    True
    """
    streams = {name: getattr(drive, name) for name in ("imu", "fix", "velocity", "heading")}
    inside = {k: s.select((s.t >= start) & (s.t < stop)) for k, s in streams.items() if s is not None}
    return replace(drive, **inside)


def concatenate(drives: Sequence[Drive], name: str | None = None) -> Drive:
    """Join drives as a recorder that was switched off between them would have recorded them.

    Parameters
    ----------
    drives : sequence of Drive
        In the order of time.
    name : str, optional
        Name of the result; that of the first by default.

    Returns
    -------
    Drive
        All samples, one drive after the other.

    Raises
    ------
    InputError
        No drive, or one that begins before the one before it ends.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> drive = read_drive("bags/bump_15kmh")
    >>> middle = drive.imu.t[0] + 30.0
    >>> whole = concatenate([cut(drive, 0.0, middle), cut(drive, middle, float("inf"))])
    >>> len(whole.imu) == len(drive.imu)
    True
    """
    if not drives:
        raise InputError("drives", "none given")
    for before, after in zip(drives, drives[1:], strict=False):
        if len(before.imu) and len(after.imu) and after.imu.t[0] <= before.imu.t[-1]:
            raise InputError(after.name, f"begins before {before.name} ends")
    headings = [d.heading for d in drives if d.heading is not None]
    return Drive(
        name=name or drives[0].name,
        imu=ImuData.joined([d.imu for d in drives]),
        fix=FixData.joined([d.fix for d in drives]),
        velocity=VelocityData.joined([d.velocity for d in drives]),
        heading=HeadingData.joined(headings) if headings else None,
        warnings=tuple(line for d in drives for line in d.warnings),
    )
