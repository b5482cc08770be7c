# SPDX-License-Identifier: Apache-2.0
"""Commands that pages show take the arguments that they are shown with; README.md and commands.md have tests of their
own."""

from __future__ import annotations

import ast
import contextlib
import io
import json
import re
import shlex
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import pytest

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.cli.main import main, subcommands

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (".", "bags", "benchmarks", "config", "docs")
PAGES = sorted(
    p
    for folder in FOLDERS
    for p in (ROOT / folder).glob("*.md" if folder == "." else "**/*.md")
    if p.name != "CHANGELOG.md"  # tells of commands that were
)
#: Their commands are run by test_readme.py.
TRIED_APART = (ROOT / "README.md", ROOT / "docs" / "commands.md")
PROGRAMS = sorted(
    p for folder in FOLDERS[1:] for p in (ROOT / folder).glob("*.py") if "__main__" in p.read_text("utf-8")
)
#: Commands with commands of their own.
_GROUPS = ("fleet", "road")
_FENCED = re.compile(r"^ *```(?:bash|text|)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def lines_of(page: Path) -> list[str]:
    """Commands of the page's blocks, a line each, without comments."""
    text = "\n".join(_FENCED.findall(page.read_text(encoding="utf-8"))).replace("\\\n", " ")
    return [re.sub(r"\s+# .*", "", line).strip() for line in text.splitlines()]


def inline(page: Path) -> list[str]:
    """What stands as code in the page's sentences."""
    return re.findall(
        r"`([^`\n]+)`",
        re.sub(r"^ *```.*?^ *```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL),
    )


@lru_cache
def options_of(command: tuple[str, ...]) -> frozenset[str]:
    """Options that ``suspension-twin COMMAND --help`` shows."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as shown:
        patch.setenv("COLUMNS", "300")
        assert main([*command, "--help"]) == 0
    return frozenset(_OPTION.findall(shown.getvalue()))


@lru_cache
def options_of_program(path: Path) -> frozenset[str]:
    """Options that a program adds to its parser; ``benchmarks/blind.py`` is ``benchmarks/blind/run.py``."""
    whole = path.with_suffix("") / "run.py"
    source = (whole if whole.is_file() else path).read_text(encoding="utf-8")
    return frozenset({"--help", "--smoke", *re.findall(r'"(--[a-z][a-z-]*)"', source)})


def ours(text: str) -> tuple[str, ...]:
    """The command of ours that a piece of code is, without its arguments; none for another."""
    words = text.removeprefix("suspension-twin ").split()
    if not words or words[0] not in {s.name for s in subcommands()}:
        return ()
    more = len(words) > 1 and words[0] in _GROUPS and re.fullmatch("[a-z]+", words[1])
    return tuple(words[: 2 if more else 1])


@pytest.mark.parametrize("page", [p for p in PAGES if p not in TRIED_APART], ids=name_of)
def test_commands_take_their_arguments(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In an empty folder each of ours gets as far as missing its first file."""
    monkeypatch.chdir(tmp_path)
    for line in lines_of(page):
        if "--source" in line or line == "suspension-twin connect":  # it would wait for what is to send
            for url in re.findall(r"--source (\S+)", line):
                assert make_sources([url.strip('"')], Hub())
        elif line.startswith("suspension-twin road make ") and "--felt" not in line:
            assert main(shlex.split(line)[1:]) == 0, line
            (tmp_path / "road.crg").unlink()
        elif line.startswith("suspension-twin "):
            assert main(shlex.split(line)[1:]) == 2, line
            error = capsys.readouterr().err
            assert re.search(r"(?i)no such file|is not there|holds no evidence", error), error


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_options_in_sentences_are_there(page: Path) -> None:
    for text in inline(page):
        if text.startswith("python "):
            path = ROOT / text.split()[1]
            known = options_of_program(path) if path.suffix == ".py" else None
        else:
            known = options_of(ours(text)) if ours(text) else None
        if known is not None:
            assert set(_OPTION.findall(text.partition(" --ros-args")[0])) <= known, text


@pytest.mark.parametrize("program", PROGRAMS, ids=name_of)
def test_options_in_the_head_of_a_program_are_there(program: Path) -> None:
    whole = program.with_suffix("") / "run.py"
    said = ast.get_docstring(ast.parse((whole if whole.is_file() else program).read_text("utf-8"))) or ""
    for line in said.splitlines():
        for name, text in re.findall(r"python (\w+/\w+\.py)([^`#]*)", line):
            assert set(_OPTION.findall(text)) <= options_of_program(ROOT / name), line


def of_programs() -> list[str]:
    """Commands of programs with options, those in sentences included; not those with a name to fill in."""
    found = {c for page in PAGES for c in (*lines_of(page), *inline(page))}
    return sorted(
        c for c in found if re.match(r"python \w+/\w+\.py .*--", c) and not re.search(r"\.\.\.|[|\[]", c)
    )


#: A process that has imported what takes longest runs each program in a copy of itself.
HELPED = """
import json, os, runpy, sys

import matplotlib.pyplot, rich.console
import suspension_twin.calibration.run, suspension_twin.diagnosis.run, suspension_twin.nodes.process

try:
    import mujoco
except ImportError:
    pass

for program, arguments, out in json.load(sys.stdin):
    child = os.fork()
    if not child:
        os.dup2(os.open(out, os.O_WRONLY | os.O_CREAT), 1)
        sys.path[0], sys.argv = os.path.dirname(program), [program, *arguments, "--help"]
        try:
            runpy.run_path(program, run_name="__main__")
        finally:  # without clearing up all that was imported
            sys.stdout.flush()
            os._exit(0)
    os.waitpid(child, 0)
"""


@pytest.fixture(scope="module")
def helped(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What each command of :func:`of_programs` prints with ``--help`` behind it; an error goes elsewhere."""
    folder = tmp_path_factory.mktemp("helped")
    out = {command: folder / str(k) for k, command in enumerate(of_programs())}
    words = {command: shlex.split(command)[1:] for command in out}
    rows = [[str(ROOT / words[c][0]), words[c][1:], str(file)] for c, file in out.items()]
    command = [sys.executable, "-c", HELPED]
    subprocess.run(command, input=json.dumps(rows), text=True, cwd=folder, check=True)
    return {command: file.read_text("utf-8") for command, file in out.items()}


@pytest.mark.long
@pytest.mark.parametrize("command", of_programs())
def test_programs_take_their_arguments(command: str, helped: dict[str, str]) -> None:
    """What takes minutes to days reads its arguments, and says what it does."""
    assert helped[command].startswith("usage: ")
