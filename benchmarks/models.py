# SPDX-License-Identifier: Apache-2.0
"""How fast ``full_car`` is, beside MuJoCo, solve_ivp and NumPy in the same run.

The task is the car paper's: ten seconds over a bump at 15 km/h, 100 stamps a second, steps of 1 ms,
candidates that differ in all 24 points of their curves. One core is measured in processor time,
all cores in wall time; each figure is the best of several tries, since others may use the machine.

Usage: ``python benchmarks/models.py [--json] [--repeats N] [--smoke]``. With ``--smoke`` every measurement is made
once, on runs of seconds: the figures mean nothing then.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from options import parse_options
from peak import arithmetic_peak
from peers import LinearCar, MujocoCar, NumpyCars, linear
from plain_car import PlainCar
from rich.console import Console
from rich.table import Table

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.models.excitation import excitation
from suspension_twin.models.parameters import lanes, layout
from suspension_twin.models.simulate import cores, simulate_lanes, simulate_twin
from suspension_twin.models.tracked import ObstacleRun
from suspension_twin.models.types import Excitation
from suspension_twin.pose.types import Trajectory
from suspension_twin.road import bump_road, circular
from suspension_twin.vehicle.twin import Twin, load_twin

CONFIG = Path(__file__).resolve().parents[1] / "config"
TWIN, TRACKED = CONFIG / "twins" / "ford_mondeo_mk4.yaml", CONFIG / "tracked" / "pt91.yaml"
SPEED = 15 / 3.6
GENERATION = 100
ENOUGH = 0.005  # rms error of every acceleration against the exact answer


class Scale(NamedTuple):
    """How much is measured: seconds of a pass, evaluations of the paper's budget, lanes of a batch and of one with an
    effect, lanes and seconds of a tracked run, numbers of lanes and lengths in s of the straight lines, seconds at
    1 kHz for the memory, and tries of each measurement."""

    passed: float = 10.0
    evaluations: int = 10_842
    lanes: int = 512
    effect_lanes: int = 128
    tracked: tuple[int, float] = (8, 4.0)
    counts: tuple[int, ...] = (64, 128, 256, 512, 1024)
    lengths: tuple[int, ...] = (5, 10, 20, 40, 80)
    long: float = 3600.0
    repeats: int = 9


SMOKE = Scale(2.0, 200, 32, 16, (2, 0.5), (16, 32), (1, 2), 20.0, 1)


def straight(seconds: float, rate: float = 100.0, speed: float = SPEED) -> Trajectory:
    """Straight ahead from the origin."""
    t = np.arange(round(seconds * rate) + 1) / rate
    z = np.zeros_like(t)
    ahead = np.column_stack([z + speed, z])
    return Trajectory(t, speed * t, z, z, ahead, z, 0 * ahead, z == 0)


def candidates(twin: Twin, count: int) -> Floats:
    """(P, count) the twin with all points of its curves moved by up to 10 %, rising still; without curves its mass."""
    keys = [name for name in layout(twin).names if ".force." in name]
    rng = np.random.default_rng(1)
    if not keys:
        return lanes(twin, ["vehicle.mass"], twin.vehicle.mass * rng.uniform(0.9, 1.1, (count, 1)))
    base = np.array([float(_at(twin, key)) for key in keys])
    steps = np.diff(base.reshape(6, -1), axis=1, prepend=0.0)
    values = np.cumsum(steps * rng.uniform(0.9, 1.1, (count, *steps.shape)), axis=2)
    return lanes(twin, keys, values.reshape(count, -1))


def _at(twin: Twin, key: str) -> Any:
    node: Any = twin
    for part in key.split("."):
        node = node[int(part)] if part.isdigit() else getattr(node, part)
    return node


def best(work: Callable[[], object], repeats: int, clock: Callable[[], float] = time.thread_time) -> float:
    """Seconds of the quickest of several runs; the first, which may compile, does not count."""
    work()
    seconds = math.inf
    for _ in range(repeats):
        begin = clock()
        work()
        seconds = min(seconds, clock() - begin)
    return seconds


def operations(hinges: int = 3) -> int:
    """float64 operations of a lane's step in ``models.corner``: a fused multiply-add is two, min or max one."""
    fused = (
        7 + 6 + 4 * (1 + hinges) + 4 + 3 + 4 + 2 + 4 + 4 + 4 + 4 * (2 + 2 * hinges) + 4 + 2 + 2 + 4 + 1 + 7
    )
    others = 4 + 4 + 4 + 4 + 4 + 3 + 1 + 1 + 2
    highest = 4 * hinges + 4 + 4 * (1 + 2 * hinges)
    return 2 * fused + others + highest


