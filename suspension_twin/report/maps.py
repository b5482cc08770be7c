# SPDX-License-Identifier: Apache-2.0
"""Where a drive went, seen from above."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from suspension_twin.arrays import Floats
from suspension_twin.report import style
from suspension_twin.report.style import COLOURS

__all__ = ["path_map"]

_MAP_PIECES = 400


def path_map(
    x: Floats,
    y: Floats,
    *,
    outline: Floats | None = None,
    heights: tuple[Floats, Floats, Floats] | None = None,
    fixes: Floats | None = None,
    value: Floats | None = None,
    value_label: str = "speed [km/h]",
    turn: float = 0.0,
) -> Figure:
    """The locked path on the ``map`` frame, seen from above, east to the right and north up.

    ``outline`` (k, 2) m is the border of the road file, ``heights`` its (X, Y, Z) mesh drawn
    under it, ``fixes`` (m, 2) the antenna's raw positions; ``value`` (n,) colours the path.
    ``turn`` rad turns the map counter-clockwise, so that a long road lies across the page; an
    arrow then says where north is.
    """
    x, y = _turned(np.column_stack([x, y]), turn).T
    outline = None if outline is None else _turned(outline, turn)
    fixes = None if fixes is None else _turned(fixes, turn)
    if heights is not None:
        mesh_x, mesh_y = np.moveaxis(_turned(np.stack(heights[:2], axis=-1), turn), -1, 0)
        heights = (mesh_x, mesh_y, heights[2])
    with style.using():
        spans = [x, y] if outline is None else [outline[:, 0], outline[:, 1]]
        width, height = (max(float(np.ptp(s)), 1.0) for s in spans)
        fig = style.figure(9.2, float(np.clip(8.0 * height / width + 0.9, 2.6, 7.0)))
        axes = fig.subplots()
        if heights is not None:
            mesh = axes.pcolormesh(*heights, cmap="Greys", alpha=0.55, shading="gouraud", rasterized=True)
            fig.colorbar(mesh, ax=axes, label="road height [m]", shrink=0.8, pad=0.01)
        if outline is not None:
            border = np.vstack([outline, outline[:1]])
            axes.fill(
                border[:, 0], border[:, 1], color=COLOURS["road"], alpha=0.0 if heights else 0.35, linewidth=0
            )
            axes.plot(border[:, 0], border[:, 1], color=COLOURS["soft"], linewidth=0.8, label="road file")
        if fixes is not None:
            axes.plot(
                fixes[:, 0],
                fixes[:, 1],
                ".",
                color=COLOURS["measured"],
                markersize=2.5,
                alpha=0.7,
                label="GPS fixes (antenna)",
                zorder=3,
            )
        if value is None:
            axes.plot(x, y, color=COLOURS["simulated"], linewidth=1.6, label="locked path", zorder=4)
        else:
            # A few hundred pieces show every colour that the eye can tell apart.
            at = np.unique(np.linspace(0, len(x) - 1, min(len(x), _MAP_PIECES)).astype(int))
            points = np.column_stack([x, y])[at][:, None, :]
            pieces = list(np.concatenate([points[:-1], points[1:]], axis=1))
            lines = LineCollection(pieces, cmap="viridis", linewidth=2.2, zorder=4, label="locked path")
            lines.set_array(value[at[:-1]])
            axes.add_collection(lines)
            fig.colorbar(lines, ax=axes, label=value_label, shrink=0.8, pad=0.01)
        axes.plot(x[:1], y[:1], "o", color=COLOURS["truth"], markersize=7, label="start", zorder=6)
        axes.plot(x[-1:], y[-1:], "s", color=COLOURS["bound"], markersize=6, label="end", zorder=6)
        axes.set_aspect("equal", adjustable="datalim")
        if turn:
            north = _turned(np.array([[0.0, 28.0]]), turn)[0]
            axes.annotate(
                "N",
                (0.045, 0.78),
                xycoords="axes fraction",
                xytext=north,
                textcoords="offset points",
                arrowprops={"arrowstyle": "<|-", "color": COLOURS["ink"], "shrinkA": 0, "shrinkB": 0},
                ha="center",
                va="center",
            )
        axes.set(xlabel="[m]" if turn else "east [m]", ylabel="[m]" if turn else "north [m]")
        style.legend(fig, *axes.get_legend_handles_labels())
    return fig


def _turned(points: Floats, angle: float) -> Floats:
    """Points (..., 2) turned counter-clockwise about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))
