# SPDX-License-Identifier: Apache-2.0
"""Recorded drives on known paths: how close the smoothed pose comes, and what it survives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from suspension_twin.drive.types import Drive, FixData, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.pose.smoothed import locked_trajectory
from suspension_twin.pose.types import PoseSettings, Trajectory
from suspension_twin.signals.offline import ingest_drive

Maker = Callable[..., object]
Away = Callable[..., Callable[[np.ndarray], np.ndarray]]


def lock(scene: object, drive: Drive | None = None, settings: PoseSettings | None = None) -> Trajectory:
    """The trajectory at the IMU's own stamps."""
    drive = drive or scene.drive
    signals = ingest_drive(drive, scene.imu)
    return locked_trajectory(drive, signals, scene.gps, scene.datum, signals.t, settings=settings)


def errors(found: Trajectory, truth: Trajectory, part: slice | np.ndarray = slice(None)) -> dict[str, float]:
    """Root mean squares of what is off: along, across m, yaw rad, speed m/s, yaw rate rad/s, ax and ay m/s²."""
    dx, dy = found.x - truth.x, found.y - truth.y
    c, s = np.cos(truth.yaw), np.sin(truth.yaw)
    off = {
        "along": dx * c + dy * s,
        "across": dy * c - dx * s,
        "yaw": np.remainder(found.yaw - truth.yaw + np.pi, 2 * np.pi) - np.pi,
        "speed": found.speed - truth.speed,
        "yaw_rate": found.yaw_rate - truth.yaw_rate,
        "ax": (found.acceleration - truth.acceleration)[:, 0],
        "ay": (found.acceleration - truth.acceleration)[:, 1],
    }
    return {name: float(np.sqrt(np.mean(values[part] ** 2))) for name, values in off.items()}


def wiggle(amplitude: float, period: float, begin: float = 5.0) -> Callable[[np.ndarray], np.ndarray]:
    """A turn rate or pitch that begins to swing, gently."""

    def swing(s: np.ndarray) -> np.ndarray:
        q = np.maximum(s - begin, 0)
        return amplitude * (1 - np.exp(-(q**2))) * np.sin(2 * np.pi * q / period)

    return swing


@pytest.mark.parametrize("turn", [None, 0.25, "swinging"])
@pytest.mark.parametrize("place", [(0.0, 0.0), (-40_000.0, 65_000.0)])
def test_rtk_at_ten_hertz_gives_centimetres(
    make_scene: Maker, away: Away, turn: object, place: tuple
) -> None:
    turns = {None: np.zeros_like, 0.25: lambda s: 0.25 * (s > 6), "swinging": wiggle(0.3, 7.0)}
    scene = make_scene(speed=away(), turn=turns[turn], place=place, rate_bias=(0.004, -0.002, 0.006))
    found = lock(scene)
    assert found.valid.all()
    off = errors(found, scene.truth)
    assert off["along"] < 0.008
    assert off["across"] < 0.008
    assert off["yaw"] < 0.004
    assert off["speed"] < 0.02
    assert off["yaw_rate"] < 0.004
    assert off["ax"] < 0.15
    assert off["ay"] < 0.12


@pytest.mark.parametrize(
    ("fix_rate", "sigma", "velocity", "limit"),
    [
        (1.0, 0.015, 0.03, 0.03),
        (5.0, 0.015, 0.03, 0.012),
        (20.0, 0.015, 0.03, 0.006),
        (5.0, 0.015, None, 0.015),
        (1.0, 2.0, 0.1, 1.2),
    ],
)
def test_other_receivers(
    make_scene: Maker, away: Away, fix_rate: float, sigma: float, velocity: float | None, limit: float
) -> None:
    scene = make_scene(
        speed=away(), turn=wiggle(0.2, 9.0), fix_rate=fix_rate, sigma=sigma, velocity_sigma=velocity, seed=4
    )
    off = errors(lock(scene), scene.truth)
    assert off["along"] < limit
    assert off["across"] < limit


@pytest.mark.parametrize("sway", [1.0, 0.0])
def test_the_antenna_swings_as_the_body_pitches_or_its_receiver_hides_it(
    make_scene: Maker, away: Away, sway: float
) -> None:
    pitch = wiggle(math.radians(2.0), 1.1)
    scene = make_scene(speed=away(), pitch=pitch)
    drive = scene.drive
    if sway == 0.0:
        still = make_scene(speed=away())
        drive = replace(drive, fix=still.drive.fix, velocity=still.drive.velocity)
    off = errors(lock(scene, drive), scene.truth)
    assert off["along"] < 0.01  # the swing itself is 37 mm rms
    assert off["speed"] < 0.03
    assert off["ax"] < 0.35  # of 1.6 m/s² that pitching adds at the sensor


