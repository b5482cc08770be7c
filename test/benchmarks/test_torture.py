# SPDX-License-Identifier: Apache-2.0
"""The torture bench goes on where it ended, says what failed, and its mutations are the same everywhere."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest


def run(repository: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    program = repository / "benchmarks" / "torture.py"
    return subprocess.run(
        [sys.executable, str(program), *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=repository,
    )


@pytest.mark.long
def test_it_goes_on_where_it_ended(repository: Path, tmp_path: Path) -> None:
    out = tmp_path / "torture.json"
    first = run(repository, "--only", "numerics", "--minutes", "0", "--out", str(out), "--json")
    assert first.returncode == 0, first.stderr
    begun = json.loads(first.stdout)["numerics"]
    assert begun["trials"] == 1 and begun["failed"] == 0 and sum(begun["counts"].values()) == 1
    assert json.loads(out.read_text())["rows"][0]["trials"] == 1
    table = run(repository, "--only", "numerics", "--minutes", "0", "--out", str(out))
    assert table.returncode == 0, table.stderr
    assert json.loads(out.read_text())["rows"][0]["trials"] == 2
    assert [line.split()[:3] for line in table.stdout.splitlines()[1:2]] == [["numerics", "2", "0"]]


def test_a_trial_is_the_same_everywhere(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(repository / "benchmarks"))
    from torture.files import mutate
    from torture.ledger import Tally

    sample = b"time,x\n" + b"".join(b"%d,0.5\n" % i for i in range(50))
    made = [mutate(sample, Tally("files", "").rng(n)) for n in range(40)]
    assert made == [mutate(sample, Tally("files", "").rng(n)) for n in range(40)]
    assert len(set(made)) > 35 and sum(m != sample for m in made) > 35
