# SPDX-License-Identifier: Apache-2.0
"""The faults that are put into a multibody car's drives: what they do, in closed form, and that seeds are apart."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.road import ReferenceLine, Road

ROAD = ("road_scale", "road_smoothing", "position_offset", "lateral_offset")
LEVEL = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def seeded() -> ModuleType:
    return import_module("seeded")


@pytest.fixture(scope="module")
def truth(seeded: ModuleType) -> Any:
    """A car that heaves at 2 Hz and pitches at 1 Hz, for ten seconds."""
    t = np.arange(0.0, 10.0, 0.005)
    zero = np.zeros_like(t)
    columns = {
        "t": t,
        "fx": zero,
        "fy": 0.3 * np.sin(2 * np.pi * 0.5 * t),
        "fz": 9.81 + np.sin(2 * np.pi * 2.0 * t),
        "wx": zero,
        "wy": 0.1 * np.sin(2 * np.pi * t),
        "wz": zero,
    }
    return seeded.Truth(columns, 1000.0, 2.7, 0.75)


@pytest.fixture(scope="module")
def drive(truth: Any) -> Drive:
    """What a perfect phone records of it, at 100 Hz."""
    pick = slice(0, None, 2)
    force = np.stack([truth.columns[k][pick] for k in ("fx", "fy", "fz")], axis=1)
    rate = np.stack([truth.columns[k][pick] for k in ("wx", "wy", "wz")], axis=1)
    none = np.empty(0)
    fix = FixData(none, none, none, none, np.empty(0, dtype=np.int8), np.empty((0, 3)))
    return Drive(
        "heave", ImuData(1000.0 + truth.t[pick], force, rate), fix, VelocityData(none, np.empty((0, 3)))
    )


@pytest.fixture(scope="module")
def road() -> Road:
    u, v = np.arange(0.0, 40.0, 0.05), np.arange(-2.0, 2.05, 0.1)
    z = np.sin(2 * np.pi * u / 4.0)[:, None] * 0.02 + 0.01 * v[None, :]
    return Road(
        name="waves",
        z=z,
        v=np.round(v, 6),
        reference=ReferenceLine.level(u, np.zeros_like(u), 0.05, (0.0, 0.0)),
    )


def test_every_effect_comes_faint_and_plain_and_seeds_share_no_case(seeded: ModuleType) -> None:
    development, reporting = seeded.plan("development"), seeded.plan("reporting")
    assert [c.name for c in development] == [c.name for c in reporting]
    assert development == seeded.plan("development")
    for effect in seeded.EFFECTS:
        own = [c for c in reporting if effect in c.faults]
        assert sorted({c.amount for c in own}) == [seeded.FAINT, seeded.PLAIN]
        assert {c.reference for c in own} == ({False} if effect in ROAD else {False, True})
    known = {c.name: c.faults for c in development if c.faults}
    assert not any(known[c.name] == c.faults for c in reporting if c.faults)
    assert sum(not c.faults for c in reporting) == 6


def test_gross_faults_are_gross_and_differ_from_seeds_to_seeds(seeded: ModuleType) -> None:
    development, reporting = seeded.plan_gross("development"), seeded.plan_gross("reporting")
    assert [c.name for c in development] == [c.name for c in reporting]
    assert len(reporting) == len({c.name for c in reporting}) == 2 * len(seeded.GROSS) - 2
    assert not any(a.faults == b.faults for a, b in zip(development, reporting, strict=True))
    least = {
        "time_offset": 0.3,
        "clock_drift": 4000.0,
        "sensor_tilt": 1.5,
        "position_offset": 1.0,
        "lateral_offset": 0.7,
    }
    for case in (*development, *reporting):
        ((effect, values),) = case.faults.items()
        assert max(abs(v) for v in values.values()) >= least[effect]


def test_a_vehicles_own_effects_come_with_and_without_a_name(seeded: ModuleType) -> None:
    development, reporting = seeded.plan_vehicle("development"), seeded.plan_vehicle("reporting")
    effects = seeded.VEHICLE
    assert len({c.name for c in development}) == len(development) == 4 * len(effects)
    for case in development:
        (effect,) = case.faults
        assert case.name.startswith(effect) and case.reference == case.name.endswith("_ref")
        assert case.share == pytest.approx(case.amount, rel=0.25)
    assert not {(c.share, c.seed) for c in development} & {(c.share, c.seed) for c in reporting}


def test_what_the_vehicle_changes_is_added_in_the_sensors_axes(
    seeded: ModuleType, drive: Drive, truth: Any
) -> None:
    own = np.zeros((truth.t.size, 6))
    own[:, 2], own[:, 4] = 0.5, 0.02
    turned = (np.pi / 2, 0.0, 0.0)  # its y looks up, its z to the right
    more = seeded.recorded(drive, truth, turned, {}, own).imu
    assert more.specific_force[50:-50] - drive.imu.specific_force[50:-50] == pytest.approx(
        np.tile([0.0, 0.5, 0.0], (drive.imu.t.size - 100, 1)), abs=1e-9
    )
    assert more.angular_rate[50:-50] - drive.imu.angular_rate[50:-50] == pytest.approx(
        np.tile([0.0, 0.0, -0.02], (drive.imu.t.size - 100, 1)), abs=1e-9
    )


def test_nothing_put_in_changes_nothing(seeded: ModuleType, drive: Drive, truth: Any) -> None:
    same = seeded.recorded(drive, truth, LEVEL, {})
    np.testing.assert_allclose(same.imu.specific_force, drive.imu.specific_force, atol=1e-9)
    np.testing.assert_allclose(same.imu.t, drive.imu.t, rtol=0, atol=1e-6)


def test_a_gain_multiplies_gravity_and_no_rate(seeded: ModuleType, drive: Drive, truth: Any) -> None:
    loud = seeded.recorded(drive, truth, LEVEL, {"sensor_scale": {"scale": 0.2}})
    np.testing.assert_allclose(loud.imu.specific_force, 1.2 * drive.imu.specific_force, atol=1e-3)
    np.testing.assert_allclose(loud.imu.angular_rate, drive.imu.angular_rate, atol=1e-9)


def test_a_sensor_ahead_feels_the_pitch(seeded: ModuleType, drive: Drive, truth: Any) -> None:
    """At x ahead, w_y' pulls down by x w_y' and the turning in by x w_y^2."""
    ahead = seeded.recorded(drive, truth, LEVEL, {"sensor_offset": {"x": 1.5, "y": 0.0, "z": 0.0}})
    s = drive.imu.t - 1000.0
    turned, rate = 0.1 * 2 * np.pi * np.cos(2 * np.pi * s), 0.1 * np.sin(2 * np.pi * s)
    more = ahead.imu.specific_force - drive.imu.specific_force
    inside = slice(20, -20)
    np.testing.assert_allclose(more[inside, 2], -1.5 * turned[inside], atol=5e-3)
    np.testing.assert_allclose(more[inside, 0], -1.5 * rate[inside] ** 2, atol=5e-3)


def test_a_low_pass_takes_what_is_quick_by_its_own_gain(seeded: ModuleType, drive: Drive, truth: Any) -> None:
    slow = seeded.recorded(drive, truth, LEVEL, {"sensor_bandwidth": {"cutoff": 2.0}})
    inside = slice(200, -200)
    gain = 1.0 / (2 * 0.75)  # of s^2 + 2 d w s + w^2 at w, with d 0.75
    heave = np.std(slow.imu.specific_force[inside, 2]) / np.std(drive.imu.specific_force[inside, 2])
    assert heave == pytest.approx(gain, rel=0.02)


def test_a_range_cuts_and_clocks_are_set(seeded: ModuleType, drive: Drive, truth: Any) -> None:
    faults = {
        "sensor_clipping": {"range": 10.2},
        "time_offset": {"offset": 0.05},
        "clock_drift": {"drift_ppm": 1000.0},
    }
    found = seeded.recorded(drive, truth, LEVEL, faults).imu
    assert found.specific_force[:, 2].max() == 10.2
    np.testing.assert_allclose(found.t - drive.imu.t, 0.05 + 1e-3 * (drive.imu.t - 1000.0), atol=1e-6)


def test_the_road_file_is_wrong_as_it_is_told(seeded: ModuleType, road: Road) -> None:
    np.testing.assert_allclose(
        seeded.surveyed(road, {"road_scale": {"scale": 0.25}}).z * 1.25, road.z, atol=1e-12
    )
    ahead = seeded.surveyed(road, {"position_offset": {"offset": 0.5}})
    np.testing.assert_allclose(ahead.z[:-20], road.z[10:-10], atol=1e-9)
    beside = seeded.surveyed(road, {"lateral_offset": {"offset": 0.3}})
    np.testing.assert_allclose(beside.z[:, :-4] - road.z[:, :-4], 0.003, atol=1e-9)
    smooth = seeded.surveyed(road, {"road_smoothing": {"sigma": 0.5}})
    wave = np.exp(-0.5 * (2 * np.pi * 0.5 / 4.0) ** 2)  # what a Gaussian leaves of 4 m
    inside = slice(100, -100)
    np.testing.assert_allclose(np.ptp(smooth.z[inside, 20]) / np.ptp(road.z[inside, 20]), wave, rtol=0.02)
