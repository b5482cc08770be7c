# SPDX-License-Identifier: Apache-2.0
"""Results that are older than the code that they measure are named, and no others."""

from __future__ import annotations

import importlib.util
import subprocess
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def results(repository: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("results", repository / "test" / "house" / "results.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def commit(root: Path, day: int, **files: str) -> None:
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".json" if "results" in name else ".py").write_text(text, encoding="utf-8")
    date = f"2026-01-{day:02d}T12:00:00Z"
    own = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    for step in (["add", "-A"], [*own, "commit", "-qm", "day"]):
        subprocess.run(
            ["git", *step],
            cwd=root,
            check=True,
            env={
                "GIT_COMMITTER_DATE": date,
                "GIT_AUTHOR_DATE": date,
                "PATH": "/usr/bin:/bin",
                "HOME": str(root),
            },
        )


def test_a_result_is_older_where_what_its_program_imports_has_changed(
    results: ModuleType, tmp_path: Path
) -> None:
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    commit(tmp_path, 1, suspension_twin____init__="", suspension_twin__a="", suspension_twin__b="")
    commit(
        tmp_path,
        2,
        benchmarks__one="def f():\n    from suspension_twin import a  # __main__\n",
        benchmarks__other="import one  # __main__",
    )
    commit(tmp_path, 3, benchmarks__results__one="{}", benchmarks__results__other_seeds="{}")
    assert results.older(tmp_path) == []
    commit(tmp_path, 4, suspension_twin__b="x = 1")
    assert results.older(tmp_path) == []
    commit(tmp_path, 5, suspension_twin__a='"""What a holds."""\n# and why\n')
    assert results.older(tmp_path) == []
    commit(tmp_path, 6, suspension_twin__a="x = 1", benchmarks__results__other_seeds="{ }")
    (line,) = results.older(tmp_path)
    assert line.startswith("one.json: of 2026-01-03") and line.endswith(
        "one.py has changed: suspension_twin/a.py"
    )


def test_every_result_has_a_benchmark(results: ModuleType, repository: Path) -> None:
    for result in (repository / "benchmarks" / "results").glob("*.json"):
        assert results.program_of(result, repository / "benchmarks"), result.name
