# SPDX-License-Identifier: Apache-2.0
"""What the live path knows at each moment: its first output, what it fills in, when it says the vehicle stands."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.drive.types import Drive
from suspension_twin.signals.checks import FULL_SCALES
from suspension_twin.signals.filters import CausalLowPass, FilterSpec
from suspension_twin.signals.imu import ImuSettings, StillLimits
from suspension_twin.signals.ingest import ImuIngest, IngestOutput
from suspension_twin.units import STANDARD_GRAVITY
from suspension_twin.vehicle.twin import Place

Maker = Callable[..., tuple[Drive, Any]]
T0 = 1.7e9
WARMUP = 17  # samples until the rate is known
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def push(
    ingest: ImuIngest, s: np.ndarray, force: np.ndarray, rate: np.ndarray | None = None
) -> list[IngestOutput | None]:
    """Every row; without ``rate`` the gyro shows nothing."""
    rate = np.zeros((s.size, 3)) if rate is None else rate
    return [ingest.push(T0 + t, f, w) for t, f, w in zip(s, force, rate, strict=True)]


def codes(ingest: ImuIngest) -> dict[str, str]:
    """Findings as code: level."""
    return {f.code: f.level for f in ingest.findings}


def shaking(n: int, seed: int = 0, rate: float = 100.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, forces and rates of a drive on cobbles that never stands."""
    random = np.random.default_rng(seed)
    return np.arange(n) / rate, UP + random.normal(0.0, 1.0, (n, 3)), random.normal(0.0, 0.1, (n, 3))


def column(outs: Iterable[IngestOutput | None], name: str) -> np.ndarray:
    """One of its fields, as an array, of what came out."""
    return np.array([getattr(out, name) for out in outs if out is not None])


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.1, -0.2, 2.0)])
def test_the_first_output_has_the_past_of_all_samples_before(rpy: tuple[float, float, float]) -> None:
    """None was lost while the rate was not known: sample by sample the low-pass of what the sensor saw, turned."""
    s, force, rate = shaking(60)
    mounted = Rotation.from_euler("xyz", rpy)
    ingest = ImuIngest(ImuSettings(), Place(rpy=rpy))
    outs = push(ingest, s, mounted.inv().apply(force), mounted.inv().apply(rate))
    assert outs[: WARMUP - 1] == [None] * (WARMUP - 1)
    assert all(outs[WARMUP - 1 :])
    spec = ImuSettings().filter
    for name, channel in (("force", force), ("rate", rate)):
        expected = CausalLowPass(spec, 100.0, 3).process(channel)[WARMUP - 1 :]
        np.testing.assert_allclose(column(outs, name), expected, rtol=0, atol=1e-4)
        np.testing.assert_allclose(column(outs, f"raw_{name}"), channel[WARMUP - 1 :], rtol=0, atol=1e-9)
    np.testing.assert_allclose(column(outs, "t"), T0 + s[WARMUP - 1 :], rtol=1e-6, atol=1e-12)
    assert ingest.counts["samples"] == 60
    # nothing is put in twice: what comes out vertically is the low-pass of force less gravity along up
    raw, up = column(outs, "raw_force"), column(outs, "up")
    vertical = raw[:, 2] - STANDARD_GRAVITY * up[:, 2]
    assert np.linalg.norm(up, axis=1) == pytest.approx(1.0)
    assert np.std(vertical) > 0.5


