# SPDX-License-Identifier: Apache-2.0
"""A twin over runs of a rig: the gap, what ``simulate`` writes, and what it says of runs that it cannot use."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lsim, sosfilt, sosfiltfilt

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.cli.main import main
from suspension_twin.diagnosis.case import baseline, build, read_case
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.drive.rig import RigRecord, read_rig, write_rig
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.fit import LinearisedFit
from suspension_twin.inference.hypothesis import Hypothesis, combined
from suspension_twin.inference.problem import Problem, whitener_of
from suspension_twin.inference.runs import observe_rig, observe_runs, repeats, rig_run, simulate_rig
from suspension_twin.models.parameters import pack
from suspension_twin.models.registry import model_of
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.models.types import RepeatedRun
from suspension_twin.vehicle.corners import CORNERS
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin, save_twin


@pytest.fixture(scope="module")
def corner(repository: Path) -> Twin:
    return load_twin(repository / "config" / "twins" / "quarter_car.yaml")


@pytest.fixture(scope="module")
def drops(repository: Path) -> RigRecord:
    return read_rig(repository / "config" / "rig" / "drops.csv")


def test_the_command_writes_the_gap_and_a_run_that_has_none(
    corner: Twin, repository: Path, tmp_path: Path
) -> None:
    twin, run = (
        repository / "config" / "twins" / "quarter_car.yaml",
        repository / "config" / "rig" / "random.csv",
    )
    assert main(["simulate", "--twin", str(twin), str(run), "--out", str(tmp_path)]) == 0
    gap = json.loads((tmp_path / "gap.json").read_text(encoding="utf-8"))
    assert gap["run"] == "random" and gap["rms"] > 3 * gap["noise_rms"]
    written = read_rig(tmp_path / "simulated.csv")
    assert {*read_rig(run).columns, "tyre_force"} == set(written.columns)
    again = simulate_rig(written, corner).gap
    for name, rms in gap["channels"].items():
        assert again.channels[name] < 1e-3 * rms


def test_the_gap_can_be_had_by_hand(corner: Twin, drops: RigRecord) -> None:
    result = simulate_rig(drops, corner)
    sos = butter(2, 20.0, fs=250.0, output="sos")
    for name, rms in result.gap.channels.items():
        both = np.c_[drops.columns[name], result.response.channel(name)[:, 0]]
        t = result.observation.t
        first, last = round(t[0] * 250.0), round(t[-1] * 250.0)
        measured, simulated = sosfiltfilt(sos, both, axis=0)[first : last + 1].T
        difference = measured - measured.mean() - simulated + simulated.mean()
        assert rms == pytest.approx(np.sqrt(np.mean(difference**2)), rel=0.02)


def test_the_floor_is_that_of_the_transducers(drops: RigRecord, corner: Twin) -> None:
    """0.03 m/s² and 0.1 mm of white noise at 250 Hz, of which the low-pass leaves what it passes of white noise."""
    observation = observe_rig(drops, model_of(corner).channels)
    assert list(observation.measured) == ["body_acceleration", "wheel_acceleration", "suspension_deflection"]
    noise = np.random.default_rng(0).standard_normal(100_000)
    passed = np.std(sosfiltfilt(butter(2, 20.0, fs=250.0, output="sos"), noise))
    assert observation.noise_rms["body_acceleration"] == pytest.approx(0.03 * passed, rel=0.2)
    assert observation.noise_rms["suspension_deflection"] == pytest.approx(1e-4 * passed, rel=0.2)


def test_zeros_of_transducers_and_gravity_are_not_compared(corner: Twin, drops: RigRecord) -> None:
    shifted = {k: v + (0.0 if k == "road_displacement" else 3.0) for k, v in drops.columns.items()}
    a, b = (simulate_rig(run, corner).gap.channels for run in (drops, replace(drops, columns=shifted)))
    assert a == pytest.approx(b, rel=1e-9)


def test_an_accelerometer_upside_down_is_reported(corner: Twin, drops: RigRecord) -> None:
    turned = {**drops.columns, "body_acceleration": -drops.columns["body_acceleration"]}
    warnings = simulate_rig(replace(drops, columns=turned), corner).warnings
    assert warnings == ("body_acceleration looks upside down: upwards and compression are positive",)
    assert simulate_rig(drops, corner).warnings == ()


def test_an_actuator_that_was_recorded_is_an_input(corner: Twin, drops: RigRecord) -> None:
    pushed = {**drops.columns, "actuator_force": 300.0 * np.sin(2 * np.pi * 3.0 * drops.t)}
    plain, moved = (simulate_rig(replace(drops, columns=c), corner).response for c in (drops.columns, pushed))
    change = (moved.signals - plain.signals)[500:, 0, 0]  # of the body: 300 N on 390 kg, above its resonance
    assert 0.8 < np.sqrt(2) * np.std(change) / (300.0 / corner.vehicle.sprung_mass) < 1.6


def test_runs_that_cannot_be_used(corner: Twin, drops: RigRecord) -> None:
    def cut(part: Any, name: str = "short") -> RigRecord:
        return RigRecord(name, drops.t[part], {k: v[part] for k, v in drops.columns.items()})

    with pytest.raises(InputError, match=r"short: lasts 0.08 s, which is too short"):
        simulate_rig(cut(slice(20)), corner)
    with pytest.raises(InputError, match=r"drops: misses samples at 3\.\d+ s: cut it"):
        simulate_rig(cut(np.r_[:800, 900:2000], "drops"), corner)
    with pytest.raises(InputError, match=r"short: filter: cutoff: 20 Hz needs samples faster than 41 Hz"):
        simulate_rig(cut(slice(None, None, 10)), corner)
    high = {**drops.columns, "road_displacement": 1e3 * drops.columns["road_displacement"]}
    with pytest.raises(WorkError, match="the simulation diverges by t = "):
        simulate_rig(replace(drops, columns=high), corner)


def test_a_road_in_too_large_a_unit_teaches_nothing(
    corner: Twin, drops: RigRecord, repository: Path, tmp_path: Path
) -> None:
    """Millimetres under a header of metres are refused; metres under one of millimetres move nothing."""
    file = tmp_path / "still.csv"
    write_rig(
        replace(
            drops, columns=drops.columns | {"road_displacement": drops.columns["road_displacement"] / 1e3}
        ),
        file,
    )
    twin = str(repository / "config" / "twins" / "quarter_car.yaml")
    result = calibrate(CalibrationRequest(twin, (str(file),)))
    assert {e.status for e in result.estimates} == {"kept"}
    assert [e.value for e in result.estimates] == [e.start for e in result.estimates]


def displaced(twin: Twin, rate: float, seed: int = 0, seconds: float = 10.0) -> RigRecord:
    """A run on a random road of the twin itself, recorded as displacements of body and wheel with its accelerometers
    beside them."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1.0 / rate)
    white = sosfiltfilt(butter(2, 4.0, fs=1000.0, output="sos"), rng.standard_normal(int(seconds * 1000) + 1))
    road = 0.05 * np.interp(t, np.arange(white.size) / 1000.0, white) * np.clip(t, 0.0, 1.0)
    response = simulate_twin(twin, rig_run(t, road))
    wheel = response.wheel_z[:, 0]
    body = wheel - response.deflection[:, 0]
    lanes = simulate_lanes(twin, pack(twin)[:, None], rig_run(t, road))
    columns = {n: lanes.channel(n)[:, 0] for n in ("body_acceleration", "wheel_acceleration")}
    heights = {"body_displacement": body, "wheel_displacement": wheel}
    return RigRecord("run", t, {"road_displacement": road, **columns, **heights})


