# SPDX-License-Identifier: Apache-2.0
"""SIGKILL at random moments: the next run resumes or starts clean, and gives the same bits as an undisturbed one."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from torture.commands import ROOT, broken_promise, digest, hidden_parts, run
from torture.ledger import Tally

__all__ = ["BAR", "torture"]

BAR = "the next run resumes or starts clean; no half file under a final name; the same bits as undisturbed"

_BAG = ROOT / "bags" / "bump_15kmh"
_TWIN = _BAG / "twin.yaml"
#: Each command with its options, the names that it writes, and its share of the trials.
COMMANDS = {
    "import": (["import", str(_BAG)], ("out",), 3),
    "mesh": (["road", "mesh", str(_BAG / "road.crg")], ("road.obj",), 2),
    "simulate": (["simulate", "--twin", str(_TWIN), str(_BAG)], ("simulated", "gap.json"), 2),
    "calibrate": (
        [
            *("calibrate", "--twin", str(_TWIN), str(_BAG), "--max-generations", "4"),
            *("--free", "vehicle.mass", "--free", "vehicle.front.damper_push"),
        ],
        ("calibrated.yaml", "calibrated.calibration.yaml"),
        2,
    ),
}


def _arguments(name: str, folder: Path) -> list[str]:
    arguments, names, _ = COMMANDS[name]
    return [*arguments, "--out", str(folder if name == "simulate" else folder / names[0])]


def torture(tally: Tally) -> None:
    """Kill a command once to three times, then let it end; another trial lets an older result stand meanwhile."""
    schedule = [name for name, (_, _, share) in COMMANDS.items() for _ in range(share)]
    undisturbed: dict[str, tuple[dict[str, str], float]] = {}
    with tempfile.TemporaryDirectory() as base:
        for number in tally.numbers():
            rng, name = tally.rng(number), schedule[number % len(schedule)]
            names = COMMANDS[name][1]
            if name not in undisturbed:
                folder = Path(base) / f"undisturbed_{name}"
                ended = run(_arguments(name, folder))
                if problem := broken_promise(ended, [0]):
                    tally.fail(f"{name} undisturbed: {problem}")
                    continue
                undisturbed[name] = {n: digest(folder / n) for n in names}, ended.seconds
            wanted, seconds = undisturbed[name]
            folder = Path(base) / "trial"
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            older = rng.random() < 0.3
            if older:  # an older result, which must stand or be replaced, never be half
                shutil.copytree(Path(base) / f"undisturbed_{name}", folder, dirs_exist_ok=True)
            problem, killed = None, 0
            for _ in range(int(rng.integers(1, 4))):
                force = ["--force"] if any((folder / n).exists() for n in names) else []
                ended = run(
                    [*_arguments(name, folder), *force], kill_after=float(rng.uniform(0.05, 1.0) * seconds)
                )
                killed += ended.killed
                there = {n: digest(folder / n) for n in names if (folder / n).exists()}
                half = [n for n, found in there.items() if found != wanted[n]]
                if half:
                    problem = f"{name}: half of {half[0]} under its final name"
                if older and len(there) < len(names):
                    tally.count("killed between two renames of a folder")
            force = ["--force"] if any((folder / n).exists() for n in names) else []
            ended = run([*_arguments(name, folder), *force])
            problem = problem or broken_promise(ended, [0])
            if not problem:
                other = [n for n in names if digest(folder / n) != wanted[n]]
                problem = f"{name}: other bits in {other[0]}" if other else None
            if not problem and (left := hidden_parts(folder)):
                problem = f"{name}: {left[0]} is left"
            tally.count(f"{name}, killed {killed} times")
            if problem:
                tally.fail(problem)
