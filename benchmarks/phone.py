# SPDX-License-Identifier: Apache-2.0
"""Calibration from the drives of an ordinary phone, beside that from RTK."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive, VelocityData
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.signals.common_rate import resampled
from suspension_twin.vehicle.twin import Datum

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class PhoneErrors:
    """Errors of a phone's receiver: standard deviation of a position in each direction in m, correlated over
    ``memory`` s; ``fixes`` a second, ``late`` s behind the IMU's clock; ``doppler`` m/s of a velocity. Its IMU has
    ``rate`` samples a second, their stamps a ``jitter`` s."""

    accuracy: float = 2.5
    memory: float = 60.0
    fixes: float = 1.0
    late: float = 0.4
    doppler: float = 0.1
    rate: float = 67.0
    jitter: float = 1e-3


def phone_grade(drive: Drive, datum: Datum, seed: int, errors: PhoneErrors | None = None) -> Drive:
    """The drive as a phone would have recorded it that has ``errors``, where it was recorded with RTK."""
    e = errors or PhoneErrors()
    rng = np.random.default_rng(seed)
    imu = resampled(drive, e.rate).imu
    jitter = e.jitter * np.clip(rng.standard_normal(len(imu)), -3.0, 3.0)
    stamps = np.maximum.accumulate(imu.t + jitter)
    imu = replace(imu, t=stamps)
    step = (
        max(1, round(1.0 / e.fixes / float(np.median(np.diff(drive.fix.t))))) if e.fixes else len(drive.fix)
    )
    rows = np.arange(rng.integers(step), len(drive.fix), step)
    fix = drive.fix.select(rows)
    offset = e.accuracy * correlated(fix.t, e.memory, rng)
    frame = LocalMap(datum)
    enu = frame.to_map(fix.latitude, fix.longitude, fix.altitude)
    enu[:, :2] += offset
    latitude, longitude, altitude = frame.to_geodetic(enu).T
    sigma = np.tile([e.accuracy, e.accuracy, 2.0 * e.accuracy], (len(fix), 1))
    status = np.zeros(len(fix), dtype=np.int8)
    fix = replace(
        fix,
        t=fix.t + e.late,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        sigma=sigma,
        status=status,
    )
    at = np.clip(np.searchsorted(drive.velocity.t, drive.fix.t[rows]), 0, len(drive.velocity) - 1)
    noise = e.doppler * rng.standard_normal((at.size, 3))
    velocity = VelocityData(drive.velocity.t[at] + e.late, drive.velocity.enu[at] + noise)
    return replace(drive, imu=imu, fix=fix, velocity=velocity)


def correlated(t: Floats, memory: float, rng: np.random.Generator) -> Floats:
    """(n, 2) of unit variance at ``t`` (n,) s, an Ornstein-Uhlenbeck process of that time constant."""
    out = rng.standard_normal((t.size, 2))
    for k in range(1, t.size):
        kept = math.exp(-(t[k] - t[k - 1]) / memory)
        out[k] = kept * out[k - 1] + math.sqrt(1.0 - kept * kept) * out[k]
    return out
