# SPDX-License-Identifier: Apache-2.0
"""The plots of every report: arrays in, a figure out, nothing kept.

Blue is measured, orange is simulated, grey dashes are the twin as it was before, green dots
are the true values (of a simulated drive). Shapes: a signal is (n,), its stamps (n,) s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.ticker import MaxNLocator

from suspension_twin.arrays import Floats
from suspension_twin.report import style
from suspension_twin.report.style import COLOURS, LINES
from suspension_twin.vehicle.corners import CORNERS, WHEELS

__all__ = [
    "Window",
    "agreement",
    "amplitude_spectra",
    "car_from_above",
    "convergence",
    "in_frequency",
    "in_time",
    "passes",
    "path_map",
    "residual_by_road",
]

ACCELERATION = "vertical acceleration [m/s²]"


@dataclass(frozen=True)
class Window:
    """An interval of a signal with a panel of its own, s on the drive's clock."""

    start: float
    end: float
    label: str = ""


def _line(axes: Axes, role: str, x: Floats, y: Floats, **settings: Any) -> None:
    axes.plot(x, y, **{"color": COLOURS[role], **LINES[role], **settings})


def _legend(fig: Figure, axes: Axes) -> None:
    """One legend above the figure, where it hides nothing."""
    style.legend(fig, *axes.get_legend_handles_labels())


def in_time(
    t: Floats,
    measured: Floats,
    simulated: Floats,
    *,
    before: Floats | None = None,
    windows: Sequence[Window] = (),
    origin: float | None = None,
    label: str = ACCELERATION,
    names: Mapping[str, str] | None = None,
) -> Figure:
    """Measured and simulated over each other, and in a strip below the residual.

    With ``windows`` each interval has its own column, all on one scale; without, the whole drive
    is shown. ``origin`` is the stamp called 0 s (the first one). ``names`` renames "measured",
    "simulated" and "before" in the legend. A NaN leaves a gap.
    """
    names = {
        "measured": "measured",
        "simulated": "simulated",
        "before": "before calibration",
        **(names or {}),
    }
    start = float(t[0]) if origin is None else origin
    columns = list(windows) or [Window(float(t[0]), float(t[-1]))]
    layout: dict[str, Any] = {"sharex": "col", "sharey": "row", "squeeze": False, "height_ratios": [3, 1.2]}
    with style.drawing(9.2, 4.6, 2, len(columns), **layout) as (fig, grid):
        for column, window in enumerate(columns):
            keep = (t >= window.start) & (t <= window.end)
            x = t[keep] - start
            top, strip = grid[0, column], grid[1, column]
            if before is not None:
                _line(top, "before", x, before[keep], label=names["before"])
            _line(top, "measured", x, measured[keep], label=names["measured"])
            _line(top, "simulated", x, simulated[keep], label=names["simulated"])
            if before is not None:
                _line(strip, "before", x, (measured - before)[keep], linewidth=0.9)
            strip.axhline(0.0, color=COLOURS["soft"], linewidth=0.7)
            residual = (measured - simulated)[keep]
            strip.plot(x, residual, color=COLOURS["ink"], linewidth=0.9, zorder=6)
            top.set_xlim(window.start - start, window.end - start)
            top.set_title(window.label)
            strip.set_xlabel("time [s]")
        grid[0, 0].set_ylabel(label)
        grid[1, 0].set_ylabel("measured −\nsimulated")
        fig.align_ylabels(grid[:, 0])
        _legend(fig, grid[0, 0])
    return fig


