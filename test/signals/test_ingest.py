# SPDX-License-Identifier: Apache-2.0
"""Message by message: the live path against the offline one, and against every way messages go wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.drive.types import Drive
from suspension_twin.signals.filters import CausalLowPass, FilterSpec
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.signals.ingest import ImuIngest, IngestOutput
from suspension_twin.vehicle.twin import Place

Maker = Callable[..., tuple[Drive, object]]


def feed(ingest: ImuIngest, drive: Drive, order: Iterable[int] | None = None) -> list[IngestOutput]:
    """Every message of the drive, in ``order``."""
    imu = drive.imu
    outs = [
        ingest.push(imu.t[i], imu.specific_force[i], imu.angular_rate[i])
        for i in (order if order is not None else range(len(imu)))
    ]
    return [out for out in outs if out is not None]


def codes(ingest: ImuIngest) -> dict[str, str]:
    """Findings as code: level."""
    return {f.code: f.level for f in ingest.findings}


@pytest.mark.parametrize("rate", [50.0, 104.4, 400.0, 1600.0])
@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (math.pi, 0.1, 2.0)])
def test_filtered_signals_are_the_truth_through_the_same_filter(
    make_drive: Maker, rate: float, rpy: tuple[float, float, float]
) -> None:
    drive, truth = make_drive(
        rate=rate,
        rpy=rpy,
        seconds=15.0,
        force_bias=(0.1, -0.1, 0.1),
        rate_bias=(0.005, -0.003, 0.004),
        jitter=0.05,
        noise=0.01,
        rate_noise=0.0005,
    )
    spec = FilterSpec(2, 15.0)
    ingest = ImuIngest(ImuSettings(filter=spec), Place(rpy=rpy))
    outs = feed(ingest, drive)
    assert len(outs) == len(drive.imu) - 17 + 1  # the rate is known with the seventeenth sample
    assert ingest.rate == pytest.approx(rate, rel=5e-3)
    assert codes(ingest) == {}
    moved = np.searchsorted(truth.t, outs[0].t) + int(2 * rate)
    for name, channel in (("force", truth.force), ("rate", truth.rate)):
        low_pass = CausalLowPass(spec, rate, 3)
        expected = low_pass.process(channel)[moved:]
        got = np.array([getattr(out, name) for out in outs])[-len(expected) :]
        assert np.sqrt(np.mean((got - expected) ** 2)) < (0.02 if name == "force" else 0.002)
    expected = CausalLowPass(spec, rate, 1).process(truth.vertical)[moved:]
    got = np.array([out.vertical_acceleration for out in outs])[-len(expected) :]
    assert np.sqrt(np.mean((got - expected) ** 2)) < 0.02
    assert abs(np.mean(got - expected)) < 0.005
    raw = np.array([out.raw_force for out in outs])[-len(expected) :]
    assert np.sqrt(np.mean((raw - truth.force[moved:]) ** 2)) < 0.02


def test_at_rest_there_is_no_vertical_acceleration_from_the_first_output(make_drive: Maker) -> None:
    drive, _ = make_drive(stand=60.0, seconds=10.0, force_bias=(0.1, 0.1, -0.2), slope=0.03)
    outs = feed(ImuIngest(ImuSettings(), Place()), drive)
    assert max(abs(out.vertical_acceleration) for out in outs) < 0.08
    assert abs(np.mean([out.vertical_acceleration for out in outs])) < 0.005
    assert np.std([out.rate for out in outs[200:]]) < 0.0015


def test_a_steady_pull_is_not_a_standstill(make_drive: Maker) -> None:
    drive, _ = make_drive(stand=3.0, seconds=3.0)
    ingest = ImuIngest(ImuSettings(), Place())
    feed(ingest, drive)
    assert ingest.standing
    t, random = drive.imu.t[-1], np.random.default_rng(0)
    for _ in range(500):
        t += 0.01
        ingest.push(t, random.normal(0, 0.03, 3) + np.array([1.5, 0, 9.80665]), random.normal(0, 0.001, 3))
    assert not ingest.standing
    out = ingest.push(t + 0.01, (1.5, 0.0, 9.80665), (0.0, 0.0, 0.0))
    assert out is not None
    assert out.raw_force[0] == pytest.approx(1.5, abs=0.05)


def test_gravity_from_standstill_after_a_rough_start(make_drive: Maker) -> None:
    """Started while driving, biases unknown: at the first stop they are found."""
    moving, _ = make_drive(
        stand=0.0, seconds=12.0, force_bias=(0.1, 0.1, 0.2), rate_bias=(0.005, 0.005, 0.01)
    )
    ingest = ImuIngest(ImuSettings(), Place())
    feed(ingest, moving)
    t, random, rest = moving.imu.t[-1], np.random.default_rng(0), np.array([0.1, 0.1, 10.0])
    for _ in range(1500):
        t += 0.01
        out = ingest.push(t, random.normal(0, 0.03, 3) + rest, random.normal(0, 0.001, 3) + 0.005)
    assert ingest.standing
    assert out is not None
    assert out.vertical_acceleration == pytest.approx(0.0, abs=0.05)
    assert np.abs(out.rate).max() < 0.002


def test_late_repeated_lost_and_broken_messages(make_drive: Maker) -> None:
    drive, truth = make_drive(seconds=20.0, noise=0.005)
    random = np.random.default_rng(2)
    order = np.arange(2000)
    order = np.delete(order, random.choice(np.arange(100, 1900), 60, replace=False))
    for k in random.choice(np.arange(100, 1800), 30, replace=False):
        order[k], order[k + 1] = order[k + 1], order[k]
    order = np.insert(order, 500, [order[499]] * 3)
    ingest = ImuIngest(ImuSettings(), Place())
    outs = feed(ingest, drive, order)
    assert ingest.counts["late"] >= 25
    assert ingest.counts["duplicate"] == 3
    assert ingest.counts["missing"] >= 80
    expected = CausalLowPass(FilterSpec(), 100.0, 1).process(truth.vertical)
    at = np.searchsorted(truth.t, [out.t - 1e-6 for out in outs])
    error = np.array([out.vertical_acceleration for out in outs]) - expected[at]
    assert np.sqrt(np.mean(error[200:] ** 2)) < 0.06  # 0.66 rms of signal; the 11 Hz part suffers most


def test_a_pause_restarts_the_filter_without_a_transient(make_drive: Maker) -> None:
    drive, _ = make_drive(stand=60.0, seconds=10.0, noise=0.0, rate_noise=0.0)
    ingest = ImuIngest(ImuSettings(), Place())
    outs = feed(ingest, drive, [*range(400), *range(700, 1000)])
    assert ingest.counts["gaps"] == 1
    assert max(abs(out.vertical_acceleration) for out in outs) < 1e-6


def test_a_looped_bag_starts_anew(make_drive: Maker) -> None:
    drive, _ = make_drive(seconds=8.0)
    ingest = ImuIngest(ImuSettings(), Place())
    first = feed(ingest, drive)
    again = feed(ingest, drive)
    assert again == first
    assert ingest.counts["resets"] == 1


@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_units_mounting_and_gravity_are_recognised_and_put_right(make_drive: Maker, rate: float) -> None:
    drive, truth = make_drive(rate=rate, seconds=12.0, noise=0.005)
    upright = drive.imu.specific_force

    def last(force: np.ndarray, rates: np.ndarray = drive.imu.angular_rate) -> tuple[ImuIngest, np.ndarray]:
        ingest = ImuIngest(ImuSettings(), Place())
        outs = [ingest.push(*row) for row in zip(drive.imu.t, force, rates, strict=True)]
        return ingest, np.array([out.vertical_acceleration for out in outs if out])

    expected = CausalLowPass(FilterSpec(), rate, 1).process(truth.vertical)
    for force, rates, found in (
        (upright / 9.80665, drive.imu.angular_rate, {"units_g": "warn"}),
        (upright * [1, -1, -1], drive.imu.angular_rate * [1, -1, -1], {"upside_down": "error"}),
        (upright - 9.80665 * truth.up, drive.imu.angular_rate, {"gravity_removed": "warn"}),
    ):
        ingest, got = last(force, rates)
        assert codes(ingest) == found
        tail = int(8 * rate)
        assert np.sqrt(np.mean((got[-tail:] - expected[-tail:]) ** 2)) < 0.05


def test_always_levelling_turns_a_tilt_out(make_drive: Maker) -> None:
    tilted = (0.0, math.radians(8.0), 0.0)
    drive, truth = make_drive(rpy=tilted, seconds=12.0, noise=0.005)
    expected = CausalLowPass(FilterSpec(), 100.0, 3).process(truth.force)[-600:]
    for level, largest in (("always", 0.03), ("gross", None)):
        ingest = ImuIngest(ImuSettings(level=level), Place())  # type: ignore[arg-type]
        got = np.array([out.force for out in feed(ingest, drive)])[-600:]
        assert codes(ingest) == {"tilted": "warn"}
        rms = np.sqrt(np.mean((got - expected) ** 2))
        assert rms < largest if largest else rms > 0.5


def test_wrong_rate_cutoff_and_saturation_are_told(make_drive: Maker) -> None:
    slow = ImuIngest(ImuSettings(filter=FilterSpec(2, 20.0)), Place())
    assert feed(slow, make_drive(rate=30.0)[0])
    assert codes(slow) == {"rate_low": "error", "cutoff": "error"}
    drive, _ = make_drive()
    ingest = ImuIngest(ImuSettings(full_scale=10.4), Place())
    imu = drive.imu
    for row in zip(imu.t, np.minimum(imu.specific_force, 10.4), imu.angular_rate, strict=True):
        ingest.push(*row)
    assert codes(ingest) == {"saturated": "warn"}
    assert ingest.counts["saturated"] == (imu.specific_force >= 10.4 * 0.999).any(axis=1).sum()


def test_a_switch_of_the_sensor_rate_is_followed(make_drive: Maker) -> None:
    ingest = ImuIngest(ImuSettings(), Place())
    slow, _ = make_drive(seconds=5.0)
    feed(ingest, slow)
    t = slow.imu.t[-1]
    for k in range(1, 1000):
        ingest.push(t + 0.0025 * k, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0))
    assert ingest.rate == pytest.approx(400.0, rel=0.01)


ANYTHING = st.one_of(
    st.floats(), st.floats(-20, 20), st.integers(-5, 5), st.none(), st.text(max_size=3), st.booleans()
)


@given(
    st.lists(st.tuples(ANYTHING, st.lists(ANYTHING, max_size=4), st.lists(ANYTHING, max_size=4)), max_size=40)
)
@settings(max_examples=100, deadline=None)
def test_no_message_makes_it_raise_or_hand_on_a_nan(messages: list[tuple[object, list, list]]) -> None:
    ingest = ImuIngest(ImuSettings(), Place())
    t = 100.0
    for _ in range(20):
        t += 0.01
        ingest.push(t, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0))
    for stamp, force, rate in messages:
        out = ingest.push(stamp, force, rate)  # type: ignore[arg-type]
        if out is not None:
            flat = [out.t, out.vertical_acceleration, *out.force, *out.rate, *out.raw_force, *out.up]
            assert all(map(math.isfinite, flat))
    assert all("\n" not in f.text for f in ingest.findings)
