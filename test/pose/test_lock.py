# SPDX-License-Identifier: Apache-2.0
"""The live lock on known paths: close, smooth, and unmoved by everything that messages do."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.pose.lock import PlanarState, PoseLock
from suspension_twin.pose.types import PoseSettings
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.signals.clock import MAX_STAMP
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.signals.ingest import ImuIngest
from suspension_twin.vehicle.twin import Datum

Maker = Callable[..., object]
Profile = Callable[[np.ndarray], np.ndarray]
Away = Callable[..., Profile]
UNDELAYED = PoseSettings(imu_delay=0.0)


def make_lock(scene: object, settings: PoseSettings = UNDELAYED) -> PoseLock:
    """A lock with the scene's places; what feeds it has not been through a low-pass."""
    return PoseLock(settings, scene.gps, scene.datum, scene.imu)


def feed(
    lock: PoseLock,
    scene: object,
    *,
    delay: float = 0.0,
    skip_fix: Callable[[float], bool] = lambda s: False,
    skip_imu: Callable[[float], bool] = lambda s: False,
    spoil: Callable[[float, float], float] = lambda s, latitude: latitude,
) -> list[PlanarState]:
    """All messages in the order they arrive, GPS ``delay`` s after its stamps; ``s`` counts from the start."""
    drive, start = scene.drive, scene.truth.t[0]
    events: list[tuple[float, int, int]] = [
        (t, 2, i) for i, t in enumerate(drive.imu.t) if not skip_imu(t - start)
    ]
    events += [(t + delay, 0, i) for i, t in enumerate(drive.fix.t) if not skip_fix(t - start)]
    events += [(t + delay, 1, i) for i, t in enumerate(drive.velocity.t) if not skip_fix(t - start)]
    if drive.heading is not None:
        events += [(t + delay, 3, i) for i, t in enumerate(drive.heading.t)]
    out = []
    for when, kind, i in sorted(events):
        if when > drive.imu.t[-1]:
            break
        if kind == 0:
            f = drive.fix
            latitude = spoil(f.t[i] - start, f.latitude[i])
            lock.on_fix(f.t[i], latitude, f.longitude[i], f.altitude[i], int(f.status[i]), *f.sigma[i, :2])
        elif kind == 1:
            lock.on_velocity(drive.velocity.t[i], *drive.velocity.enu[i, :2])
        elif kind == 3:
            lock.on_heading(drive.heading.t[i], drive.heading.yaw[i])
        else:
            state = lock.on_imu(drive.imu.t[i], drive.imu.specific_force[i], drive.imu.angular_rate[i])
            if state is not None:
                out.append(state)
    return out


def off(
    states: Sequence[PlanarState], scene: object, since: float = 0.0, until: float = 1e9
) -> dict[str, np.ndarray]:
    """What is off against the truth, sample by sample, of the valid states between two times."""
    truth, start = scene.truth, scene.truth.t[0]
    kept = [s for s in states if s.valid and since <= s.t - start <= until]
    at = np.array([(*s[:4], *s.motion) for s in kept]).T
    k = np.searchsorted(truth.t, at[0] - 1e-6)
    dx, dy = at[1] - truth.x[k], at[2] - truth.y[k]
    c, s = np.cos(truth.yaw[k]), np.sin(truth.yaw[k])
    return {
        "along": dx * c + dy * s,
        "across": dy * c - dx * s,
        "yaw": np.remainder(at[3] - truth.yaw[k] + np.pi, 2 * np.pi) - np.pi,
        "speed": at[4] - truth.speed[k],
        "yaw_rate": at[6] - truth.yaw_rate[k],
        "ax": at[7] - truth.acceleration[k, 0],
    }


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def swinging(amplitude: float, period: float) -> Profile:
    """A turn rate that swings from second 6 on."""
    return lambda s: amplitude * np.sin(2 * np.pi * np.maximum(s - 6, 0) / period)


