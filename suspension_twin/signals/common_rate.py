# SPDX-License-Identifier: Apache-2.0
"""Drives of any IMU rate on one grid for comparison.

Measured and simulated signals pass a low-pass of cut-off f_c, so that a grid of 5 f_c holds them: 100 Hz for the
default of 20 Hz. Recordings at higher rates (400 Hz phone, 1600 Hz BMI160) are low-passed and resampled to that grid
first. Drives of different rates are compared on the lowest of their grids. Recordings near the rate of the grid are
unchanged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from suspension_twin.drive.types import Drive
from suspension_twin.signals.clock import clean_stamps, find_gaps, nominal_rate
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec

__all__ = ["PER_PERIOD", "on_common_rate", "resampled"]

#: Samples for each period of the cut-off: a second-order low-pass is 14 dB down at Nyquist of that grid.
PER_PERIOD = 5.0
#: Times the grid's rate from which on resampling saves anything.
_WORTHWHILE = 1.5
#: Rates that differ by less than this share are those of one sensor whose stamps jitter.
_SAME = 0.01
#: Cut-off of the anti-aliasing low-pass as a share of the new rate: of order 4 and both ways, -3 dB at 40 Hz for 100.
_ANTI_ALIASING, _ORDER = 0.42, 4


def on_common_rate(drives: Sequence[Drive], filter: FilterSpec) -> list[Drive]:
    """The drives on one rate; unchanged where all are near that of the comparison grid.

    Parameters
    ----------
    drives
        Recordings at any rates.
    filter
        The low-pass that the comparison uses.

    Returns
    -------
    list of Drive
        In the same order; a drive with too few stamps for a rate is unchanged.
    """
    rates = [_rate(drive) for drive in drives]
    grid = PER_PERIOD * filter.cutoff
    wanted = [grid if rate > _WORTHWHILE * grid else rate for rate in rates]
    known = [rate for rate in wanted if rate > 0]
    lowest = min(known) if known and max(known) > (1.0 + _SAME) * min(known) else np.inf
    targets = [lowest if own > (1.0 + _SAME) * lowest else own for own in wanted]
    return [
        resampled(drive, target) if 0 < target < rate * (1.0 - _SAME) else drive
        for drive, rate, target in zip(drives, rates, targets, strict=True)
    ]


def _rate(drive: Drive) -> float:
    """Median samples a second of the IMU; 0 where there are too few."""
    stamps = clean_stamps(drive.imu.t).stamps
    return nominal_rate(stamps) if stamps.size > 3 else 0.0


def resampled(drive: Drive, rate: float) -> Drive:
    """The drive with its IMU low-passed without delay and sampled at ``rate`` Hz; gaps stay gaps."""
    imu = drive.imu
    finite = np.isfinite(np.hstack([imu.specific_force, imu.angular_rate])).all(axis=1)
    cleaned = clean_stamps(imu.t, np.asarray(finite))
    spec = FilterSpec(_ORDER, _ANTI_ALIASING * rate)
    path = Conditioner.for_stamps(cleaned.stamps, spec, zero_phase=True)
    kept = cleaned.keep[path.keep]
    signals = np.hstack([imu.specific_force, imu.angular_rate])[kept]
    # the filter starts from zero: filter the deviation from the mean
    mean = signals.mean(axis=0)
    smooth = path.apply(signals - mean) + mean
    count = int((path.grid[-1] - path.grid[0]) * rate) + 1
    t = path.grid[0] + np.arange(count) / rate
    for start, end in find_gaps(path.stamps, path.rate):
        t = t[(t <= start) | (t >= end)]
    read = CubicSpline(path.grid, smooth)(t)
    orientation = imu.orientation
    if orientation is not None:
        nearest = np.clip(np.searchsorted(path.stamps, t), 0, kept.size - 1)
        orientation = orientation[kept][nearest]
    return replace(
        drive,
        imu=replace(imu, t=t, specific_force=read[:, :3], angular_rate=read[:, 3:], orientation=orientation),
    )
