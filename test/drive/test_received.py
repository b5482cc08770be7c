# SPDX-License-Identifier: Apache-2.0
"""Positions and velocities as receivers and phones give them: held, repeated, incomplete, from another time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from suspension_twin.drive.checks import clean_drive, path_length, rhythm_of, summarise
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.received import (
    LivePlaces,
    held_places,
    interpolated_places,
    one_per_epoch,
    velocity_fault,
)
from suspension_twin.drive.streams import Streams, velocities_from_course, velocities_from_fixes
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.drive.write import write_drive

Same = Callable[[Drive, Drive], None]
START = 1_700_000_000.0
METRE = 1.0 / 111_195.0  # degrees


def way(t: np.ndarray) -> np.ndarray:
    """A car that stands for 6 s, drives off, stands again from 20 to 30 s and drives on: m north."""
    grid = np.arange(0, 61, 0.001)
    speed = np.interp(grid, [0, 6, 10, 16, 20, 30, 34, 61], [0, 0, 9, 9, 0, 0, 12, 12])
    return np.interp(t, grid, np.cumsum(speed) * 0.001)


def fixes(t: np.ndarray, north: np.ndarray, sigma: float = 1.0) -> FixData:
    n = t.size
    place = 47.0 + METRE * north, np.full(n, 11.0), np.full(n, 500.0)
    return FixData(START + t, *place, np.zeros(n, dtype=np.int8), np.full((n, 3), sigma))


def drive_of(fix: FixData, velocity: VelocityData | None = None, seconds: float = 60.0) -> Drive:
    t = START + np.arange(0, seconds, 0.01)
    noise = np.random.default_rng(0).normal(size=(t.size, 6)) * 0.01
    imu = ImuData(t, noise[:, :3] + [0, 0, 9.81], noise[:, 3:])
    return Drive("made", imu, fix, velocity or VelocityData.empty())


def said(drive: Drive, words: str) -> bool:
    return any(words in line for line in drive.warnings)


# --- positions that are held


@settings(max_examples=60, deadline=None)
@given(
    computed=st.sampled_from([1.0, 2.0, 5.0]),
    given_at=st.sampled_from([10.0, 25.0, 50.0, 100.0]),
    jitter=st.floats(0.0, 0.2),
    seed=st.integers(0, 99),
)
def test_held_positions_are_taken_once(computed: float, given_at: float, jitter: float, seed: int) -> None:
    """A receiver that filters has one place while it stands: there is no hole in its stream then."""
    t = np.arange(0, 60, 1 / given_at)
    own = np.floor(t * computed + 1e-9) / computed
    stamps = t + np.random.default_rng(seed).uniform(-0.5, 0.5, t.size) * jitter / given_at
    fix = fixes(stamps, way(own))
    kept = fix.select(~held_places(fix))
    rhythm = rhythm_of(kept.t)
    assert rhythm.rate == pytest.approx(computed, rel=0.05) and rhythm.gaps == ()
    assert abs(rhythm.count - 60 * computed) <= 3 + 0.02 * 60 * computed
    moving = np.flatnonzero(np.diff(kept.latitude) > METRE)
    # what stays is the first of its place: as late as the receiver gave it first
    late = kept.t[moving + 1] - START - np.interp(kept.latitude[moving + 1], 47 + METRE * way(t), t)
    assert np.median(late) < 1.5 / given_at


@pytest.mark.parametrize("rate", [1.0, 5.0, 10.0])
@pytest.mark.parametrize("quantum", [0.0, 0.18, 1.1])
def test_a_receivers_own_positions_stay(rate: float, quantum: float) -> None:
    """Also those of a car that stands, and of a receiver with few digits."""
    t = np.arange(0, 60, 1 / rate) + np.random.default_rng(1).uniform(-0.1, 0.1, int(60 * rate)) / rate
    north = way(np.maximum(t, 0))
    fix = fixes(t, np.round(north / quantum) * quantum if quantum else north)
    held = held_places(fix)
    assert not interpolated_places(fix).any()
    assert rhythm_of(fix.t[~held]).gaps == () and held.sum() < 0.1 * t.size
    if not quantum:
        assert not held.any()


def test_a_position_repeated_while_driving_is_held() -> None:
    """A receiver at 10 Hz that misses an epoch now and then gives the last one again; one without a fix, for long."""
    t = np.arange(0, 60, 0.1)
    north = way(t)
    missed = [120, 133, 400, 401, *range(450, 500)]
    for i in missed:
        north[i] = north[i - 1]
    assert np.flatnonzero(held_places(fixes(t, north))).tolist() == missed


def test_live_positions_are_judged_alike() -> None:
    t = np.arange(0, 60, 0.02)
    fix = fixes(t, way(np.floor(t)))
    live = LivePlaces()
    held = np.concatenate([live.held(fix.select(np.array([i]))) for i in range(len(fix))])
    later = t >= 12.0  # it has to see the receiver's pace first
    kept = fix.t[~held & later]
    assert 40 <= kept.size <= 50 and np.diff(kept).max() < 2.0
    alone = fixes(np.arange(0, 60, 0.1), way(np.arange(0, 60, 0.1)))
    live = LivePlaces()
    assert not live.held(alone).any()
    assert live.held(alone.select(np.array([len(alone) - 1]))).all()  # the stamp of the last one again


@settings(max_examples=60, deadline=None)
@given(
    interval=st.sampled_from([0.5, 1.0]),
    given_at=st.sampled_from([10.0, 25.0, 50.0, 100.0]),
    decimals=st.sampled_from([7, 9, 15]),
    begin=st.floats(0.0, 1.0),
)
def test_of_interpolated_positions_the_computed_ones_stay(
    interval: float, given_at: float, decimals: int, begin: float
) -> None:
    """Whatever the rate that they are written at, and with computed ones between two rows, too."""
    assume(given_at * interval >= 10)  # midway between five rows, little is left to see
    computed = np.arange(0.0, 61.0, interval)
    t = np.arange(begin, 60.0, 1 / given_at)
    fix = fixes(t, np.interp(t, computed, way(computed)))
    fix = replace(fix, latitude=np.round(fix.latitude, decimals))
    kept = fix.t[~interpolated_places(fix)] - START
    assert (
        kept.size == pytest.approx((60.0 - begin) / interval, abs=2) and np.diff(kept).max() < 1.5 * interval
    )
    beside = np.abs(kept / interval - np.round(kept / interval)) * interval
    assert np.median(beside) < 1.5 / given_at


@pytest.mark.parametrize("rate", [10.0, 100.0])
@pytest.mark.parametrize("quantum", [0.0, 0.011, 0.11, 1.1])
def test_nothing_is_made_of_a_simulators_exact_ways(rate: float, quantum: float) -> None:
    """A straight way at constant speed, one around four corners, and a circle."""
    t = np.arange(0, 120, 1 / rate)
    along = 8.0 * t % 400.0
    ways = [
        (10.0 * t, 0.0 * t),
        (np.interp(along, [0, 100, 200, 300, 400], [0, 100, 100, 0, 0]), np.clip(along - 100, 0, 100)),
        (20.0 * np.cos(0.3 * t), 20.0 * np.sin(0.3 * t)),
    ]
    for north, east in ways:
        fix = fixes(t, np.round(north / quantum) * quantum if quantum else north)
        east = np.round(east / quantum) * quantum if quantum else east
        fix = replace(fix, longitude=11.0 + METRE * east)
        assert not interpolated_places(fix).any()


@pytest.mark.parametrize("rate", [10.0, 100.0])
def test_live_positions_that_are_interpolated_are_judged_alike(rate: float) -> None:
    t, computed = np.arange(0.3, 60, 1 / rate), np.arange(0.0, 61.0)
    fix = fixes(t, np.interp(t, computed, way(computed)))
    live = LivePlaces()
    taken = t[~np.concatenate([live.held(fix.select(np.array([i]))) for i in range(len(fix))])]
    later = taken[taken > 30.0]  # it has to see some changes of speed first
    assert later.size == 30 and np.abs(later - np.round(later)).max() < 0.6 / rate


@pytest.mark.parametrize("interpolated", [False, True])
@pytest.mark.parametrize("derived", [False, True])
def test_held_positions_in_a_table_and_in_a_bag(derived: bool, interpolated: bool, tmp_path: Path) -> None:
    t = np.arange(0, 60, 0.02)
    own = np.floor(t)
    north = way(own) + interpolated * (t - own) * (way(own + 1) - way(own))
    speed = (way(own + 0.5) - way(np.maximum(own - 0.5, 0))) if not derived else None
    velocity = None if speed is None else VelocityData(START + t, np.stack([0 * t, speed, 0 * t], axis=1))
    drive = drive_of(fixes(t, north), velocity)
    write_drive(drive, tmp_path / "bag")
    read = import_drive([tmp_path / "bag"]).drive
    head, rows = "t,ax,ay,az,gx,gy,gz,lat,lon,alt,e,n", []
    imu = drive.imu
    for i in range(0, len(imu), 2):
        j = i // 2
        values = [imu.t[i], *imu.specific_force[i], *imu.angular_rate[i], drive.fix.latitude[j], 11.0, 500.0]
        rows.append(",".join(map(repr, map(float, [*values, 0.0, 0.0 if speed is None else speed[j]]))))
    (tmp_path / "log.csv").write_text("\n".join([head, *rows]))
    (tmp_path / "map.yaml").write_text(
        "imu: {time: {column: t}, specific_force: {columns: [ax, ay, az], unit: m/s2},"
        " angular_rate: {columns: [gx, gy, gz], unit: rad/s}}\n"
        "fix: {time: {column: t}, latitude: lat, longitude: lon, altitude: alt}\n"
        + ("vel: {derive: true}" if derived else "vel: {time: {column: t}, east: e, north: n}")
    )
    table = import_drive([tmp_path / "log.csv"], mapping=tmp_path / "map.yaml").drive
    for found in (read, table):
        figures = summarise(found)
        assert (figures.fix.count, round(figures.fix.rate, 2)) == (60, 1.0) and figures.fix.gaps == ()
        fault = "are interpolated between" if interpolated else "repeat the position before"
        assert said(found, f"2940 of 3000 fixes {fault}")
        assert figures.top_speed < 12.5 and figures.path == pytest.approx(way(np.array([59.0]))[0], rel=0.05)


# --- epochs, and what is not known of them


def test_of_an_epoch_the_most_complete_fix_is_kept(tmp_path: Path) -> None:
    """gpsd reports an epoch again when it knows more of it, with a stamp of whole seconds."""
    t = np.repeat(np.arange(0.0, 30.0), 3)
    fix = fixes(t, way(t))
    fix.altitude[0::3] = np.nan
    fix.sigma[0::3] = np.nan
    fix.sigma[1::3, 2] = np.nan
    assert np.flatnonzero(one_per_epoch(fix)).tolist() == list(range(2, 90, 3))
    write_drive(drive_of(fix, seconds=30.0), tmp_path / "bag")
    read = read_drive(tmp_path / "bag")
    assert len(read.fix) == 30 and (read.fix.altitude == 500).all() and said(read, "60 of 90 fixes")


def test_a_vertical_velocity_that_is_not_known_leaves_the_others(tmp_path: Path) -> None:
    t = START + np.arange(30.0)
    enu = np.stack([0 * t + 3.0, 0 * t + 4.0, np.full(30, np.nan)], axis=1)
    enu[7] = np.nan
    write_drive(drive_of(fixes(t - START, 5 * (t - START)), VelocityData(t, enu), 30.0), tmp_path / "bag")
    read = read_drive(tmp_path / "bag")
    assert len(read.velocity) == 29 and (read.velocity.enu == [3.0, 4.0, 0.0]).all()
    assert said(read, "29 of 30 velocities have no vertical part") and said(
        read, "1 of 30 velocities are no numbers"
    )


def test_a_path_without_altitudes_has_a_length() -> None:
    fix = fixes(np.arange(30.0), 5 * np.arange(30.0))
    fix.altitude[:] = np.nan
    assert path_length(fix) == pytest.approx(145.0, rel=3e-3)
    assert len(velocities_from_fixes(fix)) == 30


# --- velocities without a course


def test_how_many_velocities_have_no_course_is_said() -> None:
    streams = Streams("")
    speed = np.array([0.1, 5.0, 5.0, np.nan, -1.0, 5.0])
    streams.add_course(np.arange(6.0), speed, np.array([-1.0, 90.0, -1.0, 10.0, 10.0, np.nan]))
    assert streams.velocity is not None and streams.velocity.t.tolist() == [0.0, 1.0]
    assert streams.warnings == ["3 of 5 velocities have no speed or no course: left out"]


def test_where_all_velocities_are_gone_they_are_derived() -> None:
    speed = np.array([0.0, 0.2, 5.0, 6.0])
    assert len(velocities_from_course(np.arange(4.0), speed, np.full(4, -1.0))) == 0
    assert len(velocities_from_course(np.arange(2.0), speed[:2], np.full(2, -1.0))) == 2


@pytest.mark.parametrize("count", [0, 1, 2])
def test_no_figure_is_no_number(count: int) -> None:
    """With so few velocities and positions there is no path or no speed: then it is not named."""
    t = START + np.arange(count)
    for fix in (FixData.empty(), fixes(np.arange(float(count)), np.arange(float(count)))):
        drive = drive_of(fix, VelocityData(t, np.ones((count, 3))), 5.0)
        assert "nan" not in str(clean_drive(drive)).lower()


# --- what is not of the drive


@pytest.mark.parametrize("before", [5.0, 600.0, 1e6])
@pytest.mark.parametrize("rate", [1.0, 10.0])
def test_a_cached_first_fix(before: float, rate: float, tmp_path: Path) -> None:
    """The position that a phone still had, from another place and at another speed."""
    t = np.arange(0, 30, 1 / rate)
    cached = np.concatenate([[-before], t])
    velocity = VelocityData(START + cached, np.zeros((cached.size, 3)))
    velocity.enu[:, 1] = np.append(25.0, np.gradient(way(t), t))
    fix = fixes(cached, np.append(-4000.0, way(t)))
    for given_velocity in (velocity, None):
        write_drive(drive_of(fix, given_velocity, 30.0), tmp_path / "bag", overwrite=True)
        read = import_drive([tmp_path / "bag"]).drive
        figures = summarise(read)
        assert len(read.fix) == t.size and any(
            f"1 of {t.size + 1} fixes" in w or "/fix: 1 of" in w for w in read.warnings
        )
        assert figures.top_speed < 9.5 and figures.path == pytest.approx(way(t)[-1], rel=0.02)


def test_a_receiver_that_was_on_earlier_and_later_is_kept(same: Same) -> None:
    t = np.arange(-30, 90, 0.5)
    drive = drive_of(fixes(t, 5 * t), VelocityData(START + t, np.tile([0.0, 5.0, 0.0], (t.size, 1))))
    same(clean_drive(drive), drive)


def test_distances_stop_at_gaps() -> None:
    t = np.concatenate([np.arange(0, 10, 0.5), np.arange(40, 50, 0.5)])
    fix = fixes(t, 8 * t)
    assert path_length(fix) == pytest.approx(2 * 9.5 * 8, rel=3e-3)
    drive = drive_of(fix, VelocityData(fix.t, np.tile([0.0, 8.0, 0.0], (t.size, 1))))
    assert summarise(drive).path == pytest.approx(2 * 9.5 * 8)
    # a few messages that were lost are no gap
    lost = replace(drive, velocity=drive.velocity.select(np.arange(t.size) != 7))
    assert summarise(lost).path == pytest.approx(2 * 9.5 * 8)


def winding(seconds: float = 120.0, sigma: float = 0.02, seed: int = 0) -> tuple[FixData, VelocityData]:
    """A drive through bends across the date line, with a stop: positions at 5 Hz, velocities at 10 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.1)
    speed, yaw = 6.0 * (1.0 + np.sin(0.1 * t)), 1.5 * np.sin(0.05 * t)
    enu = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw), 0.0 * t])
    way = np.cumsum(enu, axis=0)[::2] * 0.1 + sigma * rng.standard_normal((t[::2].size, 3))
    latitude = 51.0 + np.degrees(way[:, 1] / 6_371_000.0)
    longitude = 179.9995 + np.degrees(way[:, 0] / 6_371_000.0 / np.cos(np.radians(51.0)))
    longitude = np.remainder(longitude + 180.0, 360.0) - 180.0  # across the date line
    count = latitude.size
    spread = np.full((count, 3), sigma)
    fix = FixData(t[::2], latitude, longitude, np.zeros(count), np.zeros(count, dtype=np.int8), spread)
    return fix, VelocityData(t, enu)


