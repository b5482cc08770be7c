# SPDX-License-Identifier: Apache-2.0
"""A diagnosis killed with SIGKILL and started again; what it keeps on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.inference.checkpoint import Checkpoint, Rounds
from suspension_twin.inference.fit import Fit
from suspension_twin.inference.hypothesis import Hypothesis


@pytest.mark.long
def test_killed_and_started_again_it_ends_with_the_same_bits(
    make: Any, tmp_path: Path, repository: Path
) -> None:
    """One undisturbed in this process that keeps nothing, one killed in another and ended here."""
    twin, bags, _ = make("sensor_scale", {"scale": 0.3})
    effects = ("time_offset", "sensor_scale")
    asked = DiagnosisRequest(str(twin), (bags[0],), effects=effects)
    whole = diagnose(asked)
    program = [sys.executable, "-m", "suspension_twin", "diagnose", "--twin", str(twin), bags[0]]
    program += ["--out", str(tmp_path), *(word for name in effects for word in ("--effect", name))]
    environment = {**os.environ, "PYTHONPATH": str(repository)}
    process = subprocess.Popen(program, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    state = tmp_path / ".state"
    while process.poll() is None and len(list(state.glob("state-*.npz"))) < 3:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL and not (tmp_path / "diagnosis.json").exists()
    kept = {file: file.stat().st_mtime_ns for file in state.glob("state-*.npz")}
    assert len(kept) >= 3
    resumed = diagnose(replace(asked, state=str(state)))
    assert kept == {file: file.stat().st_mtime_ns for file in kept}, "what was kept was done again"
    assert resumed.document == whole.document and resumed.evidence == whole.evidence
    assert resumed.twin == whole.twin


def test_a_piece_is_done_once_for_one_problem(tmp_path: Path) -> None:
    done: list[str] = []

    def work(effect: str) -> tuple[Fit, dict[tuple[int, bool], float], list[float | None]]:
        done.append(effect)
        x = np.asfortranarray(np.arange(6.0).reshape(2, 3)) / 7.0
        return Fit(Hypothesis((effect,), around=(0.1,)), x, 0.1 + 0.2), {(0, True): 1 / 3}, [None, 2.5]

    def run(problem: str) -> list[Any]:
        return Rounds(Checkpoint(tmp_path, problem)).side_by_side(
            "first", work, ["time_offset", "clock_drift"]
        )

    first, again = run("one"), run("one")
    assert sorted(done) == ["clock_drift", "time_offset"]
    for (fit, level, numbers), (fit_2, level_2, numbers_2) in zip(first, again, strict=True):
        assert fit.hypothesis == fit_2.hypothesis and fit.cost == fit_2.cost == 0.1 + 0.2
        assert np.array_equal(fit.x, fit_2.x) and fit_2.x.flags.f_contiguous
        assert level == level_2 and numbers == numbers_2
    run("another")
    assert len(done) == 4


def test_what_is_no_result_is_not_kept(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="object is no partial result"):
        Rounds(Checkpoint(tmp_path, "one")).side_by_side("first", lambda item: object(), ["a"])
