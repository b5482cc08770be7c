# SPDX-License-Identifier: Apache-2.0
"""The blind benchmark: its plan, its two realities against mechanics, its seal and its figures."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import cut
from suspension_twin.drive.write import write_drive
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.vehicle.twin import load_twin

CONTRACT = (
    "strut_friction",
    "bump_stop",
    "rebound_stop",
    "top_mount",
    "anti_roll_bar",
    "damper_fade",
    "corner_damper",
    "corner_spring",
    "tyre_damping",
    "tyre_envelope",
    "unsprung_mass",
    "payload",
    "body_bending",
    "powertrain_mount",
    "mount_resonance",
    "sensor_offset",
    "sensor_tilt",
    "sensor_bandwidth",
    "sensor_clipping",
    "sensor_scale",
    "time_offset",
    "clock_drift",
    "road_scale",
    "road_smoothing",
    "position_offset",
    "lateral_offset",
)


@pytest.fixture(scope="module")
def world() -> Any:
    """A world whose fast drive ends after 12 s, so that a run takes a blink."""
    from blind.world import make_world

    made = make_world(1003)
    whole = made.plans["drive_fast"]
    short = replace(whole, speed=whole.speed[:1200], push=whole.push[:1200])
    return replace(made, plans={"drive_fast": short})


def test_every_effect_of_the_contract_comes_at_three_severities_in_both_realities() -> None:
    from blind.plan import plan

    cases = [c for c in plan("report") if c.kind == "single"]
    seen = {(c.effects[0], c.severity, c.reality) for c in cases}
    assert seen == {(e, s, r) for e in CONTRACT for s in (0.5, 1.5, 5.0) for r in ("newton", "multibody")}
    assert set(CONTRACT) <= set(EFFECTS)


def test_nothing_outside_the_library_is_in_it_when_its_cases_are_diagnosed() -> None:
    from blind.plan import plan

    outside = [c for c in plan("report") if c.kind == "outside"]
    assert len({c.effects for c in outside}) >= 4
    assert all(c.effects[0] in c.without for c in outside)
    assert not {c.effects[0] for c in outside} & set(CONTRACT)


def test_development_and_reporting_share_no_world_and_no_name() -> None:
    from blind.plan import Seeds, plan

    sets = [plan(s) for s in get_args(Seeds)]
    for one, other in combinations(sets, 2):
        assert not {c.world for c in one} & {c.world for c in other}
    names = [c.name for cases in sets for c in cases]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"case_[0-9a-f]{10}", n) for n in names)


def test_a_road_fault_has_no_reference_because_the_road_file_is_the_same_for_both() -> None:
    from blind.faults import ROAD
    from blind.plan import plan

    assert all(not c.reference for c in plan("report") if set(c.effects) & set(ROAD))


def test_the_beginning_of_the_plan_is_a_fair_sample() -> None:
    from blind.plan import KINDS, plan

    cases = plan("report")
    for kind in KINDS:
        share = sum(c.kind == kind for c in cases) / len(cases)
        first = sum(c.kind == kind for c in cases[:100]) / 100
        assert first == pytest.approx(share, abs=0.02)


def test_the_plan_to_train_on_has_everything_and_any_beginning_of_it_is_balanced() -> None:
    from blind.faults import OF_THE_ROAD, WIDE_OUTSIDE
    from blind.plan import KINDS, plan

    cases = plan("train")
    singles = {(c.effects[0], c.severity) for c in cases if c.kind == "single"}
    of_cars = {n for n, e in EFFECTS.items() if set(e.hook.models) & {"full_car", "msd"}}
    decoys = {"progressive_spring", "damper_play"}
    assert singles == {(e, s) for e in of_cars - decoys for s in (1.5, 3.0, 5.0)}
    assert {c.effects[0] for c in cases if c.kind == "outside"} == set(WIDE_OUTSIDE)
    assert not set(WIDE_OUTSIDE) & set(EFFECTS)
    ways = {(c.scene, c.reference, c.calibrated, c.right) for c in cases if c.kind == "null"}
    assert (
        len(ways) == 16
    )  # four scenes, each with a reference, without, calibrated and with the true characteristics
    assert len({c.world for c in cases}) == len(cases)
    assert not any(c.reference for c in cases if set(c.effects) & set(OF_THE_ROAD))
    assert not any(c.reference and c.calibrated for c in cases)
    for count in (60, 150, 400):
        for kind in KINDS:
            share = sum(c.kind == kind for c in cases) / len(cases)
            assert sum(c.kind == kind for c in cases[:count]) / count == pytest.approx(share, abs=0.03)
    assert len({c.effects for c in cases[:60] if c.kind == "single"}) > 25
    assert len(plan("report4")) >= 200


@pytest.mark.long
@pytest.mark.parametrize("reality", ["newton", "multibody", "linkage"])
def test_a_standing_car_feels_gravity_alone(world: Any, reality: str) -> None:
    from blind.folder import RUN
    from blind.world import G, plain

    motion = RUN[reality](plain(world), world.plans["drive_fast"])
    still = motion.force[500:1500].mean(axis=0)
    assert np.linalg.norm(still) == pytest.approx(G, abs=5e-3)
    assert np.abs(motion.travel[500:1500]).max() < 0.01  # springs and tyres were chosen for this load


def test_both_realities_drive_the_same_car_alike(world: Any) -> None:
    from blind.folder import RUN

    runs = [RUN[name](world, world.plans["drive_fast"]) for name in ("newton", "multibody")]
    u = np.linspace(runs[0].u[4500], runs[0].u[11_000], 4000)
    az = [np.interp(u, r.u, r.force[:, 2]) for r in runs]
    assert np.corrcoef(*az)[0, 1] > 0.95
    assert np.std(az[0]) == pytest.approx(np.std(az[1]), rel=0.1)
    assert np.abs(runs[0].u - runs[1].u).max() < 0.15
    assert not np.array_equal(*az)


@pytest.mark.parametrize("reality", ["newton", "multibody"])
def test_a_payload_sinks_the_car_by_its_weight_over_the_springs(world: Any, reality: str) -> None:
    from blind.folder import RUN
    from blind.world import SPRING_REACH, G

    car, plan = world.car, world.plans["drive_fast"]
    load = {"payload": {"mass": 100.0, "x": car.cog[0], "y": 0.0}}
    sunk, still = (RUN[reality](world, plan, f).travel[500:1500].mean(axis=0) for f in (load, {}))
    rate = sum(
        2 * np.gradient(s.spring)[300] / (SPRING_REACH / (s.spring.size - 1)) for s in (car.front, car.rear)
    )
    assert (sunk - still).mean() == pytest.approx(100.0 * G / rate, rel=0.1)


@pytest.mark.parametrize("reality", ["newton", "multibody"])
def test_a_sagged_spring_and_a_soft_tyre_let_the_car_down(world: Any, reality: str) -> None:
    from blind.folder import RUN

    plan = world.plans["drive_fast"]
    still, sagged, soft = (
        RUN[reality](world, plan, f)
        for f in (
            {},
            {"spring_sag": {"front": 0.03, "rear": 0.0, "rate": 0.0}},
            {"tyre_pressure": {"corner": 6.0, "change": -0.3}},
        )
    )
    standing = slice(500, 1500)
    lower = (sagged.travel - still.travel)[standing].mean(axis=0)
    assert lower[:2] == pytest.approx([0.03, 0.03], abs=0.002) and np.abs(lower[2:]).max() < 0.003
    # all tyres give more under the same load: less than if they were air alone, more than a third of that
    sink = still.place[standing, 2].mean() - soft.place[standing, 2].mean()
    air = world.car.loads().mean() / world.car.tyre_stiffness * (1 / 0.7 - 1)
    assert air / 3 < sink < air
    assert np.abs((soft.travel - still.travel)[standing]).max() < 0.001


@pytest.mark.parametrize(
    ("fault", "values"),
    [
        ("wheel_imbalance", {"corner": 0.0, "moment": 1.0, "phase": 0.5, "turned": 1.0}),
        ("flat_spot", {"corner": 0.0, "depth": 0.01}),
        ("engine_order", {"force": 800.0, "idle": 9.0, "low": 0.0, "high": 0.0}),
    ],
)
def test_what_turns_is_felt_at_its_frequency(world: Any, fault: str, values: dict[str, float]) -> None:
    """Against the distance for a wheel, against the time for a fan: the strongest line of what is added."""
    from blind import newton

    plan = world.plans["drive_fast"]
    plain, odd = (newton.run(world, plan, f) for f in ({}, {fault: values}))
    n = min(plain.t.size, odd.t.size)
    change = (odd.force - plain.force)[:n, 2]
    along, unit = (
        (plain.t[:n], 9.0) if fault == "engine_order" else (plain.u[:n], 1 / (2 * np.pi * world.car.radius))
    )
    driving = slice(np.flatnonzero(plain.u > plain.u[0] + 10.0)[0], n)
    tried = np.linspace(0.5 * unit, 1.6 * unit, 400)
    power = [abs(np.sum(change[driving] * np.exp(-2j * np.pi * k * along[driving]))) for k in tried]
    assert tried[int(np.argmax(power))] == pytest.approx(unit, rel=0.03)


def test_stamps_without_the_lost_samples_run_ahead_until_the_clock_is_asked_again() -> None:
    from blind.phone import lost_time

    t = np.arange(6000) / 100.0
    early, gone = lost_time({"seconds": 0.1, "every": 10.0}, t, 3)
    assert 0.01 < gone.mean() < 0.08
    assert np.all(np.diff((t - early)[~gone]) > 0.0)
    assert early[t % 10.0 < 0.005].max() == 0.0 and early.max() > 0.1


def test_a_wheel_on_a_linkage_comes_up_as_its_lever_says(world: Any) -> None:
    import mujoco
    from blind.linkage import links
    from blind.linkage_forces import lift
    from blind.multibody import body_centre, stand

    bodies, lever = links(world.car, 1.0, body_centre(world.car))
    scene = stand(world, world.plans["drive_fast"], {}, (bodies, ""))
    flat = np.array([1.0, 0.0, 0.0, 0.0])
    for angle in (-0.06, 0.0, 0.01, 0.05):
        scene.data.qpos[3:7] = flat
        scene.data.qpos[8::2] = angle
        mujoco.mj_forward(scene.model, scene.data)
        up = scene.data.xpos[2:6] - scene.data.xpos[1] - (world.car.wheels() - scene.centre)
        for i in range(4):
            rise, slope = lift(i, angle, lever)
            assert rise == pytest.approx(up[i, 2], abs=1e-9)
            more = lift(i, angle + 1e-6, lever)[0]
            assert slope == pytest.approx((more - rise) / 1e-6, rel=1e-4)
    assert up[:, 2].min() > 0.05
    # It turns about a centre on the other side and below its own: up, it goes to the inside.
    assert np.sign(up[:, 1]).tolist() == [-1, 1, -1, 1]


def test_a_linkage_carries_a_payload_on_the_spring_the_lever_and_the_scrub_of_its_tyres(world: Any) -> None:
    from blind.folder import RUN
    from blind.linkage import FRONT_HEIGHT, FRONT_VIEW
    from blind.linkage_forces import BUILD_UP, PROGRESSION, STIFFNESS
    from blind.world import SPRING_REACH, G

    car, plan = world.car, world.plans["drive_fast"]
    load = {"payload": {"mass": 100.0, "x": car.cog[0], "y": 0.0}}
    sunk, still = (RUN["linkage"](world, plan, f).travel[500:1500].mean(axis=0) for f in (load, {}))
    rate = 0.0
    for axle, strut in enumerate((car.front, car.rear)):
        spring = np.gradient(strut.spring)[300] / (SPRING_REACH / (strut.spring.size - 1))
        tyre = car.loads()[2 * axle : 2 * axle + 2].mean()
        lever = 2 * PROGRESSION[axle] * (tyre - strut.unsprung * G)
        scrub = (car.radius + FRONT_HEIGHT[axle]) / FRONT_VIEW[axle]
        rate += 2 * (spring + lever + scrub**2 * STIFFNESS[1] * tyre / BUILD_UP[1])
    assert (sunk - still).mean() == pytest.approx(100.0 * G / rate, rel=0.1)


def test_a_tyre_builds_its_force_up_over_a_way_and_then_slips_as_its_stiffness_says() -> None:
    from blind.linkage_forces import sheared

    speed, slip, way, stiffness, normal, dt = 10.0, 0.2, 0.4, 13.0, 4000.0, 1e-4
    xi, force = 0.0, []
    for _ in range(4000):
        xi, rate = sheared(xi, slip, speed, way, stiffness, normal, dt)
        force.append(rate * xi)
    end = stiffness * normal * slip / speed
    assert force[-1] == pytest.approx(end, rel=1e-3)
    assert force[399] == pytest.approx(
        end * (1 - np.exp(-1.0)), rel=0.01
    )  # a build-up way of 0.4 m is 40 ms here
    for _ in range(4000):
        xi, rate = sheared(xi, 50 * slip, speed, way, stiffness, normal, dt)
    assert rate * xi == pytest.approx(0.95 * normal)  # the tyre slides


def test_a_car_on_linkages_does_what_one_on_slides_does_and_something_more(world: Any) -> None:
    from blind.folder import RUN

    slides, links = (RUN[name](world, world.plans["drive_fast"]) for name in ("multibody", "linkage"))
    u = np.linspace(slides.u[4500], slides.u[11_000], 4000)
    a, b = (np.interp(u, r.u, r.force[:, 2]) for r in (slides, links))
    assert 0.85 < np.corrcoef(a, b)[0, 1] < 0.99
    assert np.abs(slides.u - links.u).max() < 0.3


def test_severity_grows_with_the_amount_and_recalibration_absorbs_what_a_spring_does(world: Any) -> None:
    from blind import newton, phone, severity
    from blind.faults import knob
    from blind.world import plain

    scale = severity.yardstick(world)
    curve = severity.curve(world, scale, "mount_resonance", 3)
    assert np.all(np.diff(curve) >= 0) and curve[-1] > 5.0 > 0.5 > curve[0]
    amount = severity.amount_for(curve, 1.5)
    fault = {"mount_resonance": knob("mount_resonance", world, 3)(amount, scale.null)}
    assert scale.severity(severity.change(world, scale, fault)) == pytest.approx(1.5, rel=0.1)
    car = replace(world.car, front=replace(world.car.front, spring=1.05 * world.car.front.spring))
    stiffer = newton.run(replace(plain(world), car=car), world.plans["drive_fast"], {}, 2e-3)
    changed = severity.signals(phone.felt(stiffer, world.phone, {}, ideal=True)) - severity.signals(
        scale.felt
    )
    before = float(np.max(np.sqrt(np.mean((changed / scale.floor) ** 2, axis=0))))
    assert scale.severity(changed) < 0.15 * before


def test_labels_cannot_be_changed_after_they_are_sealed(tmp_path: Path) -> None:
    from blind import seal

    label = tmp_path / "sealed" / "case_0" / "label.json"
    label.parent.mkdir(parents=True)
    label.write_text('{"effects": ["payload"]}')
    digest = seal.seal(tmp_path, "abc")
    assert seal.sealed(tmp_path) == digest
    assert seal.labels(tmp_path) == {"case_0": {"effects": ["payload"]}}
    file = tmp_path / "sealed" / "labels.json"
    file.write_text(file.read_text().replace("payload", "top_mount"))
    with pytest.raises(seal.Broken, match="not what was sealed"):
        seal.labels(tmp_path)


def test_nothing_is_diagnosed_before_labels_are_sealed(tmp_path: Path) -> None:
    from blind import seal

    with pytest.raises(seal.Broken, match="generate cases first"):
        seal.sealed(tmp_path)


@pytest.mark.long
def test_changing_the_labels_changes_no_byte_of_a_diagnosis(tmp_path: Path, repository: Path) -> None:
    from blind import ask

    case = tmp_path / "cases" / "case_0"
    bag = repository / "bags" / "crg_road"
    drive = read_drive(bag)
    write_drive(cut(drive, float(drive.imu.t[0]), float(drive.imu.t[0]) + 16.0), case / "drive_fast")
    for name in ("road.crg", "twin.yaml"):
        shutil.copy(bag / name, case)
    without = [e for e in EFFECTS if e != "sensor_scale"]  # one effect is enough, and quick
    (case / ask.REQUEST).write_text(json.dumps({"without": without}))
    labels = tmp_path / "sealed" / "labels.json"
    labels.parent.mkdir()
    answers = []
    for truth in ("sensor_scale", "payload"):
        labels.write_text(json.dumps({"case_0": {"effects": [truth]}}))
        answer = tmp_path / "answers" / truth
        record = ask.ask(case, answer, "seal")
        assert record["status"] == 0, record["error"]
        answers.append({p.name: p.read_bytes() for p in answer.iterdir() if p.name != "record.json"})
    assert set(answers[0]) == {"diagnosis.json", "evidence.json", "twin.yaml"}
    assert answers[0] == answers[1]


LOOK = """
import json, os, sys
from pathlib import Path
folder, out = map(Path, sys.argv[1:])
out.mkdir()
seen = {"arguments": sys.argv[1:], "environment": dict(os.environ), "folder": os.getcwd(),
        "files": sorted(str(p.relative_to(folder.parent)) for p in folder.parent.rglob("*") if p.is_file())}
