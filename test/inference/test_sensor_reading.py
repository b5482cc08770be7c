# SPDX-License-Identifier: Apache-2.0
"""Simulated sensor readings: the three compiled loops against one written from their formula, sample by sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from suspension_twin.inference.sensor_reading import read_alike, read_any, read_steady
from suspension_twin.models.sensor_chain import TABLE, TAPS

M, CHANNELS, LANES = 60, 3, 4
#: In samples: whole ones, beside them by less than a double can hold in their place, fractions, beyond both ends.
SHIFTS = (0.0, -1e-17, 1.0, -1.0 + 1e-16, 0.25, -3.7, 0.999999, 40.3, -75.0, 200.0)


def compiled(kernel: Any) -> Any:
    return kernel


def plain(kernel: Any) -> Any:
    """The same loop in Python: an index beyond an array is an error, which compiled code does not notice."""
    return kernel.py_func


AT = pytest.mark.parametrize(
    ("shift", "as_run"),
    [*((s, compiled) for s in SHIFTS), *((s, plain) for s in (-1e-17, 0.25, 0.999999, -75.0, 200.0))],
)


def at(signal: np.ndarray, place: float) -> Any:
    """The signal (m, ...) at a fractional sample: windowed sinc, weights linear between two phases, ends held."""
    first = int(np.floor(place))
    phases = len(TABLE) - 1
    fine = (place - first) * phases
    phase = min(int(fine), phases - 1)
    weights = TABLE[phase] + (fine - phase) * (TABLE[phase + 1] - TABLE[phase])
    which = np.clip(first - TAPS // 2 + 1 + np.arange(TAPS), 0, len(signal) - 1)
    return np.tensordot(weights, signal[which], axes=1)


def slope(signal: np.ndarray, place: float) -> Any:
    """By sample."""
    return 0.5 * (at(signal, place + 1.0) - at(signal, place - 1.0))


@pytest.fixture
def given() -> dict[str, Any]:
    rng = np.random.default_rng(5)
    rows = np.arange(0, M - 3, 5)  # of the first a shift is held to the last digit
    return {
        "simulated": rng.standard_normal((M, CHANNELS, LANES)),
        "rows": rows,
        "gain": 1.0 + 0.3 * rng.standard_normal((CHANNELS, LANES)),
        "bias": rng.standard_normal((CHANNELS, LANES)),
        "about": rng.standard_normal((2, rows.size, CHANNELS)),
        "tilt": rng.standard_normal((2, LANES)),
        "lever": rng.standard_normal((CHANNELS, LANES)),
    }


def expected(
    given: dict[str, Any], shift: np.ndarray, turned: list[int], carried: np.ndarray | None = None
) -> Any:
    """(r, C, L): gain times (signal + lever times the slope of another, or the bend of its own) + bias + tilt."""
    moving = given["simulated"] if carried is None else given["simulated"] - carried[:, :, None]
    out = np.empty((given["rows"].size, CHANNELS, LANES))
    for i, row in enumerate(given["rows"]):
        for c in range(CHANNELS):
            for lane in range(LANES):
                place = row + shift[i, lane]
                value = at(moving[:, c, lane], place)
                if turned[c] == CHANNELS:
                    ends = [slope(moving[:, c, lane], place + step) for step in (-1.0, 1.0)]
                    value += given["lever"][c, lane] * 0.5 * (ends[1] - ends[0])
                elif turned[c] >= 0:
                    value += given["lever"][c, lane] * slope(moving[:, turned[c], lane], place)
                value = given["gain"][c, lane] * value + given["bias"][c, lane]
                value += given["tilt"][0, lane] * given["about"][0, i, c]
                value += given["tilt"][1, lane] * given["about"][1, i, c]
                out[i, c, lane] = value + (0.0 if carried is None else carried[row, c])
    return out


@AT
@pytest.mark.parametrize("one_lane", [False, True])
def test_each_lane_has_a_shift_of_its_own_at_every_sample(
    given: dict[str, Any], shift: float, one_lane: bool, as_run: Any
) -> None:
    if one_lane:
        given["simulated"] = np.repeat(given["simulated"][:, :, :1], LANES, axis=2)
    shifts = shift + np.array([0.0, 0.0, 0.4, -1.3]) + 0.01 * np.arange(given["rows"].size)[:, None]
    shifts[:, 0] = shift
    turned = [1, -1, 0]
    out = np.full((given["rows"].size, CHANNELS, LANES), np.nan)
    simulated = given["simulated"][:, :, :1].copy() if one_lane else given["simulated"]
    half = given["rows"].size // 2
    for low, high in ((0, half), (half, given["rows"].size)):
        as_run(read_any)(
            simulated, given["rows"], shifts, given["gain"], given["bias"], given["about"], given["tilt"],
            given["lever"], np.array(turned), TABLE, out, low, high,
        )  # fmt: skip
    np.testing.assert_allclose(out, expected(given, shifts, turned), rtol=0, atol=1e-12)


@AT
@pytest.mark.parametrize("carries", [False, True])
def test_all_lanes_are_shifted_alike(given: dict[str, Any], shift: float, carries: bool, as_run: Any) -> None:
    """What is carried, the response to the motion in the plane, stays in its place."""
    carried = np.random.default_rng(8).standard_normal((M, CHANNELS)) if carries else None
    shifts = np.full(given["rows"].size, shift) + 0.03 * np.arange(given["rows"].size)
    shifts[0] = shift
    turned = [1, CHANNELS, -1]
    out = np.full((given["rows"].size, CHANNELS, LANES), np.nan)
    as_run(read_alike)(
        given["simulated"], np.empty((0, CHANNELS)) if carried is None else carried, given["rows"], shifts,
        given["gain"], given["bias"], given["about"], given["tilt"], given["lever"], np.array(turned), TABLE,
        out, 0, given["rows"].size,
    )  # fmt: skip
    wanted = expected(given, np.repeat(shifts[:, None], LANES, axis=1), turned, carried)
    np.testing.assert_allclose(out, wanted, rtol=0, atol=1e-12)


@AT
def test_each_lane_has_one_shift(given: dict[str, Any], shift: float, as_run: Any) -> None:
    shifts = shift + np.array([0.0, 0.6, -2.2, 11.0])
    out = np.full((given["rows"].size, CHANNELS, LANES), np.nan)
    as_run(read_steady)(
        given["simulated"], given["rows"], shifts, given["gain"], given["bias"], given["about"], given["tilt"],
        TABLE, out, 0, given["rows"].size,
    )  # fmt: skip
    wanted = expected(given, np.tile(shifts, (given["rows"].size, 1)), [-1] * CHANNELS)
    np.testing.assert_allclose(out, wanted, rtol=0, atol=1e-12)


def test_a_whole_sample_is_the_sample_and_a_slow_wave_is_met_between_them() -> None:
    wave = np.sin(2 * np.pi * 0.05 * np.arange(M) + 0.3)
    assert at(wave, 20.0) == pytest.approx(wave[20], abs=1e-12)
    assert at(wave, 20.37) == pytest.approx(np.sin(2 * np.pi * 0.05 * 20.37 + 0.3), abs=2e-3)
