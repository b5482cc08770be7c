# SPDX-License-Identifier: Apache-2.0
"""Mutation testing of ``signals``, ``pose``, ``inference`` and the decision: do tests notice a wrong program?

A mutant is the program with one operator, number, comparison, loop or condition changed, as ``cosmic-ray`` changes
them. Mutants are drawn at random from all of a part, so that the share that is killed holds for the part. It goes on
where the last run ended (``benchmarks/results/mutation.json``), works on a copy of the package, and lists the
survivors: each is a missing test, or a change that makes no difference (``--same ID`` says so). Libraries are loaded
once: each mutant is tested in a process forked from this one, which has not loaded the package.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import importlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from options import parse_options

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "mutation.json"
PACKAGE = "suspension_twin"
#: Folder or file of the package, and the tests that are to notice. Quick ones first: the first that fails ends a trial.
PARTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "signals": ("signals", ("test/signals",)),
    "pose": ("pose", ("test/pose",)),
    "inference": (
        "inference",
        ("test/inference", "test/diagnosis/test_fit.py", "test/diagnosis/test_nuisance_penalty.py"),
    ),
    "decision": (
        "diagnosis/decision.py",
        ("test/diagnosis/test_decision.py", "test/diagnosis/test_wording.py"),
    ),
}
#: Changes that make no other program: decorators are numba's and those of dataclasses.
_LEFT_OUT = ("RemoveDecorator", "NoOp")
_TIMES_SLOWER = 5.0  # a mutant that takes so many times as long as the tests do is one that never ends
_Z = 1.645  # two-sided 90 %


@dataclass
class Mutant:
    """One change. ``outcome``: killed, timeout, survived, or same (looked at, and no other program)."""

    part: str
    file: str
    operator: str
    occurrence: int
    line: int
    change: str
    outcome: str = ""
    seconds: float = 0.0

    @property
    def key(self) -> str:
        """What it is called on the command line."""
        return f"{self.file}:{self.operator}:{self.occurrence}"


def mutants(part: str) -> Iterator[tuple[str, str, int]]:
    """File, operator and occurrence of every mutant of a part."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    place = ROOT / PACKAGE / PARTS[part][0]
    for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
        nodes = list(ast_nodes(get_ast(path.read_text(encoding="utf-8"))))
        for name in operator_names():
            operator = get_operator(name)
            if operator.arguments() or any(word in name for word in _LEFT_OUT):
                continue
            count = sum(1 for node in nodes for _ in operator().mutation_positions(node))
            for occurrence in range(count):
                yield path.relative_to(ROOT).as_posix(), name, occurrence


def mutated(source: str, operator: str, occurrence: int) -> str | None:
    """The changed source; None if it is no program at all, or the same but for annotations and documentation."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    changed: str | None = mutate_code(source, get_operator(operator)(), occurrence)
    with contextlib.suppress(SyntaxError):
        if changed is not None and _bare(changed) != _bare(source):
            return changed
    return None


def _bare(source: str) -> str:
    """The program without annotations and texts of documentation."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            node.returns = None
            for argument in ast.walk(node.args):
                if isinstance(argument, ast.arg):
                    argument.annotation = None
        if isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(0)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.BinOp):
            names = {n.id for n in ast.walk(node.value) if isinstance(n, ast.Name)}
            if isinstance(node.value.op, ast.BitOr) and names & {"Floats", "None"}:
                node.value = ast.Constant(0)  # the name of a type
    return ast.dump(tree)


def _where(source: str, changed: str) -> tuple[int, str]:
    """Line and the change itself."""
    before, after = source.splitlines(), changed.splitlines()
    for tag, i, j, k, m in difflib.SequenceMatcher(None, before, after, autojunk=False).get_opcodes():
        if tag != "equal":
            old, new = " ".join(before[i:j]).strip(), " ".join(after[k:m]).strip()
            return i + 1, f"{old}  →  {new}"[:300]
    return 0, ""


def draw(part: str, done: set[str], number: int) -> list[Mutant]:
    """So many more mutants, in an order that is the same everywhere."""
    every = sorted(mutants(part))
    order = np.random.default_rng(zlib.crc32(part.encode())).permutation(len(every))
    found: list[Mutant] = []
    for index in order:
        if len(found) == number:
            break
        file, operator, occurrence = every[int(index)]
        if f"{file}:{operator}:{occurrence}" in done:
            continue
        source = (ROOT / file).read_text(encoding="utf-8")
        changed = mutated(source, operator, occurrence)
        if changed is not None:
            found.append(Mutant(part, file, operator, occurrence, *_where(source, changed)))
    return found