def test_accelerations_go_through_the_low_pass_of_the_force() -> None:
    """Linear: force less gravity along up; angular: the change of the filtered rate, none after a pause."""
    s, force, rate = shaking(400)
    s = np.where(np.arange(400) < 300, s, s + 3.0)
    outs = [out for out in push(ImuIngest(ImuSettings(), Place()), s, force, rate) if out is not None]
    t, turning = column(outs, "t"), column(outs, "rate")
    pause = int(np.argmax(np.diff(t))) + 1
    expected = np.diff(turning, axis=0) / np.diff(t)[:, None]
    expected[pause - 1] = 0.0
    np.testing.assert_allclose(column(outs, "angular_acceleration")[1:], expected, rtol=1e-6, atol=1e-6)
    free = column(outs, "raw_force") - STANDARD_GRAVITY * column(outs, "up")
    low_pass = CausalLowPass(ImuSettings().filter, 100.0, 3)
    wanted, linear = low_pass.process(free[:pause]), column(outs, "acceleration")[:pause]
    np.testing.assert_allclose(linear[50:], wanted[50:], rtol=0, atol=5e-3)
    assert [out.vertical_acceleration for out in outs] == [out.acceleration[2] for out in outs]


def test_up_is_where_the_body_has_it(make_drive: Maker) -> None:
    drive, truth = make_drive(seconds=8.0, pull=0.0, noise=0.0, rate_noise=0.0)
    imu = drive.imu
    outs = push(ImuIngest(ImuSettings(), Place()), imu.t - T0, imu.specific_force, imu.angular_rate)
    found, true = column(outs, "up"), truth.up[WARMUP - 1 :]
    assert np.abs(found - true).max() < 0.012
    for k in range(2):
        assert np.std(found[:, k] - true[:, k]) < 0.3 * np.std(true[:, k])


@pytest.mark.parametrize("lost", [1, 2])
def test_a_lost_sample_is_taken_to_lie_on_the_line_between(lost: int) -> None:
    s, force, rate = shaking(120)
    gone = np.arange(80, 80 + lost)
    kept = np.delete(np.arange(120), gone)
    ingest = ImuIngest(ImuSettings(), Place())
    outs = push(ingest, s[kept], force[kept], rate[kept])
    assert ingest.counts["missing"] == lost
    assert ingest.counts["gaps"] == 0
    for name, channel in (("force", force), ("rate", rate)):
        line = channel.copy()
        for k in range(3):
            line[gone, k] = np.interp(s[gone], s[kept], channel[kept, k])
        expected = CausalLowPass(ImuSettings().filter, 100.0, 3).process(line)[kept][WARMUP - 1 :]
        np.testing.assert_allclose(column(outs, name), expected, rtol=0, atol=1e-4)


def test_after_a_pause_the_filter_starts_where_the_signal_is() -> None:
    s, force, rate = shaking(120)
    s = s + 0.8 * (np.arange(120) >= 70)
    outs = push(ImuIngest(ImuSettings(), Place()), s, force, rate)
    expected = CausalLowPass(ImuSettings().filter, 100.0, 3).process(force[70:])
    np.testing.assert_allclose(column(outs, "force")[70 - WARMUP + 1 :], expected, rtol=0, atol=1e-4)


def test_standing_is_said_after_two_windows_and_ends_with_one() -> None:
    """Half a second each, of which the filter hears; after a pause they are counted anew."""
    n = 600
    s = np.arange(n) / 100.0
    s = s + 2.0 * (np.arange(n) >= 300)
    force = np.tile(UP, (n, 1))
    force[500:] += 0.5 * np.sin(2 * np.pi * 3.0 * s[500:, None])
    ingest = ImuIngest(ImuSettings(), Place())
    stands = []
    for t, f in zip(s, force, strict=True):
        ingest.push(T0 + t, f, (0.0, 0.0, 0.0))
        stands.append(ingest.standing)
    rises = np.flatnonzero(np.diff(np.array(stands, dtype=int)) > 0) + 1
    falls = np.flatnonzero(np.diff(np.array(stands, dtype=int)) < 0) + 1
    assert rises == pytest.approx([100, 400], abs=2)
    assert falls[0] == 300
    assert 500 < falls[1] <= 601 - 50
    ingest.reset()
    assert not ingest.standing
    assert ingest.rate is None


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize(("share", "stands"), [(0.7, True), (1.4, False)])
def test_each_axis_alone_can_say_that_it_does_not_stand(axis: int, share: float, stands: bool) -> None:
    """By its standard deviation below 10 Hz; an idling engine may shake it faster as much as it likes."""
    limits = StillLimits()
    n = 400
    s = np.arange(n) / 200.0
    signal = np.zeros((n, 6))
    limit = limits.force if axis < 3 else limits.rate
    signal[:, axis] = share * limit * math.sqrt(2.0) * np.sin(2 * np.pi * 4.0 * s)
    signal += 4.0 * limit * np.sin(2 * np.pi * 90.0 * s)[:, None] * (np.arange(6) == axis)
    ingest = ImuIngest(ImuSettings(), Place())
    push(ingest, s, UP + signal[:, :3], signal[:, 3:])
    assert ingest.standing == stands


