# SPDX-License-Identifier: Apache-2.0
"""The bench on an excerpt of its drives, for the first look at many hypotheses.

A first search simulates a hundred and more starts of every effect to find a basin of attraction, which a part of every
drive shows as well as the whole: the stretch of SECONDS with the most information, by the whitened measured signals.
What it finds is fitted to the whole drives afterwards. Priors and noise model are those of the whole drives, so that
unknowns mean the same on both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench, Excitations
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.excited_segments import TrimSettings, fit_rows
from suspension_twin.inference.noise import Whitener
from suspension_twin.inference.prepare import Prepared
from suspension_twin.inference.problem import Problem
from suspension_twin.models.types import Excitation

__all__ = ["SECONDS", "Excerpt", "excerpt_of"]

#: s of every drive that a first search looks at: about twenty periods of the body's bounce.
SECONDS = 15.0


@dataclass(frozen=True, eq=False)
class Excerpt:
    """A ``bench`` on an excerpt, and the ``share`` of the information of the whole drives with the gap in it."""

    bench: Bench
    share: float


def excerpt_of(bench: Bench, x: Floats) -> Excerpt | None:
    """The excerpt of a bench of drives; ``x`` are the unknowns of a vehicle like the one that drove.

    None where it would save less than half, or where the unknowns differ with the length of a drive.
    """
    problem, settings = bench.problem, TrimSettings()
    if not (bench.fused and bench.excitations) or any(w > 0 for w in problem.wander):
        return None
    information = _information(bench)
    lead = settings.lead + 1.0
    windows = [_window(p.t[r], i) for p, r, i in zip(problem.parts, problem.rows, information, strict=True)]
    kept = sum(end - start + lead for start, end, _ in windows)
    if 2.0 * kept > sum(float(p.t[-1] - p.t[0]) for p in problem.parts):
        return None
    cut = [
        _cut(part, known, start - lead, end)
        for part, known, (start, end, _) in zip(problem.parts, bench.excitations, windows, strict=True)
    ]
    parts = [part for part, _ in cut]
    rows = [fit_rows(part, settings) for part in parts]
    if any(r.size < 0.5 * SECONDS * p.rate for p, r in zip(parts, rows, strict=True)):
        return None
    try:
        small = Problem(
            problem.twin,
            problem.space,
            parts,
            problem.drive_of,
            problem.terms,
            problem.priors,
            problem.wander,
            rows,
        )
        whitener = _whitener(bench.whitener, small)
    except (InputError, WorkError):
        return None
    small.interrupt = problem.interrupt
    found = replace(
        bench,
        problem=small,
        excitations=tuple(known for _, known in cut),
        whitener=whitener,
        _known_plain={},
        _stepped_excitations={},
    )
    found.carry(x)
    shown = [i for i, drive in enumerate(problem.drive_of) if bench.active[drive]]
    share = sum(windows[i][2] for i in shown) / max(sum(float(information[i].sum()) for i in shown), 1e-300)
    return Excerpt(found, float(np.clip(share, 1e-3, 1.0)))


def _information(bench: Bench) -> list[Floats]:
    """Of every part, by compared sample: the squares of the whitened measured signals, over all channels."""
    measured = bench.problem.measured
    white = bench.whitener.residuals(np.zeros((*measured.values.shape, 1)))[:, 0]
    total = np.bincount(bench.whitener.row, white**2, len(measured.values))
    return np.split(total, np.cumsum([r.size for r in bench.problem.rows])[:-1])


def _window(t: Floats, information: Floats) -> tuple[float, float, float]:
    """Start and end in s of the stretch of SECONDS with the most information, and how much it has."""
    summed = np.concatenate([[0.0], np.cumsum(information)])
    last = np.searchsorted(t, t + SECONDS, side="right")
    inside = summed[last] - summed[: t.size]
    best = int(np.argmax(inside))
    return float(t[best]), float(t[best] + SECONDS), float(inside[best])


def _cut(part: Prepared, known: Excitations, start: float, end: float) -> tuple[Prepared, Excitations]:
    """A drive and its alternative excitations between two stamps."""
    first, last = np.searchsorted(part.signals.t, [start, end]).tolist()

    def of(whole: Excitation) -> Excitation:
        return _stretch(whole, first, last)

    cut = replace(part.part(start, end), excitation=of(part.excitation))
    return cut, Excitations(
        of(known.upright),
        of(known.turned),
        {k: of(e) for k, e in known.regained.items()},
        {k: of(e) for k, e in known.reclocked.items()},
    )


def _stretch(whole: Excitation, first: int, last: int) -> Excitation:
    """The excitation at stamps ``first`` to ``last``, from static equilibrium on."""
    substeps, motion = whole.substeps[first:last].copy(), whole.motion[first:last].copy()
    substeps[0], motion[0, 0] = 0, 0.0
    path = whole.path
    begin = int(whole.first[first + 1]) - 1  # the heights at the end of the first interval
    rows = whole.first[first : last + 1] - begin
    rows[0] = 0
    return replace(
        whole,
        t=whole.t[first:last],
        substeps=substeps,
        first=rows,
        road=whole.road[begin : int(whole.first[last])],
        motion=motion,
        path=replace(path, x=path.x[first:last], y=path.y[first:last], yaw=path.yaw[first:last]),
    )


def _whitener(whole: Whitener, small: Problem) -> Whitener:
    """The noise model of the whole drives on an excerpt."""
    group = dict(zip(whole.measured.drives, whole.group, strict=True))
    groups = [group[d] for d in small.measured.drives]
    return replace(
        Whitener.with_filters(small.measured, groups, whole.filters, whole.sigma), scale=whole.scale
    )
