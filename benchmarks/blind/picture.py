# SPDX-License-Identifier: Apache-2.0
"""The confusion matrix and the reliability of the probabilities, as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from blind.faults import LIBRARY
from blind.score import PLAIN, Row

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Rectangle

_GOOD = LinearSegmentedColormap.from_list("good", ["#ffffff", "#1b7f5c"])
_BAD = LinearSegmentedColormap.from_list("bad", ["#ffffff", "#b3402e"])
_INK, _SOFT = "#1f2933", "#8a94a0"
_NAMED_COMMITS = 4  # that fit into a line


def _tell(row: Row) -> str:
    return str(row["top"]) if row["verdict"] in ("effect", "partly") else str(row["verdict"])


def draw(rows: Sequence[Row], result: dict[str, Any], path: Path) -> None:
    """Write the picture."""
    singles = [r for r in rows if r["kind"] == "single" and r["severity"] >= PLAIN]
    others = {"no effect": "null", "outside the library": "outside", "taken out of it": "excluded"}
    truths = [e for e in LIBRARY if any(r["truth"] == [e] for r in singles)]
    truths += [t for t, kind in others.items() if any(r["kind"] == kind for r in rows)]
    more = sorted({_tell(r) for r in rows} - {*LIBRARY, "no_gap", "unknown", "error"})
    answers = [*LIBRARY, *more, "no_gap", "unknown", "error"]
    counts = np.zeros((len(truths), len(answers)))
    for i, truth in enumerate(truths):
        kind = others.get(truth)
        own = (
            [r for r in rows if r["kind"] == kind] if kind else [r for r in singles if r["truth"] == [truth]]
        )
        for r in own:
            counts[i, answers.index(_tell(r))] += 1
    if not counts[:, -1].any():
        answers, counts = answers[:-1], counts[:, :-1]
    right = {t: t for t in LIBRARY} | {t: "no_gap" if t == "no effect" else "unknown" for t in others}
    height = 2.6 + 0.34 * len(truths)
    figure, (axes, below) = plt.subplots(
        1, 2, figsize=(16.5, max(height, 6.0)), width_ratios=(4.2, 1.0), layout="constrained"
    )
    _matrix(axes, counts, truths, answers, [answers.index(right[t]) for t in truths])
    _reliability(below, result["reliability"])
    figure.suptitle(
        f"Diagnosis of withheld effects: {result['cases']} cases, {result['seeds']} seeds, "
        f"{_versions(result['commit'])}",
        color=_INK,
        fontsize=13,
        x=0.01,
        ha="left",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, facecolor="white")
    plt.close(figure)


def _versions(commits: Sequence[str]) -> str:
    if len(commits) > _NAMED_COMMITS:
        return f"answered by {len(commits)} versions"
    return f"commit {', '.join(c[:7] for c in commits)}"


def _matrix(axes: Axes, counts: np.ndarray, truths: list[str], answers: list[str], right: list[int]) -> None:
    if not truths:  # faint cases and pairs alone
        axes.set_axis_off()
        return
    total = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    share = counts / total
    colours = np.ones((*share.shape, 3))
    for i in range(share.shape[0]):
        for j in range(share.shape[1]):
            colours[i, j] = (_GOOD if j == right[i] else _BAD)(share[i, j])[:3]
    axes.imshow(colours, aspect="auto")
    for i, j in zip(*np.nonzero(counts), strict=True):
        dark = share[i, j] > 0.55
        axes.text(
            j,
            i,
            f"{int(counts[i, j])}",
            ha="center",
            va="center",
            fontsize=9,
            color="white" if dark else _INK,
        )
    for i, j in enumerate(right):
        axes.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, fill=False, edgecolor=_SOFT, linewidth=1.0))
    axes.set_xticks(
        range(len(answers)), [a.replace("_", " ") for a in answers], rotation=55, ha="right", fontsize=9
    )
    names = [f"{t.replace('_', ' ')}  ({int(n)})" for t, n in zip(truths, counts.sum(axis=1), strict=True)]
    axes.set_yticks(range(len(truths)), names, fontsize=9)
    axes.set_xticks(np.arange(-0.5, len(answers)), minor=True)
    axes.set_yticks(np.arange(-0.5, len(truths)), minor=True)
    axes.grid(which="minor", color="#e6e9ed", linewidth=0.6)
    axes.tick_params(which="both", length=0, colors=_INK)
    axes.spines[:].set_visible(False)
    axes.set_xlabel("answer", color=_INK)
    axes.set_ylabel("truth (number of cases; single effects at 1.5 floors and above)", color=_INK)
    axes.set_title("green: the right answer (boxed), red: a wrong one", fontsize=10, color=_SOFT, loc="left")


def _reliability(axes: Axes, bins: Sequence[dict[str, float]]) -> None:
    axes.plot([0, 1], [0, 1], color=_SOFT, linewidth=1.0)
    axes.plot([b["said"] for b in bins], [b["right"] for b in bins], "o-", color="#1b7f5c", markersize=5)
    for b in bins:
        axes.annotate(
            f"{b['n']}",
            (b["said"], b["right"]),
            textcoords="offset points",
            xytext=(7, -9),
            fontsize=8,
            color=_SOFT,
        )
    axes.set_xlim(-0.03, 1.15)
    axes.set_ylim(-0.08, 1.08)
    axes.set_aspect("equal")
    axes.set_xlabel("probability said", color=_INK)
    axes.set_ylabel("share right", color=_INK)
    axes.set_title("probabilities (number of answers)", fontsize=10, color=_SOFT, loc="left")
    axes.tick_params(colors=_INK, labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