@pytest.mark.parametrize(("turn", "stands"), [(0.03, True), (0.08, False)])
def test_a_steady_turn_is_a_bias_up_to_a_limit(turn: float, stands: bool) -> None:
    s = np.arange(300) / 100.0
    ingest = ImuIngest(ImuSettings(), Place())
    outs = push(ingest, s, np.tile(UP, (300, 1)), np.tile([0.0, 0.0, turn], (300, 1)))
    assert ingest.standing == stands
    assert outs[-1] is not None
    assert outs[-1].rate[2] == pytest.approx(0.0 if stands else turn, abs=1e-6)


def test_biases_are_the_mean_of_all_standstills() -> None:
    """Noisy readings at rest: what is taken off is their mean, all of them counting alike but the newest window."""
    random = np.random.default_rng(4)
    n = 1000
    s = np.arange(n) / 100.0
    force = UP + np.array([0.1, -0.15, 0.2]) + random.normal(0.0, 0.05, (n, 3))
    rate = np.array([0.01, -0.02, 0.03]) + random.normal(0.0, 0.003, (n, 3))
    outs = push(ImuIngest(ImuSettings(), Place()), s, force, rate)
    found = outs[-1]
    assert found is not None
    # less the bias is what is left of the sample: the bias is what was taken off it
    assert force[-1] - found.raw_force == pytest.approx(force[:-50].mean(axis=0) - UP, abs=2e-3)
    assert rate[-1] - found.raw_rate == pytest.approx(rate[:-50].mean(axis=0), abs=1e-4)


def test_a_parking_slope_is_no_bias_and_up_follows_it() -> None:
    slope = 0.15
    reading = STANDARD_GRAVITY * np.array([math.sin(slope), 0.0, math.cos(slope)])
    ingest = ImuIngest(ImuSettings(), Place())
    out = push(ingest, np.arange(190) / 100.0, np.tile(reading, (190, 1)))[-1]
    assert out is not None
    assert out.raw_force == pytest.approx(reading, abs=1e-6)
    assert out.up == pytest.approx(reading / STANDARD_GRAVITY, abs=1e-6)
    assert out.vertical_acceleration == pytest.approx(0.0, abs=1e-6)
    assert codes(ingest) == {"tilted": "warn"}
    # of a heavy reading only the length is put right
    outs = push(ImuIngest(ImuSettings(), Place()), np.arange(400) / 100.0, np.tile(1.02 * reading, (400, 1)))
    assert outs[-1] is not None
    assert outs[-1].raw_force == pytest.approx(reading, abs=1e-6)


