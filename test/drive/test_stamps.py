# SPDX-License-Identifier: Apache-2.0
"""Stamps that recorders give wrongly: counters that begin again, clocks set back, packets, doubled topics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.calibration.checks import check_recording
from suspension_twin.drive.checks import summarise
from suspension_twin.drive.importing import Imported, import_drive
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.stamps import evened, jumps_back, of_one_recording, own_stamps, strays, unwrapped
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import BagWriter, write_drive
from suspension_twin.errors import InputError

Make = Callable[..., Drive]
IMU = "sensor_msgs/msg/Imu"
START = 1_700_000_000.0
N = 600
T = np.arange(N) / 100
RNG = np.random.default_rng(4)
FORCE = RNG.normal(size=(N, 3)) * 0.1 + np.array([0.0, 0.0, 9.81])
RATE = RNG.normal(size=(N, 3)) * 0.01
WIDTHS = [2.0**bits * unit for bits in (16, 24, 32) for unit in (1e-6, 1e-3, 1 / 32768)]

MAPPING = """
imu:
  time: {column: t}
  specific_force: {columns: [ax, ay, az], unit: m/s2}
  angular_rate: {columns: [gx, gy, gz], unit: rad/s}
"""


def imported(folder: Path, t: Sequence[float] | np.ndarray, fix: np.ndarray | None = None) -> Imported:
    """A table of an IMU, and one of positions at the stamps ``fix``."""
    folder.mkdir(exist_ok=True)
    rows = [
        ",".join(map(repr, map(float, row))) for row in np.column_stack([t, FORCE[: len(t)], RATE[: len(t)]])
    ]
    (folder / "imu.csv").write_text("\n".join(["t,ax,ay,az,gx,gy,gz", *rows]))
    mapping = MAPPING
    if fix is not None:
        rows = [f"{float(x)!r},{47 + 1e-5 * i},11.0,500" for i, x in enumerate(fix)]
        (folder / "gps.csv").write_text("\n".join(["t,lat,lon,alt", *rows]))
        mapping += "fix: {file: gps.csv, time: {column: t}, latitude: lat, longitude: lon, altitude: alt}\n"
    (folder / "map.yaml").write_text(mapping)
    return import_drive([folder / "imu.csv"], mapping=folder / "map.yaml")


def bag(path: Path, header: np.ndarray, recorded: np.ndarray, rows: np.ndarray | None = None) -> Path:
    """A bag of IMU messages with these stamps, in ns."""
    rows = np.arange(header.size) if rows is None else rows
    values: dict[str, Any] = {
        "header.stamp.sec": header // 10**9,
        "header.stamp.nanosec": header % 10**9,
        "linear_acceleration.x": FORCE[rows % N, 0],
        "linear_acceleration.z": FORCE[rows % N, 2],
        "angular_velocity.z": RATE[rows % N, 2],
    }
    with BagWriter(path) as writer:
        writer.write("/imu/data_raw", IMU, recorded, values)
    return path


def said(drive: Drive, words: str) -> bool:
    return any(words in line for line in drive.warnings)


# --- counters that begin again


@settings(max_examples=80, deadline=None)
@given(
    span=st.sampled_from(WIDTHS),
    rate=st.sampled_from([1.0, 10.0, 52.0, 100.0, 400.0]),
    begin=st.floats(0.0, 1.0),
    jitter=st.floats(0.0, 0.4),
    base=st.sampled_from([0.0, START]),
)
def test_a_counter_of_any_usual_width_goes_on(
    span: float, rate: float, begin: float, jitter: float, base: float
) -> None:
    rate = max(rate, 10.0 / span)  # a counter that is read less often than it begins again cannot be followed
    n = 200
    true = (np.arange(n) + jitter * RNG.uniform(-1, 1, n)) / rate
    true += span * np.ceil(n / rate / span) - begin * true[-1] * 0.9 - true[5]
    t, found = unwrapped(base + np.mod(true, span))
    began = np.flatnonzero(np.diff(np.mod(true, span)) < 0)
    assert found == (span if began.size else 0.0)
    np.testing.assert_allclose(np.diff(t), np.diff(true), atol=1e-6)


@pytest.mark.parametrize("span", [2.0**32 * 1e-6, 2.0**24 * 1e-6, 2.0**16 * 1e-3, 2.0**32 / 32768])
def test_a_table_and_a_bag_of_such_a_counter(span: float, tmp_path: Path) -> None:
    true = span - 2.0 + T
    fix = span - 1.9 + np.arange(0, 5.8, 0.2)
    table = imported(tmp_path / "table", np.mod(true, span), np.mod(fix, span)).drive
    np.testing.assert_allclose(table.imu.t, true, atol=1e-6)
    np.testing.assert_allclose(table.fix.t, fix, atol=1e-6)
    ns = np.rint(np.mod(true, span) * 1e9).astype(np.int64)
    read = read_drive(bag(tmp_path / "bag", ns, np.int64(START * 1e9) + np.rint(T * 1e9).astype(np.int64)))
    np.testing.assert_allclose(read.imu.t, true, atol=1e-6)
    for drive in (table, read):
        assert summarise(drive).imu.duration == pytest.approx(5.99)
        assert said(drive, f"begins again after {span:.6g} s") and not said(drive, "order")


def test_positions_that_begin_after_the_counter_did(tmp_path: Path) -> None:
    span = 2.0**32 * 1e-6
    drive = imported(tmp_path, np.mod(span - 2.0 + T, span), 0.5 + np.arange(0, 3.0, 0.2)).drive
    np.testing.assert_allclose(drive.fix.t, span + 0.5 + np.arange(0, 3.0, 0.2), atol=1e-6)


@pytest.mark.parametrize("drift", [0.0, 200.0])
def test_a_counter_with_a_drift_or_tied_to_another_clock(drift: float, tmp_path: Path) -> None:
    span, fast = 2.0**32 * 1e-6, 1 + drift * 1e-6
    raw = np.mod(span - 2.0 + T * fast, span)
    rows = [
        ",".join(map(repr, map(float, row)))
        for row in np.column_stack([raw, FORCE, RATE, np.round(START + T, 6)])
    ]
    (tmp_path / "imu.csv").write_text("\n".join(["t,ax,ay,az,gx,gy,gz,utc", *rows]))
    tie = "base: clock, tie: {column: t, posix: {column: utc}}"
    for base in (tie, f"drift_ppm: {drift}"):
        (tmp_path / "map.yaml").write_text(MAPPING.replace("{column: t}", f"{{column: t, {base}}}"))
        drive = import_drive([tmp_path / "imu.csv"], mapping=tmp_path / "map.yaml").drive
        begin = START if base == tie else span - 2.0
        np.testing.assert_allclose(drive.imu.t - begin, T, atol=2e-3 if base == tie else 1e-6)


# --- clocks that were set back, strays


@pytest.mark.parametrize("back", [2.0, 5.7, 500.0])
def test_a_clock_that_was_set_back_is_refused_and_named(back: float, tmp_path: Path) -> None:
    t = START + np.where(T < 3.0, T, T - back)
    with pytest.raises(InputError) as caught:
        imported(tmp_path, t)
    words = str(caught.value)
    assert "\n" not in words and "accelerometer" in words
    assert (
        f"{back - 0.01:.3f} s" in words and "2023-11-14 22:13:22.990 UTC" in words and "sample 300" in words
    )


def test_a_bag_that_was_set_back_says_when_and_how_far(tmp_path: Path) -> None:
    recorded = (START * 1e9 + np.arange(N) * 10**7).astype(np.int64)
    header = recorded.copy()
    header[400:] -= 3 * 10**9
    read = read_drive(bag(tmp_path / "bag", header, recorded))
    assert len(read.imu) == N
    assert said(read, "1 times, first by 2.99 s after 1700000003.99")


@settings(max_examples=60, deadline=None)
@given(
    at=st.integers(0, 299),
    by=st.floats(-3000.0, 3000.0).filter(lambda x: abs(x) > 4),
    rate=st.sampled_from([1.0, 100.0]),
)
def test_a_stray_stamp_is_one_sample(at: int, by: float, rate: float) -> None:
    t = np.arange(300) / rate
    by = by * max(1.0, 5.0 / rate)
    t[at] += by
    bad = strays(t) | ~of_one_recording(t)
    assert not np.delete(bad, at).any()
    assert not jumps_back(t[~bad]).size


def test_some_disorder_is_no_fault_of_the_clock() -> None:
    t = np.arange(300) / 100 + np.random.default_rng(1).uniform(0, 0.5, 300)
    assert not strays(t).any() and not jumps_back(t).size and of_one_recording(t).all()
    assert unwrapped(t)[1] == 0.0


# --- clocks that were not set yet


@pytest.mark.parametrize("clock", [START, 1234.0, 40.0])
@pytest.mark.parametrize("count", [1, 20, 200])
def test_messages_before_the_first_clock(clock: float, count: int, tmp_path: Path) -> None:
    """Of a recording in simulation time these have record time 0 and stamp 0."""
    ns = ((clock + T) * 1e9).astype(np.int64)
    ns[:count] = 0
    read = read_drive(bag(tmp_path / "bag", ns, ns))
    assert len(read.imu) == N - count and summarise(read).imu.duration < 6.0
    assert said(read, f"{count} of {N} messages have neither header stamp nor time of recording")


@pytest.mark.parametrize("where", ["header", "both"])
def test_a_clock_that_was_set_while_it_recorded(where: str, tmp_path: Path) -> None:
    """No span of 50 years is accepted that 6 s of samples do not fill."""
    ns = ((START + T) * 1e9).astype(np.int64)
    unset = ns.copy()
    unset[:20] = ((T[:20] + 3.0) * 1e9).astype(np.int64)
    read = read_drive(bag(tmp_path / "bag", unset, ns if where == "header" else unset))
    assert len(read.imu) == N - 20 and summarise(read).imu.duration < 6.0
    assert said(read, f"20 of {N} stamps lie far from the others: left out")
    table = imported(tmp_path / "table", unset * 1e-9).drive
    assert len(table.imu) == N - 20 and said(table, "no usable stamp")


def test_pauses_of_a_recording_are_kept() -> None:
    t = np.concatenate([np.arange(3000) / 100, 3600 + np.arange(3000) / 100, 30_000 + np.arange(6000) / 100])
    assert of_one_recording(t).all()
    assert of_one_recording(np.arange(20) * 900.0).all()


# --- packets and doubled topics


@settings(max_examples=60, deadline=None)
@given(
    size=st.integers(2, 40),
    rate=st.sampled_from([26.0, 100.0, 416.0]),
    lost=st.booleans(),
    base=st.sampled_from([0.0, START]),
)
def test_regular_packets_are_spread(size: int, rate: float, lost: bool, base: float) -> None:
    n = size * 12 + size // 2
    true = base + np.arange(n) / rate
    stamps = true[np.arange(n) // size * size]
    kept = np.ones(n, dtype=bool)
    if lost:
        kept[3 * size : 4 * size] = False
    t, first, lines = own_stamps(stamps[kept], RNG.normal(size=(kept.sum(), 6)), "IMU samples")
    assert first.all() and "packets" in lines[0]
    whole = n // size * size  # the last packet was cut off
    np.testing.assert_allclose(t[: whole - n or None], true[kept][: whole - n or None], atol=2e-6)
    assert (np.diff(t) > 0).all()


def test_rounded_stamps_are_spread() -> None:
    """1600 Hz in whole milliseconds, and 50 Hz in whole seconds."""
    for rate, unit in ((1600.0, 1e-3), (50.0, 1.0)):
        true = np.arange(2000) / rate + 0.3 * unit
        t, first, _ = own_stamps(np.floor(true / unit) * unit, RNG.normal(size=(2000, 6)), "IMU samples")
        assert first.all() and (np.diff(t) > 0).all()
        assert np.abs(t - true).max() < unit


def test_packets_in_a_table_and_in_a_bag(tmp_path: Path) -> None:
    stamps = START + T[np.arange(N) // 3 * 3]
    table = imported(tmp_path / "table", stamps).drive
    ns = np.rint(stamps * 1e9).astype(np.int64)
    for drive in (table, read_drive(bag(tmp_path / "bag", ns, ns))):
        assert len(drive.imu) == N
        np.testing.assert_allclose(drive.imu.t, START + T, atol=1e-5)
        assert said(drive, "packets of 3") and not said(drive, "left out")


def test_single_repeated_stamps_are_no_packets(tmp_path: Path) -> None:
    t = START + T
    t[[50, 200]] = t[[49, 199]]
    drive = imported(tmp_path, t).drive
    assert len(drive.imu) == N - 2 and said(drive, f"2 of {N} accelerometer samples repeat a stamp")


@pytest.mark.parametrize("late", [0, 3])
def test_two_publishers_of_one_topic(late: int, tmp_path: Path) -> None:
    """Messages that are there twice, one after the other or with others between them."""
    order = np.argsort(np.concatenate([np.arange(N), np.arange(N) + late + 0.5]), kind="stable")
    rows = np.concatenate([np.arange(N), np.arange(N)])[order]
    ns = ((START + T) * 1e9).astype(np.int64)
    read = read_drive(bag(tmp_path / "bag", ns[rows], ns[0] + np.arange(2 * N) * 5 * 10**6, rows))
    assert len(read.imu) == N and (np.diff(read.imu.t) > 0).all()
    assert said(read, f"{N} of {2 * N} IMU samples are there twice") and said(read, "two publishers")


def test_a_topic_doubled_for_a_part_of_the_drive(make: Make, tmp_path: Path) -> None:
    drive = make(400)
    rows = np.sort(np.concatenate([np.arange(400), np.arange(100, 200)]))
    write_drive(Drive("d", drive.imu.select(rows), drive.fix, drive.velocity), tmp_path / "bag")
    read = read_drive(tmp_path / "bag")
    np.testing.assert_array_equal(read.imu.t, drive.imu.t)
    assert said(read, "100 of 500 IMU samples are there twice")


# --- stamps that scatter


def shaken(t: np.ndarray) -> np.ndarray:
    """Six channels of a car on a road at times (n,) s: bounce, pitch and the hop of wheels, with a sensor's noise."""
    waves = [np.sin(2 * np.pi * hz * (t[:, None] - START) + np.arange(6)) for hz in (1.3, 1.9, 5.3, 11.7)]
    noise = np.random.default_rng(1).standard_normal((t.size, 6))
    return np.asarray(sum(waves) + 0.05 * noise)


