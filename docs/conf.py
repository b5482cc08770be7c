# SPDX-License-Identifier: Apache-2.0
"""The documentation as a site, by Sphinx with MyST: ``python -m sphinx -W --keep-going -c docs . out/site``.

The pages are the repository's own files, so that links between them are the same here and there. README.md is the home
page; docs/api.md lists the names of docs/api.yaml. The site needs no network, and its search no server.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from latex2mathml.converter import convert

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx
    from sphinx.writers.html5 import HTML5Translator

ROOT = Path(__file__).resolve().parents[1]
#: Pages below README.md, by the heading in the navigation.
NAVIGATION = {
    "Begin": ["docs/own_bump", "docs/commands", "docs/notebooks/first_drive", "docs/python", "docs/api"],
    "Vehicles and roads": [
        "docs/models",
        "docs/quarter_car",
        "docs/rig",
        "docs/tracked",
        "docs/fmu",
        "docs/effects",
        "docs/roads",
    ],
    "Calibration and diagnosis": [
        "docs/calibration",
        "docs/verdict",
        "docs/diagnosis",
        "docs/plan",
        "docs/diagnosis_figures",
        "docs/numbers",
        "docs/fleet",
    ],
    "Live": [
        "docs/sources",
        "docs/view",
        "docs/live",
        "docs/interfaces",
        "docs/parameters",
        "docs/apt",
        "docs/testing",
    ],
    "Other simulators": ["docs/export", "docs/engines"],
    "The project": ["docs/benchmarks", "docs/promises", "SECURITY", "CONTRIBUTING", "CHANGELOG"],
    "Folders": ["bags/README", "config/import/README", "benchmarks/blind/README"],
}

project = "suspension_twin"
root_doc = "README"
include_patterns = ["docs/notebooks/*.ipynb", f"{root_doc}.md"]
include_patterns += [f"{page}.md" for pages in NAVIGATION.values() for page in pages]
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "attrs_inline"]
myst_heading_anchors = 3
nb_execution_mode = "auto"  # the notebook is kept without outputs; ``-D nb_execution_mode=off`` leaves it so
nb_execution_timeout = -1
nb_execution_raise_on_error = True
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
html_theme = "furo"
html_title = project
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_copy_source = False
html_math_renderer = "mathml"
_LINK = re.compile(r"(?<!!)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s#]+)\)")


def read(app: Sphinx, page: str, source: list[str]) -> None:
    """What the site adds to pages: navigation, names of the API, the parameter file; links to folders are none."""

    def folder(found: re.Match[str]) -> str:
        text, target = found.groups()
        place = (ROOT / page).parent / target
        if re.match(r"[a-z]+:", target) or not place.is_dir():
            return found[0]
        path = place.resolve().relative_to(ROOT).as_posix()
        return f"`{path}`" if text.strip("`") in path else f"{text} (`{path}`)"

    source[0] = _LINK.sub(folder, source[0])
    if page == root_doc:
        for caption, pages in NAVIGATION.items():
            source[0] += "\n".join(["\n```{toctree}", ":hidden:", f":caption: {caption}", *pages, "```\n"])
    elif page == "docs/parameters":
        source[0] += f"\n```yaml\n{(ROOT / 'config' / 'nodes.yaml').read_text(encoding='utf-8')}```\n"
    elif page == "docs/api":
        names = yaml.safe_load((ROOT / "docs" / "api.yaml").read_text(encoding="utf-8"))
        for title, listed in names.items():
            objects = "".join(_documented(name) for name in listed)
            source[0] += f"\n## {title}\n\n```{{eval-rst}}\n{objects}```\n"


def _documented(name: str) -> str:
    """The directive that shows a function or a class with its public members."""
    kind = "class" if name.rpartition(".")[2][0].isupper() else "function"
    return f".. auto{kind}:: {name}\n" + ("   :members:\n" if kind == "class" else "") + "\n"


def inline(translator: HTML5Translator, node: nodes.math) -> None:
    """A formula in a sentence."""
    from docutils.nodes import SkipNode

    translator.body.append(convert(node.astext()))
    raise SkipNode


def display(translator: HTML5Translator, node: nodes.math_block) -> None:
    """A formula of its own."""
    from docutils.nodes import SkipNode

    translator.body.append(convert(node.astext(), display="block"))
    raise SkipNode


def finish(app: Sphinx, failure: Exception | None) -> None:
    """The home page under the name that a folder opens with."""
    if failure is None:
        shutil.copy(Path(app.outdir) / f"{root_doc}.html", Path(app.outdir) / "index.html")


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect all this."""
    app.connect("source-read", read)
    app.connect("build-finished", finish)
    app.add_html_math_renderer("mathml", (inline, None), (display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
