# SPDX-License-Identifier: Apache-2.0
"""comma2k19: a segment's folder of NumPy arrays without an ending (``processed_log`` and ``global_pose``).

Source: README.md of commaai/comma2k19. Each log is two arrays, ``t`` in s since the device booted and
``value``; IMU axes are forward, right, down; the GNSS log holds latitude, longitude, speed, UTC in ms,
altitude, bearing. A fix is logged some 0.2 s after its time, so its own UTC is the better stamp;
``global_pose`` holds the GPS time of each video frame beside its boot time, which ties the two clocks.
"""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import week_to_posix
from suspension_twin.drive.foreign_files import RecordedFiles, read_array
from suspension_twin.drive.streams import Series, Streams
from suspension_twin.drive.types import FixData
from suspension_twin.errors import InputError

__all__ = ["TITLE", "read", "recognises"]

TITLE = "comma2k19"

_IMU = "processed_log/IMU/"
_TO_FLU = np.array([1.0, -1.0, -1.0])
_GNSS = ("processed_log/GNSS/live_gnss_ublox", "processed_log/GNSS/live_gnss_qcom")


def recognises(source: RecordedFiles) -> bool:
    """The folders of a segment."""
    return source.find(_IMU + "accelerometer/t") is not None


def _array(source: RecordedFiles, name: str, columns: int) -> Floats:
    found = source.find(name)
    if found is None:
        raise InputError(source.path, name, "is missing")
    array = read_array(source.read(found), source.label(found))
    if array.shape[1] < columns:
        raise InputError(source.label(found), f"has {array.shape[1]} columns, not {columns}")
    return array


def read(source: RecordedFiles) -> Streams:
    """Accelerometer and gyroscope forward, left, up; GNSS of the u-blox receiver (or the phone's)."""
    streams = Streams(origin=TITLE)
    streams.notes.append("IMU axes: forward, right, down, turned to forward, left, up")
    offset = _boot_to_posix(source, streams)
    for sensor, target in (("accelerometer", "force"), ("gyro", "rate")):
        t = _array(source, f"{_IMU}{sensor}/t", 1)[:, 0]
        value = _array(source, f"{_IMU}{sensor}/value", 3)[:, :3]
        if t.size != value.shape[0]:
            streams.warnings.append(f"{sensor}: {t.size} stamps for {value.shape[0]} values")
        n = min(t.size, value.shape[0])
        setattr(streams, target, Series(t[:n] + offset, value[:n] * _TO_FLU, unit="m/s²"))
    log = next((name for name in _GNSS if source.find(f"{name}/value") is not None), None)
    if log is not None:
        value = _array(source, f"{log}/value", 6)
        t = value[:, 3] * 1e-3
        unknown = np.full((t.size, 3), np.nan)
        status = np.zeros(t.size, dtype=np.int8)
        streams.fix = FixData(t, value[:, 0], value[:, 1], value[:, 4], status, unknown)
        streams.add_course(t, value[:, 2], value[:, 5])
    return streams


def _boot_to_posix(source: RecordedFiles, streams: Streams) -> float:
    """Seconds from the boot time to POSIX time."""
    if source.find("global_pose/frame_gps_times") is not None:
        boot = _array(source, "global_pose/frame_times", 1)[:, 0]
        gps = _array(source, "global_pose/frame_gps_times", 2)
        n = min(boot.size, gps.shape[0])
        streams.notes.append("time: boot time tied to GPS time by the video frames")
        return float(np.median(week_to_posix(gps[:n, 0], gps[:n, 1]) - boot[:n]))
    for log in _GNSS:
        if source.find(f"{log}/value") is not None:
            boot = _array(source, f"{log}/t", 1)[:, 0]
            utc = _array(source, f"{log}/value", 6)[:, 3] * 1e-3
            n = min(boot.size, utc.size)
            streams.warnings.append("no GPS time of the frames: fixes may stand 0.2 s off the IMU")
            return float(np.max(utc[:n] - boot[:n]))
    streams.warnings.append("no GPS time: times count from when the device booted")
    return 0.0
