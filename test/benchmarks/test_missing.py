# SPDX-License-Identifier: Apache-2.0
"""A benchmark without the package that it is made for."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

#: Needed by benchmarks and tests alone: see TEST in setup.py.
EXTRAS = re.compile(r"^(?:import|from) (mujoco|hypothesis|objective_rating_metrics)\b", re.MULTILINE)


def test_it_is_named_in_one_line(repository: Path, tmp_path: Path) -> None:
    (tmp_path / "mujoco.py").write_text(
        "raise ModuleNotFoundError(\"No module named 'mujoco'\", name='mujoco')\n"
    )
    paths = os.pathsep.join(map(str, (tmp_path, repository)))
    done = subprocess.run(
        [sys.executable, repository / "benchmarks" / "models.py", "--json"],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": paths},
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "models.py: needs mujoco: pip install '.[test]'\n"


def test_no_benchmark_imports_an_extra_without_saying_so(repository: Path) -> None:
    """An import within ``try``, which is indented, ends in :func:`extras.missing`."""
    found = []
    for path in sorted((repository / "benchmarks").rglob("*.py")):
        found += [f"{path.name}: {m}" for m in EXTRAS.findall(path.read_text(encoding="utf-8"))]
    assert found == []
