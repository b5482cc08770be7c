# SPDX-License-Identifier: Apache-2.0
"""A car seen from above: which wheel something is at, and where the sensor sits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from suspension_twin.arrays import Floats
from suspension_twin.report import style
from suspension_twin.report.style import COLOURS
from suspension_twin.vehicle.corners import CORNERS, WHEELS

__all__ = ["from_above"]

#: m, of an ordinary car: overhangs, half width beyond the wheels' centres, and a wheel.
_FRONT, _REAR, _SIDE, _LONG, _WIDE = 0.85, 0.95, 0.13, 0.62, 0.21


def from_above(
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
    >>> figure = from_above(wheels, {"front_left": 0.5})
    """
    front, rear = float(wheels[:, 0].max()), float(wheels[:, 0].min())
    half = float(np.abs(wheels[:, 1]).max()) + _SIDE
    most = max(shares.values(), default=0.0)
    with style.using():
        fig = style.figure(width, 0.72 * width)
        axes = fig.subplots()
        _boxed(axes, rear - _REAR, -half, front - rear + _FRONT + _REAR, 2 * half, 0.45, "road", 0.35)
        middle = 0.5 * (front + rear)
        _boxed(axes, middle - 1.15, -0.78 * half, 1.95, 1.56 * half, 0.25, "grid", 0.9)
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


def _boxed(
    axes: Axes, x: float, y: float, length: float, width: float, round_: float, role: str, alpha: float
) -> None:
    """A rounded rectangle with its corner at x, y."""
    patch = FancyBboxPatch(
        (x + round_, y + round_),
        length - 2 * round_,
        width - 2 * round_,
        boxstyle=f"round,pad={round_}",
        facecolor=COLOURS[role],
        edgecolor=COLOURS["soft"],
        linewidth=0.9,
        alpha=alpha,
    )
    axes.add_patch(patch)


def _wheel(axes: Axes, x: float, y: float, strength: float, marked: bool) -> None:
    """A wheel, the stronger coloured the more of the gap is at it."""
    place = (x - 0.5 * _LONG, y - 0.5 * _WIDE)
    for colour, alpha in ((COLOURS["soft"], 0.55), (COLOURS["simulated"], strength)):
        axes.add_patch(
            FancyBboxPatch(
                place,
                _LONG,
                _WIDE,
                boxstyle="round,pad=0.02",
                facecolor=colour,
                edgecolor="none",
                alpha=alpha,
                zorder=3,
            )
        )
    if marked:
        axes.plot(
            [x],
            [y],
            marker="o",
            markersize=27,
            fillstyle="none",
            color=COLOURS["simulated"],
            markeredgewidth=2.0,
            zorder=6,
        )