@pytest.mark.parametrize("rate", [200.0, 500.0])
def test_displacements_are_compared_as_the_accelerations_that_they_hold(corner: Twin, rate: float) -> None:
    """Nobody has to differentiate: the second derivative of a displacement is what an accelerometer reads."""
    record = displaced(corner, rate)
    heights = {k: v for k, v in record.columns.items() if not k.endswith("acceleration")}
    channels = model_of(corner).channels
    read, derived = (observe_rig(replace(record, columns=c), channels) for c in (record.columns, heights))
    for name in ("body_acceleration", "wheel_acceleration"):
        assert np.std(read.measured[name] - derived.measured[name]) < 0.02 * np.std(read.measured[name])
    assert "suspension_deflection" in derived.measured


@pytest.mark.parametrize("given", ["wheel_displacement", "wheel_acceleration"])
def test_a_measured_wheel_drives_what_is_above_it(corner: Twin, tmp_path: Path, given: str) -> None:
    """The same body as on the road that moved the wheel, whatever is below the suspension. What an accelerometer at the
    wheel shows begins with a transient of its high-pass."""
    record = displaced(corner, 400.0, seconds=8.0)
    wheel = {
        k: v for k, v in record.columns.items() if k in (given, "body_acceleration", "suspension_deflection")
    }
    deflection = record.columns["wheel_displacement"] - record.columns["body_displacement"]
    run = replace(record, columns={**wheel, "suspension_deflection": deflection})
    above = corner.with_changes({"excitation": "wheel", "vehicle.tyre.vertical_stiffness": 1e5})
    path = written(run, tmp_path / "run.csv")
    result = simulate_rig(read_rig(path), above)
    assert list(result.measured) == ["body_acceleration", "suspension_deflection"]
    for name, rms in result.gap.channels.items():
        assert rms < (0.02 if given == "wheel_displacement" else 0.05) * np.std(result.measured[name]), name
    soft = simulate_rig(run, above.with_changes({"vehicle.sprung_mass": 500.0})).gap.channels
    assert soft["body_acceleration"] > 3.0 * result.gap.channels["body_acceleration"]
    (observed,) = observe_runs(above, [path])
    assert set(observed.measured) == set(result.measured)
    with pytest.raises(InputError, match="run: has no road: the twin file has to say excitation: wheel"):
        observe_runs(corner, [path])
    stop = above.model_copy(
        update={"effects": (EffectSpec(id="strut_friction", parameters={"front_force": 50.0}),)}
    )
    with pytest.raises(InputError, match="strut_friction does not act where the wheel's motion is given"):
        simulate_rig(run, stop)


