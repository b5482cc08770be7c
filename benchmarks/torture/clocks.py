# SPDX-License-Identifier: Apache-2.0
"""The running twin when stamps, ``/clock`` or a replay stop, jump, run and repeat themselves."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from torture.ledger import Tally
from torture.watch import BAG, Broken, Twin, stamped, watched

__all__ = ["BARS", "clock", "loop", "stamps"]

BARS = {
    "time": "resets and says so where time goes back by over 1 s, an answer within 1 s on the new time, memory flat",
    "clock": "the same with use_sim_time, and says that /clock stands still",
    "loop": "every round of a looped recording gives the same bits, memory flat within 5 MiB",
}
_IMU = "/imu/data_raw"
_TOLD = 4.0  # s within which a node has told of a reset, its diagnostics coming every second
_GROWTH = 5.0  # MiB

Act = Callable[[Twin], None]


def _jump(seconds: float) -> Act:
    def act(twin: Twin) -> None:
        twin.time += int(seconds * 1e9)

    return act


def _stop(twin: Twin) -> None:
    data = stamped(twin.samples[_IMU][0], twin.time)
    for _ in range(200):
        twin.send(_IMU, data)
        twin.listen(0.001)


def _two(twin: Twin) -> None:
    """A second publisher, 3 ms behind the first."""
    for k, data in enumerate(twin.samples[_IMU][:200]):
        twin.send(_IMU, stamped(data, twin.time + k * 10_000_000))
        twin.send(_IMU, stamped(data, twin.time + k * 10_000_000 - 3_000_000))
        twin.listen(0.002)
    twin.time += 200 * 10_000_000


def _loops(twin: Twin) -> None:
    start = twin.time
    for _ in range(20):
        twin.time = start
        twin.drive(1.5, speed=100.0)
    twin.time = start


def _fast(twin: Twin) -> None:
    twin.drive(20.0, speed=100.0)


def _disorder(twin: Twin) -> None:
    for k in np.random.default_rng(0).permutation(100):
        twin.send(_IMU, stamped(twin.samples[_IMU][int(k)], twin.time + int(k) * 10_000_000))
    twin.time += 100 * 10_000_000


#: What happens, s by which the answer may be later for it, and whether the nodes have to reset. Stamps that go back by
#: a second or less are late samples, which are dropped until time has caught up.
_STAMPS: dict[str, tuple[Act, float, bool]] = {
    "an hour forward": (_jump(3600.0), 0.0, False),
    "an hour back": (_jump(-3600.0), 0.0, True),
    "NTP step forward": (_jump(0.5), 0.0, False),
    "NTP step back": (_jump(-0.5), 0.5, False),
    "leap second": (_jump(-1.0), 1.0, False),
    "a day back": (_jump(-86_400.0), 0.0, True),
    "stamps stand still": (_stop, 0.0, False),
    "two publishers": (_two, 0.0, False),
    "100 times as fast": (_fast, 2.0, False),  # what has waited less than `max_backlog` is worked off first
    "looped": (_loops, 0.0, True),
    "out of order": (_disorder, 0.0, False),
}


def _clock_stops(twin: Twin) -> None:
    """Messages go on, the clock does not."""
    twin.levels.clear()
    twin.ticking = False
    twin.drive(6.0)
    twin.ticking = True
    if not any("/clock has not advanced" in text for text in twin.levels):
        raise Broken("/clock stops", "does not say that /clock stands still")


def _clock_flickers(twin: Twin) -> None:
    """Two clocks that differ by 0.4 s."""
    for _ in range(100):
        for shift in (0, -400_000_000):
            twin.tick(twin.time + shift)
        twin.listen(0.002)


def _clock_is_zero(twin: Twin) -> None:
    for _ in range(20):
        twin.tick(0)
        twin.listen(0.01)


_CLOCK: dict[str, tuple[Act, float, bool]] = {
    "/clock stops": (_clock_stops, 0.0, False),
    "/clock and stamps jump a minute back": (_jump(-60.0), 0.0, True),
    "/clock and stamps jump an hour ahead": (_jump(3600.0), 0.0, False),
    "/clock runs 100 times": (_fast, 2.0, False),
    "/clock is published twice": (_clock_flickers, 0.0, False),
    "/clock is zero for a while": (_clock_is_zero, 0.0, False),
    "/clock loops": (_loops, 0.0, True),
}


def _trials(tally: Tally, kinds: dict[str, tuple[Act, float, bool]], simulated: bool) -> None:
    def trial(twin: Twin, rng: np.random.Generator, number: int) -> tuple[str, float]:
        name = list(kinds)[number % len(kinds)]
        act, more, resets = kinds[name]
        twin.drive(float(rng.uniform(0.2, 1.0)))
        before = sum(twin.resets.values())
        act(twin)
        if resets:
            twin.drive(0.2)  # messages on the new time, which is when a node sees it
            until = time.monotonic() + _TOLD
            while sum(twin.resets.values()) == before and time.monotonic() < until:
                twin.drive(0.2)
            if sum(twin.resets.values()) == before:
                raise Broken(name, "no node says that it was reset")
        return name, more

    watched(tally, trial, clock=simulated)


def stamps(tally: Tally) -> None:
    """One thing that the stamps of sensors do, a trial."""
    _trials(tally, _STAMPS, simulated=False)


def clock(tally: Tally) -> None:
    """One thing that a simulated clock does, a trial."""
    _trials(tally, _CLOCK, simulated=True)


def loop(tally: Tally) -> None:
    """Rounds of a recording replayed at full speed; a trial is a round."""
    twin = Twin(arguments=("--bag", str(BAG), "--loop", "--rate", "max"), answers_alone=True)
    rounds: list[dict[int, float]] = [{}]
    newest, settled = 0, 0.0

    def heard(message: object, _published: float) -> None:
        nonlocal newest
        stamp = message.header.stamp  # type: ignore[attr-defined]
        ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        if ns < newest:
            rounds.append({})
        newest = ns
        rounds[-1][ns] = message.accel.linear.z  # type: ignore[attr-defined]

    try:
        twin.hear_answers(heard)
        until = time.monotonic() + 300.0
        while len(rounds) < 4 and time.monotonic() < until and twin.process.poll() is None:
            twin.take(0.1)
        if len(rounds) < 4:
            tally.fail(f"no second round within 300 s: {twin.problem()}")
            return
        first = rounds[1]  # the one before may have begun unheard
        tally.measure("answers a round", len(first))
        for number in tally.numbers():
            while len(rounds) < 4 and twin.process.poll() is None:
                twin.take(0.1)
            tally.count("rounds")
            if problem := twin.problem():
                tally.fail(problem)
                return
            del rounds[0]
            whole = rounds[1]
            other = [ns for ns in first.keys() & whole.keys() if first[ns] != whole[ns]]
            if other:
                tally.fail(f"{len(other)} of {len(first)} answers are not those of the first round")
            tally.measure("answers lost in a round", len(first.keys() - whole.keys()))
            settled = settled or twin.memory()
            grown = twin.memory() - settled
            tally.measure("memory grown, MiB", grown)
            if grown > _GROWTH:
                tally.fail(f"memory has grown by {grown:.1f} MiB after round {number}")
                settled = twin.memory()
    finally:
        twin.close()