SPEEDS = {
    "sound": (lambda enu: enu, ""),
    "km/h": (lambda enu: 3.6 * enu, "they come in km/h"),
    "knots": (lambda enu: enu * 3600 / 1852, "they come in knots"),
    "mph": (lambda enu: enu / 0.44704, "they come in mph"),
    "divided": (lambda enu: enu / 3.6, "0.28 times as fast as the positions move: check their unit"),
    "exchanged": (lambda enu: enu[:, [1, 0, 2]], "are exchanged"),
    "none": (lambda enu: 0.0 * enu, "stands, and its positions move"),
    "back": (lambda enu: -enu, "180° beside"),
    "of another drive": (lambda enu: enu[::-1] * [1, -1, 1] * np.sign(np.sin(enu[:, :1] * 9)), "other ways"),
}


@pytest.mark.parametrize("sigma", [0.02, 2.5])
@pytest.mark.parametrize("case", SPEEDS)
def test_velocities_are_those_of_the_positions_or_it_is_said(case: str, sigma: float) -> None:
    fix, velocity = winding(sigma=sigma)
    spoil, says = SPEEDS[case]
    fault = velocity_fault(fix, VelocityData(velocity.t, spoil(velocity.enu)))
    assert says in fault if says else fault == ""


def test_of_velocities_that_nothing_is_known_of_nothing_is_said() -> None:
    fix, velocity = winding()
    assert velocity_fault(fix, VelocityData.empty()) == ""
    assert velocity_fault(fix.select(fix.t < 9.0), velocity) == ""
    assert velocity_fault(fix, VelocityData(velocity.t + 1e4, velocity.enu)) == ""
    holes = (velocity.t % 7.0) < 3.0
    assert velocity_fault(fix, velocity.select(holes)) == ""
