# SPDX-License-Identifier: Apache-2.0
"""CONTRIBUTING.md: its steps, followed to the letter in a copy of the repository, add what they say they add."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

#: What the steps read or write; everything else of the repository is not needed.
COPIED = (
    "suspension_twin",
    "suspension_twin_interfaces",
    "test",
    "docs",
    "config",
    "README.md",
    "pyproject.toml",
)
PLUGIN = "Add any of them in a package of your own"
STEPS = ["Add an effect", "Add an importer", "Add a model", "Add a source", PLUGIN]
_BLOCK = re.compile(r"^( *)```(python|toml|bash)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)


def sections(repository: Path) -> dict[str, str]:
    """Text of every section about something to add, by its heading."""
    parts = re.split(
        r"^## (.*)$", (repository / "CONTRIBUTING.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    named = dict(zip(parts[1::2], parts[2::2], strict=True))
    return {name: text for name, text in named.items() if name.startswith("Add ")}


@pytest.fixture
def copy(repository: Path, tmp_path: Path, copy_kernels: Callable[..., None]) -> Path:
    """A copy of the repository in which the steps are followed, with the machine code that is there."""
    built = shutil.ignore_patterns("__pycache__", "build", "*.egg-info", "*.so")
    for name in COPIED:
        if (repository / name).is_dir():
            shutil.copytree(repository / name, tmp_path / name, ignore=built)
        else:
            shutil.copy(repository / name, tmp_path)
    (tmp_path / "bags").symlink_to(repository / "bags")
    copy_kernels(tmp_path / "suspension_twin" / "__pycache__")
    return tmp_path


def followed(text: str, folder: Path) -> None:
    """Write every file that a section shows, and run its commands, in the order of the page."""
    bin_folder = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    installed = folder / "installed"  # by pip, without a network
    environment = {**os.environ, "PATH": bin_folder, "PYTHONPATH": f"{folder}{os.pathsep}{installed}"}
    environment |= {"PIP_TARGET": str(installed), "PIP_NO_BUILD_ISOLATION": "0", "PIP_NO_DEPS": "1"}
    environment |= {"PIP_NO_INDEX": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    for _, language, body in _BLOCK.findall(text):
        code = textwrap.dedent(body)
        if language != "bash":
            first, _, rest = code.partition("\n")
            path = folder / first.removeprefix("# ")
            path.parent.mkdir(exist_ok=True)
            assert not path.exists(), f"{path} is there already"
            path.write_text(rest, encoding="utf-8")
        else:
            done = subprocess.run(
                ["bash", "-e", "-c", code],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                timeout=400,
            )
            assert done.returncode == 0, f"{code}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


def test_there_is_a_section_for_each_kind_of_thing(repository: Path) -> None:
    assert set(sections(repository)) == set(STEPS)


def test_no_section_has_more_than_ten_lines_of_prose(repository: Path) -> None:
    for name, text in sections(repository).items():
        prose = [line for line in _BLOCK.sub("", text).splitlines() if line.strip()]
        assert len(prose) <= 10, name


@pytest.mark.parametrize(
    "name", [PLUGIN, *(pytest.param(name, marks=pytest.mark.long) for name in STEPS if name != PLUGIN)]
)
@pytest.mark.long
def test_the_steps_add_it(name: str, repository: Path, copy: Path) -> None:
    followed(sections(repository)[name], copy)


@pytest.mark.parametrize("name", STEPS)
def test_files_of_the_page_are_formatted_and_sound(name: str, repository: Path, tmp_path: Path) -> None:
    shutil.copy(repository / "pyproject.toml", tmp_path)
    ours = "lint.isort.known-first-party = ['suspension_twin']"
    for _, language, body in _BLOCK.findall(sections(repository)[name]):
        if language == "python":
            first, _, code = textwrap.dedent(body).partition("\n")
            (tmp_path / Path(first.removeprefix("# ")).name).write_text(code, encoding="utf-8")
    for tool in ("check", "format --check"):
        command = [sys.executable, "-m", "ruff", *tool.split(), "--no-cache", "--config", ours, "."]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout
