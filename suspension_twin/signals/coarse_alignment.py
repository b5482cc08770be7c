# SPDX-License-Identifier: Apache-2.0
"""Coarse alignment in time of a measured and a simulated drive, before any fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from suspension_twin.arrays import Floats

__all__ = ["coarse_lag"]


def coarse_lag(
    pairs: Sequence[tuple[Floats, Floats]], rate: float, longest: float
) -> tuple[float, float, float]:
    """Lag in s of the largest cross-correlation of measured and simulated signals.

    ``pairs`` of measured and simulated signals of one drive, on one grid at ``rate`` Hz; lags up to ``longest`` s,
    refined by a parabola. Returns the lag (positive: simulated signals come later), the correlation there and at zero
    lag."""
    limit = int(longest * rate)
    total = np.zeros(2 * limit + 1)
    energy = 0.0
    for measured, simulated in pairs:
        a, b = measured - measured.mean(), simulated - simulated.mean()
        norm = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))
        if norm <= 0 or a.size <= limit:
            continue
        size = 1 << (a.size + limit).bit_length()
        circular = np.fft.irfft(np.fft.rfft(b, size) * np.conj(np.fft.rfft(a, size)), size)
        total += np.roll(circular, limit)[: 2 * limit + 1] / norm * a.size
        energy += a.size
    if energy == 0:
        return 0.0, 0.0, 0.0
    total /= energy
    best = int(np.argmax(total))
    lag = float(best - limit)
    if 0 < best < total.size - 1:
        low, mid, high = total[best - 1 : best + 2]
        bend = low - 2 * mid + high
        if bend < 0:
            lag += float(0.5 * (low - high) / bend)
    return lag / rate, float(total[best]), float(total[limit])
