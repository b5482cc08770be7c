# SPDX-License-Identifier: Apache-2.0
"""Preparing a drive and measuring the gap: against noise that is known and shifts that are made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from suspension_twin.drive.types import Drive, FixData, ImuData
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.gap import CHANNELS, measure_gap
from suspension_twin.inference.observation import Observation, observe, origin_of
from suspension_twin.inference.synthetic import SensorErrors, path_along, synthetic_drive
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.planar_denoising import wiener
from suspension_twin.pose.smoothed import locked_trajectory
from suspension_twin.road import Road
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.signals.noise_floor import floor_rms, white_noise_sigma
from suspension_twin.vehicle.twin import EffectSpec, Twin

KNOTS = [(0.0, 0.0), (3.0, 0.0), (6.0, 5.0), (14.0, 6.0), (16.0, 0.0), (19.5, 0.0)]


@pytest.fixture(scope="module")
def prepared(drive: Drive, twin: Twin, bumps: Road) -> Observation:
    return observe(drive, twin, bumps)


def without_fixes(drive: Drive) -> Drive:
    empty = np.empty(0)
    return replace(
        drive,
        fix=FixData(empty, empty, empty, empty, np.empty(0, dtype=np.int8), np.empty((0, 3))),
    )


def test_the_true_twin_leaves_little_more_than_the_noise(prepared: Observation, twin: Twin) -> None:
    gap = prepared.gap(prepared.condition(simulate_twin(twin, prepared.excitation)))
    assert prepared.noise_rms["vertical_acceleration"] == pytest.approx(0.029, rel=0.15)
    assert gap.rms < 1.25 * gap.noise_rms
    assert gap.channels["pitch_rate"] < 1.3 * prepared.noise_rms["pitch_rate"]
    assert gap.mse == gap.rms**2
    moving = prepared.mask & (np.abs(prepared.speed) > 0.1)
    assert gap.seconds == pytest.approx(np.count_nonzero(moving) / prepared.rate)
    assert gap.seconds < 0.7 * np.count_nonzero(prepared.mask) / prepared.rate, (
        "it stands for a third of the time"
    )


def test_a_wrong_twin_leaves_more(prepared: Observation, twin: Twin) -> None:
    soft = twin.with_changes(
        {f"vehicle.{a}.damper_pull.force.{i}": 150.0 + i for a in ("front", "rear") for i in range(4)}
    )
    gap = prepared.gap(prepared.condition(simulate_twin(soft, prepared.excitation)))
    assert gap.rms > 3 * gap.noise_rms


@pytest.mark.parametrize(
    "effect",
    [
        EffectSpec(id="sensor_scale", parameters={"scale": 0.15}),
        EffectSpec(id="sensor_tilt", parameters={"roll": 0.0, "pitch": 0.06, "yaw": 0.0}),
    ],
    ids=lambda e: e.id,
)
def test_a_sensor_that_is_wrong_stands_at_nothing_on_both_sides(
    twin: Twin, bumps: Road, effect: EffectSpec
) -> None:
    """The recording's filter takes what a gain or a tilt makes of gravity for a bias."""
    wrong = twin.model_copy(update={"effects": (effect,)})
    recorded = synthetic_drive(wrong, bumps, KNOTS, seed=4, errors=SensorErrors(), name="wrong")
    prepared = observe(recorded, wrong, bumps)
    right, plain = (
        prepared.gap(prepared.condition(simulate_twin(t, prepared.excitation))) for t in (wrong, twin)
    )
    assert right.rms < 2.0 * right.noise_rms < plain.rms


def test_a_part_on_the_move_keeps_its_mean(prepared: Observation, twin: Twin) -> None:
    """Nothing stands in it, so nothing of it is what the sensor shows standing."""
    t0 = float(prepared.signals.t[0])
    part = prepared.part(t0 + 7.0, t0 + 12.0)
    assert not part.signals.standing.any() and prepared.signals.standing.any()
    response = simulate_twin(twin, part.excitation)
    raised = replace(response, vertical_acceleration=response.vertical_acceleration + 0.5)
    shift = (
        part.condition(raised)["vertical_acceleration"] - part.condition(response)["vertical_acceleration"]
    )
    np.testing.assert_allclose(shift, 0.5, atol=1e-9)


