# SPDX-License-Identifier: Apache-2.0
"""Tonal components of the remaining residual: wheel orders and engine frequencies.

Model discrepancy is broadband. Imbalance or runout of a wheel is periodic in distance at any speed (an order), an
engine or a fan in time. The spectra of segments of a drive, over distance and over time, are divided by the level of
their neighbouring bins and averaged: a tonal component exceeds its neighbourhood.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.shrink import RemainingResidual, drives_of
from suspension_twin.inference.problem import Problem

__all__ = ["Tone", "strongest_tone"]

#: By domain (m or s): segment length, grid step, lowest and highest frequency. Wheels of 0.2 to 0.5 m radius, orders 1
#: to 3.
_DOMAINS = {"distance": (120.0, 0.05, 0.3, 1.6), "time": (10.0, 0.01, 2.0, 20.0)}
_LEAST = 0.7  # share of a segment that has to be covered by samples
#: Bins (two per resolution) from a component to the end of its neighbourhood, and of the component itself.
_NEAR, _SELF = 25, 3
#: Prominence in the residual over that in the simulated signal: a component of a periodic road is in both.
_OWN = 2.0


@dataclass(frozen=True)
class Tone:
    """A tonal component ``at`` a frequency in 1/m or Hz: ``strength`` is its ratio to the neighbouring bins,
    ``share`` that of the mean square of the channel."""

    domain: Literal["distance", "time"]
    channel: str
    at: float
    strength: float
    share: float


def strongest_tone(problem: Problem, remaining: RemainingResidual, least_share: float) -> Tone | None:
    """The most prominent tonal component on drives with the gap that has ``least_share`` of the mean square of a
    channel and that reference drives do not show; None without one."""
    found = []
    for domain, (length, step, low, high) in _DOMAINS.items():
        u = np.concatenate(
            [
                (p.position if domain == "distance" else p.t)[r]
                for p, r in zip(problem.data.parts, problem.data.rows, strict=True)
            ]
        )
        k = np.arange(round(length / step) + 1) / (2 * length)
        inside = (k >= low) & (k <= high)
        for c, channel in enumerate(problem.channels):
            if not channel.endswith(("vertical_acceleration", "roll_rate", "pitch_rate")):
                continue
            with_gap, before = (
                _prominence(
                    problem,
                    remaining.with_nuisances[:, c],
                    problem.measured.values[:, c],
                    u,
                    length,
                    step,
                    side,
                )
                for side in (True, False)
            )
            if with_gap is None:
                continue
            strength, made, share = with_gap
            good = inside & (strength > _OWN * made) & (share >= least_share)
            if before is not None:
                good &= strength > _OWN * before[0]
            if good.any():
                i = int(np.argmax(np.where(good, strength, 0.0)))
                found.append(Tone(domain, channel, float(k[i]), float(strength[i]), float(share[i])))  # type: ignore[arg-type]
    return max(found, key=lambda tone: tone.strength, default=None)


def _prominence(
    problem: Problem,
    residual: Floats,
    measured: Floats,
    u: Floats,
    length: float,
    step: float,
    with_gap: bool,
) -> tuple[Floats, Floats, Floats] | None:
    """(F,) prominence of each frequency in the residual and in the simulated signal, and its share of the residual:
    means over segments of the drives with or without the gap. None without segments."""
    of = drives_of(problem)
    ratios, made, tones, total = [], [], [], 0.0
    for drive in (d for d, active in enumerate(problem.data.active) if active == with_gap):
        rows = np.flatnonzero(of == drive)
        way = np.maximum.accumulate(u[rows])
        for begin in np.arange(way[0], way[-1], length):
            own = rows[(way >= begin) & (way < begin + length)]
            if own.size < 32 or np.ptp(u[own]) < _LEAST * length:
                continue
            grid = begin + step * np.arange(round(length / step))
            at = np.maximum.accumulate(u[own])
            window = np.hanning(grid.size) * (grid <= at[-1])
            powers = []
            for values in (residual[own], residual[own] + measured[own]):
                resampled = np.interp(grid, at, values - values.mean())
                powers.append(np.abs(np.fft.rfft(resampled * window, 2 * grid.size)) ** 2)
            around = [_neighbourhood(p) for p in powers]
            ratios.append(powers[0] / around[0])
            made.append(powers[1] / around[1])
            tones.append(2.0 * np.maximum(powers[0] - around[0], 0.0) / window.sum() ** 2)
            total += float(np.var(residual[own]))
    if not ratios:
        return None
    return np.mean(ratios, axis=0), np.mean(made, axis=0), np.sum(tones, axis=0) / max(total, 1e-300)


def _neighbourhood(power: Floats) -> Floats:
    """(F,) mean level of the neighbouring bins: median / log(2), for exponentially distributed powers."""
    beside = np.ones(2 * _NEAR + 1, dtype=bool)
    beside[_NEAR - _SELF : _NEAR + _SELF + 1] = False
    return np.asarray(median_filter(power, footprint=beside, mode="nearest") / np.log(2.0) + 1e-300)
