#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Makes what the documentation shows of the program itself.

    python docs/make_docs.py tables [PAGE...]
    python docs/make_docs.py pictures [NAME...]

``tables`` writes the generated parts, each between its marks: commands in commands.md, nodes, topics, services,
actions and message definitions in interfaces.md, effects in effects.md, figures of kept results in
diagnosis_figures.md and tracked.md; of all these pages, or of those that are named: ``tables effects`` needs no ROS. A
test says when one has fallen behind.
``pictures`` draws the pictures of this folder, or those that are named (demo, effects, damping, diagnosis, plan, rig);
all of them take some minutes.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
INTERFACES = ROOT / "suspension_twin_interfaces"
PICTURES = {"bump_time": "bump.png", "characteristics": "characteristics.png"}
#: What each node does, in a few words.
DOES = {
    "imu_ingest": "axes, biases and units of the IMU; low-pass",
    "pose_injector": "GPS, or another program's pose, and gyroscope to a smooth pose at the IMU's rate; that of a poor "
    "receiver is moved to where the road is felt",
    "suspension_model": "the twin along that pose over the road; the gap",
    "calibrator": "calibration and diagnosis of recorded drives",
    "source": "live phones, receivers and IMUs ([sources](sources.md)); only where it is given sources",
    "road_learner": "the road, learnt while driving; only with `--learn-road`",
}
_BASE = "`base_link`"
#: Frame and content of each topic, with units.
CARRIES = {
    "imu/data_raw": (
        "`imu.frame` of the twin file",
        "specific force m/s², angular rate rad/s, the sensor's axes",
    ),
    "imu/data": (
        _BASE,
        "specific force m/s² and angular rate rad/s without biases, low-passed, gravity kept",
    ),
    "imu/vertical_acceleration": (_BASE, "`accel.linear.z` m/s², gravity removed, low-passed"),
    "fix": (
        "`gps.frame` of the twin file",
        "latitude and longitude in degrees, altitude in m (WGS 84), covariance m²",
    ),
    "vel": ("any frame", "`twist.linear` m/s: x east, y north, z up"),
    "heading": ("any frame", "optional; yaw of the vehicle from east, counter-clockwise"),
    "odom": (
        "`map`, child `base_link` or a sensor's",
        "in place of `fix`, `vel` and `heading`: pose m, speeds m/s in the child's axes; covariances",
    ),
    "pose": ("`map`", "in place of `fix`: `base_link` in a game engine or a motion capture, m"),
    "transform": ("`map`, child `base_link` or a sensor's", "in place of `fix`, as a transform"),
    "fix_velocity": ("any frame", "in place of `vel`: m/s, x east, y north; covariance"),
    "twin/odom": (
        "`map`, child `base_link`",
        "pose m and speed m/s, locked to the vehicle in x, y and yaw; covariance, along the road that of a felt place",
    ),
    "twin/vertical_acceleration": (
        _BASE,
        "`accel.linear.z` m/s² at the IMU's place, gravity removed, low-passed",
    ),
    "twin/imu": ("`imu.frame`", "what the IMU would have measured on the twin: m/s², rad/s; unfiltered"),
    "twin/pose": ("`map`", "`base_link` of the twin, m"),
    "joint_states": (
        "",
        "compression from the spring's free length, m and m/s (arms of a tracked vehicle: rad, rad/s)",
    ),
    "tf": ("`map`", "`base_link`, and in it the frames of the wheels (`front_left_wheel`, ...), m"),
    "twin/gap": (
        _BASE,
        "rms of measured minus simulated over a sliding window, m/s², in all and by frequency band",
    ),
    "twin/gap_marker": ("`map`", "the gap on the road, a tile a metre, green to red"),
    "twin/road": ("`map`", "the road within 8 m of the vehicle as points, m; every 2 m"),
    "tf_static": (_BASE, "`imu_link` and `gps_link`"),
    "robot_description": ("", "URDF of the vehicle, with the joints of `joint_states`"),
}
#: Models of an effect that names none on its page.
_USUAL_MODELS = ("full_car", "quarter_car")
#: Meaning of a parameter ``corner``, which effects.md says once.
CORNERS = "0 front left, 1 front right, 2 rear left, 3 rear right"
#: Titles of the sections of effects.md, by where an effect acts.
WHERE = {
    "strut": "In the struts",
    "tyre": "In the tyres",
    "track": "In the track",
    "body": "In the body",
    "sensor": "In the sensor",
    "time": "In the clocks",
    "road": "In the road file",
}