def test_position_is_the_rear_axles_along_the_road(prepared: Observation, bumps: Road) -> None:
    still = prepared.t < prepared.t[0] + 2.0
    assert np.median(prepared.position[still]) == pytest.approx(5.0, abs=0.05)
    moving = np.abs(prepared.speed) > 2.0
    np.testing.assert_allclose(prepared.along[moving], prepared.speed[moving], atol=0.3)
    assert prepared.inside.all()


def test_a_part_is_simulated_and_measured_alike(prepared: Observation, twin: Twin) -> None:
    start = prepared.t[0]
    part = prepared.part(start + 5.0, start + 16.0)
    gap = part.gap(part.condition(simulate_twin(twin, part.excitation)))
    assert 10.0 < part.t[-1] - part.t[0] < 11.1
    assert gap.noise_rms == prepared.noise_rms["vertical_acceleration"]
    inside = (part.t > part.t[0] + 3.0) & part.mask  # the start from rest is forgotten by then
    difference = (
        part.measured["vertical_acceleration"]
        - part.condition(simulate_twin(twin, part.excitation))["vertical_acceleration"]
    )
    assert np.sqrt(np.mean(difference[inside] ** 2)) < 1.4 * gap.noise_rms
    with pytest.raises(InputError, match="too few"):
        prepared.part(start, start + 0.05)


def test_moving_the_pose_in_time_moves_the_response(prepared: Observation, twin: Twin) -> None:
    seconds = 0.05
    here = prepared.condition(simulate_twin(twin, prepared.excitation))["vertical_acceleration"]
    moved = prepared.moved(seconds, 0.0)
    there = moved.condition(simulate_twin(twin, moved.excitation))["vertical_acceleration"]
    shifted = np.interp(prepared.t + seconds, prepared.t, here)
    inside = slice(300, -300)
    assert np.sqrt(np.mean((there - shifted)[inside] ** 2)) < 0.03 * np.std(here[inside])
    assert np.sqrt(np.mean((here - shifted)[inside] ** 2)) > 0.3 * np.std(here[inside])


def test_moving_the_map_moves_the_bump(prepared: Observation) -> None:
    moved = prepared.moved(0.0, 0.5)
    here, there = (p.excitation.road[:, 0].max() > 0.03 for p in (prepared, moved))
    assert here and there
    when = [
        p.excitation.t[np.searchsorted(p.excitation.first, int(np.argmax(p.excitation.road[:, 0] > 0.02)))]
        for p in (prepared, moved)
    ]
    assert when[0] - when[1] == pytest.approx(0.5 / 5.3, abs=0.03)  # the vehicle is taken to be farther on


def test_no_fixes_are_said_where_no_bump_is_felt(drive: Drive, twin: Twin, bumps: Road) -> None:
    level = replace(bumps, z=np.zeros_like(bumps.z))
    with pytest.raises(InputError, match="bumps: no positions, and no pass over a bump"):
        observe(without_fixes(drive), twin, level)


def test_an_imu_upside_down_is_refused_only_where_it_must_be_trusted(
    drive: Drive, twin: Twin, bumps: Road
) -> None:
    flip = np.array([1.0, -1.0, -1.0])
    imu = ImuData(drive.imu.t, drive.imu.specific_force * flip, drive.imu.angular_rate * flip)
    turned = replace(drive, imu=imu)
    with pytest.raises(InputError, match="upside down"):
        observe(turned, twin, bumps, strict=True)
    assert any("upside down" in w for w in observe(turned, twin, bumps).warnings)


def test_a_twin_without_road_is_told_to_name_one(drive: Drive, twin: Twin) -> None:
    with pytest.raises(InputError, match="road"):
        observe(drive, twin)