def in_frequency(
    frequency: Floats,
    densities: Mapping[str, Floats],
    *,
    limits: tuple[float, float] = (0.5, 25.0),
    cutoff: float | None = None,
    unit: str = "(m/s²)²/Hz",
    names: Mapping[str, str] | None = None,
    width: float = 9.2,
) -> Figure:
    """Power spectral densities, one-sided, over frequency (f,) in Hz.

    ``densities`` maps a role ("measured", "simulated", "before", "residual") to its PSD (f,);
    ``cutoff`` marks where the common low-pass begins to take the signal away. ``width`` in inches. The axis ends at the
    upper one of the ``limits`` in Hz, or where the spectra do.
    """
    names = {"before": "before calibration", "residual": "measured − simulated", **(names or {})}
    keep = (frequency > 0.999 * limits[0]) & (
        frequency < 1.001 * limits[1]
    )  # a bin just beside its round value
    with style.drawing(width, min(3.6, 0.72 * width)) as (fig, axes):
        largest = 0.0
        for role, density in densities.items():
            values = np.maximum(density[keep], np.finfo(float).tiny)
            largest = max(largest, float(values.max(initial=0.0)))
            if role == "residual":
                axes.fill_between(
                    frequency[keep],
                    values,
                    1e-30,
                    color=COLOURS["ink"],
                    alpha=0.12,
                    linewidth=0,
                    label=names[role],
                )
            else:
                _line(axes, role, frequency[keep], values, label=names.get(role, role))
        axes.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel=f"spectral density [{unit}]")
        low, high = axes.set_xlim(limits[0], min(limits[1], float(frequency[-1])))
        if largest > 0:
            axes.set_ylim(largest * 1e-5, largest * 2.5)
        ticks = [f for f in (0.5, 1, 2, 3, 5, 10, 20, 50, 100) if low <= f <= high]
        axes.set_xticks(ticks, [f"{f:g}" for f in ticks])
        axes.minorticks_off()
        if cutoff is not None and limits[0] < cutoff < limits[1]:
            axes.axvline(cutoff, color=COLOURS["soft"], linewidth=0.8, linestyle=":")
            axes.annotate(
                "low-pass",
                (cutoff, 0.03),
                xycoords=("data", "axes fraction"),
                xytext=(-4, 0),
                textcoords="offset points",
                ha="right",
                color=COLOURS["soft"],
                fontsize=8,
            )
        _legend(fig, axes)
    return fig


def amplitude_spectra(
    frequency: Floats,
    amplitudes: Mapping[str, Floats],
    *,
    limit: float = 10.0,
    names: Mapping[str, str] | None = None,
) -> Figure:
    """The car paper's Fig. 11 without its mirror image: amplitude spectra up to ``limit`` Hz, m/s².

    ``amplitudes`` maps a role to its spectrum (f,), as ``signals.spectra.power_spectrum`` gives it.
    """
    keep = (frequency >= 0.0) & (frequency <= limit)
    with style.drawing(9.2, 3.2) as (fig, axes):
        for role, amplitude in amplitudes.items():
            _line(axes, role, frequency[keep], amplitude[keep], label=(names or {}).get(role, role))
        axes.set(xlabel="frequency [Hz]", ylabel="amplitude [m/s²]", xlim=(0, limit))
        axes.set_ylim(bottom=0)
        _legend(fig, axes)
    return fig