def test_a_sensor_that_leans_does_not_move_the_antenna(make_scene: Maker) -> None:
    """Mounted 14° nose down without the twin knowing it: the antenna, 1.5 m up, still hangs above the roof."""
    scene = make_scene(speed=lambda s: 6.0 + np.sin(0.5 * s), seconds=40.0, sigma=0.02)
    leaning = scene.imu.model_copy(update={"rpy": (0.05, 0.25, 0.0)})
    signals = ingest_drive(scene.drive, leaning)
    found = locked_trajectory(scene.drive, signals, scene.gps, scene.datum, signals.t)
    inner = slice(500, -500)
    off = errors(found, scene.truth, slice(None))
    level = errors(lock(scene), scene.truth, slice(None))
    assert np.sin(0.25) * scene.gps.position[2] > 0.35
    assert off["along"] < level["along"] + 0.05 and off["across"] < level["across"] + 0.05
    assert np.abs(np.mean(found.x[inner] - scene.truth.x[inner])) < 0.05


@pytest.mark.parametrize(
    ("lean", "upright", "moves"),
    [(0.035, False, True), (0.035, True, False), (0.09, False, False), (0.09, True, False)],
)
def test_whether_the_antenna_moves_is_for_what_leans_to_say(
    make_scene: Maker, lean: float, upright: bool, moves: bool
) -> None:
    """5 cm for each 2° under an antenna 1.5 m up, if it is the vehicle that noses down and not its sensor."""
    scene = make_scene(speed=lambda s: 6.0 + np.sin(0.5 * s), seconds=30.0, sigma=0.01)
    signals = ingest_drive(scene.drive, scene.imu.model_copy(update={"rpy": (0.0, lean, 0.0)}))
    found = locked_trajectory(scene.drive, signals, scene.gps, scene.datum, signals.t, upright=upright)
    off = float(np.mean(found.x[500:-500] - scene.truth.x[500:-500]))
    assert abs(off) == pytest.approx(math.sin(lean) * scene.gps.position[2] if moves else 0.0, abs=0.012)


def test_between_and_beyond_the_stamps(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away())
    signals = ingest_drive(scene.drive, scene.imu)
    t = np.arange(scene.truth.t[0] - 5.0, scene.truth.t[-1] + 5.0, 0.0137)
    found = locked_trajectory(scene.drive, signals, scene.gps, scene.datum, t)
    inside = (t > scene.truth.t[0]) & (t < scene.truth.t[-1])
    assert np.array_equal(found.valid, inside)
    assert np.isfinite([found.x, found.y, found.yaw, found.speed, found.acceleration[:, 0]]).all()
    step = np.hypot(np.diff(found.x), np.diff(found.y)) - np.abs(found.speed[1:]) * np.diff(t)
    assert np.abs(step[inside[1:] & inside[:-1]]).max() < 1e-3  # position and speed are in step


def test_noise_is_learnt_where_it_is_not_told(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), sigma=0.015, tell_sigma=False)
    fix = scene.drive.fix
    vague = replace(scene.drive, fix=replace(fix, status=np.zeros_like(fix.status)))  # 2.5 m, it would seem
    assert errors(lock(scene, vague), scene.truth)["along"] < 0.03


def test_standing_still_the_pose_stands(make_scene: Maker) -> None:
    def speed(s: np.ndarray) -> np.ndarray:
        return 4.0 * np.sin(np.pi * np.clip((s - 3) / 8, 0, 1)) ** 2

    scene = make_scene(speed=speed, rate_bias=(0.0, 0.0, 0.01), seconds=60.0)
    found = lock(scene)
    stands = slice(1400, None)
    assert np.ptp(found.yaw[stands]) < 1e-4
    assert np.ptp(found.x[stands]) < 0.01
    assert np.abs(found.speed[stands]).max() < 0.005
    assert errors(found, scene.truth, stands)["along"] < 0.008


def test_reversing_out_of_a_gap_and_driving_off(make_scene: Maker) -> None:
    def speed(s: np.ndarray) -> np.ndarray:
        back = -2.0 * np.sin(np.pi * np.clip((s - 3) / 6, 0, 1)) ** 2
        return back + 8.0 * 0.5 * (1 - np.cos(np.pi * np.clip((s - 12) / 6, 0, 1)))

    scene = make_scene(speed=speed, turn=wiggle(0.2, 8.0, begin=3.0))
    found = lock(scene)
    off = errors(found, scene.truth)
    assert off["yaw"] < 0.01
    assert off["along"] < 0.01
    assert found.speed.min() == pytest.approx(-2.0, abs=0.05)


