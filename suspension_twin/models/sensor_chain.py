# SPDX-License-Identifier: Apache-2.0
"""The sensor's chain behind the ideal sensor: stages of effects, then the clock of its stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models.constants import Outside
from suspension_twin.models.sensor import rotation
from suspension_twin.models.types import Excitation, Ints

__all__ = [
    "TABLE",
    "TAPS",
    "Chain",
    "pass_chain",
    "pass_clock",
]

_UNEVEN = 0.01  # of a step


class Chain:
    """The stages of L lanes with their state, for a stretch of a drive or one stamp at a time."""

    def __init__(self, known: Outside) -> None:
        self._stages = [
            (stage, values, np.zeros((stage.states, known.lanes))) for stage, values in known.stages
        ]
        self._axes = rotation(known.mounting)

    def __bool__(self) -> bool:
        return bool(self._stages)

    def reset(self) -> None:
        """Forget what has passed."""
        for _, _, state in self._stages:
            state[:] = 0.0

    def process(self, signals: Floats, t: Floats, fresh: NDArray[np.bool_]) -> None:
        """Change ``signals`` (n, 7, L) at ``t`` (n,) s in place; ``fresh`` (n,) marks fresh starts."""
        for stage, values, state in self._stages:
            if not stage.own_axes:
                stage.process(signals, t, fresh, values, state)
                continue
            turned = signals.copy()
            turned[:, :3] = np.einsum("ij,njl->nil", self._axes.T, signals[:, :3], optimize=False)
            before = turned[:, :3].copy()
            stage.process(turned, t, fresh, values, state)
            more = np.einsum("ij,njl->nil", self._axes, turned[:, :3] - before, optimize=False)
            signals[:, :3] += more
            signals[:, 6] += more[:, 2]


def pass_chain(known: Outside, excitation: Excitation, signals: Floats) -> None:
    """The chain over a whole drive, in place; ``signals`` (n, 7, L) as the ideal sensor read them."""
    Chain(known).process(signals, excitation.t, excitation.substeps == 0)
    pass_clock(known, excitation, signals)


def pass_clock(known: Outside, excitation: Excitation, signals: Floats) -> None:
    """The clock alone over a whole drive, in place; ``signals`` (n, q, L) as they were taken."""
    if known.clock is not None:
        stamps = excitation.t, excitation.substeps
        _restamp(
            *stamps, _even(*stamps), signals.copy(), known.clock.delay, known.clock.drift, TABLE, signals
        )


def _even(t: Floats, substeps: Ints) -> NDArray[np.bool_]:
    """(n,) whether the stamps that the table needs around the gap after each lie evenly, on one stretch."""
    n, before = t.size, TAPS // 2 - 1
    even = np.zeros(n, dtype=bool)
    if n < TAPS:
        return even
    gaps = np.lib.stride_tricks.sliding_window_view(np.diff(t), TAPS - 1)
    middle = gaps[:, before]
    fresh = np.lib.stride_tricks.sliding_window_view(substeps[1:] == 0, TAPS - 1).any(axis=1)
    close = np.abs(gaps - middle[:, None]).max(axis=1) <= _UNEVEN * middle
    even[before : before + middle.size] = close & ~fresh
    return even


@compiled
def _restamp(
    t: Floats,
    substeps: Ints,
    even: NDArray[np.bool_],
    plain: Floats,
    delay: Floats,
    drift: Floats,
    table: Floats,
    out: Floats,
) -> None:
    """Read ``plain`` (n, q, L) at earlier times, by the windowed sinc of ``table`` where stamps are ``even`` (n,), else
    by cubics through four of them, ends held.

    A lane without delay keeps its numbers. Nothing reaches across a fresh start.
    """
    n, taps, phases = t.size, table.shape[1], table.shape[0] - 1
    w = np.empty(taps)
    begin = 0
    while begin < out.shape[2]:
        # lanes of one clock offset share their weights, and the loop over them vectorises
        offset, pace = delay[begin], drift[begin]
        end = begin + 1
        while end < out.shape[2] and delay[end] == offset and drift[end] == pace:
            end += 1
        k = 0
        for row in range(n if offset != 0.0 or pace != 0.0 else 0):
            at = t[row] - offset - pace * (t[row] - t[0])
            while k < n - 2 and t[k + 1] <= at:
                k += 1
            while k > 0 and t[k] > at:
                k -= 1
            if n < 2 or at <= t[0] or at >= t[n - 1] or substeps[k + 1] == 0:
                nearest = k if n < 2 or at - t[k] <= t[k + 1] - at else k + 1
                for channel in range(out.shape[1]):  # the compiler is two seconds quicker than with slices
                    for lane in range(begin, end):
                        out[row, channel, lane] = plain[nearest, channel, lane]
                continue
            h = t[k + 1] - t[k]
            s = (at - t[k]) / h
            if even[k]:
                p = min(int(s * phases), phases - 1)
                fine = s * phases - p
                for i in range(taps):
                    w[i] = (1.0 - fine) * table[p, i] + fine * table[p + 1, i]
                first = k - taps // 2 + 1
                for q in range(out.shape[1]):
                    to = out[row, q, begin:end]
                    to[:] = 0.0
                    for i in range(taps):
                        many, f = plain[first + i, q, begin:end], w[i]
                        for lane in range(to.size):
                            to[lane] += f * many[lane]
                continue
            before = k > 0 and substeps[k] > 0
            after = k + 2 < n and substeps[k + 2] > 0
            for q in range(out.shape[1]):
                for lane in range(begin, end):
                    a, b = plain[k, q, lane], plain[k + 1, q, lane]
                    slope = (b - a) / h
                    left = right = slope
                    if before:
                        left = _slope(
                            (a - plain[k - 1, q, lane]) / (t[k] - t[k - 1]), slope, t[k] - t[k - 1], h
                        )
                    if after:
                        then = t[k + 2] - t[k + 1]
                        right = _slope(slope, (plain[k + 2, q, lane] - b) / then, h, then)
                    out[row, q, lane] = (
                        (1 + 2 * s) * (1 - s) ** 2 * a
                        + s * (1 - s) ** 2 * h * left
                        + s * s * (3 - 2 * s) * b
                        + s * s * (s - 1) * h * right
                    )
        begin = end


@compiled
def _slope(before: float, after: float, h0: float, h1: float) -> float:
    """Derivative at the middle of three stamps, of the parabola through them."""
    return (before * h1 + after * h0) / (h0 + h1)


TAPS, _PHASES = 8, 512


def _phase_table() -> Floats:
    """(phases + 1, taps) weights of the samples around a place between two of them."""
    phase = np.arange(_PHASES + 1)[:, None] / _PHASES
    distance = np.arange(TAPS)[None, :] - (TAPS // 2 - 1) - phase
    window = np.i0(6.0 * np.sqrt(np.maximum(0.0, 1.0 - (distance / (TAPS / 2)) ** 2)))
    weights = np.sinc(distance) * window
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


#: A windowed sinc over eight samples, tabled by phase: to 0.07 % at up to a quarter of the sampling rate, where
#: a cubic through four would be off by a tenth.
TABLE = _phase_table()
