# SPDX-License-Identifier: Apache-2.0
"""Measured drives against what is documented of them, and a multibody car against its own truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.pose.lock import PlanarState, PoseLock
from suspension_twin.pose.smoothed import locked_trajectory
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.signals.ingest import ImuIngest
from suspension_twin.signals.offline import ImuSignals, ingest_drive
from suspension_twin.vehicle.twin import Datum, Place, load_twin


def live(drive: Drive, imu: Place, gps: Place, datum: Datum) -> list[PlanarState]:
    """The drive through both live stages as the nodes have them."""
    ingest, lock = ImuIngest(ImuSettings(), imu), PoseLock(None, gps, datum, imu)
    fix, velocity = drive.fix, drive.velocity
    events = sorted(
        [(t, 0, i) for i, t in enumerate(fix.t)]
        + [(t, 1, i) for i, t in enumerate(velocity.t)]
        + [(t, 2, i) for i, t in enumerate(drive.imu.t)]
    )
    out = []
    for t, kind, i in events:
        if kind == 0:
            place = fix.latitude[i], fix.longitude[i], fix.altitude[i]
            lock.on_fix(t, *place, int(fix.status[i]), *fix.sigma[i, :2])
        elif kind == 1:
            lock.on_velocity(t, *velocity.enu[i, :2])
        else:
            sample = ingest.push(t, drive.imu.specific_force[i], drive.imu.angular_rate[i])
            state = sample and lock.on_imu(sample.t, sample.force, sample.rate)
            if state and state.valid:
                out.append(state)
    return out


@pytest.fixture(scope="module")
def rtk(shared_data: Path, repository: Path) -> tuple[Drive, ImuSignals, Trajectory, list[PlanarState]]:
    """The roof IMU and RTK receiver of rtklibexplorer, smoothed and live; its antenna taken for above the
    rear axle, which its lateral speed bears out."""
    folder = shared_data / "rtklibexplorer_GNSS_IMU"
    if not folder.is_dir():
        pytest.skip("no measured data: rtklibexplorer_GNSS_IMU")
    mapping = repository / "config" / "import" / "rtklibexplorer_gnss_imu.yaml"
    drive = import_drive([folder], mapping=mapping).drive
    imu = Place(position=(0.0, 0.0, 1.5), rpy=(0.0111, -0.1180, 3.0476))
    gps = Place(frame="gps_link", position=(0.0, 0.0, 2.15))
    fix = drive.fix
    datum = Datum(latitude=fix.latitude[0], longitude=fix.longitude[0], altitude=fix.altitude[0])
    signals = ingest_drive(drive, imu)
    smoothed = locked_trajectory(drive, signals, gps, datum, signals.t)
    return drive, signals, smoothed, live(drive, imu, gps, datum)


def test_rtk_drive_as_documented(rtk: tuple) -> None:
    _, signals, path, states = rtk
    assert signals.rate_hz == pytest.approx(100.0, rel=1e-3)
    assert [f for f in signals.findings if f.level == "error"] == []
    assert path.valid.mean() > 0.99
    assert np.sum(np.hypot(np.diff(path.x), np.diff(path.y))) == pytest.approx(4050.0, rel=2e-3)
    assert path.speed.max() == pytest.approx(16.3, abs=0.1)
    rows = np.array([(*s[:4], *s.motion) for s in states])
    assert rows[:, 4].max() == pytest.approx(16.3, abs=0.2)
    assert np.sum(np.hypot(np.diff(rows[:, 1]), np.diff(rows[:, 2]))) == pytest.approx(4050.0, rel=5e-3)


def test_rtk_drive_standing_and_level(rtk: tuple) -> None:
    drive, signals, _, states = rtk
    speed = np.interp(signals.t, drive.velocity.t, np.hypot(*drive.velocity.enu[:, :2].T))
    assert not signals.standing[speed > 0.3].any()
    assert signals.standing.sum() > 0.6 * np.count_nonzero(speed < 0.05)  # an idling engine shakes it
    assert abs(np.mean(signals.vertical_acceleration)) < 0.03
    # Whenever it stands for long, the live yaw does not move.
    t, yaw = np.array([(s.t, s.yaw) for s in states]).T
    for begin, end in _stretches(signals.t, signals.standing):
        if end - begin > 5.0:
            inside = (t > begin + 2.5) & (t < end - 0.3)
            if inside.any():
                assert np.ptp(yaw[inside]) < 0.003


def _stretches(t: np.ndarray, flags: np.ndarray) -> Iterator[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        yield t[first], t[last - 1]


def test_rtk_drive_meets_the_same_bump_twice_at_the_same_place(rtk: tuple) -> None:
    """t = 337.6 s and 362.6 s since the first fix: documented as 6 cm apart along the track."""
    drive, signals, path, states = rtk
    vertical = zero_phase(FilterSpec(2, 10.0), signals.rate_hz, signals.vertical_acceleration)
    rows = np.array([s[:4] for s in states])
    peaks, speeds, online = [], [], []
    for since in (337.6, 362.6):
        near = np.flatnonzero(np.abs(signals.t - drive.fix.t[0] - since) < 0.6)
        k = near[np.argmax(np.abs(vertical[near]))]
        peaks.append((path.x[k], path.y[k], path.yaw[k]))
        speeds.append(path.speed[k])
        online.append([np.interp(signals.t[k], rows[:, 0], rows[:, c]) for c in (1, 2)])
    assert speeds == pytest.approx([6.3, 5.9], abs=0.25)
    (x0, y0, yaw), (x1, y1, _) = peaks
    along = (x1 - x0) * math.cos(yaw) + (y1 - y0) * math.sin(yaw)
    assert abs(along) < 0.08
    (a0, b0), (a1, b1) = online
    assert abs((a1 - a0) * math.cos(yaw) + (b1 - b0) * math.sin(yaw)) < 0.15


@pytest.mark.parametrize("velocities", [True, False], ids=["velocities", "fixes alone"])
def test_a_lock_that_starts_in_the_middle_of_the_rtk_drive(rtk: tuple, velocities: bool) -> None:
    """Every half minute, whatever the car is doing; four seconds later it is where the smoothed path is."""
    drive, _, path, _ = rtk
    imu = Place(position=(0.0, 0.0, 1.5), rpy=(0.0111, -0.1180, 3.0476))
    gps = Place(frame="gps_link", position=(0.0, 0.0, 2.15))
    fix = drive.fix
    datum = Datum(latitude=fix.latitude[0], longitude=fix.longitude[0], altitude=fix.altitude[0])
    worst = []
    for start in np.arange(path.t[0] + 11.0, path.t[-1] - 16.0, 30.0):
        if np.interp(start, path.t, path.speed) < 2.0:
            continue
        part = replace(
            drive,
            imu=drive.imu.select((drive.imu.t > start) & (drive.imu.t < start + 15.0)),
            fix=fix.select((fix.t > start) & (fix.t < start + 15.0)),
            velocity=drive.velocity.select(
                (drive.velocity.t > start) & (drive.velocity.t < start + 15.0 * velocities)
            ),
        )
        rows = np.array([(*s[:4], s.motion.speed) for s in live(part, imu, gps, datum) if s.t > start + 4.0])
        x, y = (np.interp(rows[:, 0], path.t, values) for values in (path.x, path.y))
        worst.append(np.hypot(rows[:, 1] - x, rows[:, 2] - y).max())
    assert len(worst) > 12
    assert np.median(worst) < 0.1 and max(worst) < 0.25


@pytest.mark.long
def test_the_rtk_drive_with_a_phone_s_receiver(rtk: tuple) -> None:
    """One fix and velocity a second, 2.5 m and 0.3 m/s off and silent about it: better than each of its fixes."""
    drive, _, path, _ = rtk
    imu = Place(position=(0.0, 0.0, 1.5), rpy=(0.0111, -0.1180, 3.0476))
    gps = Place(frame="gps_link", position=(0.0, 0.0, 2.15))
    datum = Datum(
        latitude=drive.fix.latitude[0], longitude=drive.fix.longitude[0], altitude=drive.fix.altitude[0]
    )
    random = np.random.default_rng(5)
    fix = drive.fix.select(np.flatnonzero(np.diff(np.floor(drive.fix.t), prepend=0.0) > 0))
    velocity = drive.velocity.select(np.flatnonzero(np.diff(np.floor(drive.velocity.t), prepend=0.0) > 0))
    north, east = random.normal(0.0, 2.5 / 111_200.0, (2, len(fix)))
    fix = replace(
        fix,
        latitude=fix.latitude + north,
        longitude=fix.longitude + east / math.cos(math.radians(datum.latitude)),
        status=np.zeros(len(fix), dtype=np.int8),
        sigma=np.full((len(fix), 3), np.nan),
    )
    velocity = replace(velocity, enu=velocity.enu + random.normal(0.0, 0.3, velocity.enu.shape))
    rows = np.array(
        [(*s[:4], s.motion.speed) for s in live(replace(drive, fix=fix, velocity=velocity), imu, gps, datum)]
    )
    x, y, speed = (np.interp(rows[:, 0], path.t, values) for values in (path.x, path.y, path.speed))
    place = np.hypot(rows[:, 1] - x, rows[:, 2] - y)
    assert np.sqrt(np.mean(place**2)) < 1.6 and place.max() < 6.0
    assert np.sqrt(np.mean((rows[:, 4] - speed) ** 2)) < 0.35


def test_comma2k19_speed_against_the_wheels(shared_data: Path, repository: Path) -> None:
    folder = shared_data / "comma2k19_Example_1"
    if not folder.is_dir():
        pytest.skip("no measured data: comma2k19_Example_1")
    drive = import_drive([folder], mapping=repository / "config" / "import" / "comma2k19.yaml").drive
    imu, gps = Place(position=(2.0, 0.0, 1.2)), Place(frame="gps_link", position=(2.0, 0.0, 1.2))
    fix = drive.fix
    datum = Datum(latitude=fix.latitude[0], longitude=fix.longitude[0], altitude=fix.altitude[0])
    signals = ingest_drive(drive, imu)
    assert signals.rate_hz == pytest.approx(104.36, rel=2e-3)
    path = locked_trajectory(drive, signals, gps, datum, signals.t)
    # CAN and IMU share a clock; the drive's is tied to the GPS's by the first IMU sample.
    log = folder / "processed_log"
    shift = drive.imu.t[0] - np.load(log / "IMU" / "accelerometer" / "t")[0]
    t, wheels = np.load(log / "CAN" / "speed" / "t") + shift, np.load(log / "CAN" / "speed" / "value").ravel()
    inside = (t > path.t[0] + 1) & (t < path.t[-1] - 1)
    t, wheels = t[inside], wheels[inside]
    rows = np.array([(*s[:4], s.motion.speed) for s in live(drive, imu, gps, datum)])
    for at, speed in ((path.t, path.speed), (rows[:, 0], rows[:, 4])):
        seen = t > at[0] + 2.0
        off = np.interp(t[seen], at, speed) - wheels[seen]
        assert np.std(off) < 0.12
        # A per cent of wheel radius is not the GPS's fault.
        assert np.mean(off) / np.mean(wheels) == pytest.approx(0.009, abs=0.006)


@pytest.mark.long
def test_husky_at_thirty_hertz_is_located_but_told_too_slow(shared_data: Path, repository: Path) -> None:
    folder = shared_data / "robot_localization_bags"
    if not (folder / "test1.bag").is_file():
        pytest.skip("no measured data: robot_localization_bags")
    mapping = repository / "config" / "import" / "robot_localization_test1.yaml"
    drive = import_drive([folder / "test1.bag"], mapping=mapping).drive
    imu = Place(position=(0.2, 0.0, 0.5), rpy=(math.pi / 2, 0.0, 0.0))  # gravity on +y
    signals = ingest_drive(drive, imu)
    assert [f.code for f in signals.findings if f.level == "error"] == ["rate_low"]
    assert ingest_drive(drive, Place()).findings[-1].code in ("axes_wrong", "no_standstill")
    fix = drive.fix
    datum = Datum(latitude=fix.latitude[0], longitude=fix.longitude[0])
    path = locked_trajectory(drive, signals, Place(frame="gps_link"), datum, signals.t)
    assert path.valid.mean() > 0.95
    assert path.speed.max() < 2.0
    assert len(live(drive, imu, Place(frame="gps_link"), datum)) > 10_000


@pytest.mark.parametrize("name", ["drive_fast", "drive_slow", "drive_other", "reference"])
def test_multibody_car_against_its_own_truth(shared_data: Path, name: str) -> None:
    """RTK at 10 Hz, 15 mm: the smoothed pose within a centimetre along the road, the live one within two."""
    folder = shared_data.parent / "withheld" / "no_effect_added"
    if not folder.is_dir():
        pytest.skip("no measured data: drives of the multibody car")
    twin = load_twin(folder / "twin.yaml")
    assert twin.datum is not None
    drive = read_drive(folder / name)
    truth = np.genfromtxt(folder / f"{name}_truth.csv", delimiter=",", names=True)
    start = drive.fix.t[0]
    ahead = _direction(folder / "road.crg")
    signals = ingest_drive(drive, twin.imu)
    path = locked_trajectory(drive, signals, twin.gps, twin.datum, signals.t)
    assert path.valid.all()

    def off(t: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        # u is counted at the front axle.
        along = x * math.cos(ahead) + y * math.sin(ahead) + twin.vehicle.wheelbase
        inside = t - start < truth["t"][-1]
        return (along - np.interp(t - start, truth["t"], truth["u"]))[inside]

    smoothed = off(path.t, path.x, path.y)
    assert np.sqrt(np.mean(smoothed**2)) < 0.010
    assert np.abs(smoothed).max() < 0.035
    speed = path.speed - np.interp(path.t - start, truth["t"], truth["v_fwd"])
    assert np.std(speed) < 0.025
    pitch = np.interp(path.t - start, truth["t"], truth["pitch"])
    assert np.std(np.arcsin(-signals.up[:, 0]) - pitch) < 0.0015
    rows = np.array([s[:3] for s in live(drive, twin.imu, twin.gps, twin.datum)])
    online = off(*rows.T)[300:]
    assert np.sqrt(np.mean(online**2)) < 0.020
    assert np.abs(online).max() < 0.045


def _direction(road: Path) -> float:
    """Heading of a straight road by its header's first and last point."""
    head = road.read_bytes()[:4000].decode("latin-1")

    def value(key: str) -> float:
        return float(head.split(key)[1].split("=")[1].split()[0])

    rise = value("reference_line_end_y") - value("reference_line_start_y")
    run = value("reference_line_end_x") - value("reference_line_start_x")
    return math.atan2(rise, run)