(out / "diagnosis.json").write_text(json.dumps(seen))
"""


def test_a_diagnosis_is_started_with_the_case_alone_and_not_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from blind import ask

    case, answer = tmp_path / "cases" / "case_0", tmp_path / "answers" / "case_0"
    case.mkdir(parents=True)
    (case / "twin.yaml").write_text("model: full_car\n")
    monkeypatch.setenv("BLIND_LABELS", str(tmp_path / "sealed"))
    starter = (sys.executable, "-c", LOOK)
    record = ask.ask(case, answer, "seal", starter)
    seen = (answer / "diagnosis.json").read_text()
    assert json.loads(seen)["files"] == ["case/twin.yaml"]
    assert str(tmp_path / "sealed") not in seen and str(tmp_path / "cases") not in seen
    assert ask.ask(case, answer, "seal", ("false",)) == record  # kept
    (case / "twin.yaml").write_text("model: msd\n")
    assert ask.ask(case, answer, "seal", ("false",))["status"] != 0  # another case: asked again


def _row(kind: str, truth: list[str], verdict: str, top: str, chance: float, **more: Any) -> dict[str, Any]:
    named = [top] if verdict in ("effect", "partly") else []
    chances = {"no_gap": 1 - chance if verdict != "no_gap" else chance, "unknown": 0.0}
    if verdict == "unknown":
        chances["unknown"] = chance
    if named:
        chances[top] = chance
    return {
        "case": "c",
        "kind": kind,
        "truth": truth,
        "severity": 5.0,
        "verdict": verdict,
        "top": top,
        "named": named,
        "set": named,
        "rank": [1 if top in truth else 4],
        "chances": chances,
        "where": {},
        "reference": False,
        "seconds": 50.0,
        "cpu_seconds": 80.0,
        "memory_mb": 900.0,
        "interval": None,
        **more,
    }


def test_kept_answers_grow_by_those_to_other_cases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from blind import table

    monkeypatch.setattr(table, "RESULTS", tmp_path)
    monkeypatch.setattr(table.ask, "commit", lambda: "abc")
    file = tmp_path / "blind_dev.json"

    def keep(seal: str, add: bool, **right: bool) -> dict[str, Any]:
        rows = [
            _row(
                "single",
                ["payload"],
                "effect",
                "payload" if good else "top_mount",
                0.95,
                case=case,
                commit=seal,
                reality="newton",
                right=False,
            )
            for case, good in right.items()
        ]
        table._keep(rows, table._result(rows, [seal], "dev", 40), add)
        return dict(json.loads(file.read_text()))

    assert keep("first", True, one=True, two=False)["figures"]["top1"]["value"] == 0.5
    both = keep("second", True, two=True, three=True)
    assert [r["case"] for r in both["rows"]] == ["one", "two", "three"]
    assert both["cases"] == 3 and both["planned"] == 40 and both["figures"]["top1"]["value"] == 1.0
    assert both["labels_sha256"] == both["commit"] == ["first", "second"]
    assert [r["case"] for r in keep("third", False, four=True)["rows"]] == ["four"]
    assert file.with_suffix(".png").stat().st_size > 1000


def test_the_figures_count_what_they_say() -> None:
    from blind.score import figures

    rows = [
        _row(
            "single",
            ["payload"],
            "effect",
            "payload",
            0.95,
            predicted_shrink=0.8,
            measured_shrink=0.77,
            parameters={"payload.mass": [200.0, 190.0, 170.0, 210.0], "payload.x": [0.5, 0.4, 0.3, 0.45]},
        ),
        _row("single", ["payload"], "effect", "top_mount", 0.95),
        _row("single", ["top_mount"], "no_gap", "top_mount", 0.6),
        _row("null", [], "no_gap", "payload", 0.99),
        _row("null", [], "partly", "payload", 0.5),
        _row("outside", ["engine_order"], "unknown", "payload", 0.8),
        _row("pair", ["payload", "top_mount"], "effect", "payload", 0.5),
    ]
    found = {k: v["value"] for k, v in figures(rows)["figures"].items()}
    assert found["top1"] == pytest.approx(1 / 3)  # no gap is no answer, even where the right effect leads
    assert found["top1_ranked"] == pytest.approx(2 / 3)
    assert found["false_alarms"] == 0.5
    assert found["unknown_outside"] == 1.0
    assert found["pairs_exact"] == 0.0 and found["pairs_no_wrong"] == 1.0
    assert found["sure_and_wrong"] == pytest.approx(1 / 7)
    assert found["wrong_name"] == pytest.approx(2 / 7)
    assert found["shrink_error_median"] == pytest.approx(3.0)
    assert found["unknown_excluded"] is None
    assert found["parameter_error_median"] == pytest.approx(0.125) and found["parameter_in_interval"] == 0.5


def test_parameters_are_compared_where_label_and_answer_mean_the_same() -> None:
    from blind.score import _parameters

    label = {
        "faults": {"corner_spring": {"corner": 1.0, "change": -0.3}, "position_offset": {"offset": -0.2}}
    }
    causes = [
        {
            "effect": "corner_spring",
            "parameters": {"corner": 1.0, "change": -0.25},
            "parameter_intervals": {"change": [-0.4, -0.1]},
        },
        {
            "effect": "position_offset",
            "parameters": {"offset": 0.19},
            "parameter_intervals": {"offset": [0.1, 0.3]},
        },
        {"effect": "payload", "parameters": {"mass": 10.0}, "parameter_intervals": {"mass": [0.0, 20.0]}},
    ]
    told = _parameters(label, {"causes": causes, "combination": ["corner_spring", "position_offset"]})
    assert told == {
        "corner_spring.change": [-0.3, -0.25, -0.4, -0.1],
        "position_offset.offset": [0.2, 0.19, 0.1, 0.3],
    }


def test_values_that_moved_are_compared_with_the_true_car(tmp_path: Path) -> None:
    """Dampers over the velocities that the answer's own force shows, a worn axle by what it has left."""
    from blind.values import told_values
    from blind.world import DAMPER_N, DAMPER_REACH, SPRING_N, SPRING_REACH, G, car_of

    car, reached = car_of(7), 0.31
    at = np.linspace(0.0, reached, 9)[1:]
    grid = np.linspace(0.0, DAMPER_REACH, DAMPER_N + 1)
    true = [0.6 * float(np.mean(np.interp(at, grid, f))) for f in (car.rear.push, car.rear.pull)]
    pushes, pulls = 2000.0, 4000.0
    given = [float(np.mean(slope * at)) for slope in (pushes, pulls)]
    x, v = [0.1, 0.3, 0.5, 1.0], [0.125, 0.25, 0.35, 0.4]
    axle = {
        "spring": {"compression": x, "force": [25e3 * a for a in x]},
        "damper_push": {"velocity": v, "force": [pushes * a for a in v]},
        "damper_pull": {"velocity": v, "force": [pulls * a for a in v]},
    }
    (tmp_path / "twin.yaml").write_text(json.dumps({"vehicle": {"front": axle, "rear": axle}}))
    change = sum(true) / sum(given) - 1.0
    both = [f"vehicle.rear.damper_{way}.force" for way in ("pull", "push")]
    told = (
        ("rear damper, both ways", both, 0.5 * sum(given), 0.6),
        ("rear spring rate", ["vehicle.rear.spring.force"], 25e3, 0.3),
        ("front spring rate", ["vehicle.front.spring.force"], 25e3, 0.05),
        ("sprung inertia pitch", ["vehicle.sprung_inertia.pitch"], 2000.0, 0.2),
    )
    rows = [
        {
            "characteristic": name,
            "keys": keys,
            "before": before,
            "share": share,
            "change": change,
            "interval": [change - 0.1, change + 0.1],
        }
        for name, keys, before, share in told
    ]
    (tmp_path / "diagnosis.json").write_text(json.dumps({"verdict": "recalibration", "recalibrated": rows}))
    label = {"reality": "newton", "world": 7, "faults": {"worn_dampers": {"front": 0.9, "rear": 0.4}}}
    found = told_values(label, tmp_path, tmp_path)
    assert set(found) == {"rear damper, both ways", "rear spring rate"}
    assert found["rear damper, both ways"] == pytest.approx([change, change, change - 0.1, change + 0.1])
    load = float(np.mean(car.loads()[2:])) - G * car.rear.unsprung
    fine = np.linspace(0.0, SPRING_REACH, SPRING_N + 1)
    standing = np.interp(load, car.rear.spring, fine)
    low, high = np.interp([standing - 0.02, standing + 0.02], fine, car.rear.spring)
    assert found["rear spring rate"][0] == pytest.approx((high - low) / 0.04 / 25e3 - 1.0)
    # on levers that grow by 1.2 per metre the force F (1 + 2.4 s) at the wheel has the slope k + 2.4 F
    levered = told_values({**label, "reality": "linkage"}, tmp_path, tmp_path)["rear spring rate"][0]
    assert levered == pytest.approx(found["rear spring rate"][0] + 2.4 * load / 25e3)
    assert told_values({**label, "reality": "measured"}, tmp_path, tmp_path) == {}


