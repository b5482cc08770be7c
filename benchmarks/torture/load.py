# SPDX-License-Identifier: Apache-2.0
"""The running twin at 1 kHz, beside a calibration on the same cores, and beside many of its kind."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from pathlib import Path

from torture.commands import PROGRAM, ROOT, environment
from torture.ledger import Tally
from torture.watch import Twin, running, stamped

__all__ = ["BAR", "torture"]

BAR = "no loss at 1 kHz and with many twins where the machine allows, else said; memory flat within 5 MiB"
_RATE, _SECONDS = 1000, 10.0  # Hz, s of a trial
#: s of a trial that are not judged: after a pause and at another rate filters start, and the recorded drive begins
#: anew, to which the pose jumps after a second of refused fixes.
_WARM = 2.0
_GROWTH = 5.0  # MiB
#: Twins for each core, at 100 Hz each, fifty at most; MiB of memory that each needs.
_EACH_CORE, _MOST, _NEEDS = 4, 50, 700.0
#: Share of the time that a twin waits for the processor from which on a loss is the machine's.
_STARVED = 0.1


def _free() -> float:
    """MiB."""
    found = re.search(r"MemAvailable:\s*(\d+)", Path("/proc/meminfo").read_text(encoding="ascii"))
    return int(found[1]) / 1024 if found else 0.0


def _pushed(twins: list[Twin], rate: int, seconds: float) -> tuple[list[dict[int, float]], float]:
    """Samples at ``rate`` Hz to each twin: stamp and time of sending, s since the epoch; how late the last was, s."""
    imu = twins[0].samples["/imu/data_raw"]
    step, each = 1_000_000_000 // rate, max(rate // 10, 1)
    base = max(twin.time for twin in twins)
    sent: list[dict[int, float]] = [{} for _ in twins]
    began = time.monotonic()
    taken = began
    for k in range(int(seconds * rate)):
        while (left := began + k / rate - time.monotonic()) > 0:
            for twin in twins:
                twin.take(left / len(twins))
            taken = time.monotonic()
        if time.monotonic() - taken > 0.1:  # late, but not deaf
            for twin in twins:
                twin.take(0.0)
            taken = time.monotonic()
        stamp = base + k * step
        for twin, mine in zip(twins, sent, strict=True):
            if k % each == 0:
                for name in ("/fix", "/vel"):
                    rows = twin.samples[name]
                    twin.send(name, stamped(rows[k // each % len(rows)], stamp))
            mine[stamp] = time.time()
            twin.send("/imu/data_raw", stamped(imu[k * 100 // rate % len(imu)], stamp))
    late = time.monotonic() - began - seconds
    until = time.monotonic() + 2.0
    while time.monotonic() < until:
        for twin in twins:
            twin.take(0.02)
    for twin in twins:
        twin.time = base + int((seconds + 2.0) * 1e9)
    return sent, late


def _judged(tally: Tally, twins: list[Twin], what: str, rate: int) -> None:
    """One trial: loss and delay of all twins together."""
    for twin in twins:
        twin.answered.clear()
        twin.values.clear()
    waited = [twin.starved() for twin in twins]
    began = time.monotonic()
    pushed, late = _pushed(twins, rate, _WARM + _SECONDS)
    sent = [{stamp: at for stamp, at in mine.items() if stamp >= min(mine) + 1e9 * _WARM} for mine in pushed]
    waits = max(twin.starved() - before for twin, before in zip(twins, waited, strict=True))
    starved = waits / (time.monotonic() - began)
    tally.count(what)
    for twin in twins:
        if problem := twin.problem():
            tally.fail(f"{what}: {problem}")
            return
    pairs = list(zip(twins, sent, strict=True))
    delays = sorted(t.answered[s] - at for t, mine in pairs for s, at in mine.items() if s in t.answered)
    if not delays:
        tally.fail(f"{what}: no answer; says: {'; '.join(dict.fromkeys(twins[0].levels[-5:]))[:200]}")
        return
    lost = 1.0 - len(delays) / sum(map(len, sent))
    tally.measure(f"lost {what}, %", 100 * lost)
    tally.measure(f"p99 {what}, ms", 1e3 * delays[int(0.99 * len(delays))])
    tally.measure(f"waits for the processor {what}, %", 100 * starved)
    if late > 0.2:
        tally.note(f"this machine could not send in time: {what}")
    if lost > 0.0 and starved > _STARVED:
        tally.note(f"too little of a processor is left: {what}")
        if not any("too slow" in text or "missing IMU samples" in text for t in twins for text in t.levels):
            tally.fail(f"{what}: {100 * lost:.1f} % were lost, and no node says so")
    elif lost > 0.0:
        tally.fail(f"{what}: {100 * lost:.2f} % were lost")


def _many(tally: Tally) -> None:
    """As many twins as the machine is to carry, each in its namespace and process, at 100 Hz."""
    number = int(min(_MOST, _EACH_CORE * (os.cpu_count() or 1), _free() / _NEEDS))
    if number < 2:
        tally.note("too little memory for more than one twin")
        return
    if number < _MOST:
        tally.note(
            f"{number} twins in place of {_MOST}: {_EACH_CORE} for each core, {_NEEDS:.0f} MiB for each"
        )
    twins: list[Twin] = []
    try:
        for k in range(number):
            twins.append(Twin(space=f"car{k}", answers_alone=True))
        for twin in twins:
            twin.wait()
        _pushed(twins, 100, 12.0)  # heading found
        _judged(tally, twins, f"{number} twins", 100)
    finally:
        for twin in twins:
            twin.close()


def torture(tally: Tally) -> None:
    """By turns: alone at 1 kHz, at 1 kHz beside a calibration, many twins at 100 Hz."""
    settled = 0.0
    # eight topics at 1 kHz are more than the watcher can take
    with running(tally, answers_alone=True) as twin, tempfile.TemporaryDirectory() as folder:
        for number in tally.numbers():
            turn = number % 3
            if turn == 2:
                _many(tally)
                continue
            beside = None
            if turn == 1:
                bag = ROOT / "bags" / "bump_15kmh"
                arguments = ["--twin", str(bag / "twin.yaml"), str(bag), "--out", f"{folder}/calibrated.yaml"]
                beside = subprocess.Popen(
                    [*PROGRAM, "calibrate", *arguments, "--force"],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    env=environment(),
                )
                twin.listen(5.0)
            try:
                _judged(tally, [twin], "at 1 kHz" + (" beside a calibration" if beside else ""), _RATE)
            finally:
                if beside is not None:
                    beside.kill()
                    beside.wait()
            if twin.process.poll() is not None:
                return
            settled = settled or twin.memory()
            grown = twin.memory() - settled
            tally.measure("memory grown, MiB", grown)
            if grown > _GROWTH:
                tally.fail(f"memory has grown by {grown:.1f} MiB")
                settled = twin.memory()
