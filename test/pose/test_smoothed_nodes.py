# SPDX-License-Identifier: Apache-2.0
"""A recorded drive as nodes: what is measured and kept, means over intervals, levers of sensor and antenna."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.pose import ekf
from suspension_twin.pose.ekf import planar_inputs
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.smoothed import (
    MAX_MEAN_SLOPE,
    Measurements,
    gather,
    make_nodes,
    mean_tilt,
    planar_rows,
)
from suspension_twin.pose.types import PoseSettings, fix_sigma
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.vehicle.twin import Datum, Place

T0 = 1.7e9
G = 9.81
DATUM = Datum(latitude=47.4, longitude=19.28, altitude=120.0)
IMU, GPS = Place(position=(1.9, 0.3, 1.2)), Place(frame="gps_link", position=(0.8, -0.4, 1.5))


def drive(s: np.ndarray, **spoilt: Any) -> Drive:
    """Fixes to the east at ``s`` from T0, 10 m/s, and velocities with them."""
    enu = np.column_stack([10.0 * s, 2.0 + 0.0 * s, 0.0 * s])
    lla = LocalMap(DATUM).to_geodetic(enu)
    status, sigma = np.zeros(s.size, np.int8), np.full((s.size, 3), 0.5)
    fix = FixData(T0 + s, lla[:, 0], lla[:, 1], lla[:, 2], status, sigma)
    velocity = VelocityData(T0 + s, np.tile([10.0, 0.0, np.nan], (s.size, 1)))
    imu = ImuData(np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    return replace(Drive("drive", imu, fix, velocity), **spoilt)


def test_fixes_velocities_and_headings_in_the_order_of_time() -> None:
    s = np.arange(0.0, 5.0)
    heading = HeadingData(T0 + s[::-1] + 0.3, 0.1 * s)
    found = gather(drive(s, heading=heading), DATUM, PoseSettings(velocity_sigma=0.2, heading_sigma=0.03))
    assert found.t == pytest.approx(T0 + np.repeat(s, 3) + np.tile([0.0, 0.0, 0.3], 5))
    assert found.kind.tolist() == [ekf.FIX, ekf.VELOCITY, ekf.HEADING] * 5
    assert found.z[0::3] == pytest.approx(np.column_stack([10.0 * s, 2.0 + 0.0 * s, 0.5 + 0.0 * s]), abs=1e-6)
    assert found.z[1::3] == pytest.approx(np.tile([10.0, 0.0, 0.2], (5, 1)))
    assert found.z[2::3] == pytest.approx(np.column_stack([0.1 * s[::-1], 0.0 * s, 0.03 + 0.0 * s]))


def test_what_is_of_no_use_is_left_out_and_what_repeats_counts_once() -> None:
    s = np.repeat(np.arange(0.0, 10.0), 2)
    whole = drive(s)
    fix, velocity = whole.fix, whole.velocity
    latitude, longitude, altitude, t = (c.copy() for c in (fix.latitude, fix.longitude, fix.altitude, fix.t))
    status, sigma, enu, vt = fix.status.copy(), fix.sigma.copy(), velocity.enu.copy(), velocity.t.copy()
    latitude[2:4] = longitude[4:6] = t[6:8] = np.nan
    status[8:10], sigma[10:12] = -1, 500.0
    altitude[12:14] = np.nan  # the height alone is no loss
    enu[2:4, 0] = enu[4:6, 1] = vt[6:8] = np.nan
    heading = HeadingData(T0 + np.array([0.5, np.nan, 1.5, 1.5]), np.array([0.1, 0.2, np.nan, 0.3]))
    spoilt = replace(
        whole,
        fix=FixData(t, latitude, longitude, altitude, status, sigma),
        velocity=VelocityData(vt, enu),
        heading=heading,
    )
    found = gather(spoilt, DATUM, PoseSettings())

    def at(kind: int) -> list[float]:
        return np.round(found.t[found.kind == kind] - T0, 3).tolist()

    assert at(ekf.FIX) == [0.0, 6.0, 7.0, 8.0, 9.0]
    assert at(ekf.VELOCITY) == [0.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    assert at(ekf.HEADING) == [0.5, 1.5]
    assert found.z[found.kind == ekf.FIX, 0] == pytest.approx([0.0, 60.0, 70.0, 80.0, 90.0], abs=1e-3)
    with pytest.raises(InputError, match="no usable GPS fix"):
        gather(replace(whole, fix=replace(fix, status=np.full(s.size, -1, np.int8))), DATUM, PoseSettings())


@pytest.mark.parametrize(("sigma", "wanted"), [(0.01, 0.1), (10.0, 0.5)])
def test_the_velocities_of_a_poor_receiver_are_poor(sigma: float, wanted: float) -> None:
    whole = drive(np.arange(0.0, 5.0))
    told = np.full((5, 3), sigma)
    told[0] = 25.0  # one alone says nothing
    found = gather(
        replace(whole, fix=replace(whole.fix, sigma=told)), DATUM, PoseSettings(velocity_sigma=0.1)
    )
    assert found.z[found.kind == ekf.VELOCITY, 2] == pytest.approx(wanted)
    assert found.z[found.kind == ekf.FIX, 2] == pytest.approx([25.0, *[sigma] * 4])


def test_how_sure_a_fix_is() -> None:
    own = PoseSettings(fix_sigma=2.0, fix_floor=0.02, fix_ceiling=20.0)
    assert math.isnan(fix_sigma(own, -1, 1.0, 1.0))
    assert fix_sigma(own, 0, 3.0, 4.0) == pytest.approx(math.sqrt(12.5))
    assert fix_sigma(own, 0, 0.0, 4.0) == pytest.approx(math.sqrt(8.0))
    assert fix_sigma(own, 0, 3.0, 0.0) == pytest.approx(math.sqrt(4.5))
    assert fix_sigma(own, 0, 0.001, 0.002) == 0.02
    assert fix_sigma(own, 0, 19.0, 19.0) == pytest.approx(19.0)
    assert math.isnan(fix_sigma(own, 0, 21.0, 21.0))
    for untold in ((0.0, 0.0), (math.nan, 1.0), (1.0, math.nan), (math.nan, math.nan)):
        plain, sbas, rtk = (fix_sigma(own, status, *untold) for status in (0, 1, 2))
        assert plain == fix_sigma(own, -2, *untold) == 2.0
        assert rtk < 0.1 * sbas < 0.1 * plain


# -- the IMU's part ------------------------------------------------------------------------------


NO_GAPS = np.empty((0, 2))


def signals(
    t: np.ndarray,
    force: np.ndarray,
    rate: np.ndarray,
    up: np.ndarray,
    rate_hz: float = 100.0,
    gaps: np.ndarray = NO_GAPS,
    place: Place = IMU,
    **more: Any,
) -> ImuSignals:
    """Clean signals in base_link axes at IMU."""
    n = t.size
    given = {
        "t": T0 + t,
        "force": force,
        "rate": rate,
        "vertical_acceleration": force[:, 2] - G * up[:, 2],
        "up": up,
        "standing": np.zeros(n, dtype=bool),
        "saturated": np.zeros(n, dtype=bool),
        "place": place,
        "gravity": G,
        "rate_hz": rate_hz,
        "force_bias": np.zeros(3),
        "rate_bias": np.zeros(3),
        "gaps": gaps,
        "findings": [],
    }
    return ImuSignals(**{**given, **more})


def tilted(roll: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """(n, 3) up in the axes of a body that rolls and pitches."""
    return np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])


def nodding(n: int = 6000) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, roll and pitch that swing at a hertz, and their rates; no slope on average."""
    t = np.arange(n) / 100.0
    roll, pitch = 0.03 * np.sin(6.0 * t), 0.04 * np.sin(5.0 * t + 1.0)
    return t, roll, pitch, 0.18 * np.cos(6.0 * t), 0.2 * np.cos(5.0 * t + 1.0)


