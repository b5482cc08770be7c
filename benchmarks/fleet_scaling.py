# SPDX-License-Identifier: Apache-2.0
"""Throughput of a fleet's scheduling against the number of workers, up to hundreds, on one machine.

The scheduler is Dask's in a process of its own, as an operator runs it; this process is the command, with its own loop
and ledger; workers are hundreds in a few processes, each of which sleeps ``--length`` s a task and hands back a record
of true size. So every result takes its real way, and only the calibration is missing. Each part's time of a core is
measured: what is full first on machines with a core for each worker is the part with the most time a result, and it is
full at so many results a second as that time goes into a second.

``--plot FILE`` draws it; ``--from FILE`` draws the figures that ``--json`` printed before.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
from fleet import ENVIRONMENT, bare, free_port, make_fleet
from options import parse_options

#: Workers that share a process: their event loops cost one core together.
EACH = 50
#: Tasks for each worker, of which the first three fill it.
ROUNDS = 7
#: s for all workers to be there.
ARRIVAL = 120.0


def hold_workers(address: str, count: int, length: float, record_file: str) -> None:
    """Workers that sleep, until the scheduler is gone."""
    from unittest.mock import patch

    from distributed import Worker

    record = json.loads(Path(record_file).read_text(encoding="utf-8"))

    def asleep(task: Any) -> dict[str, Any]:
        time.sleep(length)
        return {**record, "key": task.key}

    here: dict[str, Any] = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "dashboard": False}
    kinds = {"nthreads": 1, "memory_limit": 0, **here}

    async def hold() -> None:
        workers = [Worker(address, **kinds) for _ in range(count)]
        await asyncio.gather(*workers)
        await asyncio.gather(*(w.finished() for w in workers))

    with patch("suspension_twin.addons.fleet.engine.work", asleep):
        asyncio.run(hold())


@contextmanager
def cluster(workers: int, length: float, folder: Path) -> Iterator[tuple[Any, dict[str, Any]]]:
    """A client of a scheduler with so many workers, and the processes by what they are."""
    import distributed

    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    environment = os.environ | ENVIRONMENT | {"DASK_DISTRIBUTED__SCHEDULER__WORK_STEALING": "False"}
    with (folder / "dask.log").open("ab") as log:

        def start(*words: str) -> subprocess.Popen[bytes]:
            return subprocess.Popen(
                [sys.executable, *words], stdout=log, stderr=log, env=environment, cwd=folder
            )

        words = ["-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", str(port)]
        words += ["--no-dashboard", "--dashboard-address", "127.0.0.1:0"]
        scheduler = start(*words)
        holders = [
            start(
                str(Path(__file__).resolve()),
                *("--hold", address, str(min(EACH, workers - first)), str(length)),
                str(folder / "record.json"),
            )
            for first in range(0, workers, EACH)
        ]
        try:
            client = distributed.Client(address, timeout=60, set_as_default=False)
            try:
                client.wait_for_workers(workers, timeout=ARRIVAL)
                yield client, {"scheduler": [scheduler], "workers": holders}
            finally:
                with suppress(Exception):
                    client.close(timeout=5)
        finally:
            for process in (*holders, scheduler):
                process.kill()
                process.wait()


def cores(processes: Sequence[Any]) -> float:
    """s of a core that processes have used."""
    times = [psutil.Process(p.pid).cpu_times() for p in processes]
    return float(sum(t.user + t.system for t in times))


def measured(manifest: Path, counts: Sequence[int], length: float) -> Iterator[dict[str, Any]]:
    """A row for each number of workers."""
    from suspension_twin.addons.fleet.engine import Cluster, FleetPlan, run_fleet
    from suspension_twin.addons.fleet.manifest import read_manifest
    from suspension_twin.addons.fleet.results import Ledger
    from suspension_twin.addons.fleet.work import Options, plan_task, work

    items = read_manifest(manifest)
    base = plan_task(items[0], Options("calibrate"))
    record = work(base)
    assert record["status"] == "done", record["message"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "record.json").write_text(json.dumps(record), encoding="utf-8")
        for workers in counts:
            count = ROUNDS * workers
            tasks = tuple(replace(base, key=f"{k % 256:02x}{workers:04d}{k:08d}") for k in range(count))
            plan = FleetPlan(tuple(items[:1] * count), tasks, {})
            with cluster(workers, length, folder) as (client, processes):
                took = {part: cores(found) for part, found in processes.items()}
                own, began = time.process_time(), time.monotonic()
                ledger = Ledger(folder / f"results_{workers}")
                outcome = run_fleet(plan, ledger, Cluster(client, ""))
                seconds = time.monotonic() - began
                spent = {p: (cores(found) - took[p]) / count for p, found in processes.items()}
                spent["command"] = (time.process_time() - own) / count
                assert outcome.computed == count, outcome.lost
            yield {
                "workers": workers,
                "results": count,
                "length_s": length,
                "ideal_per_s": workers / length,
                "results_per_s": round(count / seconds, 3),
                "efficiency": round(count / seconds * length / workers, 3),
                "core_ms_a_result": {part: round(1e3 * s, 2) for part, s in spent.items()},
                "load": round(os.getloadavg()[0], 1),
                "record_bytes": len(json.dumps(record)),
            }


def limits(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Results a second at which each part of one core is full, from the row with the most workers."""
    last = max(rows, key=lambda row: (row["workers"], -row["length_s"]))
    parts = last["core_ms_a_result"]
    return {part: 1e3 / parts[part] for part in ("scheduler", "command")}


