# SPDX-License-Identifier: Apache-2.0
"""Springs and dampers of one or several vehicles over each other, with their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import Band
from suspension_twin.report import style
from suspension_twin.report.style import COLOURS, LINES
from suspension_twin.vehicle.twin import Suspension

__all__ = ["AxleEvidence", "HasAxles", "characteristics", "force"]


class HasAxles(Protocol):
    """A vehicle with springs and dampers."""

    @property
    def axles(self) -> Mapping[str, Suspension]: ...


@dataclass(frozen=True)
class AxleEvidence:
    """Evidence of a drive on one axle: bands, the ranges it excited and the points it did not.

    ``spring``, ``push`` and ``pull`` are bands (or None); ``compression`` m and ``velocity`` m/s
    the excited ranges (push positive, pull negative); ``unexcited`` the (kind, abscissa) of
    points that the drive does not identify, kind one of "spring", "push", "pull".
    """

    spring: Band | None = None
    push: Band | None = None
    pull: Band | None = None
    compression: tuple[float, float] | None = None
    velocity: tuple[float, float] | None = None
    unexcited: Sequence[tuple[str, float]] = field(default=())


def force(points: tuple[Floats, Floats], x: Floats) -> Floats:
    """A characteristic at ``x`` >= 0: through (0, 0), linear between points, on with its last slope.

    ``points`` are abscissae and forces (k,) in N; ``x`` (m,) comes back as forces (m,).
    """
    ax = np.concatenate([[0.0], points[0]])
    af = np.concatenate([[0.0], points[1]])
    slope = (af[-1] - af[-2]) / (ax[-1] - ax[-2])
    return np.asarray(np.where(x > ax[-1], af[-1] + slope * (x - ax[-1]), np.interp(x, ax, af)))


def characteristics(
    vehicles: Mapping[str, HasAxles],
    *,
    evidence: Mapping[str, AxleEvidence] | None = None,
    names: Mapping[str, str] | None = None,
    from_rest: bool = False,
) -> Figure:
    """An axle beside the other, springs above and dampers below; forces of one wheel at the wheel.

    ``vehicles`` maps a role ("before", "simulated", "truth") to a vehicle; ``evidence`` maps
    the axles to what the drive identifies. Jounce (push) is drawn to the right and upwards,
    rebound (pull) to the left and downwards. The axes cover the range that the drive excited, else
    the vehicles' points.

    With ``from_rest`` springs are drawn over the travel from standstill instead of the compression
    from free length, and so is the evidence. A drive identifies the travel, not the free length,
    since at rest every spring carries the same load.
    """
    names = {"before": "before calibration", "simulated": "calibrated", "truth": "truth", **(names or {})}
    evidence = evidence or {}
    reach_x = _reach([e.compression for e in evidence.values()], vehicles, "spring")
    reach_v = _reach([e.velocity for e in evidence.values()], vehicles, "damper")
    axles = list(next(iter(vehicles.values())).axles)
    layout: dict[str, Any] = {"sharey": "row", "sharex": "row", "squeeze": False}
    with style.drawing(9.2, 6.2, 2, len(axles), **layout) as (fig, grid):
        for column, axle in enumerate(axles):
            found = evidence.get(axle, AxleEvidence())
            spring, damper = grid[0, column], grid[1, column]
            spring.set_title(f"{axle} spring".strip())
            damper.set_title(f"{axle} damper".strip())
            _range(spring, found.compression, "excited by the drive")
            _range(damper, found.velocity)
            panels = {"spring": spring, "push": damper, "pull": damper}
            for role, vehicle in vehicles.items():
                for kind, curve in _curves(vehicle.axles[axle], from_rest).items():
                    low, reach = (-reach_x, reach_x) if kind == "spring" else (0.0, reach_v)
                    label = names.get(role, role) if kind == "spring" else None
                    _draw(panels[kind], role, curve, (low, reach), label)
            if "simulated" in vehicles:
                simulated = _curves(vehicles["simulated"].axles[axle], from_rest)
                for kind, x in found.unexcited:
                    _ring(panels[kind], simulated[kind], x)
            _bands(spring, damper, found)
            spring.set_xlabel(
                "travel from standstill [m]" if from_rest else "compression from free length [m]"
            )
            damper.set_xlabel("velocity [m/s]   ← rebound · jounce →")
            damper.axhline(0, color=COLOURS["soft"], linewidth=0.7)
            damper.axvline(0, color=COLOURS["soft"], linewidth=0.7)
        grid[0, 0].set(ylabel="force at the wheel [kN]", xlim=(-reach_x if from_rest else 0, reach_x))
        if not from_rest:
            grid[0, 0].set_ylim(bottom=0)
        grid[1, 0].set(ylabel="force at the wheel [kN]", xlim=(-reach_v, reach_v))
        fig.align_ylabels(grid[:, 0])
        style.legend(fig, *grid[0, 0].get_legend_handles_labels())
    return fig


def _reach(
    ranges: Sequence[tuple[float, float] | None], vehicles: Mapping[str, HasAxles], kind: str
) -> float:
    """Limit of an axis: 15 % beyond the excited range, else the last point of any vehicle."""
    excited = [max(abs(r[0]), abs(r[1])) for r in ranges if r is not None]
    if excited:
        return 1.15 * max(excited)
    parts = [own.part for vehicle in vehicles.values() for own in vehicle.axles.values()]
    if kind == "spring":
        return float(max(part.spring.compression[-1] for part in parts))
    return float(max(d.velocity[-1] for part in parts for d in (part.damper_push, part.damper_pull)))


class _Curve(NamedTuple):
    """Points (k,) of a characteristic, drawn at ``sign`` (x - ``shift``), ``sign`` F(x)."""

    points: tuple[Floats, Floats]
    sign: float
    shift: float


def _curves(own: Suspension, from_rest: bool) -> dict[str, _Curve]:
    """The characteristics of an axle by kind."""
    return {
        "spring": _Curve(own.part.spring.points, 1.0, own.static_compression if from_rest else 0.0),
        "push": _Curve(own.part.damper_push.points, 1.0, 0.0),
        "pull": _Curve(own.part.damper_pull.points, -1.0, 0.0),
    }


def _draw(axes: Axes, role: str, curve: _Curve, span: tuple[float, float], label: str | None) -> None:
    """A curve over a span of its abscissa, with its own points; a truth is a curve without points."""
    (x, f), sign, shift = curve
    low, high = max(span[0] + shift, 0.0), span[1] + shift
    inside = (x > low) & (x <= high)
    at = np.concatenate([[low], x[inside], [high]])
    line = {"color": COLOURS[role], "label": label, **LINES[role]}
    axes.plot(sign * (at - shift), sign * force(curve.points, at) / 1e3, **line)
    if role != "truth":
        dots = {"color": COLOURS[role], "markersize": 3.6, "zorder": LINES[role]["zorder"]}
        axes.plot(sign * (x[inside] - shift), sign * f[inside] / 1e3, "o", **dots)


def _ring(axes: Axes, curve: _Curve, x: float) -> None:
    """A ring about the point of a curve at ``x``."""
    y = float(force(curve.points, np.array([x]))[0])
    place = [curve.sign * (x - curve.shift)], [curve.sign * y / 1e3]
    axes.plot(*place, "o", markersize=7, markerfacecolor="none", color=COLOURS["bound"], zorder=7)


def _range(axes: Axes, span: tuple[float, float] | None, label: str | None = None) -> None:
    if span is not None:
        axes.axvspan(span[0], span[1], color=COLOURS["extra"], alpha=0.13, linewidth=0, label=label)


def _bands(spring: Axes, damper: Axes, found: AxleEvidence) -> None:
    for axes, band, sign in (
        (spring, found.spring, 1.0),
        (damper, found.push, 1.0),
        (damper, found.pull, -1.0),
    ):
        if band is not None:
            axes.fill_between(
                sign * band.x,
                sign * band.low / 1e3,
                sign * band.high / 1e3,
                color=COLOURS["simulated"],
                alpha=0.22,
                linewidth=0,
                zorder=1,
                label="interval" if axes is spring else None,
            )
