# SPDX-License-Identifier: Apache-2.0
"""A picture of a road: its heights, its place in ``map``, the wheel paths and their spectrum."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import replacing
from suspension_twin.road.check import PathFigures, RoadCheck, check_road, wheel_paths
from suspension_twin.road.road import Road
from suspension_twin.road.roughness import CLASSES, N0, road_psd, roughness, smoothed_psd

__all__ = ["check_picture", "road_figure", "save_road_picture"]

_LEFT, _RIGHT, _SPIKE, _INK, _FAINT = "#1f6fb2", "#d1661c", "#c2185b", "#22262b", "#8a929b"
_STYLE: dict[str, object] = {
    "font.size": 9.5,
    "axes.edgecolor": _FAINT,
    "axes.labelcolor": _INK,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "text.color": _INK,
}


def save_road_picture(road: Road | RoadCheck, path: str | os.PathLike[str], track: float = 1.5) -> None:
    """Draw :func:`road_figure` into a file (.png, .svg or .pdf). Raises InputError, WorkError."""
    check_picture(path)
    figure = road_figure(road, track)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150, facecolor="white")


def check_picture(path: str | os.PathLike[str]) -> None:
    """Raise InputError for a file that is named neither .png nor .svg nor .pdf."""
    if Path(path).suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(path, "a picture is written as .png, .svg or .pdf; name the file so")


def road_figure(road: Road | RoadCheck, track: float = 1.5) -> Figure:
    """The picture as a matplotlib figure; wheel paths ``track`` m apart about the middle of the road."""
    import matplotlib

    checked = road if isinstance(road, RoadCheck) else check_road(road)
    road = checked.road
    with matplotlib.rc_context(_STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(13.0, 9.2), layout="constrained")
        figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)  # type: ignore[union-attr,call-arg]
        grid = figure.add_gridspec(3, 2, height_ratios=[1.0, 1.0, 1.55], width_ratios=[1.25, 1.0])
        top, middle = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, :])
        spectrum, place = figure.add_subplot(grid[2, 0]), figure.add_subplot(grid[2, 1])
        at, left, right = wheel_paths(road, track)
        _height_map(figure, top, checked, at)
        _paths(middle, checked, at, left, right)
        middle.sharex(top)
        _spectrum(spectrum, checked, left, right)
        _place(place, road)
        facts = checked.facts
        figure.suptitle(f"{road.name}\n", x=0.012, ha="left", fontsize=15, fontweight="bold", color=_INK)
        figure.text(
            0.012,
            0.957,
            f"{facts['length']}   |   {facts['width']}   |   {_spike_text(checked)}   |   IRI {facts['IRI']}",
            fontsize=9.5,
            color="#555c64",
            va="top",
        )
    return figure


def _spike_text(checked: RoadCheck) -> str:
    count = len(checked.spikes)
    if not count:
        return "no spikes"
    worst = checked.spikes.found[0]
    spikes = f"{count} spike" if count == 1 else f"{count} spikes, the worst"
    return f"{spikes} with a step of {1e3 * worst.step:.0f} mm at u {worst.u:.2f} m"


def _unit(values: Floats) -> tuple[float, str]:
    """Factor and name of the unit that suits heights."""
    span = float(np.nanmax(values) - np.nanmin(values))
    return (1.0, "m") if span > 1.0 else (1e3, "mm")


def _height_map(figure: Figure, axes: Axes, checked: RoadCheck, at: tuple[float, float]) -> None:
    road = checked.road
    # A raster of the picture's own size: a road has more points than a screen along, fewer across.
    u = np.linspace(road.u_first, road.u_last, 1800)
    v = np.linspace(road.v[0], road.v[-1], 240)
    samples = road.sample_uv(u[None, :], v[:, None], "hold")
    factor, unit = _unit(samples.z[samples.inside] if samples.inside.any() else samples.z)
    z = np.where(samples.inside, samples.z, np.nan) * factor
    low, high = float(np.nanmin(z)), float(np.nanmax(z))
    if high - low < 1e-9:
        low, high = low - 1.0, high + 1.0
    image = axes.imshow(
        _shaded(z, low, high),
        extent=(road.u_first, road.u_last, road.v[0], road.v[-1]),
        origin="lower",
        aspect="auto",
        interpolation="nearest",
    )
    image.set(cmap="viridis", clim=(low, high))
    bar = figure.colorbar(image, ax=axes, pad=0.008, aspect=14, fraction=0.03)
    bar.set_label(f"height [{unit}]")
    bar.outline.set_visible(False)  # type: ignore[operator]
    for v_path, colour in zip(at, (_LEFT, _RIGHT), strict=True):
        axes.axhline(v_path, color="white", lw=2.4, alpha=0.85)
        axes.axhline(v_path, color=colour, lw=1.2)
    if len(checked.spikes):
        axes.plot(
            [s.u for s in checked.spikes.found],
            [0.5 * (s.v_low + s.v_high) for s in checked.spikes.found],
            "o",
            mfc="none",
            mec=_SPIKE,
            ms=7,
            mew=1.3,
            clip_on=False,
        )
    rings = " and spikes (rings)" if len(checked.spikes) else ""
    axes.set(facecolor="#e6e8ea", title=f"Height map, with the wheel paths{rings}", ylabel="v [m], left up")
    axes.tick_params(labelbottom=False)


def _shaded(z: Floats, low: float, high: float) -> Floats:
    """Colours of heights, lit from the upper left so that short waves show; missing ones clear."""
    import matplotlib

    held = np.where(np.isnan(z), low, z)
    scaled = np.clip((held - low) / (high - low), 0.0, 1.0)
    rgb = matplotlib.colormaps["viridis"](scaled)
    light = LightSource(azdeg=315, altdeg=50).hillshade(scaled, vert_exag=25.0)
    shade = 0.72 + 0.56 * (light - 0.5)
    rgb[..., :3] = np.clip(rgb[..., :3] * np.clip(shade + 0.18, 0.55, 1.18)[..., None], 0.0, 1.0)
    rgb[..., 3] = np.where(np.isnan(z), 0.0, 1.0)
    return np.asarray(rgb, dtype=np.float64)


def _paths(axes: Axes, checked: RoadCheck, at: tuple[float, float], left: Floats, right: Floats) -> None:
    road = checked.road
    factor, unit = _unit(np.concatenate([left, right]))
    alike = np.allclose(left, right, rtol=0.0, atol=1e-6)
    # The right path lies under the left one: wide enough to be seen where they are the same.
    axes.plot(
        road.u, right * factor, color=_RIGHT, lw=2.2 if alike else 1.0, label=f"right, v = {at[1]:.2f} m"
    )
    label = f"left, v = {at[0]:.2f} m" + (" (the same)" if alike else "")
    axes.plot(road.u, left * factor, color=_LEFT, lw=0.9, label=label)
    met = [(s.u, v) for s in checked.spikes.found for v in at if s.v_low - 0.05 <= v <= s.v_high + 0.05]
    if met:
        u, v = np.array(met).T
        z = road.heights_uv(u, v, "hold") * factor
        axes.plot(u, z, "o", mfc="none", mec=_SPIKE, ms=6, mew=1.3, label="spikes in a path")
    for path, v_colour in zip(checked.wheel_paths, (_LEFT, _RIGHT), strict=True):
        for event in () if path.roughness is None else path.roughness.events:
            axes.axvspan(event.start, event.end, color=v_colour, alpha=0.10, lw=0)
    shaded = any(p.roughness is not None and p.roughness.events for p in checked.wheel_paths)
    axes.set(
        title="Wheel paths" + (", events shaded" if shaded else ""),
        xlabel="u along the reference line [m]",
        ylabel=f"height [{unit}]",
    )
    axes.grid(alpha=0.25)
    axes.margins(x=0.0)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3, frameon=False, fontsize=8.5)


def _spectrum(axes: Axes, checked: RoadCheck, left: Floats, right: Floats) -> None:
    road = checked.road
    paths = {p.side: p for p in checked.wheel_paths}
    axes.set(
        title="Spectrum of the wheel paths beside the ISO 8608 classes",
        xlabel="spatial frequency [cycles/m]",
        ylabel="displacement PSD [m³]",
        xscale="log",
        yscale="log",
    )
    drawn = []
    for z, colour, side in ((right, _RIGHT, "right"), (left, _LEFT, "left")):
        try:
            n, psd = road_psd(z, road.u_step)
        except InputError:
            continue
        drawn.append(psd[psd > 0.0])
        axes.plot(n, psd, color=colour, lw=0.5, alpha=0.3)
        centres, means = smoothed_psd(n, psd)
        axes.plot(
            centres,
            means,
            color=colour,
            lw=1.9,
            marker="o",
            ms=2.6,
            label=f"{side}, {_class_text(paths[side])}",
        )
    edge = np.array([min(max(1.0 / road.length, 1e-3), 0.01), max(0.5 / road.u_step, 10.0)])
    for k, letter in enumerate(CLASSES):
        low, high = (f * roughness(letter) * (edge / N0) ** -2.0 for f in (0.5, 2.0))
        axes.fill_between(edge, low, high, color=f"{0.955 - 0.045 * k:.3f}", lw=0, zorder=0)
    axes.set_xlim(edge[0], edge[1])
    _limits(axes, drawn)
    bottom, ceiling = axes.get_ylim()
    for letter in CLASSES:
        # Each letter where its class enters the picture, at the left or along the top.
        at = edge[0] * 1.25
        y = roughness(letter) * (at / N0) ** -2.0
        if y > ceiling / 1.6:
            y = ceiling / 2.2
            at = N0 * np.sqrt(roughness(letter) / y)
        if y > bottom * 1.5 and at < edge[1] / 1.2:
            axes.text(
                at, y, letter, ha="center", va="center", color="#59616a", fontsize=9.5, fontweight="bold"
            )
    axes.grid(alpha=0.18, which="major")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    if drawn:
        axes.legend(loc="lower left", frameon=True, framealpha=0.85, edgecolor="none", fontsize=8.5)
    else:
        axes.text(0.5, 0.5, "too short for a spectrum", transform=axes.transAxes, ha="center", color=_FAINT)


def _class_text(path: PathFigures) -> str:
    if path.roughness is None:
        return "band means"
    r = path.roughness
    return f"class {r.letter}" + (f" without events, {r.letter_with_events} with" if r.events else "")


def _limits(axes: Axes, drawn: list[Floats]) -> None:
    """The power that there is, a decade of room, and classes A to C at least."""
    low, high = 1e-9, 1e-2
    values = np.concatenate(drawn) if drawn else np.zeros(0)
    if values.size:
        # A level road's spectrum is rounding noise, forty decades down.
        low = max(min(low, 0.3 * float(np.quantile(values, 0.02))), 1e-13)
        high = max(high, 3.0 * float(values.max()))
    axes.set_ylim(low, high)


def _place(axes: Axes, road: Road) -> None:
    rows = np.unique(np.linspace(0, road.u.size - 1, 1500).astype(np.intp))
    u = road.u[rows]
    right, left = (np.column_stack(road.uv_to_xy(u, np.full(u.size, v))) for v in road.v[[0, -1]])
    outline = np.vstack([right, left[::-1], right[:1]])
    axes.fill(outline[:, 0], outline[:, 1], color="#c9d3dc", lw=0)
    axes.plot(outline[:, 0], outline[:, 1], color=_FAINT, lw=0.8)
    axes.plot(road.x[rows], road.y[rows], color=_INK, lw=1.0, ls=(0, (6, 3)))
    axes.plot(road.x[0], road.y[0], "o", color=_INK, ms=6)
    end = (road.x[-1], road.y[-1])
    before = (
        end[0] - 1e-3 * road.length * np.cos(road.headings[1]),
        end[1] - 1e-3 * road.length * np.sin(road.headings[1]),
    )
    axes.annotate("", end, before, arrowprops={"arrowstyle": "-|>", "color": _INK, "mutation_scale": 16})
    axes.annotate("start", (road.x[0], road.y[0]), textcoords="offset points", xytext=(7, 7), fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.grid(alpha=0.25)
    axes.set(title="Place in map", xlabel="east [m]", ylabel="north [m]")
