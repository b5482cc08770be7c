# SPDX-License-Identifier: Apache-2.0
"""Standstill detection, and the accelerometer's bias at standstill."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening, uniform_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.signals.filters import FilterSpec, zero_phase

__all__ = [
    "MAX_TILT_DIFFERENCE",
    "STANDSTILL_FILTER",
    "STANDSTILL_FILTER_DELAY",
    "StillLimits",
    "is_still",
    "rest_bias",
    "standstill_filter_step",
    "standstill_mask",
    "white_noise",
]

#: Low-pass before standstill is judged: an idling engine shakes above 20 Hz, a moving car below 10 Hz.
STANDSTILL_FILTER = FilterSpec(2, 10.0)
STANDSTILL_FILTER_DELAY = 2.0 / (2.0 * math.pi * 10.0)  # s
#: rad between the specific force and the gyro's vertical beyond which the vehicle accelerates.
MAX_TILT_DIFFERENCE = 0.03


@dataclass(frozen=True)
class StillLimits:
    """What a standing car with its engine idling does not exceed within a window.

    ``window`` s; ``force`` m/s² and ``rate`` rad/s standard deviations of the noisiest axis below 10 Hz;
    ``turn`` rad/s the largest mean rate, all of it gyro bias. The limits lie between what a car with
    its engine running shows at rest (0.02 m/s², 0.0015 rad/s) and the least it shows on a smooth
    road (0.13 m/s², 0.007 rad/s).
    """

    window: float = 0.5
    force: float = 0.08
    rate: float = 0.005
    turn: float = 0.05


@compiled
def standstill_filter_step(stages: Floats, sample: Floats, dt: float) -> None:  # pragma: no cover - compiled
    """``STANDSTILL_FILTER`` for live samples of any rate: two poles at 10 Hz, delay ``STANDSTILL_FILTER_DELAY``.

    ``stages`` (3, k): the sample before, the first pole, the second pole, which is the result.
    """
    keep = math.exp(-2.0 * dt / STANDSTILL_FILTER_DELAY)
    share = 0.5 * (1.0 - keep)
    for k in range(sample.size):
        first = keep * stages[1, k] + share * (sample[k] + stages[0, k])
        stages[2, k] = keep * stages[2, k] + share * (first + stages[1, k])
        stages[1, k] = first
        stages[0, k] = sample[k]


def is_still(force_std: float, rate_std: float, turn: float, limits: StillLimits) -> bool:
    """Judge one window by its largest standard deviations and largest mean rate."""
    return force_std < limits.force and rate_std < limits.rate and turn < limits.turn


def standstill_mask(
    rate_hz: float, force: Floats, rate: Floats, limits: StillLimits, speed: Floats | None = None
) -> NDArray[np.bool_]:
    """(n,) True where the vehicle stands for at least two windows; ``speed`` (n,) m/s, NaN where not
    known, overrules the IMU above 0.3 m/s. The first and the last half window of a stop are left out."""
    size = max(round(limits.window * rate_hz), 5)
    if len(force) < size:
        return np.zeros(len(force), dtype=np.bool_)
    soft = FilterSpec(STANDSTILL_FILTER.order, min(STANDSTILL_FILTER.cutoff, 0.4 * rate_hz))
    force, rate = zero_phase(soft, rate_hz, force), zero_phase(soft, rate_hz, rate)

    def spread(values: Floats) -> tuple[Floats, Floats]:
        centred = values - np.median(values, axis=0)
        mean = uniform_filter1d(centred, size, axis=0, mode="nearest")
        square = uniform_filter1d(centred**2, size, axis=0, mode="nearest")
        deviation = np.sqrt(np.maximum(square - mean**2, 0.0))
        return deviation.max(axis=1), np.abs(mean + np.median(values, axis=0)).max(axis=1)

    force_std, _ = spread(force)
    rate_std, turn = spread(rate)
    still = (force_std < limits.force) & (rate_std < limits.rate) & (turn < limits.turn)
    if speed is not None:
        # A fast stretch beside the window rules it out too.
        moving = binary_dilation(np.nan_to_num(speed, nan=0.0) > 0.3, iterations=size // 2)
        still &= ~moving
    return np.asarray(binary_opening(still, structure=np.ones(size, dtype=np.bool_)), dtype=np.bool_)


def rest_bias(mean_force: Floats, gravity: float, limit: float) -> Floats:
    """(3,) accelerometer bias from the mean specific force at rest, in nominally upright axes.

    A slope and a horizontal bias read the same. What lies within ``limit`` m/s² is taken for bias,
    a deviation from (0, 0, g) altogether; beyond it for a tilt, and only the error in length,
    along the measured vertical, is removed.
    """
    if math.hypot(float(mean_force[0]), float(mean_force[1])) <= limit and mean_force[2] > 0:
        return np.asarray(mean_force - np.array([0.0, 0.0, gravity]))
    length = float(np.linalg.norm(mean_force))
    return np.asarray(mean_force * (1.0 - gravity / length)) if length > 0 else np.zeros(3)


def white_noise(samples: Floats) -> float:
    """Standard deviation of the white noise on an axis of ``samples`` (n, 3) at rest: of their differences, so that a
    car that rocks on its springs does not count as noise."""
    return (
        float(np.sqrt(np.mean(np.var(np.diff(samples, axis=0), axis=0)) / 2.0)) if len(samples) > 1 else 0.0
    )
