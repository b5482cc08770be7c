# SPDX-License-Identifier: Apache-2.0
"""The noise rms of a channel after the filter."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats, runs
from suspension_twin.signals.conditioner import Conditioner

__all__ = ["floor_rms", "white_noise_sigma"]

_STANDSTILL = 3.0  # s of standstill needed for an estimate there
_WINDOW = 1.0  # s
_QUIETEST = 0.2  # quantile of the windows that have little road excitation near Nyquist


def floor_rms(
    raw: Floats, conditioner: Conditioner, standing: NDArray[np.bool_], filtered: Floats | None = None
) -> float:
    """Rms of the noise in ``conditioner.apply(raw)``, in the unit of ``raw`` (n,).

    From standstill where there are three seconds of it: the filtered signal's spread around its
    mean. Else from the fourth differences of the signal, a high-pass at the Nyquist frequency,
    where the road excitation is weak.
    """
    still = _still_on_grid(conditioner, standing)
    if np.count_nonzero(still) >= _STANDSTILL * conditioner.rate:
        values = conditioner.apply(raw) if filtered is None else filtered
        return _spread_within(values, still)
    return white_noise_sigma(raw, conditioner.rate) * _noise_gain(conditioner)


def white_noise_sigma(raw: Floats, rate: float) -> float:
    """Standard deviation of the white noise in ``raw`` (n,), from its quietest seconds."""
    size = max(16, int(_WINDOW * rate))
    return float(np.sqrt(_quiet_power(raw, size) / _quiet_power_of_one(size)))


def _quiet_power(raw: Floats, size: int) -> float:
    """Power of the fourth differences in the quieter of windows of ``size``, as if they were white noise."""
    difference = np.diff(raw, n=4) ** 2 / 70.0  # 70 is the sum of the squares of 1, -4, 6, -4, 1
    windows = [difference[i : i + size].mean() for i in range(0, max(1, difference.size - size + 1), size)]
    return float(np.quantile(windows, _QUIETEST))


@lru_cache(maxsize=16)
def _quiet_power_of_one(size: int) -> float:
    """The same for white noise of unit rms: the bias of the low quantile."""
    return _quiet_power(np.random.default_rng(0).standard_normal(400 * size), size)


def _noise_gain(conditioner: Conditioner) -> float:
    """Rms of the conditioned signal for white noise of rms one on the stamps."""
    noise = np.random.default_rng(0).standard_normal(conditioner.stamps.size)
    return float(np.sqrt(np.mean(conditioner.apply(noise) ** 2)))


def _still_on_grid(conditioner: Conditioner, standing: NDArray[np.bool_]) -> NDArray[np.bool_]:
    nearest = np.clip(np.searchsorted(conditioner.stamps, conditioner.grid), 0, standing.size - 1)
    return np.asarray(standing[nearest] & conditioner.valid)


def _spread_within(values: Floats, still: NDArray[np.bool_]) -> float:
    """Rms about the mean of each standstill, so that grade and bias drift are not part of it."""
    squares, freedom = 0.0, 0
    for start, end in runs(still):
        part = values[start:end]
        squares += float(np.sum((part - part.mean()) ** 2))
        freedom += part.size - 1
    return float(np.sqrt(squares / max(freedom, 1)))
