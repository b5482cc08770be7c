# SPDX-License-Identifier: Apache-2.0
"""Which kept results are older than the code that they measure: ``python3 bootstrap.py check --results``.

A result belongs to the benchmark whose name its own begins with; its code is what that program imports of this
repository. It is older where that code, without comments, docstrings and layout, was another at the last commit of the
result.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def program_of(result: Path, benchmarks: Path) -> Path | None:
    """The benchmark that made a result: that with the longest name with which the result's begins."""
    named = [p for p in benchmarks.glob("*.py") if f"{result.stem}_".startswith(f"{p.stem}_")]
    programs = [p for p in named if "__main__" in p.read_text(encoding="utf-8")]
    return max(programs, key=lambda p: len(p.stem), default=None)


@cache
def imported(path: Path) -> set[str]:
    """Names that a file imports, at any level."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def code_of(program: Path, root: Path) -> set[Path]:
    """The program, and all files of the repository that it imports, directly or not."""
    found, left = set(), {program}
    while left:
        path = left.pop()
        found.add(path)
        for name in imported(path):
            parts = Path(*name.split("."))
            for base in (root, program.parent):
                for file in (base / f"{parts}.py", base / parts / "__init__.py"):
                    left |= {file} - found if file.is_file() else set()
    return found


def git(root: Path, *arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout


def plain(source: str) -> str:
    """What a file does: its syntax without comments, docstrings and layout."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            node.body = node.body[ast.get_docstring(node, clean=False) is not None :]
    return ast.dump(tree)


def changed(commit: str, paths: set[Path], root: Path) -> Iterator[str]:
    """Names of the files that do something else than they did at a commit."""
    names = [str(path.relative_to(root)) for path in sorted(paths)]
    then = set(git(root, "ls-tree", "-r", "--name-only", commit).splitlines())
    for name in git(root, "diff", "--name-only", commit, "--", *names).splitlines():
        now = (root / name).read_text(encoding="utf-8")
        if name not in then or plain(git(root, "show", f"{commit}:{name}")) != plain(now):
            yield name


def older(root: Path) -> list[str]:
    """A line for each result whose code has changed since."""
    lines = []
    for result in sorted((root / "benchmarks" / "results").glob("*.json")):
        program = program_of(result, root / "benchmarks")
        if program is None:
            lines.append(f"{result.name}: made by no benchmark of that name")
            continue
        made = git(root, "log", "-1", "--format=%h %cs", "--", str(result.relative_to(root))).split()
        if not made:
            continue  # just made, and not committed
        code = code_of(program, root)
        if first := next(changed(made[0], code, root), None):
            lines.append(
                f"{result.name}: of {made[1]} ({made[0]}); the code of {program.name} has changed: {first}"
            )
    return lines


if __name__ == "__main__":
    print("\n".join(older(ROOT)) or "Every result is as new as its code.")
    sys.exit(0)
