# SPDX-License-Identifier: Apache-2.0
"""SIGKILL at random moments: the next run resumes or starts clean, and gives the same bits as an undisturbed one.

Of a live recording all but its last seconds is there, and the next one with its name is refused.
"""

from __future__ import annotations

import asyncio
import hashlib
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torture.commands import PROGRAM, ROOT, broken_promise, digest, environment, hidden_parts, run
from torture.ledger import Tally

sys.path.insert(0, str(ROOT / "test" / "addons" / "sources"))  # the emulators of the apps

__all__ = ["BAR", "torture"]

BAR = "the next run resumes or starts clean; no half file under a final name; the same bits as undisturbed"

_BAG = ROOT / "bags" / "bump_15kmh"
_OTHER = ROOT / "bags" / "crg_road"
_TWIN = _BAG / "twin.yaml"
_FOLDER = "{folder}"  # in arguments: the one of ``out``
_LOST = 3.0  # s of a live recording that a kill may cost


@dataclass(frozen=True)
class Command:
    """``arguments`` without ``--out``, whose last word is ``out``; the ``names`` that it writes beside each other, or
    in ``out`` where it ``goes_on`` by itself, with a suffix of the files in it that are the same in every run."""

    arguments: tuple[str, ...]
    names: tuple[str, ...]
    share: int
    out: str = ""
    goes_on: str = ""

    def line(self, folder: Path) -> list[str]:
        force = ["--force"] if not self.goes_on and any((folder / n).exists() for n in self.names) else []
        arguments = [a.replace(_FOLDER, str(folder)) for a in self.arguments]
        return [*arguments, "--out", str(folder / self.out), *force]

    def contents(self, folder: Path) -> dict[str, str]:
        """Digest of everything that is there under a final name."""
        if self.goes_on:
            files = sorted((folder / self.out).rglob(self.goes_on))
            return {str(f.relative_to(folder)): digest(f) for f in files}
        return {n: digest(folder / n) for n in self.names if (folder / n).exists()}


def commands(folder: Path) -> dict[str, Command]:
    """What is killed; ``folder`` gets what they need."""
    manifest = folder / "fleet.csv"
    rows = [f"{b.name},2026-01-0{i + 1},{b / 'twin.yaml'},{b}" for i, b in enumerate((_BAG, _OTHER))]
    manifest.write_text("\n".join(["vehicle,date,twin,drives", *rows]) + "\n")
    free = ("--free", "vehicle.mass", "--free", "vehicle.front.damper_push")
    calibrate = ("calibrate", "--twin", str(_TWIN), str(_BAG), "--max-generations", "4", *free)
    effects = ("--effect", "time_offset", "--effect", "sensor_scale")
    answers = ("diagnosis.json", "evidence.json", "twin.yaml", "report.html")
    part, joint = f"{_BAG}@0..40", ("--iterations", "3", "--joint", f"{_FOLDER}/joint.yaml")
    roads = ("road", "drives", part, "--twin", str(_TWIN), *joint)
    fleet = ("fleet", "calibrate", str(manifest), "--max-generations", "3", "--workers", "1")
    return {
        "import": Command(("import", str(_BAG)), ("out",), 2, "out"),
        "mesh": Command(("road", "mesh", str(_BAG / "road.crg")), ("road.obj",), 1, "road.obj"),
        "road drives": Command(roads, ("road.crg", "road.json", "joint.yaml"), 2, "road.crg"),
        "simulate": Command(("simulate", "--twin", str(_TWIN), str(_BAG)), ("simulated", "gap.json"), 1),
        "calibrate": Command(
            calibrate, ("calibrated.yaml", "calibrated.calibration.yaml"), 2, "calibrated.yaml"
        ),
        "diagnose": Command(("diagnose", "--twin", str(_TWIN), str(_BAG), *effects), answers, 2),
        "fleet": Command(fleet, (), 2, "fleet", "twin.yaml"),
    }


