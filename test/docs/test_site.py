# SPDX-License-Identifier: Apache-2.0
"""The documentation: the site builds without a warning, pages are up to date, their examples and links are right."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").glob("*.md"))
#: Pages whose length is limited, in words.
LONGEST = {"diagnosis.md": 1800}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


@pytest.fixture(scope="module")
def make_docs() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_docs", ROOT / "docs" / "make_docs.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the site, built without a warning; its notebook has a test of its own."""
    pytest.importorskip("myst_nb")
    pytest.importorskip("furo")
    folder = tmp_path_factory.mktemp("site")
    options = ["-q", "-W", "--keep-going", "-D", "nb_execution_mode=off", "-c", "docs", "."]
    command = [sys.executable, "-m", "sphinx", *options, str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.mark.long
def test_the_site_is_built_without_a_warning(site: Path) -> None:
    home, page, api = (
        (site / name).read_text("utf-8") for name in ("index.html", "docs/diagnosis.html", "docs/api.html")
    )
    assert "suspension_twin_demo" in home
    assert page.count("<math") > 20
    assert "$" not in re.sub(r"<[^>]+>", "", page), "a formula is left as it was written"
    assert 'id="suspension_twin.api.simulate"' in api
    for text in (home, page):
        outside = re.findall(r'(?:src|href)="(https?://[^"]+)"', text)
        assert not [link for link in outside if link.endswith((".js", ".css"))], "a page needs a network"


@pytest.mark.long
def test_no_link_of_the_site_is_broken(site: Path) -> None:
    for page in site.rglob("*.html"):
        for link in re.findall(r'(?:src|href)="([^"#?]+)', page.read_text("utf-8")):
            if not re.match(r"[a-z]+:", link):
                assert (page.parent / unquote(link)).exists(), f"{page.name}: {link}"


@pytest.mark.long
def test_the_search_works_from_a_folder(site: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    with playwright.sync_playwright() as play:
        page = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"]).new_page()
        page.goto(f"{(site / 'search.html').as_uri()}?q=latency")
        page.wait_for_selector("#search-results li")
        assert page.locator("#search-results li").count() > 3


@pytest.mark.parametrize("name", ["interfaces.md", "effects.md"])
def test_generated_parts_are_up_to_date(name: str, make_docs: ModuleType) -> None:
    page = ROOT / "docs" / name
    assert make_docs.brought_up_to_date(page) == page.read_text(encoding="utf-8"), (
        "run: python docs/make_docs.py tables"
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if not link.startswith(("#", "http")):
            assert (page.parent / link.partition("#")[0]).exists(), link


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda p: p.name)
def test_files_that_a_page_names_are_there(page: Path) -> None:
    for name in re.findall(
        r"`(?:python )?((?:[a-z_0-9]+/)+[a-z_0-9]+\.py)[` ]", page.read_text(encoding="utf-8")
    ):
        assert (ROOT / name).exists() or (ROOT / "suspension_twin" / name).exists(), name


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
@pytest.mark.long
def test_examples_in_python_run(
    page: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    for code in blocks(page, "python"):
        exec(compile(code, page.name, "exec"), {})
        assert capsys.readouterr().out


@pytest.mark.parametrize("name", LONGEST)
def test_a_page_is_no_longer_than_it_should_be(name: str) -> None:
    assert len((ROOT / "docs" / name).read_text(encoding="utf-8").split()) < LONGEST[name]