def on_hubs(repository: Path) -> Twin:
    """A car on its measured hubs, with straight springs and dampers, whose sensor sits beside the middle."""
    car = load_twin(repository / "config" / "twins" / "ford_mondeo_mk4.yaml")
    straight: dict[str, object] = {"model": "msd", "excitation": "wheel", "imu.position": (0.9, 0.3, 0.8)}
    for axle, (rate, push, pull) in {"front": (26e3, 1500.0, 1500.0), "rear": (30e3, 2000.0, 2000.0)}.items():
        straight[f"vehicle.{axle}.spring"] = {"compression": (1.0,), "force": (rate,)}
        straight[f"vehicle.{axle}.damper_push"] = {"velocity": (1.0,), "force": (push,)}
        straight[f"vehicle.{axle}.damper_pull"] = {"velocity": (1.0,), "force": (pull,)}
    return car.with_changes(straight)


def shaken(twin: Twin, seconds: float) -> RigRecord:
    """What a sensor on the body reads whose four quarters follow their hubs, each by its own equation
    m/4 x'' = k (u - x) + c (u' - x'), and the hubs' heights and accelerations, by scipy."""
    t, vehicle = np.arange(0.0, seconds, 0.002), twin.vehicle
    noise = np.random.default_rng(3).standard_normal((t.size, 4))
    sos = butter(4, [1.0, 8.0], "bandpass", fs=500.0, output="sos")
    fade = np.clip(np.minimum(t, seconds - 0.5 - t), 0.0, 1.0) ** 2
    hubs = 0.2 * sosfilt(sos, noise, axis=0) * fade[:, None]
    speed, pull = (np.asarray(CubicSpline(t, hubs)(t, order)) for order in (1, 2))
    moved, rates = np.empty((t.size, 4)), np.empty((t.size, 4))
    for corner in range(4):
        axle = vehicle.front if corner < 2 else vehicle.rear
        k, c = (4.0 * part.force[0] / vehicle.mass for part in (axle.spring, axle.damper_push))
        body = np.array([[0.0, 1.0], [-k, -c]]), np.array([[0.0, 0.0], [k, c]])
        driven = np.column_stack([hubs[:, corner], speed[:, corner]])
        _, read, _ = lsim((*body, *body), driven, t)
        rates[:, corner], moved[:, corner] = read.T
    x, y, _ = twin.imu.position

    def plane(corners: Floats) -> tuple[Floats, Floats, Floats]:
        left, right = corners[:, ::2], corners[:, 1::2]
        tracks = np.array([vehicle.front_track, vehicle.rear_track])
        pitch = (corners[:, 2:].mean(axis=1) - corners[:, :2].mean(axis=1)) / vehicle.wheelbase
        return corners.mean(axis=1), ((left - right) / tracks).mean(axis=1), pitch

    heave, roll, pitch = plane(moved)
    _, roll_rate, pitch_rate = plane(rates)
    vertical = heave - (x - vehicle.wheelbase / 2) * pitch + y * roll
    columns = {"vertical_acceleration": vertical, "roll_rate": roll_rate, "pitch_rate": pitch_rate}
    wheels = {f"{name}_wheel_displacement": 0.1 * i + hubs[:, i] for i, name in enumerate(CORNERS)}
    pulls = {f"{name}_wheel_acceleration": 9.81 + pull[:, i] for i, name in enumerate(CORNERS)}
    return RigRecord("run", t, {**columns, **wheels, **pulls})


