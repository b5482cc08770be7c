# SPDX-License-Identifier: Apache-2.0
"""A run ends with one line of what it skipped, and the command that installs what was missing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SKIPPING = """
import pytest

@pytest.mark.parametrize("reason", {reasons!r})
def test_it(reason):
    if reason == "an import":
        pytest.importorskip("no_such_module")
    if reason:
        pytest.skip(reason)
"""
WITHOUT = [
    "",
    "no measured data: one",
    "no measured data: another",
    "too old a file",
    "no browser here: apt-get install chromium",
    "no C# here: apt-get install mono-mcs mono-runtime",
    "an import",
]


@pytest.mark.long
def test_it_is_one_line(repository: Path, tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(SKIPPING.format(reasons=WITHOUT))
    shutil.copy(repository / "test" / "conftest.py", tmp_path)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "-c",
        os.devnull,
        "--rootdir",
        str(tmp_path),
    ]
    done = subprocess.run([*command, str(tmp_path)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("skipped")]
    assert line == (
        "skipped: 2 no measured data, 1 too old a file, 1 no browser here, 1 no C# here, "
        "1 could not import 'no_such_module'; "
        "missing: apt-get install chromium mono-mcs mono-runtime && pip install -e.[test]"
    )