BENDS: dict[str, dict[str, Callable[[np.ndarray], np.ndarray]]] = {
    "left": {"speed": lambda s: 9.0 + 0 * s, "turn": lambda s: 0.4 + 0 * s},
    "right": {"speed": lambda s: 6.0 + 0 * s, "turn": lambda s: -0.5 + 0 * s},
    "brakes": {"speed": lambda s: 2.0 + 13.0 * np.exp(-s / 4.0), "turn": lambda s: 0.1 * np.sin(s)},
    "speeds up": {"speed": lambda s: 12.0 - 9.0 * np.exp(-s / 3.0), "turn": lambda s: 0.2 + 0 * s},
}


@pytest.mark.parametrize("how", BENDS)
@pytest.mark.parametrize("velocities", [True, False], ids=["velocities", "fixes alone"])
def test_a_lock_that_starts_while_the_vehicle_brakes_or_turns(
    make_scene: Maker, how: str, velocities: bool
) -> None:
    scene = make_scene(**BENDS[how], velocity_sigma=0.03 if velocities else None)
    lock = make_lock(scene)
    states = feed(lock, scene)
    error = off(states, scene, since=4.0)
    assert np.hypot(error["along"], error["across"]).max() < 0.15
    assert np.abs(error["yaw"]).max() < 0.06
    assert np.abs(error["speed"]).max() < 0.3
    assert lock.counts["relocated"] == lock.counts["turned_round"] == 0
    assert lock.counts["refused"] <= 2


@pytest.mark.parametrize("heading", [True, False], ids=["heading", "course"])
def test_the_first_yaw_in_a_bend_is_the_vehicles(make_scene: Maker, heading: bool) -> None:
    """The antenna 0.8 m ahead of the rear axle has a course of its own, by 0.07 rad; a heading has none."""
    scene = make_scene(**BENDS["right"], seconds=8.0)
    lock = make_lock(scene)
    if heading:
        lock.on_heading(scene.truth.t[49], scene.truth.yaw[49])
    first = [s for s in feed(lock, scene, skip_fix=lambda s: s < 0.5) if s.valid][:10]
    assert np.abs(off(first, scene)["yaw"]).max() < 0.02


@pytest.mark.parametrize("how", [*BENDS, "from rest"])
def test_velocities_of_a_phone_are_worth_what_they_are(make_scene: Maker, away: Away, how: str) -> None:
    """1 Hz, 2.5 m and 0.3 m/s, which nothing says; a phone that rattles, so that no standstill is seen."""
    course = BENDS[how] if how in BENDS else {"speed": away(top=12.0), "turn": swinging(0.2, 9.0)}
    phone = {"fix_rate": 1.0, "sigma": 2.5, "velocity_sigma": 0.3, "tell_sigma": False, "noise": 0.3}
    errors = []
    for seed in range(3):
        scene = make_scene(**course, **phone, seed=seed)
        errors.append(off(feed(make_lock(scene), scene), scene, since=15.0))
    places = np.concatenate([np.hypot(e["along"], e["across"]) for e in errors])
    assert rms(places) < 2.5
    assert rms(np.concatenate([e["speed"] for e in errors])) < 0.5


def test_a_pause_of_the_imu_in_a_bend(make_scene: Maker) -> None:
    """Five seconds without samples, longer than the gyro carries the vertical: the speed is there again within a
    second, and the place drifts over as slowly as it may."""
    scene = make_scene(**BENDS["left"])
    states = feed(make_lock(scene), scene, skip_imu=lambda s: 15.0 < s < 20.0)
    assert np.abs(off(states, scene, since=21.0)["speed"]).max() < 0.3
    error = off(states, scene, since=30.0)
    assert np.hypot(error["along"], error["across"]).max() < 0.05


def test_fixes_of_ten_centimetres_in_a_bend_are_followed_while_the_vertical_is_not_yet_known(
    make_scene: Maker,
) -> None:
    scene = make_scene(**BENDS["left"], velocity_sigma=None, sigma=0.1)
    states = feed(make_lock(scene), scene)
    error = off(states, scene, since=2.0)
    assert np.hypot(error["along"], error["across"]).max() < 1.0
    late = off(states, scene, since=15.0)
    assert np.hypot(late["along"], late["across"]).max() < 0.4


