# SPDX-License-Identifier: Apache-2.0
"""ISO/TS 18571, objective rating of non-ambiguous signals, compiled over lanes of candidates.

The standard's constants throughout. The package objective-rating-metrics computes the same for one
signal at a time, in seconds for a whole drive; the tests hold this against it.
"""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled

__all__ = ["rate_lanes"]

INNER, OUTER = 0.05, 0.5  # corridors, shares of the largest measured value
CORRIDOR_POWER = 2.0
MAX_SHIFT = 0.2  # share of the samples
WARP = 0.1  # half width of the warping window, share of the samples
MAGNITUDE_LIMIT = 0.5
SLOPE_LIMIT = 2.0
SLOPE_MEAN = 9  # samples


@compiled
def _corridor(m: Floats, s: Floats) -> float:  # pragma: no cover - compiled
    largest = 0.0
    for i in range(m.size):
        largest = max(largest, abs(m[i]))
    inner, outer = INNER * largest, OUTER * largest
    total = 0.0
    for i in range(m.size):
        off = abs(m[i] - s[i])
        if off < inner:
            total += 1.0
        elif off <= outer:
            total += ((outer - off) / (outer - inner)) ** CORRIDOR_POWER
    return total / m.size


@compiled
def _correlation(m: Floats, s: Floats) -> float:  # pragma: no cover - compiled
    mean_m = mean_s = 0.0
    for i in range(m.size):
        mean_m += m[i] / m.size
        mean_s += s[i] / m.size
    mm = ss = ms = 0.0
    for i in range(m.size):
        dm, ds = m[i] - mean_m, s[i] - mean_s
        mm += dm * dm
        ss += ds * ds
        ms += dm * ds
    spread = math.sqrt(mm * ss)
    return ms / spread if spread > 0.0 else -2.0


@compiled
def _shift(m: Floats, s: Floats) -> int:  # pragma: no cover - compiled
    """Samples by which the simulated signal comes late (negative: early) at the best correlation."""
    best, at = _correlation(m, s), 0
    n = m.size
    for k in range(1, math.floor(n * MAX_SHIFT) + 1):
        early = _correlation(m[: n - k], s[k:])
        if early > best:
            best, at = early, k
        late = _correlation(m[k:], s[: n - k])
        if late > best:
            best, at = late, -k
    return at


@compiled
def _magnitude(m: Floats, s: Floats) -> float:  # pragma: no cover - compiled
    """Score after dynamic time warping with squared distances within a band."""
    n = m.size
    half = math.ceil(WARP * n) - 1
    width = 2 * half + 1
    # Row i of the simulated signal meets columns i - half to i + half of the measured one.
    total = np.empty((n, width))
    for i in range(n):
        for c in range(width):
            total[i, c] = np.inf
        for c in range(max(0, half - i), min(width, n + half - i)):
            j = i - half + c
            cost = (s[i] - m[j]) ** 2
            if i == 0 and j == 0:
                total[i, c] = cost
                continue
            least = np.inf
            if i > 0 and c + 1 < width:
                least = total[i - 1, c + 1]
            if c > 0 and total[i, c - 1] < least:
                least = total[i, c - 1]
            if i > 0 and total[i - 1, c] < least:
                least = total[i - 1, c]
            total[i, c] = cost + least
    i, j = n - 1, n - 1
    off, size = abs(s[i] - m[j]), abs(m[j])
    while i > 0 or j > 0:
        c = j - i + half
        up = total[i - 1, c + 1] if i > 0 and c + 1 < width else np.inf
        back = total[i, c - 1] if c > 0 else np.inf
        both = total[i - 1, c] if i > 0 and j > 0 else np.inf
        if up <= back and up <= both:
            i -= 1
        elif back <= both:
            j -= 1
        else:
            i -= 1
            j -= 1
        off += abs(s[i] - m[j])
        size += abs(m[j])
    share = off / size if size > 0.0 else np.inf
    return max(0.0, (MAGNITUDE_LIMIT - share) / MAGNITUDE_LIMIT)


@compiled
def _slopes(x: Floats, rate: float) -> Floats:  # pragma: no cover - compiled
    """Central differences, averaged over nine samples, over fewer towards the ends."""
    n = x.size
    d = np.empty(n)
    d[0], d[n - 1] = (x[1] - x[0]) * rate, (x[n - 1] - x[n - 2]) * rate
    for i in range(1, n - 1):
        d[i] = 0.5 * (x[i + 1] - x[i - 1]) * rate
    out = np.empty(n)
    for i in range(n):
        reach = min(SLOPE_MEAN // 2, i, n - 1 - i)
        out[i] = 0.0
        for k in range(i - reach, i + reach + 1):
            out[i] += d[k] / (2 * reach + 1)
    return out


@compiled
def _slope(m: Floats, s: Floats, rate: float) -> float:  # pragma: no cover - compiled
    dm, ds = _slopes(m, rate), _slopes(s, rate)
    size = off = 0.0
    for i in range(dm.size):
        size += abs(dm[i])
        off += abs(dm[i] - ds[i])
    share = off / size if size > 0.0 else np.inf
    return max(0.0, (SLOPE_LIMIT - share) / SLOPE_LIMIT)


@compiled
def rate_lanes(measured: Floats, lanes: Floats, rate: float) -> Floats:  # pragma: no cover - compiled
    """(L, 4) corridor, phase, magnitude and slope scores of ``lanes`` (L, n) against ``measured`` (n,)."""
    n = measured.size
    out = np.empty((lanes.shape[0], 4))
    for lane in range(lanes.shape[0]):
        s = lanes[lane]
        shift = _shift(measured, s)
        away = abs(shift)
        if shift >= 0:
            m0, s0 = measured[: n - away], s[away:]
        else:
            m0, s0 = measured[away:], s[: n - away]
        out[lane, 0] = _corridor(measured, s)
        out[lane, 1] = max(0.0, (n * MAX_SHIFT - away) / (n * MAX_SHIFT))
        out[lane, 2] = _magnitude(m0, s0)
        out[lane, 3] = _slope(m0, s0, rate)
    return out
