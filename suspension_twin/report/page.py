# SPDX-License-Identifier: Apache-2.0
"""A page is a title, a few key figures and sections; it opens anywhere, without a network.

Example::

    page = Page("Calibration", "bump_15kmh, 3 passes")
    page.card("Gap", "0.31 m/s²", "was 1.52 m/s²", mark="good")
    page.add(Section("In time", "What the sensor felt.", figure))
    page.write(folder / "index.html")
"""

from __future__ import annotations

import html as _html
import math
import re
from collections.abc import Sequence
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
    """HTML taken as it is; the writer answers for its safety."""

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
    """What a page has to say, above everything: one sentence, and a few more below it in smaller letters."""

    sentence: str
    remarks: Sequence[str] = ()
    mark: Mark = ""


Content = Figure | Table | Row | Html


@dataclass(frozen=True)
class Section:
    """A heading, a text and any number of figures, tables and pieces of HTML under it.

    In ``text`` a blank line parts paragraphs, lines that begin with "- " make a list,
    ``**bold**`` and backticked code work; everything else is escaped. ``captions`` go under
    the figures, in their order. A ``folded`` section shows its heading until it is opened.
    """

    title: str
    text: str = ""
    content: tuple[Content, ...] = ()
    captions: tuple[str, ...] = ()
    folded: bool = False

    def __init__(
        self,
        title: str,
        text: str = "",
        *content: Content | None,
        captions: Sequence[str] = (),
        folded: bool = False,
    ) -> None:
        object.__setattr__(self, "title", title)
        object.__setattr__(self, "text", text)
        object.__setattr__(self, "content", tuple(c for c in content if c is not None))
        object.__setattr__(self, "captions", tuple(captions))
        object.__setattr__(self, "folded", folded)


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
        What the page has to say, in a sentence above everything.

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
        seen: dict[str, int] = {}
        sections = []
        for number, section in enumerate(self.sections):
            anchor = re.sub(r"[^a-z0-9]+", "-", section.title.lower()).strip("-") or "section"
            seen[anchor] = seen.get(anchor, 0) + 1
            if seen[anchor] > 1:
                anchor = f"{anchor}-{seen[anchor]}"
            sections.append(
                {
                    "anchor": anchor,
                    "title": section.title,
                    "text": _prose(section.text),
                    "content": _content(section, number),
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
    return environment.from_string(resources.files(__package__).joinpath("page.html.j2").read_text("utf-8"))


def _content(section: Section, number: int) -> list[Markup]:
    out = []
    figures = 0
    for index, item in enumerate(section.content):
        if isinstance(item, Figure):
            caption = section.captions[figures] if figures < len(section.captions) else ""
            figures += 1
            out.append(_figure(item, caption, section.title, f"{number}-{index}"))
        elif isinstance(item, Row):
            captions = [*item.captions, *[""] * len(item.figures)]
            drawn = [
                _figure(fig, caption, section.title, f"{number}-{index}-{k}")
                for k, (fig, caption) in enumerate(zip(item.figures, captions, strict=False))
            ]
            out.append(Markup(f'<div class="row">{"".join(drawn)}</div>'))
        elif isinstance(item, Table):
            out.append(_table(item))
        else:
            out.append(Markup(item.text))
    return out


def _figure(fig: Figure, caption: str, title: str, salt: str) -> Markup:
    label = _html.escape(caption or title, quote=True)
    body = style.html(fig, salt=salt, label=label)
    note = f"<figcaption>{_inline(caption)}</figcaption>" if caption else ""
    return Markup(f"<figure>{body}{note}</figure>")


def _table(table: Table) -> Markup:
    cells = [[c if isinstance(c, Cell) else Cell(c) for c in row] for row in table.rows]
    for row in cells:
        if len(row) != len(table.columns):
            raise ValueError(f"table has {len(table.columns)} columns, a row has {len(row)} cells")
    numeric = [
        bool(cells) and all(isinstance(row[i].value, (int, float)) or row[i].value is None for row in cells)
        for i in range(len(table.columns))
    ]
    wide = ' class="wide"' if len(table.columns) >= _WIDE else ""
    parts = [f'<div class="scroll"><table{wide}>']
    if table.caption:
        parts.append(f"<caption>{_inline(table.caption)}</caption>")
    heads = "".join(
        f'<th scope="col"{" class=n" if n else ""}>{_inline(c)}</th>'
        for c, n in zip(table.columns, numeric, strict=True)
    )
    parts.append(f"<thead><tr>{heads}</tr></thead><tbody>")
    for row in cells:
        parts.append("<tr>")
        for cell, is_number in zip(row, numeric, strict=True):
            classes = " ".join(
                c for c in ("n" if is_number else "", f"mark {cell.mark}" if cell.mark else "") if c
            )
            note = f' title="{_html.escape(cell.note, quote=True)}"' if cell.note else ""
            parts.append(f'<td class="{classes}"{note}>' if classes else f"<td{note}>")
            parts.append(f"{_value(cell.value)}</td>")
        parts.append("</tr>")
    parts.append("</tbody></table></div>")
    return Markup("".join(parts))


def _value(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return short(value)
    return value.text if isinstance(value, Html) else _inline(str(value))


def short(value: float, digits: int = 4) -> str:
    """A number as people write it: four digits that matter, no trailing noise, true minus sign."""
    if math.isnan(value):
        return "–"
    value += 0.0  # nothing has no sign
    if value and not 1e-4 <= abs(value) < 1e7:
        text = f"{value:.{digits - 1}e}"
    else:
        text = f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return text.replace("-", "\u2212")


def _inline(text: str) -> str:
    text = _html.escape(text, quote=False)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    return re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", text)


def _prose(text: str) -> Markup:
    blocks: list[str] = []
    for block in re.split(r"\n\s*\n", text.strip()):
        lines = [line.strip() for line in block.splitlines() if line.strip()]
        if lines and all(line.startswith("- ") for line in lines):
            blocks.append("<ul>" + "".join(f"<li>{_inline(line[2:])}</li>" for line in lines) + "</ul>")
        elif lines:
            blocks.append(f"<p>{_inline(' '.join(lines))}</p>")
    return Markup("".join(blocks))