def test_the_planar_part_of_a_body_that_turns_pulls_and_nods() -> None:
    """Yaw rate and pull of base_link, whatever the sensor feels ahead of it and above; the antenna's sway apart."""
    t, roll, pitch, droll, dpitch = nodding()
    turn, pull = 0.3 * np.sin(0.8 * t), 0.7 * np.cos(0.5 * t)
    up = tilted(roll, pitch)
    rate = np.column_stack([droll, dpitch, turn])
    px, py, pz = IMU.position
    faster = np.gradient(rate, t, axis=0)
    ahead = pull + G * up[:, 0] - turn**2 * px - faster[:, 2] * py + faster[:, 1] * pz
    still, sway = planar_rows(signals(t, np.column_stack([ahead, 0 * t, G + 0 * t]), rate, up), GPS)
    inner = slice(1500, -1500)
    about = np.einsum("ij,ij->i", rate, up)
    np.testing.assert_allclose(still[inner, 0], about[inner], rtol=0, atol=2e-3)
    np.testing.assert_allclose(still[inner, 1], pull[inner], rtol=0, atol=0.03)
    assert not still[:, 2:4].any()
    gx, gy, gz = GPS.position
    np.testing.assert_allclose(still[inner, 4:6], np.tile([gx, gy], (t.size, 1))[inner], rtol=0, atol=2e-3)
    np.testing.assert_allclose(
        still[inner, 6:8], np.column_stack([-about * gy, about * gx])[inner], rtol=0, atol=2e-3
    )
    # the roof goes ahead as the nose goes down, and to the right as it leans there
    np.testing.assert_allclose(sway[inner, 0], (gz * np.sin(pitch))[inner], rtol=0, atol=4e-3)
    np.testing.assert_allclose(sway[inner, 1], (-gz * np.sin(roll))[inner], rtol=0, atol=4e-3)
    np.testing.assert_allclose(sway[inner, 2], (gz * dpitch)[inner], rtol=0, atol=4e-3)
    np.testing.assert_allclose(sway[inner, 3], (-gz * droll)[inner], rtol=0, atol=4e-3)


