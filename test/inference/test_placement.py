# SPDX-License-Identifier: Apache-2.0
"""Passes are placed on the road by what was felt, where the receiver leaves the place open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.calibration.setup import set_up
from suspension_twin.diagnosis.case import read_case
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.felt_passes import felt_passes
from suspension_twin.inference.observation import observe
from suspension_twin.inference.placement import NoPlaceError, is_open, on_one_clock, place
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road import Road, bump_road, circular, flat_road, load_road, write_road
from suspension_twin.vehicle.twin import RoadFile, Twin, load_twin, save_twin

KNOTS = ((0.0, 0.0), (4.0, 0.0), (7.0, 5.0), (13.0, 5.0), (15.0, 3.0))
BUMP = bump_road(circular(0.9, 0.05), at=25.0, length=70.0)


@pytest.fixture(scope="module")
def twin(repository: Path) -> Twin:
    return load_twin(repository / "bags" / "bump_15kmh" / "truth.yaml")


@pytest.fixture(scope="module")
def softer(repository: Path) -> Twin:
    """As the vehicle is known before: another one."""
    return load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")


def phone(drive: Drive, twin: Twin, metres: float, sigma: float = 2.5, late: float = 0.0) -> Drive:
    """The drive with positions ``metres`` behind along the road, once a second."""
    assert twin.datum is not None
    fix = drive.fix.select(np.arange(3, len(drive.fix), 10))
    frame = LocalMap(twin.datum)
    enu = frame.to_map(fix.latitude, fix.longitude, fix.altitude) - np.array([metres, 0.0, 0.0])
    latitude, longitude, altitude = frame.to_geodetic(enu).T
    given = np.full_like(fix.sigma, sigma)
    own = replace(fix, t=fix.t + late, latitude=latitude, longitude=longitude, altitude=altitude, sigma=given)
    velocity = replace(drive.velocity, t=drive.velocity.t + late)
    return replace(drive, fix=own, velocity=velocity.select(np.arange(3, len(velocity), 10)))


def driven(twin: Twin, road: Road = BUMP, seed: int = 1) -> Drive:
    return synthetic_drive(twin, road, KNOTS, seed, u=5.0)


@pytest.mark.parametrize("metres", [-4.0, 1.7, 5.5])
def test_a_pass_is_found_by_another_twin(twin: Twin, softer: Twin, metres: float) -> None:
    observed = observe(phone(driven(twin), twin, metres), softer, BUMP)
    found = place(observed, softer)
    assert found is not None and found.spans == ()
    at = int(np.argmin(np.abs(np.interp(found.t, observed.t, observed.position) + metres - 25.0)))
    assert found.ahead[at] == pytest.approx(metres, abs=0.3)
    moved = found.moved(observed)
    np.testing.assert_allclose(moved.position, observed.position + found.ahead[at], atol=0.5)
    assert any("placed on the road" in line for line in moved.warnings)


def test_an_accurate_receiver_stays_where_it_is(twin: Twin) -> None:
    observed = observe(driven(twin), twin, BUMP)
    assert not is_open(observed) and place(observed, twin) is None
    assert on_one_clock(observed) is observed


def test_the_limit_is_half_the_shortest_wave(twin: Twin) -> None:
    """At 5 m/s and 20 Hz the shortest wave is 0.25 m long."""
    drive = driven(twin)
    for sigma, wanted in ((0.03, False), (0.06, True)):
        assert is_open(observe(phone(drive, twin, 0.0, sigma), twin, BUMP)) is wanted


def test_a_receiver_that_states_no_accuracy_is_as_good_as_its_kind(twin: Twin) -> None:
    drive = driven(twin)
    for status, sigma in ((0, 2.5), (-2, 2.5), (1, 1.0), (2, 0.0)):
        kind = np.full_like(drive.fix.status, status)
        fix = replace(drive.fix, status=kind, sigma=np.full_like(drive.fix.sigma, np.nan))
        seen = observe(replace(drive, fix=fix), twin, BUMP)
        assert seen.position_sigma == pytest.approx(sigma) and is_open(seen) is (sigma > 0.0)
        assert any("how accurate" in line for line in seen.warnings) is (sigma > 0.0)


@pytest.mark.long
def test_a_bump_of_another_road_is_not_placed(twin: Twin) -> None:
    """Felt is a bump; on the road of the file there is none: the pass is not compared."""
    observed = observe(phone(driven(twin), twin, 1.0), twin, flat_road(length=70.0))
    with pytest.raises(NoPlaceError, match="no place on the road"):
        place(observed, twin)


@pytest.mark.long
def test_a_drive_of_no_place_is_left_out_where_another_has_one(
    twin: Twin, softer: Twin, tmp_path: Path
) -> None:
    """The second drive went over a bump that the road of the file has not."""
    other = bump_road(circular(2.5, 0.12), at=29.0, length=70.0)
    bags = []
    for name, road in (("there", BUMP), ("elsewhere", other)):
        bags.append(str(tmp_path / name))
        write_drive(replace(phone(driven(twin, road), twin, 1.0), name=name), tmp_path / name)
    write_road(BUMP, tmp_path / "road.crg")
    save_twin(
        softer.model_copy(update={"road": RoadFile(file=tmp_path / "road.crg")}), tmp_path / "twin.yaml"
    )
    asked = str(tmp_path / "twin.yaml"), tuple(bags)
    setup = set_up(CalibrationRequest(*asked), lambda _: None, lambda: False)
    case = read_case(DiagnosisRequest(*asked), lambda _: None, lambda: False)
    for drives, warnings in ((setup.drives, setup.warnings), (case.drives, case.warnings)):
        assert [d.name for d in drives] == ["there"]
        assert any(w.startswith("elsewhere: no place") and w.endswith("left out") for w in warnings)
    assert len(setup.placements) == 1 and case.active == (True,)
    with pytest.raises(NoPlaceError, match="elsewhere"):
        read_case(DiagnosisRequest(asked[0], (bags[1],)), lambda _: None, lambda: False)


@pytest.mark.long
@pytest.mark.parametrize("across", [0.0, 0.35])
def test_between_passes_a_place_is_found_to_centimetres(repository: Path, across: float) -> None:
    """Positions drift by half a metre along the road and are off to the side, on a road whose wheel paths differ."""
    folder = repository / "bags" / "crg_road"
    exact, road = read_drive(folder), load_road(folder / "road.crg")
    given = load_twin(folder / "twin.yaml")
    assert given.datum is not None
    frame, fix = LocalMap(given.datum), exact.fix
    seen = observe(exact, given, road)
    course = np.interp(fix.t, seen.trajectory.t, np.unwrap(seen.trajectory.yaw))
    drift = 1.2 + 0.5 * np.sin(2.0 * np.pi * (fix.t - fix.t[0]) / 25.0)
    enu = frame.to_map(fix.latitude, fix.longitude, fix.altitude)
    enu[:, 0] -= drift * np.cos(course) - across * np.sin(course)
    enu[:, 1] -= drift * np.sin(course) + across * np.cos(course)
    latitude, longitude, altitude = frame.to_geodetic(enu).T
    off = replace(
        fix, latitude=latitude, longitude=longitude, altitude=altitude, sigma=np.full_like(fix.sigma, 1.5)
    )
    observed = observe(replace(exact, fix=off), given, road)
    found = place(observed, given)
    assert found is not None
    path, truth = found.moved(observed).trajectory, seen.trajectory
    used = path.valid & (path.t > found.t[0]) & (path.t < found.t[-1])
    for start, end in found.spans:
        used &= (path.t < start) | (path.t > end)
    t, yaw = path.t[used], path.yaw[used]
    x, y = np.interp(t, truth.t, truth.x) - path.x[used], np.interp(t, truth.t, truth.y) - path.y[used]
    along, left = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
    assert used.mean() > 0.5
    assert np.median(np.abs(along)) < 0.05
    assert np.median(np.abs(left)) < 0.05


@pytest.mark.parametrize("kept", [True, False])
def test_passes_without_positions(twin: Twin, softer: Twin, kept: bool) -> None:
    """The delay between the axles gives the speed, also where no receiver does."""
    drive = driven(twin)
    blind = replace(drive, fix=FixData.empty())
    if not kept:
        blind = replace(blind, velocity=type(drive.velocity).empty())
    observed = observe(blind, softer, BUMP)
    passes = felt_passes(observed.signals, softer, BUMP, (np.empty(0), np.empty(0)))
    assert len(passes) == 1
    assert passes[0].speed == pytest.approx(5.0, rel=0.06)
    seen = observe(drive, twin, BUMP)
    there = float(np.interp(passes[0].t, seen.t, seen.position))
    assert passes[0].u == pytest.approx(there, abs=0.4)
    near = np.abs(observed.trajectory.t - passes[0].t) < 2.0
    truth = np.interp(observed.trajectory.t, seen.trajectory.t, seen.trajectory.speed)
    np.testing.assert_allclose(observed.trajectory.speed[near], truth[near], atol=0.4)


def test_without_positions_a_bump_must_be_felt(twin: Twin) -> None:
    blind = replace(driven(twin, flat_road(length=70.0)), fix=FixData.empty())
    with pytest.raises(InputError, match="no pass over a bump"):
        observe(blind, twin, BUMP)


def test_between_passes_over_one_bump_the_place_does_not_jump(repository: Path) -> None:
    """A jump would drag the wheels over the bump within one step."""
    folder = repository / "bags" / "bump_15kmh"
    drive = replace(read_drive(folder), fix=FixData.empty())
    observed = observe(drive, load_twin(folder / "twin.yaml"), load_road(folder / "road.crg"))
    u, _ = observed.road.xy_to_uv(observed.trajectory.x, observed.trajectory.y)
    speed = np.abs(np.diff(u)) / np.diff(observed.trajectory.t)
    assert speed.max() < 20.0
    used = observed.trajectory.valid[1:] & observed.trajectory.valid[:-1]
    np.testing.assert_allclose(speed[used], observed.trajectory.speed[1:][used], atol=0.3)


@pytest.mark.parametrize("left", [4.5, -5.5])
def test_a_receiver_off_to_the_side_does_not_leave_the_road(twin: Twin, softer: Twin, left: float) -> None:
    """A lane 6 m wide, positions 2.5 m off in each direction: within three deviations the car is on its road."""
    from suspension_twin.calibration.setup import observe_checked

    lane = bump_road(circular(0.9, 0.05), at=25.0, length=70.0, width=6.0)
    drive = phone(driven(twin, lane), twin, 1.7)
    assert twin.datum is not None
    frame = LocalMap(twin.datum)
    enu = frame.to_map(drive.fix.latitude, drive.fix.longitude, drive.fix.altitude)

    def beside(metres: float, sigma: float) -> Drive:
        moved = frame.to_geodetic(enu + np.array([0.0, metres, 0.0])).T
        columns = dict(zip(("latitude", "longitude", "altitude"), moved, strict=True))
        accuracy = np.full_like(drive.fix.sigma, sigma)
        return replace(drive, fix=replace(drive.fix, **columns, sigma=accuracy))

    observed = observe_checked(beside(left, 2.5), softer, lane)
    found = place(observed, softer)
    assert found is not None and found.spans == ()
    assert found.moved(observed).inside.mean() > 0.9
    for metres, sigma in ((left, 0.01), (20.0, 2.5)):
        with pytest.raises(InputError, match="never drives on the road"):
            observe_checked(beside(metres, sigma), softer, lane)


def test_a_place_is_kept_where_the_sensor_is_read_otherwise(twin: Twin, softer: Twin) -> None:
    from suspension_twin.inference.sensor_correction import SensorCorrection

    observed = observe(phone(driven(twin), twin, 4.0), softer, BUMP)
    found = place(observed, softer)
    assert found is not None
    kept = found.kept(observed)
    np.testing.assert_allclose(kept.trajectory.x, found.moved(observed).trajectory.x, atol=1e-9)
    read = kept.source.excitation(SensorCorrection(gain=1.001))
    np.testing.assert_allclose(read.path.x, kept.trajectory.x, atol=0.05)


def test_a_phones_drive_is_simulated_where_it_was_felt(repository: Path, twin: Twin) -> None:
    drive = read_drive(repository / "bags" / "bump_phone")
    road = load_road(repository / "bags" / "bump_15kmh" / "road.crg")
    found = simulate_drive(drive, twin, road)
    assert any("placed on the road" in line for line in found.observation.warnings)
    (beside,) = (line for line in found.observation.warnings if line.startswith("off the road"))
    assert f" for {found.observation.off_road.seconds:.1f} s (" in beside
    at_its_positions = observe(drive, twin, road)
    assert at_its_positions.gap(at_its_positions.simulated(twin)).rms > 0.5
    assert found.gap.rms < 0.1


def test_what_cannot_be_placed_is_simulated_at_its_positions(twin: Twin) -> None:
    other = phone(driven(twin, bump_road(circular(2.5, 0.12), at=29.0, length=70.0)), twin, 1.0)
    found = simulate_drive(other, twin, BUMP)
    assert any("it is left at its positions" in line for line in found.observation.warnings)
    np.testing.assert_allclose(found.observation.position, observe(other, twin, BUMP).position, atol=0.5)


def test_a_receiver_off_to_the_side_is_on_its_road(twin: Twin) -> None:
    """Of a lane three metres wide, as of any that a phone's receiver misses."""
    drive = phone(driven(twin), twin, 0.0)
    assert twin.datum is not None
    frame = LocalMap(twin.datum)
    enu = frame.to_map(drive.fix.latitude, drive.fix.longitude, drive.fix.altitude)
    enu[:, 1] += 4.5
    latitude, longitude, altitude = frame.to_geodetic(enu).T
    fix = replace(drive.fix, latitude=latitude, longitude=longitude, altitude=altitude)
    found = simulate_drive(replace(drive, fix=fix), twin, BUMP)
    assert found.observation.inside[np.abs(found.observation.speed) > 1.0].mean() > 0.9
    assert found.gap.rms < 1.5 * simulate_drive(drive, twin, BUMP).gap.rms


@pytest.mark.long
def test_the_gap_of_a_phones_drive_is_that_of_its_passes(repository: Path) -> None:
    """Though the mounting that was found gives another path, which nobody has placed."""
    bags = repository / "bags"
    found = calibrate(
        CalibrationRequest(twin=str(bags / "bump_15kmh" / "twin.yaml"), bags=(str(bags / "bump_phone"),))
    )
    (drive,) = found.drives
    assert found.twin.imu != load_twin(bags / "bump_15kmh" / "twin.yaml").imu
    assert drive.gap_after.rms < 1.3 * drive.nuisance_free < 0.3 * drive.gap_before.rms
    # and so is that of the twin that is written
    assert simulate_drive(read_drive(bags / "bump_phone"), found.twin).gap.rms < 0.3 * drive.gap_before.rms
