# SPDX-License-Identifier: Apache-2.0
"""The tracked vehicle's blind check: how strong its cases are, and what counts as what."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def answer(named: list[str], verdict: str, tied: tuple[str, ...] = ()) -> dict[str, Any]:
    return {
        "verdict": verdict,
        "combination": named,
        "causes": [{"indistinguishable_from": list(tied)}],
        "cannot_be_judged": ["track_tension", "sensor_tilt"],
    }


def test_an_outcome_is_what_was_said_of_what_was_done() -> None:
    from tracked_blind import outcome

    heavy = {"kind": "payload", "mass": 3000.0}
    assert outcome({"kind": "none"}, answer([], "no_gap")) == "right"
    assert outcome({"kind": "none"}, answer(["payload"], "effect")) == "another"
    assert outcome(heavy, answer(["payload"], "partly")) == "right"
    assert outcome(heavy, answer(["payload", "track_wear"], "effect")) == "another"
    assert outcome(heavy, answer(["track_wear"], "effect", ("payload",))) == "in_set"
    assert outcome(heavy, answer([], "unknown")) == "unknown"
    assert outcome(heavy, answer([], "no_gap")) == "no_gap"
    assert outcome({"kind": "track_tension", "tighter": 20.0}, answer([], "no_gap")) == "said_unseen"


def test_a_fault_is_as_strong_as_asked_for_in_what_no_clock_takes_away() -> None:
    from tracked_cases import FLOOR, amount_for, left_over

    t = np.arange(0, 5, 0.02)
    sound = np.outer(np.sin(3 * t), np.ones(9))
    late = -0.02 * np.gradient(sound, t, axis=0)
    assert np.abs(left_over(late, sound, t)).max() < 1e-6
    assert np.abs(left_over(10 * late, sound, t)).max() == pytest.approx(
        np.abs(17 / 2 * late / FLOOR).max(), rel=1e-6
    )  # 30 ms of 200 at most
    other = np.outer(np.sin(20 * t), FLOOR)
    assert np.sqrt(np.mean(left_over(other, sound, t) ** 2)) == pytest.approx(np.sqrt(0.5), rel=0.05)
    rising = np.array([1.0, 2.0, 4.0])  # at 0.2, 0.5 and 1 of the most
    assert [amount_for(rising, f) for f in (0.5, 1.5, 3.0, 9.0)] == pytest.approx([0.1, 0.35, 0.75, 1.0])


def test_every_effect_is_among_the_kinds_and_seeds_are_apart() -> None:
    from tracked_blind import SEEDS, STRENGTH
    from tracked_cases import KINDS, SEVERITIES

    from suspension_twin.effects.registry import EFFECTS

    # a clock's drift over the seconds of a run is the driver's speed
    known = {name for name, found in EFFECTS.items() if "tracked" in found.models} - {"clock_drift"}
    assert set(KINDS) - {"none"} == known == set(STRENGTH)
    assert SEVERITIES == (0.5, 1.5, 5.0)
    assert not set(SEEDS["development"]) & set(SEEDS["reporting"])


def test_what_is_kept_has_every_kind_at_every_severity() -> None:
    from tracked_blind import STRENGTH

    kept = json.loads((BENCHMARKS / "results" / "tracked_blind.json").read_text(encoding="utf-8"))[
        "reporting"
    ]
    asked = {(r["kind"], r["severity"]) for r in kept["rows"]}
    assert asked >= {(k, s) for k in kept["kinds"] if k != "none" for s in (0.5, 1.5, 5.0)}
    for row in kept["rows"]:  # what was done stands beside what was said of it
        assert row["kind"] == "none" or STRENGTH[row["kind"]] in row
        assert row["kind"] != "time_offset" or abs(row["offset"]) < 0.31
    assert kept["right"] == sum(r["outcome"] == "right" for r in kept["rows"])
