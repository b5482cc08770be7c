# SPDX-License-Identifier: Apache-2.0
"""A recorded drive from a bag, whatever its format, with a line for everything left out or repaired."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.cdr import Decoded
from suspension_twin.drive.checks import clean_drive, repair_stamps
from suspension_twin.drive.contents import Contents, decode_topic, topic_name
from suspension_twin.drive.recording import read_recording
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData, deviations
from suspension_twin.errors import InputError
from suspension_twin.files import reader

__all__ = ["TYPES", "Topics", "read_drive"]


_LAST_STAMP = 1 << 62  # ns: the year 2116


@dataclass(frozen=True)
class Topics:
    """Names of the topics that a drive is read from, absolute with or without the leading slash.

    Parameters
    ----------
    imu : str
        ``sensor_msgs/Imu``, specific force and angular rate in the sensor's axes.
    fix : str
        ``sensor_msgs/NavSatFix``.
    vel : str
        ``geometry_msgs/TwistStamped``, east, north, up in m/s.
    heading : str
        ``geometry_msgs/QuaternionStamped``, may be absent.

    Examples
    --------
    >>> Topics(imu="/phone/imu").fix
    '/fix'
    """

    imu: str = "/imu/data_raw"
    fix: str = "/fix"
    vel: str = "/vel"
    heading: str = "/heading"


#: Types that each role may have; the first is written.
TYPES: dict[str, tuple[str, ...]] = {
    "imu": ("sensor_msgs/msg/Imu",),
    "fix": ("sensor_msgs/msg/NavSatFix",),
    "vel": ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped"),
    "heading": ("geometry_msgs/msg/QuaternionStamped",),
}


@reader("a recorded drive")
def read_drive(path: str | Path, *, topics: Topics | None = None) -> Drive:
    """Read one drive from a recording.

    Times are header stamps; where those of a topic are missing (zero) its record stamps are taken. Samples
    that are not finite and outlying stamps are removed.

    Parameters
    ----------
    path : str or Path
        A rosbag2 folder (MCAP or sqlite3), a bare ``.mcap`` or ``.db3`` file, or a ROS 1 bag, truncated or
        not.
    topics : Topics, optional
        Names of the topics; those of the contract by default. That of the IMU must be there, and any other
        name that is given; an empty one is none.

    Returns
    -------
    Drive
        SI units, stamps in s since the epoch; ``warnings`` has a line for everything that was lost or
        repaired.

    Raises
    ------
    InputError
        No recording, a topic that is not there (the message names those that fit), or is of a wrong type, or
        no sample.

    Examples
    --------
    >>> drive = read_drive("bags/bump_15kmh")
    >>> drive.name, len(drive.imu), len(drive.fix)
    ('bump_15kmh', 6954, 694)
    """
    return _read(path, topics or Topics())


def _read(path: str | Path, topics: Topics) -> Drive:
    names = {role: topic_name(name) for role, name in asdict(topics).items()}
    contents = read_recording(path, set(names.values()))
    for role, name in names.items():
        have = contents.types.get(name)
        if have is not None and have not in TYPES[role]:
            raise InputError(path, name, f"holds {have}, but {role} needs {TYPES[role][0]}")
        if have is None and (role == "imu" or name not in (getattr(Topics, role), "/")):
            raise InputError(path, name, _missing(contents, role))
        if have is None and role == "fix" and name != "/" and set(contents.types.values()) & set(TYPES[role]):
            contents.warnings.append(f"{name}: {_missing(contents, role)}")
    columns = {f.name: _Columns.of(contents, names[f.name]) for f in fields(Topics)}
    if not columns["imu"].t.size:
        raise InputError(path, names["imu"], "; ".join(["no message was read", *contents.warnings]))
    with np.errstate(all="ignore"):  # a message may hold anything
        drive = Drive(
            name=drive_name(path),
            imu=_imu(columns["imu"]),
            fix=_fix(columns["fix"]),
            velocity=_velocity(columns["vel"]),
            heading=_heading(columns["heading"]),
            warnings=tuple(contents.warnings),
        )
        drive = clean_drive(drive)
    if not len(drive.imu):
        raise InputError(path, names["imu"], "; ".join(["no usable sample", *drive.warnings]))
    return drive


def drive_name(path: str | Path) -> str:
    """Name of a drive from where it lies."""
    path = Path(path)
    return path.name if path.is_dir() else path.name.split(".", 1)[0] or path.name


def _missing(contents: Contents, role: str) -> str:
    """One line: the topics that are there instead, and the remedy."""
    if not contents.types:
        return "; ".join(["the recording holds no topics", *contents.warnings])
    fit = sorted(name for name, kind in contents.types.items() if kind in TYPES[role])
    others = sorted(f"{name} ({kind})" for name, kind in contents.types.items() if name not in fit)
    if fit:
        return (
            f"no such topic; {role} topics of this recording are {', '.join(fit)}: name one as the {role} topic, or "
            f"'suspension-twin import --{role}-topic {fit[0]}' makes a drive of it"
        )
    shown = ", ".join(others[:8]) + (f" and {len(others) - 8} more" if len(others) > 8 else "")
    return f"no such topic, nor any other of type {TYPES[role][0]}; the recording holds {shown}"


@dataclass
class _Columns:
    """Messages of one topic with their repaired stamps."""

    t: Floats
    groups: list[Decoded]
    order: NDArray[np.intp]

    @classmethod
    def of(cls, contents: Contents, name: str) -> _Columns:
        groups = decode_topic(contents, name)
        if not groups:
            return cls(np.empty(0), [], np.empty(0, dtype=np.intp))
        index = np.concatenate([group.index for group in groups])
        order = np.argsort(index, kind="stable")
        header = np.concatenate([group.stamp_ns for group in groups])[order]
        recorded = _as_stamps(contents.topics[name].stamps)[index[order]]
        t, keep, warnings = repair_stamps(header, recorded)
        contents.warnings.extend(f"{name}: {line}" for line in warnings)
        return cls(t[keep], groups, order[keep])

    def rows(self, name: str) -> NDArray[Any]:
        """Field ``name`` of the messages kept, in their order."""
        return np.asarray(np.concatenate([group[name] for group in self.groups])[self.order])

    def vector(self, prefix: str, names: str = "xyz") -> Floats:
        """(n, len(names)) of a field's members."""
        if not self.groups:
            return np.empty((0, len(names)))
        return np.asarray(np.concatenate([g.columns(prefix, names) for g in self.groups])[self.order])

    @property
    def frame(self) -> str:
        return self.groups[0].text("header.frame_id") if self.groups else ""


