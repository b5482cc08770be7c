# SPDX-License-Identifier: Apache-2.0
"""The command killed with SIGKILL, at a generation or in the middle of writing its state, and started again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from suspension_twin.calibration.output import details_path

THREADS = ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
#: What of the state's folder has to be seen, how often, before the process is killed.
MOMENTS = ((".*.part.*", 2), ("state.npz", 3))


def command(case: Any, out: Path, *more: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "suspension_twin",
        "calibrate",
        "--twin",
        case.twin,
        case.bag("pass"),
        "--out",
        str(out),
        "--seed",
        "5",
        *more,
    ]


def killed(arguments: list[str], state: Path, pattern: str, count: int, environment: dict[str, str]) -> bool:
    """Start, wait until ``pattern`` was seen ``count`` times with another content, kill; False if it was through."""
    process = subprocess.Popen(
        arguments, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    seen: set[tuple[str, int]] = set()
    while len(seen) < count and process.poll() is None:
        for path in state.glob(pattern):
            try:
                seen.add((path.name, path.stat().st_mtime_ns))
            except OSError:
                continue
        time.sleep(0.0005)
    through = process.poll() is not None
    process.send_signal(signal.SIGKILL)
    process.wait()
    return not through


@pytest.mark.long
def test_killed_and_started_again_it_ends_with_the_same_bits(
    pass_case: Any, tmp_path: Path, repository: Path
) -> None:
    """One run undisturbed on one thread, one killed twice and ended on two: the same files."""
    more = ("--objective", "euclidean")
    environment = {**os.environ, "PYTHONPATH": str(repository)}
    one, two = ({**environment, **dict.fromkeys(THREADS, n)} for n in ("1", "2"))
    whole, broken = tmp_path / "whole" / "twin.yaml", tmp_path / "broken" / "twin.yaml"
    subprocess.run(command(pass_case, whole, *more), check=True, capture_output=True, env=one)
    state = broken.with_name(f".{broken.name}.state")
    for (pattern, count), threads in zip(MOMENTS, (two, one), strict=True):
        assert killed(command(pass_case, broken, *more), state, pattern, count, threads)
        assert not broken.exists()
    assert (state / "state.npz").exists()
    subprocess.run(command(pass_case, broken, *more), check=True, capture_output=True, env=two)
    assert not state.exists()
    assert broken.read_bytes() == whole.read_bytes()
    assert details_path(broken).read_bytes() == details_path(whole).read_bytes()