def parts() -> dict[Path, dict[str, Callable[[], str]]]:
    """Makers of the generated parts, by the page and the name of their mark."""
    return {
        HERE / "commands.md": {"commands": commands},
        HERE / "interfaces.md": {
            "nodes": nodes,
            "topics": topics,
            "calls": calls,
            "definitions": definitions,
        },
        HERE / "effects.md": {"effects": effects},
        HERE / "diagnosis_figures.md": {"figures": figures},
        HERE / "tracked.md": {"tracked": tracked},
    }


def brought_up_to_date(page: Path) -> str:
    """The text of a page with its generated parts as the program declares them now."""
    text = page.read_text(encoding="utf-8")
    for name, make in parts()[page].items():
        begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
        if text.count(begin) != 1 or text.count(end) != 1:
            raise SystemExit(f"{page.name}: the marks of {name} are missing")
        text = text[: text.index(begin) + len(begin)] + make() + text[text.index(end) :]
    return text


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    lines = [list(heads), *map(list, rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def commands() -> str:
    """The subcommands of ``suspension-twin``."""
    from suspension_twin.cli.main import subcommands

    return table(
        ["command", "what it does"], [[f"`suspension-twin {row.name}`", row.help] for row in subcommands()]
    )


# -- nodes ---------------------------------------------------------------------------------------


def _node_classes() -> dict[str, Any]:
    from suspension_twin.addons.nodes.road_learner import RoadLearnerNode
    from suspension_twin.addons.nodes.source import SourceNode
    from suspension_twin.nodes.calibrator import CalibratorNode
    from suspension_twin.nodes.imu_ingest import ImuIngestNode
    from suspension_twin.nodes.pose_injector import PoseInjectorNode
    from suspension_twin.nodes.suspension_model import SuspensionModelNode

    return {
        "imu_ingest": ImuIngestNode,
        "pose_injector": PoseInjectorNode,
        "suspension_model": SuspensionModelNode,
        "calibrator": CalibratorNode,
        "source": SourceNode,
        "road_learner": RoadLearnerNode,
    }


#: Nodes that do not start without a parameter.
_NEEDED = {"source": ("sources", "sensorlogger://127.0.0.1:0"), "road_learner": ("out", "road.crg")}


def _graph() -> dict[str, dict[str, list[tuple[str, str]]]]:
    """Of each node its own ``in`` and ``out`` topics, ``services`` and ``actions``, each with its type."""
    import rclpy
    from rclpy.action.graph import get_action_server_names_and_types_by_node
    from rclpy.utilities import try_shutdown

    found = {}
    rclpy.init(args=[])
    try:
        for name, kind in _node_classes().items():
            node = _make(name, kind)
            served = get_action_server_names_and_types_by_node(node, name, "/")
            found[name] = {
                "latched": [(p.topic, "") for p in node.publishers if _latched(p)],
                "in": [(s.topic, _type(s.msg_type)) for s in node.subscriptions if _own(s.topic)],
                "out": [(p.topic, _type(p.msg_type)) for p in node.publishers if _own(p.topic)],
                "services": [
                    (s.srv_name, _type(s.srv_type)) for s in node.services if s.srv_name.startswith("~")
                ],
                "actions": [(action.removeprefix("/"), types[0]) for action, types in served],
            }
            node.destroy_node()
    finally:
        try_shutdown()
    return found


def _make(name: str, kind: Any) -> Any:
    from rclpy.parameter import Parameter

    from suspension_twin.nodes.topics import Embedding

    needed = [_NEEDED[name]] if name in _NEEDED else []
    return kind(Embedding(parameters=tuple(Parameter(key, value=value) for key, value in needed)))


def _own(topic: str) -> bool:
    """Whether a topic is not one that every node has."""
    return not re.search(r"/(rosout|clock|parameter_events|diagnostics)$|/_action/", topic)


def _latched(publisher: Any) -> bool:
    from rclpy.qos import DurabilityPolicy

    return bool(publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def _type(kind: type) -> str:
    package, group, *_ = kind.__module__.split(".")
    return f"{package}/{group}/{kind.__name__}"


def _topic(name: str) -> str:
    return f"`{name if name.startswith('/tf') else name.removeprefix('/')}`"


def nodes() -> str:
    """The nodes, each with what it does."""
    return "".join(f"- `{name}`: {DOES[name]}\n" for name in _node_classes())


def topics() -> str:
    """Every topic with its type, the nodes at both of its ends, its frame, and its content; inputs first."""
    kinds: dict[str, str] = {}
    latched: set[str] = set()
    ends: dict[str, tuple[list[str], list[str]]] = {}
    for name, of in _graph().items():
        latched |= {topic for topic, _ in of["latched"]}
        for side, way in enumerate(("in", "out")):
            for topic, kind in of[way]:
                kinds[topic] = kind
                ends.setdefault(topic, ([], []))[side].append(name)
    inputs: list[str] = []
    outputs: list[str] = []
    for topic, kind in kinds.items():
        into, out = (", ".join(f"`{n}`" for n in names) for names in ends[topic])
        frame, content = CARRIES[topic.removeprefix("/")]
        way = f" → {into}" if out in ("", "`source`") else f", {out}{' → ' + into if into else ''}"
        said = (
            f"- {_topic(topic)} `{kind.replace('/msg', '')}`{way}{', latched' if topic in latched else ''}. "
        )
        (inputs if out in ("", "`source`") else outputs).append(
            f"{said}{frame + ': ' if frame else ''}{content}\n"
        )
    return (
        f"\nFrom sensors, or the node `source`:\n\n{''.join(inputs)}\nFrom the nodes:\n\n{''.join(outputs)}\n"
    )


def calls() -> str:
    """Services and actions."""
    text = ""
    for name, of in _graph().items():
        for what in ("services", "actions"):
            text += "".join(f"- {what[:-1]} `{call}` of `{name}`: `{kind}`\n" for call, kind in of[what])
    return text


def definitions() -> str:
    """The project's own messages, services and actions with the first line of their files."""
    text = ""
    for folder in ("msg", "srv", "action"):
        for path in sorted((INTERFACES / folder).glob(f"*.{folder}")):
            says = path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ")
            text += f"- [`{path.stem}`](../{path.relative_to(ROOT).as_posix()}): {says}\n"
    return text


# -- figures -------------------------------------------------------------------------------------

RESULTS = ROOT / "benchmarks" / "results"
#: Columns of the figures of the diagnosis after those that were learnt: the results of each.
ASKED = {"fresh": ("blind_report4", "blind_flexible", "blind_measured"), "latest": ("blind_report5",)}
#: Figure, its name in train_decision.json, its names in blind_*.json, what is wanted.
FIGURES = (
    ("single effects of severity 1.3 and above: named for sure", "single_named", ("top1",), "95 %"),
    ("the same, sure or suspected", "single_named_or_suspected", ("sure_or_suspected",), "97 %"),
    ("the same, ranked first", "single_first", ("top1_ranked",), ""),
    ("suspected wrongly, of all suspected", "suspected_wrong", ("suspected_wrong",), "15 %"),
    ("a wrong cause named for sure, of all answers", "wrong_name", ("wrong_name",), "1.5 %"),
    ("no effect: no gap or recalibration", "null_no_gap", ("null_no_gap",), "97 %"),
    ("recalibration: springs and dampers in the right direction", "", ("recalibration_direction",), "95 %"),
    ("no effect: a cause named", "null_named", ("false_alarms",), "1 %"),
    (
        "outside the library, or taken out: unknown",
        "outside_unknown",
        ("unknown_outside", "unknown_excluded"),
        "85 to 90 %",
    ),
    ("pairs exact", "pair_exact", ("pairs_exact",), "80 %"),
    ("candidate set holds a right answer", "coverage", (), "88 to 93 %"),
    ("shrink inside its 90 % interval", "", ("shrink_in_interval",), "85 to 95 %"),
    ("parameters inside their 90 % interval", "", ("parameter_in_interval",), "85 to 95 %"),
)


def figures() -> str:
    """How often a diagnosis was right, from the kept results."""
    learnt = json.loads((RESULTS / "train_decision.json").read_text(encoding="utf-8"))
    asked = {
        column: [
            json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))["figures"] for name in names
        ]
        for column, names in ASKED.items()
    }
    rows = []
    for text, own, names, wanted in FIGURES:
        counted = [[learnt[own]] if own else []]
        for results in asked.values():
            some = [result[name] for result in results for name in names if name in result]
            counted.append([(one["value"], one["n"]) for one in some if one["n"]])
        rows.append([text, *map(_counted, counted), wanted])
    return table(["", "learnt", *asked, "wanted"], rows)


def _counted(shares: list[Any]) -> str:
    """``p % (k/n)`` of shares and what each is a share of."""
    n = sum(n for _, n in shares)
    k = sum(round(share * n) for share, n in shares)
    return f"{100 * k / n:.{0 if 5 * k > n else 1}f} % ({k}/{n})" if n else ""


def tracked() -> str:
    """Every answer to the sealed runs of the tracked vehicle, by fault and size, from the kept results."""
    from suspension_twin.effects.registry import EFFECTS

    kept = json.loads((RESULTS / "tracked_blind.json").read_text(encoding="utf-8"))["reporting"]
    found: dict[str, list[str]] = {}
    for row in kept["rows"]:
        if row["kind"] == "none":
            continue
        effect = EFFECTS[row["kind"]].on("tracked")
        name = next(name for name in effect.severity if name in row)
        unit = effect.parameter(name).unit
        said = ", ".join(f"`{cause}`" for cause in row["named"]) or row["verdict"].replace("_", " ")
        if row["verdict"] == "suspected":
            said += " suspected"
        if row["outcome"] == "right":
            value, true = (f"{float(f'{v:.2g}'):g}" for v in (row["own"][name], row[name]))
            said = f"**{said}** {value} ({true}){'' if unit in ('', '1') else f' {unit}'}"
        found.setdefault(f"`{row['kind']}`", []).append(said)
    heads = ["fault", *(f"{size:g} floors" for size in kept["severities"])]
    text = table(heads, ([kind, *cells] for kind, cells in found.items()))
    right = f"{kept['right']} of {kept['cases']} right, in bold with what was said and the true size"
    return f"{text}\nBy commit {kept['commit'][:8]}: {right}.\n"


# -- effects -------------------------------------------------------------------------------------


def effects() -> str:
    """Every effect as it describes itself, by where it acts."""
    from suspension_twin.effects.registry import EFFECTS

    text = ""
    for where, title in WHERE.items():
        own = [_effect(e) for e in EFFECTS.values() if e.where == where]
        text += f"\n## {title}\n" + "".join(own) if own else ""
    return text + "\n"


def _effect(e: Any) -> str:
    from suspension_twin.diagnosis.library import DECOYS

    decoy = " A [decoy hypothesis](diagnosis.md#decoy-hypotheses)." if e.id in DECOYS else ""
    title = "" if e.title.replace("-", " ") == e.id.replace("_", " ") else f": {e.title}"
    models = "" if e.models == _USUAL_MODELS else f" Models: {', '.join(f'`{m}`' for m in e.models)}."
    return (
        f"\n### `{e.id}`{title}\n\n{e.doc}\n\n{''.join(_lines(e))}\n"
        f"Excited by: {'; '.join(e.excited_by)}. Confused with: {'; '.join(e.confused_with)}."
        f"{models}{_common(e)}{decoy}{_variants(e)}\n"
    )


def _lines(e: Any) -> Iterable[str]:
    """A line for each parameter; front and rear share one where they differ in nothing but the axle."""
    given = {p.name: p for p in e.parameters}
    for name, p in given.items():
        rear = given.get(name.replace("front", "rear"), p)
        front = given.get(name.replace("rear", "front"), p)
        if rear is not p and _size(rear) == _size(p):
            both = re.sub(r", front$|\bfront ", "", p.doc)
            yield f"- {_name(e, p)}, {_name(e, rear)} {_size(p)}: {both}\n"
        elif (front is p or _size(front) != _size(p)) and p.doc != CORNERS:
            yield f"- {_parameter(e, p)}\n"


def _variants(e: Any) -> str:
    """In which parameters an effect differs on other models, but for axle and corner of a single corner."""
    text, base = "", {p.name: p for p in e.parameters}
    for model, variant in e.variants.items():
        own = {p.name: p for p in variant.parameters}
        missing = [f"`{name}`" for name in base if name not in own and not re.match("rear|corner", name)]
        parts = [f"without {', '.join(missing)}"] * bool(missing)
        parts += [_parameter(e, p) for name, p in own.items() if p != base.get(name)]
        text += f" On `{model}`: {'; '.join(parts)}." if parts else ""
    return text


def _common(e: Any) -> str:
    """What of an effect any vehicle has: no finding."""
    if e.usual_share:
        return f" Up to {100 * e.usual_share:g} % of the mass is normal."
    usual = next((p for p in e.parameters if p.prior.usual), None)
    return "" if usual is None else f" Up to {usual.prior.usual:g} {usual.unit or 'of change'} is normal."


def _name(e: Any, p: Any) -> str:
    return f"**`{p.name}`**" if p.name in e.severity else f"`{p.name}`"


def _size(p: Any) -> str:
    """Unit, range, prior, and the value of a parameter that is not given where that is not 0."""
    prior = f"{p.prior.typical:g} {'×/÷' if p.prior.log else '±'} {round(p.prior.spread, 4):g}"
    neutral = [f"neutral {p.neutral:g}"] if p.neutral else []
    return ", ".join(
        [p.unit] * bool(p.unit) + [f"[{p.lower:g}, {p.upper:g}]"] + [prior] * (not p.choices) + neutral
    )


def _parameter(e: Any, p: Any) -> str:
    return f"{_name(e, p)} {_size(p)}: {p.doc}"


# -- pictures ------------------------------------------------------------------------------------


def demo_pictures() -> None:
    """Run the demo as its command does and keep two of its figures."""
    from suspension_twin.cli.common import bundled
    from suspension_twin.demo.page import figures
    from suspension_twin.demo.steps import run_demo
    from suspension_twin.report import style

    class Quiet:
        def begin(self, text: str) -> None:
            print(text, flush=True)

        def share(self, done: float, note: str = "") -> None:
            pass

        def end(self, text: str) -> None:
            print(f"  {text}", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        drawn = figures(run_demo(bundled("bags"), Path(folder), Quiet()))
    for name, file in PICTURES.items():
        style.save(drawn[name], HERE / file, dpi=130)


def effects_picture() -> None:
    """What each effect of a car changes of the vertical acceleration over the bundled speed bump, by frequency."""
    import numpy as np

    from suspension_twin.drive.read import read_drive
    from suspension_twin.effects.registry import EFFECTS
    from suspension_twin.inference.observation import observe, road_of
    from suspension_twin.models.simulate import simulate_twin
    from suspension_twin.report import style
    from suspension_twin.signals.spectra import power_density
    from suspension_twin.vehicle.twin import EffectSpec, load_twin

    twin = load_twin(ROOT / "bags" / "bump_15kmh" / "truth.yaml")
    prepared = observe(read_drive(ROOT / "bags" / "bump_15kmh"), twin, road_of(twin))
    edges = 0.5 * 2.0 ** (0.5 * np.arange(12))  # Hz

    def bands(taken: Any, *given: EffectSpec) -> Any:
        response = simulate_twin(twin.model_copy(update={"effects": given}), prepared.road_excitation)
        f, density = power_density(
            prepared.condition(response)["vertical_acceleration"] - taken, prepared.rate, 4.0
        )
        return np.array([density[(f >= a) & (f < b)].mean() for a, b in zip(edges, edges[1:], strict=False)])

    undisturbed = prepared.condition(simulate_twin(twin, prepared.road_excitation))["vertical_acceleration"]
    motion, rows = bands(0.0), {}
    for name, e in EFFECTS.items():
        if "full_car" not in e.models:
            continue
        values = {p.name: _typical(p, p.name in e.severity) for p in e.parameters}
        rows[name] = np.sqrt(bands(undisturbed, EffectSpec(id=name, parameters=values)) / motion)
    names = sorted(rows, key=lambda n: float(np.average(np.arange(11), weights=rows[n] + 1e-9)))
    shares = np.clip([rows[n] for n in names], 1e-3, None)
    with style.using():
        fig = style.figure(8.0, 6.2)
        axes = fig.subplots()
        drawn = axes.imshow(np.log10(shares), aspect="auto", cmap="viridis", vmin=-2.0, vmax=0.0)
        centres = np.sqrt(edges[1:] * edges[:-1])
        axes.set_xticks(range(len(centres))[::2], [f"{c:.2g}" for c in centres[::2]])
        axes.set_yticks(range(len(names)), names)
        axes.set_xlabel("frequency [Hz]")
        axes.grid(False)
        bar = fig.colorbar(drawn, ticks=[-2, -1, 0], label="change as a share of the motion in the band")
        bar.ax.set_yticklabels(["0.01", "0.1", "1"])
    style.save(fig, HERE / "effects.png", dpi=110)


def _typical(p: Any, severe: bool) -> float:
    """A typical value of an effect's parameter: one standard deviation of its prior where the mean is neutral."""
    if p.choices:
        return float(p.choices[0])
    prior = p.prior
    value = (
        prior.typical + prior.spread
        if severe and not prior.log and prior.typical == p.neutral
        else prior.typical
    )
    return float(min(max(value, p.lower), p.upper))


def damping_picture() -> None:
    """Variance of the pitch over speed for the seven dampings of the tracked paper, as the command draws it."""
    twin = ROOT / "config" / "tracked" / "pt91.yaml"
    with tempfile.TemporaryDirectory() as folder:
        _run("-m", "suspension_twin", "damping", "--twin", str(twin), "--out", folder)
        shutil.copy(Path(folder) / "pitch_variance.png", HERE / "tracked_damping.png")


def diagnosis_picture() -> None:
    """Probabilities, and the gap before and after, of a development case of ``benchmarks/blind.py``: dry friction."""
    wanted = "--full --seeds dev --only strut_friction --severity 5 --limit 2 --stage generate --out"
    with tempfile.TemporaryDirectory() as folder:
        _run("benchmarks/blind.py", *wanted.split(), folder)
        case = next(p for p in (Path(folder) / "cases").iterdir() if (p / "reference").is_dir())
        answer, drives = Path(folder) / "answer", [str(case / d) for d in ("drive_fast", "drive_slow")]
        given = [
            "--twin",
            str(case / "twin.yaml"),
            "--reference",
            str(case / "reference"),
            "--out",
            str(answer),
        ]
        _run("-m", "suspension_twin", "diagnose", *given, *drives)
        draw_diagnosis(case, answer)


def draw_diagnosis(case: Path, answer: Path) -> None:
    """Bars of the likeliest answers beside the density of the gap."""
    from suspension_twin.drive.read import read_drive
    from suspension_twin.inference.observation import observe
    from suspension_twin.models.simulate import simulate_twin
    from suspension_twin.report import style
    from suspension_twin.signals.spectra import power_density
    from suspension_twin.vehicle.twin import load_twin

    document = json.loads((answer / "diagnosis.json").read_text(encoding="utf-8"))
    answers = [(c["effect"], c["probability"]) for c in document["causes"][:5]]
    answers += [("no gap", document["no_gap_probability"]), ("unknown", document["unknown_probability"])]
    prepared = observe(read_drive(case / "drive_fast"), load_twin(case / "twin.yaml"))
    measured = prepared.measured["vertical_acceleration"]
    series = {"motion": ("measured", measured)}
    for label, role, twin in (
        ("gap before", "before", case),
        ("gap with the cause added", "simulated", answer),
    ):
        response = simulate_twin(load_twin(twin / "twin.yaml"), prepared.road_excitation)
        series[label] = (role, prepared.condition(response)["vertical_acceleration"] - measured)
    with style.using():
        fig = style.figure(8.6, 2.9)
        left, right = fig.subplots(1, 2, width_ratios=(1, 1.4))
        names, values = zip(*reversed(answers), strict=True)
        left.barh(names, values, color=style.colour("simulated"), height=0.6)
        left.set_xlim(0, 1)
        left.set_xlabel("probability")
        for label, (role, signal) in series.items():
            f, density = power_density(signal[prepared.mask], prepared.rate)
            right.loglog(f[1:], density[1:], color=style.colour(role), label=label)
        right.set_xlim(0.5, 25.0)
        right.set_ylim(1e-5, None)
        right.set_xlabel("frequency [Hz]")
        right.set_ylabel("density [m²/s⁴/Hz]")
        right.legend()
    style.save(fig, HERE / "diagnosis.png", dpi=130)


def plan_picture() -> None:
    """The smallest sizes that two drives over the bundled bump could show."""
    from suspension_twin.addons.plan.page import sizes_picture
    from suspension_twin.addons.plan.plan import plan
    from suspension_twin.report import style
    from suspension_twin.vehicle.twin import load_twin

    found = plan(load_twin(ROOT / "bags" / "bump_15kmh" / "twin.yaml"))
    style.save(sizes_picture(found.detectability), HERE / "plan.png", dpi=110)


def rig_picture() -> None:
    """A drop of the bundled rig: the body as measured and as its twin has it, calibrated on the other run or not."""
    from suspension_twin.drive.rig import read_rig
    from suspension_twin.inference.runs import simulate_rig
    from suspension_twin.report import style
    from suspension_twin.vehicle.twin import load_twin

    twin, runs = ROOT / "config" / "twins" / "quarter_car.yaml", ROOT / "config" / "rig"
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "found.yaml"
        options = ["--twin", str(twin), str(runs / "random.csv"), "--out", str(found)]
        _run("-m", "suspension_twin", "calibrate", *options)
        twins = {"before": load_twin(twin), "simulated": load_twin(found)}
    results = {role: simulate_rig(read_rig(runs / "drops.csv"), one) for role, one in twins.items()}
    seen = results["before"].observation
    name = next(iter(seen.measured))
    series = {"measured": ("measured", seen.measured[name])}
    for role, label in (("before", "twin as written"), ("simulated", "calibrated on another run")):
        series[label] = (role, seen.apply(results[role].response.channel(name)[:, 0]))
    with style.using():
        fig = style.figure(8.6, 2.6)
        axes = fig.subplots()
        for label, (role, signal) in series.items():
            line = {**style.LINES[role], **({"linewidth": 4.0, "alpha": 0.5} if role == "measured" else {})}
            axes.plot(seen.t, signal, color=style.colour(role), label=label, **line)
        axes.set_xlim(2.9, 3.7)
        axes.set_ylim(-8.5, 2.5)
        axes.set_xlabel("time [s]")
        axes.set_ylabel("body acceleration [m/s²]")
        axes.legend(loc="lower right")
    style.save(fig, HERE / "quarter_car.png", dpi=130)


def _run(*arguments: str) -> None:
    subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True)


#: What draws the pictures of the documentation, as commands and benchmarks make them.
PAINTERS = {
    "demo": demo_pictures,
    "effects": effects_picture,
    "damping": damping_picture,
    "diagnosis": diagnosis_picture,
    "plan": plan_picture,
    "rig": rig_picture,
}


def main() -> None:
    wanted, named = sys.argv[1:2], sys.argv[2:]
    pages = {page.stem: page for page in parts()}
    if wanted == ["tables"] and set(named) <= pages.keys():
        for name in named or pages:
            pages[name].write_text(brought_up_to_date(pages[name]), encoding="utf-8")
    elif wanted == ["pictures"] and set(named) <= PAINTERS.keys():
        for name in named or PAINTERS:
            PAINTERS[name]()
    else:
        raise SystemExit((__doc__ or "").strip())


if __name__ == "__main__":
    main()
