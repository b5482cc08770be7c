# SPDX-License-Identifier: Apache-2.0
"""ruff and mypy --strict find nothing, with the settings of pyproject.toml."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TOOLS: list[Any] = ["ruff check --no-cache --output-format concise ."]
# The last numpy for Python 3.10 comes with types of its own kind; what is checked there is checked on the others.
if np.lib.NumpyVersion(np.__version__) >= "2.3.0":
    TOOLS.append(pytest.param("mypy --no-error-summary", marks=pytest.mark.long))


@pytest.mark.parametrize("tool", TOOLS)
def test_finds_nothing(tool: str, repository: Path) -> None:
    command = [sys.executable, "-m", *tool.split()]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=600)
    lines = [line for line in (done.stdout + done.stderr).splitlines() if ": note:" not in line]
    assert done.returncode == 0, "\n".join([f"{tool}:", *lines])
