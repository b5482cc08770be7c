# SPDX-License-Identifier: Apache-2.0
"""Whether two versions of the package give the same answers to the same files, and what each of them costs.

    python benchmarks/golden.py make FOLDER                     # cases as plain files, the same each time
    python benchmarks/golden.py capture FOLDER --out OLD.json   # answers of this version
    python benchmarks/golden.py capture FOLDER --out NEW.json   # answers of another version
    python benchmarks/golden.py compare OLD.json NEW.json       # exit status 1 where they differ

``make`` writes 24 cases: twin files, roads, drives with a gap and drives from before it, of cars by the simulators of
``blind/``, of a rig's corner by MuJoCo, of a tracked vehicle by ``tracked_reality.py``, and two of the withheld ones
(``../shared/withheld`` from the repository, or SUSPENSION_TWIN_WITHHELD). Model ``full_car`` and ``msd``, with and
without a reference, single effects of every category, pairs, none, some outside the library, and cars without a road.
None was chosen by its answer. A version that has other generators takes the files as they are.

``capture`` diagnoses every case and keeps verdict, causes and the numbers of the evidence; it calibrates and simulates
the bundled drives, calibrates the tracked vehicle, and plays a drive through the nodes. What is in ``--out`` is not
done again, so that it goes on after an interruption. ``--again`` does it again, says where an answer is not the same to
the last digit, and keeps the smaller times: the first run of a version also compiles. ``compare`` says of each item
whether verdict and first cause are the same, by how many nats and in which row the evidence differs most, how far
calibrated values and gaps are apart, and the ratio of the processor times. Gains of the evidence are not yet tempered,
so that they are many times more sensitive than a probability. ``--smoke`` makes and captures two tiny cases.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE))

from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

CASE = "case.json"
WITHHELD = Path(os.environ.get("SUSPENSION_TWIN_WITHHELD", ROOT.parent / "shared" / "withheld"))
TRACKED = ROOT / "config" / "tracked"
#: Numbers of an evidence row that are in nats.
NATS = ("gain", "gain_fitted", "occam", "tempered_gain", "freedom", "since", "preexisting")
#: More nats than this are another evidence.
MOST_NATS = 1.0
#: What of an evidence row is not kept: long, and follows from the rest.
_LEFT_OUT = (
    "mean_squares",
    "mean_squares_on_reference",
    "channels",
    "vehicle",
    "parameters",
    "effects",
    "where",
)
_DIGITS = 8

Item = dict[str, Any]


# -- the cases --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Golden:
    """One case: how it is made, and the part of the library (empty: all) that is asked about it. ``drives`` of the car
    simulators' two that are shown."""

    name: str
    source: str  # car, planar, rig, tracked, withheld
    kind: str = "single"
    effects: tuple[str, ...] = ()
    seed: int = 0
    reality: str = "newton"
    reference: bool = False
    severity: float = 3.0
    msd: bool = False
    right: bool = False
    drives: int = 2
    library: tuple[str, ...] = ()
    more: dict[str, Any] = field(default_factory=dict)


