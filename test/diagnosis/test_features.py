# SPDX-License-Identifier: Apache-2.0
"""Rows of evidence: even spectra, usual errors of twin files, and numbers that JSON can hold."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from one_channel import CHANNEL, RATE, problem_over
from scipy.signal import butter, sosfilt

from suspension_twin.diagnosis import features, where
from suspension_twin.diagnosis.shrink import RemainingResidual
from suspension_twin.inference.hypothesis import Hypothesis


def road_motion(seed: int, samples: int) -> np.ndarray:
    """(n,) band-passed noise like the vertical acceleration of a body on a rough road, m/s²."""
    white = np.random.default_rng(seed).standard_normal(samples)
    return np.asarray(sosfilt(butter(2, [1.0, 12.0], "band", fs=RATE, output="sos"), white))


@pytest.mark.parametrize("seed", range(4))
def test_model_discrepancy_is_even_over_frequency_and_an_order_is_not(seed: int) -> None:
    n = 4000
    motion, own = road_motion(seed, n), road_motion(seed + 100, n)
    order = 0.3 * np.sin(2 * np.pi * 7.0 * np.arange(n) / RATE)
    left = (0.1 * own)[:, None]
    loud = left + order[:, None]

    def unevenness(measured: np.ndarray, rest: np.ndarray) -> float:
        residual = RemainingResidual(rest, rest)
        return where.unevenness(problem_over([n], measured[:, None]), residual, {CHANNEL: 0.005})

    assert unevenness(motion, left) < 2.7
    assert unevenness(motion + order, loud) > 3.0


def fitted(hypothesis: Hypothesis, nuisances: dict[str, float], values: dict[str, float]) -> tuple[Any, Any]:
    """A problem and evidence with these nuisances, in spreads, and these parameters of the effects."""
    names = list(nuisances)
    given = SimpleNamespace(names=names, spread=np.full(len(names), 0.002))
    twin = SimpleNamespace(vehicle=SimpleNamespace(mass=1500.0))
    # a drive of 40 s in two parts, a shorter one, and a longer one from before
    ends = ((0.0, 10.0, 0), (25.0, 40.0, 0), (50.0, 75.0, 1), (90.0, 190.0, 2))
    parts = [SimpleNamespace(t=np.array([a, b]), position=np.array([5.0, 95.0])) for a, b, _ in ends]
    data = SimpleNamespace(parts=parts, drive_of=[drive for *_, drive in ends], active=(True, True, False))
    there = SimpleNamespace(d=2, q=len(names), shared=2 + len(names), nuisances=given, twin=twin, data=data)
    u = [(values[p.name] - p.prior.typical) / p.prior.spread for _, p in hypothesis.searched]
    x = np.concatenate([np.zeros(2), [0.002 * v for v in nuisances.values()], u])
    return there, SimpleNamespace(fit=SimpleNamespace(hypothesis=hypothesis, x=x), penalty=None)


def usual(
    effect: str, values: dict[str, float], nuisances: dict[str, float], changed: bool = False
) -> float | None:
    """Size over the usual error of a twin file, and whether there is a reference of the same vehicle."""
    there, found = fitted(Hypothesis((effect,)), nuisances, values)
    rows = {effect: {k: {"value": v} for k, v in values.items()}}
    return features.usual_ratio(there, found.fit.hypothesis, rows, changed)


@pytest.mark.parametrize(("mass", "ratio"), [(30.0, 0.5), (60.0, 1.0), (150.0, 2.5)])
def test_a_payload_is_compared_with_the_usual_error_of_a_twin_file(mass: float, ratio: float) -> None:
    assert usual("payload", {"mass": mass, "x": 0.5, "y": 0.0}, {}) == pytest.approx(ratio)
    assert usual("tyre_envelope", {"length": 0.18}, {}) == pytest.approx(1.5)
    assert usual("sensor_clipping", {"range": 20.0}, {}) is None


@pytest.mark.parametrize(
    ("effect", "values", "usual_size"),
    [
        ("strut_friction", {"front_force": 3.0, "rear_force": 5.0}, True),
        ("strut_friction", {"front_force": 0.0, "rear_force": 40.0}, False),
        ("tyre_damping", {"damping": 25.0}, True),
        ("tyre_damping", {"damping": 300.0}, False),
        ("road_scale", {"scale": -0.012}, True),
        ("road_scale", {"scale": 0.08}, False),
        ("sensor_offset", {"x": 0.01, "y": 0.0, "z": -0.01}, True),
        ("sensor_offset", {"x": 0.0, "y": 0.0, "z": 0.2}, False),
        ("clock_drift", {"drift_ppm": -25.0}, True),
        ("clock_drift", {"drift_ppm": -250.0}, False),
        (
            "progressive_spring",
            {"front_rise": 2e5, "rear_rise": -5e4, "front_square": 1e6, "rear_square": 0.0},
            True,
        ),
        (
            "progressive_spring",
            {"front_rise": 7e4, "rear_rise": 4e3, "front_square": 3e7, "rear_square": 3e7},
            False,
        ),
        ("bump_stop", {"front_clearance": 0.003, "rear_clearance": 0.04, "stiffness": 3.2e3}, True),
        ("rebound_stop", {"front_clearance": 0.03, "rear_clearance": 0.03, "stiffness": 4.0e4}, False),
    ],
)
def test_sizes_of_sound_cars_are_usual(effect: str, values: dict[str, float], usual_size: bool) -> None:
    ratio = usual(effect, values, {})
    assert ratio is not None and (ratio < 0.6 if usual_size else ratio > 1.7)
    # where a reference shows the same car, what it had before is in both; a clock is another on every drive
    with_reference = usual(effect, values, {}, changed=True)
    assert with_reference == (ratio if effect == "clock_drift" else None)


def test_clock_offsets_within_their_prior_at_both_ends_are_no_drift() -> None:
    def ratio(ppm: float, clocks: dict[str, float]) -> float:
        found = usual("clock_drift", {"drift_ppm": ppm}, clocks, changed=True)
        assert found is not None
        return found

    one = {"drive_fast.clock_offset": 0.0, "clock_offset": 0.0}  # 40 s and 2 ms: four of these are 200 ppm
    assert ratio(-200.0, one) == pytest.approx(1.0)
    both = {**one, "drive_fast.map_position": 0.0}  # and 2 mm at 4.5 m/s
    assert (
        ratio(100.0 * np.hypot(2.0, 2.0 / 4.5), both) == pytest.approx(1.0, rel=0.01)
        or ratio(100.0, both) < 1.0
    )
    assert ratio(100.0, {}) > 1.7  # where no clock's error is known only its rate shows


def test_values_that_are_not_finite_are_none() -> None:
    assert features._plain({"a": np.float64("nan"), "b": (1, np.inf, True), "c": "x"}) == {
        "a": None,
        "b": [1, None, True],
        "c": "x",
    }