def torture(tally: Tally) -> None:
    """Kill a command two to six times, then let it end; another trial lets an older result stand meanwhile."""
    with tempfile.TemporaryDirectory() as base:
        known = commands(Path(base))
        schedule = [name for name, command in known.items() for _ in range(command.share)] + ["record"] * 6
        undisturbed: dict[str, tuple[dict[str, str], float]] = {}
        for number in tally.numbers():
            rng, name = tally.rng(number), schedule[number * 7 % len(schedule)]
            folder = Path(base) / "trial"
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            if name == "record":
                if problem := _recorded(rng, folder):
                    tally.fail(problem)
                tally.count("record, killed 1 times")
                continue
            command = known[name]
            if name not in undisturbed:
                whole = Path(base) / f"undisturbed_{name}"
                whole.mkdir()
                ended = run(command.line(whole))
                if problem := broken_promise(ended, [0]):
                    tally.fail(f"{name} undisturbed: {problem}")
                    continue
                undisturbed[name] = command.contents(whole), ended.seconds
            problem, killed = _killed(tally, rng, name, command, folder, *undisturbed[name])
            tally.count(f"{name}, killed {killed} times")
            if problem:
                tally.fail(f"{name}: {problem}")


def _killed(
    tally: Tally,
    rng: np.random.Generator,
    name: str,
    command: Command,
    folder: Path,
    wanted: dict[str, str],
    seconds: float,
) -> tuple[str | None, int]:
    """The first problem, and how often it was killed."""
    older = not command.goes_on and rng.random() < 0.3
    if older:  # an older result, which must stand or be replaced, never be half
        shutil.copytree(folder.with_name(f"undisturbed_{name}"), folder, dirs_exist_ok=True)
    problem, killed = None, 0
    for _ in range(int(rng.integers(2, 7))):
        ended = run(command.line(folder), kill_after=float(rng.uniform(0.05, 1.0) * seconds))
        killed += ended.killed
        there = command.contents(folder)
        half = [n for n, found in there.items() if found != wanted.get(n)]
        if half:
            problem = f"half of {half[0]} under its final name"
        if older and len(there) < len(command.names):
            tally.count("killed between two renames of a folder")
    ended = run(command.line(folder))
    problem = problem or broken_promise(ended, [0])
    if not problem:
        found = command.contents(folder)
        other = [n for n in wanted if found.get(n) != wanted[n]]
        problem = f"other bits in {other[0]}" if other else None
    if not problem and (left := hidden_parts(folder)):
        problem = f"{left[0]} is left"
    return problem, killed


def _recorded(rng: np.random.Generator, folder: Path) -> str | None:
    """Kill a live recording of a phone that plays a drive; what is wrong with what is left of it."""
    from sensor_logger_app import SensorLoggerApp

    from suspension_twin.drive.read import read_drive

    drive = read_drive(_BAG)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    name = str(rng.choice(["live", "live.mcap"]))
    arguments = ["record", "--source", f"sensorlogger://127.0.0.1:{port}", "--out", str(folder / name)]
    process = subprocess.Popen(
        [*PROGRAM, *arguments], env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    end = time.monotonic() + 60.0
    while time.monotonic() < end and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                break
        time.sleep(0.05)
    lasts = float(rng.uniform(0.2, 7.5))
    asyncio.run(SensorLoggerApp(drive).push_until(f"http://127.0.0.1:{port}/", lasts, process.kill))
    process.communicate()
    wanted, step = drive.imu.specific_force, float(np.median(np.diff(drive.imu.t)))
    try:
        left = read_drive(folder / name).imu.specific_force
    except Exception as error:  # of the first seconds nothing may be there yet
        left = wanted[:0]
        if lasts > _LOST + 1.0:
            return f"record, killed after {lasts:.1f} s: {error}"
    if len(left) * step < lasts - _LOST:
        return f"record, killed after {lasts:.1f} s: {len(left) * step:.1f} s are left"
    if not np.array_equal(left, wanted[: len(left)]):
        return "record: other samples than were sent"
    again = run([*arguments, "--seconds", "0.1"])
    if (folder / name).exists() and (again.status != 2 or "exists already" not in again.err):
        return f"record: the next one with its name ends with {again.status}"
    before = hashlib.sha256(left.tobytes()).digest()
    if (
        len(left)
        and hashlib.sha256(read_drive(folder / name).imu.specific_force.tobytes()).digest() != before
    ):
        return "record: the next one with its name changed it"
    return None
