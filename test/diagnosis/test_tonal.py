# SPDX-License-Identifier: Apache-2.0
"""Lines in what is left: a wheel's turns, an engine's period, and what only looks like one."""

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
    """A bench of drives of 400 m at about these speeds, each one's place and time, and noise like a model's error."""
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
    problem = SimpleNamespace(
        parts=parts,
        rows=rows,
        measured=measured,
        channels=("vertical_acceleration", "roll_rate", "pitch_rate"),
    )
    rest = 0.2 * lfilter([1.0], [1.0, -1.5, 0.75], rng.normal(size=motion.shape), axis=0)
    place = np.concatenate([p.position for p in parts])
    return SimpleNamespace(problem=problem, active=active), place, np.concatenate([p.t for p in parts]), rest


def judged(bench: Any, rest: np.ndarray) -> tuple[float, Any]:
    """Prominence of the strongest tone, 0 without one, and the tone; model discrepancy has up to 10."""
    tone = strongest_tone(bench, RemainingResidual(rest, rest), 0.1)
    return (0.0 if tone is None else tone.strength), tone


@pytest.mark.parametrize("seed", range(20))
def test_noise_has_no_lines(seed: int) -> None:
    bench, _, _, rest = drives([8.0, 15.0], (True, True), seed)
    assert judged(bench, rest)[0] < 10.5


@pytest.mark.parametrize("seed", range(5))
def test_the_turns_of_a_wheel_are_found_at_any_speed(seed: int) -> None:
    bench, place, _, rest = drives([8.0, 15.0], (True, True), seed)
    turning = 0.8 * rest[:, 1].std() * np.sin(2 * np.pi * place / 1.93 + 1.0)
    rest[:, 1] += turning
    strength, line = judged(bench, rest)
    assert strength > 24.0 and line.domain == "distance" and line.channel == "roll_rate"
    assert 1 / line.at == pytest.approx(1.93, rel=0.01)
    assert line.share == pytest.approx(np.var(turning) / np.var(rest[:, 1]), rel=0.35)


@pytest.mark.parametrize("hertz", [4.3, 11.7])
def test_an_engines_period_is_found_in_time(hertz: float) -> None:
    bench, _, time, rest = drives([8.0, 15.0], (True, True), 3)
    rest[:, 0] += rest[:, 0].std() * np.sin(2 * np.pi * hertz * time)
    strength, line = judged(bench, rest)
    assert strength > 24.0 and line.domain == "time" and line.at == pytest.approx(hertz, abs=0.1)


def test_what_the_model_makes_there_too_is_no_line_of_its_own() -> None:
    """A washboard that is mapped too low is in what is left as it is in what the model makes."""
    bench, place, _, rest = drives([8.0, 15.0], (True, True), 5)
    wash = np.sin(2 * np.pi * place / 1.5)
    bench.problem.measured.values[:, 0] += 20.0 * wash
    rest[:, 0] -= 2.0 * wash
    assert judged(bench, rest)[0] < 10.5


def test_what_the_reference_has_as_well_is_a_trait() -> None:
    for shown_only in (False, True):
        bench, place, _, rest = drives([8.0, 15.0, 10.0], (True, True, False), 7)
        turning = rest[:, 2].std() * np.sin(2 * np.pi * place / 2.1)
        there = np.repeat([1.0, 1.0, 0.0 if shown_only else 1.0], [len(r) for r in bench.problem.rows])
        rest[:, 2] += turning * there
        assert (judged(bench, rest)[0] > 24.0) == shown_only


def test_a_resonance_is_no_line() -> None:
    """What shakes at its own frequency is as wide as its damping, however slight."""
    bench, _, _, rest = drives([8.0, 15.0], (True, True), 11)
    band = butter(1, (9.3, 9.9), "bandpass", fs=RATE, output="sos")
    shaking = sosfilt(band, np.random.default_rng(1).normal(size=len(rest)))
    rest[:, 0] += rest[:, 0].std() / shaking.std() * shaking
    assert judged(bench, rest)[0] < 12.7


def test_too_short_a_drive_has_no_lines() -> None:
    bench, _, _, rest = drives([8.0], (True,), 0)
    bench.problem.rows = [r[:300] for r in bench.problem.rows]
    bench.problem.measured.values = bench.problem.measured.values[:300]
    bench.problem.measured.segments = [slice(0, 300)]
    assert strongest_tone(bench, RemainingResidual(rest[:300], rest[:300]), 0.0) is None
