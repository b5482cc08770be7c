# SPDX-License-Identifier: Apache-2.0
"""Results on a screen: axes to draw on, tables of pandas, and texts of a few lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from suspension_twin.errors import WorkError, printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

__all__ = ["axes_or_new", "bulleted", "table"]


def axes_or_new(ax: Axes | None, xlabel: str, ylabel: str, title: str = "") -> Axes:
    """The axes ``ax``, or those of a new figure, with labels and title; matplotlib is imported here."""
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.subplots(figsize=(9.0, 3.5), layout="constrained")[1]
    ax.set(xlabel=xlabel, ylabel=ylabel, title=printable(title))
    return ax


def table(columns: Mapping[str, Iterable[object]], index: str) -> DataFrame:
    """A table of pandas with one of the ``columns`` as its index.

    Raises
    ------
    WorkError
        pandas, which is no requirement of this package, is not installed.
    """
    try:
        from pandas import DataFrame
    except ImportError:
        raise WorkError("a table takes pandas, which is not installed: pip install pandas") from None
    return DataFrame(dict(columns)).set_index(index)


def bulleted(title: str, lines: Sequence[str], warnings: Sequence[str] = ()) -> str:
    """A title and below it indented lines and warnings, nothing of which a terminal obeys."""
    rows = [title, *(f"  {line}" for line in lines), *(f"  warning: {text}" for text in warnings)]
    return "\n".join(map(printable, rows))
