# SPDX-License-Identifier: Apache-2.0
"""A fleet of simulated vehicles, some of which get a fault on a date: throughput, lost results, faults found.

The drives are made by the bundled generators: every vehicle has dampers of its own (10 % around the twin's), every
drive another speed and a load of up to 75 kg that the twin does not know. From a date on, the faulty vehicles lose 20
to 45 % of the damper force of one axle. ``suspension-twin fleet calibrate`` calibrates all drives in a process of its
own. Throughput is beside the bare function: as many processes as workers that calibrate some of the drives without
Dask, before and after.

``--kill-every S`` kills a worker (SIGKILL) every S s. ``--restart-scheduler`` runs scheduler and workers as programs of
their own, kills the scheduler when half of the drives are done, and starts what has ended again, as an operator's
supervisor would.

With ``--keep DIR --resume`` a run goes on where an earlier one of that folder ended, drives and results; ``--budget
S`` ends it after S s. Throughput is then that of all sittings together.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from options import parse_options

#: As docs/fleet.md has it for workers of a scheduler of one's own.
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(64 << 20),
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "10s",
    "DASK_DISTRIBUTED__SCHEDULER__ACTIVE_MEMORY_MANAGER__START": "False",
}
#: Drives that a process of the bare function calibrates at a time, after two that load the compiled code.
BARE = 20
#: s after which a run is given up.
LONGEST = 7200.0


# -- drives -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vehicle:
    """One vehicle: its name, the number of its first drive with the fault (None: sound), the fault in words."""

    name: str
    fault_at: int | None
    fault: str


def make_fleet(
    folder: Path, vehicles: int, faults: int, drives: int, seconds: float, seed: int
) -> tuple[Path, list[Vehicle]]:
    """Write twin, road, drives and manifest; ``drives`` for each vehicle. The same seed makes the same files."""
    from suspension_twin.cli.common import bundled
    from suspension_twin.drive.write import write_drive
    from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
    from suspension_twin.road import bump_road, circular, write_road
    from suspension_twin.vehicle.twin import RoadFile, load_twin, save_twin

    rng = np.random.default_rng(seed)
    length = 7.0 * seconds + 20.0
    bumps = list(np.arange(25.0, length - 20.0, 30.0))
    road = bump_road(circular(0.9, 0.05), at=bumps, length=length, step=0.05, x=-20.0, y=3.0, heading=0.4)
    write_road(road, folder / "road.crg")
    plain = load_twin(bundled("config", "twins", "ford_mondeo_mk4.yaml"))
    twin = plain.model_copy(update={"road": RoadFile(file=folder / "road.crg")})
    save_twin(twin, folder / "twin.yaml")
    known, rows = [], ["vehicle,date,twin,drives"]
    faulty = set(rng.choice(vehicles, faults, replace=False).tolist())
    for number in range(vehicles):
        name = f"car_{number:02d}"
        own = dict(zip(("front", "rear"), rng.normal(0.0, 0.1, 2), strict=True))
        at = int(rng.integers(drives // 4, drives - drives // 4)) if number in faulty else None
        axle, loss = rng.choice(["front", "rear"]), float(rng.uniform(0.2, 0.45))
        known.append(Vehicle(name, at, "" if at is None else f"{axle} dampers -{100 * loss:.0f} %"))
        for k in range(drives):
            day = date(2026, 1, 5) + timedelta(days=7 * k)
            share = {a: 1.0 - min(max(-0.3, v), 0.3) for a, v in own.items()}
            if at is not None and k >= at:
                share[axle] *= 1.0 - loss
            truth = twin
            for a, factor in share.items():
                for part in ("damper_push", "damper_pull"):
                    curve = getattr(getattr(twin.vehicle, a), part)
                    scaled = {"velocity": list(curve.velocity), "force": [factor * f for f in curve.force]}
                    truth = truth.with_changes({f"vehicle.{a}.{part}": scaled})
            load = {"id": "payload", "parameters": {"mass": float(rng.uniform(0.0, 75.0))}}
            truth = truth.with_changes({"effects": [load]})
            v = float(rng.uniform(4.5, 5.5))
            knots = [(0.0, v - 0.5), (0.5 * seconds, v + 0.5), (seconds, v)]
            stamp = SensorErrors(start=1_767_600_000.0 + 7 * 86_400.0 * k)
            own_seed, place = int(rng.integers(1 << 31)), folder / "drives" / f"{name}_{k:02d}"
            if not place.exists():  # made by an earlier sitting; what is there is whole
                write_drive(synthetic_drive(truth, road, knots, own_seed, stamp, name=name), place)
            rows.append(f"{name},{day},twin.yaml,drives/{name}_{k:02d}")
    manifest = folder / "fleet.csv"
    manifest.write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "truth.json").write_text(json.dumps([vars(v) for v in known]), encoding="utf-8")
    return manifest, known


# -- the bare function ------------------------------------------------------------------------------


def bare(manifest: Path, processes: int) -> float:
    """Drives a second that so many processes calibrate without Dask, each on its own drives."""
    code = (
        "import sys, time\n"
        "from suspension_twin.addons.fleet.manifest import read_manifest\n"
        "from suspension_twin.addons.fleet.work import Options, plan_task, work\n"
        f"number, many, count = int(sys.argv[2]), {processes}, {BARE}\n"
        "items = read_manifest(sys.argv[1])[number::many]\n"
        "tasks = [plan_task(i, Options('calibrate')) for i in (items * (count + 2))[:count + 2]]\n"
        "work(tasks.pop()), work(tasks.pop())\n"
        "print('ready', flush=True)\n"
        "sys.stdin.readline()\n"
        "began = time.monotonic()\n"
        "for task in tasks:\n"
        "    assert work(task)['status'] == 'done'\n"
        "print(time.monotonic() - began, flush=True)\n"
    )
    children = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(manifest), str(number)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | ENVIRONMENT,
        )
        for number in range(processes)
    ]
    for child in children:
        assert child.stdout is not None and child.stdout.readline() == "ready\n"
    for child in children:
        assert child.stdin is not None
        child.stdin.write("go\n")
        child.stdin.flush()
    rates = []
    for child in children:
        out, _ = child.communicate(timeout=LONGEST)
        rates.append(BARE / float(out))
    return sum(rates)


# -- the run ----------------------------------------------------------------------------------------


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


class Programs:
    """Scheduler and workers as programs of their own, started again when they end."""

    def __init__(self, workers: int, folder: Path) -> None:
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self._port = self.address.rpartition(":")[2]
        self._workers, self._folder = workers, folder
        self.scheduler = self._start_scheduler()
        self.workers = self._start_workers()

    def _start(self, what: str, *words: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{what}.log").open("ab") as log:
            return subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "distributed.cli.dask_spec" if what == "spec" else "dask",
                    what,
                    *words,
                ],
                stdout=log,
                stderr=log,
                env=os.environ | ENVIRONMENT,
                cwd=self._folder,
            )

    def _start_scheduler(self) -> subprocess.Popen[bytes]:
        words = ("--host", "127.0.0.1", "--port", self._port)
        return self._start("scheduler", *words, "--no-dashboard", "--dashboard-address", "127.0.0.1:0")

    def _start_workers(self) -> subprocess.Popen[bytes]:
        count = str(self._workers)
        words = ["--nworkers", count, "--nthreads", "1", "--no-dashboard", "--memory-limit", "0"]
        here = ("--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0")
        return self._start("worker", self.address, *words, *here)

    def kill_scheduler(self) -> None:
        """SIGKILL."""
        self.scheduler.kill()
        self.scheduler.wait()

    def look_after(self) -> None:
        """Start again what has ended."""
        if self.scheduler.poll() is not None:
            self.scheduler = self._start_scheduler()
        if self.workers.poll() is not None:
            self.workers = self._start_workers()

    def close(self) -> None:
        """End all."""
        for process in (self.workers, self.scheduler):
            with suppress(psutil.NoSuchProcess):
                for child in psutil.Process(process.pid).children(recursive=True):
                    with suppress(psutil.NoSuchProcess):
                        child.kill()
            process.kill()
            process.wait()


@contextmanager
def programs(workers: int, folder: Path, wanted: bool) -> Iterator[Programs | None]:
    """Scheduler and workers, where they are wanted."""
    if not wanted:
        yield None
        return
    made = Programs(workers, folder)
    try:
        yield made
    finally:
        made.close()


def worker_processes(parent: int) -> list[psutil.Process]:
    """Dask's worker processes below a process."""
    found = []
    with suppress(psutil.Error):
        for child in psutil.Process(parent).children(recursive=True):
            with suppress(psutil.Error):
                if "spawn_main" in " ".join(child.cmdline()):
                    found.append(child)
    return found