@pytest.mark.parametrize("delay", [0.0, 0.15, 0.4])
@pytest.mark.parametrize("turn", [np.zeros_like, lambda s: 0.25 * np.clip(s - 6, 0, 1), swinging(0.3, 7.0)])
def test_close_and_without_steps_whether_fixes_come_at_once_or_late(
    make_scene: Maker, away: Away, turn: Profile, delay: float
) -> None:
    scene = make_scene(speed=away(), turn=turn)
    lock = make_lock(scene)
    states = feed(lock, scene, delay=delay)
    error = off(states, scene, since=10.0)
    # Ahead of the last fix the pose runs on speed and yaw alone.
    assert rms(error["along"]) < 0.02 + 0.08 * delay
    assert rms(error["across"]) < 0.02 + 0.08 * delay
    assert rms(error["yaw"]) < 0.006
    assert rms(error["speed"]) < 0.06
    assert lock.latency == pytest.approx(delay, abs=0.012)
    assert lock.counts["refused"] == 0
    # From sample to sample the pose moves as speed and yaw say: a fix makes no step.
    rows = np.array([(*s[:4], *s.motion[:2]) for s in states if s.valid])
    step = np.hypot(np.diff(rows[:, 1]), np.diff(rows[:, 2])) - np.abs(rows[1:, 4]) * np.diff(rows[:, 0])
    assert np.abs(step[1:]).max() < 0.004
    assert np.abs(np.diff(rows[:, 3]) / np.diff(rows[:, 0])).max() < 0.6


@pytest.mark.parametrize(
    ("fix_rate", "velocity", "limit"),
    [(1.0, 0.03, 0.08), (5.0, 0.03, 0.03), (20.0, 0.03, 0.02), (5.0, None, 0.06)],
)
def test_other_receivers(
    make_scene: Maker, away: Away, fix_rate: float, velocity: float | None, limit: float
) -> None:
    scene = make_scene(speed=away(), turn=swinging(0.2, 9.0), fix_rate=fix_rate, velocity_sigma=velocity)
    error = off(feed(make_lock(scene), scene), scene, since=12.0)
    assert rms(error["along"]) < limit
    assert rms(error["across"]) < limit


def test_phone_grade_gps_stays_smooth(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), turn=swinging(0.2, 9.0), fix_rate=1.0, sigma=3.0, velocity_sigma=0.1)
    states = feed(make_lock(scene), scene, delay=0.2)
    error = off(states, scene, since=12.0)
    assert rms(np.hypot(error["along"], error["across"])) < 3.0
    rows = np.array([(*s[:4], *s.motion[:2]) for s in states if s.valid])
    step = np.hypot(np.diff(rows[:, 1]), np.diff(rows[:, 2])) - np.abs(rows[1:, 4]) * np.diff(rows[:, 0])
    assert np.abs(step[1:]).max() < 0.01


@pytest.mark.parametrize("rate", [50.0, 1000.0])
def test_at_every_rate_of_the_imu_there_is_a_pose_for_every_sample(
    make_scene: Maker, away: Away, rate: float
) -> None:
    scene = make_scene(speed=away(), seconds=20.0, rate=rate)
    states = feed(make_lock(scene), scene, delay=0.1)
    assert len(states) >= len(scene.drive.imu) - 0.11 * rate
    assert rms(off(states, scene, since=10.0)["along"]) < 0.03


