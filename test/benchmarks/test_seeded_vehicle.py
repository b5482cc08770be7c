# SPDX-License-Identifier: Apache-2.0
"""What another formulation says that a vehicle's own effect changes in the drives of a multibody car."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
DRIVE = "drive_fast"


@pytest.fixture(scope="module")
def vehicle() -> ModuleType:
    return import_module("seeded_vehicle")


@pytest.fixture(scope="module")
def source() -> Path:
    beside = BENCHMARKS.parents[1] / "shared" / "withheld"
    folder = Path(os.environ.get("SUSPENSION_TWIN_WITHHELD", str(beside))) / "no_effect_added"
    if not folder.is_dir():
        pytest.skip(f"no measured data: drives of a multibody car in {folder.parent}")
    return folder


def low_passed(values: np.ndarray, rate: float) -> np.ndarray:
    return np.asarray(sosfiltfilt(butter(4, 20.0, fs=rate, output="sos"), values))


def test_the_simpler_car_moves_as_the_multibody_car_does(vehicle: ModuleType, source: Path) -> None:
    world, truth, begun = vehicle._world(source, DRIVE)
    felt = vehicle._along(vehicle._plain(source, DRIVE), truth, begun)
    for column, at, alike in (("fx", 0, 0.97), ("fz", 2, 0.88), ("wy", 4, 0.94)):
        both = [low_passed(v, truth.rate)[truth.moving] for v in (truth.columns[column], felt[:, at])]
        assert np.corrcoef(both)[0, 1] > alike
        assert np.std(both[1]) == pytest.approx(np.std(both[0]), rel=0.15)
    # a damper holds against rebound more than against jounce, and neither takes force back as it gets faster
    for strut in (world.car.front, world.car.rear):
        assert strut.pull[300] > strut.push[300] > 100.0
        assert (np.diff(strut.push) >= 0).all() and (np.diff(strut.pull) >= 0).all()


def test_nothing_and_next_to_nothing_change_nothing(vehicle: ModuleType, source: Path) -> None:
    assert not vehicle.changed(source, DRIVE, {"sensor_scale": {"scale": 0.2}}).any()
    slight = vehicle.changed(source, DRIVE, {"tyre_damping": {"damping": 1e-6}})
    assert 0.0 < np.abs(slight).max() < 1e-6


def test_a_load_behind_lets_the_car_lean_back_and_changes_no_weight(
    vehicle: ModuleType, source: Path
) -> None:
    load = {"mass": 200.0, "x": -0.4, "y": 0.0}
    world, truth, _ = vehicle._world(source, DRIVE)
    rest = vehicle.changed(source, DRIVE, {"payload": load})[truth.t < 1.0].mean(axis=0)
    # springs and tyres in series, each axle's share of the load by its lever
    car, sunk = world.car, []
    for strut, share in ((car.front, load["x"] / car.wheelbase), (car.rear, 1 - load["x"] / car.wheelbase)):
        rate = strut.spring[1] / (0.6 / 1200)
        sunk.append(9.80665 * load["mass"] * share / 2 * (1 / rate + 1 / car.tyre_stiffness))
    pitch = (sunk[0] - sunk[1]) / car.wheelbase
    assert rest[0] == pytest.approx(-9.80665 * pitch, rel=0.05)
    assert rest[0] > 0.0
    assert abs(rest[2]) < 0.005


@pytest.mark.parametrize("effect", ["strut_friction", "loose_ball_joint"])
@pytest.mark.long
def test_parameters_give_the_share_that_is_asked_for(vehicle: ModuleType, source: Path, effect: str) -> None:
    _, truth, _ = vehicle._world(source, DRIVE)
    faults = vehicle.faults_of(effect, 0.3, source, DRIVE, 7)
    change = vehicle.changed(source, DRIVE, faults)
    parts = [low_passed(v, truth.rate)[truth.moving].std() for v in (change[:, 2], truth.columns["fz"])]
    assert parts[0] / parts[1] == pytest.approx(0.3, abs=0.03)
    assert change.shape == (truth.t.size, 6) and np.isfinite(change).all()
