# SPDX-License-Identifier: Apache-2.0
"""A corner on a test rig in MuJoCo: runs for a twin that has not seen it, with an effect drawn by a seed.

    python benchmarks/rig.py --out DIR [--seed N] [--effect ID] [--diagnose N] [--seeded [--folder RUNS]] [--json]

Wheel, sprung mass and the road's plate are MuJoCo's slide joints; tyre and stops are its tendons with a dead band,
so that a wheel can leave the plate; dry friction is its constraint; the mount of a damper is a body of its own. The
spring stiffens, the damper is a smooth curve with more in rebound than in jounce: no point of a twin's characteristics
is exact. Written are ``DIR/reference`` (the corner as it was) and ``DIR/gap`` (with the effect), each a sine sweep,
drops and a random road, ``DIR/twin.yaml`` with generic characteristics, and ``DIR/answer.json``, which no
command reads. Then, as with any rig:

    suspension-twin diagnose --twin DIR/twin.yaml DIR/gap/*.csv --reference DIR/reference/drops.csv --out DIR/found

``--diagnose N`` makes N cases and diagnoses each, all effects in turn. ``--loggers`` calibrates the corner on a random
road as different loggers record it, and says what that explains of drops.

``--seeded`` takes runs of programs that were repeated, of this corner on an actuator that repeats to 5 %, or those in
``--folder`` (CSV, as ``import --mapping`` writes them). The last run of each program is diagnosed with the others as
references, by a twin that was calibrated on these: as it is, and with a change of the sensor seeded into its responses.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from options import parse_options
from rich.console import Console
from rich.table import Table
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter, sosfilt, sosfilt_zi, sosfiltfilt

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.diagnosis.case import SHORTEST
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.drive.rig import RigRecord, read_rig, write_rig
from suspension_twin.inference.linear_corner import linear_corner
from suspension_twin.inference.runs import observe_runs, repeats, simulate_rig
from suspension_twin.models.quarter_car import CHANNELS
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

try:
    import mujoco
except ImportError:
    sys.exit("benchmarks/rig.py needs MuJoCo: pip install 'suspension-twin[test]'")

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("sweep", "drops", "random")
GRAVITY, RATE, SETTLE = 9.80665, 250.0, 2.0
#: Noise of the transducers: what a capacitive accelerometer, a string potentiometer and a load cell have.
NOISE = {
    "road_displacement": 2e-5,
    "body_acceleration": 0.03,
    "wheel_acceleration": 0.1,
    "suspension_deflection": 1e-4,
    "body_displacement": 2e-6,
    "wheel_displacement": 2e-6,
}
HEIGHTS = ("body_displacement", "wheel_displacement")


@dataclass(frozen=True)
class Corner:
    """One corner, and what an effect changes of it; at the neutral values there is none. SI units."""

    sprung: float = 400.0
    unsprung: float = 42.0
    tyre: float = 2.1e5
    spring: float = 2.3e4
    stiffening: float = 6.0e5  # N/m³
    push: float = 1500.0  # N s/m at rest, falling to a third beyond `knee`
    pull: float = 3200.0
    knee: float = 0.25
    friction: float = 0.0
    bump: tuple[float, float] = (0.05, 0.0)  # m of travel from standing, N/m
    rebound: tuple[float, float] = (0.05, 0.0)
    mount: float = 0.0  # N/m, 0 for a damper that ends on the body itself
    tyre_damping: float = 0.0
    payload: float = 0.0
    gain: float = 1.0
    cutoff: float = 0.0
    late: float = 0.0
    drift: float = 0.0

    def damper(self, v: float) -> float:
        """Force in N against the extension speed ``v`` m/s."""
        slope = self.pull if v > 0.0 else self.push
        return slope * v * (1 / 3 + 2 / 3 / math.sqrt(1.0 + (v / self.knee) ** 2))


#: What the seed draws from, by the id of the effect in the twin file: how a corner gets it, from a severity of 0 to 1.
EFFECTS: dict[str, Callable[[Corner, float], Corner]] = {
    "none": lambda c, s: c,
    "strut_friction": lambda c, s: replace(c, friction=60.0 + 140.0 * s),
    "bump_stop": lambda c, s: replace(c, bump=(0.02 - 0.01 * s, 6e4 + 6e4 * s)),
    "rebound_stop": lambda c, s: replace(c, rebound=(0.02 - 0.01 * s, 6e4 + 6e4 * s)),
    "top_mount": lambda c, s: replace(c, mount=1.5e5 - 1e5 * s),
    "tyre_damping": lambda c, s: replace(c, tyre_damping=400.0 + 800.0 * s),
    "payload": lambda c, s: replace(c, payload=50.0 + 70.0 * s),
    "sensor_scale": lambda c, s: replace(c, gain=1.1 + 0.15 * s),
    "sensor_bandwidth": lambda c, s: replace(c, cutoff=20.0 - 10.0 * s),
    "time_offset": lambda c, s: replace(c, late=0.01 + 0.03 * s),
    "clock_drift": lambda c, s: replace(c, drift=1e-3 + 2e-3 * s),
}


def step_of(c: Corner) -> float:
    """s: half a kilogram between mount and damper is quick."""
    return 1e-4 if c.mount else 2e-4


def model_of(c: Corner) -> mujoco.MjModel:
    """Coordinates: plate, wheel, body against wheel and, where the damper has a mount, its end against the body."""
    mount = f"""<body name="top"><joint name="mount" type="slide" axis="0 0 1" stiffness="{c.mount}" damping="50"/>
        <geom type="sphere" size=".02" mass="0.5" contype="0" conaffinity="0"/></body>"""
    return mujoco.MjModel.from_xml_string(
        f"""
        <mujoco><option timestep="{step_of(c)}" gravity="0 0 {-GRAVITY}" integrator="implicitfast"/><worldbody>
        <body name="plate"><joint name="plate" type="slide" axis="0 0 1"/>
          <geom type="box" size=".2 .2 .02" mass="1000" contype="0" conaffinity="0"/></body>
        <body name="wheel"><joint name="wheel" type="slide" axis="0 0 1"/>
          <geom type="sphere" size=".1" mass="{c.unsprung}" contype="0" conaffinity="0"/><site name="wheel"/>
          <body name="body" pos="0 0 .5"><joint name="strut" type="slide" axis="0 0 1"
              frictionloss="{c.friction}"
              solreffriction="0.001 1" solimpfriction="0.99 0.99 0.001"/>
            <geom type="box" size=".2 .2 .1" mass="{c.sprung + c.payload}" contype="0" conaffinity="0"/>
            <site name="body"/>
            {mount if c.mount else ""}</body></body></worldbody>
        <tendon>
          <fixed name="tyre" stiffness="{c.tyre}" damping="{c.tyre_damping}" springlength="0 9">
            <joint joint="wheel" coef="1"/><joint joint="plate" coef="-1"/></fixed>
          <fixed name="bump" stiffness="{c.bump[1]}" springlength="{-c.bump[0]} 9">
            <joint joint="strut" coef="1"/></fixed>
          <fixed name="rebound" stiffness="{c.rebound[1]}" springlength="-9 {c.rebound[0]}">
            <joint joint="strut" coef="1"/></fixed>
        </tendon>
        <sensor><accelerometer site="body"/><accelerometer site="wheel"/></sensor></mujoco>"""
    )


def road(kind: str, seconds: float, rng: np.random.Generator) -> CubicSpline:
    """Displacement in m of the plate over t from 0 s, from rest."""
    t = np.arange(0.0, seconds + 0.5, 1e-3)
    if kind == "sweep":  # 0.5 to 20 Hz, the amplitude falling with the frequency
        rise = np.log(40.0) / seconds
        f = 0.5 * np.exp(rise * t)
        z = 0.02 * (0.5 / f) ** 0.75 * np.sin(2 * np.pi * (f - 0.5) / rise)
    elif kind == "drops":  # every 2 s up or down within 15 ms
        z, n = np.zeros(t.size), int(seconds / 2.0)
        for k, height in enumerate(rng.uniform(0.02, 0.06, n) * (-1.0) ** np.arange(n)):
            s = np.clip((t - 1.0 - 2.0 * k) / 0.015, 0.0, 1.0)
            z += height * s * s * (3.0 - 2.0 * s)
    else:  # ISO 8608 class C at 15 m/s, above 0.1 Hz
        rate = 2 * np.pi * 0.1 * np.sqrt(256e-6 * 15.0) * rng.standard_normal(t.size) / np.sqrt(1e-3)
        z = lfilter([1e-3], [1.0, -np.exp(-2 * np.pi * 0.1e-3)], rate)
        z = lfilter(*butter(2, 40.0, fs=1e3), z)
    return CubicSpline(t, z * np.clip(t / 0.5, 0.0, 1.0) ** 2)


def run_of(
    c: Corner,
    kind: str,
    seconds: float,
    rng: np.random.Generator,
    program: int = 0,
    displacements: bool = False,
    astray: float = 0.0,
) -> RigRecord:
    """One run as its transducers record it, or as ones of ``displacements`` do; runs of one ``program`` have the same
    road, but for an actuator that goes ``astray`` by this share of it."""
    model, curve = model_of(c), road(kind, seconds, np.random.default_rng(program))
    if astray:
        off = road("random", seconds, rng)
        curve = CubicSpline(
            curve.x, curve(curve.x) + astray * np.std(curve(curve.x)) * off(curve.x) / np.std(off(curve.x))
        )
    data, step = mujoco.MjData(model), step_of(c)
    t, rest = np.arange(0.0, seconds, 1.0 / RATE), round(SETTLE / step)
    dense = np.arange(round(seconds / step)) * step
    height, speed = curve(dense).tolist(), curve.derivative()(dense).tolist()
    weight = c.sprung * GRAVITY
    data.qpos[1] = -(weight + c.unsprung * GRAVITY) / c.tyre
    read = np.empty((dense.size, 5))
    for k in range(-rest, dense.size):
        data.qpos[0], data.qvel[0] = height[max(k, 0)], speed[max(k, 0)]
        wheel, travel, rate = float(data.qpos[1]), float(data.qpos[2]), float(data.qvel[2:].sum())
        damper = -c.damper(rate)
        data.qfrc_applied[2:] = damper
        data.qfrc_applied[2] += weight - c.spring * travel - c.stiffening * travel**3
        mujoco.mj_step(model, data)
        if k >= 0:  # the sensors show where the step began
            read[k] = data.sensordata[2], data.sensordata[5], -travel, wheel + travel, wheel
    read[:, 0] *= c.gain
    if c.cutoff:
        sos = butter(2, c.cutoff, fs=1.0 / step, output="sos")
        read[:, 0] = sosfilt(sos, read[:, 0], zi=sosfilt_zi(sos) * read[0, 0])[0]
    at = t - c.late - c.drift * t
    columns = {"road_displacement": curve(t)}
    names = "body_acceleration", "wheel_acceleration", "suspension_deflection", *HEIGHTS
    for i, name in enumerate(names):
        if (name in HEIGHTS) == displacements:
            columns[name] = np.interp(at, dense, read[:, i])
    noisy = {name: values + NOISE[name] * rng.standard_normal(t.size) for name, values in columns.items()}
    return RigRecord(kind, t, noisy)


def make(out: Path, seed: int, effect: str | None = None, seconds: float = 20.0) -> dict[str, float | str]:
    """Write a case to ``out``; returns its answer."""
    rng = np.random.default_rng(seed)
    unlike = {
        "unsprung": 0.1,
        "tyre": 0.1,
        "spring": 0.1,
        "stiffening": 0.5,
        "push": 0.2,
        "pull": 0.2,
        "knee": 0.3,
    }
    plain = replace(
        Corner(),
        **{name: getattr(Corner, name) * (1.0 + s * rng.uniform(-1, 1)) for name, s in unlike.items()},
    )
    chosen, severity = str(rng.choice(list(EFFECTS))), float(rng.uniform())
    chosen = effect or chosen
    for folder, corner in (("reference", plain), ("gap", EFFECTS[chosen](plain, severity))):
        for kind in KINDS:
            write_rig(
                run_of(corner, kind, seconds, rng, seed),
                out / folder / f"{kind}.csv",
                f"{kind}, simulated by benchmarks/rig.py",
            )
    twin = load_twin(ROOT / "config" / "twins" / "quarter_car.yaml")
    save_twin(
        twin.with_changes({"vehicle.sprung_mass": plain.sprung * rng.uniform(0.99, 1.01)}), out / "twin.yaml"
    )
    answer: dict[str, float | str] = {"effect": chosen, "severity": severity, "seed": seed}
    (out / "answer.json").write_text(json.dumps(answer) + "\n", encoding="utf-8")
    return answer


def filtered(record: RigRecord) -> RigRecord:
    """The run with accelerations behind an anti-aliasing filter of 40 Hz of their own."""
    sos = butter(2, 40.0, fs=RATE, output="sos")
    columns = {
        k: sosfilt(sos, v - v[0]) if k.endswith("acceleration") else v for k, v in record.columns.items()
    }
    return replace(record, columns=columns)


def differentiated(record: RigRecord) -> RigRecord:
    """The run with body and wheel acceleration by second differences of their displacements."""
    columns = dict(record.columns)
    for name in HEIGHTS:
        second = np.gradient(np.gradient(columns.pop(name), 1.0 / RATE), 1.0 / RATE)
        columns[name.replace("displacement", "acceleration")] = second
    return replace(record, columns=columns)


#: How a corner is recorded: whether displacements are, how late all responses come in s, what is done to the channels.
LOGGERS: dict[str, tuple[bool, float, Callable[[RigRecord], RigRecord]]] = {
    "accelerometers": (False, 0.0, lambda record: record),
    "accelerometers with a filter of 40 Hz": (False, 0.0, filtered),
    "responses 25 ms late": (False, 0.025, lambda record: record),
    "displacements": (True, 0.0, lambda record: record),
    "displacements differentiated by hand": (True, 0.0, differentiated),
}


def explained(twin: Twin, record: RigRecord) -> float:
    """Share of the variance of the body acceleration below 20 Hz that a twin explains over a run."""
    run = simulate_rig(record, twin)
    measured, simulated = run.measured["body_acceleration"], run.simulated["body_acceleration"]
    return 1.0 - float(np.var(measured - simulated) / np.var(measured))


def recorded(out: Path, seed: int, seconds: float) -> list[dict[str, str]]:
    """A corner calibrated on the random road by each logger: what it explains of drops that were not used, beside the
    linear corner of the same run."""
    make(out, seed, "none", seconds)
    twin, rows = load_twin(out / "twin.yaml"), []
    for logger, (displacements, late, change) in LOGGERS.items():
        folder = out / logger.replace(" ", "_")
        runs = {}
        for kind in ("random", "drops"):
            rng = np.random.default_rng(seed)
            runs[kind] = change(run_of(replace(Corner(), late=late), kind, seconds, rng, seed, displacements))
            write_rig(runs[kind], folder / f"{kind}.csv", f"{kind}, {logger}, simulated by benchmarks/rig.py")
        found = calibrate(CalibrationRequest(str(out / "twin.yaml"), (str(folder / "random.csv"),)))
        used, drops = observe_runs(twin, [str(folder / f"{kind}.csv") for kind in ("random", "drops")])
        linear = linear_corner([used], ["body_acceleration"])[0].signals(drops)["body_acceleration"]
        measured = drops.measured["body_acceleration"]
        rows.append(
            {
                "recorded by": logger,
                "twin as written": f"{explained(twin, runs['drops']):.3f}",
                "linear corner": f"{1.0 - float(np.var(measured - linear) / np.var(measured)):.3f}",
                "calibrated": f"{explained(found.twin, runs['drops']):.3f}",
                "latency, ms": f"{1e3 * found.twin.imu.latency:.1f}",
                "seconds": f"{found.seconds:.0f}",
            }
        )
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def diagnosed(out: Path, seed: int, count: int, seconds: float) -> list[dict[str, float | str]]:
    """What the diagnosis says of each of ``count`` cases, beside what each has."""
    found = []
    order = np.random.default_rng(seed).permutation(list(EFFECTS))
    for number in range(count):
        case = out / f"case_{number:02}"
        truth = make(case, seed + number, str(order[number % order.size]), seconds)
        began = time.perf_counter()
        after, before = (tuple(str(case / f / f"{kind}.csv") for kind in KINDS) for f in ("gap", "reference"))
        document = diagnose(DiagnosisRequest(str(case / "twin.yaml"), after, before, seed)).document
        first = document["causes"][0]
        row: dict[str, float | str] = {
            "effect": truth["effect"],
            "severity": f"{truth['severity']:.2f}",
            "verdict": document["verdict"],
            "named": ", ".join(document["combination"]),
            "first": first["effect"],
            "probability": f"{first['probability']:.2f}",
            "shrink": f"{first['shrink']:.2f}",
            "seconds": f"{time.perf_counter() - began:.0f}",
        }
        found.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
    return found


def _of_acceleration(change: Callable[[np.ndarray, float], np.ndarray]) -> Callable[[RigRecord], RigRecord]:
    """A change of what the accelerometer on the body reads, gravity included, at a rate in Hz."""

    def changed(record: RigRecord) -> RigRecord:
        rate = (record.t.size - 1) / float(record.t[-1] - record.t[0])
        read = change(record.columns["body_acceleration"] + GRAVITY, rate) - GRAVITY
        return replace(record, columns={**record.columns, "body_acceleration": read})

    return changed


def _late(record: RigRecord) -> RigRecord:
    """The run with all responses 20 ms late."""
    columns = {
        name: values if name in INPUTS else np.interp(record.t - 0.02, record.t, values)
        for name, values in record.columns.items()
    }
    return replace(record, columns=columns)


def _low_passed(values: np.ndarray, rate: float) -> np.ndarray:
    sos = butter(2, 6.0, fs=rate, output="sos")
    return np.asarray(sosfilt(sos, values, zi=sosfilt_zi(sos) * values[0])[0])


INPUTS = ("road_displacement", "road_velocity", "actuator_force")
#: Changes that are seeded, by the id of the effect that they are: the range is half of the swing over gravity (0.999).
SEEDED: dict[str, Callable[[RigRecord], RigRecord]] = {
    "none": lambda record: record,
    "time_offset": _late,
    "sensor_bandwidth": _of_acceleration(_low_passed),
    "sensor_scale": _of_acceleration(lambda values, rate: 1.15 * values),
    "sensor_clipping": _of_acceleration(
        lambda values, rate: np.minimum(values, GRAVITY + 0.5 * np.quantile(values - GRAVITY, 0.999))
    ),
}


def repeated(out: Path, seed: int, seconds: float) -> list[Path]:
    """Three runs of two programs of the corner each, long enough for a diagnosis to hold some of them out."""
    paths, seconds = [], max(seconds, SHORTEST + 2.0)
    for program, kind in enumerate(("sweep", "random")):
        for number in range(3):
            rng = np.random.default_rng([seed, program, number])
            paths.append(out / "runs" / f"{kind}_{number}.csv")
            run = run_of(Corner(), kind, seconds, rng, seed + program, True, 0.05)
            write_rig(run, paths[-1], f"{kind}, simulated by benchmarks/rig.py")
    return paths


def with_accelerometers(record: RigRecord) -> RigRecord:
    """A run with what accelerometers would read in the place of displacements: behind a filter of 40 Hz, for encoders
    that are differentiated twice are mostly noise."""
    sos = butter(2, 40.0, fs=(record.t.size - 1) / float(record.t[-1] - record.t[0]), output="sos")
    columns = {name: values for name, values in record.columns.items() if name in INPUTS}
    for name in CHANNELS:
        values = record.channel(name)
        if values is not None:
            derived = name.endswith("acceleration") and name not in record.columns
            columns[name] = np.asarray(sosfiltfilt(sos, values)) if derived else values
    return replace(record, columns=columns)


def seeded(out: Path, seed: int, paths: list[Path], twin: Path) -> list[dict[str, str]]:
    """What the diagnosis says of the last run of each program, as it is and with each seeded change."""
    files = [str(path) for path in paths]
    runs = observe_runs(load_twin(twin), files)
    last = [not any(repeats(run, later) for later in runs[i + 1 :]) for i, run in enumerate(runs)]
    known = tuple(file for file, shown in zip(files, last, strict=True) if not shown)
    found = calibrate(CalibrationRequest(str(twin), known)).twin
    save_twin(found, out / "corner.yaml")
    rows = []
    for file in (file for file, shown in zip(files, last, strict=True) if shown):
        record = read_rig(file)
        plain = with_accelerometers(record)
        for effect, change in SEEDED.items():
            path = out / "seeded" / f"{record.name}_{effect}.csv"
            write_rig(change(plain), path, f"{record.name}, {effect} seeded by benchmarks/rig.py")
            began = time.process_time()
            document = diagnose(
                DiagnosisRequest(str(out / "corner.yaml"), (str(path),), known, seed)
            ).document
            named = document["combination"]
            right = named == ([] if effect == "none" else [effect]) and document["verdict"] != "unknown"
            row = {
                "run": record.name,
                "seeded": effect,
                "verdict": document["verdict"],
                "named": ", ".join(named),
                "probability": f"{document['probability']:.2f}",
                "right": "yes" if right else "wrong" if named and named != [effect] else "no",
                "processor, s": f"{time.process_time() - began:.0f}",
            }
            rows.append(row)
            print(json.dumps(row), file=sys.stderr, flush=True)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--effect", choices=EFFECTS, help="instead of one that the seed draws")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a run")
    parser.add_argument(
        "--diagnose", type=int, metavar="N", help="make N cases, each effect in turn, and diagnose them"
    )
    parser.add_argument("--json", action="store_true", help="figures as JSON on standard output")
    parser.add_argument(
        "--loggers", action="store_true", help="calibrate the corner as each kind of logger records it"
    )
    parser.add_argument(
        "--seeded", action="store_true", help="diagnose repeats as they are and with seeded changes"
    )
    parser.add_argument("--folder", type=Path, help="measured runs for --seeded, CSV")
    parser.add_argument(
        "--twin",
        type=Path,
        default=ROOT / "config" / "twins" / "quarter_car.yaml",
        help="where these start from",
    )
    given = parse_options(parser, seconds=5.0)
    if given.diagnose or given.loggers or given.seeded:
        answers: list[dict[str, float | str]] | list[dict[str, str]]
        if given.loggers:
            answers = recorded(given.out, given.seed, given.seconds)
        elif given.seeded:
            measured = sorted(given.folder.glob("*.csv")) if given.folder else None
            answers = seeded(
                given.out, given.seed, measured or repeated(given.out, given.seed, given.seconds), given.twin
            )
        else:
            answers = diagnosed(given.out, given.seed, given.diagnose, given.seconds)
        title = "Explained variance of drops that were not used" if given.loggers else "Diagnoses"
        table = Table(title=title, title_justify="left", title_style="bold")
        for name in answers[0]:
            table.add_column(name.replace("_", " "))
        for row in answers:
            table.add_row(*(str(value) for value in row.values()))
        Console(stderr=given.json).print(table)
        if given.json:
            print(json.dumps(answers))
        return 0
    make(given.out, given.seed, given.effect, given.seconds)
    twin = load_twin(given.out / "twin.yaml")
    figures = {
        f"{folder}/{kind}": simulate_rig(read_rig(given.out / folder / f"{kind}.csv"), twin).gap.channels
        for folder in ("reference", "gap")
        for kind in KINDS
    }
    table = Table(title="Gap of the twin as it is written", title_justify="left", title_style="bold")
    table.add_column("run")
    for name in next(iter(figures.values())):
        table.add_column(name.replace("_", " "), justify="right")
    for name, gap in figures.items():
        table.add_row(name, *(f"{value:.4g}" for value in gap.values()))
    Console(stderr=given.json).print(table)
    if given.json:
        print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
