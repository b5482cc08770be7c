# SPDX-License-Identifier: Apache-2.0
"""Batches keep house: lanes apart, failures contained, threads and processes alike, code kept on disk."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.errors import InputError, WorkError
from suspension_twin.models.excitation import coarser, excitation, substeps
from suspension_twin.models.parameters import lanes, layout, pack
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.road import bump_road, circular

TWIN = Path(__file__).resolve().parents[2] / "config" / "twins" / "ford_mondeo_mk4.yaml"
FORCE = "vehicle.front.damper_push.force.3"


@pytest.fixture(scope="module")
def way(mondeo: Any, drive: Any, rough: Any) -> Any:
    return excitation(drive(seconds=1.5, jitter=0.4, yaw_rate=0.1), mondeo.vehicle, rough)


def spread(twin: Any, count: int, seed: int = 0) -> Any:
    keys = [n for n in layout(twin).names if ".force." in n] + ["vehicle.mass", "imu.position.0"]
    base = dict(zip(layout(twin).names, pack(twin), strict=True))
    factors = np.random.default_rng(seed).uniform(0.97, 1.03, (count, len(keys)))
    return lanes(twin, keys, np.array([base[k] for k in keys]) * factors)


@settings(max_examples=12, deadline=None)
@given(count=st.integers(1, 80), threads=st.integers(1, 5), at=st.integers(0, 1000))
def test_a_lane_is_the_same_in_any_company(mondeo: Any, way: Any, count: int, threads: int, at: int) -> None:
    params = spread(mondeo, 80)
    at %= count
    batch = simulate_lanes(mondeo, params[:, :count], way, threads)
    alone = simulate_lanes(mondeo, params[:, at : at + 1], way, 1)
    assert np.array_equal(batch.force[:, :, at], alone.force[:, :, 0])
    assert np.array_equal(batch.rate[:, :, at], alone.rate[:, :, 0])
    assert np.array_equal(batch.vertical_acceleration[:, at], alone.vertical_acceleration[:, 0])


def test_less_asked_for_is_the_same_less(mondeo: Any, way: Any) -> None:
    params = spread(mondeo, 5)
    full = simulate_lanes(mondeo, params, way)
    less = simulate_lanes(mondeo, params, way, vertical_only=True)
    assert np.array_equal(full.vertical_acceleration, less.vertical_acceleration)
    assert less.force.shape == (len(way), 0, 5)


@pytest.mark.long
def test_more_points_on_the_same_line_change_nothing_but_rounding(mondeo: Any, way: Any) -> None:
    """Kernels for 3, 7 and 31 changes of slope."""
    plain = simulate_twin(mondeo, way).force
    for count in (7, 20):
        changes = {}
        for axle in ("front", "rear"):
            for part, key in (
                ("spring", "compression"),
                ("damper_push", "velocity"),
                ("damper_pull", "velocity"),
            ):
                x, f = getattr(getattr(mondeo.vehicle, axle), part).points
                more = np.unique(np.r_[x, np.linspace(0.05, 0.9, count)[: count - 4] * x[-1]])
                force = np.interp(more, np.r_[0, x], np.r_[0, f])
                changes[f"vehicle.{axle}.{part}"] = {key: tuple(more), "force": tuple(force)}
        np.testing.assert_allclose(simulate_twin(mondeo.with_changes(changes), way).force, plain, atol=1e-8)


def test_a_bad_candidate_fails_alone(mondeo: Any, way: Any) -> None:
    keys = [
        FORCE,
        "vehicle.mass",
        "vehicle.front.unsprung_mass",
        "vehicle.cog.0",
        "vehicle.tyre.vertical_stiffness",
    ]
    base = dict(zip(layout(mondeo).names, pack(mondeo), strict=True))
    good = [base[k] for k in keys]
    values = np.array([good] * 9)
    values[1, 0] = 100.0  # falls
    values[2, 1] = 0.0
    values[3, 1] = 100.0  # less than the wheels
    values[4, 2] = -1.0
    values[5, 3] = 5.0  # in front of the front axle
    values[6, 4] = 1e9  # a step of 1 ms cannot follow
    values[7, 0] = np.nan
    run = simulate_lanes(mondeo, lanes(mondeo, keys, values), way)
    assert run.failed.tolist() == [False] + [True] * 7 + [False]
    alone = simulate_twin(mondeo, way)
    for lane in (0, 8):
        assert np.array_equal(run.force[:, :, lane], alone.force)
    assert np.isfinite(run.force).all()
    assert not run.force[:, :, run.failed].any()


def test_a_diverging_lane_fails_alone(mondeo: Any, drive: Any, ground: Any) -> None:
    """A wall of 40 m: whoever is still a car behind it is not one."""
    wall = ground(lambda x, y: np.where(x > 6, 40.0, 0.0))
    way = excitation(drive(seconds=1), mondeo.vehicle, wall)
    run = simulate_lanes(mondeo, spread(mondeo, 3), way)
    assert run.failed.all()
    assert np.isfinite(run.force).all()
    with pytest.raises(WorkError, match="diverges"):
        simulate_twin(mondeo, way)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        (
            {"vehicle.front.spring": {"compression": (0.1, 0.2), "force": (2000.0, 2000.0)}},
            "vehicle.front.spring.force",
        ),
        ({"vehicle.cog": (0.1, 0.0, 0.5), "vehicle.front.unsprung_mass": 200.0}, "vehicle.cog"),
        (
            {"vehicle.tyre.vertical_stiffness": 1e7, "vehicle.rear.unsprung_mass": 2.0},
            "vehicle.tyre.vertical_stiffness",
        ),
    ],
)
def test_a_twin_that_cannot_stand_or_be_stepped_is_refused_by_its_key(
    mondeo: Any, way: Any, changes: Any, key: str
) -> None:
    with pytest.raises(InputError) as error:
        simulate_twin(mondeo.with_changes(changes), way)
    assert f"twin: {key}: " in str(error.value)


def test_candidates_that_are_none(mondeo: Any, way: Any) -> None:
    with pytest.raises(InputError, match="not a number of this twin"):
        lanes(mondeo, ["vehicle.front.spring.force.9"], np.zeros((1, 1)))
    with pytest.raises(InputError, match="road was looked up"):
        lanes(mondeo, ["vehicle.wheelbase"], np.zeros((1, 1)))
    with pytest.raises(InputError, match="candidates"):
        simulate_lanes(mondeo, np.zeros((3, 2)), way)


@pytest.mark.parametrize("step", [0.0, -1e-3, np.nan, 1.0])
def test_an_unusable_step_is_refused(mondeo: Any, drive: Any, flat: Any, step: float) -> None:
    with pytest.raises(InputError, match="max_step"):
        excitation(drive(seconds=0.1), mondeo.vehicle, flat, max_step=step)


def test_unusable_trajectories_and_roads_are_named(mondeo: Any, drive: Any, flat: Any, ground: Any) -> None:
    way = drive(seconds=0.2)

    def changed(name: str, at: int, value: float) -> Any:
        values = getattr(way, name).copy()
        values[at] = value
        return type(way)(**{k: values if k == name else getattr(way, k) for k in way.__dataclass_fields__})

    with pytest.raises(InputError, match="trajectory: x: is not finite at sample 3"):
        excitation(changed("x", 3, np.nan), mondeo.vehicle, flat)
    with pytest.raises(InputError, match="does not rise at sample 5"):
        excitation(changed("t", 5, way.t[4]), mondeo.vehicle, flat)
    hole = ground(lambda x, y: np.where(x > 1, np.inf, 0.0))
    with pytest.raises(InputError, match=r"road: no height under a wheel at t = 1700000000\.\d"):
        excitation(way, mondeo.vehicle, hole)


@given(interval=st.floats(1e-5, 0.5), most=st.floats(1e-4, 5e-3))
def test_steps_fill_the_interval_and_stay_below_the_largest(interval: float, most: float) -> None:
    n = substeps(interval, most)
    assert interval / n <= most * (1 + 3e-3)
    assert n == 1 or interval / (n - 1) > most * (1 - 1e-9)


def test_a_coarser_excitation_is_one_made_coarser(mondeo: Any, drive: Any, rough: Any) -> None:
    trajectory = drive(seconds=1.5, jitter=0.4, yaw_rate=0.1)
    fine, other = (excitation(trajectory, mondeo.vehicle, rough, step) for step in (1e-3, 2.5e-3))
    found = coarser(fine, 2.5e-3)
    for name in ("t", "substeps", "first", "road", "motion", "max_step"):
        assert np.array_equal(getattr(found, name), getattr(other, name)), name
    assert found.road.shape[0] < 0.5 * fine.road.shape[0]
    plain, rougher = (simulate_twin(mondeo, e).force for e in (fine, found))
    assert 0.0 < np.abs(rougher - plain).max() < 0.05 * np.abs(plain - plain.mean(axis=0)).max()
    with pytest.raises(InputError, match="max_step"):
        coarser(fine, 0.0)


def test_golden_derivatives(mondeo: Any, drive: Any, flat: Any) -> None:
    """One step from standing under braking and turning: what a change of this file would change."""
    way = drive(seconds=0.02, rate=1000, ax=0.0, t0=0.0)
    still = simulate_twin(mondeo, excitation(way, mondeo.vehicle, flat))
    assert np.abs(still.acceleration).max() < 1e-8
    brake = replace(way, acceleration=np.where(way.t[:, None] > 0, (-2.0, 1.0), 0.0))
    run = simulate_twin(mondeo, excitation(brake, mondeo.vehicle, flat))
    # the moments of m h a appear at the first step: 1725 x 0.55 x (1, 2) over 550 and 2600
    assert run.acceleration[1, 1] == pytest.approx(1725 * 0.55 / 550, rel=2e-2)
    assert run.acceleration[1, 2] == pytest.approx(1725 * 0.55 * 2 / 2600, rel=2e-2)
    golden = [-0.0253015, 1.48394, 0.658196, 0.180300, -0.946337, 1.38224, -0.106306]
    np.testing.assert_allclose(run.acceleration[20], golden, rtol=1e-4)
    exact = [
        -0.0253250,
        1.48391,
        0.658182,
        0.179888,
        -0.943695,
        1.37888,
        -0.105995,
    ]  # LSODA, test_against_lsoda
    np.testing.assert_allclose(run.acceleration[20], exact, rtol=4e-3)


def test_spawned_workers_give_the_same_numbers(mondeo: Any, drive: Any) -> None:
    """An evaluation is a pure function of arguments that can be sent to another process."""
    road = bump_road(circular(0.9, 0.05), at=2.0, length=20.0)
    way = excitation(drive(seconds=1.0, speed=5.0), mondeo.vehicle, road)
    params = spread(mondeo, 40)
    here = simulate_lanes(mondeo, params, way, 2).vertical_acceleration
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        there = pool.submit(simulate_lanes, mondeo, params, way, 2).result(timeout=120)
    assert np.array_equal(there.vertical_acceleration, here)


_START = """
import json, sys
import numpy as np
from suspension_twin.models import full_car
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.types import Trajectory
from suspension_twin.vehicle.twin import load_twin
class Flat:
    def heights(self, x, y): return 0 * x
t = np.arange(10) / 100
z = np.zeros_like(t)
twin = load_twin(sys.argv[1])
still = np.zeros((10, 2))
simulate_twin(twin, excitation(Trajectory(t, t, z, z, still, z, still, z == 0), twin.vehicle, Flat()))
stats = full_car.KERNELS[3, 3].stats
print(json.dumps([sum(stats.cache_hits.values()), sum(stats.cache_misses.values())]))
"""


def _start(environment: dict[str, str]) -> list[int]:
    run = subprocess.run(
        [sys.executable, "-c", _START, str(TWIN)],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
        env={**os.environ, **environment},
    )
    out: list[int] = json.loads(run.stdout.strip().splitlines()[-1])
    return out


@pytest.mark.long
def test_a_second_start_compiles_nothing(tmp_path: Path, copy_kernels: Any) -> None:
    copy_kernels(tmp_path, "suspension_twin.models.full_car.*")
    environment = {"NUMBA_CACHE_DIR": str(tmp_path)}
    assert _start(environment) == [0, 1]
    assert _start(environment) == [1, 0]