def test_behind_the_low_pass_of_the_imu_node(make_scene: Maker, away: Away) -> None:
    """As the nodes have it: ImuIngest in front, its delay made up for."""
    biases = {"force_bias": (0.1, -0.1, 0.1), "rate_bias": (0.003, 0.003, 0.003)}
    scene = make_scene(
        speed=away(top=5.0), turn=swinging(0.5, 2.0), sigma=0.003, velocity_sigma=0.003, **biases
    )
    ingest = ImuIngest(ImuSettings(), scene.imu)
    found = {}
    for settings_ in (PoseSettings(), UNDELAYED):
        lock = make_lock(scene, settings_)
        ingest.reset()
        imu, states, k = scene.drive.imu, [], 0
        for i, t in enumerate(imu.t):
            while k < len(scene.drive.fix) and scene.drive.fix.t[k] <= t:
                f = scene.drive.fix
                lock.on_fix(f.t[k], f.latitude[k], f.longitude[k], f.altitude[k], 2, *f.sigma[k, :2])
                lock.on_velocity(scene.drive.velocity.t[k], *scene.drive.velocity.enu[k, :2])
                k += 1
            sample = ingest.push(t, imu.specific_force[i], imu.angular_rate[i])
            state = sample and lock.on_imu(sample.t, sample.force, sample.rate)
            if state:
                states.append(state)
        found[settings_.imu_delay] = off(states, scene, since=8.0)
    late, prompt = found[0.0], found[PoseSettings().imu_delay]
    assert rms(prompt["along"]) < 0.03
    assert rms(prompt["yaw"]) < 0.006
    assert rms(prompt["yaw"]) < 0.7 * rms(late["yaw"])


def stop_and_wait(s: np.ndarray) -> np.ndarray:
    """To 5 m/s and back to rest within ten seconds, then a long wait."""
    return 5.0 * np.sin(np.pi * np.clip((s - 3) / 10, 0, 1)) ** 2


def test_a_sensor_that_is_known_to_be_turned_says_what_an_upright_one_says(make_scene: Maker) -> None:
    scene = make_scene(
        speed=lambda s: 6.0 + 4.0 * np.sin(0.5 * s) * np.clip(s - 5, 0, 1), turn=swinging(0.3, 7.0)
    )
    rpy = (-0.09, 0.07, 0.3)
    there = rpy_matrix(rpy)  # from what the turned sensor reads to what an upright one does
    upright = feed(make_lock(scene), scene)
    imu = scene.drive.imu
    own = replace(imu, specific_force=imu.specific_force @ there, angular_rate=imu.angular_rate @ there)
    scene = replace(scene, drive=replace(scene.drive, imu=own))
    turned = feed(PoseLock(UNDELAYED, scene.gps, scene.datum, scene.imu, rpy), scene)
    unknown = feed(make_lock(scene), scene)
    assert np.allclose(
        [(*s[:4], *s.motion) for s in turned], [(*s[:4], *s.motion) for s in upright], rtol=0, atol=1e-6
    )
    assert rms(off(unknown, scene, 8.0)["ax"]) > 2.0 * rms(off(turned, scene, 8.0)["ax"])


def test_a_sensor_that_is_known_to_read_too_much_says_what_a_sound_one_says(make_scene: Maker) -> None:
    scene = make_scene(
        speed=lambda s: 6.0 + 4.0 * np.sin(0.5 * s) * np.clip(s - 5, 0, 1), turn=swinging(0.3, 7.0)
    )
    sound = feed(make_lock(scene), scene)
    imu = scene.drive.imu
    # as the filter hands it on: what it reads too much at rest has gone with the bias
    loud = replace(imu, specific_force=imu.specific_force * np.array([1.3, 1.3, 1.0]))
    scene = replace(scene, drive=replace(scene.drive, imu=loud))
    known = feed(PoseLock(UNDELAYED, scene.gps, scene.datum, scene.imu, imu_gain=1.3), scene)
    unknown = feed(make_lock(scene), scene)
    assert np.allclose(
        [(*s[:4], *s.motion) for s in known], [(*s[:4], *s.motion) for s in sound], rtol=0, atol=1e-6
    )
    assert rms(off(unknown, scene, 8.0)["speed"]) > 2.0 * rms(off(known, scene, 8.0)["speed"])