@pytest.mark.parametrize(("given", "most"), [("displacement", 0.02), ("acceleration", 0.05)])
def test_four_measured_hubs_drive_a_car(repository: Path, tmp_path: Path, given: str, most: float) -> None:
    """Heights count from anywhere; accelerometers show what is above 0.2 Hz."""
    twin, record = on_hubs(repository), shaken(on_hubs(repository), 12.0)
    other = {"displacement": "acceleration", "acceleration": "displacement"}[given]
    columns = {k: v for k, v in record.columns.items() if not k.endswith(f"wheel_{other}")}
    result = simulate_rig(read_rig(written(replace(record, columns=columns), tmp_path / "run.csv")), twin)
    assert list(result.measured) == ["vertical_acceleration", "roll_rate", "pitch_rate"]
    for name, rms in result.gap.channels.items():
        assert rms < most * np.std(result.measured[name]), name
    result.write(tmp_path / "out")
    assert set(read_rig(tmp_path / "out" / "simulated.csv").columns) == set(columns)
    lifted = replace(
        record, columns={**columns, f"rear_left_wheel_{given}": 2 * columns[f"rear_left_wheel_{given}"]}
    )
    for name, rms in simulate_rig(lifted, twin).gap.channels.items():
        assert rms > 5.0 * result.gap.channels[name], name


@pytest.mark.long
def test_a_car_on_its_hubs_is_calibrated(repository: Path, tmp_path: Path) -> None:
    """Springs, dampers and the place of the sensor are found from one run."""
    true, start = on_hubs(repository), tmp_path / "twin.yaml"
    changes = {"front.spring.force": (20e3,), "rear.damper_pull.force": (1500.0,)}
    off = {f"vehicle.{key}": value for key, value in changes.items()} | {"imu.position": (1.0, 0.3, 0.8)}
    save_twin(true.with_changes(off), start)
    run = written(shaken(true, 12.0), tmp_path / "run.csv")
    result = calibrate(CalibrationRequest(str(start), (str(run),)))
    assert result.yardstick is not None and result.yardstick.twin > 0.99 > 0.98 > result.yardstick.given
    found, wanted = result.twin.vehicle, true.vehicle
    assert found.rear.damper_pull.force[0] == pytest.approx(wanted.rear.damper_pull.force[0], rel=0.05)
    assert result.twin.imu.position[0] == pytest.approx(true.imu.position[0], abs=0.03)