def test_three_very_quiet_seconds_stand_although_the_vertical_has_drifted() -> None:
    """The gyro's bias, unknown, has carried the vertical off while the car drove; then it stands on a slope."""
    s, force, rate = shaking(1000, seed=3)
    bias = np.array([0.004, 0.0, 0.0])
    n = 900
    rest = np.random.default_rng(5).normal(0.0, 0.01, (n, 3)) + UP
    still = np.random.default_rng(6).normal(0.0, 5e-4, (n, 3))
    s = np.arange(1000 + n) / 100.0
    ingest = ImuIngest(ImuSettings(attitude_time=40.0), Place())
    stands = []
    for t, f, w in zip(s, np.vstack([force, rest]), np.vstack([rate, still]) + bias, strict=True):
        out = ingest.push(T0 + t, f, w)
        stands.append(ingest.standing)
        if len(stands) == 1000:
            assert out is not None
            assert math.hypot(*out.up[:2]) > 0.03
    first = int(np.argmax(stands)) - 1000
    assert 300 <= first <= 450
    assert all(stands[1000 + first :])
    assert out is not None
    assert out.raw_rate == pytest.approx(still[-1], abs=2e-4)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_each_axis_of_either_sensor_can_sit_at_its_end(axis: int, sign: float) -> None:
    s, force, rate = shaking(40)
    force[20, axis], rate[25, axis] = sign * 19.6, sign * 4.36
    for settings_, count in (
        (ImuSettings(full_scale=19.6, full_scale_rate=4.36), 2),
        (ImuSettings(full_scale=19.6), 1),
        (ImuSettings(full_scale=25.0, full_scale_rate=4.36), 1),
        (ImuSettings(full_scale=25.0, full_scale_rate=8.7), 0),
    ):
        ingest = ImuIngest(settings_, Place())
        push(ingest, s, force, rate)
        assert ingest.counts["saturated"] == count
        assert ("saturated" in codes(ingest)) == (count > 0)


@pytest.mark.parametrize("full", FULL_SCALES)
def test_the_ranges_that_phones_have_are_known(full: float) -> None:
    s, force, rate = shaking(60)
    force[30] = [0.0, -full, 1.0]
    force[35] = [0.0, 0.97 * full, 1.0]
    ingest = ImuIngest(ImuSettings(), Place())
    push(ingest, s, force, rate)
    assert ingest.counts["saturated"] == 1
    # one that sends g is at the end of its range where so many g are
    in_g = ImuIngest(ImuSettings(), Place())
    push(in_g, s, force / STANDARD_GRAVITY, rate)
    assert in_g.counts["saturated"] == 1


@pytest.mark.parametrize("restore", [True, False])
def test_gravity_that_the_phone_has_removed_is_put_back_or_left(restore: bool) -> None:
    s, force, rate = shaking(400)
    linear = 0.5 * (force - UP)
    ingest = ImuIngest(ImuSettings(restore_gravity=restore), Place())
    outs = push(ingest, s, linear, rate)
    assert codes(ingest) == {"gravity_removed": "warn"}
    raw = column(outs, "raw_force")
    np.testing.assert_allclose(raw, linear[WARMUP - 1 :] + UP * restore, rtol=0, atol=1e-9)
    low_pass = CausalLowPass(ImuSettings().filter, 100.0, 1)
    expected = low_pass.process(linear[:, 2])[WARMUP - 1 :]
    np.testing.assert_allclose(column(outs, "vertical_acceleration"), expected, rtol=0, atol=1e-4)
    assert np.array_equal(column(outs, "up"), np.tile([0.0, 0.0, 1.0], (len(raw), 1)))


def test_of_removed_gravity_what_is_left_at_rest_is_bias() -> None:
    n = 400
    bias = np.array([0.2, -0.5, 0.4])
    out = push(ImuIngest(ImuSettings(), Place()), np.arange(n) / 100.0, np.tile(bias, (n, 1)))[-1]
    assert out is not None
    assert out.raw_force == pytest.approx(UP, abs=1e-9)
    assert out.vertical_acceleration == pytest.approx(0.0, abs=1e-9)