_TRACKED_LIBRARY = ("track_tension", "station_bar", "time_offset")
CASES = (
    Golden("strut_friction_ref", "car", "single", ("strut_friction",), 1201, "newton", True),
    Golden("worn_dampers", "car", "single", ("worn_dampers",), 1202, "multibody", severity=5.0, drives=1),
    Golden("tyre_pressure_ref", "car", "single", ("tyre_pressure",), 1203, "newton", True, drives=1),
    Golden("tyre_envelope", "car", "single", ("tyre_envelope",), 1204, "multibody"),
    Golden("payload_ref", "car", "single", ("payload",), 1205, "newton", True, drives=1),
    Golden("mount_resonance_ref", "car", "single", ("mount_resonance",), 1206, "newton", True, drives=1),
    Golden("time_offset", "car", "single", ("time_offset",), 1207, "newton", drives=1),
    Golden("road_scale", "car", "single", ("road_scale",), 1208, "multibody", severity=5.0, drives=1),
    Golden("msd_unsprung_mass", "car", "single", ("unsprung_mass",), 1209, "newton", severity=5.0, msd=True),
    Golden("msd_bump_stop_ref", "car", "single", ("bump_stop",), 1210, "newton", True, msd=True, drives=1),
    Golden(
        "pair_payload_time_ref", "car", "pair", ("payload", "time_offset"), 1211, "newton", True, drives=1
    ),
    Golden(
        "pair_dampers_tyre", "car", "pair", ("worn_dampers", "tyre_pressure"), 1212, "newton", severity=5.0
    ),
    Golden("null_ref", "car", "null", (), 1213, "multibody", True, 0.0, drives=1),
    Golden("null_right", "car", "null", (), 1214, "newton", severity=0.0, right=True, drives=1),
    Golden("outside_loose_mass_ref", "car", "outside", ("loose_mass",), 1215, "newton", True, 5.0, drives=1),
    Golden("outside_gusts", "car", "outside", ("gusts",), 1216, "newton", severity=5.0, drives=1),
    Golden("planar_time_offset_ref", "planar", "single", ("time_offset",), 1217, "newton", True),
    Golden("planar_sensor_tilt", "planar", "single", ("sensor_tilt",), 1218, "newton", severity=5.0),
    Golden("tracked_tension_ref", "tracked", "single", ("track_tension",), 110, library=_TRACKED_LIBRARY),
    Golden("tracked_bar_ref", "tracked", "single", ("station_bar",), 111, library=_TRACKED_LIBRARY),
    Golden("rig_friction_ref", "rig", "single", ("strut_friction",), 21, reference=True),
    Golden("rig_payload", "rig", "single", ("payload",), 22),
    Golden("withheld_4", "withheld"),
    Golden("withheld_5", "withheld"),
)
SMOKE = (
    Golden(
        "smoke_rig",
        "rig",
        "single",
        ("strut_friction",),
        23,
        reference=True,
        library=("strut_friction", "payload"),
        more={"seconds": 5.0, "runs": ("random",)},
    ),
    Golden(
        "smoke_planar", "planar", "single", ("time_offset",), 1219, "newton", True, library=("time_offset",)
    ),
)


def make_all(folder: Path, cases: tuple[Golden, ...], tell: Callable[[str], None]) -> list[Item]:
    """Write the cases that are not there yet; a case that cannot be made is told and left out."""
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for case in cases:
        if not (folder / case.name / CASE).is_file():
            began = time.monotonic()
            with tempfile.TemporaryDirectory(prefix=".making_", dir=folder) as name:
                try:
                    bags, before = _MAKE[case.source](case, Path(name))
                except (FileNotFoundError, ImportError, ValueError) as error:
                    tell(f"{case.name} cannot be made: {error}")
                    continue
                about = {"source": case.source, "kind": case.kind, "made_with": list(case.effects)}
                asked = {"bags": bags, "reference": before, "effects": list(case.library), "seed": 0}
                target = Path(name) / case.name
                (target / CASE).write_text(json.dumps({**about, **asked}, indent=1) + "\n", encoding="utf-8")
                shutil.rmtree(folder / case.name, ignore_errors=True)
                target.rename(folder / case.name)
            tell(f"{case.name} made in {time.monotonic() - began:.0f} s")
        made.append(
            {"case": case.name, **json.loads((folder / case.name / CASE).read_text(encoding="utf-8"))}
        )
    return made


def _make_car(case: Golden, out: Path) -> tuple[list[str], list[str]]:
    """A car on a short road, or of one whose twin file has no road, by the simulators of ``blind/``."""
    from blind import folder, measured
    from blind.plan import Spec

    spec = Spec(
        case.name,
        case.kind,  # type: ignore[arg-type]
        case.effects,
        case.severity,
        case.seed,
        case.reality,
        reference=case.reference,
        right=case.right,
        msd=case.msd,
        scene="usual" if case.source == "planar" else "short",
        wide=True,
        planar=case.source == "planar",
    )
    (out / "sealed" / case.name).mkdir(parents=True)
    (measured if spec.planar else folder).make_case(spec, out, out / "sealed")
    return ["drive_fast", "drive_slow"][: case.drives], ["reference"] if case.reference else []