def run(
    manifest: Path,
    out: Path,
    workers: int,
    kill_every: float = 0.0,
    restart: bool = False,
    say: Callable[[str], None] = print,
    budget: float = LONGEST,
) -> dict[str, Any]:
    """``fleet calibrate`` over the manifest for up to ``budget`` s; figures of the run."""
    total = manifest.read_text(encoding="utf-8").count("\n") - 1
    command = [
        sys.executable,
        "-m",
        "suspension_twin",
        "fleet",
        "calibrate",
        str(manifest),
        "--out",
        str(out),
    ]
    kills, restarted, chance = 0, 0, random.Random(0)
    earlier = set((out / "items").glob("*/*/record.json"))
    with programs(workers, manifest.parent, restart) as apart:
        command += ["--scheduler", apart.address] if apart else ["--workers", str(workers)]
        if apart:
            time.sleep(8.0)  # until the workers are there
        began = time.monotonic()
        with (manifest.parent / "command.log").open("ab") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | ENVIRONMENT)
        next_kill = began + kill_every
        try:
            while process.poll() is None:
                time.sleep(0.5)
                now = time.monotonic()
                if now - began > budget:
                    say(f"ended after {budget:.0f} s")
                    process.send_signal(signal.SIGINT)
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(120.0)
                    break
                if kill_every and now >= next_kill:
                    alive = worker_processes(apart.workers.pid if apart else process.pid)
                    if alive:
                        with suppress(psutil.NoSuchProcess):
                            chance.choice(alive).send_signal(signal.SIGKILL)
                            kills += 1
                    next_kill = now + kill_every
                if apart:
                    there = len(list((out / "items").glob("*/*/record.json")))
                    if not restarted and len(earlier) < total // 2 <= there:
                        say(f"the scheduler is killed after {now - began:.0f} s")
                        apart.kill_scheduler()
                        restarted = 1
                        time.sleep(3.0)
                    apart.look_after()
        finally:
            if process.poll() is None:
                process.kill()
        took = time.monotonic() - began
    records = set((out / "items").glob("*/*/record.json"))
    times = {p.parent.name: p.stat().st_mtime for p in records - earlier}
    if not times:
        raise SystemExit(
            (manifest.parent / "command.log").read_text(encoding="utf-8").strip().rpartition("\n")[2]
        )
    rows = [json.loads(p.read_text(encoding="utf-8")) for p in records - earlier]
    done = [r for r in rows if r["status"] == "done"]
    first, last = min(times.values()), max(times.values())
    # Of what ended in between, the part that lies in between.
    inside = sum(min(r["seconds"], times[r["key"]] - first) for r in done)
    steady = (len(times) - 1) / (last - first)
    return {
        "workers": workers,
        "exit_status": process.returncode,
        "seconds": round(took, 1),
        "drives": len(done),
        "open": total - len(records),
        "failed": len(rows) - len(done),
        "kills": kills,
        "scheduler_restarts": restarted,
        "drives_per_s": round(len(done) / took, 3),
        "drives_per_s_first_to_last": round(steady, 3),
        "in_the_function": round(inside / workers / (last - first), 3),
        "peak_memory_mib": round(max((r["peak_memory"] or 0) for r in done) / (1 << 20)) if done else None,
    }


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a Parquet file."""
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    return rows


def judge(out: Path, known: Sequence[Vehicle]) -> dict[str, Any]:
    """Which faults were found, by how many drives their dates are off, and what was named that is none."""
    found: dict[str, dict[str, Any]] = {}
    dates: dict[str, list[str]] = {}
    for row in read(out / "results.parquet"):
        dates.setdefault(row["vehicle"], []).append(row["date"])
    for row in read(out / "changes.parquet"):
        best = found.get(row["vehicle"])
        if row["probability"] >= 0.95 and (best is None or row["probability"] > best["probability"]):
            found[row["vehicle"]] = row
    errors, lines = [], []
    for v in known:
        named = found.get(v.name)
        if v.fault_at is not None:
            text = f"{v.name}: {v.fault} from drive {v.fault_at}: "
            if named is None:
                lines.append(text + "not found")
                continue
            at = sorted(dates[v.name]).index(named["date"])
            errors.append(abs(at - v.fault_at))
            lines.append(
                f"{text}{named['quantity']} {100 * (named['ratio'] - 1):+.0f} % from drive {at}, "
                f"p {named['probability']:.3f}"
            )
        elif named is not None:
            lines.append(
                f"{v.name}: sound, but {named['quantity']} {100 * (named['ratio'] - 1):+.0f} % is named"
            )
    faulty = sum(v.fault_at is not None for v in known)
    return {
        "faults": faulty,
        "found": len(errors),
        "largest_date_error_drives": max(errors, default=None),
        "date_errors_drives": errors,
        "sound": len(known) - faulty,
        "false": sum(v.fault_at is None and v.name in found for v in known),
        "lines": lines,
    }


# -- the command ------------------------------------------------------------------------------------


def together(sittings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures of all sittings of a run: sums, and rates weighted by their time."""
    seconds = sum(s["seconds"] for s in sittings)
    steady = sum(s["drives"] / s["drives_per_s_first_to_last"] for s in sittings)
    bare_drives = sum(sum(s["bare_per_s"]) / 2.0 * s["seconds"] for s in sittings)
    drives = sum(s["drives"] for s in sittings)
    summed = ("drives", "failed", "kills", "scheduler_restarts")
    return {
        "workers": sittings[-1]["workers"],
        "sittings": len(sittings),
        "exit_status": sittings[-1]["exit_status"],
        "open": sittings[-1]["open"],
        "seconds": round(seconds, 1),
        **{key: sum(s[key] for s in sittings) for key in summed},
        "drives_per_s": round(drives / seconds, 3),
        "drives_per_s_first_to_last": round(drives / steady, 3),
        "in_the_function": round(sum(s["in_the_function"] * s["seconds"] for s in sittings) / seconds, 3),
        "peak_memory_mib": max(s["peak_memory_mib"] or 0 for s in sittings),
        "bare_per_s": round(bare_drives / seconds, 3),
        "share_of_bare": round(drives / bare_drives, 3),
        "share_of_bare_first_to_last": round(drives / steady / (bare_drives / seconds), 3),
        "load": max(s["load"] for s in sittings),
    }


