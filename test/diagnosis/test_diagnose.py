# SPDX-License-Identifier: Apache-2.0
"""A diagnosis from files to files: what was put in is found, and nothing where nothing was."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.calibration.presets import refined
from suspension_twin.cli.main import main
from suspension_twin.diagnosis import search
from suspension_twin.diagnosis.answer import decided_anew, write
from suspension_twin.diagnosis.decision import Costs
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.sensor_correction import SensorCorrection
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.models.parameters import twin_value
from suspension_twin.report.diagnosis import diagnosis_page
from suspension_twin.road import write_road
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import EffectSpec, RoadFile, Twin, load_twin, save_twin

FEW = ("strut_friction", "tyre_damping", "time_offset")


def ask(case: tuple[Path, list[str], list[str]], **settings: Any) -> DiagnosisRequest:
    twin, bags, reference = case
    return DiagnosisRequest(str(twin), tuple(bags), tuple(reference), effects=FEW, **settings)


def check(document: dict[str, Any]) -> None:
    """The shape of diagnosis.json."""
    total = sum(c["probability"] for c in document["causes"])
    assert total + document["no_gap_probability"] + document["unknown_probability"] == pytest.approx(
        1, abs=1e-4
    )
    assert sorted(c["effect"] for c in document["causes"]) == sorted(FEW)
    assert set(document["where"]) == {"time", "road", "frequency", "channel", "corner", "operating_point"}
    for cause in document["causes"]:
        low, high = cause["shrink_interval"]
        assert low <= cause["shrink"] <= high
        if cause["gap_before"] > 0.0:
            assert cause["shrink"] == pytest.approx(1 - cause["gap_after"] / cause["gap_before"], abs=1e-4)


def test_friction_is_found_with_its_size_and_the_written_twin_closes_the_gap(
    make: Any, tmp_path: Path
) -> None:
    case = make("strut_friction", {"front_force": 250.0, "rear_force": 250.0}, reference=True)
    result = diagnose(ask(case))
    document = result.document
    check(document)
    gaps = [simulate_drive(read_drive(bag), load_twin(case[0])).gap for bag in case[1]]
    seconds, squares = (np.array([getattr(g, name) for g in gaps]) for name in ("seconds", "mse"))
    assert document["gap"]["rms"] == pytest.approx(np.sqrt(seconds @ squares / seconds.sum()), rel=5e-4)
    assert document["verdict"] == "effect", document["message"]
    assert document["combination"] == ["strut_friction"]
    lead = document["causes"][0]
    assert lead["effect"] == "strut_friction" and lead["probability"] > 0.8
    assert lead["parameters"]["front_force"] == pytest.approx(250, rel=0.2)
    assert lead["shrink_beyond_recalibration_interval"][0] > 0.5
    assert "strut_friction" in document["candidates"]
    write(result, tmp_path)
    diagnosis_page(result).write(tmp_path / "report.html")
    assert json.loads((tmp_path / "diagnosis.json").read_text()) == document
    # the answer follows from the file of evidence alone, the twin file too
    anew, again = decided_anew(tmp_path, Costs())
    assert {**anew, "next_experiment": document["next_experiment"]} == {**document, **anew}
    (spec,) = load_twin(tmp_path / "twin.yaml").effects
    assert again is not None and [e.id for e in again.effects] == [spec.id]
    assert again.effects[0].parameters == pytest.approx(spec.parameters, rel=1e-5)
    # whatever costs make of it, a twin file goes with it
    for costs in (Costs(missed=0.0, unknown=0.0), Costs(wrong=0.0, missed=9.0, unknown=9.0)):
        assert decided_anew(tmp_path, costs)[1] is not None
    told = (tmp_path / "report.html").read_text()
    assert "strut friction" in told
    twin = load_twin(tmp_path / "twin.yaml")
    drive = read_drive(case[1][0])
    before = simulate_drive(drive, load_twin(case[0])).gap
    after = simulate_drive(drive, twin).gap
    assert after.rms < 0.4 * before.rms


@pytest.mark.long
def test_friction_beyond_that_of_a_calibrated_file_is_no_wrong_number_of_it(make: Any, car: Twin) -> None:
    """What a fault adds to an optional part is named, with its size; the part itself stays as the file has it."""
    known = refined(car).with_changes({f"vehicle.{axle}.friction": 15.0 for axle in car.axles})
    found = diagnose(ask(make("strut_friction", {"front_force": 120.0, "rear_force": 120.0}, car=known)))
    assert found.document["combination"] == ["strut_friction"], found.document["message"]
    assert found.document["causes"][0]["parameters"]["front_force"] == pytest.approx(120, rel=0.25)
    assert twin_value(found.twin, "vehicle.front.friction") == 15.0
    assert not [r for r in found.document["recalibrated"] if "friction" in r["characteristic"]]


@pytest.mark.long
def test_a_late_clock_is_found_without_a_reference(make: Any) -> None:
    document = diagnose(ask(make("time_offset", {"offset": 0.06}))).document
    check(document)
    lead = document["causes"][0]
    assert lead["effect"] == "time_offset" and lead["probability"] > 0.8
    assert lead["parameters"]["offset"] == pytest.approx(0.06, abs=0.01)


@pytest.mark.long
def test_wrong_characteristics_alone_are_recalibrated_and_twice_the_same(
    make: Any, car: Twin, tmp_path: Path
) -> None:
    """The car's front dampers are 15 % stronger in jounce than the file says, which it says to be sure of."""
    case = make()
    stated = {"vehicle.front.damper_push.force": (2.0, 4.0, 5.0, 6.0)}
    save_twin(load_twin(case[0]).with_changes({"uncertainty": stated}), tmp_path / "given.yaml")
    case = (tmp_path / "given.yaml", *case[1:])
    result = diagnose(ask(case))
    first = result.document
    check(first)
    assert first["verdict"] == "recalibration", first["message"]
    assert (
        first["combination"] == [] and first["recalibration_probability"] == first["no_gap_probability"] > 0.5
    )
    (own,) = [one for one in first["recalibrated"] if "vehicle.front.damper_push.force" in one["keys"]]
    asked = np.array([230.0, 480.0, 700.0, 810.0])
    truth = float(np.mean(asked / car.axles["front"].part.damper_push.points[1])) - 1.0
    assert own is first["recalibrated"][0] and own["interval"][0] <= truth <= own["interval"][1]
    assert own["change"] == pytest.approx(truth, abs=0.1) and own["share"] > 0.5
    assert "front damper, push" in first["message"]
    assert first["next_experiment"] == "No further drive is needed to separate candidates."
    assert [one["stated"] for one in first["recalibrated"]] == [one is own for one in first["recalibrated"]]
    write(result, tmp_path)
    assert load_twin(tmp_path / "twin.yaml").uncertainty is None  # of values that are replaced
    drive = read_drive(case[1][0])
    before, after = (simulate_drive(drive, load_twin(p)).gap for p in (case[0], tmp_path / "twin.yaml"))
    assert after.rms < before.rms
    assert json.dumps(first) == json.dumps(diagnose(ask(case)).document)
    text = " ".join(diagnosis_page(result).render().split())
    assert "What recalibration changes" in text


