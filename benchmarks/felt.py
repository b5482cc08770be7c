# SPDX-License-Identifier: Apache-2.0
"""Felt map matching: how well the place along a known road is known live from a phone's receiver, and what it costs.

    python benchmarks/felt.py [--seeds N] [--tries N] [--seconds S] [--json]

A car drives a road of ISO class C with a bump every hundred metres, and a flat road with such bumps; its receiver is a
phone's: fixes with a correlated error of 2.5 m and 60 s, once a second, 0.4 s late beyond their stamps, Doppler of
0.1 m/s. The twin knows the road. In other tries its road is another one of the same class, with bumps of its own: a
moment at which a place is believed is a false lock. The last part is the latency of the nodes at 100 Hz with and
without it, in turns.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import live
import numpy as np
from options import parse_options

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.inference.synthetic import SensorErrors, path_along, synthetic_drive
from suspension_twin.live.twin import DigitalTwin, digital_twin, replay
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road import half_sine
from suspension_twin.road.build import add_bump
from suspension_twin.road.crg import write_road
from suspension_twin.road.road import Road
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import Datum, Twin, load_twin, save_twin

ROOT = Path(__file__).resolve().parents[1]
#: Bars: m rms after the first bump, and within a bump's length behind each; ratio of the latencies' p99.
BARS = {"after_the_first_bump": 0.25, "behind_bumps": 0.15, "false_locks": 0, "p99_ratio": 1.1}
SPEEDS = (5.0, 8.0, 11.0, 14.0)
START, APART = 10.0, 100.0
#: s of a drive until the first bump, about.
FIRST = 14.0
BUMP = half_sine(0.9, 0.05)
BEGIN = 1_700_000_000.0


@dataclass(frozen=True)
class Receiver:
    """A phone's: correlated error m and s, lateness s, Doppler m/s, one fix a second."""

    sigma: float = 2.5
    time: float = 60.0
    late: float = 0.4
    doppler: float = 0.1

    def received(self, drive: Drive, datum: Datum, seed: int) -> Drive:
        """The drive with what this receiver makes of its exact fixes and velocities."""
        rng, fix, velocity, here = np.random.default_rng(seed), drive.fix, drive.velocity, LocalMap(datum)
        kept = np.flatnonzero(np.diff(np.floor(fix.t), prepend=-1.0) > 0)
        t, keep = fix.t[kept], math.exp(-1.0 / self.time)
        place = here.to_map(fix.latitude, fix.longitude, fix.altitude)
        place = np.column_stack([np.interp(t - self.late, fix.t, column) for column in place.T])
        error = self.sigma * rng.standard_normal(2)
        for row in place:
            row[:2] += error
            error = keep * error + self.sigma * math.sqrt(1.0 - keep**2) * rng.standard_normal(2)
        latitude, longitude, altitude = here.to_geodetic(place).T
        enu = np.column_stack([np.interp(t - self.late, velocity.t, column) for column in velocity.enu.T])
        enu[:, :2] += self.doppler * rng.standard_normal((t.size, 2))
        sigma = np.tile(self.sigma * np.array([1.0, 1.0, 1.5]), (t.size, 1))
        fixes = replace(
            fix,
            t=t,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            status=fix.status[kept],
            sigma=sigma,
        )
        return replace(drive, fix=fixes, velocity=replace(velocity, t=t, enu=enu))


@dataclass(frozen=True, eq=False)
class Case:
    """A drive as a phone recorded it, its true way (n,) m at ``t`` s, and the bumps' places m."""

    drive: Drive
    t: Floats
    way: Floats
    bumps: list[float]


def knots_of(speed: float, seconds: float) -> tuple[tuple[float, float], ...]:
    """Stand, drive off, brake to three quarters for a moment."""
    shape = (
        (0.0, 0.0),
        (2.0, 0.0),
        (min(9.0, 0.5 * seconds), 1.0),
        (0.6 * seconds, 1.0),
        (0.7 * seconds, 0.75),
        (0.8 * seconds, 1.0),
    )
    return tuple((t, v * speed) for t, v in (*shape, (seconds, 1.0)))


def road_of(kind: str, length: float, first: float, seed: int) -> tuple[Road, list[float]]:
    """The same profile under both wheels, 12 m wide, and bumps from ``first`` m on."""
    if kind == "flat":
        road = iso8608_road("A", length, width=12.0, v_step=6.0).with_heights(
            np.zeros((round(length / 0.05) + 1, 3))
        )
    else:
        road = iso8608_road(kind, length, width=12.0, v_step=6.0, seed=seed)
        road = road.with_heights(np.repeat(road.z[:, 1:2], road.z.shape[1], axis=1))
    rng = np.random.default_rng(seed)
    places = [at + float(rng.uniform(-15.0, 15.0)) for at in np.arange(first, length - 30.0, APART)]
    for at in places:
        road = add_bump(road, BUMP, at)
    return road, places