def test_gap_refuses_what_is_no_comparison() -> None:
    zero = {c: np.zeros(10) for c in CHANNELS}
    with pytest.raises(WorkError, match="nothing to compare"):
        measure_gap(zero, zero, np.zeros(10, dtype=bool), 100.0, 0.1)
    broken = {c: np.full(10, np.nan) for c in CHANNELS}
    with pytest.raises(WorkError, match="not a number"):
        measure_gap(zero, broken, np.ones(10, dtype=bool), 100.0, 0.1)
    one = {c: np.ones(10) for c in CHANNELS}
    gap = measure_gap(one, zero, np.ones(10, dtype=bool), 100.0, 0.1)
    assert gap.as_dict()["channels"]["yaw_rate"] == 1.0 and gap.seconds == 0.1


# -- noise -----------------------------------------------------------------------------------------


def test_white_noise_is_seen_through_motion() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(0, 60, 0.01)
    wave = 3.0 * np.sin(2 * np.pi * 1.5 * t) + 0.5 * np.sin(2 * np.pi * 9 * t)
    for sigma in (0.02, 0.2):
        assert white_noise_sigma(wave + sigma * rng.standard_normal(t.size), 100.0) == pytest.approx(
            sigma, rel=0.12
        )


def test_the_floor_is_what_the_filter_leaves_of_the_noise() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0, 60, 0.01)
    noise = 0.1 * rng.standard_normal(t.size)
    path = Conditioner.for_stamps(t, FilterSpec())
    true = float(np.std(path.apply(noise)[path.valid]))
    nowhere = np.zeros(t.size, dtype=bool)
    moving = noise + np.where(t > 20, np.sin(2 * np.pi * 1.5 * t), 0.0)
    assert floor_rms(moving, path, nowhere) == pytest.approx(true, rel=0.1)
    assert floor_rms(moving + 5.0, path, t < 19.0) == pytest.approx(true, rel=0.1)


def test_wiener_keeps_lines_and_what_stands_out_and_drops_noise() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(0, 40, 0.01)
    density = 0.05**2 / 50.0

    def noise(f: np.ndarray) -> np.ndarray:
        return np.full_like(f, density)

    line = 2.0 + 0.1 * t
    np.testing.assert_allclose(wiener(line, 100.0, noise), line, atol=1e-9)
    left = wiener(line + 0.05 * rng.standard_normal(t.size), 100.0, noise) - line
    assert np.std(left) < 0.15 * 0.05
    braking = np.where((t > 15) & (t < 18), 3.0 * np.sin(np.pi * (t - 15) / 3) ** 2, 0.0)
    kept = wiener(braking + 0.05 * rng.standard_normal(t.size), 100.0, noise)
    assert np.sqrt(np.mean((kept - braking) ** 2)) < 0.02
    untouched = wiener(braking, 100.0, lambda f: np.zeros_like(f))
    np.testing.assert_allclose(untouched, braking, atol=1e-9)


def test_quiet_motion_is_nearer_to_the_truth(twin: Twin, bumps: Road) -> None:
    knots = [(0.0, 0.0), (3.0, 0.0), (6.0, 5.0), (14.0, 6.0), (16.0, 0.0), (19.5, 0.0)]
    noisy = synthetic_drive(twin, bumps, knots, seed=3, errors=SensorErrors(force=0.08, rate=0.005))
    read = observe(noisy, twin, bumps)
    datum = origin_of(twin, noisy)
    noisy_path = locked_trajectory(noisy, read.signals, twin.gps, datum, read.signals.t)
    error = {}
    for quiet, there in ((False, noisy_path), (True, read.trajectory)):
        true = path_along(bumps, there.t - 1_700_000_000.0, knots, 5.0)
        driving = true.speed > 4.0
        error[quiet] = [
            float(np.sqrt(np.mean((is_there - is_true)[driving] ** 2)))
            for is_there, is_true in (
                (there.acceleration[:, 0], true.acceleration[:, 0]),
                (there.yaw_rate, true.yaw_rate),
            )
        ]
    assert error[True][0] < 0.5 * error[False][0]
    assert error[True][1] < 0.5 * error[False][1]
