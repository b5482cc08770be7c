# SPDX-License-Identifier: Apache-2.0
"""The problem on an excerpt of its drives, for the first look at many hypotheses.

A first search simulates a hundred and more starts of every effect to find a basin of attraction, which a part of every
drive shows as well as the whole: the stretch of SECONDS with the most information, by the whitened measured signals.
The result is fitted to the whole drives afterwards. Priors and noise model are those of the whole drives, so that
unknowns mean the same on both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.excited_segments import TrimSettings, fit_rows
from suspension_twin.inference.noise import Whitener
from suspension_twin.inference.problem import Problem, effective_weight, whitener_of

__all__ = ["SECONDS", "Excerpt", "excerpt_of"]

#: s of every drive that a first search looks at: about twenty periods of the body's bounce.
SECONDS = 15.0


@dataclass(frozen=True, eq=False)
class Excerpt:
    """A ``problem`` on an excerpt, and the ``share`` of the information of the whole drives with the gap in it."""

    problem: Problem
    share: float


def excerpt_of(problem: Problem, x: Floats) -> Excerpt | None:
    """The excerpt of a problem of drives; ``x`` are the unknowns of a vehicle like the one that drove.

    None where it would save less than half, or where the unknowns differ with the length of a drive.
    """
    data, settings = problem.data, TrimSettings()
    readable = all(part.reading is not None for part in data.parts)
    if not (problem.simulation.fused and readable) or any(".wander." in n for n in problem.nuisances.names):
        return None
    information = _information(problem)
    lead = settings.lead + 1.0
    windows = [_window(p.t[r], i) for p, r, i in zip(data.parts, data.rows, information, strict=True)]
    kept = sum(end - start + lead for start, end, _ in windows)
    if 2.0 * kept > problem.seconds:
        return None
    parts = [
        part.excerpt(start - lead, end) for part, (start, end, _) in zip(data.parts, windows, strict=True)
    ]
    rows = [fit_rows(part, settings) for part in parts]
    if any(r.size < 0.5 * SECONDS * p.rate for p, r in zip(parts, rows, strict=True)):
        return None
    small = replace(data, parts=tuple(parts), rows=tuple(rows))
    whole = whitener_of(problem)
    try:
        group = dict(zip(whole.measured.drives, whole.group, strict=True))
        groups = [group[d] for d in small.measured.drives]
        noise = Whitener.with_filters(small.measured, groups, whole.filters, whole.sigma)
    except (InputError, WorkError):
        return None
    noise = replace(noise, scale=whole.scale)
    likelihood = replace(
        problem.likelihood,
        data=small,
        nuisances=small.nuisances(problem.nuisances.priors),
        noise=noise,
        weight=effective_weight(noise),
    )
    found = replace(problem, likelihood=likelihood).with_planar_response(x)
    shown = [i for i, drive in enumerate(data.drive_of) if data.active[drive]]
    share = sum(windows[i][2] for i in shown) / max(sum(float(information[i].sum()) for i in shown), 1e-300)
    return Excerpt(found, float(np.clip(share, 1e-3, 1.0)))


def _information(problem: Problem) -> list[Floats]:
    """Of every part, by compared sample: the squares of the whitened measured signals, over all channels."""
    measured, noise = problem.measured, whitener_of(problem)
    white = noise.residuals(np.zeros((*measured.values.shape, 1)))[:, 0]
    total = np.bincount(noise.row, white**2, len(measured.values))
    return np.split(total, np.cumsum([r.size for r in problem.data.rows])[:-1])


def _window(t: Floats, information: Floats) -> tuple[float, float, float]:
    """Start and end in s of the stretch of SECONDS with the most information, and how much it has."""
    summed = np.concatenate([[0.0], np.cumsum(information)])
    last = np.searchsorted(t, t + SECONDS, side="right")
    inside = summed[last] - summed[: t.size]
    best = int(np.argmax(inside))
    return float(t[best]), float(t[best] + SECONDS), float(inside[best])
