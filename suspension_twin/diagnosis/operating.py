# SPDX-License-Identifier: Apache-2.0
"""Localisation of the gap by corner and by operating point: spring travel, signed damper velocity, speed.

Shares are of the energy of the gap above the noise. Significance is by block bootstrap over segments of a second
(Künsch 1989), with a false discovery rate of 0.1 over all intervals tested (Benjamini and Hochberg 1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import false_discovery_control

from suspension_twin.arrays import Floats, runs
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.corners import CORNERS
from suspension_twin.vehicle.twin import Twin

__all__ = ["DRAWS", "FALSE_DISCOVERY_RATE", "by_motion", "ranked"]

#: s of a block of the bootstrap (Künsch 1989), its draws, and the rate of false discoveries (Benjamini, Hochberg 1995).
_SECONDS, DRAWS, FALSE_DISCOVERY_RATE = 1.0, 1000, 0.1
_BINS, _STANDS_OUT, _LEAST_SHARE, _MOST = 10, 1.25, 0.02, 8


def by_motion(with_gap: Sequence[Any], excess: Sequence[Floats], twin: Twin, seed: int = 0) -> dict[str, Any]:
    """``corner`` and ``operating_point`` of diagnosis.json for drives (prepared, compared rows) and the energy of the
    gap (r,) of each; ``twin`` is simulated for the motion of the suspension."""
    travel, speed, driven, blocks, first = [], [], [], [], 0
    for part, rows in with_gap:
        response = simulate_twin(twin, part.excitation)
        at = np.clip(np.searchsorted(response.t, part.t[rows]), 0, response.t.size - 1)
        travel.append(response.deflection[at] - response.deflection[0])
        speed.append(response.deflection_rate[at])
        driven.append(np.abs(part.along[rows]))
        _, block = np.unique(np.floor((part.t[rows] - part.t[0]) / _SECONDS), return_inverse=True)
        blocks.append(block + first)
        first = int(blocks[-1].max()) + 1
    block, amount = np.concatenate(blocks), np.concatenate(list(excess))
    drawn = np.random.default_rng(seed).multinomial(first, np.full(first, 1.0 / first), DRAWS).astype(float)
    deflection, velocity = np.concatenate(travel), np.concatenate(speed)
    quantities = [("speed", np.concatenate(driven), "m/s")]
    for axle, own in twin.axles.items():
        quantities += [
            (f"{axle} damper velocity".strip(), _larger(velocity[:, own.columns]), "m/s"),
            (f"{axle} spring travel".strip(), _larger(deflection[:, own.columns]), "m"),
        ]
    return {
        "corner": _corners(velocity, amount, block, drawn) if velocity.shape[1] == len(CORNERS) else [],
        "operating_point": _points(quantities, amount, block, drawn),
    }


def ranked(items: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The ``_MOST`` largest shares of at least ``_LEAST_SHARE``, largest first."""
    return sorted((i for i in items if i["share"] >= _LEAST_SHARE), key=lambda i: -float(i["share"]))[:_MOST]


def _larger(values: Floats) -> Floats:
    """(n,) signed value of the wheel with the larger magnitude, of (n, wheels)."""
    return np.asarray(values[np.arange(len(values)), np.argmax(np.abs(values), axis=1)])


def _corners(velocity: Floats, amount: Floats, block: np.ndarray, drawn: Floats) -> list[dict[str, Any]]:
    """Share of the gap by corner: regression of its envelope on the damper speeds of the corners. Corners with a
    significant share, and always the largest."""
    drive = np.abs(velocity) / np.maximum(np.std(velocity, axis=0), 1e-9)
    count = drawn.shape[1]
    products = (*(drive * drive[:, i : i + 1] for i in range(4)), drive * np.sqrt(amount)[:, None])
    sums = np.stack([[np.bincount(block, c, count) for c in p.T] for p in products])  # (5, 4, B)

    def shares(at: Floats) -> Floats:
        """(k, 4) for sums (k, 5, 4)."""
        gram = at[:, :4] + 1e-9 * np.trace(at[:, :4], axis1=1, axis2=2)[:, None, None] * np.eye(4)
        weight = np.maximum(np.linalg.solve(gram, at[:, 4, :, None])[:, :, 0], 0.0)
        return np.asarray(weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12))

    found = shares(sums.sum(axis=2)[None])[0]
    sure = (shares(np.einsum("kb,pcb->kpc", drawn, sums, optimize=False)) > _LEAST_SHARE).mean(axis=0) >= 0.95
    order = np.argsort(-found, kind="stable")
    return [
        {"name": CORNERS[i], "share": round(float(found[i]), 4)}
        for n, i in enumerate(order)
        if n == 0 or sure[i]
    ]


def _points(
    quantities: Sequence[tuple[str, Floats, str]], amount: Floats, block: np.ndarray, drawn: Floats
) -> list[dict[str, Any]]:
    """Ranges of each quantity, by deciles of its samples, in which the gap is significantly above its mean."""
    tried = []
    for name, values, unit in quantities:
        edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1)))
        bins = edges.size - 1
        if bins < 2:
            continue
        cell = block * bins + np.clip(np.digitize(values, edges[1:-1]), 0, bins - 1)
        sums, counts = (
            np.bincount(cell, w, drawn.shape[1] * bins).reshape(-1, bins)
            for w in (amount, np.ones(amount.size))
        )

        def ratio(s: Floats, n: Floats) -> Floats:
            usual = s.sum(axis=-1, keepdims=True) / np.maximum(n.sum(axis=-1, keepdims=True), 1.0)
            return np.asarray(s / np.maximum(n, 1.0) / np.maximum(usual, 1e-30))

        draws = ratio(*(np.einsum("kb,bi->ki", drawn, v, optimize=False) for v in (sums, counts)))
        chance = np.clip((draws <= 1.0).mean(axis=0), 0.5 / DRAWS, 1.0)
        whole = ratio(sums.sum(axis=0), counts.sum(axis=0))
        tried.append((name, unit, edges, sums.sum(axis=0), whole, chance))
    if not tried:
        return []
    kept = false_discovery_control(np.concatenate([t[-1] for t in tried])) < FALSE_DISCOVERY_RATE
    points: list[dict[str, Any]] = []
    first, total = 0, max(float(amount.sum()), 1e-30)
    for name, unit, edges, energy, whole, chance in tried:
        flags = kept[first : first + chance.size] & (whole > _STANDS_OUT)
        first += chance.size
        for a, b in runs(flags):
            points.append(
                {
                    "quantity": name,
                    "low": round(float(edges[a]), 4),
                    "high": round(float(edges[b]), 4),
                    "unit": unit,
                    "share": round(float(energy[a:b].sum()) / total, 4),
                }
            )
    return ranked(points)
