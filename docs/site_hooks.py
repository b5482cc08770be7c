# SPDX-License-Identifier: Apache-2.0
"""What MkDocs does beside its plugins when it builds the site (see ``mkdocs.yml``).

The home page, the contributing page and the changelog are the files at the root of the repository; the pages of the
Python API are made from the names in ``docs/api.yaml``; links to files outside ``docs`` lead to the repository, where
``repo_url`` names one, and formulas become MathML, which browsers draw without any script.
"""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

import yaml
from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

HERE = Path(__file__).resolve().parent
AT_ROOT = {
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "security.md": "SECURITY.md",
}
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_ROLE = re.compile(r":(?:func|class|meth|data|mod|attr):<code>(~?)([\w.]+)</code>")
_FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\s*\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]\s*</\1>', re.DOTALL
)


def api() -> dict[str, list[str]]:
    """The public names by the title of their page, in the order of ``docs/api.yaml``."""
    pages: dict[str, list[str]] = yaml.safe_load((HERE / "api.yaml").read_text(encoding="utf-8"))
    return pages


def _slug(title: str) -> str:
    return re.sub(r"\W+", "_", title.lower()).strip("_")


def _api_page(title: str, names: list[str]) -> str:
    return f"# {title}\n\n" + "".join(f"::: {name}\n\n" for name in names)


def on_config(config: Any) -> Any:
    """The API's pages in the navigation."""
    for entry in config["nav"]:
        if "Python API" in entry:
            entry["Python API"] = [{title: f"api/{_slug(title)}.md"} for title in api()]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that do not lie in ``docs``."""
    pages = {page: (HERE.parent / file).read_text(encoding="utf-8") for page, file in AT_ROOT.items()}
    pages |= {f"api/{_slug(title)}.md": _api_page(title, names) for title, names in api().items()}
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    for page in sorted(HERE.glob("*.md")):
        for picture in re.findall(r"!\[[^\]]*\]\(\.\./([^)\s]+)\)", page.read_text(encoding="utf-8")):
            files.append(File.generated(config, picture, abs_src_path=str(HERE.parent / picture)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links as they lead from the site: to its pages, to the repository, or nowhere but to a path's name."""
    if page.file.src_uri.startswith("api/"):
        return markdown
    at_root = page.file.src_uri in AT_ROOT
    root = {file: name for name, file in AT_ROOT.items()}

    def replaced(found: re.Match[str]) -> str:
        picture, text, target = found.groups()
        path, hash_, anchor = target.partition("#")
        if not path or re.match(r"[a-z]+:", target):
            return found[0]
        place = (HERE.parent if at_root else HERE) / path
        inside = place.resolve().relative_to(HERE.parent)
        if inside.parts[0] == HERE.name and len(inside.parts) > 1:
            return f"{picture}[{text}]({inside.relative_to(HERE.name).as_posix()}{hash_}{anchor})"
        if inside.as_posix() in root:
            return f"[{text}]({root[inside.as_posix()]}{hash_}{anchor})"
        if picture:
            return f"![{text}]({inside.as_posix()})"
        if config["repo_url"]:
            return f"[{text}]({config['repo_url'].rstrip('/')}/blob/HEAD/{inside.as_posix()}{hash_}{anchor})"
        path = f"`{inside.as_posix()}`"
        return path if text.strip("`") in inside.as_posix() else f"{text} ({path})"

    return _LINK.sub(replaced, markdown)


def on_page_content(content: str, page: Any, config: Any, files: Files) -> str:
    """Formulas as MathML, and the roles of docstrings as the names that they refer to."""

    def drawn(found: re.Match[str]) -> str:
        display = "block" if found["open"] == "[" else "inline"
        return str(convert(html.unescape(found["latex"]), display=display))

    def named(found: re.Match[str]) -> str:
        short, name = found.groups()
        return f"<code>{name.rpartition('.')[2] if short else name}</code>"

    return _ROLE.sub(named, _FORMULA.sub(drawn, content))
