# SPDX-License-Identifier: Apache-2.0
"""Disks that are full, read-only, slow to say so, files that shrink: one line, and nothing lost that was there."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torture.commands import ROOT, broken_promise, digest, hidden_parts, run
from torture.ledger import Tally

__all__ = ["BAR", "torture"]

BAR = "one line; nothing lost that was written before; exit 1 where there is no space, 2 where a path cannot be used"

_BAG = ROOT / "bags" / "crg_road"
_ROAD, _TWIN = _BAG / "road.crg", _BAG / "twin.yaml"
#: Commands with what they write, and the size in kB of the disk on which they may fail.
COMMANDS = {
    "import": (["import", str(_BAG), "--out"], "out", 3000),
    "mesh": (["road", "mesh", str(_ROAD), "--out"], "road.obj", 4000),
    "show": (["road", "show", str(_ROAD), "--out"], "road.png", 600),
    "check": (["road", "check", str(_ROAD), "--out"], "road.json", 12),
    "simulate": (["simulate", "--twin", str(_TWIN), str(_BAG), "--out"], ".", 3000),
}
_WRITTEN = {"simulate": ("simulated", "gap.json")}


def _in_namespace(script: str, arguments: Sequence[str]) -> list[str]:
    """A command line before the program that makes mounts of its own: nobody else sees them."""
    return ["unshare", "-rm", "sh", "-c", f'{script}; exec "$@"', "sh", *arguments]


def _mounts() -> bool:
    try:
        done = subprocess.run(["unshare", "-rm", "true"], capture_output=True, check=False)
    except OSError:
        return False
    return done.returncode == 0


def _full(tally: Tally, name: str, folder: Path, rng: np.random.Generator) -> str | None:
    """A file system of random size, which may hold an older result; what is on it afterwards comes back as a copy."""
    arguments, out, most = COMMANDS[name]
    kilobytes, older = int(rng.integers(4, most)), rng.random() < 0.5
    disk, back = folder / "disk", folder / "back"
    disk.mkdir()
    fill = (
        f'echo old > "{disk}/{"gap.json" if name == "simulate" else out}"'
        if older and name != "import"
        else "true"
    )
    script = (
        f'mount -t tmpfs -o size={kilobytes}k tmpfs "{disk}" && {fill} && '
        f'{{ "$@"; code=$?; cp -a "{disk}" "{back}"; exit $code; }}; exit $?'
    )
    ended = run([*arguments, str(disk / out), "--force"], before=["unshare", "-rm", "sh", "-c", script, "sh"])
    written = _WRITTEN.get(name, (out,))
    if ended.status == 0:
        tally.count("there was space")
        return None if all((back / w).exists() for w in written) else f"{name}: done, and nothing there"
    tally.count("full")
    if problem := broken_promise(ended, [1]):
        return f"{name}, {kilobytes} kB: {problem}"
    if "space" not in ended.err:
        return f"{name}, {kilobytes} kB: does not say why: {ended.err.strip()[-200:]}"
    if left := hidden_parts(back):
        return f"{name}, {kilobytes} kB: {left[0]} is left"
    for w in written:
        path = back / w
        if older and name != "import" and path.is_file() and path.read_text() == "old\n":
            continue
        if path.exists() and not (name == "simulate" and w == "simulated"):
            return f"{name}, {kilobytes} kB: {w} is there after a failure"
    return None


def _read_only(tally: Tally, name: str, folder: Path, rng: np.random.Generator) -> str | None:
    arguments, out, _ = COMMANDS[name]
    disk = folder / "disk"
    disk.mkdir()
    script = f'mount --bind "{disk}" "{disk}" && mount -o remount,ro,bind "{disk}"'
    ended = run([*arguments, str(disk / out)], before=_in_namespace(script, []))
    tally.count("read-only")
    return broken_promise(ended, [2]) or (f"{name}: wrote" if any(disk.iterdir()) else None)


def _quota(tally: Tally, name: str, folder: Path, rng: np.random.Generator) -> str | None:
    """A limit of the size of a file."""
    arguments, out, most = COMMANDS[name]
    blocks = int(rng.integers(1, max(most // 4, 2)))
    ended = run(
        [*arguments, str(folder / out)],
        before=["sh", "-c", f'trap "" XFSZ; ulimit -f {blocks}; exec "$@"', "sh"],
    )
    tally.count("limited")
    if ended.status == 0:
        return None
    problem = broken_promise(ended, [1])
    left = hidden_parts(folder)
    return f"{name}, limited: {problem}" if problem else f"{name}: {left[0]} is left" if left else None


def _shrinks(tally: Tally, name: str, folder: Path, rng: np.random.Generator) -> str | None:
    """The input is cut while it is read, or written anew as by a slow copy."""
    inputs = folder / "bag"
    shutil.copytree(_BAG, inputs)
    victim = inputs / "road.crg" if name in ("mesh", "show", "check") else next(inputs.glob("*.mcap"))
    whole = victim.read_bytes()
    arguments = [
        str(inputs / Path(a).relative_to(_BAG)) if a.startswith(str(_BAG)) else a for a in COMMANDS[name][0]
    ]
    stop = threading.Event()

    def shrink() -> None:
        own = np.random.default_rng(int(rng.integers(1 << 30)))
        while not stop.is_set():
            with victim.open("rb+") as file:
                file.truncate(int(own.integers(len(whole))))
            time.sleep(float(own.uniform(0.0, 0.1)))
            if own.random() < 0.5:
                victim.write_bytes(whole)
                time.sleep(float(own.uniform(0.0, 0.5)))

    thread = threading.Thread(target=shrink)
    thread.start()
    try:
        ended = run([*arguments, str(folder / COMMANDS[name][1])])
    finally:
        stop.set()
        thread.join()
    tally.count("shrinks")
    problem = broken_promise(ended, [0, 1, 2])
    return f"{name}, input shrinks: {problem}" if problem else None


def torture(tally: Tally) -> None:
    """One kind of disk and one command a trial."""
    kinds = [_quota, _shrinks]
    if _mounts():
        kinds = [_full, _full, _read_only, *kinds]
    else:
        tally.note("no file systems of its own may be mounted here: full and read-only disks are left out")
    if os.geteuid() == 0:
        tally.note("run as root, whom permissions do not stop: they are left out")
    before = {path: digest(path) for path in (_ROAD, _TWIN)}
    for number in tally.numbers():
        rng = tally.rng(number)
        name = list(COMMANDS)[number % len(COMMANDS)]
        kind = kinds[number // len(COMMANDS) % len(kinds)]
        with tempfile.TemporaryDirectory() as folder:
            problem = kind(tally, name, Path(folder), rng)
        if problem:
            tally.fail(problem)
        if any(digest(path) != found for path, found in before.items()):
            tally.fail(f"{name}: changed its input")
            return
