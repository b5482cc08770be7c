# SPDX-License-Identifier: Apache-2.0
"""Time of the demo: the first one, which compiles everything, and the next.

    python benchmarks/demo.py [--json]

Both run as a user runs it, in an empty folder; the first with an empty cache of machine code. Beside the seconds stands
their ratio to a fixed piece of work in the same run, because absolute times of shared machines mean little.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time

import numpy as np
from options import parse_options


def timed(cache: str, folder: str) -> dict[str, float]:
    """Wall and processor seconds of one demo."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "suspension_twin", "demo", "--force"]
    subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "NUMBA_CACHE_DIR": cache},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": time.perf_counter() - began, "cpu_s": used}


def work() -> float:
    """Processor seconds of a fixed piece of work: products of matrices on one core or several."""
    matrix, began = np.random.default_rng(0).normal(size=(900, 900)), time.process_time()
    for _ in range(20):
        matrix = matrix @ matrix
        matrix /= np.abs(matrix).max()
    return time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=2, help="the first compiles")
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser, runs=1)
    unit = work()
    with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as folder:
        runs = [timed(cache, folder) for _ in range(options.runs)]
    if options.json:
        print(json.dumps({"work_s": unit, "runs": runs}))
        return
    print(f"{'demo':12} {'wall, s':>8} {'processor, s':>13} {'over the fixed work':>20}")
    for number, run in enumerate(runs):
        name = "the next" if number else "the first"
        print(f"{name:12} {run['wall_s']:8.0f} {run['cpu_s']:13.0f} {run['cpu_s'] / unit:20.1f}")


if __name__ == "__main__":
    main()