def residual_by_road(
    distance: Floats,
    residual: Floats,
    *,
    before: Floats | None = None,
    profile: tuple[Floats, Floats] | None = None,
    label: str = "gap, rms [m/s²]",
    profile_label: str = "road [cm]",
    names: Mapping[str, str] | None = None,
) -> Figure:
    """Root mean square of the residual (n,) in each metre along the road, over ``distance`` (n,) m.

    ``profile`` is (distance (k,), height (k,) or (k, 2) for left and right wheel, m) of the road, drawn
    under the bars so that a pothole and its gap stand above each other. NaNs and bins that the drive
    never entered stay empty. ``names`` renames "residual" and "before" in the legend.
    """
    names = {"residual": "measured − simulated", "before": "before calibration", **(names or {})}
    edges = np.arange(np.floor(np.nanmin(distance)), np.nanmax(distance) + 1.0)
    if edges.size < 2:
        edges = np.array([edges[0], edges[0] + 1.0])
    ratios = [2, 1] if profile is not None else [1]
    layout: dict[str, Any] = {"sharex": True, "squeeze": False, "height_ratios": ratios}
    with style.drawing(9.2, 2.0 + len(ratios), len(ratios), **layout) as (fig, grid):
        rows = grid[:, 0]
        if before is not None:
            rows[0].stairs(
                _binned(distance, before, edges),
                edges,
                label=names["before"],
                color=COLOURS["before"],
                linewidth=1.1,
            )
        rows[0].stairs(
            _binned(distance, residual, edges),
            edges,
            fill=True,
            alpha=0.8,
            label=names["residual"],
            color=COLOURS["simulated"],
        )
        rows[0].set_ylabel(label)
        rows[0].set_ylim(bottom=0)
        if profile is not None:
            tracks = np.atleast_2d(profile[1].T)
            sides = [("left wheels", "soft"), ("right wheels", "mark")] if len(tracks) > 1 else [("", "soft")]
            for track, (side, role) in zip(tracks, sides, strict=True):
                rows[1].plot(profile[0], 100 * track, color=COLOURS[role], linewidth=1.0, label=side)
            rows[1].set_ylabel(profile_label)
        rows[-1].set_xlabel("position along the road [m]")
        rows[-1].set_xlim(edges[0], edges[-1])
        fig.align_ylabels(rows)
        entries = [axes.get_legend_handles_labels() for axes in rows]
        style.legend(fig, *([e for pair in entries for e in pair[k]] for k in (0, 1)))
    return fig


def _binned(distance: Floats, values: Floats, edges: Floats) -> Floats:
    """Root mean square per bin, NaN where a bin holds no sample."""
    good = np.isfinite(distance) & np.isfinite(values)
    count, _ = np.histogram(distance[good], edges)
    total, _ = np.histogram(distance[good], edges, weights=values[good] ** 2)
    out: Floats = np.full(count.shape, np.nan)
    np.sqrt(total / np.maximum(count, 1), out=out, where=count > 0)
    return out


def passes(
    before: Sequence[tuple[Floats, Floats]],
    after: Sequence[tuple[Floats, Floats]],
    *,
    label: str = ACCELERATION,
) -> Figure:
    """Passes over one place laid over one another: each a line of a signal (k,) over m driven (k,) in the direction of
    travel, ``before`` and ``after`` they were placed."""
    with style.drawing(9.2, 3.2, 1, 2, sharey=True) as (fig, axes):
        for ax, lines, title in zip(
            axes, (before, after), ("by the receiver", "placed by what was felt"), strict=True
        ):
            for number, (way, values) in enumerate(lines, 1):
                ax.plot(way, values, linewidth=1.0, label=f"pass {number}")
            ax.set_title(title, fontsize=10)
            ax.set_xlabel("m beyond the bump")
        axes[0].set_ylabel(label)
        _legend(fig, axes[0])
    return fig


def convergence(
    evaluations: Floats,
    best: Floats,
    *,
    mean: Floats | None = None,
    stages: Sequence[tuple[float, str]] = (),
    label: str = "cost",
) -> Figure:
    """Best (and mean) cost over the count of simulated candidates; ``stages`` are (evaluation, name) marks."""
    with style.drawing(9.2, 3.2) as (fig, axes):
        if mean is not None:
            _line(axes, "before", evaluations, mean, label="mean of the generation")
        axes.plot(
            evaluations, best, color=COLOURS["simulated"], linewidth=1.8, label="best", drawstyle="steps-post"
        )
        for position, name in stages:
            axes.axvline(position, color=COLOURS["soft"], linewidth=0.8, linestyle=":")
            axes.annotate(
                name,
                (position, 0.97),
                xycoords=("data", "axes fraction"),
                xytext=(4, 0),
                va="top",
                textcoords="offset points",
                color=COLOURS["soft"],
                fontsize=8,
            )
        finite = best[np.isfinite(best) & (best > 0)]
        if finite.size and finite.max() > 5 * finite.min():
            axes.set_yscale("log")
        axes.set(xlabel="evaluations (simulated candidates)", ylabel=label)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        _legend(fig, axes)
    return fig