def test_the_table_and_the_picture_are_drawn(tmp_path: Path) -> None:
    from blind.picture import draw
    from blind.score import figures
    from blind.table import text_of

    rows = [
        _row("single", ["payload"], "effect", "payload", 0.95),
        _row("null", [], "no_gap", "payload", 0.99),
    ]
    rows.append({**_row("single", ["top_mount"], "error", "", 0.0), "chances": {}, "top": None})
    assert figures(rows)["figures"]["failed"]["value"] == pytest.approx(1 / 3)
    result = {**figures(rows), "cases": 2, "seeds": "dev", "commit": ["abc"]}
    text = text_of({**result, "planned": 3})
    assert "null: a cause suspected" in text and len(text.splitlines()) > len(result["figures"])
    draw(rows, result, tmp_path / "made" / "confusion.png")
    assert (tmp_path / "made" / "confusion.png").read_bytes().startswith(b"\x89PNG")
    # of a pair alone there is no row of a single cause
    pair = [_row("pair", ["payload", "top_mount"], "unknown", "payload", 0.6)]
    draw(pair, {**figures(pair), "cases": 1, "seeds": "dev", "commit": ["abc"]}, tmp_path / "pair.png")
    assert (tmp_path / "pair.png").is_file()


def _answered(out: Path, name: str, stage: str, **document: Any) -> None:
    folder = out / stage / name
    folder.mkdir(parents=True)
    causes = [{"effect": "payload", "presence": 0.6}]
    text = json.dumps({"causes": causes, "combination": [], **document})
    (folder / "diagnosis.json").write_text(text, encoding="utf-8")