def _make_rig(case: Golden, out: Path) -> tuple[list[str], list[str]]:
    """Runs of a corner on a rig."""
    try:
        import rig
    except SystemExit as error:  # MuJoCo is missing
        raise ImportError(str(error)) from None

    folder = out / case.name
    rig.make(folder, case.seed, case.effects[0], case.more.get("seconds", 10.0))
    (folder / "answer.json").unlink()
    runs = case.more.get("runs", ("drops", "random"))
    return [f"gap/{run}.csv" for run in runs], ["reference/random.csv"] if case.reference else []


def _make_tracked(case: Golden, out: Path) -> tuple[list[str], list[str]]:
    """A run of a tracked vehicle with six tenths of the most that is believed of a fault, and one from before."""
    import numpy as np
    from tracked_cases import KINDS, SPEEDS, knob, specimen
    from tracked_reality import photogrammetry, simulate
    from tracked_runs import write_run

    kind, kmh = case.effects[0], 13
    rng = np.random.default_rng([case.seed, KINDS.index(kind)])
    vehicle = specimen(rng)
    turn = knob(kind, vehicle, rng)
    folder = out / case.name
    folder.mkdir()
    for name, made in (("before", turn(0.0)), ("after", turn(0.6))):
        motion = simulate(made.vehicle, kmh / 3.6 * (1 + rng.normal(0, 0.006)), SPEEDS[kmh], made.faults)
        camera = {"scale": made.camera.scale, "tilt": made.camera.tilt}
        late = made.camera.late + rng.normal(0, 0.008)
        table = photogrammetry(motion, int(rng.integers(1 << 30)), rate=50.0, late=late, **camera)
        (folder / name).mkdir()
        write_run(folder / name / f"{kmh:02d}kmh_1.csv", table)  # a run's speed is in its name
    shutil.copy(TRACKED / "pt91.yaml", folder / "twin.yaml")
    return [f"after/{kmh:02d}kmh_1.csv"], [f"before/{kmh:02d}kmh_1.csv"]


def _make_withheld(case: Golden, out: Path) -> tuple[list[str], list[str]]:
    """A copy of a withheld case."""
    source = WITHHELD / case.name
    if not (source / "twin.yaml").is_file():
        raise FileNotFoundError(f"{source} has no twin.yaml; SUSPENSION_TWIN_WITHHELD names the folder")
    shutil.copytree(source, out / case.name)
    for path in (out / case.name, *(out / case.name).rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)  # the source may be read only
    names = sorted(p.name for p in (out / case.name).iterdir() if p.is_dir())
    return [n for n in names if n.startswith("drive")], [n for n in names if n.startswith("reference")]


_MAKE = {
    "car": _make_car,
    "planar": _make_car,
    "rig": _make_rig,
    "tracked": _make_tracked,
    "withheld": _make_withheld,
}


# -- the answers ------------------------------------------------------------------------------------


def items_of(folder: Path, smoke: bool) -> dict[str, Callable[[], Item]]:
    """Everything that is captured, by name."""
    found = sorted(p.parent for p in folder.glob(f"*/{CASE}"))
    order = {case.name: n for n, case in enumerate((*CASES, *SMOKE))}
    found.sort(key=lambda p: order.get(p.name, len(order)))
    tiny = {case.name for case in SMOKE}
    cases = {p.name: _bound(_diagnosis, p) for p in found if not smoke or p.name in tiny}
    if not cases:
        raise SystemExit(f"{folder}: no case with a {CASE}; make them first")
    if smoke:
        return cases
    bump, road = ROOT / "bags" / "bump_15kmh", ROOT / "bags" / "crg_road"
    slow = (TRACKED / "runs" / "04kmh_1.csv",)
    free = ("stiffness", "bending_stiffness", "damping", "bending_damping")
    keys = (*(f"vehicle.track.{key}" for key in free), "vehicle.idler.setting")
    return {
        "live_bump_15kmh": _bound(_live, bump),
        "simulate_bump_15kmh": _bound(_simulation, bump),
        "simulate_crg_road": _bound(_simulation, road),
        "fast_bump_15kmh": _bound(_calibration, bump / "twin.yaml", (bump,), preset="fast"),
        "fast_crg_road": _bound(_calibration, road / "twin.yaml", (road,), preset="fast"),
        "paper_bump_15kmh": _bound(_calibration, bump / "twin.yaml", (bump,), preset="paper"),
        **cases,
        "tracked_paper": _bound(
            _calibration, TRACKED / "pt91.yaml", slow, preset="tracked_paper", free=keys, generations=8
        ),
    }