@pytest.mark.parametrize(
    ("changes", "gone", "words"),
    [
        ({"model": "full_car"}, (), "the measured motion of wheels drives the model msd alone"),
        (
            {},
            ("front_right_wheel_displacement", "front_right_wheel_acceleration"),
            "run: wheel_displacement: is missing of each of the four wheels, and so is",
        ),
        (
            {},
            ("vertical_acceleration", "_rate"),
            "run: vertical_acceleration: is missing, and so is all else that the twin simulates",
        ),
        (
            {"effects": [{"id": "road_scale", "parameters": {"scale": 0.1}}]},
            (),
            "road_scale does not act where the wheel's motion is given",
        ),
    ],
)
def test_what_cannot_be_on_measured_hubs(
    repository: Path, changes: dict[str, object], gone: tuple[str, ...], words: str
) -> None:
    twin, record = on_hubs(repository), shaken(on_hubs(repository), 2.0)
    left = {k: v for k, v in record.columns.items() if not k.endswith(gone)}
    with pytest.raises(InputError, match=words):
        simulate_rig(replace(record, columns=left), twin.with_changes(changes))


@pytest.mark.parametrize(
    ("name", "factor", "words"),
    [
        ("body_acceleration", 1.0 / 9.80665, "body_acceleration is 0.1 times what the displacements"),
        ("body_acceleration", -1.0, "body_acceleration is -1 times what the displacements"),
        ("wheel_acceleration", 9.80665, "wheel_acceleration is 9.8 times what the displacements"),
        ("wheel_acceleration", 1.15, ""),
        ("suspension_deflection", 0.3048, "suspension_deflection is 0.3 times what the displacements"),
        ("suspension_deflection", 1.0, ""),
    ],
)
def test_a_unit_that_contradicts_another_column_is_said(
    corner: Twin, tmp_path: Path, name: str, factor: float, words: str
) -> None:
    """Encoders of 5 µm beside the accelerometers; a gain that is off by 15 % is no unit."""
    record, rng = displaced(corner, 500.0, seconds=6.0), np.random.default_rng(4)
    columns = {
        k: v + (5e-6 * rng.standard_normal(v.size) if k.endswith("displacement") else 0.0)
        for k, v in record.columns.items()
    }
    columns["suspension_deflection"] = columns["wheel_displacement"] - columns["body_displacement"]
    columns[name] = factor * columns[name]
    (run,) = observe_runs(corner, [written(replace(record, columns=columns), tmp_path / "run.csv")])
    said = [w for w in run.warnings if "what the displacements" in w]
    assert len(said) == bool(words) and all(w.startswith(words) for w in said)


def test_the_floor_of_displacements_is_not_that_of_white_noise(corner: Twin, drops: RigRecord) -> None:
    """Encoders of 2 µm: twice differentiated, their noise lies at high frequencies, where the low-pass removes it."""
    rng, record = np.random.default_rng(1), displaced(corner, 500.0)
    noisy = {
        k: v + (2e-6 * rng.standard_normal(v.size) if k.endswith("_displacement") else 0.0)
        for k, v in record.columns.items()
        if not k.endswith("acceleration")
    }
    found = observe_rig(replace(record, columns=noisy), ["body_acceleration"])
    still = {k: noisy[k] - record.columns[k] for k in noisy}
    left = observe_rig(replace(record, columns=still), ["body_acceleration"]).measured["body_acceleration"]
    assert np.std(left) / 2 < found.noise_rms["body_acceleration"] < 4 * np.std(left)


