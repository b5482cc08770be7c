# SPDX-License-Identifier: Apache-2.0
"""Passes are placed on the road by what was felt, where the receiver leaves the place open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData
from suspension_twin.errors import InputError
from suspension_twin.inference.felt_passes import felt_passes
from suspension_twin.inference.observation import observe
from suspension_twin.inference.placement import is_open, on_one_clock, place
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road import Road, bump_road, circular, flat_road, load_road
from suspension_twin.vehicle.twin import Twin, load_twin

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


@pytest.mark.long
def test_a_bump_of_another_road_is_not_placed(twin: Twin) -> None:
    """Felt is a bump; on the road of the file there is none: the pass is not compared."""
    from suspension_twin.errors import WorkError

    observed = observe(phone(driven(twin), twin, 1.0), twin, flat_road(length=70.0))
    with pytest.raises(WorkError, match="no place on the road"):
        place(observed, twin)


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