@pytest.mark.parametrize(("rate_hz", "passes"), [(100.0, 12.0), (20.0, 8.0)])
def test_what_is_quicker_than_a_vehicle_turns_is_smoothed_away(rate_hz: float, passes: float) -> None:
    """As far as the rate allows; a constant passes unchanged."""
    t = np.arange(800) / rate_hz
    flat = tilted(0 * t, 0 * t)
    for frequency, least, most in ((0.125 * passes, 0.95, 1.001), (passes, 0.4, 0.6)):
        wave = np.sin(2.0 * np.pi * frequency * t)
        force = np.column_stack([0.5 + wave, 0 * t, G + 0 * t])
        rows, _ = planar_rows(
            signals(t, force, np.outer(wave, [0.0, 0.0, 1.0]), flat, rate_hz, place=Place()), Place()
        )
        inner = slice(200, -200)
        assert np.mean(rows[inner, 1]) == pytest.approx(0.5, abs=0.01)
        for column in (0, 1):
            assert least < math.sqrt(2.0) * np.std(rows[inner, column]) < most


def test_a_slope_moves_the_antenna_and_a_leaning_sensor_does_not() -> None:
    """Up to MAX_MEAN_SLOPE on average it is a slope, unless the caller knows better."""
    t, roll, pitch, droll, dpitch = nodding(1500)
    rate = np.column_stack([droll, dpitch, 0.1 + 0 * t])
    level = tilted(roll, pitch)
    force = G * level
    whole, _ = planar_rows(signals(t, force, rate, level), GPS)
    mended, own_sway = planar_rows(signals(t, force, rate, level), GPS, True)
    np.testing.assert_allclose(mended[:, 4:6].mean(axis=0), GPS.position[:2], rtol=0, atol=1e-3)
    for lean in ((0.03, -0.035), (-0.035, 0.03), (0.02, 0.04), (0.3, -0.5)):
        # the smallest turn that takes the sensor's mean vertical to z: no yaw in it
        up = Rotation.from_rotvec([lean[0], lean[1], 0.0]).apply(level)
        slope = math.degrees(math.hypot(*lean))
        assert mean_tilt(up) == pytest.approx(slope, rel=0.01)
        for upright in (False, True):
            rows, sway = planar_rows(signals(t, G * up, rate, up), GPS, upright)
            moved = rows[:, 4:6].mean(axis=0) - whole[:, 4:6].mean(axis=0)
            if upright or slope > MAX_MEAN_SLOPE:
                np.testing.assert_allclose(rows[:, 4:6], mended[:, 4:6], rtol=0, atol=2e-3)
                assert sway[:, :2] == pytest.approx(own_sway[:, :2], abs=2e-3)
            else:
                gz = GPS.position[2]
                assert moved == pytest.approx([-gz * up[:, 0].mean(), -gz * up[:, 1].mean()], abs=4e-3)
            # pull and yaw rate are those of the sensor as it stands, either way
            np.testing.assert_allclose(
                rows[:, :2], planar_rows(signals(t, G * up, rate, up), GPS)[0][:, :2], rtol=1e-6, atol=1e-12
            )