def agreement(rows: Mapping[str, Mapping[str, float]], *, label: str = "gap, rms [m/s²]") -> Figure:
    """Bars of the gap: ``rows`` maps a drive to {role: value}, roles "before", "simulated", "truth"."""
    names = {"before": "before calibration", "simulated": "calibrated", "truth": "true parameters"}
    with style.drawing(9.2, 0.9 + 0.75 * len(rows)) as (fig, axes):
        drives = list(rows)
        roles = [r for r in ("before", "simulated", "truth") if any(r in row for row in rows.values())]
        thickness = 0.8 / max(len(roles), 1)
        for number, role in enumerate(roles):
            at = [i + (number - (len(roles) - 1) / 2) * thickness for i in range(len(drives))]
            values = [rows[d].get(role, float("nan")) for d in drives]
            bars = axes.barh(at, values, height=0.88 * thickness, color=COLOURS[role], label=names[role])
            axes.bar_label(bars, fmt="%.2f", padding=4, fontsize=8.5)
        axes.set_yticks(range(len(drives)), drives)
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(label)
        axes.margins(x=0.08)
        _legend(fig, axes)
    return fig


# -- seen from above ---------------------------------------------------------------------------------

_MAP_PIECES = 400


def path_map(
    x: Floats,
    y: Floats,
    *,
    outline: Floats | None = None,
    fixes: Floats | None = None,
    value: Floats | None = None,
    turn: float = 0.0,
) -> Figure:
    """The locked path on the ``map`` frame, seen from above, east to the right and north up.

    ``outline`` (k, 2) m is the border of the road file, ``fixes`` (m, 2) the antenna's raw
    positions; ``value`` (n,), the speed in km/h, colours the path.
    ``turn`` rad turns the map counter-clockwise, so that a long road lies across the page; an
    arrow then says where north is.
    """
    x, y = _turned(np.column_stack([x, y]), turn).T
    outline = None if outline is None else _turned(outline, turn)
    fixes = None if fixes is None else _turned(fixes, turn)
    spans = [x, y] if outline is None else [outline[:, 0], outline[:, 1]]
    width, height = (max(float(np.ptp(s)), 1.0) for s in spans)
    with style.drawing(9.2, float(np.clip(8.0 * height / width + 0.9, 2.6, 7.0))) as (fig, axes):
        if outline is not None:
            border = np.vstack([outline, outline[:1]])
            axes.fill(border[:, 0], border[:, 1], color=COLOURS["road"], alpha=0.35, linewidth=0)
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
            fig.colorbar(lines, ax=axes, label="speed [km/h]", shrink=0.8, pad=0.01)
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


#: m, of an ordinary car: overhangs, half width beyond the wheels' centres, and a wheel.
_FRONT, _REAR, _SIDE, _LONG, _WIDE = 0.85, 0.95, 0.13, 0.62, 0.21