def draw(found: dict[str, Any], path: Path) -> None:
    """Throughput against workers, with where each part is full."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    for k, length in enumerate(sorted({row["length_s"] for row in found["rows"]})):
        rows = [row for row in found["rows"] if row["length_s"] == length]
        x = [row["workers"] for row in rows]
        axes.plot(
            x,
            [row["results_per_s"] for row in rows],
            "o-",
            color=f"C{k}",
            label=f"measured, {length:g} s a result",
        )
        axes.plot(x, [row["ideal_per_s"] for row in rows], ":", color=f"C{k}", label="workers / length")
    for k, (part, rate) in enumerate(limits(found["rows"]).items()):
        axes.axhline(
            rate, color=f"C{7 + k}", linewidth=1.0, linestyle="--", label=f"{part}: one core is full"
        )
    axes.set(xscale="log", yscale="log", xlabel="workers", ylabel="results a second")
    counts = sorted({row["workers"] for row in found["rows"]})
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.yaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    fig.savefig(path, dpi=130)


def told(found: dict[str, Any]) -> str:
    """The figures in words."""
    words = ("s", 5), ("workers", 8), ("ideal/s", 9), ("results/s", 10), ("share", 6), ("scheduler", 10)
    head = "".join(f"{word:>{width}}" for word, width in (*words, ("command", 8), ("worker", 7)))
    lines = [f"{head}   (the last three: ms of a core a result)"]
    for row in found["rows"]:
        spent = row["core_ms_a_result"]
        lines.append(
            f"{row['length_s']:5g}{row['workers']:8d}{row['ideal_per_s']:9.2f}{row['results_per_s']:10.2f}"
            f"{row['efficiency']:6.2f}{spent['scheduler']:10.1f}{spent['command']:8.1f}{spent['workers']:7.1f}"
        )
    full = limits(found["rows"])
    first = min(full, key=full.__getitem__)
    lines.append(
        f"One core is full in the scheduler at {full['scheduler']:.0f} results a second, in the command at "
        f"{full['command']:.0f}: the {first} is first, with {full[first] * 10:.0f} workers of 10 s a result"
    )
    return "\n".join(lines)


def main() -> int:
    """Measure, print, draw."""
    if "--hold" in sys.argv:
        address, count, seconds, record = sys.argv[2:6]
        hold_workers(address, int(count), float(seconds), record)
        return 0
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 5, 10, 20, 50, 100, 200])
    parser.add_argument(
        "--length", type=float, nargs="+", default=[2.0, 10.0], help="s of a task; 0: as the function"
    )
    parser.add_argument("--plot", type=Path, metavar="FILE")
    parser.add_argument("--from", dest="known", type=Path, metavar="FILE")
    parser.add_argument("--json", action="store_true", help="figures as one JSON object")
    options = parse_options(parser, workers=[1], length=[0.1])
    if options.known:
        found = json.loads(options.known.read_text(encoding="utf-8"))
    else:
        found = {"cores": os.cpu_count(), "rows": []}
        with tempfile.TemporaryDirectory() as name:
            manifest, _ = make_fleet(Path(name), 1, 0, 4, 30.0, 0)
            for given in options.length:
                length = given or 1.0 / bare(manifest, 1)
                found["rows"] += list(measured(manifest, options.workers, length))
    print(json.dumps(found) if options.json else told(found))
    if options.plot:
        draw(found, options.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
