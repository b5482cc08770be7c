# SPDX-License-Identifier: Apache-2.0
"""Simulated sensor readings: time shift, gain, tilt and bias applied to simulated signals. Compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled

__all__ = ["read_alike", "read_any", "read_steady"]


@compiled
def read_any(
    simulated: Floats,
    rows: NDArray[np.intp],
    shift: Floats,
    gain: Floats,
    bias: Floats,
    about: Floats,
    tilt: Floats,
    lever: Floats,
    turned: NDArray[np.intp],
    table: Floats,
    out: Floats,
    low: int,
    high: int,
) -> None:  # pragma: no cover - compiled
    """out[i, c, l] = gain[c, l] * signal + bias[c, l] + tilt[:, l] * about[:, i, c] for low <= i < high.

    ``signal`` is channel c of ``simulated`` at rows[i] + shift[i, l], held at both ends, plus lever[c, l] times
    the slope by sample of channel turned[c] if that is not negative.
    """
    m, _, given = simulated.shape
    channels = out.shape[1]
    phases, taps, lanes = table.shape[0] - 1, table.shape[1], out.shape[2]
    w = np.zeros(taps + 4)  # two of nothing at either end: the slope's weights are differences of these
    for i in range(low, high):
        begin = 0
        while begin < lanes:
            # of one given signal, lanes that are shifted alike share everything
            end = begin + 1
            while given == 1 and end < lanes and shift[i, end] == shift[i, begin]:
                end += 1
            place = rows[i] + shift[i, begin]
            j = int(np.floor(place))
            fine = (place - j) * phases
            p = min(int(fine), phases - 1)
            fine -= p
            first = j - taps // 2  # of the slope's samples: one before the value's own
            for k in range(taps):
                w[k + 2] = (1.0 - fine) * table[p, k] + fine * table[p + 1, k]
            source = begin if given > 1 else 0
            for c in range(channels):
                x, y, other = about[0, i, c], about[1, i, c], turned[c]
                value, slope = 0.0, 0.0
                for k in range(taps):
                    value += w[k + 2] * simulated[min(max(first + k + 1, 0), m - 1), c, source]
                if other >= 0:
                    for k in range(taps + 2):
                        of = simulated[min(max(first + k, 0), m - 1), other, source]
                        slope += 0.5 * (w[k] - w[k + 2]) * of
                for lane in range(begin, end):
                    signal = gain[c, lane] * (value + lever[c, lane] * slope)
                    out[i, c, lane] = signal + bias[c, lane] + tilt[0, lane] * x + tilt[1, lane] * y
            begin = end


@compiled
def read_alike(
    simulated: Floats,
    carried: Floats,
    rows: NDArray[np.intp],
    shift: Floats,
    gain: Floats,
    bias: Floats,
    about: Floats,
    tilt: Floats,
    lever: Floats,
    turned: NDArray[np.intp],
    table: Floats,
    out: Floats,
    low: int,
    high: int,
) -> None:  # pragma: no cover - compiled
    """As ``read_any`` for one shift (r,) of all lanes. The response ``carried`` (m, C; none: (0, C)) to the planar
    motion is not shifted. ``turned`` = C stands for the second derivative of the channel itself.

    One loop over all channels and lanes vectorises.
    """
    m, channels, lanes = simulated.shape
    phases, taps = table.shape[0] - 1, table.shape[1]
    side = simulated.reshape(m, channels * lanes)
    to, more = np.empty(channels * lanes), np.empty(lanes)
    w, slope, bend = np.empty(taps), np.empty(taps + 2), np.empty(taps + 4)
    at = np.empty(taps + 4, dtype=np.intp)
    for i in range(low, high):
        place = rows[i] + shift[i]
        j = int(np.floor(place))
        fine = (place - j) * phases
        p = min(int(fine), phases - 1)
        fine -= p
        for k in range(taps):
            w[k] = (1.0 - fine) * table[p, k] + fine * table[p + 1, k]
        for k in range(taps + 2):
            slope[k] = 0.5 * ((w[k - 2] if k >= 2 else 0.0) - (w[k] if k < taps else 0.0))
        for k in range(taps + 4):
            bend[k] = 0.5 * ((slope[k - 2] if k >= 2 else 0.0) - (slope[k] if k < taps + 2 else 0.0))
            at[k] = min(max(j - taps // 2 - 1 + k, 0), m - 1)
        a0, a1, a2, a3, a4, a5, a6, a7 = at[2], at[3], at[4], at[5], at[6], at[7], at[8], at[9]
        w0, w1, w2, w3, w4, w5, w6, w7 = w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7]
        for x in range(to.size):
            to[x] = (
                w0 * side[a0, x]
                + w1 * side[a1, x]
                + w2 * side[a2, x]
                + w3 * side[a3, x]
                + w4 * side[a4, x]
                + w5 * side[a5, x]
                + w6 * side[a6, x]
                + w7 * side[a7, x]
            )
        for c in range(channels):
            other, still, moved, own = turned[c], 0.0, 0.0, c * lanes
            if carried.shape[0] > 0:
                still = carried[rows[i], c]
                for k in range(taps):
                    moved += w[k] * carried[at[k + 2], c]
            if other >= 0:
                first, count, weights = (0, taps + 4, bend) if other == channels else (1, taps + 2, slope)
                of = c if other == channels else other
                more[:] = 0.0
                for k in range(count):
                    f, a = weights[k], at[first + k]
                    plain = carried[a, of] if carried.shape[0] > 0 else 0.0
                    for lane in range(lanes):
                        more[lane] += f * (side[a, of * lanes + lane] - plain)
                for lane in range(lanes):
                    to[own + lane] += lever[c, lane] * more[lane]
            x, y = about[0, i, c], about[1, i, c]
            for lane in range(lanes):
                value = gain[c, lane] * (to[own + lane] - moved) + bias[c, lane]
                out[i, c, lane] = value + tilt[0, lane] * x + tilt[1, lane] * y + still


@compiled
def read_steady(
    simulated: Floats,
    rows: NDArray[np.intp],
    shift: Floats,
    gain: Floats,
    bias: Floats,
    about: Floats,
    tilt: Floats,
    table: Floats,
    out: Floats,
    low: int,
    high: int,
) -> None:  # pragma: no cover - compiled
    """As ``read_any`` for a constant shift (L,) of each lane and no lever arms.

    The weights of each lane are computed once: the case of a population whose candidates have their own clock offsets.
    """
    m, channels, _ = simulated.shape
    phases, taps, lanes = table.shape[0] - 1, table.shape[1], out.shape[2]
    w, first = np.empty((taps, lanes)), np.empty(lanes, dtype=np.intp)
    for lane in range(lanes):
        j = int(np.floor(shift[lane]))
        fine = (shift[lane] - j) * phases
        p = min(int(fine), phases - 1)
        fine -= p
        first[lane] = j - taps // 2 + 1
        for k in range(taps):
            w[k, lane] = (1.0 - fine) * table[p, k] + fine * table[p + 1, k]
    earliest, latest = first.min(), first.max() + taps - 1
    for i in range(low, high):
        inside = rows[i] + earliest >= 0 and rows[i] + latest < m
        for c in range(channels):
            x, y = about[0, i, c], about[1, i, c]
            for lane in range(lanes):
                start, value = rows[i] + first[lane], 0.0
                if inside:
                    for k in range(taps):
                        value += w[k, lane] * simulated[start + k, c, lane]
                else:
                    for k in range(taps):
                        value += w[k, lane] * simulated[min(max(start + k, 0), m - 1), c, lane]
                out[i, c, lane] = (
                    gain[c, lane] * value + bias[c, lane] + tilt[0, lane] * x + tilt[1, lane] * y
                )
