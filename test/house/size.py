#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Counts of the code: statements by package, records, signatures, names, numbers, and how each compares with its limit.

    python3 bootstrap.py check --size [--json]

A statement is one of the syntax tree; docstrings do not count. A record is a class of annotated fields. Numbers are
the numeric literals of module-level assignments, those in tuples and tables counted one by one.
"""

from __future__ import annotations

import ast
import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CORE = ("models", "effects", "inference", "calibration", "diagnosis")
WHOLE_CORE = (*CORE, "nodes", "report", "cli")
INFERRING = ("inference", "calibration", "diagnosis")
MOST_FIELDS, MOST_POSITIONAL = 8, 6
#: Records that may have more fields: settings that a person sets, and what is read from a file or sent as a message.
FREE_RECORDS = ("Settings", "Request", "Parameters")
KERNELS = ("compiled", "inlined", "njit")

Modules = dict[Path, ast.Module]


def modules(package: Path) -> Modules:
    """Every module of a package by its path in it."""
    return {
        path.relative_to(package): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(package.rglob("*.py"))
    }


def statements(tree: ast.Module) -> int:
    """Statements of a module, without docstrings and other bare texts."""
    return sum(
        isinstance(node, ast.stmt)
        and not (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        )
        for node in ast.walk(tree)
    )


def by_package(found: Modules) -> Counter[str]:
    """Statements of each package; modules beside them count under their own name."""
    counts: Counter[str] = Counter()
    for path, tree in found.items():
        counts[path.parts[0] if len(path.parts) > 1 else "."] += statements(tree)
    return counts


def large_records(found: Modules) -> Iterator[str]:
    """Records of more fields than a reader keeps in mind, but for settings."""
    for path, tree in found.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.endswith(FREE_RECORDS):
                strict = any("Strict" in ast.dump(base) or "Twin" in ast.dump(base) for base in node.bases)
                fields = sum(isinstance(line, ast.AnnAssign) for line in node.body)
                if fields > MOST_FIELDS and not strict:
                    yield f"{path}: {node.name} has {fields} fields"


def long_signatures(found: Modules) -> Iterator[str]:
    """Functions of more positional parameters than a caller keeps apart, but for compiled kernels."""
    for path, tree in found.items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            names = [a.arg for a in (*node.args.posonlyargs, *node.args.args)]
            count = len(names) - (names[:1] in (["self"], ["cls"]))
            marks = " ".join(ast.unparse(mark) for mark in node.decorator_list)
            if count > MOST_POSITIONAL and not any(kernel in marks for kernel in KERNELS):
                yield f"{path}: {node.name} takes {count}"


def repeated_names(found: Modules) -> Iterator[str]:
    """Public class names that more than one module defines."""
    where: dict[str, list[str]] = {}
    for path, tree in found.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where.setdefault(node.name, []).append(str(path))
    return (f"{name}: {', '.join(paths)}" for name, paths in where.items() if len(paths) > 1)


def uses_of_any(found: Modules) -> int:
    """How often ``Any`` stands where a type could, imports not counted."""
    return sum(
        isinstance(node, ast.Name) and node.id == "Any" for tree in found.values() for node in ast.walk(tree)
    )


def numbers(found: Modules, packages: tuple[str, ...] = INFERRING) -> Iterator[str]:
    """Numeric literals of module-level assignments."""
    for path, tree in found.items():
        if path.parts[0] not in packages:
            continue
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                for value in ast.walk(node.value):
                    if isinstance(value, ast.Constant) and type(value.value) in (int, float):
                        yield f"{path}:{node.lineno}: {value.value}"


def docstrings_with_what(found: Modules) -> Iterator[str]:
    """Docstrings that begin with "What" instead of a noun or a verb of the field."""
    described = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for path, tree in found.items():
        for node in ast.walk(tree):
            if isinstance(node, described) and (ast.get_docstring(node) or "").startswith("What "):
                yield f"{path}: {getattr(node, 'name', 'module')}"


def size(package: Path) -> dict[str, tuple[float, float]]:
    """Each count and its limit."""
    found = modules(package)
    count = by_package(found)
    return {
        "statements of models, effects, inference, calibration, diagnosis": (
            sum(count[p] for p in CORE),
            11_500,
        ),
        "statements of these with nodes, report, cli": (sum(count[p] for p in WHOLE_CORE), 20_000),
        "statements of all": (sum(count.values()), 32_000),
        f"records of more than {MOST_FIELDS} fields": (len(list(large_records(found))), 0),
        f"functions of more than {MOST_POSITIONAL} positional parameters": (
            len(list(long_signatures(found))),
            0,
        ),
        "class names that occur twice": (len(list(repeated_names(found))), 0),
        "uses of Any": (uses_of_any(found), 150),
        "numbers at module level of inference, calibration, diagnosis": (len(list(numbers(found))), 160),
        'docstrings that begin with "What"': (len(list(docstrings_with_what(found))), 0),
    }


def main(arguments: list[str]) -> int:
    """Print the counts; status 1 where one is beyond its limit. ``--list`` names what is counted."""
    package = ROOT / "suspension_twin"
    found, counts = modules(package), size(package)
    if "--json" in arguments:
        print(json.dumps({name: {"count": c, "limit": most} for name, (c, most) in counts.items()}, indent=2))
    else:
        for name, (value, most) in counts.items():
            print(f"{value:8d}  of {most:6d}  {name}{'' if value <= most else '   <- beyond'}")
        print(
            "\n".join(
                f"{n:8d}  {p} ({sum(q.parts[0] == p for q in found)} modules)"
                for p, n in by_package(found).most_common()
            )
        )
    if "--list" in arguments:
        for lines in (large_records, long_signatures, repeated_names, numbers, docstrings_with_what):
            print(f"\n{lines.__doc__}", *lines(found), sep="\n  ")
    return int(any(value > most for value, most in counts.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
