# SPDX-License-Identifier: Apache-2.0
"""The program as a process: run, killed, watched; and what it must keep to whatever happens."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["PROGRAM", "ROOT", "Ended", "broken_promise", "digest", "hidden_parts", "run"]

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = (sys.executable, "-m", "suspension_twin")


@dataclass(frozen=True)
class Ended:
    """How a command ended; ``killed`` before it was done."""

    status: int
    out: str
    err: str
    seconds: float
    killed: bool = False


def environment(**more: str) -> dict[str, str]:
    """Of a child: this source tree, one thread."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", **more}


def run(
    arguments: Sequence[str],
    *,
    kill_after: float | None = None,
    timeout: float = 600.0,
    before: Sequence[str] = (),
) -> Ended:
    """Run the program with these arguments; SIGKILL after ``kill_after`` s. ``before`` is put before the command."""
    began = time.monotonic()
    process = subprocess.Popen(
        [*before, *PROGRAM, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment(),
        start_new_session=True,
    )
    killed = False
    try:
        out, err = process.communicate(timeout=timeout if kill_after is None else kill_after)
    except subprocess.TimeoutExpired:
        killed = True
        process.kill()
        out, err = process.communicate()
    return Ended(process.returncode, out, err, time.monotonic() - began, killed)


def broken_promise(ended: Ended, allowed: Sequence[int]) -> str | None:
    """What a command did that it must not: another status, a traceback, more than one line of error."""
    lines = [line for line in ended.err.splitlines() if line.strip()]
    if ended.status not in allowed:
        return f"exit status {ended.status}: {' '.join(lines[-1:])[:200]}"
    if "Traceback" in ended.err or "unexpected error" in ended.err:
        return f"not one line: {lines[-1][:200]}"
    if ended.status and len(lines) != 1:
        return f"{len(lines)} lines of error: {lines[:2]}"
    return None


def digest(path: Path) -> str:
    """Of a file, or of all files in a folder with their names."""
    total = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            total.update(file.relative_to(path).as_posix().encode() + b"\0" + file.read_bytes())
    return total.hexdigest()


def hidden_parts(folder: Path) -> list[str]:
    """Temporary files that a command left."""
    return sorted(p.name for p in folder.rglob(".*.part*"))
