# SPDX-License-Identifier: Apache-2.0
"""A twin over runs of a rig: the gap, what ``simulate`` writes, and what it says of runs that it cannot use."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.cli.main import main
from suspension_twin.drive.rig import RigRecord, read_rig, write_rig
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.runs import observe_rig, simulate_rig
from suspension_twin.models.registry import model_of
from suspension_twin.vehicle.twin import Twin, load_twin


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
