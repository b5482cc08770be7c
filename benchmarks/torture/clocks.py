# SPDX-License-Identifier: Apache-2.0
"""The running twin when stamps, ``/clock`` or a replay stop, jump, run and repeat themselves."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pymap3d import enu2geodetic
from scipy.spatial.transform import Rotation

from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.drive.write import write_drive
from suspension_twin.vehicle.twin import load_twin
from torture.ledger import Tally
from torture.watch import BAG, Broken, Twin, stamped, watched

__all__ = ["BARS", "clock", "day", "loop", "stamps"]

BARS = {
    "time": "resets and says so where time goes back by over 1 s, an answer within 1 s on the new time, memory flat",
    "clock": "the same with use_sim_time, and says that /clock stands still",
    "day": "no answer lost in a drive of 24 hours, memory flat within 5 MiB after its first hour",
    "loop": "every round of a looped recording gives the same bits, memory flat within 5 MiB",
}
_IMU = "/imu/data_raw"
_TOLD = 4.0  # s within which a node has told of a reset, its diagnostics coming every second
_GROWTH = 5.0  # MiB
_HOUR, _DAY_RATE = 3600.0, 50  # s, Hz
#: s that an hour of a drive takes at full speed on a slow machine: with less time a shorter drive is replayed.
_EACH_HOUR = 300.0

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


def day(tally: Tally) -> None:
    """A drive of 24 hours at 50 Hz, or of what there is time for, at full speed; a trial is an hour of it, or all."""
    hours = float(np.clip(tally.left() / _EACH_HOUR, 0.1, 24.0))
    hours = hours if hours < 1.0 else float(int(hours))
    with tempfile.TemporaryDirectory() as folder:
        write_drive(_circles(hours * _HOUR), Path(folder) / "day")
        _replay_day(tally, Path(folder) / "day", hours)


def _replay_day(tally: Tally, bag: Path, hours: float) -> None:
    twin = Twin(arguments=("--bag", str(bag), "--rate", "max"), answers_alone=True)
    first = last = answers = 0

    def heard(message: object, _published: float) -> None:
        nonlocal first, last, answers
        stamp = message.header.stamp  # type: ignore[attr-defined]
        last = stamp.sec * 1_000_000_000 + stamp.nanosec
        first, answers = first or last, answers + 1

    try:
        twin.hear_answers(heard)
        settled = 0.0
        for hour, _ in enumerate(tally.numbers(), 1):
            end = min(hour * _HOUR, hours * _HOUR - 60.0)  # the first answers want a heading
            while last - first < end * 1e9:
                if problem := twin.problem():
                    tally.fail(problem)
                    return
                twin.take(0.1)
            tally.measure("hours of one drive", min(hour, hours))
            lost = 1.0 - answers / (1 + round((last - first) / 1e9 * _DAY_RATE))
            tally.measure("answers lost, %", 100.0 * lost)
            if lost > 0.0:
                tally.fail(f"{100.0 * lost:.3f} % of the answers were lost until hour {hour}")
            settled = settled or twin.memory()
            tally.measure("memory grown, MiB", twin.memory() - settled)
            if twin.memory() - settled > _GROWTH:
                tally.fail(f"memory has grown by {twin.memory() - settled:.1f} MiB after hour {hour}")
                settled = twin.memory()
            if hour >= hours:
                tally.deadline = 0.0  # that was the last
    finally:
        twin.close()


def _circles(seconds: float) -> Drive:
    """What sensors record on a circle of 50 m at 8 m/s, for so long: shaken by noise, fixes twice a second."""
    twin = load_twin(BAG / "twin.yaml")
    assert twin.datum is not None
    rng = np.random.default_rng(0)
    start, speed, radius = float(int(time.time() - seconds)), 8.0, 50.0
    turn = speed / radius
    t = np.arange(int(seconds * _DAY_RATE)) / _DAY_RATE
    force = np.tile([0.0, speed * turn, 9.81], (t.size, 1)) + rng.normal(0.0, 0.3, (t.size, 3))
    rate = np.tile([0.0, 0.0, turn], (t.size, 1)) + rng.normal(0.0, 0.01, (t.size, 3))
    mount = Rotation.from_euler("xyz", twin.imu.rpy).as_matrix()
    imu = ImuData(start + t, force @ mount, rate @ mount, frame=twin.imu.frame)
    at = t[:: round(_DAY_RATE / 2)]
    east, north = radius * np.sin(turn * at), radius * (1.0 - np.cos(turn * at))
    datum = twin.datum
    latitude, longitude, altitude = enu2geodetic(
        east, north, np.zeros(at.size), datum.latitude, datum.longitude, datum.altitude
    )
    fix = FixData(
        start + at,
        latitude,
        longitude,
        altitude,
        np.zeros(at.size, np.int8),
        np.full((at.size, 3), 0.02),
        "gps_link",
    )
    enu = speed * np.stack([np.cos(turn * at), np.sin(turn * at), np.zeros(at.size)], axis=1)
    return Drive("day", imu, fix, VelocityData(start + at, enu))
