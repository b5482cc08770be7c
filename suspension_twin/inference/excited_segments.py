# SPDX-License-Identifier: Apache-2.0
"""Excited segments: the parts of a drive where the road excites the vehicle enough for identification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.inference.observation import Observation

__all__ = ["TrimSettings", "excited", "fit_rows", "trim"]


@dataclass(frozen=True)
class TrimSettings:
    """Criteria of an excited segment.

    ``threshold``: local rms of the vertical acceleration in units of its noise; ``window`` s of that rms; ``before``
    and ``after`` s kept around it (free oscillation shows damping); ``bridge`` s: shorter gaps are not cut; ``lead``
    s simulated but not compared, for the transient from rest to decay; ``slowest`` m/s."""

    threshold: float = 4.0
    window: float = 0.5
    before: float = 0.5
    after: float = 2.0
    bridge: float = 4.0
    lead: float = 2.5
    slowest: float = 0.8


def excited(observation: Observation, settings: TrimSettings) -> NDArray[np.bool_]:
    """(m,) True on the grid samples of a drive where the road excites the moving vehicle."""
    rate = observation.rate
    vertical = observation.measured["vertical_acceleration"]
    floor = max(observation.noise_rms["vertical_acceleration"], 1e-3)
    window = max(3, int(settings.window * rate))
    # the mean of two seconds is road grade and bias, not excitation
    wave = vertical - uniform_filter1d(vertical, max(3, int(2.0 * rate)), mode="nearest")
    rms = np.sqrt(np.maximum(uniform_filter1d(wave**2, window, mode="nearest"), 0.0))
    moving = (np.abs(observation.speed) > settings.slowest) & observation.mask
    active = (rms > settings.threshold * floor) & moving
    return np.asarray(
        _widened(active, int(settings.before * rate), int(settings.after * rate)) & observation.mask
    )


def _widened(active: NDArray[np.bool_], before: int, after: int) -> NDArray[np.bool_]:
    """True from ``before`` samples ahead of every active one to ``after`` behind it."""
    count = np.concatenate([[0], np.cumsum(active)])
    i = np.arange(active.size)
    last = np.minimum(i + before + 1, active.size)
    return np.asarray(count[last] > count[np.maximum(i - after, 0)])


def trim(observation: Observation, settings: TrimSettings) -> list[Observation]:
    """The drive cut to its excited segments, each with its lead; the whole drive if one segment covers 90 % of it."""
    active = excited(observation, settings)
    rows = np.flatnonzero(active)
    if not rows.size:
        return []
    t = observation.t
    starts = [rows[0], *rows[1:][np.diff(rows) > settings.bridge * observation.rate]]
    ends = [*rows[:-1][np.diff(rows) > settings.bridge * observation.rate], rows[-1]]
    pad = 1.0  # transients of the filter
    spans: list[tuple[Floats, Floats]] = [
        (max(t[a] - settings.lead - pad, t[0]), min(t[b] + pad, t[-1]))
        for a, b in zip(starts, ends, strict=True)
    ]
    kept = sum(float(b - a) for a, b in spans)
    if len(spans) == 1 and kept > 0.9 * (t[-1] - t[0]):
        return [observation]
    return [observation.part(float(a), float(b)) for a, b in spans]


def fit_rows(part: Observation, settings: TrimSettings) -> NDArray[np.intp]:
    """Grid samples of a part that are compared: excited, and not within the lead; all of a controlled run."""
    if part.reading is None:
        return np.flatnonzero(part.mask)
    active = excited(part, settings)
    rows = np.flatnonzero(active)
    if rows.size:
        # from the first to the last excited sample, calm samples between included
        between = np.zeros_like(active)
        between[rows[0] : rows[-1] + 1] = True
        active = between & part.mask & (np.abs(part.speed) > settings.slowest)
    if np.abs(part.speed[0]) >= settings.slowest:  # it moved before: how is not known
        active &= part.t > part.t[0] + settings.lead
    return np.flatnonzero(active)