def test_a_sensor_in_g_that_is_left_so_says_the_same_in_g(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=10.0, force_bias=(0.1, -0.1, 0.1), rate_bias=(0.005, 0.0, -0.01))
    imu, g = drive.imu, STANDARD_GRAVITY
    found = {}
    for convert in (True, False):
        ingest = ImuIngest(ImuSettings(convert_units=convert), Place())
        found[convert] = push(ingest, imu.t - T0, imu.specific_force / g, imu.angular_rate)
        assert codes(ingest) == {"units_g": "warn"}
    one, other = found[True], found[False]
    for name in ("force", "raw_force", "vertical_acceleration"):
        np.testing.assert_allclose(g * column(other, name), column(one, name), rtol=0, atol=1e-9)
    for name in ("rate", "raw_rate", "up"):
        np.testing.assert_array_equal(column(other, name), column(one, name))


def test_units_that_change_are_followed_after_two_looks() -> None:
    """A driver that is restarted in g: after four seconds at the latest all is as before."""
    s, force, rate = shaking(1500)
    ingest = ImuIngest(ImuSettings(), Place())
    push(ingest, s[:600], force[:600], rate[:600])
    assert codes(ingest) == {}
    outs = push(ingest, s[600:], force[600:] / STANDARD_GRAVITY, rate[600:])
    assert codes(ingest) == {"units_g": "warn"}
    np.testing.assert_allclose(column(outs, "raw_force")[450:], force[1050:], rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        column(outs, "raw_force")[150], force[750] / STANDARD_GRAVITY, rtol=0, atol=1e-6
    )
    # one look alone changes nothing
    once = ImuIngest(ImuSettings(), Place())
    force[601:800] /= STANDARD_GRAVITY
    push(once, s, force, rate)
    assert codes(once) == {}


@pytest.mark.parametrize(
    ("axis", "code"), [(1, "accelerometer_axis_dead"), (4, "gyro_axis_dead"), (None, None)]
)
def test_a_dead_axis_is_told_and_forgotten_once_it_lives(axis: int | None, code: str | None) -> None:
    s, force, rate = shaking(900)
    signal = np.hstack([force, rate])
    if axis is not None:
        signal[:450, axis] = 0.25
    ingest = ImuIngest(ImuSettings(), Place())
    push(ingest, s[:450], signal[:450, :3], signal[:450, 3:])
    assert codes(ingest) == ({code: "error"} if code else {})
    push(ingest, s[450:], signal[450:, :3], signal[450:, 3:])
    assert codes(ingest) == {}


@pytest.mark.parametrize(
    ("level", "tilt", "turned"),
    [
        ("never", 1.0, False),
        ("gross", 0.7, False),
        ("gross", 0.9, True),
        ("always", 0.1, True),
        ("always", 0.02, False),
    ],
)
def test_axes_are_turned_upright_as_the_settings_say(level: str, tilt: float, turned: bool) -> None:
    """At the start, and at the first standstill of a drive that starts with a bump."""
    mounted = Rotation.from_euler("xyz", (0.0, tilt, 0.0))
    for start in (0, 40):
        s, force, rate = shaking(1200)
        force[start:], rate[start:] = UP, 0.0
        force[:start] += [0.0, 0.0, 9.0]
        sensor = mounted.inv().apply(force), mounted.inv().apply(rate + np.array([0.0, 0.0, 1e-3]))
        ingest = ImuIngest(ImuSettings(level=level), Place())  # type: ignore[arg-type]
        outs = push(ingest, s, *sensor)
        assert outs[-1] is not None
        still = UP if turned or tilt < 0.03 else mounted.inv().apply(UP)
        assert outs[-1].raw_force == pytest.approx(still, abs=1e-3)
        assert outs[-1].up == pytest.approx(still / STANDARD_GRAVITY, abs=1e-3)
        assert outs[-1].rate == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)


