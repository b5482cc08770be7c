# SPDX-License-Identifier: Apache-2.0
"""Every oddity is found, named, and comes with what to do; an ordinary signal raises nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from suspension_twin.drive.units import recognise_units
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.signals.checks import (
    EXCLUDES,
    Finding,
    check_axes,
    check_mounting,
    check_rate,
    check_units,
    saturated_samples,
    told,
)

RANDOM = np.random.default_rng(7)
ROUGH = RANDOM.normal(0, 1.5, (3000, 3)) + np.array([0.3, -0.2, 9.8])


def test_units_by_the_mean() -> None:
    assert recognise_units(ROUGH) == "m/s2"
    assert recognise_units(ROUGH / 9.80665) == "g"
    assert recognise_units(ROUGH - [0.3, -0.2, 9.8]) == "gravity removed"
    assert recognise_units(ROUGH * 9.80665) == "unknown"
    assert recognise_units(np.empty((0, 3))) == "unknown"
    # Half a second of steady pulling away without gravity is neither 1 g nor 9.8.
    assert recognise_units(RANDOM.normal(0, 0.05, (50, 3)) + np.array([1.9, 0, 0])) == "gravity removed"


@pytest.mark.parametrize("units", ["g", "gravity removed", "unknown"])
def test_units_are_told_with_a_remedy(units: str) -> None:
    finding = check_units(units, 1.0)  # type: ignore[arg-type]
    assert finding is not None
    assert finding.level == ("error" if units == "unknown" else "warn")
    assert "\n" not in finding.text
    assert ":" in finding.text


def test_right_units_are_not_worth_a_word() -> None:
    assert check_units("m/s2", 9.8) is None


@pytest.mark.parametrize(
    ("rate", "code"), [(30.0, "rate_low"), (49.5, None), (100.0, None), (1600.0, None), (2000.0, "rate_high")]
)
def test_rate(rate: float, code: str | None) -> None:
    finding = check_rate(rate)
    assert (finding.code if finding else None) == code


@pytest.mark.parametrize(
    ("mounted", "code", "level"),
    [
        ((0.0, 0.0, 0.0), None, None),
        ((0.01, -0.01, 0.0), None, None),
        ((0.0, 0.12, 0.0), "tilted", "warn"),
        ((math.pi / 2, 0.0, 0.0), "axes_wrong", "error"),
        ((math.pi, 0.05, 0.0), "upside_down", "error"),
    ],
)
@pytest.mark.parametrize("yaw", [0.0, 1.0])
def test_mounting_is_named_and_the_rpy_that_repairs_it_is_given(
    mounted: tuple[float, float, float], code: str | None, level: str | None, yaw: float
) -> None:
    file_rpy = (0.0, 0.0, yaw)
    true_turn = rpy_matrix(file_rpy) @ rpy_matrix(mounted)
    read = true_turn.T @ [0, 0, 9.8]  # the sensor's own axes
    finding = check_mounting(rpy_matrix(file_rpy) @ read, file_rpy, 0.03)
    assert (finding.code if finding else None) == code
    if finding:
        assert finding.level == level
        numbers = finding.text.split("imu.rpy: [")[1].split("]")[0]
        suggested = tuple(float(x) for x in numbers.split(","))
        assert rpy_matrix(suggested) @ read == pytest.approx([0, 0, 9.8], abs=2e-3)  # type: ignore[arg-type]


def test_dead_axes() -> None:
    rates = RANDOM.normal(0, 0.1, (500, 3))
    assert check_axes(ROUGH[:500], rates) == []
    one = ROUGH[:500].copy()
    one[:, 1] = 0.25
    assert [f.code for f in check_axes(one, rates)] == ["accelerometer_axis_dead"]
    assert "axis y" in check_axes(one, rates)[0].text
    assert [f.code for f in check_axes(ROUGH[:500], 0 * rates)] == ["gyro_dead"]
    assert check_axes(one[:20], rates[:20]) == []  # too few to tell


def test_saturation_is_seen_without_knowing_the_range() -> None:
    clipped = np.clip(ROUGH, -100, 13.0)
    found = saturated_samples(clipped)
    assert np.array_equal(found, (ROUGH >= 13.0).any(axis=1))
    assert found.sum() > 10
    assert not saturated_samples(ROUGH).any()
    coarse = np.round(ROUGH / 0.0096) * 0.0096  # a 16-bit sensor at 16 g and less
    assert not saturated_samples(coarse).any()
    assert not saturated_samples(np.zeros((100, 3))).any()
    assert not saturated_samples(np.empty((0, 3))).any()


def test_saturation_with_a_known_range() -> None:
    clipped = np.clip(ROUGH, -12.0, 12.0)
    # A converter's last step may lie a little inside the range.
    assert np.array_equal(saturated_samples(clipped, 12.0), (np.abs(ROUGH) >= 0.9995 * 12.0).any(axis=1))
    assert np.array_equal(saturated_samples(clipped, 12.003), (np.abs(ROUGH) >= 0.9995 * 12.003).any(axis=1))


@pytest.mark.parametrize(
    ("cause", "left"), [(c, other) for c, row in EXCLUDES.items() for other in sorted(row)]
)
def test_what_a_finding_explains_is_not_advised(cause: str, left: str) -> None:
    both = [
        Finding("warn", left, "set imu.rpy"),
        Finding("error", cause, "the cause"),
        Finding("ok", "rate", ""),
    ]
    assert [f.code for f in told(both)] == [cause, "rate"]
    assert told(both[:1]) == both[:1]  # alone it is said


def test_no_two_findings_silence_each_other() -> None:
    order = list(EXCLUDES)
    for row, excluded in EXCLUDES.items():
        assert not any(
            other in order and order.index(other) < order.index(row) for other in excluded - {"clocks"}
        )
        assert not any(row in EXCLUDES.get(other, ()) for other in excluded)