@pytest.mark.long
def test_one_bump_recalibrates_the_twin_that_never_was_calibrated(repository: Path) -> None:
    """All of the gap is in one block of the road: its shrink is proven nonetheless."""
    bump = repository / "bags" / "bump_15kmh"
    result = diagnose(DiagnosisRequest(str(bump / "twin.yaml"), (str(bump),), effects=FEW))
    assert result.document["verdict"] == "recalibration"
    assert result.document["recalibration"]["shrink_interval"][0] > 0.5
    moved = {one["characteristic"] for one in result.document["recalibrated"]}
    assert {"front damper, both ways", "rear damper, both ways"} <= moved
    assert "--reference" not in result.document["next_experiment"]
    assert "twin recalibrated" in diagnosis_page(result).render()


@pytest.mark.long
def test_a_healthy_twin_is_handed_back_as_it_came(make: Any, car: Twin, tmp_path: Path) -> None:
    twin, bags, _ = make()
    sound = load_twin(twin).with_changes({"vehicle.front.damper_push.force": [230.0, 480.0, 700.0, 810.0]})
    given = tmp_path / "sound.yaml"
    save_twin(sound, given)
    given.write_text("# weighed in May\n" + given.read_text())
    result = diagnose(ask((given, bags, [])))
    assert result.document["verdict"] == "no_gap", result.message
    assert result.document["shrink"] == 0.0 and result.document["gap_after"] == result.document["gap_before"]
    write(result, tmp_path / "elsewhere")
    assert load_twin(tmp_path / "elsewhere" / "twin.yaml") == sound
    assert (tmp_path / "elsewhere" / "twin.yaml").read_text().startswith("# weighed in May\n")
    write(result, tmp_path)
    assert (tmp_path / "twin.yaml").read_bytes() == given.read_bytes()


