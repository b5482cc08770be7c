# SPDX-License-Identifier: Apache-2.0
"""What the whole of a recording must say again when it is told in other words: other units, other axes, backwards."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.drive.types import Drive, FixData
from suspension_twin.signals.attitude import carried_up, normal_gravity, smooth_up, up_step
from suspension_twin.signals.imu import (
    STANDSTILL_FILTER_DELAY,
    ImuSettings,
    StillLimits,
    rest_bias,
    standstill_filter_step,
    standstill_mask,
    white_noise,
)
from suspension_twin.signals.metrics import rate_lanes
from suspension_twin.signals.offline import ImuSignals, ingest_drive
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.twin import Place

Maker = Callable[..., tuple[Drive, Any]]


def with_imu(drive: Drive, **changes: object) -> Drive:
    """The drive with parts of its IMU data replaced."""
    return replace(drive, imu=replace(drive.imu, **changes))  # type: ignore[arg-type]


def same(one: np.ndarray, other: np.ndarray, most: float) -> None:
    """Alike within ``most``."""
    np.testing.assert_allclose(one, other, rtol=0, atol=most)


@pytest.mark.parametrize(
    ("bias", "slope", "pull"),
    [((0.1, -0.2, 0.1), 0.0, 0.0), ((0.0, 0.0, 0.2), 0.1, 0.0), ((0.0, 0.0, 0.0), 0.1, 2.0)],
)
def test_a_sensor_in_g_that_is_left_so_says_the_same_in_g(
    make_drive: Maker, bias: tuple[float, float, float], slope: float, pull: float
) -> None:
    """Biases, slopes, accelerations and standstill are judged in m/s²."""
    drive, _ = make_drive(seconds=12.0, force_bias=bias, slope=slope, pull=pull)
    in_g = with_imu(drive, specific_force=drive.imu.specific_force / G)
    plain, turned = (ingest_drive(in_g, Place(), ImuSettings(convert_units=c)) for c in (False, True))
    whole = ingest_drive(drive, Place())
    assert [f.code for f in plain.findings] == [f.code for f in turned.findings]
    assert ("tilted" in [f.code for f in plain.findings]) == (slope > 0.0)
    assert turned.gravity == whole.gravity == pytest.approx(G * plain.gravity)
    same(turned.force, whole.force, 1e-9)
    for name in ("force", "force_bias", "vertical_acceleration"):
        same(G * getattr(plain, name), getattr(turned, name), 1e-9)
    same(plain.up, turned.up, 1e-12)
    assert np.array_equal(plain.standing, turned.standing)


@pytest.mark.parametrize("velocities", [True, False])
def test_a_standstill_is_seen_where_gravity_is_removed(make_drive: Maker, velocities: bool) -> None:
    """There is no vertical in the force that an acceleration could be told from."""
    drive, truth = make_drive(velocities=velocities, stand=6.0, rate_bias=(0.01, 0.01, 0.02))
    signals = ingest_drive(with_imu(drive, specific_force=drive.imu.specific_force - G * truth.up), Place())
    assert [f.code for f in signals.findings] == ["gravity_removed"]
    assert signals.standing[: int(5.5 * signals.rate_hz)].mean() > 0.9
    same(signals.rate_bias, np.array([0.01, 0.01, 0.02]), 5e-4)


def test_whatever_way_the_sensor_is_mounted_and_said_to_be_all_is_the_same(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=10.0, force_bias=(0.1, 0.0, 0.1), rate_bias=(0.01, 0.0, -0.01))
    upright = ingest_drive(drive, Place(position=(1.0, 0.5, 0.3)))
    rpy = (0.4, -1.1, 2.5)
    own = Rotation.from_euler("xyz", rpy).inv()
    mounted = with_imu(
        drive,
        specific_force=own.apply(drive.imu.specific_force),
        angular_rate=own.apply(drive.imu.angular_rate),
    )
    turned = ingest_drive(mounted, Place(position=(1.0, 0.5, 0.3), rpy=rpy))
    for name in ("force", "rate", "vertical_acceleration", "up", "force_bias"):
        same(getattr(turned, name), getattr(upright, name), 1e-9)
    same(turned.rate_bias, upright.rate_bias, 1e-9)
    assert np.array_equal(turned.standing, upright.standing)
    # what was taken off is what was put on
    put_on = drive.imu.specific_force - upright.force
    same(put_on, np.tile(upright.force_bias, (len(put_on), 1)), 1e-9)
    same(drive.imu.angular_rate - upright.rate, np.tile(upright.rate_bias, (len(put_on), 1)), 1e-9)


def test_a_rest_on_a_slope_and_a_long_reading(make_drive: Maker) -> None:
    """Of what is longer than gravity only the length is bias; the rates are turned with the forces."""
    drive, _ = make_drive(seconds=10.0, slope=0.2, pull=0.0, rate_bias=(0.02, 0.01, 0.03))
    longer = with_imu(drive, specific_force=1.02 * drive.imu.specific_force)
    signals = ingest_drive(longer, Place())
    rest = signals.force[signals.standing].mean(axis=0)
    assert np.linalg.norm(rest) == pytest.approx(G, abs=5e-3)
    assert rest[0] == pytest.approx(G * math.sin(0.2), abs=0.01)
    level = ingest_drive(drive, Place(), ImuSettings(level="always"))
    assert level.force[level.standing].mean(axis=0) == pytest.approx([0.0, 0.0, G], abs=5e-3)
    turn = Rotation.from_euler("xyz", [0.0, -0.2, 0.0])
    same(level.rate_bias, turn.apply([0.02, 0.01, 0.03]), 5e-4)
    same(level.rate, turn.apply(ingest_drive(drive, Place()).rate), 1e-3)


def test_the_sensor_far_from_the_axle_feels_bends_and_the_vertical_does_not(make_drive: Maker) -> None:
    """What turning adds at its place is taken for no tilt."""
    drive, truth = make_drive(seconds=30.0)
    x, y = 3.0, 1.0
    turn = truth.rate[:, 2]
    faster = np.gradient(turn, truth.t)
    more = np.column_stack([-(turn**2) * x - faster * y, faster * x - turn**2 * y, 0.0 * turn])
    moved = with_imu(drive, specific_force=drive.imu.specific_force + more)
    there = ingest_drive(moved, Place(position=(x, y, 0.0)))
    here = ingest_drive(drive, Place())
    same(there.up, here.up, 3e-3)
    wrong = ingest_drive(moved, Place(position=(-5 * x, -5 * y, 0.0)))
    assert np.abs(wrong.up - here.up).max() > 2.0 * np.abs(there.up - here.up).max()


def test_the_latitude_is_the_middle_one_of_usable_fixes(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=5.0)
    t = drive.imu.t[0] + np.arange(5.0)
    latitude = np.array([10.0, 60.0, np.nan, 61.0, 62.0])
    status = np.array([-1, 0, 0, 0, 0], np.int8)
    fix = FixData(t, latitude, 0 * t, 0 * t, status, np.full((5, 3), np.nan))
    assert ingest_drive(replace(drive, fix=fix), Place()).gravity == pytest.approx(normal_gravity(61.0))
    none = replace(fix, status=np.full(5, -1, np.int8))
    assert ingest_drive(replace(drive, fix=none), Place()).gravity == G


@pytest.mark.parametrize("latitude", [-90.0, 90.0, 0.0])
def test_every_latitude_on_earth_is_one(latitude: float) -> None:
    assert ImuSettings(latitude=latitude).latitude == latitude


def texts(signals: ImuSignals) -> dict[str, str]:
    """Findings as code: text."""
    return {f.code: f.text for f in signals.findings}


def test_findings_have_the_numbers_right(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=15.0)
    imu = drive.imu
    keep = np.r_[0:500, 520:900, 1000:1500]
    force = imu.specific_force.copy()
    force[[600, 610, 620], 1] = 30.0
    force[[5, 7]] = np.nan
    spoilt = imu.select(keep)
    signals = ingest_drive(
        replace(drive, imu=replace(spoilt, specific_force=force[keep])), Place(), ImuSettings(full_scale=30.0)
    )
    found = texts(signals)
    assert found["gaps"].startswith("2 gaps, 1.22 s in all, the longest 1.01 s")
    assert found["saturated"].startswith(f"3 of {len(keep) - 2} samples")
    assert found["invalid"].startswith("2 ")
    assert np.flatnonzero(signals.saturated).tolist() == [
        int(np.searchsorted(signals.t, spoilt.t[k])) for k in (580, 590, 600)
    ]


def test_a_rate_at_the_end_of_its_range_is_saturated_too(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=10.0)
    rate = drive.imu.angular_rate.copy()
    rate[700, 2] = -4.36
    signals = ingest_drive(with_imu(drive, angular_rate=rate), Place(), ImuSettings(full_scale_rate=4.36))
    assert np.flatnonzero(signals.saturated).tolist() == [700]


# -- the vertical ----------------------------------------------------------------------------


def test_backwards_in_time_it_is_carried_as_forwards() -> None:
    """Time turned round, the gyro turns the other way: first and last change places. Its bias is learnt, too."""
    random = np.random.default_rng(0)
    t = np.cumsum(random.uniform(0.005, 0.015, 3000))
    force = np.array([0.3, -0.2, G]) + random.normal(0.0, 0.5, (t.size, 3))
    rate = np.array([0.01, -0.02, 0.1]) + random.normal(0.0, 0.1, (t.size, 3))
    time = random.uniform(2.0, 8.0, t.size)
    ahead, back = carried_up(t, force, rate, G, time)
    mirrored = carried_up(-t[::-1], force[::-1].copy(), -rate[::-1], G, time[::-1].copy())
    same(mirrored[0][::-1], back, 1e-9)
    same(mirrored[1][::-1], ahead, 1e-9)
    both = ahead + back
    same(smooth_up(t, force, rate, G, time), both / np.linalg.norm(both, axis=1, keepdims=True), 1e-12)
    assert np.abs(ahead - back).max() > 1e-3


@pytest.mark.parametrize("angle", [1e-3, 0.02, 0.0499, 0.0501, 0.3, 2.0])
def test_one_step_is_a_rotation(angle: float) -> None:
    """By whichever formula: in the limit of small angles and beyond."""
    axis = np.array([0.48, -0.6, 0.64])
    up = np.array([0.36, 0.48, 0.8])
    expected = Rotation.from_rotvec(-angle * axis).apply(up)
    up_step(up, np.zeros(3), np.array([0.0, 0.0, G]), axis * angle / 0.02, 0.02, G, 0.0, 0.0)
    same(up, expected, 2e-9)


def test_the_correction_and_the_bias_are_along_the_error() -> None:
    """Mahony: about the axis that takes the vertical to the force, by the gain; the bias against it."""
    up, bias = np.array([0.0, 0.0, 1.0]), np.array([0.01, -0.02, 0.03])
    force = G * np.array([0.02, -0.01, 1.0])
    error = np.cross(force / G, up)
    gain = 0.125 / (1.0 + error @ error / 0.01)
    after, learnt = up.copy(), bias.copy()
    up_step(after, learnt, force, np.array([0.1, 0.2, 0.3]), 0.01, G, 0.125, 0.02)
    turned = (np.array([0.1, 0.2, 0.3]) - bias + gain * error) * 0.01
    same(after, Rotation.from_rotvec(-turned).apply(up), 1e-9)
    same(learnt, bias - 0.02 * gain * error * 0.01, 1e-12)
    # a force that is far off weighs less: it is the vehicle's own
    small, large = (np.array([0.0, 0.0, 1.0]) for _ in range(2))
    up_step(small, np.zeros(3), G * np.array([0.02, 0.0, 1.0]), np.zeros(3), 0.01, G, 0.125, 0.0)
    up_step(large, np.zeros(3), G * np.array([0.5, 0.0, 1.0]), np.zeros(3), 0.01, G, 0.125, 0.0)
    assert large[0] < 25.0 * small[0] / 10.0


# -- standstill --------------------------------------------------------------------------------


def test_the_standstill_filter_is_late_by_its_delay_and_has_two_poles() -> None:
    for dt in (0.001, 0.01):
        stages = np.zeros((3, 2))
        for k in range(round(2.0 / dt)):
            standstill_filter_step(stages, np.array([k * dt, 5.0]), dt)
        assert stages[0] == pytest.approx([2.0 - dt, 5.0])
        assert 2.0 - dt - stages[2, 0] == pytest.approx(STANDSTILL_FILTER_DELAY, abs=0.0012)
        assert stages[2, 1] == pytest.approx(5.0)
        stages = np.zeros((3, 1))
        wave = []
        for k in range(round(2.0 / dt)):
            standstill_filter_step(stages, np.array([math.sin(2 * math.pi * 10.0 * k * dt)]), dt)
            wave.append(stages[2, 0])
        # both poles at 10 Hz: half of it is left
        assert math.sqrt(2.0) * np.std(wave[len(wave) // 2 :]) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("axis", range(6))
def test_standing_ends_where_any_axis_shows_it(axis: int) -> None:
    """Shaken a little, more, and a little again; the more by half a window is left out on either side."""
    limits, rate_hz = StillLimits(), 100.0
    s = np.arange(1500) / rate_hz
    limit = limits.force if axis < 3 else limits.rate
    loud = (s > 5.0) & (s < 10.0)
    signal = np.zeros((s.size, 6))
    signal[:, axis] = limit * math.sqrt(2.0) * np.where(loud, 1.6, 0.6) * np.sin(2 * np.pi * 4.0 * s)
    still = standstill_mask(rate_hz, signal[:, :3] + [0, 0, G], signal[:, 3:], limits)
    assert still[s < 4.6].all()
    assert not still[(s > 5.0) & (s < 10.0)].any()
    assert still[s > 10.4].all()


def test_standing_needs_slow_rates_a_slow_speed_and_a_window_of_its_own() -> None:
    limits, rate_hz = StillLimits(), 100.0
    force, zero = np.tile([0.0, 0.0, G], (1000, 1)), np.zeros((1000, 3))
    assert standstill_mask(rate_hz, force, zero, limits).all()
    assert standstill_mask(rate_hz, force, zero + np.array([0.0, 0.04, 0.0]), limits).all()
    assert not standstill_mask(rate_hz, force, zero - np.array([0.0, 0.06, 0.0]), limits).any()
    speed = np.zeros(1000)
    speed[500:] = 0.4
    speed[100:200] = np.nan  # not known is not fast
    found = standstill_mask(rate_hz, force, zero, limits, speed)
    assert found[:470].all()
    assert not found[480:].any()
    assert not standstill_mask(rate_hz, force[:20], zero[:20], limits).any()
    # a stop shorter than a window is none
    speed = np.full(1000, 5.0)
    speed[300:380] = 0.0
    assert not standstill_mask(rate_hz, force, zero, limits, speed).any()
    speed[300:420] = 0.0
    assert standstill_mask(rate_hz, force, zero, limits, speed).any()


def test_a_reading_at_rest_is_bias_or_tilt() -> None:
    assert rest_bias(np.array([0.2, -0.1, 9.9]), 9.8, 0.3) == pytest.approx([0.2, -0.1, 0.1])
    tilt = np.array([3.0, -1.0, 9.5])
    bias = rest_bias(tilt, 9.8, 0.3)
    assert np.linalg.norm(tilt - bias) == pytest.approx(9.8)
    assert np.cross(bias, tilt) == pytest.approx(0.0, abs=1e-12)
    assert rest_bias(np.array([0.0, 0.1, -9.9]), 9.8, 0.3) == pytest.approx(
        np.array([0.0, 0.1, -9.9]) * (1 - 9.8 / math.hypot(0.1, 9.9))
    )
    assert rest_bias(np.zeros(3), 9.8, 0.3) == pytest.approx(0.0)


def test_white_noise_is_found_beside_a_slow_rocking() -> None:
    random = np.random.default_rng(0)
    t = np.arange(20_000) / 100.0
    rocking = np.sin(2 * np.pi * 0.5 * t)[:, None]
    assert white_noise(random.normal(0.0, 0.05, (t.size, 3)) + rocking) == pytest.approx(0.05, rel=0.12)
    assert white_noise(random.normal(0.0, [0.03, 0.0, 0.04], (t.size, 3))) == pytest.approx(
        0.05 / math.sqrt(3.0), rel=0.02
    )
    assert white_noise(np.ones((1, 3))) == 0.0


# -- the rating --------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [50, 55, 61, 100])
def test_the_largest_shift_is_looked_at(n: int) -> None:
    """A pulse that is late or early by k samples has the phase score 1 - k / (0.2 n), to the end of the range."""
    t = np.arange(n, dtype=float)
    middle = n / 2.0
    for k in (1, math.floor(0.2 * n) - 1, math.floor(0.2 * n)):
        pulse, late = (np.exp(-(((t - middle - d) / 2.5) ** 2)) for d in (0, k))
        for m, s in ((pulse, late), (late, pulse)):
            assert rate_lanes(m, s[None, :], 100.0)[0, 1] == pytest.approx(1.0 - k / (0.2 * n), abs=1e-12)


def test_where_one_of_the_two_is_flat_no_shift_is_better() -> None:
    """A ramp at the end that goes down where the measured one goes up: of the shifts that leave both."""
    t, n = np.arange(100.0), 100
    m = np.clip(t - 85.0, 0.0, None)
    found = {}
    for k in range(-20, 21):
        a, b = m[max(-k, 0) : n - max(k, 0)], -m[max(k, 0) : n - max(-k, 0)]
        if np.ptp(a) > 0.0 and np.ptp(b) > 0.0:
            found[k] = np.corrcoef(a, b)[0, 1]
    assert max(found.values()) < 0.0
    best = abs(max(found, key=lambda k: found[k]))
    scores = rate_lanes(m, np.vstack([-m, 0.0 * m, m]), 100.0)
    assert scores[:, 1] == pytest.approx([1.0 - best / 20.0, 1.0, 1.0])
    assert scores[2] == pytest.approx(1.0)