def test_standing_the_yaw_does_not_wander(make_scene: Maker) -> None:
    def turn(s: np.ndarray) -> np.ndarray:
        return 0.1 * np.sin(2 * np.pi * np.clip(s - 3, 0, 10) / 5)

    scene = make_scene(speed=stop_and_wait, turn=turn, seconds=90.0, rate_bias=(0.0, 0.0, 0.004))
    lock = make_lock(scene)
    states = feed(lock, scene, skip_fix=lambda s: 40 < s < 60)
    assert lock.standing
    waits = [s for s in states if s.t - scene.truth.t[0] > 17]
    assert np.ptp([s.yaw for s in waits]) < 1e-3
    assert max(abs(s.motion.speed) for s in waits) < 0.01
    assert all(s.motion.yaw_rate == 0.0 for s in waits)
    assert np.hypot(np.ptp([s.x for s in waits]), np.ptp([s.y for s in waits])) < 0.04
    assert rms(off(states, scene, since=65.0)["yaw"]) < 0.01


def test_outliers_are_refused(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), turn=swinging(0.2, 9.0))
    lock = make_lock(scene)

    def spoil(s: float, latitude: float) -> float:
        return latitude + (3.0 / 111_000 if round(s * 10) % 17 == 0 and s > 8 else 0.0)

    error = off(feed(lock, scene, spoil=spoil), scene, since=10.0)
    assert lock.counts["refused"] >= 15
    assert lock.counts["relocated"] == 0
    assert np.abs(error["across"]).max() < 0.08
    assert rms(error["along"]) < 0.03
    assert any(f.code == "outliers" for f in lock.findings)


def test_a_true_jump_is_followed_within_two_seconds(make_scene: Maker, away: Away) -> None:
    """The receiver finds its integers: everything after lies half a metre to the north."""
    scene = make_scene(speed=away())
    lock = make_lock(scene)
    states = feed(lock, scene, spoil=lambda s, latitude: latitude + (0.5 / 111_200 if s > 20 else 0.0))
    assert lock.counts["relocated"] == 1
    truth = scene.truth
    after = [s for s in states if s.t - truth.t[0] > 24]
    k = np.searchsorted(truth.t, [s.t - 1e-6 for s in after])
    assert np.mean([s.y for s in after] - truth.y[k]) == pytest.approx(0.5, abs=0.03)
    rows = np.array([(*s[:4], *s.motion[:2]) for s in states if s.valid])
    step = np.hypot(np.diff(rows[:, 1]), np.diff(rows[:, 2])) - np.abs(rows[1:, 4]) * np.diff(rows[:, 0])
    assert np.abs(step[1:]).max() < 0.01  # bled in, at half a metre per second at most


def test_an_outage_drifts_little_is_marked_and_ends(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), turn=swinging(0.2, 9.0), rate_bias=(0.0, 0.0, 0.001))
    lock = make_lock(scene)
    states = feed(lock, scene, skip_fix=lambda s: 20 < s < 28)
    start = scene.truth.t[0]
    lost = [s for s in states if 22.6 < s.t - start < 28]
    assert lost
    assert not any(s.valid for s in lost)
    marked = off([s._replace(valid=True) for s in lost], scene)
    assert np.abs(marked["along"]).max() < 2.0  # eight seconds at ten metres per second
    deviation = math.sqrt(lost[-1].covariance[0] + lost[-1].covariance[3])
    assert math.hypot(marked["along"][-1], marked["across"][-1]) < 4 * deviation
    error = off(states, scene, since=31.0)
    assert rms(error["along"]) < 0.03
    assert lock.counts["relocated"] == 0


@pytest.mark.parametrize("how", ["status", "nan", "sigma"])
def test_useless_fixes_are_no_fixes(make_scene: Maker, away: Away, how: str) -> None:
    scene = make_scene(speed=away(), seconds=20.0)
    fix = scene.drive.fix
    gone = fix.t > fix.t[0] + 15
    changes = {
        "status": {"status": np.where(gone, -1, fix.status).astype(np.int8)},
        "nan": {"latitude": np.where(gone, np.nan, fix.latitude)},
        "sigma": {"sigma": np.where(gone[:, None], 500.0, fix.sigma)},
    }[how]
    lock = make_lock(scene)
    states = feed(lock, replace(scene, drive=replace(scene.drive, fix=replace(fix, **changes))))
    assert not states[-1].valid
    assert lock.counts["unusable"] == gone.sum()
    assert [f.code for f in lock.findings] == ["fix_lost"]