def _told(row: dict[str, Any]) -> str:
    """A run in words."""
    return (
        f"{row['workers']} workers: {row['drives']} drives in {row['seconds']} s and {row['sittings']} sittings, "
        f"{row['open']} open, {row['failed']} failed, {row['kills']} workers killed, scheduler restarted "
        f"{row['scheduler_restarts']} times\n"
        f"drives a second: {row['drives_per_s']}, from the first result to the last "
        f"{row['drives_per_s_first_to_last']}; bare function {row['bare_per_s']}: "
        f"{row['share_of_bare']:.2f} and {row['share_of_bare_first_to_last']:.2f} of it\n"
        f"share of the workers' time in the function, first result to last: {row['in_the_function']:.2f}; "
        f"largest memory of a worker {row['peak_memory_mib']} MiB; load of the machine up to {row['load']}"
    )


def _verdict(row: dict[str, Any]) -> str:
    """What was found, in words."""
    off = row["largest_date_error_drives"]
    dates = "" if off is None else f", dates off by at most {off} drives"
    return (
        f"{row['found']} of {row['faults']} faults found{dates}; {row['false']} of {row['sound']} sound vehicles "
        "named"
    )


def main() -> None:
    """Make the fleet, run it, print what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", type=int, default=10)
    parser.add_argument("--faults", type=int, default=2, help="vehicles that get a fault")
    parser.add_argument("--drives", type=int, default=200, help="drives of all vehicles together")
    parser.add_argument("--seconds", type=float, default=30.0, help="s of every drive")
    parser.add_argument("--workers", type=int, nargs="+", default=[len(os.sched_getaffinity(0))])
    parser.add_argument(
        "--kill-every", type=float, default=0.0, metavar="S", help="s; 0: no worker is killed"
    )
    parser.add_argument("--restart-scheduler", action="store_true")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="make drives and results here and keep them")
    parser.add_argument("--resume", action="store_true", help="go on with the results that are there")
    parser.add_argument("--budget", type=float, default=LONGEST, metavar="S", help="s of a run at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="figures as one JSON object")
    options = parse_options(parser, vehicles=1, faults=0, drives=4, seconds=10.0, workers=[1])

    def say(text: str) -> None:
        if not options.json:
            print(text, flush=True)

    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "truth.json").is_file():
            manifest = folder / "fleet.csv"
            known = [Vehicle(**v) for v in json.loads((folder / "truth.json").read_text(encoding="utf-8"))]
        else:
            each = max(4, options.drives // options.vehicles)
            say(f"makes {options.vehicles} times {each} drives of {options.seconds:g} s")
            manifest, known = make_fleet(
                folder, options.vehicles, options.faults, each, options.seconds, options.seed
            )
        found: dict[str, Any] = {"cores": os.cpu_count(), "load": os.getloadavg()[0], "runs": []}
        for workers in options.workers:
            # sittings may have different numbers of workers
            own = "" if options.resume else f"_{workers}"
            out, log = folder / f"results{own}", folder / f"sittings{own}.json"
            if not options.resume:
                shutil.rmtree(out, ignore_errors=True)
                log.unlink(missing_ok=True)
            sittings = json.loads(log.read_text(encoding="utf-8")) if log.is_file() else []
            before = bare(manifest, workers)
            row = run(
                manifest, out, workers, options.kill_every, options.restart_scheduler, say, options.budget
            )
            row["bare_per_s"] = [round(r, 3) for r in (before, bare(manifest, workers))]
            row["load"] = round(os.getloadavg()[0], 1)
            log.write_text(json.dumps([*sittings, row], indent=1), encoding="utf-8")
            whole = together([*sittings, row])
            found["runs"].append(whole)
            say(_told(whole))
            if whole["open"]:
                say(f"{whole['open']} drives are not done: the same command with --resume goes on")
                continue
            whole |= judge(out, known)
            say("\n".join(f"  {line}" for line in whole["lines"]))
            say(_verdict(whole))
        if options.json:
            print(json.dumps(found))


if __name__ == "__main__":
    main()