def _bound(work: Callable[..., Item], *given: Any, **named: Any) -> Callable[[], Item]:
    return lambda: work(*given, **named)


def _diagnosis(folder: Path) -> Item:
    """Verdict, causes and evidence of one case."""
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.run import diagnose

    asked = json.loads((folder / CASE).read_text(encoding="utf-8"))
    bags, before = (tuple(str(folder / b) for b in asked[k]) for k in ("bags", "reference"))
    request = DiagnosisRequest(
        twin=str(folder / "twin.yaml"),
        bags=bags,
        reference=before,
        seed=asked["seed"],
        effects=tuple(asked["effects"]),
    )
    result, times = _timed(lambda: diagnose(request))
    document, evidence = result.document, result.evidence
    causes = document["causes"]
    kept = ("probability", "combination", "candidates", "no_gap_probability", "unknown_probability")
    gaps = ("gap_before", "gap_after", "shrink", "shrink_interval", "unexplained", "message")
    rows: dict[str, Item] = {}
    for row in evidence["hypotheses"]:
        name = " + ".join(row["effects"]) + (" (decoy)" if row.get("decoy") else "")
        rows[name if name not in rows else f"{name} #{len(rows)}"] = _numbers(row)
    return {
        "what": "diagnosis",
        "verdict": document["verdict"],
        "top": causes[0]["effect"] if causes else "",
        "top_probability": causes[0]["probability"] if causes else 0.0,
        **{k: document.get(k) for k in (*kept, *gaps)},
        "warnings": list(result.warnings),
        "causes": {c["effect"]: c["probability"] for c in causes},
        "case": _numbers(evidence["case"]),
        "base": {**_numbers(evidence["base"]), "vehicle": evidence["base"].get("vehicle", {})},
        "rows": rows,
        **times,
    }


def _numbers(row: Item) -> Item:
    """The numbers of an evidence row, parameters by ``effect.name`` and the gap that is left in each channel."""
    out = {k: v for k, v in row.items() if k not in _LEFT_OUT and isinstance(v, (bool, int, float))}
    for effect, own in row.get("parameters", {}).items():
        for name, value in own.items():
            out[f"parameters.{effect}.{name}"] = value["value"] if isinstance(value, dict) else value
    for channel, gap in row.get("channels", {}).items():
        out[f"left.{channel}"] = gap.get("after", gap.get("gap"))
    return out


def _calibration(
    twin: Path, bags: tuple[Path, ...], preset: str, free: tuple[str, ...] = (), generations: int = 0
) -> Item:
    """Values with their intervals, and gaps before and after; 0 ``generations``: the preset's."""
    from suspension_twin.calibration.request import CalibrationRequest
    from suspension_twin.calibration.run import calibrate

    request = CalibrationRequest(
        twin=str(twin),
        bags=tuple(str(b) for b in bags),
        preset=preset,
        seed=0,
        free=free,
        max_generations=generations,
    )
    result, times = _timed(lambda: calibrate(request))
    return {
        "what": "calibration",
        "values": {e.key: [e.value, e.low, e.high, e.status] for e in result.estimates},
        "nuisances": {n.name: [n.value, n.sigma] for n in result.nuisances},
        "sensor": {s.key: [s.value, s.low, s.high] for s in result.sensor},
        "gaps": {d.name: [d.gap_before.rms, d.gap_after.rms] for d in result.drives},
        "cost": [result.initial_cost, result.cost],
        "distance": [result.initial_distance, result.distance],
        "evaluations": result.evaluations,
        **times,
    }


