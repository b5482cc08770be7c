# SPDX-License-Identifier: Apache-2.0
"""Drives with a known truth: what each sensor error does to them, and what cannot be made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.inference.synthetic import SensorErrors, path_along, synthetic_drive
from suspension_twin.road import Road
from suspension_twin.vehicle.twin import Twin

KNOTS = [(0.0, 0.0), (1.0, 0.0), (3.0, 4.0), (6.0, 4.0)]
QUIET = SensorErrors(force=0.0, rate=0.0, jitter=0.0, position=0.0, velocity=0.0)


def test_a_seed_is_a_drive(twin: Twin, bumps: Road) -> None:
    one, same, other = (synthetic_drive(twin, bumps, KNOTS, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.imu.specific_force, same.imu.specific_force)
    np.testing.assert_array_equal(one.fix.latitude, same.fix.latitude)
    assert not np.array_equal(one.imu.specific_force, other.imu.specific_force)


def test_each_error_does_what_its_name_says(twin: Twin, bumps: Road) -> None:
    clean = synthetic_drive(twin, bumps, KNOTS, seed=3, errors=QUIET)
    np.testing.assert_allclose(np.linalg.norm(clean.imu.specific_force[:50], axis=1), 9.81, atol=0.02)
    assert np.diff(clean.imu.t) == pytest.approx(0.01, abs=1e-6)
    late = synthetic_drive(twin, bumps, KNOTS, seed=3, errors=replace(QUIET, clock_offset=0.2))
    np.testing.assert_allclose(late.imu.t - clean.imu.t, 0.2, atol=1e-6)
    np.testing.assert_array_equal(late.fix.t, clean.fix.t)
    biased = synthetic_drive(
        twin, bumps, KNOTS, seed=3, errors=replace(QUIET, force_bias=(0.1, 0, 0), rate_bias=(0, 0.02, 0))
    )
    moved = biased.imu.specific_force - clean.imu.specific_force
    np.testing.assert_allclose(moved, [[0.1, 0.0, 0.0]] * len(moved), atol=1e-12)
    assert (biased.imu.angular_rate - clean.imu.angular_rate)[:, 1] == pytest.approx(0.02)
    noisy = synthetic_drive(twin, bumps, KNOTS, seed=3, errors=replace(QUIET, force=0.05, rate=0.003))
    assert np.std(noisy.imu.specific_force - clean.imu.specific_force) == pytest.approx(0.05, rel=0.1)
    lossy = synthetic_drive(
        twin, bumps, KNOTS, seed=3, errors=replace(QUIET, lost=0.1, imu_rate=200.0, gps_rate=5.0)
    )
    assert 0.85 * 1200 < len(lossy.imu.t) < 0.95 * 1200
    assert np.diff(lossy.fix.t) == pytest.approx(0.2, abs=1e-6)


def test_the_path_keeps_to_the_road_and_its_speed(bumps: Road) -> None:
    t = np.linspace(0.0, 6.0, 601)
    path = path_along(bumps, t, KNOTS, u=2.0, v=0.4)
    u, v = bumps.xy_to_uv(path.x, path.y)
    np.testing.assert_allclose(v, 0.4, atol=1e-6)
    np.testing.assert_allclose(np.gradient(u, t)[5:-5], path.speed[5:-5], atol=0.02)
    assert path.speed[0] == 0.0 and path.speed[-1] == pytest.approx(4.0)


def test_what_cannot_be_made_is_said(twin: Twin, bumps: Road) -> None:
    with pytest.raises(InputError, match="speed: needs at least two knots"):
        synthetic_drive(twin, bumps, [(0.0, 1.0)], seed=1)
    with pytest.raises(InputError, match="datum"):
        synthetic_drive(twin.model_copy(update={"datum": None}), bumps, KNOTS, seed=1)