def test_reversing_out_is_seen_by_the_pull(make_scene: Maker) -> None:
    def speed(s: np.ndarray) -> np.ndarray:
        back = -2.5 * np.sin(np.pi * np.clip((s - 3) / 8, 0, 1)) ** 2
        return back + 8.0 * 0.5 * (1 - np.cos(np.pi * np.clip((s - 13) / 6, 0, 1)))

    scene = make_scene(speed=speed, turn=swinging(0.1, 8.0))
    lock = make_lock(scene)
    states = feed(lock, scene)
    error = off(states, scene)
    assert np.abs(error["yaw"]).max() < 0.15
    assert rms(off(states, scene, since=15.0)["yaw"]) < 0.01
    assert min(s.motion.speed for s in states) == pytest.approx(-2.5, abs=0.1)
    assert lock.counts["turned_round"] == 0


def test_aligned_the_wrong_way_round_it_turns(make_scene: Maker, away: Away) -> None:
    """A heading that is off by half a turn, and then no more: nothing reverses at 10 m/s for long."""
    scene = make_scene(speed=away())
    lock = make_lock(scene)
    lock.on_heading(scene.truth.t[0] + 0.005, scene.truth.yaw[0] + math.pi)
    states = feed(lock, scene)
    assert lock.counts["turned_round"] == 1
    assert rms(off(states, scene, since=20.0)["yaw"]) < 0.01


def test_a_heading_aligns_at_rest(make_scene: Maker) -> None:
    scene = make_scene(speed=np.zeros_like, heading=True, seconds=15.0)
    lock = make_lock(scene)
    states = feed(lock, scene)
    assert lock.aligned
    error = off(states, scene, since=5.0)
    assert rms(error["yaw"]) < 0.02
    assert rms(error["along"]) < 0.02


def test_before_the_yaw_is_known_there_is_a_place_but_no_claim(make_scene: Maker) -> None:
    scene = make_scene(speed=np.zeros_like, seconds=5.0)
    lock = make_lock(scene)
    states = feed(lock, scene)
    assert states
    assert not any(s.valid for s in states)
    assert states[-1].covariance[5] == pytest.approx(math.pi**2)
    assert [f.code for f in lock.findings] == ["not_aligned"]
    assert math.hypot(states[-1].x - scene.truth.x[0], states[-1].y - scene.truth.y[0]) < 1.0


def test_a_looped_bag_starts_anew(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), seconds=15.0)
    lock = make_lock(scene)
    first = feed(lock, scene)
    again = feed(lock, scene)
    assert lock.counts["resets"] == 1
    # The first velocity of the second loop arrives before the reset, so that its vertical rests on one less.
    poses = [np.array([s[:4] for s in states[-500:]]) for states in (again, first)]
    assert np.array_equal(poses[0][:, 0], poses[1][:, 0])
    assert np.abs(poses[0] - poses[1]).max() < 1e-3


def test_without_a_datum_the_first_fix_is_the_origin_and_it_can_be_set(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), seconds=12.0)
    lock = PoseLock(UNDELAYED, scene.gps, None, scene.imu)
    assert lock.datum is None
    feed(lock, scene)
    assert lock.datum is not None
    assert lock.datum.latitude == scene.drive.fix.latitude[0]
    lock.set_datum(Datum(latitude=10.0, longitude=20.0))
    assert not lock.aligned
    assert lock.datum == Datum(latitude=10.0, longitude=20.0)


def test_far_from_the_datum_nothing_is_lost(make_scene: Maker, away: Away) -> None:
    near = make_scene(speed=away(), seconds=20.0)
    far = make_scene(speed=away(), seconds=20.0, place=(60_000.0, -80_000.0))
    a, b = (feed(make_lock(scene), scene)[-1] for scene in (near, far))
    assert b.x - 60_000.0 == pytest.approx(a.x, abs=2e-3)
    assert b.yaw == pytest.approx(a.yaw, abs=1e-5)