def test_what_was_proposed_over_the_road_of_the_case_is_driven_and_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from blind import more, plan, seal
    from blind.world import make_world

    spec = next(c for c in plan.plan("report5") if c.kind == "single" and c.reality == "newton")
    world = make_world(spec.world, spec.right, spec.scene)
    label = {"faults": {"payload": {"mass": 200.0, "x": 0.5, "y": 0.0, "z": 0.6}}}
    more.driven(spec, label, 25.0, tmp_path / more.NAME)
    drive = read_drive(tmp_path / more.NAME)
    speed = np.hypot(*drive.velocity.enu[:, :2].T)
    assert np.median(speed[speed > 1.0]) == pytest.approx(25.0 / 3.6, abs=0.3)
    assert len({p.start for p in world.plans.values()} | {drive.imu.t[0].round(3)}) == len(world.plans) + 1

    said = {"next_drive": {"speed_kmh": 20.0}}
    _answered(tmp_path, "open", "answers", verdict="suspected", **said)
    _answered(tmp_path, "sure", "answers", verdict="effect", **said)
    _answered(
        tmp_path, "bump", "answers", verdict="unknown", next_drive={"road": "a bump", "speed_kmh": 20.0}
    )
    _answered(tmp_path, "none", "answers", verdict="unknown")
    driven = {n: more.proposed(tmp_path / "answers" / n) for n in ("open", "sure", "bump", "none", "missing")}
    assert [n for n, drive in driven.items() if drive] == ["open"]

    cases = []
    for name, kind, truth, after in (
        ("right", "single", ["payload"], {"verdict": "effect", "combination": ["payload"]}),
        ("wrong", "single", ["payload"], {"verdict": "effect", "combination": ["spring_sag"]}),
        ("still", "single", ["payload"], {"verdict": "suspected", "combination": ["payload"]}),
        ("taken", "excluded", ["payload"], {"verdict": "unknown"}),
        ("sound", "null", [], {"verdict": "recalibration"}),
    ):
        cases.append(replace(spec, name=name, kind=kind, effects=tuple(truth)))
        _answered(tmp_path, name, "answers", verdict="unknown", **said)
        _answered(tmp_path, name, "answers_more", **after)
    monkeypatch.setattr(seal, "labels", lambda out: {c.name: {} for c in cases})
    found = more.figures(cases, tmp_path)
    assert {k: v for k, v in found.items() if k != "rows"} == {
        "open_and_driven": 5,
        "settled_rightly": 3,
        "named_wrongly": 1,
        "single": 3,
        "single_named": 1,
    }
    assert "3 settled rightly, 1 named wrongly" in more.text_of(found)


