# SPDX-License-Identifier: Apache-2.0
"""``docs/numbers.md`` lists every number that the modules of the diagnosis set, with its value; its reason stands there
or, of a tolerance or a definition, in a comment beside it."""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

#: Kinds of numbers: those whose source is on the page, and those that have a comment beside them.
SAID, COMMENTED = ("threshold", "prior"), ("tolerance", "definition")
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


def commented_in(module: Path) -> set[tuple[str, str]]:
    """(file, name) of what is assigned at the top level of a module below a comment, or before one in its line."""
    source, found = module.read_text(encoding="utf-8"), set()
    lines = source.splitlines()
    for statement in ast.parse(source).body:
        if isinstance(statement, ast.Assign | ast.AnnAssign):
            own = " ".join(lines[statement.lineno - 1 : statement.end_lineno])
            if lines[statement.lineno - 2].startswith("#") or "  # " in own:
                targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
                names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
                found |= {(module.name, name) for name in names}
    return found


def modules(repository: Path) -> list[Path]:
    package = repository / "suspension_twin"
    fitting = [package / "inference" / f"{name}.py" for name in FITTING]
    return [*sorted((package / "diagnosis").glob("*.py")), package / "addons" / "plan" / "plan.py", *fitting]


def in_the_code(repository: Path) -> dict[tuple[str, str], tuple[str, int]]:
    found: dict[tuple[str, str], tuple[str, int]] = {}
    for module in modules(repository):
        found |= set_by(module)
    return found


def on_the_page(repository: Path) -> dict[tuple[str, str], tuple[str, str, str]]:
    """(file, name) to (value, kind, source); the kind is the heading above."""
    text = (repository / "docs" / "numbers.md").read_text(encoding="utf-8")
    rows: list[tuple[str, str, str, str, str]] = []
    for section in text.split("\n## ")[1:]:
        kind = section.partition("s\n")[0].lower()
        for file, name, value, source in re.findall(
            r"^- `(\w+)\.(\w+)` (`.*?`|\d+ numbers): (.+)$", section, re.MULTILINE
        ):
            rows.append((f"{file}.py", name, value, kind, source))
        for file, line in re.findall(r"^- `(\w+)`: (.+)$", section, re.MULTILINE):
            rows += [(f"{file}.py", *pair, kind, "") for pair in re.findall(r"`(\w+)` (`.*?`)", line)]
    assert len({row[:2] for row in rows}) == len(rows), "a number is listed twice"
    return {(file, name): (value, kind, source) for file, name, value, kind, source in rows}


def test_every_number_of_the_diagnosis_is_listed_with_its_value(repository: Path) -> None:
    code, page = in_the_code(repository), on_the_page(repository)
    assert {key: value for key, (value, _) in code.items()} == {key: row[0] for key, row in page.items()}


def test_every_number_has_a_kind_and_a_source(repository: Path) -> None:
    commented = {pair for module in modules(repository) for pair in commented_in(module)}
    for key, (_, kind, source) in on_the_page(repository).items():
        assert kind in (*SAID, *COMMENTED), key
        if kind in SAID:
            assert len(source.split()) >= 3 and source.endswith("."), key
        else:
            assert key in commented, f"{key}: a comment beside it says where it comes from"


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
