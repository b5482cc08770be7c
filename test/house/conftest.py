# SPDX-License-Identifier: Apache-2.0
"""What the tests of the house share: the files that belong to the project, and what setup.py hands to setuptools."""

from __future__ import annotations

import ast
import runpy
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(scope="session")
def tracked(repository: Path) -> list[Path]:
    """The project's files: what git tracks and is still there, relative to the repository."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=repository, capture_output=True, text=True, check=True
    )
    return [Path(name) for name in listed.stdout.split("\0") if name and (repository / name).is_file()]


def statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """All statements, those within others as well."""
    for node in body:
        yield node
        for field in ("body", "orelse", "handlers", "finalbody", "cases"):
            yield from statements(getattr(node, field, []))


@pytest.fixture(scope="session")
def imports(repository: Path, tracked: list[Path]) -> dict[Path, frozenset[str]]:
    """Full names of everything that each Python file imports, anywhere in it."""
    found = {}
    for path in (p for p in tracked if p.suffix == ".py"):
        names = set()
        for node in statements(ast.parse((repository / path).read_text(encoding="utf-8")).body):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: imports name the whole path"
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
        found[path] = frozenset(names)
    return found


@pytest.fixture
def setup_arguments(repository: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What setup.py calls setup() with, without building anything."""
    caught: dict[str, Any] = {}
    monkeypatch.chdir(repository)
    monkeypatch.setattr("setuptools.setup", lambda **arguments: caught.update(arguments))
    runpy.run_path("setup.py")
    return caught