def speed_of_the_batch(twin: Twin, way: Excitation, scale: Scale) -> dict[str, float]:
    """Simulated seconds per second: all cores, one core, one lane; and the paper's budget."""
    repeats, simulated = scale.repeats, scale.lanes * scale.passed
    many = candidates(twin, scale.lanes)
    one = candidates(twin, 1)

    def run(params: Floats, threads: int) -> Callable[[], object]:
        return lambda: simulate_lanes(twin, params, way, threads, vertical_only=True)

    everything = best(lambda: simulate_lanes(twin, many, way, 1), repeats)
    budget = candidates(twin, scale.evaluations)

    def generations() -> None:
        for begin in range(0, scale.evaluations, GENERATION):
            simulate_lanes(twin, budget[:, begin : begin + GENERATION], way, vertical_only=True)

    return {
        "simulated_s_per_s_all_cores": simulated / best(run(many, cores()), repeats, time.perf_counter),
        "simulated_s_per_s_one_core": simulated / best(run(many, 1), repeats),
        "simulated_s_per_s_one_core_all_signals": simulated / everything,
        "simulated_s_per_s_one_lane": scale.passed / best(run(one, 1), repeats),
        "paper_budget_s": best(generations, max(2, repeats // 4), time.perf_counter),
        "cores": cores(),
    }


def beside_mujoco(twin: Twin, scale: Scale) -> tuple[dict[str, float], list[tuple[str, float, float, float]]]:
    """MuJoCo's speed at 1 ms, and rows (who, step in s, error, simulated s per s) of the linear car."""
    car = linear(twin)
    fine = 1e-4  # the road is linear between these, for everyone
    passed, repeats = scale.passed, scale.repeats
    t = np.arange(round(passed / fine) + 1) * fine
    bump = bump_road(
        circular(0.9, 0.05), at=2.0 * passed, length=80.0, width=24.0, step=0.01, heading=0.1
    )  # slantwise: roll
    wheels = car.vehicle.wheel_positions
    road = np.asarray(bump.heights(SPEED * t[:, None] + wheels[:, 0], 0 * t[:, None] + wheels[:, 1]))
    exact = LinearCar.of(car).exact(road, fine)
    size = np.sqrt(np.mean(exact**2, axis=0))
    rows: list[tuple[str, float, float, float]] = []
    figures: dict[str, float] = {}
    for integrator in ("Euler", "implicitfast", "RK4"):
        for step in (2e-3, 1e-3, 5e-4, 2e-4, 1e-4):
            every = round(step / fine)
            peer = MujocoCar(car, step, integrator)
            error = np.sqrt(np.mean((peer.accelerations(road[::every]) - exact[::every]) ** 2, axis=0))
            bare, with_road = peer.seconds_per_step(road[::every][:10_000], repeats)
            rows.append((f"MuJoCo {integrator}", step, float((error / size).max()), step / with_road))
            if integrator == "Euler" and step == 1e-3:
                figures["mujoco_s_per_s"] = step / with_road
                figures["mujoco_mj_step_alone_s_per_s"] = step / bare
    for step in (2e-3, 1e-3, 5e-4):
        way = excitation(straight(passed, 100.0), car.vehicle, bump, max_step=step)
        answer = simulate_twin(car, way).acceleration
        error = np.sqrt(np.mean((answer - exact[:: round(0.01 / fine)]) ** 2, axis=0))
        many = candidates(car, scale.lanes)
        seconds = best(partial(simulate_lanes, car, many, way, 1, vertical_only=True), repeats)
        rows.append(("full_car, batched", step, float((error / size).max()), scale.lanes * passed / seconds))
    return figures, rows


def peers_of_one(twin: Twin, way: Excitation, scale: Scale) -> dict[str, float]:
    """Simulated seconds per second of solve_ivp and of NumPy over lanes, the nonlinear car."""
    plain = PlainCar(twin, way)
    cars = NumpyCars(twin, way, 256)
    return {
        "solve_ivp_s_per_s": scale.passed / best(lambda: plain.simulate(twin.vehicle), 1),
        "numpy_s_per_s": 256 * scale.passed / best(cars.run, 1),
    }


def armed(effect: Effect, twin: Twin) -> Twin:
    """The twin with an effect of a size that its model is made for."""
    given = {}
    for p in effect.parameters:
        value = p.prior.typical if p.prior.typical != p.neutral else p.neutral + 0.25 * (p.upper - p.neutral)
        given[p.name] = p.choices[-1] if p.choices else min(max(value, p.lower), p.upper)
    possible = effect.hook.possible
    if possible is not None and not possible(twin, given):
        given |= {p.name: p.choices[0] for p in effect.parameters if p.choices}
    return twin.with_changes({"effects": [{"id": effect.id, "parameters": given}]})


def cost_of_effects(twin: Twin, way: Excitation, scale: Scale) -> dict[str, float]:
    """Time with an effect in all lanes, as a ratio to its model without any: the first model that it declares."""
    tracked, (few, seconds) = load_twin(TRACKED), scale.tracked
    cases: dict[str, tuple[Twin, int, Any, dict[str, bool]]] = {
        "tracked": (tracked, few, ObstacleRun(np.arange(round(100 * seconds) + 1) / 100, SPEED), {})
    }
    for model in ("full_car", "msd"):
        of_cars = {"vertical_only": True}
        cases[model] = twin.with_changes({"model": model}), scale.effect_lanes, way, of_cars

    clock = time.process_time  # the lanes of a tracked vehicle are simulated in threads

    def cost(changed: Twin) -> float:
        _, count, run, options = cases[changed.model]
        params = candidates(changed, count)
        return best(lambda: simulate_lanes(changed, params, run, 1, **options), scale.repeats, clock)

    bare = {model: cost(case[0]) for model, case in cases.items()}
    return {
        name: cost(armed(effect.on(model), cases[model][0])) / bare[model]
        for name, effect in EFFECTS.items()
        for model in effect.models[:1]
    }


def straight_lines(twin: Twin, scale: Scale) -> dict[str, Any]:
    """Cost against lanes and against length, each with the share of it that a straight line explains."""
    road = bump_road(circular(0.9, 0.05), at=20.0, length=400.0)
    way = excitation(straight(scale.passed), twin.vehicle, road)

    def lane_cost(count: int) -> float:
        params = candidates(twin, count)
        return best(lambda: simulate_lanes(twin, params, way, 1, vertical_only=True), scale.repeats)

    def length_cost(seconds: float) -> float:
        long = excitation(straight(seconds), twin.vehicle, road)
        params = candidates(twin, 64)
        return best(lambda: simulate_lanes(twin, params, long, 1, vertical_only=True), scale.repeats)

    out: dict[str, Any] = {}
    for name, cost, sizes in (
        ("lanes", lane_cost, scale.counts),
        ("length_s", length_cost, scale.lengths),
    ):
        times = [cost(n) for n in sizes]
        out[f"cost_against_{name}"] = dict(zip(map(str, sizes), times, strict=True))
        out[f"linearity_{name}"] = float(np.corrcoef(sizes, times)[0, 1] ** 2)
    return out


_HOUR = "import sys; sys.path.insert(0, sys.argv[1]); from models import an_hour; an_hour(float(sys.argv[2]))"


def an_hour(seconds: float = 3600.0) -> None:
    """An hour, or so many ``seconds``, at 1 kHz, everything recorded; prints peak memory in bytes and seconds."""
    twin = load_twin(TWIN)
    begin = time.perf_counter()
    road = bump_road(circular(0.9, 0.05), at=20.0, length=200.0)  # held beyond its end
    way = straight(seconds, 1000.0)
    simulate_twin(twin, excitation(way, twin.vehicle, road))
    usage = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps([usage, time.perf_counter() - begin]))


def memory(scale: Scale) -> dict[str, float]:
    """Peak memory of that hour, in a process of its own."""
    here = str(Path(__file__).resolve().parent)
    run = subprocess.run(
        [sys.executable, "-c", _HOUR, here, str(scale.long)], capture_output=True, text=True, check=True
    )
    peak, seconds = json.loads(run.stdout.strip().splitlines()[-1])
    return {"hour_at_1_khz_peak_bytes": peak, "hour_at_1_khz_s": seconds}


def measure(scale: Scale) -> tuple[dict[str, Any], list[tuple[str, float, float, float]]]:
    """All figures, and the table of errors and speeds."""
    twin = load_twin(TWIN)
    road = bump_road(circular(0.9, 0.05), at=2.0 * scale.passed, length=80.0)
    way = excitation(straight(scale.passed), twin.vehicle, road)
    half = scale._replace(repeats=max(min(2, scale.repeats), scale.repeats // 2))
    out: dict[str, Any] = speed_of_the_batch(twin, way, scale)
    mujoco_figures, rows = beside_mujoco(twin, scale)
    out |= mujoco_figures
    out["ratio_to_mujoco_per_core"] = out["simulated_s_per_s_one_core"] / out["mujoco_s_per_s"]
    good = [row for row in rows if row[2] <= ENOUGH]
    mine = max((row[3] for row in good if row[0].startswith("full_car")), default=math.nan)
    theirs = max((row[3] for row in good if row[0].startswith("MuJoCo")), default=math.nan)
    out["ratio_to_mujoco_per_core_at_equal_error"] = mine / theirs
    out |= peers_of_one(twin, way, scale)
    out["peak_flop_per_s_one_core"] = arithmetic_peak()
    steps = out["simulated_s_per_s_one_core"] * int(way.first[-1]) / scale.passed
    out["flop_per_step"] = operations()
    out["share_of_peak"] = steps * operations() / out["peak_flop_per_s_one_core"]
    out["effects"] = cost_of_effects(twin, way, half)
    out |= straight_lines(twin, half)
    out |= memory(scale)
    return out, rows


def show(figures: dict[str, Any], rows: list[tuple[str, float, float, float]], scale: Scale) -> None:
    """Tables for people."""
    console = Console(width=110)
    table = Table("simulated seconds per second", "", title="Ten seconds over a bump, 24 curve points, 1 ms")
    for key, text in (
        ("simulated_s_per_s_all_cores", f"batched, {figures['cores']} cores"),
        ("simulated_s_per_s_one_core", "batched, one core, vertical acceleration"),
        ("simulated_s_per_s_one_core_all_signals", "batched, one core, all seven signals"),
        ("simulated_s_per_s_one_lane", "one lane"),
        ("mujoco_s_per_s", "MuJoCo, 1 ms, Euler, linear car, road by its rollout"),
        ("mujoco_mj_step_alone_s_per_s", "MuJoCo, the same, mj_step alone"),
        ("solve_ivp_s_per_s", "scipy solve_ivp (LSODA, 1e-4)"),
        ("numpy_s_per_s", "NumPy over 256 lanes"),
    ):
        table.add_row(text, f"{figures[key]:,.0f}")
    console.print(table)
    table = Table("linear car", "step ms", "largest rms error %", "simulated s/s, one core")
    for who, step, error, speed in rows:
        table.add_row(who, f"{step * 1e3:g}", f"{100 * error:.3f}", f"{speed:,.0f}")
    console.print(table)
    console.print(
        f"{scale.evaluations} evaluations of a pass, {GENERATION} at a time: {figures['paper_budget_s']:.2f} s "
        f"on {figures['cores']} cores (bar: 2 s on two)\n"
        f"against MuJoCo per core: {figures['ratio_to_mujoco_per_core']:.0f} times at 1 ms, "
        f"{figures['ratio_to_mujoco_per_core_at_equal_error']:.0f} times at {100 * ENOUGH:g} % error (bar: 300)\n"
        f"arithmetic: {figures['flop_per_step']} operations a step, {100 * figures['share_of_peak']:.0f} % of "
        f"{figures['peak_flop_per_s_one_core'] / 1e9:.1f} GFLOP/s (fused multiply-adds in registers, peak.py)\n"
        f"an hour at 1 kHz: {figures['hour_at_1_khz_peak_bytes'] / 2**30:.2f} GiB at most, "
        f"{figures['hour_at_1_khz_s']:.1f} s (bar: 2 GB)\n"
        f"a straight line explains {100 * figures['linearity_lanes']:.2f} % of the cost over lanes, "
        f"{100 * figures['linearity_length_s']:.2f} % over length"
    )
    table = Table("effect in every lane", "time, base = 1")
    for name, ratio in sorted(figures["effects"].items(), key=lambda item: item[1]):
        model = EFFECTS[name].models[0]
        table.add_row(name if model == "full_car" else f"{name} (of {model})", f"{ratio:.2f}")
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--repeats", type=int, default=9, help="tries of each measurement")
    arguments = parse_options(parser)
    scale = SMOKE if arguments.smoke else Scale(repeats=max(1, arguments.repeats))
    figures, rows = measure(scale)
    if arguments.json:
        keys = ("who", "step_s", "error", "s_per_s")
        print(json.dumps(figures | {"linear_car": [dict(zip(keys, row, strict=True)) for row in rows]}))
    else:
        show(figures, rows, scale)


if __name__ == "__main__":
    main()
