# SPDX-License-Identifier: Apache-2.0
"""The smoothed pose's own claims: where it is valid, in step with itself, learnt noise and sway."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.smoothed import locked_trajectory
from suspension_twin.pose.types import PoseSettings
from suspension_twin.signals.offline import ImuSignals, ingest_drive


@pytest.fixture(scope="module")
def scene(make_scene: Callable[..., Any]) -> Any:
    """Short and lively, with a bend."""
    return make_scene(
        speed=lambda s: 7.0 + np.sin(0.8 * s),
        turn=lambda s: 0.2 * np.sin(0.6 * s),
        seconds=20.0,
        fix_rate=5.0,
    )


@pytest.fixture(scope="module")
def signals(scene: Any) -> ImuSignals:
    """Its IMU."""
    return ingest_drive(scene.drive, scene.imu)


@pytest.mark.parametrize("outage", [1.0, 3.0])
def test_valid_is_what_lies_between_fixes_and_half_as_far_beyond(
    scene: Any, signals: ImuSignals, outage: float
) -> None:
    """Of the fixes that count: outliers do not."""
    fix, start = scene.drive.fix, scene.truth.t[0]
    s = fix.t - start
    kept = np.flatnonzero(((s > 3.9) & (s < 8.1)) | ((s > 9.9) & (s < 12.1)) | ((s > 13.3) & (s < 15.1)))
    latitude = fix.latitude.copy()
    wrong = kept[np.argmin(np.abs(s[kept] - 13.4))]
    latitude[wrong] += 300.0 / 111_200.0
    used = s[np.setdiff1d(kept, [wrong])]
    drive = replace(scene.drive, fix=replace(fix, latitude=latitude).select(kept))
    found = locked_trajectory(
        drive, signals, scene.gps, scene.datum, signals.t, settings=PoseSettings(outage=outage)
    )
    t = signals.t - start
    wanted = np.zeros(t.size, dtype=bool)
    for a, b in zip(used[:-1], used[1:], strict=True):
        inner = (t >= a) & (t <= b)
        wanted[inner] = np.maximum(t - a, b - t)[inner] <= outage
    wanted |= (t < used[0]) & (used[0] - t <= 0.5 * outage)
    wanted |= (t > used[-1]) & (t - used[-1] <= 0.5 * outage)
    assert np.count_nonzero(found.valid != wanted) <= 6  # a sample at either end
    assert 0.2 < wanted.mean() < 0.9


def test_all_that_it_says_hangs_together(scene: Any, signals: ImuSignals) -> None:
    """Speeds are the path's derivatives, the yaw rate the yaw's, the accelerations the speed's and the bend's."""
    t = np.arange(signals.t[0] + 0.5, signals.t[-1] - 0.5, 0.002)
    path = locked_trajectory(scene.drive, signals, scene.gps, scene.datum, t)
    c, s = np.cos(path.yaw), np.sin(path.yaw)
    dx, dy = np.gradient(path.x, t), np.gradient(path.y, t)
    assert len(path) == t.size
    np.testing.assert_allclose(dx * c + dy * s, path.speed, rtol=0, atol=0.01)
    np.testing.assert_allclose(dy * c - dx * s, path.velocity[:, 1], rtol=0, atol=0.02)
    assert np.std(np.gradient(path.yaw, t) - path.yaw_rate) < 5e-3
    assert np.std(np.gradient(path.speed, t) - path.acceleration[:, 0]) < 0.05
    np.testing.assert_allclose(path.acceleration[:, 1], path.speed * path.yaw_rate)
    assert np.abs(path.speed - np.interp(t, scene.truth.t, scene.truth.speed)).max() < 0.1


@pytest.mark.parametrize("believed", [0.02, 0.28])
def test_how_noisy_fixes_are_is_seen_from_what_they_show(
    make_scene: Callable[..., Any], believed: float
) -> None:
    """Whatever a receiver with carrier phase says of itself, within a factor of ten: the pose is as good."""
    scene = make_scene(speed=lambda s: 7.0 + np.sin(0.8 * s), seconds=40.0, sigma=0.2, velocity_sigma=0.1)
    fix = scene.drive.fix
    signals = ingest_drive(scene.drive, scene.imu)

    def off(sigma: float) -> float:
        drive = replace(scene.drive, fix=replace(fix, sigma=np.full_like(fix.sigma, sigma)))
        path = locked_trajectory(drive, signals, scene.gps, scene.datum, signals.t)
        return float(np.sqrt(np.mean((path.x - scene.truth.x) ** 2 + (path.y - scene.truth.y) ** 2)))

    honest = off(0.2)
    assert honest < 0.1
    assert off(believed) < 1.5 * honest + 0.05


def test_a_slow_error_of_fixes_does_not_turn_the_path(make_scene: Callable[..., Any]) -> None:
    """Fixes that wander by 2.5 m within a minute are worth less than a second of velocities: the heading is as good as
    these make it, 0.1 m/s over 7 m/s and the root of forty."""
    scene = make_scene(speed=lambda s: 7.0 + np.sin(0.8 * s), seconds=40.0, sigma=0.01, velocity_sigma=0.1)
    signals, frame = ingest_drive(scene.drive, scene.imu), LocalMap(scene.datum)
    velocity, turned = scene.drive.velocity.select(np.arange(0, len(scene.drive.velocity), 10)), []
    for seed in range(6):
        rng, fix = np.random.default_rng(seed), scene.drive.fix.select(np.arange(0, len(scene.drive.fix), 10))
        enu, error = frame.to_map(fix.latitude, fix.longitude, fix.altitude), 2.5 * rng.standard_normal(2)
        for row, dt in zip(enu, np.diff(fix.t, prepend=fix.t[0]), strict=True):
            kept = np.exp(-dt / 60.0)
            error = kept * error + 2.5 * np.sqrt(1.0 - kept**2) * rng.standard_normal(2)
            row[:2] += error
        latitude, longitude, altitude = frame.to_geodetic(enu).T
        stated = np.full_like(fix.sigma, 2.5)
        slow = replace(fix, latitude=latitude, longitude=longitude, altitude=altitude, sigma=stated)
        drive = replace(scene.drive, fix=slow, velocity=velocity)
        path = locked_trajectory(drive, signals, scene.gps, scene.datum, signals.t)
        turned.append(float(np.mean(path.yaw - scene.truth.yaw)))
    assert np.ptp(turned) < 0.001
    assert np.abs(turned).max() < 0.005
