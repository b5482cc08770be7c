# SPDX-License-Identifier: Apache-2.0
"""Tonal components of the remaining residual: orders of a wheel, engine frequencies, and signals that resemble them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

from suspension_twin.diagnosis.shrink import RemainingResidual
from suspension_twin.diagnosis.where import strongest_tone

RATE = 100.0


def drives(
    speeds: list[float], active: tuple[bool, ...], seed: int
) -> tuple[Any, np.ndarray, np.ndarray, Any]:
    """A problem of drives of 400 m at about these speeds, each one's place and time, and noise like a model's error."""
    rng = np.random.default_rng(seed)
    parts, rows, lengths = [], [], []
    for speed in speeds:
        n = int(400 / speed * RATE)
        t = np.arange(n) / RATE
        way = np.cumsum(speed * (1 + 0.15 * np.sin(2 * np.pi * t / 17))) / RATE
        parts.append(SimpleNamespace(t=t, position=way))
        rows.append(np.arange(n))
        lengths.append(n)
    ends = np.cumsum([0, *lengths])
    motion = lfilter([1.0], [1.0, -1.6, 0.8], rng.normal(size=(ends[-1], 3)), axis=0)
    measured = SimpleNamespace(
        values=motion,
        segments=[slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)],
        drives=list(range(len(speeds))),
        rate=RATE,
    )
    data = SimpleNamespace(parts=parts, rows=rows, drive_of=list(range(len(speeds))), active=active)
    problem = SimpleNamespace(
        data=data,
        measured=measured,
        channels=("vertical_acceleration", "roll_rate", "pitch_rate"),
    )
    rest = 0.2 * lfilter([1.0], [1.0, -1.5, 0.75], rng.normal(size=motion.shape), axis=0)
    place = np.concatenate([p.position for p in parts])
    return problem, place, np.concatenate([p.t for p in parts]), rest


def strongest(problem: Any, rest: np.ndarray) -> tuple[float, Any]:
    """Prominence of the strongest tone, 0 without one, and the tone; model discrepancy has up to 10."""
    tone = strongest_tone(problem, RemainingResidual(rest, rest), 0.1)
    return (0.0 if tone is None else tone.strength), tone


@pytest.mark.parametrize("seed", range(20))
def test_broadband_noise_has_no_tonal_component(seed: int) -> None:
    problem, _, _, rest = drives([8.0, 15.0], (True, True), seed)
    assert strongest(problem, rest)[0] < 10.5


@pytest.mark.parametrize("seed", range(5))
def test_an_order_of_a_wheel_is_found_at_any_speed(seed: int) -> None:
    problem, place, _, rest = drives([8.0, 15.0], (True, True), seed)
    turning = 0.8 * rest[:, 1].std() * np.sin(2 * np.pi * place / 1.93 + 1.0)
    rest[:, 1] += turning
    strength, tone = strongest(problem, rest)
    assert strength > 24.0 and tone.domain == "distance" and tone.channel == "roll_rate"
    assert 1 / tone.at == pytest.approx(1.93, rel=0.01)
    assert tone.share == pytest.approx(np.var(turning) / np.var(rest[:, 1]), rel=0.35)


@pytest.mark.parametrize("hertz", [4.3, 11.7])
def test_an_engine_frequency_is_found_in_time(hertz: float) -> None:
    problem, _, time, rest = drives([8.0, 15.0], (True, True), 3)
    rest[:, 0] += rest[:, 0].std() * np.sin(2 * np.pi * hertz * time)
    strength, tone = strongest(problem, rest)
    assert strength > 24.0 and tone.domain == "time" and tone.at == pytest.approx(hertz, abs=0.1)


def test_a_component_of_the_simulated_signal_is_none_of_the_residual() -> None:
    """A washboard road whose heights are too low is in the residual and in the simulated signal alike."""
    problem, place, _, rest = drives([8.0, 15.0], (True, True), 5)
    wash = np.sin(2 * np.pi * place / 1.5)
    problem.measured.values[:, 0] += 20.0 * wash
    rest[:, 0] -= 2.0 * wash
    assert strongest(problem, rest)[0] < 10.5


def test_a_component_on_the_reference_is_no_finding() -> None:
    for shown_only in (False, True):
        problem, place, _, rest = drives([8.0, 15.0, 10.0], (True, True, False), 7)
        turning = rest[:, 2].std() * np.sin(2 * np.pi * place / 2.1)
        there = np.repeat([1.0, 1.0, 0.0 if shown_only else 1.0], [len(r) for r in problem.data.rows])
        rest[:, 2] += turning * there
        assert (strongest(problem, rest)[0] > 24.0) == shown_only


def test_a_resonance_is_no_tonal_component() -> None:
    """The width of a resonance is that of its damping, however small."""
    problem, _, _, rest = drives([8.0, 15.0], (True, True), 11)
    band = butter(1, (9.3, 9.9), "bandpass", fs=RATE, output="sos")
    shaking = sosfilt(band, np.random.default_rng(1).normal(size=len(rest)))
    rest[:, 0] += rest[:, 0].std() / shaking.std() * shaking
    assert strongest(problem, rest)[0] < 12.7


def test_too_short_a_drive_has_no_tonal_component() -> None:
    problem, _, _, rest = drives([8.0], (True,), 0)
    problem.data.rows = [r[:300] for r in problem.data.rows]
    problem.measured.values = problem.measured.values[:300]
    problem.measured.segments = [slice(0, 300)]
    assert strongest_tone(problem, RemainingResidual(rest[:300], rest[:300]), 0.0) is None