def test_fixes_too_late_and_from_the_future_are_counted(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away(), seconds=12.0)
    lock = make_lock(scene)
    feed(lock, scene)
    f, now = scene.drive.fix, scene.truth.t[-1]
    lock.on_fix(now - 5.0, f.latitude[0], f.longitude[0], 0.0, 2, 0.01, 0.01)
    lock.on_fix(now + 60.0, f.latitude[0], f.longitude[0], 0.0, 2, 0.01, 0.01)
    assert lock.counts["too_late"] == 1
    assert lock.counts["from_the_future"] == 1
    assert {"too_late", "from_the_future"} <= {f.code for f in lock.findings}


def test_gaps_late_and_repeated_imu_messages(make_scene: Maker, away: Away) -> None:
    scene = make_scene(speed=away())
    imu = scene.drive.imu
    keep = np.r_[0:2000, 2120:3000, 2995, 2999, 3000 : len(imu)]
    drive = replace(
        scene.drive,
        imu=replace(
            imu, t=imu.t[keep], specific_force=imu.specific_force[keep], angular_rate=imu.angular_rate[keep]
        ),
    )
    lock = make_lock(scene)
    events = sorted([(t, 1, i) for i, t in enumerate(drive.fix.t)] + [(t, 0, i) for i, t in enumerate(imu.t)])
    order = {t: [] for t in imu.t}
    for position, t in enumerate(drive.imu.t):
        order[t].append(position)
    states = []
    for _, kind, i in events:
        if kind == 1:
            f = drive.fix
            lock.on_fix(f.t[i], f.latitude[i], f.longitude[i], f.altitude[i], 2, 0.015, 0.015)
            lock.on_velocity(drive.velocity.t[i], *drive.velocity.enu[i, :2])
        else:
            for k in order[imu.t[i]]:
                s = lock.on_imu(drive.imu.t[k], drive.imu.specific_force[k], drive.imu.angular_rate[k])
                states += [s] if s else []
    assert lock.counts["gaps"] == 2  # the first sample counts as after one
    assert lock.counts["late"] == 2
    assert rms(off(states, scene, since=23.0)["along"]) < 0.05


def test_a_stamp_beyond_what_ros_can_hold_is_invalid(make_scene: Maker, away: Away) -> None:
    lock = make_lock(make_scene(speed=away()))
    for number, t in enumerate((MAX_STAMP, -MAX_STAMP, np.inf, np.nan), start=1):
        assert lock.on_imu(t, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)) is None
        assert lock.counts["invalid"] == number


NUMBER = st.one_of(st.floats(), st.floats(-20, 20), st.floats(1.7e9, 1.7e9 + 20))


@given(st.lists(st.tuples(st.integers(0, 3), st.lists(NUMBER, min_size=7, max_size=7)), max_size=30))
@settings(max_examples=100, deadline=None)
def test_no_message_makes_it_raise_or_hand_on_a_nan(messages: list[tuple[int, list[float]]]) -> None:
    lock = PoseLock(PoseSettings())
    t = 1.7e9
    for k in range(60):
        t += 0.01
        lock.on_imu(t, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0))
        if k % 10 == 0:
            lock.on_fix(t, 47.0 + 1e-6 * k, 19.0, 0.0)
            lock.on_velocity(t, 0.0, 2.0)
    for kind, n in messages:
        if kind == 0:
            state = lock.on_imu(n[0], n[1:4], n[4:7])
            if state is not None:
                pose = (state.t, state.x, state.y, state.yaw)
                assert all(map(math.isfinite, (*pose, *state.motion, *state.covariance)))
        elif kind == 1:
            lock.on_fix(n[0], n[1], n[2], n[3], 0, n[4], n[5])
        elif kind == 2:
            lock.on_velocity(n[0], n[1], n[2])
        else:
            lock.on_heading(n[0], n[1])
    assert all("\n" not in f.text for f in lock.findings)