def test_calibrated_twins_are_asked_again_with_the_drive_of_their_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from blind import ask, more, plan, seal

    spec = next(c for c in plan.plan("report5") if c.kind == "single" and c.calibrated)
    seen: list[list[str]] = []

    def asked(folder: Path, answer: Path, digest: str) -> dict[str, Any]:
        seen.append(sorted(p.name for p in folder.iterdir()))
        sure = answer.parent.name == "answers_referred"
        cause = {
            "effect": spec.effects[0],
            "presence": 0.9,
            "indistinguishable_from": [],
            "probability": 0.9 - 0.5 * (not sure),
        }
        document = {
            "verdict": "effect" if sure else "unknown",
            "causes": [cause],
            "combination": list(spec.effects) if sure else [],
            "no_gap_probability": 0.05,
            "unknown_probability": 0.05,
            "unexplained": 0.4,
            "shrink_interval": [0.5, 0.7],
        }
        record = {
            "seconds": 1.0,
            "cpu_seconds": 1.0,
            "memory_mb": 1.0,
            "commit": "c",
            "error": "",
            "status": 0,
        }
        answer.mkdir(parents=True)
        (answer / "diagnosis.json").write_text(json.dumps(document), encoding="utf-8")
        (answer / "record.json").write_text(json.dumps(record), encoding="utf-8")
        return record

    label = {
        "name": spec.name,
        "kind": "single",
        "reality": spec.reality,
        "effects": list(spec.effects),
        "faults": {},
        "reached": {spec.effects[0]: {"severity": 3.0}},
        "severity": 3.0,
        "reference": False,
        "right": False,
        "stretch": None,
        "frequency": [],
        "drives": {},
    }
    monkeypatch.setattr(ask, "ask", asked)
    monkeypatch.setattr(seal, "labels", lambda out: {spec.name: label})
    monkeypatch.setattr(seal, "sealed", lambda out: "")
    for folder in ("cases", "sealed"):
        (tmp_path / folder / spec.name / ("drive_fast" if folder == "cases" else "reference")).mkdir(
            parents=True
        )
    asked(tmp_path / "cases" / spec.name, tmp_path / "answers" / spec.name, "")
    more.refer([spec, replace(spec, name="other", calibrated=False)], tmp_path, lambda text: None)
    assert seen == [["drive_fast"], ["drive_fast", "reference"]]
    found = more.compared([spec], tmp_path)
    assert [f["top1"]["value"] for f in found["figures"].values()] == [0.0, 1.0]
    assert "unknown" in more.compared_text(found) and "1.00 of 1" in more.compared_text(found)


def test_a_drive_of_the_own_model_leaves_as_much_but_not_the_same(repository: Path) -> None:
    from blind.ceiling import remade

    folder = repository / "bags" / "crg_road"
    drive, twin = read_drive(folder), load_twin(folder / "twin.yaml")
    before = simulate_drive(drive, twin)
    rows, alike = before.observation.driving, []
    for seed in range(6):
        own = remade(drive, twin, np.random.default_rng(seed))
        assert own.fix is drive.fix and own.velocity is drive.velocity
        found = simulate_drive(own, twin)
        assert found.gap.rms == pytest.approx(before.gap.rms, rel=0.3)
        left = [(f.measured["pitch_rate"] - f.simulated["pitch_rate"])[rows] for f in (before, found)]
        alike.append(np.corrcoef(*left)[0, 1])
    assert abs(np.mean(alike)) < 0.5 and max(map(abs, alike)) < 0.98
    again = remade(drive, twin, np.random.default_rng(5))
    assert np.array_equal(again.imu.specific_force, own.imu.specific_force)
