# SPDX-License-Identifier: Apache-2.0
"""The static compression of a spring, which a drive does not determine.

A spring at rest carries its load whatever its curve is, and a drive excites the curve only about the static
compression. If the excited piece is moved along the compression and the unexcited segment below makes up the force,
all sensors read the same. A Laplace approximation does not have this direction where a point of the curve is just
outside the excited range. These slides are therefore evaluated on a grid of shifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats

__all__ = ["FARTHEST", "Slide", "changes", "slides", "standing_at"]

_STEP = 0.004  # m between slides
FARTHEST = 0.16  # m
_MISFIT = 0.01  # share of the load by which a curve may miss (0, 0)


@dataclass(frozen=True, eq=False)
class Slide:
    """The curve moved by ``shift`` m: logarithms of its slopes (k,), and the density per m of the prior coordinate of
    the unexcited segment over ``shift``."""

    shift: float
    z: Floats
    density: float


def slides(
    x: Floats, z: Floats, prior: Floats, correlation: float, static: float, seen: Floats
) -> list[Slide]:
    """Curves with the same response about the static compression ``static`` m over the excited compressions ``seen``
    (s,) m.

    ``x`` (k,) m abscissae, ``z`` (k,) logarithms of the slopes, ``prior`` (k,) those of the preset.
    """
    slope = np.exp(z)
    load = _force(x, slope, static)
    old = slope[_segment(x, seen)]
    found: list[Slide] = []
    remainders: list[tuple[float, float, Floats]] = []
    steps = int(FARTHEST / _STEP)
    for shift in _STEP * np.arange(-steps, steps + 1):
        if seen.min() + shift <= 0 or abs(shift) < 0.5 * _STEP:
            continue
        new, lowest = _slid(x, old, prior, z, correlation, seen + shift)
        edge = float(x[lowest - 1]) if lowest else 0.0
        below = load - (_force(x, new, static + shift) - _force(x, new, edge))
        if lowest == 0:
            remainders.append((float(shift), below, new))
        elif below > 0:
            share = np.exp(prior[:lowest])
            new[:lowest] = share * below / _force(x, np.concatenate([share, new[lowest:]]), edge)
            found.append(
                Slide(float(shift), np.log(new), float(slope[_segment(x, np.array([static]))[0]]) / below)
            )
    # with the lowest segment excited, the curve has to pass (0, 0): a few shifts at most
    for (shift, below, new), (_, following, _) in zip(remainders, remainders[1:], strict=False):
        if below * following <= 0 or abs(below) < _MISFIT * load:
            found.append(Slide(shift, np.log(new), 1.0 / max(static + shift, _STEP)))
    return sorted(found, key=lambda slide: slide.shift)


def changes(found: Sequence[Slide]) -> Floats:
    """(k, s) change of the logarithms of the slopes from one grid step to the next about each slide, of those that are
    neighbours: the grid has gaps where a curve cannot be moved, and a wider step about the curve as it is."""
    z = np.stack([s.z for s in found], axis=1)
    near = np.diff([s.shift for s in found]) < 2.5 * _STEP
    step = np.where(near, np.diff(z, axis=1), 0.0)
    none = np.zeros((z.shape[0], 1))
    number = np.concatenate([[0], near]) + np.concatenate([near, [0]])
    before, after = np.concatenate([none, step], axis=1), np.concatenate([step, none], axis=1)
    return np.asarray((before + after) / np.maximum(number, 1))


def _segment(x: Floats, at: Floats) -> np.ndarray:
    """Index of the segment, the last one going on."""
    return np.minimum(np.searchsorted(x, at, side="left"), x.size - 1)


def _force(x: Floats, slope: Floats, at: float) -> float:
    """Force of the curve with these slopes at one compression."""
    edges = np.concatenate([[0.0], x])
    width = np.clip(at - edges[:-1], 0.0, np.diff(edges))
    width[-1] = max(at - edges[-2], 0.0)
    return float(np.sum(slope * width))


def _slid(
    x: Floats, old: Floats, prior: Floats, z: Floats, correlation: float, place: Floats
) -> tuple[Floats, int]:
    """Slopes (k,) after the slide and the lowest excited segment; unexcited ones follow their neighbours by the
    prior."""
    at = _segment(x, place)
    new = np.exp(z).copy()
    sight = np.unique(at)
    for j in sight:
        new[j] = old[at == j].mean()
    for j in range(x.size):
        if j not in sight:
            near = int(sight[np.argmin(np.abs(sight - j))])
            new[j] = np.exp(prior[j] + correlation ** abs(j - near) * (np.log(new[near]) - prior[near]))
    return new, int(sight[0])


def standing_at(x: Floats, z: Floats, static: float, corner: int) -> Floats:
    """Logarithms of slopes (k,) of a curve with the same load at its point ``corner`` instead of at ``static`` m, and
    beyond it with the slope at the static compression."""
    slope = np.exp(z)
    below = _force(x, slope, float(x[corner]))
    new = slope.copy()
    new[: corner + 1] *= _force(x, slope, static) / below
    local = slope[_segment(x, np.array([static]))[0]]
    new[corner + 1 :] *= local / new[corner + 1]
    return np.log(new)
