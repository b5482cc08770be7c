# SPDX-License-Identifier: Apache-2.0
"""The page: self-contained, escaped, valid, the same text for the same content."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

from suspension_twin.errors import WorkError
from suspension_twin.report import Card, Cell, Html, Page, Section, Table, style
from suspension_twin.report.page import short

VOID = {"meta", "br", "img", "hr", "link", "input"}


class Outline(HTMLParser):
    """Checks that every element is closed in order, and collects ids, links and text."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        for key, value in attrs:
            if key == "id":
                self.ids.append(value)
            elif key in ("href", "src", "xlink:href"):
                self.references.append(value)

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def outline(html: str) -> Outline:
    parser = Outline()
    parser.feed(html)
    parser.close()
    assert not parser.open
    return parser


def drawing(role: str = "measured") -> Figure:
    with style.using():
        fig = style.figure(4, 2)
        axes = fig.subplots()
        axes.plot([0, 1, 2], [0, 1, 0], color=style.COLOURS[role], label="a < b & c")
        axes.fill_between([0, 1], [0, 1], color=style.COLOURS["extra"], alpha=0.3)
        axes.legend()
    return fig


def page() -> Page:
    out = Page("Title <of> & page", "what it shows")
    out.card("Gap", "0.1 m/s²", "of 1.2", "good")
    out.add(
        Section("First", "One `code`.\n\n- a\n- **b**", drawing(), drawing("simulated"), captions=["x > y"])
    )
    out.add(
        Section(
            "First", "again", Table(["name", "value"], [["m", Cell(1725.0, "bad", 'on the "bound"')]], "c")
        )
    )
    out.add(Section("Last", "", Html("<p>raw</p>"), None))
    return out


def test_page_stands_alone_and_is_well_formed():
    html = page().render()
    seen = outline(html)
    assert len(seen.ids) == len(set(seen.ids)), "an id stands twice"
    for reference in seen.references:
        assert reference.startswith(("#", "data:")), f"{reference} leaves the page"
        if reference.startswith("#"):
            assert reference[1:] in seen.ids
    assert "<script" not in html
    assert not re.search(r"url\((?!#)", html)
    assert re.findall(r"url\(#([^)]+)\)", html), "the figures' clip paths are gone"
    for target in re.findall(r"url\(#([^)]+)\)", html):
        assert target in seen.ids


def test_text_is_escaped_and_marked_up():
    html = page().render()
    assert "Title &lt;of&gt; &amp; page" in html
    assert "<code>code</code>" in html
    assert "<li><strong>b</strong></li>" in html
    assert "x &gt; y" in html
    assert 'title="on the &#34;bound&#34;"' in html
    assert '<td class="n mark bad"' in html
    assert "<p>raw</p>" in html


def test_same_content_gives_the_same_bits():
    assert page().render() == page().render()


def test_headings_of_one_name_have_their_own_anchors():
    assert {"first", "first-2", "last"} <= set(outline(page().render()).ids)


def test_figures_follow_the_colours_of_the_page():
    text = style.svg(drawing(), salt="s")
    assert "var(--measured)" in text
    assert "var(--ink)" in text
    for value in style.COLOURS.values():
        assert value.lower() not in text.lower()
    assert "DejaVu Sans Mono" not in text
    assert "Inter" in text
    assert "a &lt; b &amp; c" in text


def test_roles_have_one_colour_each_and_both_themes_know_them():
    assert len({v.lower() for v in style.COLOURS.values()}) == len(style.COLOURS)
    assert set(style.DARK) == set(style.COLOURS)


def luminance(value: str) -> float:
    parts = np.array([int(value[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize(("colours", "ground"), [(style.COLOURS, "#FFFFFF"), (style.DARK, "#1D2127")])
@pytest.mark.parametrize(
    ("role", "ratio"),
    [("ink", 7.0), ("soft", 4.5), ("measured", 3.0), ("simulated", 3.0), ("truth", 3.0), ("before", 3.0)],
)
def test_colours_stand_out_from_the_page(colours, ground, role, ratio):
    """WCAG 2.1: 4.5 for text, 3 for graphics."""
    pair = sorted([luminance(colours[role]), luminance(ground)])
    assert (pair[1] + 0.05) / (pair[0] + 0.05) >= ratio


def test_a_heavy_drawing_goes_in_as_a_picture(monkeypatch):
    monkeypatch.setattr(style, "_LARGEST_SVG", 100)
    html = Page("t").add(Section("s", "", drawing())).render()
    assert 'src="data:image/png;base64,' in html
    assert "<svg" not in html


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match="2 columns, a row has 1"):
        Page("t").add(Section("s", "", Table(["a", "b"], [[1]]))).render()


def test_page_is_written_with_its_folders(tmp_path):
    path = page().write(tmp_path / "a" / "b" / "index.html")
    assert path.read_text(encoding="utf-8") == page().render()


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkError) as caught:
        page().write(tmp_path / "file" / "index.html")
    assert "\n" not in str(caught.value)
    assert "file" in str(caught.value)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1725.0, "1725"),
        (0.31415926, "0.3142"),
        (-2.5, "−2.5"),
        (-0.0, "0"),
        (210000.0, "210000"),
        (1.5e-7, "1.500e−07"),
        (float("nan"), "–"),
    ],
)
def test_numbers_are_written_short(value, text):
    assert short(value) == text


def test_columns_of_numbers_stand_to_the_right():
    html = Page("t").add(Section("s", "", Table(["a", "b"], [["x", 1.0], ["y", None]]))).render()
    assert '<th scope="col" class=n>b</th>' in html
    assert '<th scope="col">a</th>' in html
    assert '<td class="n">–</td>' in html


def test_cards_show_their_mark():
    out = Page("t", cards=[Card("a", "1", mark="bad")])
    assert '<div class="card bad">' in out.render()
