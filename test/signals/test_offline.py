# SPDX-License-Identifier: Apache-2.0
"""A whole recording: what is removed, what is put right, what is only reported."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from suspension_twin.drive.types import Drive, FixData, ImuData
from suspension_twin.errors import InputError
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.signals.offline import ImuSignals, ingest_drive
from suspension_twin.vehicle.twin import Place

Maker = Callable[..., tuple[Drive, object]]


def with_imu(drive: Drive, **changes: object) -> Drive:
    """The drive with parts of its IMU data replaced."""
    return replace(drive, imu=replace(drive.imu, **changes))  # type: ignore[arg-type]


def codes(signals: ImuSignals) -> dict[str, str]:
    """Findings as code: level."""
    return {f.code: f.level for f in signals.findings}


@pytest.mark.parametrize("rate", [50.0, 104.4, 400.0, 1600.0])
@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (math.pi, 0.1, 2.0), (0.2, -1.2, -0.7)])
def test_biases_and_gravity_go_and_the_motion_stays(
    make_drive: Maker, rate: float, rpy: tuple[float, float, float]
) -> None:
    bias, turn = (0.12, -0.08, 0.1), (0.006, -0.004, 0.008)
    drive, truth = make_drive(rate=rate, rpy=rpy, force_bias=bias, rate_bias=turn, jitter=0.1, seconds=20.0)
    signals = ingest_drive(drive, Place(rpy=rpy))
    assert codes(signals) == {}
    assert signals.rate_hz == pytest.approx(rate, rel=1e-3)
    assert signals.force_bias == pytest.approx(bias, abs=0.01)
    assert signals.rate_bias == pytest.approx(turn, abs=5e-4)
    assert np.sqrt(np.mean((signals.force - truth.force) ** 2)) < 0.035  # the noise is 0.03
    assert np.sqrt(np.mean((signals.vertical_acceleration - truth.vertical) ** 2)) < 0.035
    assert abs(np.mean(signals.vertical_acceleration - truth.vertical)) < 0.005
    lean = np.linalg.norm(np.cross(signals.up, truth.up), axis=1)
    assert np.degrees(lean.max()) < 0.8
    assert signals.standing.mean() == pytest.approx(3.0 / 20.0, abs=0.05)
    assert not signals.standing[truth.speed > 0.5].any()


def test_hard_braking_does_not_tilt_the_vertical(make_drive: Maker) -> None:
    drive, truth = make_drive(pull=3.0, seconds=40.0)
    signals = ingest_drive(drive, Place())
    error = signals.vertical_acceleration - truth.vertical
    assert abs(error.mean()) < 0.004
    assert np.sqrt(np.mean(error**2)) < 0.035
    # Without GPS the same within twice the noise.
    blind = ingest_drive(make_drive(pull=3.0, seconds=40.0, velocities=False)[0], Place())
    assert np.sqrt(np.mean((blind.vertical_acceleration - truth.vertical) ** 2)) < 0.06
    assert blind.standing.mean() == pytest.approx(3.0 / 40.0, abs=0.03)


def test_a_slope_is_not_a_bias(make_drive: Maker) -> None:
    slope = math.radians(5.0)
    drive, truth = make_drive(slope=slope, force_bias=(0.0, 0.0, 0.05))
    signals = ingest_drive(drive, Place())
    assert codes(signals) == {"tilted": "warn"}
    assert np.abs(signals.force_bias[:2]).max() < 0.02
    assert abs(np.mean(signals.vertical_acceleration - truth.vertical)) < 0.01
    assert -math.asin(np.median(signals.up[:, 0])) == pytest.approx(-slope, abs=0.005)


def test_g_is_converted_and_told(make_drive: Maker) -> None:
    drive, truth = make_drive()
    in_g = with_imu(drive, specific_force=drive.imu.specific_force / 9.80665)
    signals = ingest_drive(in_g, Place())
    assert codes(signals) == {"units_g": "warn"}
    assert np.std(signals.vertical_acceleration - truth.vertical) < 0.035
    plain = ingest_drive(in_g, Place(), ImuSettings(convert_units=False))
    assert codes(plain)["units_g"] == "warn"
    assert np.abs(plain.force).max() < 3.0


def test_gravity_already_removed_is_put_back_and_told(make_drive: Maker) -> None:
    drive, truth = make_drive(pull=0.5)
    without = drive.imu.specific_force - 9.80665 * truth.up
    signals = ingest_drive(with_imu(drive, specific_force=without), Place())
    assert codes(signals) == {"gravity_removed": "warn"}
    assert np.std(signals.vertical_acceleration - truth.vertical) < 0.035
    assert signals.force[:, 2].mean() == pytest.approx(signals.gravity, abs=0.02)
    left = ingest_drive(with_imu(drive, specific_force=without), Place(), ImuSettings(restore_gravity=False))
    assert left.vertical_acceleration == pytest.approx(signals.vertical_acceleration, abs=1e-9)
    assert abs(left.force[:, 2].mean()) < 0.02


def test_upside_down_is_an_error_and_turned_unless_told_otherwise(make_drive: Maker) -> None:
    drive, truth = make_drive(rpy=(math.pi, 0.0, 0.0))
    signals = ingest_drive(drive, Place())
    assert codes(signals) == {"upside_down": "error"}
    assert np.std(signals.vertical_acceleration - truth.vertical) < 0.04
    never = ingest_drive(drive, Place(), ImuSettings(level="never"))
    assert codes(never) == {"upside_down": "error"}
    assert np.std(never.vertical_acceleration + truth.vertical) < 0.04


def test_a_small_tilt_is_told_and_left_in_unless_asked(make_drive: Maker) -> None:
    tilt = math.radians(6.0)
    drive, truth = make_drive(rpy=(0.0, tilt, 0.0))
    reported = ingest_drive(drive, Place())
    assert codes(reported) == {"tilted": "warn"}
    assert reported.force[:300].mean(axis=0)[0] == pytest.approx(-9.8 * math.sin(tilt), abs=0.05)
    assert abs(reported.vertical_acceleration.mean()) < 0.02  # free of gravity all the same
    turned = ingest_drive(drive, Place(), ImuSettings(level="always"))
    assert np.std(turned.force - truth.force) < 0.035
    given = ingest_drive(drive, Place(rpy=(0.0, tilt, 0.0)))
    assert codes(given) == {}


def test_lost_repeated_mixed_and_broken_samples(make_drive: Maker) -> None:
    drive, truth = make_drive(seconds=20.0)
    imu = drive.imu
    order = np.arange(len(imu))
    order[500:520] = np.random.default_rng(0).permutation(order[500:520])
    order = np.concatenate([order[:1000], order[995:1000], order[1000:1400], order[1440:]])
    force = imu.specific_force[order].copy()
    force[700] = np.nan
    t = imu.t[order].copy()
    t[800] = np.nan
    signals = ingest_drive(replace(drive, imu=ImuData(t, force, imu.angular_rate[order])), Place())
    assert codes(signals) == dict.fromkeys(("invalid", "duplicates", "reordered", "gaps"), "warn")
    assert np.all(np.diff(signals.t) > 0)
    assert len(signals) == 2000 - 40 - 2
    assert signals.gaps == pytest.approx(np.array([[truth.t[1399], truth.t[1440]]]), abs=1e-6)
    found = np.searchsorted(truth.t, signals.t - 1e-6)
    assert np.std(signals.vertical_acceleration - truth.vertical[found]) < 0.04


def test_a_looped_recording_is_one_loop(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=20.0)
    imu = drive.imu
    again = np.concatenate([np.arange(2000), np.arange(900)])
    looped = ImuData(imu.t[again], imu.specific_force[again], imu.angular_rate[again])
    signals = ingest_drive(replace(drive, imu=looped), Place())
    assert codes(signals) == {"looped": "warn"}
    assert len(signals) == 2000


def test_saturation_dead_axis_low_rate_and_a_stuck_clock(make_drive: Maker) -> None:
    drive, _ = make_drive()
    force = np.minimum(drive.imu.specific_force, 10.3)
    signals = ingest_drive(with_imu(drive, specific_force=force), Place())
    assert codes(signals) == {"saturated": "warn"}
    assert np.array_equal(signals.saturated, (drive.imu.specific_force > 10.3).any(axis=1))
    rates = drive.imu.angular_rate.copy()
    rates[:, 0] = 0.0
    assert codes(ingest_drive(with_imu(drive, angular_rate=rates), Place())) == {"gyro_axis_dead": "error"}
    assert codes(ingest_drive(make_drive(rate=30.0)[0], Place()))["rate_low"] == "error"
    coarse = np.floor(drive.imu.t * 20) / 20
    assert codes(ingest_drive(with_imu(drive, t=coarse), Place()))["stamps_stuck"] == "error"


def test_no_standstill_is_told_and_biases_come_from_the_drive(make_drive: Maker) -> None:
    drive, truth = make_drive(stand=0.0, seconds=60.0, force_bias=(0.1, 0.1, 0.1), rate_bias=(0.005,) * 3)
    # The course follows the yaw.
    velocity = drive.velocity
    yaw = np.interp(velocity.t, truth.t, np.cumsum(truth.rate[:, 2]) * 0.01)
    speed = velocity.enu[:, :1]
    enu = np.hstack([speed * np.cos(yaw)[:, None], speed * np.sin(yaw)[:, None], 0 * speed])
    signals = ingest_drive(replace(drive, velocity=replace(velocity, enu=enu)), Place())
    assert codes(signals) == {"no_standstill": "warn"}
    assert signals.force_bias == pytest.approx([0.1] * 3, abs=0.03)
    assert signals.rate_bias == pytest.approx([0.005] * 3, abs=1e-3)
    assert np.std(signals.vertical_acceleration - truth.vertical) < 0.035


def test_a_steady_pull_is_not_a_standstill(make_drive: Maker) -> None:
    """Smooth and straight at 0.6 m/s² for five seconds looks as still as parked."""
    drive, truth = make_drive(seconds=9.0, stand=4.0, velocities=False, pull=0.0)
    moving = truth.t - truth.t[0] > 4.0
    force = drive.imu.specific_force.copy()
    rate = drive.imu.angular_rate.copy()
    quiet = np.random.default_rng(3).normal(0, 0.03, (int(moving.sum()), 3))
    force[moving] = quiet + np.array([0.6, 0.0, 9.80665])
    rate[moving] = 0.002 * quiet
    signals = ingest_drive(with_imu(drive, specific_force=force, angular_rate=rate), Place())
    assert signals.standing[~moving].mean() > 0.7
    assert signals.standing[moving].mean() < 0.1


def test_gravity_by_the_latitude_of_the_fixes(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=10.0)
    one = np.array([drive.imu.t[0]])
    fix = FixData(
        one, np.array([60.0]), np.array([10.0]), one * 0, np.array([0], np.int8), np.full((1, 3), np.nan)
    )
    assert ingest_drive(replace(drive, fix=fix), Place()).gravity == pytest.approx(9.8191, abs=1e-4)
    assert ingest_drive(drive, Place(), ImuSettings(latitude=0.0)).gravity == pytest.approx(9.7803, abs=1e-4)


def test_nothing_usable_is_refused(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=5.0)
    with pytest.raises(InputError, match="no IMU samples"):
        ingest_drive(with_imu(drive, t=np.empty(0)), Place())
    with pytest.raises(InputError, match="too few"):
        ingest_drive(with_imu(drive, specific_force=np.full((500, 3), np.nan)), Place())


@pytest.mark.parametrize(
    "wrong",
    [
        {"level": "sometimes"},
        {"max_bias": -1.0},
        {"attitude_time": math.inf},
        {"full_scale": 0.0},
        {"full_scale_rate": math.nan},
        {"latitude": 91.0},
    ],
)
def test_wrong_settings_are_named(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        ImuSettings(**wrong)  # type: ignore[arg-type]
