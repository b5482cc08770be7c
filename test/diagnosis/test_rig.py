# SPDX-License-Identifier: Apache-2.0
"""A corner on a rig of other code: calibrated and diagnosed by the commands, its effect withheld."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from suspension_twin.cli.main import main
from suspension_twin.diagnosis.library import library
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.drive.rig import RigRecord, write_rig
from suspension_twin.inference.runs import observe_runs, rig_run
from suspension_twin.models.parameters import lanes, pack
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.vehicle.twin import EffectSpec, load_twin, save_twin


@pytest.fixture(scope="module")
def rig(repository: Path) -> Any:
    before = list(sys.path)
    sys.path.insert(0, str(repository / "benchmarks"))
    yield import_module("rig")
    sys.path[:] = before


def test_a_corner_is_calibrated_to_the_noise_of_its_transducers(repository: Path, tmp_path: Path) -> None:
    """On a run that the fit has not used, with stiffness of the tyre and mass of the wheel found on the way."""
    twin, runs = repository / "config" / "twins" / "quarter_car.yaml", repository / "config" / "rig"
    found = tmp_path / "found.yaml"
    assert main(["calibrate", "--twin", str(twin), str(runs / "random.csv"), "--out", str(found)]) == 0
    gaps = []
    for file in (twin, found):
        out = tmp_path / file.stem
        assert main(["simulate", "--twin", str(file), str(runs / "drops.csv"), "--out", str(out)]) == 0
        gaps.append(json.loads((out / "gap.json").read_text(encoding="utf-8"))["rms"])
    assert gaps[1] < 0.1 * gaps[0]
    corner = load_twin(found).vehicle
    assert corner.unsprung_mass == pytest.approx(42.0, rel=0.1)
    assert corner.tyre.vertical_stiffness == pytest.approx(2.1e5, rel=0.15)


@pytest.mark.long
def test_a_withheld_stop_is_named(rig: Any, tmp_path: Path) -> None:
    """Stops of a stiffness and clearance that the seed draws, on a road like that of the reference."""
    rig.make(tmp_path, seed=5, effect="rebound_stop", seconds=8.0)
    runs = [str(tmp_path / "gap" / f"{kind}.csv") for kind in ("drops", "random")]
    reference = [str(tmp_path / "reference" / f"{kind}.csv") for kind in ("drops", "random")]
    arguments = ["diagnose", "--twin", str(tmp_path / "twin.yaml"), *runs, "--out", str(tmp_path / "answer")]
    for path in reference:
        arguments += ["--reference", path]
    for effect in ("rebound_stop", "bump_stop", "strut_friction"):
        arguments += ["--effect", effect]
    assert main(arguments) == 0
    document = json.loads((tmp_path / "answer" / "diagnosis.json").read_text(encoding="utf-8"))
    assert document["verdict"] in ("effect", "partly") and "rebound_stop" in document["combination"]
    named = next(cause for cause in document["causes"] if cause["effect"] == "rebound_stop")
    assert document["probability"] >= 0.5 and named["shrink_beyond_recalibration_interval"][0] > 0.5
    assert "rebound_stop" in [e.id for e in load_twin(tmp_path / "answer" / "twin.yaml").effects]
    assert document["where"]["operating_point"] and not document["where"]["corner"]


def test_runs_of_one_program_share_an_excitation(repository: Path, tmp_path: Path) -> None:
    twin, runs = (
        load_twin(repository / "config" / "twins" / "quarter_car.yaml"),
        repository / "config" / "rig",
    )
    text = (runs / "drops.csv").read_text(encoding="utf-8").splitlines()
    again = tmp_path / "drops.csv"
    again.write_text("\n".join([text[1], *text[2:]]) + "\n", encoding="utf-8")
    first, other, repeat = observe_runs(twin, [str(runs / "drops.csv"), str(runs / "random.csv"), str(again)])
    assert repeat.excitation is first.excitation and other.excitation is not first.excitation
    assert [first.name, repeat.name] == ["drops", "drops_2"]
    assert abs(float(first.position[0]) - float(other.position[0])) > 1e3 and first.rate == 125.0


@pytest.mark.long
def test_a_clock_that_has_an_offset_in_the_twin_changes_again(repository: Path, tmp_path: Path) -> None:
    """10 ms in the twin file and on the reference, 35 ms since: the effect of the file is named with its new size, in
    place of the old one."""
    corner = load_twin(repository / "config" / "twins" / "quarter_car.yaml")
    clock = [EffectSpec(id="time_offset", parameters={"offset": offset}) for offset in (0.010, 0.035)]
    before, after = (corner.model_copy(update={"effects": (one,)}) for one in clock)
    t, rng = np.arange(0.0, 14.0, 0.005), np.random.default_rng(5)
    road = 0.02 * sosfiltfilt(butter(2, 6.0, fs=200.0, output="sos"), rng.standard_normal(t.size))
    save_twin(before, tmp_path / "twin.yaml")
    paths = []
    for name, twin in (("before", before), ("after", after)):
        response = simulate_lanes(twin, pack(twin)[:, None], rig_run(t, road))
        columns = {n: response.channel(n)[:, 0] for n in ("body_acceleration", "suspension_deflection")}
        noisy = {n: v + 0.01 * np.std(v) * rng.standard_normal(t.size) for n, v in columns.items()}
        write_rig(RigRecord(name, t, {"road_displacement": road, **noisy}), tmp_path / f"{name}.csv")
        paths.append(str(tmp_path / f"{name}.csv"))
    request = DiagnosisRequest(
        str(tmp_path / "twin.yaml"), (paths[1],), (paths[0],), effects=("time_offset", "sensor_scale")
    )
    result = diagnose(request)
    assert result.document["combination"] == ["time_offset"]
    cause = result.document["causes"][0]
    assert cause["parameters"]["offset"] == pytest.approx(0.035, abs=0.003) and cause["held"] == {
        "offset": 0.01
    }
    assert "(in the twin file: offset 10 ms)" in result.document["message"]
    assert [e.id for e in result.twin.effects] == ["time_offset"]
    assert result.twin.effects[0].parameters["offset"] == pytest.approx(0.035, abs=0.003)


def test_what_is_offered_where_the_wheel_is_given_acts(repository: Path) -> None:
    """Effects of what is above the wheel, of the sensor and of its clock: each changes what a corner does."""
    corner = load_twin(repository / "config" / "twins" / "quarter_car.yaml")
    above, t = corner.with_changes({"excitation": "wheel"}), np.arange(0.0, 2.0, 0.005)
    offered = library(above, True)
    assert {"payload", "spring_sag", "worn_dampers", "sensor_scale", "time_offset"} <= set(offered)
    assert set(offered) < set(library(corner, True)) and "strut_friction" not in offered
    run = rig_run(t, 0.03 * np.sin(60.0 * t**1.5))
    plain = simulate_lanes(above, pack(above)[:, None], run).signals[:, 0, 0]
    for name, (first, *_) in offered.items():
        if name in (
            "spring_sag",
            "sensor_clipping",
        ):  # of a standing height, and of a range that is not reached
            continue
        twin, values = first.twin(above), first.values(first.starts(2, 1))
        keys, rows = first.on_drive(0)
        moved = simulate_lanes(twin, lanes(twin, keys, values[rows].T), run).signals[:, 0]
        assert np.std(moved - plain[:, None], axis=0).max() > 1e-3 * np.std(plain), name
