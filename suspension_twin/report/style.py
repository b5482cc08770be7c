# SPDX-License-Identifier: Apache-2.0
"""The style of all figures: colours and lines by role.

The colours are Okabe and Ito's, which readers with the usual forms of colour blindness can distinguish; line
styles distinguish the roles in print. A figure is drawn with the light colours; inside
a page :func:`svg` puts CSS variables in their place, so that the same figure follows the
reader's light or dark setting.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from cycler import cycler
from matplotlib.figure import Figure

from suspension_twin.files import replacing

__all__ = [
    "COLOURS",
    "DARK",
    "LINES",
    "colour",
    "css_variables",
    "drawing",
    "figure",
    "html",
    "png",
    "save",
    "svg",
    "using",
]

#: Colours by role on a light page. Every value is unique: :func:`svg` finds the role by it.
COLOURS: Final[Mapping[str, str]] = {
    "measured": "#0072B2",
    "simulated": "#D55E00",
    "before": "#8A8F98",
    "truth": "#009E73",
    "bound": "#CC79A7",
    "mark": "#E69F00",
    "extra": "#56B4E9",
    "ink": "#1C2128",
    "soft": "#5B6470",
    "grid": "#DDE1E6",
    "road": "#C9CED6",
}
#: The same roles on a dark page.
DARK: Final[Mapping[str, str]] = {
    "measured": "#5CB8F0",
    "simulated": "#FF8A3D",
    "before": "#9AA1AC",
    "truth": "#3FCF9F",
    "bound": "#E79BC4",
    "mark": "#F5BE41",
    "extra": "#8CCBF5",
    "ink": "#E8EAED",
    "soft": "#A3ABB6",
    "grid": "#343B45",
    "road": "#4A525E",
}
#: Line styles by role, so that a black and white print can be read.
LINES: Final[Mapping[str, dict[str, Any]]] = {
    "measured": {"linestyle": "-", "linewidth": 1.5, "zorder": 4},
    "simulated": {"linestyle": "-", "linewidth": 1.3, "zorder": 5},
    "before": {"linestyle": (0, (4, 1.5)), "linewidth": 1.2, "zorder": 3},
    "truth": {"linestyle": (0, (1.2, 1.2)), "linewidth": 2.0, "zorder": 6},
    "bound": {"linestyle": (0, (6, 2, 1, 2)), "linewidth": 1.0, "zorder": 2},
}
_FONTS: Final = "Inter, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
_LARGEST_SVG: Final = 1_500_000  # characters; a heavier figure goes in as a picture

_RC: Final[Any] = {  # Any: the type of its keys differs between versions of matplotlib
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.labelsize": 9.0,
    "axes.labelcolor": COLOURS["ink"],
    "axes.titlecolor": COLOURS["ink"],
    "axes.edgecolor": COLOURS["soft"],
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "axes.prop_cycle": cycler(
        color=[COLOURS[k] for k in ("measured", "simulated", "truth", "bound", "mark", "extra")]
    ),
    "grid.color": COLOURS["grid"],
    "grid.linewidth": 0.7,
    "text.color": COLOURS["ink"],
    "xtick.color": COLOURS["soft"],
    "ytick.color": COLOURS["soft"],
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.2,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "svg.fonttype": "none",
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
    "agg.path.chunksize": 20_000,
}


def colour(role: str) -> str:
    """The light colour of a role; a colour that is no role comes back as it is."""
    return COLOURS.get(role, role)


@contextmanager
def using() -> Iterator[None]:
    """The house style for everything drawn inside; settings outside stay as they were."""
    with mpl.rc_context(_RC):
        yield


def figure(width: float = 9.2, height: float = 3.4) -> Figure:
    """An empty figure, inches; without pyplot, so that it is never kept alive and needs no display."""
    return Figure(figsize=(width, height), layout="constrained")


@contextmanager
def drawing(
    width: float = 9.2, height: float = 3.4, *panels: int, **settings: Any
) -> Iterator[tuple[Figure, Any]]:
    """An empty figure, inches, and its axes as ``Figure.subplots`` makes them, in the house style for what is drawn
    inside."""
    with using():
        fig = figure(width, height)
        yield fig, fig.subplots(*panels, **settings)


def legend(fig: Figure, handles: Sequence[Any], labels: Sequence[str]) -> None:
    """A legend in a row of its own above everything."""
    fig.suptitle(" ", fontsize=11)  # keeps the row free (matplotlib before 3.7 has no loc="outside ...")
    fig.legend(handles, labels, loc="upper right", ncols=max(len(labels), 1), borderaxespad=0.2)


def svg(fig: Figure, *, salt: str = "figure") -> str:
    """The figure as an ``<svg>`` element whose colours are the page's CSS variables.

    ``salt`` keeps the ids of several figures of one page apart; the same figure with the same
    salt gives the same text.
    """
    buffer = io.StringIO()
    with using(), mpl.rc_context({"svg.hashsalt": salt}):
        _arranged(fig)
        fig.savefig(
            buffer,
            format="svg",
            facecolor="none",
            edgecolor="none",
            metadata={"Date": None, "Creator": None, "Type": None, "Format": None},
        )
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    # Several figures share a page: an id that nothing refers to would only be there twice.
    used = set(re.findall(r"(?:url\(#|href=\"#)([^\")]+)", text))
    text = re.sub(r' id="([^"]+)"', lambda m: m.group(0) if m.group(1) in used else "", text)
    for role, value in COLOURS.items():
        text = re.sub(re.escape(value), f"var(--{role})", text, flags=re.IGNORECASE)
    text = re.sub(r"'DejaVu Sans'(, [^;\"]*)?", _FONTS, text)
    # The element scales with the page: the view box stays, the fixed size goes.
    head, rest = text.split(">", 1)
    head = re.sub(r' (?:width|height)="[^"]*"', "", head)
    return f'{head} role="img">{rest}'


def _arranged(fig: Figure) -> None:
    """Lay the figure out once and for all; left on, the engine does it for a dry run and for the drawing."""
    engine = fig.get_layout_engine()
    if engine is not None:
        engine.execute(fig)
        fig.set_layout_engine(None)


def png(fig: Figure, *, dpi: int = 160) -> bytes:
    """The figure as a PNG on white."""
    buffer = io.BytesIO()
    with using():
        _arranged(fig)
        fig.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def save(fig: Figure, path: str | Path, *, dpi: int = 160) -> None:
    """Write the figure; the format follows from the name's suffix."""
    with using(), replacing(path) as temporary:
        _arranged(fig)
        fig.savefig(temporary, dpi=dpi)


def html(fig: Figure, *, salt: str, label: str) -> str:
    """The figure for a page: an SVG, or a picture where the drawing would be too heavy."""
    text = svg(fig, salt=salt)
    if len(text) <= _LARGEST_SVG:
        return text.replace("<svg", f'<svg aria-label="{label}"', 1)
    data = base64.b64encode(png(fig)).decode()
    return f'<img alt="{label}" src="data:image/png;base64,{data}">'


def css_variables(colours: Mapping[str, str]) -> str:
    """The colours as CSS declarations."""
    return " ".join(f"--{role}: {value};" for role, value in colours.items())