@pytest.mark.long
def test_a_clock_offset_that_the_twin_file_has_is_none(make: Any, tmp_path: Path) -> None:
    """Without it in the file 60 ms are named as a clock offset, as another test shows."""
    twin, bags, _ = make()
    save_twin(load_twin(twin).with_changes({"imu.latency": 0.06}), tmp_path / "twin.yaml")
    late = [tmp_path / Path(bag).name for bag in bags]
    for bag, folder in zip(bags, late, strict=True):
        write_drive(SensorCorrection(clock=-0.06).timed(read_drive(bag)), folder)
    document = diagnose(ask((tmp_path / "twin.yaml", [str(folder) for folder in late], []))).document
    check(document)
    assert document["verdict"] in ("no_gap", "recalibration"), document["message"]
    assert "time_offset" not in document["combination"]


@pytest.mark.long
def test_a_diagnosis_goes_on_with_one_drive_more(
    make: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin, (first, second), _ = make()
    effects = [word for name in ("strut_friction", "time_offset") for word in ("--effect", name)]
    assert main(["diagnose", "--add", second, "--out", str(tmp_path)]) == 2  # nothing to go on with
    assert "evidence.json" in capsys.readouterr().err
    assert main(["diagnose", "--twin", str(twin), first, *effects, "--out", str(tmp_path)]) == 0
    before = json.loads((tmp_path / "diagnosis.json").read_text())
    capsys.readouterr()
    assert main(["diagnose", "--add", second, "--out", str(tmp_path)]) == 0
    after, evidence = (json.loads((tmp_path / f"{n}.json").read_text()) for n in ("diagnosis", "evidence"))
    assert [Path(bag).name for bag in evidence["asked"]["bags"]] == ["drive_0", "drive_1"]
    assert (
        evidence["asked"]["effects"] == ["strut_friction", "time_offset"] and evidence["case"]["drives"] == 2
    )
    assert after["earlier"]["verdict"] == before["verdict"]
    assert "Before the last drive: " in capsys.readouterr().out.replace("\n", " ")
    assert main(["diagnose", "--add", second, "--twin", str(twin), "--out", str(tmp_path)]) == 2


@pytest.mark.long
def test_what_only_a_decoy_explains_is_unknown_unless_it_is_asked_for(make: Any) -> None:
    case = make("progressive_spring", {f"{axle}_square": 4e7 for axle in ("front", "rear")}, reference=True)
    result = diagnose(ask(case))
    document = result.document
    check(document)
    assert document["verdict"] == "unknown", document["message"]
    like = document["signature"]["resembles"][0]
    assert like["effect"] == "progressive_spring" and like["probability"] > 0.8 and like["shrink"] > 0.5
    assert like["parameters"]["front_square"] == pytest.approx(4e7, rel=0.4)
    assert document["message"].endswith("they resemble progressive spring")
    assert "is like progressive spring" in diagnosis_page(result).render()
    asked = replace(ask(case), bags=(case[1][0],), effects=("strut_friction", "progressive_spring"))
    named = diagnose(asked).document
    assert named["verdict"] == "effect" and named["combination"] == ["progressive_spring"]


@pytest.mark.long
def test_a_narrow_resonance_against_the_bodys_motion_is_found(make: Any) -> None:
    """Far from where such modes usually are, and of the other sign: starts here and there miss it."""
    truth = {"gain": -0.25, "frequency": 10.0, "damping_ratio": 0.03}
    case = replace(ask(make("body_bending", truth)), effects=("body_bending", "strut_friction"))
    document = diagnose(case).document
    lead = document["causes"][0]
    assert document["verdict"] == "effect" and lead["effect"] == "body_bending"
    assert lead["parameters"]["frequency"] == pytest.approx(10.0, rel=0.02)
    assert lead["parameters"]["gain"] == pytest.approx(-0.25, rel=0.25)


@pytest.mark.long
def test_a_shaking_engine_is_found_on_a_road_that_shakes_nothing(car: Twin, tmp_path: Path) -> None:
    """No stretch of the drive stands out of the noise."""
    road = iso8608_road("A", 130, seed=4, v_step=0.4, roughness_n0=4e-7)
    write_road(road, tmp_path / "road.crg")
    save_twin(car.model_copy(update={"road": RoadFile(file=tmp_path / "road.crg")}), tmp_path / "twin.yaml")
    shaking = EffectSpec(id="engine_order", parameters={"force": 100.0, "frequency": 13.0, "per_metre": 0.0})
    truth, bags = car.model_copy(update={"effects": (shaking,)}), []
    for seed, top in ((1, 8.0), (2, 6.0)):
        drive = synthetic_drive(
            truth, road, ((0.0, 0.0), (3.0, top), (13.0, top)), seed, name=f"drive_{seed}"
        )
        write_drive(drive, tmp_path / drive.name)
        bags.append(str(tmp_path / drive.name))
    effects = ("engine_order", "strut_friction", "body_bending")
    document = diagnose(DiagnosisRequest(str(tmp_path / "twin.yaml"), tuple(bags), effects=effects)).document
    lead = document["causes"][0]
    assert document["verdict"] == "effect" and lead["effect"] == "engine_order"
    assert lead["parameters"]["force"] == pytest.approx(100.0, rel=0.1)


@pytest.mark.long
def test_a_little_tilt_under_a_high_antenna_is_no_map_that_lies_ahead(make: Any, car: Twin) -> None:
    """2.6° of a sensor's lean, taken for the vehicle's, put the antenna and with it the car 7 cm elsewhere."""
    high = car.model_copy(update={"gps": car.gps.model_copy(update={"position": (0.0, 0.0, 1.5)})})
    case = make("sensor_tilt", {"roll": 0.01, "pitch": 0.045, "yaw": 0.03}, car=high)
    asked = replace(ask(case), effects=("sensor_tilt", "position_offset", "lateral_offset"))
    document = diagnose(asked).document
    assert document["combination"] == ["sensor_tilt"], document["message"]
    assert document["causes"][0]["probability"] > 0.6


@pytest.mark.long
def test_a_sensor_that_is_turned_far_is_named_and_pushes_no_vehicle(make: Any) -> None:
    """By 14° of yaw a quarter of the braking is felt as a push to the side: no body rolls by that."""
    truth = {"roll": -0.05, "pitch": 0.12, "yaw": 0.25}
    asked = replace(
        ask(make("sensor_tilt", truth)), effects=("sensor_tilt", "corner_spring", "road_smoothing")
    )
    document = diagnose(asked).document
    assert document["verdict"] == "effect" and document["combination"] == ["sensor_tilt"], document["message"]
    assert document["causes"][0]["parameters"] == pytest.approx(truth, abs=0.012)
    assert document["unexplained"] < 0.28  # 0.35 if the vehicle were pushed


@pytest.mark.long
def test_an_effect_that_no_step_leads_to_from_the_baseline_is_tried_on_the_vehicle_of_the_file(
    make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A baseline that made up for too much may be a vehicle to which nothing can be added."""
    lost: list[str] = []
    right = search.refit

    def refit(problem: Any, starts: Any, *how: Any, **more: Any) -> Any:
        centre = problem.prior.centre[: problem.d]
        away = all(not np.array_equal(x[: problem.d], centre) for x in starts)
        if problem.hypothesis.effects == ("sensor_tilt",) and away and not lost:
            lost.append("sensor_tilt")
            return starts[0], np.inf
        return right(problem, starts, *how, **more)

    monkeypatch.setattr(search, "refit", refit)
    case = make("sensor_tilt", {"roll": 0.06, "pitch": 0.08, "yaw": 0.0})
    document = diagnose(replace(ask(case), effects=("sensor_tilt", "sensor_scale"))).document
    assert lost and document["combination"] == ["sensor_tilt"]


def test_a_drive_is_not_its_own_reference(make: Any) -> None:
    twin, bags, _ = make()
    with pytest.raises(InputError, match="drive_0"):
        diagnose(DiagnosisRequest(str(twin), tuple(bags), (bags[0],)))


@pytest.mark.long
def test_effects_asked_for_by_name_on_the_command_line(
    make: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin, bags, _ = make("strut_friction", {"front_force": 250.0, "rear_force": 250.0})
    ask = ["diagnose", "--twin", str(twin), *bags, "--out", str(tmp_path / "out")]
    assert main([*ask, "--effect", "strut_fricton"]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "--effect: strut_fricton: is not an effect" in error and "strut_friction" in error
    assert main([*ask, "--effect", "strut_friction", "--effect", "tyre_damping"]) == 0
    assert not (tmp_path / "out" / ".state").exists()
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert sorted(c["effect"] for c in document["causes"]) == ["strut_friction", "tyre_damping"]
    assert document["combination"] == ["strut_friction"]


@pytest.mark.long
def test_two_causes_are_named_together_and_nothing_has_to_tell_them_apart(make: Any) -> None:
    elsewhere = EffectSpec(id="sensor_offset", parameters={"x": 0.8, "y": 0.0, "z": 0.0})
    case = make("strut_friction", {"front_force": 250.0, "rear_force": 250.0}, always=(elsewhere,))
    effects = ("strut_friction", "sensor_offset", "payload")
    document = diagnose(replace(ask(case), effects=effects)).document
    assert set(document["combination"]) == {"strut_friction", "sensor_offset"}, document["message"]
    first, second, other = document["causes"]
    assert min(first["probability"], second["probability"]) > 0.4 and other["probability"] < 0.01
    assert not any(c["indistinguishable_from"] for c in document["causes"])
    assert document["next_experiment"].startswith("No further drive is needed to separate candidates.")


@pytest.mark.long
def test_what_a_converter_cuts_off_is_compared(make: Any, tmp_path: Path) -> None:
    """Samples at the end of the range are left out where a twin is calibrated: here they are the evidence."""
    twin, whole, _ = make()
    bags, reach = [str(tmp_path / Path(bag).name) for bag in whole], 13.0
    for original, bag in zip(whole, bags, strict=True):
        drive = read_drive(original)
        force = np.clip(drive.imu.specific_force, -reach, reach)
        assert (force[:, 2] == reach).sum() >= 3
        write_drive(replace(drive, imu=replace(drive.imu, specific_force=force)), bag)
    effects = ("sensor_clipping", "bump_stop", "sensor_scale")
    document = diagnose(DiagnosisRequest(str(twin), tuple(bags), effects=effects)).document
    assert document["combination"] == ["sensor_clipping"]
    assert document["causes"][0]["parameters"]["range"] == pytest.approx(reach, rel=0.02)


@pytest.mark.long
def test_a_map_that_was_off_before_and_after_is_named_as_not_new(make: Any) -> None:
    """Half a metre in reference and gap drives alike is no other car, and no change."""
    off = EffectSpec(id="position_offset", parameters={"offset": 0.5})
    twin, bags, reference = make(always=(off,), reference=True)
    effects = ("position_offset", "time_offset")
    document = diagnose(DiagnosisRequest(str(twin), (bags[0],), tuple(reference), effects=effects)).document
    assert document["combination"] == ["position_offset"], document["message"]
    assert document["before_and_after"] is True and "before and after alike" in document["message"]
    assert document["causes"][0]["parameters"]["offset"] == pytest.approx(0.5, abs=0.03)


@pytest.mark.long
def test_a_late_clock_is_found_beside_a_load_that_leaves_little(make: Any) -> None:
    """10 ms are half taken over by the nuisance parameters and far less than the scattered starts are apart, and the
    load alone leaves no more than a complete model may."""
    late = EffectSpec(id="time_offset", parameters={"offset": 0.01})
    case = make("payload", {"mass": 300.0, "x": 0.3, "y": 0.1}, always=(late,))
    few = ("payload", "time_offset", "position_offset", "tyre_pressure", "corner_spring", "lateral_offset")
    result = diagnose(replace(ask(case), effects=few))
    assert result.document["combination"] == ["payload", "time_offset"], result.document["message"]


@pytest.mark.long
def test_an_open_answer_of_a_calibrated_twin_asks_for_a_drive_of_its_calibration(
    make: Any, tmp_path: Path
) -> None:
    twin, bags, _ = make("progressive_spring", {f"{axle}_square": 4e7 for axle in ("front", "rear")})
    save_twin(load_twin(twin).with_changes({"uncertainty": {"vehicle.mass": 20.0}}), tmp_path / "twin.yaml")
    document = diagnose(ask((tmp_path / "twin.yaml", bags, []))).document
    assert document["verdict"] == "unknown", document["message"]
    assert document["next_experiment"].startswith(
        "Diagnose again with --reference and a drive on which the twin was calibrated"
    )
