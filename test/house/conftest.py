# SPDX-License-Identifier: Apache-2.0
"""What the tests of the house share: the files that belong to the project, and what setup.py hands to setuptools."""

from __future__ import annotations

import runpy
import subprocess
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


@pytest.fixture
def setup_arguments(repository: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What setup.py calls setup() with, without building anything."""
    caught: dict[str, Any] = {}
    monkeypatch.chdir(repository)
    monkeypatch.setattr("setuptools.setup", lambda **arguments: caught.update(arguments))
    runpy.run_path("setup.py")
    return caught