def car_from_above(
    wheels: Floats,
    shares: Mapping[str, float],
    *,
    marked: Sequence[str] = (),
    sensor: tuple[float, float] | None = None,
    width: float = 4.5,
) -> Figure:
    """Draw a car from above, its front to the right.

    Parameters
    ----------
    wheels : (4, 2) array
        m, the wheels' places in ``base_link``: front left, front right, rear left, rear right.
    shares : mapping of str to float
        By corner, the share of the gap there; a corner that is left out stays grey.
    marked : sequence of str
        Corners with a ring about them: those that the answer names.
    sensor : tuple of float, optional
        x and y of the sensor in m.
    width : float
        Inches.

    Returns
    -------
    Figure
        With the name and the share of every wheel.

    Examples
    --------
    >>> wheels = np.array([[2.7, 0.8], [2.7, -0.8], [0.0, 0.8], [0.0, -0.8]])
    >>> figure = car_from_above(wheels, {"front_left": 0.5})
    """
    front, rear = float(wheels[:, 0].max()), float(wheels[:, 0].min())
    half = float(np.abs(wheels[:, 1]).max()) + _SIDE
    most = max(shares.values(), default=0.0)
    with style.drawing(width, 0.72 * width) as (fig, axes):
        edge = {"edgecolor": COLOURS["soft"], "linewidth": 0.9}
        length, middle = front - rear + _FRONT + _REAR, 0.5 * (front + rear)
        body = {"facecolor": COLOURS["road"], "alpha": 0.35, **edge}
        cabin = {"facecolor": COLOURS["grid"], "alpha": 0.9, **edge}
        _box(axes, (rear - _REAR, -half), (length, 2 * half), 0.45, **body)
        _box(axes, (middle - 1.15, -0.78 * half), (1.95, 1.56 * half), 0.25, **cabin)
        for (x, y), corner, name in zip(wheels, CORNERS, WHEELS, strict=True):
            share = shares.get(corner, 0.0)
            _wheel(axes, float(x), float(y), share / most if most else 0.0, corner in marked)
            outside = np.sign(y) * (half + 0.3)
            text = f"{name}\n{100 * share:.0f} %" if corner in shares else name
            axes.text(
                x,
                outside,
                text,
                ha="center",
                va="bottom" if y > 0 else "top",
                color=COLOURS["ink"] if corner in marked else COLOURS["soft"],
                fontweight="bold" if corner in marked else "normal",
                fontsize=8.5,
            )
        if sensor is not None:
            axes.plot(*sensor, marker="D", markersize=6, color=COLOURS["measured"], zorder=5)
            axes.annotate(
                "sensor",
                sensor,
                xytext=(0, -12),
                textcoords="offset points",
                ha="center",
                color=COLOURS["measured"],
                fontsize=8,
            )
        axes.annotate(
            "",
            (front + _FRONT + 0.55, 0.0),
            (front + _FRONT + 0.1, 0.0),
            arrowprops={"arrowstyle": "-|>", "color": COLOURS["soft"]},
        )
        axes.set_aspect("equal")
        axes.set_xlim(rear - _REAR - 0.2, front + _FRONT + 0.65)
        axes.set_ylim(-half - 0.9, half + 0.9)
        axes.set_axis_off()
    return fig


def _box(
    axes: Axes, corner: tuple[float, float], size: tuple[float, float], round_: float, **look: Any
) -> None:
    """A rounded rectangle with its ``corner`` at x, y and its ``size`` in x and y."""
    (x, y), (length, width) = corner, size
    patch = FancyBboxPatch(
        (x + round_, y + round_),
        length - 2 * round_,
        width - 2 * round_,
        boxstyle=f"round,pad={round_}",
        **look,
    )
    axes.add_patch(patch)


def _wheel(axes: Axes, x: float, y: float, strength: float, marked: bool) -> None:
    """A wheel, the stronger coloured the more of the gap is at it."""
    place, size = (x - 0.5 * _LONG - 0.02, y - 0.5 * _WIDE - 0.02), (_LONG + 0.04, _WIDE + 0.04)
    for colour, alpha in ((COLOURS["soft"], 0.55), (COLOURS["simulated"], strength)):
        _box(axes, place, size, 0.02, facecolor=colour, edgecolor="none", alpha=alpha, zorder=3)
    if marked:
        ring: dict[str, Any] = {"markersize": 27, "fillstyle": "none", "markeredgewidth": 2.0, "zorder": 6}
        axes.plot([x], [y], "o", color=COLOURS["simulated"], **ring)