def _simulation(bag: Path) -> Item:
    """The gap of a bundled drive with its own twin file, by the command line."""
    command = [
        sys.executable,
        "-m",
        "suspension_twin",
        "simulate",
        "--twin",
        str(bag / "twin.yaml"),
        str(bag),
    ]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="golden_") as name:
        subprocess.run([*command, "--out", f"{name}/out"], check=True, stdout=subprocess.DEVNULL)
        gap = json.loads(Path(name, "out", "gap.json").read_text(encoding="utf-8"))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    times = {"processor_s": round(used, 3), "wall_s": round(time.monotonic() - began, 3)}
    return {"what": "simulation", "values": dict(_leaves(gap)), **times}


def _live(bag: Path) -> Item:
    """A drive played at full speed through the nodes in one process: what they publish, and their gap."""
    os.environ.setdefault("ROS_DOMAIN_ID", "88")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    import numpy as np

    from suspension_twin.drive.read import read_drive
    from suspension_twin.nodes.composed import Composed, Playback
    from suspension_twin.nodes.process import ros_context

    heard: dict[str, list[float]] = {"twin": [], "measured": []}
    drive = read_drive(bag)
    patient = ["--ros-args", "--log-level", "error", "-p", "max_backlog:=3600.0"]

    def hear(name: str, message: Any) -> None:
        heard[name].append(message.accel.linear.z)

    def play() -> float | None:
        with ros_context(patient) as context:
            composed = Composed(context, bag / "twin.yaml", "golden", Playback(drive, math.inf))
            for name, node, topic in (
                ("twin", "suspension_model", "twin/vertical_acceleration"),
                ("measured", "imu_ingest", "imu/vertical_acceleration"),
            ):
                outputs = composed.nodes[node].outputs[topic]
                outputs.links.append(partial(hear, name))
            while not composed.finished:
                composed.step()
            whole = composed.model.whole_gap()
            composed.close()
            return whole

    whole, times = _timed(play)
    values: Item = {"whole_gap": whole}
    for name, own in heard.items():
        series = np.array(own)
        values |= {
            f"{name}.messages": series.size,
            f"{name}.rms": float(np.sqrt(np.mean(series**2))),
            f"{name}.least": float(series.min()),
            f"{name}.most": float(series.max()),
        }
        values |= {f"{name}.{k}": float(series[k]) for k in range(0, series.size, 100)}
    return {"what": "live", "values": values, **times}


def _timed(work: Callable[[], Any]) -> tuple[Any, Item]:
    began, used = time.monotonic(), time.process_time()
    result = work()
    times = {"processor_s": time.process_time() - used, "wall_s": time.monotonic() - began}
    return result, {k: round(v, 3) for k, v in times.items()}


def capture(
    folder: Path, out: Path, only: list[str], again: bool, smoke: bool, tell: Callable[[str], None]
) -> Item:
    """Capture what is not in ``out`` yet, or with ``again`` everything asked for; written after each item."""
    from suspension_twin.errors import SuspensionTwinError

    known = json.loads(out.read_text(encoding="utf-8")) if out.is_file() else {}
    items = items_of(folder, smoke)
    if unknown := [name for name in only if name not in items]:
        raise SystemExit(f"--only: {', '.join(unknown)} is none of {', '.join(items)}")
    results: dict[str, Item] = known.get("items", {})
    for name in only or items:
        if name in results and not again:
            continue
        try:
            found = items[name]()
        except SuspensionTwinError as error:  # an answer as well
            found = {
                "what": "error",
                "error": str(error).replace(str(folder), ""),
                "processor_s": 0.0,
                "wall_s": 0.0,
            }
        found = _short(found)
        note = ""
        if name in results:
            apart = difference(results[name], found)
            note = "again the same" if apart.same_to_the_digit else f"again: {apart.text()}"
            if results[name]["what"] == found["what"]:
                least = {k: min(found[k], results[name][k]) for k in ("processor_s", "wall_s")}
                found = {**results[name], **least}
        results[name] = found
        _write(out, {"commit": _commit(), "cores": os.cpu_count(), "items": results})
        tell(f"{name:24s} {headline(found):60s} {found['processor_s']:7.1f} s of processor  {note}".rstrip())
    return {"items": {name: results[name] for name in only or items if name in results}}