@pytest.mark.parametrize(("scatter", "lost"), [(3e-3, 0.005), (5e-3, 0.002), (0.01, 0.0)])
def test_stamps_that_scatter_are_read_on_the_sensors_even_clock(scatter: float, lost: float) -> None:
    """Of a phone at 67 Hz whose clock is 50 ppm off; its samples come in order, some do not come at all."""
    rng = np.random.default_rng(3)
    true = START + np.arange(4000) * 1.00005 / 67.0
    true = true[rng.random(4000) >= lost]
    stamps = true + scatter * np.clip(rng.standard_normal(true.size), -3.0, 3.0)
    even, known = evened(stamps, shaken(true))
    assert known
    assert np.std(even - true) < 0.35 * np.std(stamps - true)


@pytest.mark.parametrize("scatter", [2e-3, 0.01])
def test_a_sensor_that_is_polled_unevenly_keeps_its_stamps(scatter: float) -> None:
    rng = np.random.default_rng(3)
    true = np.unique(START + np.arange(4000) / 67.0 + scatter * rng.standard_normal(4000))
    stamps, known = evened(true, shaken(true))
    assert known and np.array_equal(stamps, true)


def test_a_drive_says_that_its_stamps_scatter(make: Make, tmp_path: Path) -> None:
    drive = make(4000)
    true, rng = drive.imu.t, np.random.default_rng(3)
    waves = shaken(true - true[0] + START)
    period = float(np.median(np.diff(true)))
    for share, words in ((0.0, "its times are taken"), (0.1, "nothing says when a sample was taken")):
        kept = rng.random(true.size) >= share
        stamps = np.maximum.accumulate(
            true + 0.7 * period * np.clip(rng.standard_normal(true.size), -3.0, 3.0)
        )
        imu = replace(drive.imu, t=stamps, specific_force=waves[:, :3], angular_rate=waves[:, 3:])
        name = tmp_path / f"bag{share}"
        write_drive(Drive("d", imu.select(kept), drive.fix, drive.velocity), name)
        read = read_drive(name)
        assert said(read, words)
        if share:
            with pytest.raises(InputError, match="the sensor's own stamps"):
                check_recording(read)
        else:
            assert len(read.imu) == true.size and np.std(read.imu.t - true) < 0.1 * period
