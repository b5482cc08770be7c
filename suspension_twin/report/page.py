# SPDX-License-Identifier: Apache-2.0
"""A page is a title, a few key figures and sections; it opens anywhere, without a network.

Example::

    page = Page("Calibration", "bump_15kmh, 3 passes")
    page.card("Gap", "0.31 m/s²", "was 1.52 m/s²", mark="good")
    page.add(Section("In time", "Vertical acceleration at the sensor.", figure))
    page.write(folder / "index.html")
"""

from __future__ import annotations

import html as _html
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Literal

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure

from suspension_twin import __version__
from suspension_twin.files import write_text
from suspension_twin.report import style

__all__ = ["Card", "Cell", "Content", "Html", "Lead", "Mark", "Page", "Row", "Section", "Table", "short"]

#: Colour of a cell or card: "good", "warn" (look at it), "bad" (on a bound, not excited), "soft" (aside).
Mark = Literal["", "good", "warn", "bad", "soft"]
#: Columns from which on a table is scrolled sideways on a narrow screen instead of squeezed.
_WIDE = 5


@dataclass(frozen=True)
class Html:
    """HTML that is not escaped; the writer is responsible for its safety."""

    text: str


@dataclass(frozen=True)
class Cell:
    """A table cell with a coloured mark and a note that shows on hovering."""

    value: object
    mark: Mark = ""
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of values or :class:`Cell`; numbers are written short and stand to the right."""

    columns: Sequence[str]
    rows: Sequence[Sequence[object]]
    caption: str = ""


@dataclass(frozen=True)
class Card:
    """One key figure at the top of a page."""

    label: str
    value: str
    note: str = ""
    mark: Mark = ""


@dataclass(frozen=True)
class Row:
    """Small figures side by side, below each other where the page is narrow, and their captions."""

    figures: Sequence[Figure]
    captions: Sequence[str] = ()


@dataclass(frozen=True)
class Lead:
    """The finding of a page, above everything: one sentence, and a few more below it in smaller letters."""

    sentence: str
    remarks: Sequence[str] = ()
    mark: Mark = ""


Content = Figure | Table | Row | Html


class Section:
    """A heading, a text and any number of figures, tables and pieces of HTML under it.

    In ``text`` a blank line parts paragraphs, lines that begin with "- " make a list,
    ``**bold**`` and backticked code work; everything else is escaped. ``captions`` go under
    the figures, in their order. A ``folded`` section shows its heading until it is opened.
    """

    def __init__(
        self,
        title: str,
        text: str = "",
        *content: Content | None,
        captions: Sequence[str] = (),
        folded: bool = False,
    ) -> None:
        self.title, self.text, self.folded = title, text, folded
        self.content = tuple(c for c in content if c is not None)
        self.captions = tuple(captions)


@dataclass
class Page:
    """A report page; ``add`` and ``card`` return the page itself.

    Parameters
    ----------
    title : str
        Heading.
    subtitle : str
        Line below it.
    sections : list of Section
        Text, figures and tables.
    cards : list of Card
        Key figures in the row at the top.
    lead : Lead, optional
        The finding, in a sentence above everything.

    Examples
    --------
    >>> page = Page("Gap").card("rms", "0.11 m/s²")
    >>> "0.11 m/s²" in page.render()
    True
    """

    title: str
    subtitle: str = ""
    sections: list[Section] = field(default_factory=list)
    cards: list[Card] = field(default_factory=list)
    lead: Lead | None = None

    def add(self, section: Section) -> Page:
        """Append a section."""
        self.sections.append(section)
        return self

    def card(self, label: str, value: str, note: str = "", mark: Mark = "") -> Page:
        """Append a key figure to the row at the top."""
        self.cards.append(Card(label, value, note, mark))
        return self

    def render(self) -> str:
        """The whole page as one HTML text: no scripts, no links to other files."""
        anchors = [re.sub(r"[^a-z0-9]+", "-", s.title.lower()).strip("-") or "section" for s in self.sections]
        sections = []
        for number, (section, anchor) in enumerate(zip(self.sections, anchors, strict=True)):
            again = anchors[: number + 1].count(anchor)
            sections.append(
                {
                    "anchor": anchor if again == 1 else f"{anchor}-{again}",
                    "title": section.title,
                    "text": _prose(section.text),
                    "content": list(_content(section, number)),
                    "folded": section.folded,
                }
            )
        return _template().render(
            title=self.title,
            subtitle=self.subtitle,
            cards=self.cards,
            lead=self.lead,
            sections=sections,
            light=Markup(style.css_variables(style.COLOURS)),
            dark=Markup(style.css_variables(style.DARK)),
            version=__version__,
        )

    def write(self, path: str | Path) -> Path:
        """Write the page and return where it is; missing folders are made."""
        write_text(path, self.render())
        return Path(path)


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"inline": _inline, "value": _value}
    return environment.from_string(resources.files(__package__).joinpath("page.html.j2").read_text("utf-8"))


def _content(section: Section, number: int) -> Iterator[dict[str, object]]:
    """Figures, tables and HTML as the template takes them."""
    captions = iter(section.captions)
    for index, item in enumerate(section.content):
        salt = f"{number}-{index}"
        if isinstance(item, Figure):
            yield {"kind": "figure", "figure": _figure(item, next(captions, ""), section.title, salt)}
        elif isinstance(item, Row):
            notes = [*item.captions, *[""] * len(item.figures)]
            drawn = [
                _figure(fig, notes[k], section.title, f"{salt}-{k}") for k, fig in enumerate(item.figures)
            ]
            yield {"kind": "row", "figures": drawn}
        elif isinstance(item, Table):
            yield {"kind": "table", **_table(item)}
        else:
            yield {"kind": "html", "html": Markup(item.text)}


def _figure(fig: Figure, caption: str, title: str, salt: str) -> dict[str, str]:
    label = _html.escape(caption or title, quote=True)
    return {"drawing": Markup(style.html(fig, salt=salt, label=label)), "caption": caption}


def _table(table: Table) -> dict[str, object]:
    """Headings and cells, each with whether its column holds numbers alone."""
    rows = [[c if isinstance(c, Cell) else Cell(c) for c in row] for row in table.rows]
    for row in rows:
        if len(row) != len(table.columns):
            raise ValueError(f"table has {len(table.columns)} columns, a row has {len(row)} cells")
    numeric = [
        bool(rows) and all(isinstance(row[i].value, int | float | None) for row in rows)
        for i in range(len(table.columns))
    ]
    return {
        "caption": table.caption,
        "wide": len(table.columns) >= _WIDE,
        "heads": list(zip(table.columns, numeric, strict=True)),
        "rows": [list(zip(row, numeric, strict=True)) for row in rows],
    }


def _value(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return short(value)
    return Markup(value.text) if isinstance(value, Html) else _inline(str(value))


def short(value: float, digits: int = 4) -> str:
    """A number as people write it: four significant digits and a true minus sign."""
    if math.isnan(value):
        return "–"
    value += 0.0  # nothing has no sign
    if value and not 1e-4 <= abs(value) < 1e7:
        text = f"{value:.{digits - 1}e}"
    else:
        text = f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return text.replace("-", "\u2212")


def _inline(text: str) -> Markup:
    text = _html.escape(text, quote=False)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    return Markup(re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", text))


def _prose(text: str) -> Markup:
    blocks: list[str] = []
    for block in re.split(r"\n\s*\n", text.strip()):
        lines = [line.strip() for line in block.splitlines() if line.strip()]
        if lines and all(line.startswith("- ") for line in lines):
            blocks.append("<ul>" + "".join(f"<li>{_inline(line[2:])}</li>" for line in lines) + "</ul>")
        elif lines:
            blocks.append(f"<p>{_inline(' '.join(lines))}</p>")
    return Markup("".join(blocks))