def case_of(twin: Twin, kind: str, seed: int, seconds: float) -> tuple[Case, Road]:
    """One drive and its road."""
    speed = SPEEDS[seed % len(SPEEDS)]
    road, bumps = road_of(kind, START + speed * seconds + 50.0, START + speed * (FIRST - 5.0), seed)
    knots = knots_of(speed, seconds)
    exact = synthetic_drive(twin, road, knots, seed, SensorErrors(position=1e-3, velocity=1e-3), u=START)
    assert twin.datum is not None
    t = np.arange(0.0, seconds, 0.01)
    return Case(
        Receiver().received(exact, twin.datum, seed), t, path_along(road, t, knots, START).x, bumps
    ), road


def on_road(twin: Twin, road: Road, folder: str) -> Twin:
    """The twin on a road."""
    file = Path(folder) / "road.crg"
    write_road(road, file)
    return twin.with_changes({"road": {"file": str(file)}})


def felt_along(case: Case, twin: DigitalTwin) -> Iterator[tuple[float, float, float, float, float, float]]:
    """Of every pose: s, true place m, how far ahead of it m the receiver's place is, the felt one and the one
    published, and the standard deviation m of the felt one, NaN where none is."""
    felt = twin.felt
    assert felt is not None
    twin.follower = None  # the pose alone is of interest
    for update in replay(case.drive, twin):
        twin.rest()
        pose = update.pose
        if pose is None or not pose.aligned:
            continue
        t = pose.t - BEGIN
        true = float(np.interp(t, case.t, case.way))
        receiver = pose.x - felt.offset  # straight on, to the east
        place = receiver - true + felt.ahead
        yield t, true, receiver - true, place, pose.x - true, felt.spread if felt.known else math.nan


def accuracy(twin: Twin, kind: str, seeds: int, seconds: float) -> dict[str, Any]:
    """Errors m of the place over all drives, after the first bump and within a bump's length behind each."""
    rows: list[Floats] = []
    for seed in range(seeds):
        case, road = case_of(twin, kind, seed, seconds)
        with tempfile.TemporaryDirectory() as folder:
            found = np.array(list(felt_along(case, digital_twin(on_road(twin, road, folder)))))
        place = found[:, 1]
        passed = [(place > at + BUMP.length) & (place < at + 2.0 * BUMP.length) for at in case.bumps]
        after = place > case.bumps[0] + BUMP.length
        rows.append(np.column_stack([found, after, np.any(passed, axis=0)]))
    table = np.concatenate(rows)
    after, behind, known = table[:, 6] > 0, table[:, 7] > 0, np.isfinite(table[:, 5])
    return {
        "receiver": rms(table[after, 2]),
        "after_the_first_bump": rms(table[after, 3]),
        "behind_bumps": rms(table[behind, 3]),
        "published": rms(table[after, 4]),
        "worst_drive": max(rms(part[part[:, 6] > 0, 3]) for part in rows),
        "known": float(known[after].mean()),
        "error_over_sigma": rms(table[after & known, 3] / table[after & known, 5]),
    }


def false_locks(twin: Twin, tries: int, seconds: float) -> dict[str, Any]:
    """Drives whose road is not that of the twin."""
    locks, moved = 0, 0.0
    for seed in range(tries):
        case, _ = case_of(twin, "C", seed, seconds)
        other, _ = road_of("C", float(case.way[-1]) + 50.0, case.bumps[0], seed + 10_000)
        with tempfile.TemporaryDirectory() as folder:
            found = np.array(list(felt_along(case, digital_twin(on_road(twin, other, folder)))))
        locks += bool(np.isfinite(found[:, 5]).any())
        moved = max(moved, float(np.abs(found[:, 4] - found[:, 2]).max()))
    return {"tries": tries, "false_locks": locks, "largest_shift": moved}


