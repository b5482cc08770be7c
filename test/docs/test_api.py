# SPDX-License-Identifier: Apache-2.0
"""The public API of docs/api.yaml: every name exists, is documented in NumPy's style, and its example runs."""

from __future__ import annotations

import ast
import builtins
import dataclasses
import doctest
import inspect
import re
import textwrap
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

from suspension_twin import errors
from suspension_twin.inference.problem import Interrupted

LIST = Path(__file__).resolve().parents[2] / "docs" / "api.yaml"
NAMES = [name for names in yaml.safe_load(LIST.read_text(encoding="utf-8")).values() for name in names]
_HEADING = re.compile(r"^([A-Z][a-z]+)\n(-{3,})$", re.MULTILINE)


def found(name: str) -> Any:
    module, _, attribute = name.rpartition(".")
    return getattr(import_module(module), attribute)


def sections(thing: Any) -> dict[str, str]:
    """Text by heading of a docstring in NumPy's style; what comes before the first heading is by ``""``."""
    parts = _HEADING.split(inspect.getdoc(thing) or "")
    for heading, line in zip(parts[1::3], parts[2::3], strict=True):
        assert len(heading) == len(line), f"the line below {heading} is not as long"
    return {"": parts[0].strip(), **dict(zip(parts[1::3], parts[3::3], strict=True))}


def described(text: str) -> list[str]:
    """Names of the entries of a section."""
    heads = [line.partition(" : ")[0] for line in text.splitlines() if line and not line.startswith(" ")]
    return [name.strip() for head in heads for name in head.split(",")]


def parameters(thing: Any) -> set[str]:
    """Names of what a function or a class is called with."""
    if dataclasses.is_dataclass(thing):
        return {f.name for f in dataclasses.fields(thing) if not f.name.startswith("_")}
    if hasattr(thing, "model_fields"):
        return set(thing.model_fields)
    return set(inspect.signature(thing).parameters) - {"self"}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_documented(name: str) -> None:
    thing, text = found(name), sections(found(name))
    assert text[""].partition("\n\n")[0].endswith((".", ":")), "the summary is no sentence"
    given = text.get("Parameters", text.get("Attributes", ""))
    assert set(described(given)) == parameters(thing)
    assert ">>>" in text["Examples"]
    if inspect.isfunction(thing):
        returns = inspect.signature(thing).return_annotation
        assert ("Returns" in text) == (returns not in ("None", None)), "Returns"
        body = ast.walk(ast.parse(textwrap.dedent(inspect.getsource(thing))))
        raises = {n.exc.func.id for n in body if isinstance(n, ast.Raise) and isinstance(n.exc, ast.Call)}
        assert raises <= set(described(text.get("Raises", ""))), "Raises"
    for error in described(text.get("Raises", "")):
        assert error == Interrupted.__name__ or hasattr(errors, error) or hasattr(builtins, error), error


@pytest.mark.parametrize("name", NAMES)
def test_an_example_runs(name: str, repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(repository)
    thing = found(name)
    finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner(verbose=False)
    report: list[str] = []
    globs = dict(vars(import_module(name.rpartition(".")[0])))
    for case in finder.find(thing, name, globs=globs):
        runner.run(case, out=report.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(report)


def test_no_name_is_listed_twice_and_all_are_public() -> None:
    assert len(NAMES) == len(set(NAMES))
    for name in NAMES:
        module, _, attribute = name.rpartition(".")
        assert attribute in import_module(module).__all__, name