def _as_stamps(stamps: list[int]) -> NDArray[np.int64]:
    """Times of recording in ns; impossible ones become 0."""
    try:
        array = np.array(stamps, dtype=np.int64)
    except OverflowError:
        array = np.array([stamp if 0 <= stamp < _LAST_STAMP else 0 for stamp in stamps], dtype=np.int64)
    return np.where((array >= 0) & (array < _LAST_STAMP), array, 0)


def _imu(columns: _Columns) -> ImuData:
    quaternions = columns.vector("orientation", "xyzw")
    # REP-145: a first covariance of -1 means that the sensor reports no orientation; a quaternion
    # that is not one means the same
    unit = np.abs(np.linalg.norm(np.clip(quaternions, -10, 10), axis=1) - 1) < 0.01
    absent = not unit.all() or (columns.rows("orientation_covariance")[:, 0] < 0).any()
    return ImuData(
        t=columns.t,
        specific_force=columns.vector("linear_acceleration"),
        angular_rate=columns.vector("angular_velocity"),
        orientation=None if absent else quaternions,
        frame=columns.frame or "imu_link",
    )


def _fix(columns: _Columns) -> FixData:
    if not columns.groups:
        return FixData.empty()
    variance = columns.rows("position_covariance")[:, [0, 4, 8]]
    return FixData(
        t=columns.t,
        latitude=columns.rows("latitude"),
        longitude=columns.rows("longitude"),
        altitude=columns.rows("altitude"),
        status=columns.rows("status.status").astype(np.int8),
        sigma=deviations(variance, columns.rows("position_covariance_type") != 0),
        frame=columns.frame or "gps_link",
    )


def _velocity(columns: _Columns) -> VelocityData:
    if not columns.groups:
        return VelocityData.empty()
    names = columns.groups[0].records.dtype.names or ()
    with_covariance = "twist.twist.linear.x" in names
    return VelocityData(
        columns.t, columns.vector("twist.twist.linear" if with_covariance else "twist.linear")
    )


def _heading(columns: _Columns) -> HeadingData | None:
    if not columns.groups:
        return None
    x, y, z, w = np.clip(columns.vector("quaternion", "xyzw"), -10, 10).T
    norm = x * x + y * y + z * z + w * w
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return HeadingData(columns.t, np.where(np.abs(norm - 1) < 0.02, yaw, np.nan))