def rms(values: Floats) -> float:
    """Root of the mean square; NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


# -- cost -------------------------------------------------------------------------------------------


def answer_times(twin: Twin, seconds: float) -> dict[str, float]:
    """p99 in µs of the processor time from a sample to its answer, with and without; what other processes do to a
    latency is not in it. The work that follows the answer is apart: ms each time that it is done."""
    case, road = case_of(twin, "C", 1, seconds)
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        here = on_road(twin, road, folder)
        for state in ("auto", "off", "auto", "off"):  # the first round compiles
            live_twin, answers, works = digital_twin(here), [], []
            live_twin.felt = live_twin.felt if state == "auto" else None
            push = live_twin.push_imu

            def timed(*sample: Any) -> Any:
                began = time.thread_time_ns()
                live_twin.rest()  # noqa: B023 - called within the round
                rested = time.thread_time_ns()
                out = push(*sample)  # noqa: B023
                answers.append(time.thread_time_ns() - rested)  # noqa: B023
                works.append(rested - began)  # noqa: B023
                return out

            live_twin.push_imu = timed  # type: ignore[method-assign, assignment]
            for _ in replay(case.drive, live_twin):
                pass
            found[state] = float(np.percentile(answers, 99)) / 1e3
            if state == "auto":
                work = np.array(works)[np.array(works) > 2e5] / 1e6
                found |= {"work_ms": float(np.median(work)), "work_p99_ms": float(np.percentile(work, 99))}
    found["ratio"] = found["auto"] / found["off"]
    return found


def nodes(control: Connection, file: str, position: str) -> None:
    """The nodes in one process, with ``felt_position`` as given."""
    from suspension_twin.nodes.composed import Composed
    from suspension_twin.nodes.process import ros_context

    with ros_context([*live.QUIET, "-p", f"felt_position:={position}"]) as context:
        composed = Composed(context, file, namespace=position)
        composed.settle_memory()
        live._serve(control, composed.step)
        composed.close()


def cost(twin: Twin, seconds: float, rounds: int, warm_up: float) -> dict[str, Any]:
    """Latencies at 100 Hz with and without, in turns; the receiver says 2.5 m."""
    import rclpy

    states = ("auto", "off")
    with tempfile.TemporaryDirectory() as folder:
        road, _ = road_of("C", 3000.0, 100.0, 1)
        file = str(Path(folder) / "twin.yaml")
        save_twin(on_road(twin.with_changes({"imu.rpy": (0.0, 0.0, 0.0)}), road, folder), file)
        children = {state: live.Child(nodes, file, state) for state in states}
        rclpy.init(args=[])
        live.ANSWERS.update(dict.fromkeys(states, "twin/vertical_acceleration"))
        drivers = {state: live.Driver(state) for state in states}
        p99s: dict[str, list[float]] = {state: [] for state in states}
        load = dict.fromkeys(states, 0.0)
        for _ in range(rounds):
            for state, driver in drivers.items():
                driver.fix.position_covariance[0] = driver.fix.position_covariance[4] = Receiver().sigma ** 2
                before = children[state].cpu()
                driver.drive(100, warm_up, seconds / rounds)
                load[state] += (children[state].cpu() - before) / (seconds / rounds + warm_up) / rounds
                p99s[state].append(float(np.percentile(driver.latencies(), 99)))
        for child in children.values():
            child.stop()
        rclpy.shutdown()
    ratios = [a / b for a, b in zip(p99s["auto"], p99s["off"], strict=True)]
    return {
        "p99_us": {state: round(1e6 * float(np.median(values)), 1) for state, values in p99s.items()},
        "cpu_share": load,
        "p99_ratio": float(np.median(ratios)),
        "p99_ratios": ratios,
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=12, help="drives of each kind of road")
    parser.add_argument("--tries", type=int, default=200, help="drives on a road that is not the twin's")
    parser.add_argument("--length", type=float, default=60.0, help="s of a drive")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="s of measured latency of each system; 0: none"
    )
    parser.add_argument("--rounds", type=int, default=5, help="turns that the systems take")
    parser.add_argument("--json", action="store_true")
    given = parse_options(parser, seeds=1, tries=1, length=30.0, seconds=2.0, rounds=1)
    twin = load_twin(ROOT / "bags" / "bump_15kmh" / "twin.yaml")
    found: dict[str, Any] = {"bars": BARS}
    for kind in ("C", "flat"):
        found[kind] = accuracy(twin, kind, given.seeds, given.length)
    found["unrelated"] = false_locks(twin, given.tries, 0.4 * given.length)
    found["answer"] = answer_times(twin, given.length)
    if given.seconds > 0:
        found["cost"] = cost(twin, given.seconds, given.rounds, 5.0)
    print(json.dumps(found, indent=1) if given.json else table(found))


def table(found: dict[str, Any]) -> str:
    """The figures as text."""
    lines = [
        "rms in m:     receiver   after the first bump   behind bumps   published   worst drive    known  error/σ"
    ]
    for kind, name in (("C", "ISO class C"), ("flat", "flat, bumps")):
        row = found[kind]
        lines.append(
            f"{name:>12} {row['receiver']:9.2f} {row['after_the_first_bump']:22.2f} {row['behind_bumps']:14.2f} "
            f"{row['published']:11.2f} {row['worst_drive']:13.2f} {100 * row['known']:6.0f} % "
            f"{row['error_over_sigma']:8.2f}"
        )
    row = found["unrelated"]
    lines.append(
        f"{row['tries']} drives on another road than the twin's: {row['false_locks']} false locks, the receiver's "
        f"place moved by {row['largest_shift']:.3f} m at most"
    )
    row = found["answer"]
    lines.append(
        f"processor time to an answer, p99: {row['auto']:.0f} µs with, {row['off']:.0f} µs without, ratio "
        f"{row['ratio']:.2f}; behind the answers {row['work_ms']:.1f} ms ten times a second"
    )
    if "cost" in found:
        row = found["cost"]
        shares = ", ".join(f"{state} {100 * share:.1f} %" for state, share in row["cpu_share"].items())
        lines.append(
            f"p99 at 100 Hz: {row['p99_us']['auto']:.0f} µs with, {row['p99_us']['off']:.0f} µs without, ratio "
            f"{row['p99_ratio']:.2f} (bar {BARS['p99_ratio']:g}); of a core: {shares}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