def headline(found: Item) -> str:
    """The answer in a few words."""
    what = found["what"]
    if what == "error":
        return f"error: {found['error']}"
    if what == "diagnosis":
        return f"{found['verdict']}, {found['top']} {found['top_probability']:.3f}"
    if what == "calibration":
        gaps = ", ".join(f"{a:.4g} to {b:.4g}" for a, b in found["gaps"].values())
        return f"gap {gaps}; {found['evaluations']} evaluations"
    values = found["values"]
    if what == "live":
        return f"gap {values['whole_gap']:.4g}, rms {values['twin.rms']:.4g} and {values['measured.rms']:.4g}"
    return f"gap {values.get('channels.vertical_acceleration', values.get('rms', math.nan)):.4g}"


def _commit() -> str:
    run = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    return run.stdout.strip() or "unknown"


def _write(out: Path, content: Item) -> None:
    """One line an item, whole or not at all."""
    lines = [f"{json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in content["items"].items()]
    head = json.dumps({k: v for k, v in content.items() if k != "items"})[1:-1]
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_suffix(".part")
    part.write_text("{" + head + ', "items": {\n' + ",\n".join(lines) + "\n}}\n", encoding="utf-8")
    part.replace(out)


def _short(value: Any) -> Any:
    """The same with numbers of eight digits; what is not finite is None."""
    if isinstance(value, dict):
        return {str(k): _short(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_short(v) for v in value]
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return float(f"{float(value):.{_DIGITS}g}") if math.isfinite(value) else None


# -- the comparison ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Difference:
    """How far two answers to one item are apart. ``nats`` and ``where``: the largest of the evidence; ``tempered`` the
    largest of the tempered gains; ``relative`` and ``which``: the largest of all other numbers; ``sigma``: the largest
    of the calibrated values in halves of their intervals."""

    what: str
    words: tuple[str, ...] = ()
    nats: float = 0.0
    where: str = ""
    tempered: float = 0.0
    relative: float = 0.0
    which: str = ""
    sigma: float = 0.0
    probability: float = 0.0
    gap: float = 0.0
    same_to_the_digit: bool = True
    ratio: float = math.nan

    @property
    def another(self) -> bool:
        """Whether the answer is another one."""
        return bool(self.words) or self.nats > MOST_NATS

    def text(self) -> str:
        """All of it in one line."""
        if self.same_to_the_digit:
            return "the same"
        parts = list(self.words)
        if self.nats:
            parts.append(f"{self.nats:.3g} nats ({self.where}), tempered {self.tempered:.3g}")
        if self.probability:
            parts.append(f"probability {self.probability:.3g}")
        if self.sigma:
            parts.append(f"{self.sigma:.3g} of half an interval")
        if self.gap:
            parts.append(f"gap {100 * self.gap:.3g} %")
        if self.relative:
            parts.append(f"{100 * self.relative:.3g} % ({self.which})")
        return ", ".join(parts)


def difference(old: Item, new: Item) -> Difference:
    """Compare two captured items."""
    timeless = [{k: v for k, v in one.items() if k not in ("processor_s", "wall_s")} for one in (old, new)]
    found = Difference(new["what"], same_to_the_digit=timeless[0] == timeless[1])
    if old["processor_s"] > 0.0:
        found = replace(found, ratio=new["processor_s"] / old["processor_s"])
    if old["what"] != new["what"]:
        return replace(found, words=(f"{old['what']} became {new['what']}",))
    if new["what"] == "error":
        return found if found.same_to_the_digit else replace(found, words=("another error",))
    if new["what"] == "diagnosis":
        return _of_diagnoses(found, old, new)
    a, b = (dict(_leaves({k: v for k, v in one.items() if k not in ("what", "message")})) for one in timeless)
    relative, which = _furthest(a, b)
    sigma = gap = 0.0
    if new["what"] == "calibration":
        for key in old["values"].keys() & new["values"].keys():
            value, low, high, _ = old["values"][key]
            if low is not None and high is not None and high > low and new["values"][key][0] is not None:
                sigma = max(sigma, 2 * abs(new["values"][key][0] - value) / (high - low))
        pairs = [(old["gaps"][d], new["gaps"][d]) for d in old["gaps"].keys() & new["gaps"].keys()]
        gap = max((_apart(x, y) for p, q in pairs for x, y in zip(p, q, strict=True)), default=0.0)
    words = tuple(f"{n} {'is missing' if n in a else 'is new'}" for n in sorted(a.keys() ^ b.keys()))[:3]
    return replace(found, words=words, relative=relative, which=which, sigma=sigma, gap=gap)


def _of_diagnoses(found: Difference, old: Item, new: Item) -> Difference:
    words = [f"{k} {old[k]} became {new[k]}" for k in ("verdict", "top") if old[k] != new[k]]
    if old["combination"] != new["combination"] and not words:
        words.append(f"named {old['combination']} became {new['combination']}")
    rows = [{"base": one["base"], **one["rows"]} for one in (old, new)]
    lost, more = rows[0].keys() - rows[1].keys(), rows[1].keys() - rows[0].keys()
    nats, where, tempered = 0.0, "", 0.0
    for name in rows[0].keys() & rows[1].keys():
        for key in NATS:
            x, y = (r[name].get(key) for r in rows)
            if x is None or y is None:  # a key that one of the versions does not write
                continue
            apart = abs(y - x)
            tempered = max(tempered, apart) if key == "tempered_gain" else tempered
            if apart > nats:
                nats, where = apart, f"{name}: {key}"
    if lost or more:
        # sets of effects are those that the best single effects make: others may come and go
        single = [n for n in lost | more if " + " not in n]
        nats, where = (math.inf, f"{single[0]} came or went") if single else (nats, where)
        found = replace(found, which=f"sets that came or went: {', '.join(sorted(lost | more))}")
    probability = max(
        (abs(old["causes"].get(e, 0.0) - new["causes"].get(e, 0.0)) for e in old["causes"] | new["causes"]),
        default=0.0,
    )
    a, b = (
        dict(_leaves({"base": one["base"], "rows": one["rows"], "case": one["case"]})) for one in (old, new)
    )
    relative, which = _furthest(a, b, tuple(f".{k}" for k in NATS))
    gap = max((_apart(old[k], new[k]) for k in ("gap_before", "gap_after")), default=0.0)
    which = "; ".join(w for w in (which, found.which) if w)
    return replace(
        found,
        words=tuple(words),
        nats=nats,
        where=where,
        tempered=tempered,
        relative=relative,
        which=which,
        probability=probability,
        gap=gap,
    )


def _furthest(a: Item, b: Item, without: tuple[str, ...] = ()) -> tuple[float, str]:
    """Largest relative difference of two sets of numbers, and of which."""
    most, which = 0.0, ""
    for name in a.keys() & b.keys():
        apart = 0.0 if name.endswith(without or ("\0",)) else _apart(a[name], b[name])
        if apart > most:
            most, which = apart, name
    return most, which


def _apart(x: Any, y: Any) -> float:
    numbers = [v for v in (x, y) if isinstance(v, (int, float))]
    if len(numbers) < 2:
        return 0.0 if x == y else math.inf
    largest = max(abs(x), abs(y))
    return abs(x - y) / largest if largest else 0.0


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers of nested containers by dotted name."""
    inner = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    )
    if inner is not None:
        for key, one in inner:
            yield from _leaves(one, f"{name}.{key}" if name else str(key))
    elif isinstance(value, (int, float)) or value is None:
        yield name, value


def compare(old: Item, new: Item) -> Item:
    """The differences by item, and whether any is another answer."""
    shared = [n for n in old["items"] if n in new["items"]]
    if not shared:
        raise SystemExit("nothing is in both files")
    pairs = {n: difference(old["items"][n], new["items"][n]) for n in shared}
    total = [sum(one["items"][n]["processor_s"] for n in shared) for one in (old, new)]
    return {
        "pairs": pairs,
        "missing": [n for n in old["items"] if n not in new["items"]],
        "added": [n for n in new["items"] if n not in old["items"]],
        "another": [n for n, d in pairs.items() if d.another],
        "processor_ratio": total[1] / total[0] if total[0] else math.nan,
    }


def _print_comparison(console: Console, old: Item, new: Item, found: Item) -> None:
    title = f"{old.get('commit')} against {new.get('commit')}"
    table = Table(title=title, title_justify="left", title_style="bold")
    for name in ("item", "answer", "nats", "tempered", "where", "gap", "other numbers", "time"):
        table.add_column(name, justify="right" if name in ("nats", "tempered", "gap", "time") else "left")
    for name, d in found["pairs"].items():
        answer = (
            "same digits"
            if d.same_to_the_digit
            else "; ".join(d.words) or ("other evidence" if d.another else "same")
        )
        of_values = f"{100 * d.relative:.2g} % {d.which}" if d.relative else d.which
        if d.what == "calibration":
            of_values = f"{d.sigma:.2g} of half an interval; {of_values}"
        diagnosed = d.what == "diagnosis"
        table.add_row(
            name,
            f"[red]{answer}[/]" if d.another else answer,
            f"{d.nats:.2g}" if diagnosed else "",
            f"{d.tempered:.2g}" if diagnosed else "",
            d.where,
            f"{100 * d.gap:.2g} %" if d.what in ("diagnosis", "calibration") else "",
            of_values if not d.same_to_the_digit else "",
            f"{d.ratio:.2f}",
        )
    console.print(table)
    for name in ("missing", "added"):
        if found[name]:
            console.print(f"{name}: {', '.join(found[name])}")
    console.print(f"processor time, new over old, all together: {found['processor_ratio']:.3f}")
    if found["another"]:
        console.print(f"Other answers: {', '.join(found['another'])}")
    else:
        console.print("The answers are the same.")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    stages = parser.add_subparsers(dest="stage", required=True)
    making = stages.add_parser("make", help="write the cases")
    making.add_argument("folder", type=Path)
    making.add_argument("--smoke", action="store_true", help="two tiny cases")
    taking = stages.add_parser("capture", help="keep the answers of this version")
    taking.add_argument("folder", type=Path)
    taking.add_argument("--out", type=Path, required=True, metavar="FILE")
    taking.add_argument("--only", nargs="+", default=[], metavar="NAME", help="items by name")
    taking.add_argument(
        "--again", action="store_true", help="also what is in FILE; says where it is not the same"
    )
    taking.add_argument("--smoke", action="store_true", help="the two tiny cases")
    comparing = stages.add_parser("compare", help="compare two files of answers")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    for stage in (making, taking, comparing):
        stage.add_argument("--json", action="store_true", help="one JSON object on standard output")
    return parser.parse_args()


def main() -> int:
    """Make, capture or compare."""
    options = parsed()
    console = Console(highlight=False)

    def tell(text: str) -> None:
        print(text, file=sys.stderr if options.json else sys.stdout, flush=True)

    if options.stage == "make":
        made = make_all(options.folder.resolve(), SMOKE if options.smoke else CASES, tell)
        if options.json:
            print(json.dumps(made))
        return 0
    if options.stage == "capture":
        found = capture(
            options.folder.resolve(), options.out, options.only, options.again, options.smoke, tell
        )
        if options.json:
            rows = {n: {"headline": headline(i), **i} for n, i in found["items"].items()}
            print(json.dumps({n: {k: v for k, v in r.items() if k != "rows"} for n, r in rows.items()}))
        else:
            total = sum(i["processor_s"] for i in found["items"].values())
            tell(f"{len(found['items'])} items, {total:.0f} s of processor, in {options.out}")
        return 0
    old, new = (json.loads(p.read_text(encoding="utf-8")) for p in (options.old, options.new))
    found = compare(old, new)
    if options.json:
        pairs = {
            n: {**_short(vars(d)), "words": list(d.words), "another": d.another}
            for n, d in found["pairs"].items()
        }
        print(json.dumps({**_short({k: v for k, v in found.items() if k != "pairs"}), "pairs": pairs}))
    else:
        _print_comparison(console, old, new, found)
    return 1 if found["another"] else 0


if __name__ == "__main__":
    sys.exit(main())