def test_mean_tilt_is_that_of_the_mean() -> None:
    assert mean_tilt(np.tile([0.0, 0.0, 1.0], (5, 1))) == 0.0
    assert mean_tilt(np.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])) == pytest.approx(0.0)
    assert mean_tilt(np.tile([0.3, 0.4, 0.5 * math.sqrt(3.0)], (3, 1))) == pytest.approx(30.0)
    assert mean_tilt(np.array([[0.0, 0.0, -1.0]])) == pytest.approx(180.0)


def test_the_antenna_s_place_is_its_arm_turned_level() -> None:
    """Whatever roll and pitch: ahead and left on level ground, by the rotation without the yaw."""
    random = np.random.default_rng(1)
    n = 50
    roll, pitch = random.uniform(-0.5, 0.5, (2, n))
    up, arm = tilted(roll, pitch), np.array(GPS.position)
    zero = np.zeros((n, 3))
    level = Rotation.from_euler("xyz", np.column_stack([roll, pitch, 0 * roll])).apply(arm)
    flat = tilted(0 * roll, 0 * roll)
    for share in (0.0, 0.4, 1.0):
        out = planar_inputs(G * up, zero, zero, up, flat, share, G, zero[0], arm)
        assert out[:, 4:6] == pytest.approx(arm[:2] + share * (level[:, :2] - arm[:2]))
        slow = planar_inputs(G * up, zero, zero, flat, up, share, G, zero[0], arm)
        assert slow[:, 4:6] == pytest.approx(level[:, :2] + share * (arm[:2] - level[:, :2]))
        assert out[:, [0, 1, 2, 3, 6, 7]] == pytest.approx(np.zeros((n, 6)), abs=1e-12)


# -- the nodes ---------------------------------------------------------------------------------


def some(t: np.ndarray, kind: int = ekf.FIX) -> Measurements:
    """Fixes at ``t`` from T0."""
    return Measurements(T0 + t, np.full(t.size, float(kind)), np.column_stack([t, -t, 0.1 + 0 * t]))


def flat(t: np.ndarray, rate_hz: float, **more: Any) -> ImuSignals:
    up = tilted(0 * t, 0 * t)
    return signals(t, G * up, 0 * up, up, rate_hz, **more)


@pytest.mark.parametrize(("rate_hz", "step"), [(400.0, 0.01), (100.0, 0.01), (25.0, 0.04)])
def test_every_measurement_within_has_a_node_of_its_own(rate_hz: float, step: float) -> None:
    t = np.arange(0.0, 4.0, 1.0 / rate_hz)
    at = np.array([-0.5, 0.0, 0.123, 1.0, 1.0004, 2.777, t[-1], 4.5])
    nodes = make_nodes(flat(t, rate_hz), np.zeros((t.size, 8)), np.zeros((t.size, 4)), some(at))
    assert (np.diff(nodes.t) >= 0.0).all()
    even = nodes.t[nodes.kind < 0] - T0
    assert even[[0, -1]] == pytest.approx([0.0, t[-1]], abs=1e-6)
    assert np.diff(even) == pytest.approx(np.full(even.size - 1, step), rel=0.02)
    own = nodes.kind == ekf.FIX
    assert nodes.t[own] - T0 == pytest.approx(at[1:-1], abs=1e-6)
    assert nodes.z[own] == pytest.approx(np.column_stack([at, -at, 0.1 + 0 * at])[1:-1])
    assert not nodes.z[~own].any()
    # of nodes that share a stamp the measured one comes last
    assert nodes.kind[1] == ekf.FIX and nodes.kind[-1] == ekf.FIX


