# SPDX-License-Identifier: Apache-2.0
"""The comparison of two versions, whole on two tiny cases."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mujoco")


@pytest.mark.long
def test_a_version_agrees_with_itself_and_a_changed_answer_is_a_difference(
    repository: Path, tmp_path: Path
) -> None:
    def golden(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(repository / "benchmarks" / "golden.py"), *arguments]
        return subprocess.run(command, capture_output=True, text=True)

    cases, out = tmp_path / "cases", tmp_path / "answers.json"
    made = golden("make", str(cases), "--smoke")
    assert made.returncode == 0 and "smoke_rig made in" in made.stdout, made.stderr
    taken = golden("capture", str(cases), "--out", str(out), "--smoke")
    assert taken.returncode == 0, taken.stderr
    assert golden("compare", str(out), str(out)).returncode == 0
    answers = json.loads(out.read_text())
    name = next(n for n in answers["items"] if n.startswith("smoke_"))
    answers["items"][name]["verdict"] = "other"
    changed = tmp_path / "changed.json"
    changed.write_text(json.dumps(answers))
    found = golden("compare", str(out), str(changed))
    assert found.returncode == 1 and name in found.stdout
