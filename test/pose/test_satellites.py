# SPDX-License-Identifier: Apache-2.0
"""The motion that fixes alone tell, against known paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from suspension_twin.drive.types import FixData
from suspension_twin.errors import InputError
from suspension_twin.pose.satellites import RATE, satellite_motion
from suspension_twin.signals.offline import ingest_drive


def cut(fix: FixData, keep: Any) -> FixData:
    names = ("t", "latitude", "longitude", "altitude", "status", "sigma")
    return replace(fix, **{k: getattr(fix, k)[keep] for k in names})


@pytest.fixture(scope="module")
def scene(make_scene: Callable[..., Any]) -> Any:
    """A slalom that speeds up and slows down; the antenna stands ahead of the rear axle and to the right."""
    return make_scene(
        speed=lambda s: 10.0 + 2.0 * np.sin(0.4 * s),
        turn=lambda s: 0.2 * np.sin(0.7 * s),
        seconds=60.0,
        sigma=0.005,
    )


def test_the_motion_is_the_vehicle_s_and_both_sides_are_as_slow(scene: Any) -> None:
    signals, motion = satellite_motion(
        scene.drive, ingest_drive(scene.drive, scene.imu), scene.gps, scene.datum
    )
    assert signals.rate_hz == pytest.approx(RATE, rel=1e-3)
    assert len(signals) == len(motion) == signals.force.shape[0] == signals.standing.size
    inner = motion.valid & (motion.t > motion.t[0] + 5) & (motion.t < motion.t[-1] - 5)
    assert inner.sum() > 200

    def true(values: np.ndarray) -> np.ndarray:
        return np.interp(motion.t, scene.truth.t, values)[inner]

    # fixes to 5 mm ten times a second: what that noise is after two derivatives up to 0.8 Hz
    for most, *pair in (
        (0.02, motion.speed, scene.truth.speed),
        (0.004, motion.yaw_rate, scene.truth.yaw_rate),
        (0.05, motion.acceleration[:, 0], scene.truth.acceleration[:, 0]),
        (0.05, motion.acceleration[:, 1], scene.truth.acceleration[:, 1]),
    ):
        off = pair[0][inner] - true(pair[1])
        assert np.sqrt(np.mean(off**2)) < most
    np.testing.assert_allclose(motion.x[inner], true(scene.truth.x), atol=0.1)
    # the gyro that went through the same low-pass says the same, at the same time
    delays = np.arange(-3, 4)
    fit = [
        np.corrcoef(signals.rate[10:-10, 2], motion.yaw_rate[10 + d : len(motion) - 10 + d])[0, 1]
        for d in delays
    ]
    assert delays[int(np.argmax(fit))] == 0 and max(fit) > 0.995


def test_nothing_is_said_where_fixes_are_missing(scene: Any) -> None:
    drive = scene.drive
    start = drive.fix.t[0]
    keep = (drive.fix.t < start + 20) | (drive.fix.t > start + 26)
    fix = cut(drive.fix, keep)
    _, motion = satellite_motion(
        replace(drive, fix=fix), ingest_drive(drive, scene.imu), scene.gps, scene.datum
    )
    assert not motion.valid[(motion.t > start + 20.5) & (motion.t < start + 25.5)].any()
    assert motion.valid[(motion.t > start + 30) & (motion.t < start + 50)].all()
    assert all(np.isfinite(column).all() for column in vars(motion).values())


def test_too_few_fixes_and_a_parked_car_are_named(scene: Any, make_scene: Callable[..., Any]) -> None:
    drive = scene.drive
    few = cut(drive.fix, slice(10))
    signals = ingest_drive(drive, scene.imu)
    with pytest.raises(InputError, match="10 usable positions"):
        satellite_motion(replace(drive, fix=few), signals, scene.gps, scene.datum)
    parked = make_scene(speed=np.zeros_like, seconds=20.0)
    with pytest.raises(InputError, match="never moves"):
        satellite_motion(parked.drive, ingest_drive(parked.drive, parked.imu), parked.gps, parked.datum)


def test_heights_that_are_missing_or_unknown_make_no_hills(scene: Any) -> None:
    """A climb of 5 % is taken off the forward pull where the receiver knows its height, and only there."""
    drive, signals = scene.drive, ingest_drive(scene.drive, scene.imu)
    fix = drive.fix
    climb = 0.05 * 10.0 * (fix.t - fix.t[0])
    sure, vague = fix.sigma.copy(), fix.sigma.copy()
    sure[:, 2], vague[:, 2] = 0.01, 3.0
    holes = fix.altitude + climb
    holes[::7] = np.nan

    def pull(altitude: Any, sigma: Any) -> Any:
        asked = replace(drive, fix=replace(fix, altitude=altitude, sigma=sigma))
        slower, motion = satellite_motion(asked, signals, scene.gps, scene.datum)
        assert np.isfinite(slower.force).all()
        return slower.force[motion.valid, 0]

    flat = pull(fix.altitude, vague)
    assert np.mean(pull(holes, sure) - flat) == pytest.approx(-9.81 * 0.05, rel=0.1)
    np.testing.assert_allclose(pull(holes, vague), flat)
    np.testing.assert_allclose(pull(np.full_like(holes, np.nan), sure), flat)


def test_heights_of_a_receiver_that_does_not_vouch_for_them_are_hills_if_the_imu_feels_them(
    scene: Any,
) -> None:
    """Waves of the road 120 m long and 2 m high: felt, or made up by the receiver."""
    drive, signals = scene.drive, ingest_drive(scene.drive, scene.imu)
    fix, slope = drive.fix, 2.0 * np.pi / 120.0

    def along(t: Any) -> Any:
        return 10.0 * (t - fix.t[0])

    altitude = fix.altitude + 2.0 * np.sin(slope * along(fix.t))
    sigma = np.full_like(fix.sigma, np.nan)
    asked = replace(drive, fix=replace(fix, altitude=altitude, sigma=sigma))
    feels = signals.force.copy()
    feels[:, 0] += 9.81 * 2.0 * slope * np.cos(slope * along(signals.t))

    def pull(force: Any, one: Any) -> Any:
        slower, motion = satellite_motion(one, replace(signals, force=force), scene.gps, scene.datum)
        return slower.force[motion.valid, 0]

    flat, hilly = pull(signals.force, drive), pull(feels, asked)
    assert np.std(pull(feels, drive) - flat) > 0.5
    assert np.std(hilly - flat) < 0.15
    np.testing.assert_allclose(pull(signals.force, asked), flat, atol=5e-3)


def test_near_a_stop_a_course_that_the_filter_has_smeared_is_no_claim(make_scene: Callable[..., Any]) -> None:
    """Two periods of the low-pass on either side: once for the course, once for what is made of it."""
    scene = make_scene(
        speed=lambda s: 9.0 * 0.5 * (1 + np.cos(np.pi * np.clip((np.abs(s - 30.0) - 13.0) / -8.0, 0.0, 1.0))),
        turn=lambda s: 0.1 * np.sin(0.5 * s),
        seconds=60.0,
        sigma=0.005,
    )
    _, motion = satellite_motion(scene.drive, ingest_drive(scene.drive, scene.imu), scene.gps, scene.datum)
    s = motion.t - motion.t[0]
    slow = s[motion.speed < 3.0]
    claimed = s[motion.valid]
    assert slow.size > 50
    period = 1.0 / 0.8
    before, after = slow[0] - claimed[claimed < slow[0]].max(), claimed[claimed > slow[-1]].min() - slow[-1]
    for between in (before, after):  # either end is known to a sample
        assert 2.0 * period - 0.02 < between < 2.0 * period + 2.0 / RATE
    assert not motion.valid[(s > slow[0]) & (s < slow[-1])].any()
    yaw = np.interp(motion.t, scene.truth.t, scene.truth.yaw)[motion.valid]
    off = np.remainder(motion.yaw[motion.valid] - yaw + np.pi, 2.0 * np.pi) - np.pi
    assert np.abs(off[20:-20]).max() < 0.02