def written(record: RigRecord, path: Path) -> str:
    write_rig(record, path)
    return str(path)


def test_repeats_are_of_one_program_although_an_actuator_repeats_to_some_per_cent(
    corner: Twin, drops: RigRecord, tmp_path: Path
) -> None:
    """Each with its own road; a run of equal rows with other stamps is another program."""
    road = drops.columns["road_displacement"]
    off = sosfiltfilt(
        butter(2, 5.0, fs=250.0, output="sos"), np.random.default_rng(2).standard_normal(road.size)
    )
    again = replace(
        drops, columns={**drops.columns, "road_displacement": road + 0.07 * np.std(road) * off / np.std(off)}
    )
    slower = replace(drops, t=1.01 * drops.t)
    paths = [written(r, tmp_path / f"{i}.csv") for i, r in enumerate((drops, drops, again, slower))]
    first, same, repeat, other = observe_runs(corner, paths)
    assert same.excitation is first.excitation and repeat.excitation is not first.excitation
    assert repeats(first, repeat) and not repeats(first, other)
    for run in (first, repeat, other):
        assert run.measured["body_acceleration"].size == run.t.size


def test_a_fast_logger_is_simulated_on_fewer_stamps(corner: Twin, tmp_path: Path) -> None:
    """2 kHz become 200 Hz, and the same is compared."""
    record = displaced(corner, 2000.0, seconds=6.0)
    (found,) = observe_runs(corner, [written(record, tmp_path / "fast.csv")])
    assert found.road_excitation.t.size < 1300
    plain = observe_rig(record, ["body_acceleration"])
    there = np.interp(found.t, plain.t, plain.measured["body_acceleration"])
    assert np.std(there - found.measured["body_acceleration"]) < 0.01 * np.std(there)


def test_a_force_of_the_other_sign_is_reported(corner: Twin, tmp_path: Path) -> None:
    t = np.arange(0.0, 10.0, 0.005)
    rng = np.random.default_rng(3)
    sos = butter(2, 5.0, fs=200.0, output="sos")
    road, force = (size * sosfiltfilt(sos, rng.standard_normal(t.size)) for size in (0.05, 900.0))
    response = simulate_lanes(corner, pack(corner)[:, None], rig_run(t, road, force=force))
    body = response.channel("body_acceleration")[:, 0]
    for sign, count in ((1.0, 0), (-1.0, 1)):
        columns = {"road_displacement": road, "actuator_force": sign * force, "body_acceleration": body}
        (run,) = observe_runs(corner, [written(RigRecord("run", t, columns), tmp_path / f"{count}.csv")])
        said = [w for w in run.warnings if "actuator_force acts the other way round" in w]
        assert len(said) == count and all("sign: -1 for actuator_force" in w for w in said)
        shares = [float(v) for w in said for v in re.findall(r"(-?\d+) %", w)]
        assert not said or shares[0] > max(90.0, shares[1] + 10.0)


def test_a_reference_is_no_witness_of_itself(corner: Twin, drops: RigRecord, tmp_path: Path) -> None:
    """What is expected of a run comes from other references of its program: nothing of the only one."""
    short = replace(drops, t=drops.t[:900], columns={k: v[:900] for k, v in drops.columns.items()})
    paths = [written(short, tmp_path / f"{i}.csv") for i in range(3)]
    twin = tmp_path / "twin.yaml"
    save_twin(corner, twin)
    for before, expected in ((paths[1:2], [True, False]), (paths[1:], [True, True, True])):
        request = DiagnosisRequest(str(twin), (paths[0],), tuple(before))
        case = read_case(request, lambda note: None, lambda: False)
        problem, _, _ = baseline(case, build(case, lambda: False))
        assert [isinstance(p.excitation, RepeatedRun) for p in problem.data.parts] == expected
        assert not any(e is not None for e in problem.likelihood.expected)