def test_a_sensor_that_faces_backwards_makes_no_car_reverse_at_speed(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), turn=wiggle(0.2, 9.0))
    imu = scene.drive.imu
    turned = np.array([-1.0, -1.0, 1.0])
    backwards = replace(
        imu, specific_force=imu.specific_force * turned, angular_rate=imu.angular_rate * turned
    )
    found = lock(scene, replace(scene.drive, imu=backwards))
    assert found.speed.min() > -1.0
    assert found.speed.max() > 5.0
    assert errors(found, scene.truth)["yaw"] < 0.3


def test_headings_serve_a_car_that_never_moves(make_scene: Maker) -> None:
    scene = make_scene(speed=np.zeros_like, heading=True, seconds=20.0)
    found = lock(scene)
    off = errors(found, scene.truth)
    assert off["yaw"] < 0.005
    assert off["along"] < 0.01
    blind = replace(scene.drive, heading=None)
    with pytest.raises(InputError, match="never moves"):
        lock(scene, blind)


def test_outliers_are_outvoted(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), turn=wiggle(0.2, 9.0))
    fix = scene.drive.fix
    latitude = fix.latitude.copy()
    random = np.random.default_rng(5)
    wrong = random.choice(np.arange(20, 380), 30, replace=False)
    latitude[wrong] += random.uniform(-5, 5, 30) / 111_000
    latitude[200:208] += 2.0 / 111_000  # and one spell of eight
    off = errors(lock(scene, replace(scene.drive, fix=replace(fix, latitude=latitude))), scene.truth)
    assert off["along"] < 0.012
    assert off["across"] < 0.012


def test_a_lost_receiver_is_bridged_and_marked(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), turn=wiggle(0.2, 9.0))
    fix, velocity = scene.drive.fix, scene.drive.velocity
    gone = (fix.t > scene.truth.t[0] + 20) & (fix.t < scene.truth.t[0] + 26)
    status = np.where(gone, -1, fix.status).astype(np.int8)
    nowhere = np.where(gone, np.nan, fix.latitude)
    drive = replace(
        scene.drive,
        fix=replace(fix, status=status, latitude=nowhere),
        velocity=VelocityData(velocity.t[~gone], velocity.enu[~gone]),
    )
    found = lock(scene, drive)
    inside = (scene.truth.t > scene.truth.t[0] + 22) & (scene.truth.t < scene.truth.t[0] + 24)
    assert not found.valid[inside].any()
    assert found.valid[:1900].all()
    assert found.valid[2700:].all()
    off = errors(found, scene.truth)
    assert off["along"] < 0.15  # from both sides, over six seconds and sixty metres
    assert errors(found, scene.truth, slice(0, 1950))["along"] < 0.01


def test_huge_covariance_and_unknown_status(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away())
    fix = scene.drive.fix
    sigma = fix.sigma.copy()
    sigma[::2] = 1000.0
    latitude = fix.latitude.copy()
    latitude[::2] += 0.01
    status = np.full(len(fix), -2, dtype=np.int8)  # not set
    drive = replace(scene.drive, fix=replace(fix, sigma=sigma, latitude=latitude, status=status))
    assert errors(lock(scene, drive), scene.truth)["along"] < 0.012


def test_a_gap_in_the_imu_is_bridged_by_the_gps(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), turn=wiggle(0.1, 12.0))
    imu = scene.drive.imu
    keep = np.r_[0:2000, 2150 : len(imu)]
    drive = replace(
        scene.drive,
        imu=replace(
            imu, t=imu.t[keep], specific_force=imu.specific_force[keep], angular_rate=imu.angular_rate[keep]
        ),
    )
    signals = ingest_drive(drive, scene.imu)
    found = locked_trajectory(drive, signals, scene.gps, scene.datum, scene.truth.t)
    assert errors(found, scene.truth)["along"] < 0.02


def test_what_cannot_be_located_is_refused(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), seconds=10.0)
    fix = scene.drive.fix
    none = FixData(*(np.empty(0),) * 4, np.empty(0, np.int8), np.empty((0, 3)))
    for spoilt, word in (
        (none, "no usable GPS fix"),
        (replace(fix, status=np.full(len(fix), -1, np.int8)), "no usable GPS fix"),
        (replace(fix, t=fix.t + 1e6), "clocks agree"),
    ):
        with pytest.raises(InputError, match=word):
            lock(scene, replace(scene.drive, fix=spoilt))


@pytest.mark.parametrize(
    "wrong", [{"gate": 0.0}, {"outage": math.nan}, {"imu_delay": 1.0}, {"imu_delay": -0.1}]
)
def test_wrong_settings_are_named(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        PoseSettings(**wrong)