def test_an_interval_has_the_mean_of_what_the_samples_draw() -> None:
    """Yaw rate and pull on jittered stamps, straight lines between them: no node loses a part of the integral."""
    random = np.random.default_rng(2)
    t = np.cumsum(random.uniform(0.004, 0.02, 500))
    rows, sway = random.normal(0.0, 0.3, (t.size, 8)), random.normal(0.0, 0.1, (t.size, 4))
    at = np.sort(random.uniform(t[0], t[-1], 20))
    nodes = make_nodes(flat(t, 83.0), rows, sway, some(at))
    s = nodes.t - T0
    assert nodes.inputs.shape == (s.size, 8)
    assert nodes.sway.shape == (s.size, 4)
    fine = np.linspace(0.0, 1.0, 4001)
    for column in (0, 1):
        for k in random.integers(1, s.size, 60):
            if s[k] - s[k - 1] > 1e-4:
                drawn = np.interp(s[k - 1] + fine * (s[k] - s[k - 1]), t, rows[:, column])
                assert nodes.inputs[k, column] == pytest.approx(float(np.mean(drawn)), abs=2e-3)
        whole = float(np.sum(np.diff(s) * nodes.inputs[1:, column]))
        drawn = np.sum(np.diff(t) * 0.5 * (rows[1:, column] + rows[:-1, column]))
        assert whole == pytest.approx(float(drawn), abs=1e-5)
    for column in range(4, 8):
        np.testing.assert_allclose(
            nodes.inputs[:, column], np.interp(s, t, rows[:, column]), rtol=0, atol=1e-4
        )
        np.testing.assert_allclose(
            nodes.sway[:, column - 4], np.interp(s, t, sway[:, column - 4]), rtol=0, atol=1e-4
        )
    assert (nodes.inputs[:, 3] == 1.0).all()


def test_standing_and_gaps_at_the_nodes() -> None:
    t = np.concatenate([np.arange(0.0, 2.0, 0.01), np.arange(3.0, 5.0, 0.01)])
    rows = np.zeros((t.size, 8))
    rows[(t > 0.495) & (t < 1.005), 2] = 1.0
    gaps = T0 + np.array([[1.99, 3.0]])
    nodes = make_nodes(
        flat(t, 100.0, gaps=gaps), rows, np.zeros((t.size, 4)), some(np.array([0.6031, 2.5, 4.0]))
    )
    s = nodes.t - T0
    stands = nodes.inputs[:, 2]
    assert set(stands) == {0.0, 1.0}
    assert (stands[(s > 0.5) & (s < 1.0)] == 1.0).all()
    assert not stands[(s < 0.49) | (s > 1.01)].any()
    loose = nodes.inputs[:, 3]
    inside = (s > 1.9901) & (s < 2.9999)
    assert (loose[inside] > 1.0).all()
    assert (loose[(s < 1.9899) | (s > 3.0001)] == 1.0).all()


def test_too_few_fixes_within_the_imu_s_time_are_refused() -> None:
    t = np.arange(0.0, 2.0, 0.01)
    rows, sway = np.zeros((t.size, 8)), np.zeros((t.size, 4))
    with pytest.raises(InputError, match="fewer than two fixes"):
        make_nodes(flat(t, 100.0), rows, sway, some(np.array([-1.0, 1.0, 5.0])))
    with pytest.raises(InputError, match="fewer than two fixes"):
        make_nodes(flat(t, 100.0), rows, sway, some(np.array([0.5, 1.0, 1.5]), ekf.VELOCITY))
    assert make_nodes(flat(t, 100.0), rows, sway, some(np.array([0.5, 1.0]))).t.size > 200