_REPEATED = np.arange(0.0, 12.0, 0.005)


def smooth(seed: int, cutoff: float) -> Floats:
    """A random signal of unit rms below ``cutoff`` Hz on the stamps of the repeats."""
    found = sosfiltfilt(
        butter(2, cutoff, fs=200.0, output="sos"), np.random.default_rng(seed).standard_normal(_REPEATED.size)
    )
    return np.asarray(found / np.std(found))


def after_repeats(
    corner: Twin, folder: Path, read: Callable[[int, Floats], Floats]
) -> tuple[Problem, LinearisedFit]:
    """The baseline of the first of three runs of one program with the others as references; ``read`` makes of the
    number of a run and of the corner's body acceleration what was measured."""
    road = 0.01 * smooth(0, 8.0)
    response = simulate_lanes(corner, pack(corner)[:, None], rig_run(_REPEATED, road))
    body, paths = response.channel("body_acceleration")[:, 0], []
    for number in range(3):
        columns = {"road_displacement": road, "body_acceleration": read(number, body)}
        paths.append(written(RigRecord("run", _REPEATED, columns), folder / f"{number}.csv"))
    save_twin(corner, folder / "twin.yaml")
    request = DiagnosisRequest(str(folder / "twin.yaml"), (paths[0],), tuple(paths[1:]))
    case = read_case(request, lambda note: None, lambda: False)
    problem, base, _ = baseline(case, build(case, lambda: False))
    return problem, base