def test_the_worst_is_told_first_and_a_reset_forgets() -> None:
    s, force, rate = shaking(700)
    signal = force / STANDARD_GRAVITY
    signal[:, 1] = 0.0
    ingest = ImuIngest(ImuSettings(), Place())
    ingest.push(math.nan, signal[0], rate[0])
    ingest.push(T0 - 1.0, signal[0][:2], rate[0])
    push(ingest, s, signal, rate)
    assert list(codes(ingest)) == ["accelerometer_axis_dead", "units_g", "invalid"]
    assert ingest.counts["invalid"] == 2
    assert ingest.findings[-1].text.startswith("2 messages")
    ingest.reset()
    assert ingest.findings == []
    assert not ingest.counts


def test_a_reset_or_a_clock_set_back_forgets_units_axes_and_biases() -> None:
    s = np.arange(400) / 100.0
    odd = np.tile(np.array([0.02, 0.02, -1.01]), (400, 1))  # in g, upside down, biased
    for how in ("reset", "set back"):
        ingest, fresh = ImuIngest(ImuSettings(), Place()), ImuIngest(ImuSettings(), Place())
        push(ingest, s + 1000.0, odd, np.full((400, 3), 0.02))
        if how == "reset":
            ingest.reset()
        _, force, rate = shaking(400)
        assert push(ingest, s, force, rate) == push(fresh, s, force, rate)
        assert ingest.counts["resets"] == (how == "set back")
        assert codes(ingest) == codes(fresh) == {}


def test_a_pause_before_the_rate_is_known_starts_over() -> None:
    s, force, rate = shaking(60)
    s = s + 5.0 * (np.arange(60) >= 10)
    ingest, fresh = ImuIngest(ImuSettings(), Place()), ImuIngest(ImuSettings(), Place())
    outs = [out for out in push(ingest, s, force, rate) if out]
    later = [out for out in push(fresh, s[10:], force[10:], rate[10:]) if out]
    assert len(outs) >= len(later)
    expected = CausalLowPass(ImuSettings().filter, 100.0, 3).process(force[10:])[-len(later) :]
    np.testing.assert_allclose(column(outs, "force")[-len(later) :], expected, rtol=0, atol=1e-4)


def test_gravity_is_that_of_the_latitude() -> None:
    """On the equator 9.78 m/s² is all of it: nothing is left over as a bias."""
    n = 300
    reading = np.tile([0.05, 0.0, 9.7803], (n, 1))
    out = push(ImuIngest(ImuSettings(latitude=0.0), Place()), np.arange(n) / 100.0, reading)[-1]
    assert out is not None
    assert out.raw_force == pytest.approx((0.0, 0.0, 9.7803), abs=1e-4)
    away = push(ImuIngest(ImuSettings(), Place()), np.arange(n) / 100.0, reading)[-1]
    assert away is not None
    assert away.raw_force[2] == pytest.approx(STANDARD_GRAVITY, abs=1e-4)


def test_when_the_rate_drifts_the_filter_is_designed_anew_without_a_transient() -> None:
    """From 60 to 56 Hz within the clock's patience: 20 Hz stay 20 Hz, and a constant stays what it is."""
    steps = np.concatenate([np.full(400, 1 / 60.0), np.full(2500, 1 / 56.0)])
    s = np.cumsum(steps)
    ingest = ImuIngest(ImuSettings(filter=FilterSpec(2, 20.0)), Place())
    force = np.tile(UP, (s.size, 1))
    force[1400:, 0] += 1.5 * np.sin(2 * np.pi * 15.0 * s[1400:])
    force[1400:, 1] += np.random.default_rng(0).normal(0.0, 0.5, s.size - 1400)
    outs = push(ingest, s, force)
    assert ingest.rate == pytest.approx(56.0, rel=0.01)
    np.testing.assert_allclose(
        column(outs[:1390], "force"), np.tile(UP, (1390 - WARMUP + 1, 1)), rtol=0, atol=1e-9
    )
    x = column(outs, "force")[-1000:, 0]
    expected = CausalLowPass(FilterSpec(2, 20.0), 56.0, 1).process(force[1400:, 0])[-1000:]
    assert np.std(x) == pytest.approx(np.std(expected), rel=0.02)
