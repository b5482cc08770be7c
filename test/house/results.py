# SPDX-License-Identifier: Apache-2.0
"""Which kept results are older than the code that they measure: ``python3 bootstrap.py check --results``.

A result belongs to the benchmark whose name its own begins with; its code is what that program imports of this
repository, and the days are those of the last commits.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def program_of(result: Path, benchmarks: Path) -> Path | None:
    """The benchmark that made a result: that with the longest name with which the result's begins."""
    named = [p for p in benchmarks.glob("*.py") if f"{result.stem}_".startswith(f"{p.stem}_")]
    programs = [p for p in named if "__main__" in p.read_text(encoding="utf-8")]
    return max(programs, key=lambda p: len(p.stem), default=None)


def code_of(program: Path, root: Path) -> set[Path]:
    """The program, and all files of the repository that it imports, directly or not."""
    found, left = set(), {program}
    while left:
        path = left.pop()
        found.add(path)
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        for name in names:
            parts = Path(*name.split("."))
            for base in (root, program.parent):
                for file in (base / f"{parts}.py", base / parts / "__init__.py"):
                    left |= {file} - found if file.is_file() else set()
    return found


def last_commit(paths: set[Path], root: Path) -> tuple[int, str]:
    """Time in s and, as day and hash, name of the newest commit that changed one of the files; 0 if none did."""
    names = [str(path.relative_to(root)) for path in sorted(paths)]
    command = ["git", "log", "-1", "--format=%ct %cs (%h)", "--", *names]
    said = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout
    seconds, _, name = said.strip().partition(" ")
    return int(seconds or 0), name or "not committed"


def older(root: Path) -> list[str]:
    """A line for each result whose code has changed since."""
    lines = []
    for result in sorted((root / "benchmarks" / "results").glob("*.json")):
        program = program_of(result, root / "benchmarks")
        if program is None:
            lines.append(f"{result.name}: made by no benchmark of that name")
            continue
        made, measured = last_commit({result}, root), last_commit(code_of(program, root), root)
        if measured[0] > made[0]:
            lines.append(f"{result.name}: of {made[1]}; the code of {program.name} is of {measured[1]}")
    return lines


if __name__ == "__main__":
    print("\n".join(older(ROOT)) or "Every result is as new as its code.")
    sys.exit(0)