def test_what_repeats_differ_by_is_noise_of_a_change(corner: Twin, tmp_path: Path) -> None:
    """A rig that repeats to 7 % under a twin that misses nothing: the run after the references differs from them as
    they do from each other, and what no unknown changes is simulated once."""
    noise = 0.002 * np.random.default_rng(9).standard_normal((3, _REPEATED.size))
    problem, base = after_repeats(
        corner, tmp_path, lambda i, body: body + 0.07 * np.std(body) * smooth(1 + i, 20.0) + noise[i]
    )
    independent, shown = problem.measured.independent, whitener_of(problem).drive == 0
    squares = base.at.residual[shown] ** 2 / independent
    assert 0.3 < np.mean(squares) < 1.5
    assert problem.d == 0 and problem.likelihood.still
    moving = replace(problem, likelihood=replace(problem.likelihood, still=()))
    unknowns = np.zeros((problem.shared, 2))
    for one, other in zip(problem.signals(unknowns)[0], moving.signals(unknowns)[0], strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("latency", [0.0, 0.02])
def test_what_a_reference_leaves_passes_the_sensor_of_the_run_after_it(
    corner: Twin, tmp_path: Path, latency: float
) -> None:
    """A resonance that the twin has not, under a low-pass of 6 Hz and a gain that came since: with both in the twin
    nothing is left of it, nor is anything of an unchanged run; the twin's own latency is not counted twice."""
    cutoff, gain = 6.0, 1.2
    corner = corner.with_changes({"imu.latency": latency})
    low = butter(2, cutoff, fs=200.0, output="sos")

    def read(number: int, body: Floats) -> Floats:
        seen = body + 0.5 * np.std(body) * smooth(5, 18.0)
        seen = np.asarray(gain * sosfilt(low, seen)) if number == 0 else seen
        return seen + 0.002 * np.random.default_rng(number).standard_normal(body.size)

    problem, _ = after_repeats(corner, tmp_path, read)
    sensor = (("sensor_bandwidth", {"cutoff": cutoff}), ("sensor_scale", {"scale": gain - 1.0}))
    parts = [Hypothesis((name,), model="quarter_car") for name, _ in sensor]
    sizes = [one.at(EffectSpec(id=name, parameters=p)) for one, (name, p) in zip(parts, sensor, strict=True)]
    changed = problem.having(combined(*parts))
    at = np.concatenate([np.zeros(problem.shared), *sizes])
    own = slice(0, problem.data.rows[0].size)
    measured = problem.measured.values[own, 0]
    left = np.std(changed.compared(at[:, None])[own, 0, 0] - measured)
    assert left < 0.1 * np.std(measured)
    reference = slice(own.stop, own.stop + problem.data.rows[1].size)
    measured = problem.measured.values[reference, 0]
    left = np.std(problem.compared(np.zeros((problem.shared, 1)))[reference, 0, 0] - measured)
    assert left < 0.05 * np.std(measured)


def test_one_set_of_transducers_has_one_noise(corner: Twin, tmp_path: Path) -> None:
    """Motion counts as noise in a floor: the least of a rig's runs is theirs, that of a louder one as well."""
    record = displaced(corner, 200.0, seconds=8.0)
    shaken = record.columns["wheel_acceleration"] * 0.05 * np.sin(2 * np.pi * 60.0 * record.t)
    loud = {**record.columns, "body_acceleration": record.columns["body_acceleration"] + shaken}
    runs = observe_runs(
        corner,
        [
            written(replace(record, columns=c), tmp_path / f"{i}.csv")
            for i, c in enumerate((record.columns, loud))
        ],
    )
    assert runs[0].noise_rms == runs[1].noise_rms
    alone = observe_rig(record, ["body_acceleration"])
    assert runs[1].noise_rms["body_acceleration"] <= alone.noise_rms["body_acceleration"]


def test_a_bench_of_two_plates_is_calibrated_by_default(corner: Twin, tmp_path: Path) -> None:
    """Kilograms on springs of newtons a millimetre, responses 12 ms late, a force between the plates: the latency is
    found, written and said, so are the mass above and the damping below, and no linear model is better."""
    bench = corner.with_changes(
        {
            "vehicle.sprung_mass": 2.0,
            "vehicle.unsprung_mass": 1.0,
            "vehicle.tyre.vertical_stiffness": 2500.0,
            "vehicle.tyre.damping": 15.0,
            "vehicle.spring": {"compression": (0.1,), "force": (120.0,)},
            "vehicle.damper_push": {"velocity": (0.1, 0.4), "force": (1.5, 4.0)},
            "vehicle.damper_pull": {"velocity": (0.1, 0.4), "force": (2.5, 8.0)},
            "imu.latency": 0.012,
        }
    )
    t, paths = np.arange(0.0, 5.0, 0.005), []
    sos = butter(2, 6.0, fs=200.0, output="sos")
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        road, force = (size * sosfiltfilt(sos, rng.standard_normal(t.size)) for size in (0.01, 6.0))
        response = simulate_lanes(bench, pack(bench)[:, None], rig_run(t, road, force=force))
        columns = {name: response.channel(name)[:, 0] for name in response.names[:3]}
        noisy = {name: v + 0.02 * np.std(v) * rng.standard_normal(t.size) for name, v in columns.items()}
        record = RigRecord("run", t, {"road_displacement": road, "actuator_force": force, **noisy})
        paths.append(written(record, tmp_path / f"{seed}.csv"))
    start = bench.with_changes(
        {
            "vehicle.sprung_mass": 2.4,
            "vehicle.tyre.damping": 0.0,
            "imu.latency": 0.0,
            "vehicle.unsprung_mass": 0.9,
        }
    )
    save_twin(start, tmp_path / "start.yaml")
    result = calibrate(CalibrationRequest(str(tmp_path / "start.yaml"), tuple(paths)))
    assert result.twin.imu.latency == pytest.approx(0.012, abs=1e-3)
    assert result.twin.vehicle.sprung_mass == pytest.approx(2.0, rel=0.05)
    assert result.twin.vehicle.tyre.damping == pytest.approx(15.0, rel=0.3)
    assert any("ms after road and force" in w for w in result.warnings)
    measure = result.yardstick
    assert measure is not None and measure.held_out == "runs" and measure.twin > 0.99
    assert not measure.lost and np.isfinite(measure.linear) and "linear model" in str(result)
