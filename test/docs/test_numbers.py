# SPDX-License-Identifier: Apache-2.0
"""``docs/numbers.md`` lists every number that the modules of the diagnosis set, with its value and its source."""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

KINDS = ("standard", "definition", "prior", "learnt", "tolerance", "threshold")
#: Modules of inference that the fits of a diagnosis rest on.
FITTING = ("problem", "fit", "hypothesis", "cross_validation", "checkpoint")
MOST = 6  # numbers that are written out


def numbers_in(node: ast.expr) -> int:
    """How many numbers an expression has, zeros and powers included."""
    return sum(
        isinstance(part, ast.Constant)
        and isinstance(part.value, int | float)
        and not isinstance(part.value, bool)
        for part in ast.walk(node)
    )


def shown(node: ast.expr) -> str:
    """An expression as the page shows it."""
    count = numbers_in(node)
    return f"`{ast.unparse(node)}`" if count <= MOST else f"{count} numbers"


def set_by(module: Path) -> dict[tuple[str, str], tuple[str, int]]:
    """(file, name) to (value as shown, count) of what a module assigns at its top level and has a number in it."""
    found: dict[tuple[str, str], tuple[str, int]] = {}
    for statement in ast.parse(module.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.AnnAssign) and statement.value is not None:
            pairs = [(statement.target, statement.value)]
        elif isinstance(statement, ast.Assign):
            (target,) = statement.targets
            pairs = [(target, statement.value)]
            if isinstance(target, ast.Tuple) and isinstance(statement.value, ast.Tuple):
                pairs = list(zip(target.elts, statement.value.elts, strict=True))
        else:
            continue
        for target, value in pairs:
            if numbers_in(value):
                found[module.name, ast.unparse(target)] = shown(value), numbers_in(value)
    return found


def in_the_code(repository: Path) -> dict[tuple[str, str], tuple[str, int]]:
    found: dict[tuple[str, str], tuple[str, int]] = {}
    package = repository / "suspension_twin"
    for module in (*sorted((package / "diagnosis").glob("*.py")), package / "addons" / "plan" / "plan.py"):
        found |= set_by(module)
    for name in FITTING:
        found |= set_by(repository / "suspension_twin" / "inference" / f"{name}.py")
    return found


def on_the_page(repository: Path) -> dict[tuple[str, str], tuple[str, str, str]]:
    """(file, name) to (value, kind, source); the kind is the heading above."""
    text = (repository / "docs" / "numbers.md").read_text(encoding="utf-8")
    rows: list[tuple[str, str, str, str, str]] = []
    for section in text.split("\n## ")[1:]:
        kind = section.partition("s\n")[0].lower()
        found = re.findall(r"^- `(\w+)\.(\w+)` (`.*?`|\d+ numbers): (.+)$", section, re.MULTILINE)
        rows += [(f"{file}.py", name, value, kind, source) for file, name, value, source in found]
    assert len({row[:2] for row in rows}) == len(rows), "a number is listed twice"
    return {(file, name): (value, kind, source) for file, name, value, kind, source in rows}


def test_every_number_of_the_diagnosis_is_listed_with_its_value(repository: Path) -> None:
    code, page = in_the_code(repository), on_the_page(repository)
    assert {key: value for key, (value, _) in code.items()} == {key: row[0] for key, row in page.items()}


def test_every_number_has_a_kind_and_a_source(repository: Path) -> None:
    for key, (_, kind, source) in on_the_page(repository).items():
        assert kind in KINDS, key
        assert len(source.split()) >= 3 and source.endswith("."), key


def test_the_counts_are_those_of_the_code(repository: Path) -> None:
    code, page = in_the_code(repository), on_the_page(repository)
    counts: Counter[str] = Counter()
    for key, (_, count) in code.items():
        counts[page[key][1]] += count
    text = (repository / "docs" / "numbers.md").read_text(encoding="utf-8")
    stated = {
        kind: int(count) for kind, count in re.findall(r"^\| (\w+) \|.*\| (\d+) \|$", text, re.MULTILINE)
    }
    assert stated == dict(counts)
