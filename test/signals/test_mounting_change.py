# SPDX-License-Identifier: Apache-2.0
"""A phone that turns in its holder is turned back, said with moment and angle, or refused where it goes on and on."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.inference.observation import observe
from suspension_twin.live.twin import DigitalTwin, ingest_stage, replay
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.signals.offline import ingest_drive
from suspension_twin.vehicle.twin import Place, Twin, load_twin

Turn = Callable[[np.ndarray], np.ndarray]


def with_turn(drive: Drive, turn: Turn) -> Drive:
    """``turn`` gives the rotation vectors (n, 3) in rad of the sensor at seconds (n,) since the first sample."""
    by = Rotation.from_rotvec(turn(drive.imu.t - drive.imu.t[0]))
    imu = drive.imu
    vectors = {name: by.apply(getattr(imu, name)) for name in ("specific_force", "angular_rate")}
    return replace(drive, imu=replace(imu, **vectors))


def slips(axis: tuple[float, ...], degrees: float, at: float) -> Turn:
    return lambda t: np.radians(degrees) * np.outer(t > at, axis)


def droops(axis: tuple[float, ...], degrees: float) -> Turn:
    return lambda t: np.radians(degrees) * np.outer(t / t[-1], axis)


def said(drive: Drive, place: Place) -> list[tuple[str, str]]:
    return [(f.code, f.text) for f in ingest_drive(drive, place).findings if f.code.startswith("turn")]


@pytest.fixture(scope="module")
def bump(repository: Path) -> tuple[Drive, Twin]:
    folder = repository / "bags" / "bump_15kmh"
    return read_drive(folder), load_twin(folder / "twin.yaml")


@pytest.mark.parametrize(
    ("axis", "degrees", "at"),
    [
        ((1.0, 0.0, 0.0), 5.0, 34.8),
        ((1.0, 0.0, 0.0), -90.0, 15.0),
        ((0.0, 0.0, 1.0), -5.0, 50.0),
        ((0.0, 0.0, 1.0), 40.0, 34.8),
        ((0.7071, 0.0, -0.7071), 15.0, 50.0),
        ((0.7071, 0.0, -0.7071), -60.0, 34.8),
        ((1.0, 0.0, 0.0), 3.0, 34.8),  # in pitch
    ],
)
def test_a_slip_is_seen_said_and_turned_back(
    bump: tuple[Drive, Twin], axis: tuple[float, ...], degrees: float, at: float
) -> None:
    drive, twin = bump
    sound, found = (ingest_drive(d, twin.imu) for d in (drive, with_turn(drive, slips(axis, degrees, at))))
    (text,) = [f.text for f in found.findings if f.code == "turned"]
    angle, moment = map(float, re.findall(r"by ([\d.]+)° at ([\d.]+) s", text)[0])
    gravity = Rotation.from_rotvec(np.radians(degrees) * np.array(axis))
    down = (
        sound.up[np.abs(sound.t - sound.t[0] - at) < 5.0].mean(axis=0)
        @ Rotation.from_euler("xyz", twin.imu.rpy).as_matrix()
    )
    expected = math.degrees(math.acos(float(np.clip(down @ gravity.apply(down) / (down @ down), -1, 1))))
    assert angle == pytest.approx(expected, abs=0.7)
    assert moment == pytest.approx(at, abs=0.3)
    after = found.t > found.t[0] + at + 1.0
    left = np.linalg.norm(found.up[after, :2] - sound.up[after, :2], axis=1)
    assert np.degrees(np.median(left)) < 1.0


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_a_holder_that_gives_way_all_the_time_is_refused(
    bump: tuple[Drive, Twin], axis: tuple[float, ...]
) -> None:
    drive, twin = bump
    ((code, text),) = said(with_turn(drive, droops(axis, 12.0)), twin.imu)
    assert code == "turning" and "slowly" in text


@pytest.mark.parametrize("degrees", [-1.5, 0.0, 2.0])
def test_what_a_road_does_too_is_no_alarm(bump: tuple[Drive, Twin], degrees: float) -> None:
    """In roll, as a cross slope; in pitch where no altitudes show the slope."""
    drive, twin = bump
    ahead = Rotation.from_euler("xyz", twin.imu.rpy).inv().apply([1.0, 0.0, 0.0])
    assert said(with_turn(drive, slips(tuple(ahead), degrees, 34.8)), twin.imu) == []
    flat = replace(drive, fix=replace(drive.fix, altitude=np.full(len(drive.fix), np.nan)))
    assert said(with_turn(flat, slips((1.0, 0.0, 0.0), degrees, 34.8)), twin.imu) == []


def test_the_second_bundled_drive_with_its_ramp_is_no_alarm(repository: Path) -> None:
    folder = repository / "bags" / "crg_road"
    assert said(read_drive(folder), load_twin(folder / "twin.yaml").imu) == []


@pytest.fixture(scope="module", params=["comma2k19", "rtklibexplorer"])
def measured(request: pytest.FixtureRequest, shared_data: Path, repository: Path) -> tuple[Drive, Place]:
    name, mapping, rpy = {
        "comma2k19": ("comma2k19_Example_1", None, (math.pi, 0.0, 0.0)),
        "rtklibexplorer": (
            "rtklibexplorer_GNSS_IMU",
            repository / "config" / "import" / "rtklibexplorer_gnss_imu.yaml",
            (0.0111, -0.1180, 3.0476),
        ),
    }[request.param]
    if not (shared_data / name).is_dir():
        pytest.skip(f"no measured data: {name}")
    return import_drive([shared_data / name], mapping=mapping).drive, Place(position=(0.0, 0.0, 1.2), rpy=rpy)


def test_real_hills_bends_and_brakes_are_no_alarm(measured: tuple[Drive, Place]) -> None:
    assert said(*measured) == []


def test_a_sensor_that_looks_backwards_unsaid_has_not_slipped(measured: tuple[Drive, Place]) -> None:
    """Slopes and braking are then felt the other way round."""
    drive, place = measured
    roll, pitch, yaw = place.rpy
    backwards = place.model_copy(update={"rpy": (roll, pitch, yaw + np.pi)})
    assert [text for code, text in said(drive, backwards) if code == "turned"] == []


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_a_slip_of_five_degrees_on_a_real_drive_is_seen(
    measured: tuple[Drive, Place], axis: tuple[float, ...]
) -> None:
    drive, place = measured
    at = 0.5 * (drive.imu.t[-1] - drive.imu.t[0])
    ((code, text),) = said(with_turn(drive, slips(axis, 5.0, at)), place)
    angle, moment = map(float, re.findall(r"by ([\d.]+)° at ([\d.]+) s", text)[0])
    assert code == "turned" and angle == pytest.approx(5.0, abs=0.4) and moment == pytest.approx(at, abs=0.3)


@pytest.mark.parametrize("degrees", [40.0, -70.0])
def test_a_turn_about_the_vertical_is_seen_by_braking(bump: tuple[Drive, Twin], degrees: float) -> None:
    drive, twin = bump
    upright = Rotation.from_euler("xyz", twin.imu.rpy).inv().apply([0.0, 0.0, 1.0])
    spoilt = with_turn(drive, slips(tuple(upright), degrees, 34.8))
    said = [w for w in observe(spoilt, twin).warnings if "about the vertical" in w]
    (angle, moment), *_ = [re.findall(r"by (-?\d+)° about the vertical at ([\d.]+) s", w)[0] for w in said]
    assert abs(float(angle)) == pytest.approx(abs(degrees), abs=8.0)
    assert not any("imu.rpy" in w for w in observe(spoilt, twin).warnings)
    assert not any("about the vertical" in w for w in observe(drive, twin).warnings)
    assert 10.0 < float(moment) < 50.0  # between two brakings


@pytest.mark.parametrize(("degrees", "seen"), [(0.0, False), (15.0, True), (-40.0, True), (90.0, True)])
def test_the_live_twin_says_it_and_turns_it_back(
    bump: tuple[Drive, Twin], degrees: float, seen: bool
) -> None:
    drive, twin = bump
    live = DigitalTwin(ingest_stage(twin, ImuSettings()))
    *_, last = replay(with_turn(drive, slips((1.0, 0.0, 0.0), degrees, 34.8)), live)
    codes = [f.code for f in live.findings]
    assert ("turned" in codes) == seen
    assert last.sample is not None and math.degrees(math.acos(last.sample.up[2])) < 2.5