class Laboratory:
    """A copy of what the tests need, in which files are changed."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="mutation_")
        self.root = Path(self._folder.name) / "copy"
        self._loaded = Path(self._folder.name) / "loaded"
        tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
        for name in tracked.decode().split("\0"):
            source = ROOT / name
            if name and source.is_file() and not name.startswith(("benchmarks/results/", "docs/")):
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, self.root / name)

    def close(self) -> None:
        """Remove it."""
        self._folder.cleanup()

    def test(self, paths: tuple[str, ...], limit: float) -> tuple[str, float]:
        """Outcome of the tests as they find the copy, and seconds."""
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            os.setsid()
            self._be_pytest(paths)
        while True:
            ended, status = os.waitpid(child, os.WNOHANG)
            took = time.monotonic() - began
            if ended:
                break
            if took > limit:
                os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return "timeout", took
            time.sleep(0.02)
        if status == 0:
            for name in self._loaded.read_text(encoding="utf-8").split():
                with contextlib.suppress(Exception):  # what is made while the tests run
                    importlib.import_module(name)
        return "survived" if status == 0 else "killed", took

    def _be_pytest(self, paths: tuple[str, ...]) -> None:
        """Run the tests in this process, tell what was loaded for them, and end."""
        status = 70
        try:
            nowhere = os.open(os.devnull, os.O_RDWR)
            for descriptor in (0, 1, 2):
                os.dup2(nowhere, descriptor)
            os.chdir(self.root)
            sys.path.insert(0, str(self.root))
            sys.dont_write_bytecode = True
            data = str(ROOT.parent / "shared" / "data")
            os.environ.setdefault("SUSPENSION_TWIN_DATA", data)
            os.environ["PYTHONPATH"] = str(self.root)
            import pytest

            status = int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", *paths]))
            libraries = [
                name
                for name, module in list(sys.modules.items())
                if "site-packages" in str(getattr(module, "__file__", "")) and not name.startswith("rclpy")
            ]
            self._loaded.write_text("\n".join(libraries), encoding="utf-8")
        finally:
            os._exit(status)

    def judge(self, mutant: Mutant, limit: float) -> None:
        """Change, test, change back."""
        path = self.root / mutant.file
        source = path.read_text(encoding="utf-8")
        changed = mutated(source, mutant.operator, mutant.occurrence)
        assert changed is not None
        try:
            path.write_text(changed, encoding="utf-8")
            mutant.outcome, mutant.seconds = self.test(PARTS[mutant.part][1], limit)
        finally:
            path.write_text(source, encoding="utf-8")


def interval(killed: int, number: int) -> tuple[float, float]:
    """Wilson's 90 % interval of a share."""
    if not number:
        return 0.0, 1.0
    share, square = killed / number, _Z**2 / number
    middle = (share + square / 2) / (1 + square)
    half = _Z * math.sqrt(share * (1 - share) / number + square / number / 4) / (1 + square)
    return middle - half, middle + half


def score(rows: list[Mutant]) -> dict[str, Any]:
    """Counts and the share killed, of those that are another program."""
    killed = sum(r.outcome in ("killed", "timeout") for r in rows)
    survived = sum(r.outcome == "survived" for r in rows)
    low, high = interval(killed, killed + survived)
    same = sum(r.outcome == "same" for r in rows)
    share = killed / (killed + survived) if killed + survived else math.nan
    return {"killed": killed, "survived": survived, "same": same, "score": share, "low": low, "high": high}


def table(rows: list[Mutant]) -> str:
    """A line a part, and the survivors."""
    lines = [f"{'part':<16}{'killed':>8}{'survived':>10}{'same':>6}{'score':>8}  90 % interval"]
    for part in [*PARTS, "all"]:
        s = score([r for r in rows if part in ("all", r.part)])
        if s["killed"] + s["survived"]:
            share = f"{100 * s['score']:.0f} %"
            span = f"{100 * s['low']:.0f} to {100 * s['high']:.0f} %"
            lines.append(f"{part:<16}{s['killed']:>8}{s['survived']:>10}{s['same']:>6}{share:>8}  {span}")
    for row in rows:
        if row.outcome == "survived":
            lines += [f"{row.file}:{row.line}  {row.key}", f"    {row.change}"]
    return "\n".join(lines)


def main() -> int:
    """Draw, test, keep, show."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--mutants", type=int, default=20, help="further ones of each part (default 20)")
    parser.add_argument("--minutes", type=float, default=60.0, help="at most, for all (default 60)")
    parser.add_argument("--only", action="append", choices=list(PARTS), help="this part; repeatable")
    parser.add_argument(
        "--again", action="store_true", help="test the survivors again, after tests were added"
    )
    parser.add_argument("--same", action="append", metavar="ID", help="this survivor is no other program")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    parser.add_argument("--out", type=Path, default=RESULTS, help="where the figures are kept")
    options = parse_options(
        parser, only=["decision"], mutants=1, out=Path(tempfile.gettempdir()) / "mutation_smoke.json"
    )
    rows = []
    if options.out.is_file():
        rows = [Mutant(**row) for row in json.loads(options.out.read_text(encoding="utf-8"))["mutants"]]
    for row in rows:
        if row.key in (options.same or ()):
            row.outcome = "same"
    names = [] if options.same else options.only or list(PARTS)
    deadline = time.monotonic() + 60.0 * options.minutes
    laboratory = Laboratory()
    try:
        for part in names:
            if options.again:
                todo = [r for r in rows if r.part == part and r.outcome == "survived"]
            else:
                todo = draw(part, {r.key for r in rows}, options.mutants)
            if not todo:
                continue
            outcome, seconds = laboratory.test(PARTS[part][1], 3600.0)
            if outcome != "survived":
                print(f"mutation: {part}: the tests fail without a mutant", file=sys.stderr)
                return 1
            for mutant in todo:
                if time.monotonic() > deadline:
                    break
                laboratory.judge(mutant, 60.0 + _TIMES_SLOWER * seconds)
                if not options.again:
                    rows.append(mutant)
                _keep(options.out, rows)
    finally:
        laboratory.close()
    _keep(options.out, rows)
    if options.json:
        print(json.dumps({part: score([r for r in rows if r.part == part]) for part in PARTS}))
    else:
        print(table(rows))
    return 0


def _keep(path: Path, rows: list[Mutant]) -> None:
    text = json.dumps({"mutants": [asdict(row) for row in rows]}, indent=1, ensure_ascii=False)
    new = path.with_name(f".{path.name}.new")  # the package's own writer would load the package
    new.write_text(text + "\n", encoding="utf-8")
    new.replace(path)


if __name__ == "__main__":
    sys.exit(main())
