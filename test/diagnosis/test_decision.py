# SPDX-License-Identifier: Apache-2.0
"""The learnt decision: probabilities, signs, costs, candidate sets, and deciding anew from a file."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from suspension_twin.cli.main import main
from suspension_twin.diagnosis.answer import answer_of
from suspension_twin.diagnosis.decision import FEATURES, Costs, Weights, answers_of, decide, learnt
from suspension_twin.errors import InputError

PARAMETERS = {"strut_friction": ("front_force", "rear_force"), "payload": ("mass", "x", "y")}
SIZE = {"value": 200.0, "z": 0.5, "far": 0.5, "bound": False}
CHANNELS = ("vertical_acceleration", "pitch_rate")


def row(*effects: str, gain: float = 0.0, left: float = 1.0, decoy: bool = False) -> dict[str, Any]:
    """A hypothesis that gains so many nats and leaves this share of a gap of 0.4 of the motion."""
    shrink = 1.0 - left
    channel = {
        "before": 0.4,
        "after": 0.4 * left,
        "shrink": shrink,
        "low": shrink - 0.05,
        "high": shrink + 0.05,
        "worst": shrink,
        "fitted": True,
        "written": {"before": 0.5, "after": 0.4 * left, "shrink": 1 - 0.8 * left, "low": 0.0, "high": 0.9},
    }
    return {
        "effects": list(effects),
        "decoy": decoy,
        "tempered_gain": gain,
        "gain": 10.0 * gain,
        "gain_fitted": 11.0 * gain,
        "folds": 1.0 if gain > 0 else 0.5,
        "signs": 1.0,
        "level": 0.4 * left,
        "level_fitted": 0.4 * left,
        "mean_squares": dict.fromkeys(CHANNELS, 8.0 * left**2 + 1.0),
        "channels": {name: dict(channel) for name in CHANNELS},
        "parameters": {e: {p: dict(SIZE) for p in PARAMETERS.get(e, ("size",))} for e in effects},
        "added_low": shrink - 0.05,
        "usual": None,
        "where": ["strut"],
        "resonance": False,
        "undetectable": 0.0,
        "detectable": True,
        "tone": 0.0,
        "band": 1.0,
        "place": 0.0,
        "vehicle": {},
    }


def evidence(*rows: dict[str, Any], reference: bool = True) -> dict[str, Any]:
    """Evidence on a car whose gap is 0.4 of the motion, with hypotheses beside."""
    channel = {"noise": 0.02, "motion": 1.0, "gap": 0.5, "driven": True}
    return {
        "format": 1,
        "seed": 0,
        "twin": "gone.yaml",
        "case": {
            "kind": "road",
            "reference": reference,
            "level_on_reference": 0.1 if reference else None,
            "temper": 0.1,
            "channels": {name: dict(channel) for name in CHANNELS},
        },
        "base": row(),
        "hypotheses": list(rows),
    }


def others(count: int = 5) -> list[dict[str, Any]]:
    return [row(f"other_{i}", gain=0.1 * i) for i in range(count)]


def features(case: dict[str, Any], *causes: str) -> dict[str, float]:
    """What an answer is judged by."""
    (answer,) = (a for a in answers_of(case) if a.causes == causes)
    return dict(zip(FEATURES, answer.features.tolist(), strict=True))


@pytest.mark.parametrize("reference", [True, False])
@pytest.mark.parametrize("share", [1e-9, 0.25, 0.9, 1.0, 1.3])
def test_what_is_explained_is_a_share_of_a_large_residuals_mean_square(reference: bool, share: float) -> None:
    """Where the residual is far above the expected discrepancy."""
    level, square = 1e3, 1e7
    some = row("strut_friction", gain=3.0, left=0.5)
    some["level_fitted"] = level * np.sqrt(share)
    some["mean_squares"] = dict.fromkeys(CHANNELS, square * share)
    case = evidence(some, *others(), reference=reference)
    case["base"]["level_fitted"], case["base"]["mean_squares"] = level, dict.fromkeys(CHANNELS, square)
    found = features(case, "strut_friction")
    assert found["explained"] == pytest.approx(max(1.0 - share, 0.0), abs=1e-3)
    if share > 0.1:
        assert found["excess"] == pytest.approx(3.0 * (1.0 - found["explained"]), abs=1e-9)


@pytest.mark.parametrize("reference", [True, False])
def test_what_remains_is_judged_as_no_gap_would_be_and_by_the_share_that_is_not_explained(
    reference: bool,
) -> None:
    some = row("strut_friction", gain=30.0, left=0.6)
    case = evidence(some, *others(), reference=reference)
    alone = evidence(*others(), reference=reference)
    alone["base"] = some | {"effects": []}
    found, remaining = features(case, "strut_friction"), features(alone)["none_excess"]
    assert 0.2 < found["explained"] < 0.9 and remaining > 0.1
    assert found["excess"] == pytest.approx(remaining * (1.0 - found["explained"]))
    assert features(case, "unknown")["unknown_best_excess"] == pytest.approx(remaining)
    assert features(case, "unknown")["unknown_blind"] == float(not reference)
    noisy = deepcopy(case)
    for channel in noisy["case"]["channels"].values():
        channel["noise"] = 1.0
    assert features(noisy)["none_excess"] == features(noisy, "strut_friction")["excess"] == 0.0


@pytest.mark.parametrize("reference", [True, False])
def test_a_small_residual_counts_by_its_square(reference: bool) -> None:
    """Where it is far below the expected discrepancy."""
    some = row("strut_friction", gain=3.0, left=0.5)
    some["level_fitted"], some["mean_squares"] = 1e-3 * np.sqrt(0.5), dict.fromkeys(CHANNELS, 0.5e-4)
    case = evidence(some, *others(), reference=reference)
    case["base"]["level_fitted"], case["base"]["mean_squares"] = 1e-3, dict.fromkeys(CHANNELS, 1e-4)
    assert features(case, "strut_friction")["explained"] == pytest.approx(1.0 - 0.5**2, abs=1e-3)


def test_what_remains_counts_by_its_logarithm() -> None:
    case = evidence(*others())
    found = []
    for square in (4.2, 7.0):
        case["base"]["mean_squares"] = {"vertical_acceleration": square, "pitch_rate": 1.0}
        found.append(features(case)["none_excess"])
    assert found[1] - found[0] == pytest.approx(0.5 * np.log(7.0 / 4.2))


@pytest.mark.parametrize("left, above", [(0.1, 0.0), (0.25, 0.0), (0.5, np.log(2.0)), (1.0, np.log(4.0))])
def test_what_remains_is_compared_with_what_remains_on_the_reference(left: float, above: float) -> None:
    """The gap is 0.4 of the motion, and 0.1 of it remains on the reference."""
    rows = (row("strut_friction", gain=3.0, left=left), row("payload", gain=2.0, left=0.75))
    case = evidence(*rows)
    assert features(case, "strut_friction")["above_reference"] == pytest.approx(above)
    assert features(case)["none_above_reference"] == pytest.approx(np.log(4.0))
    least = min(above, np.log(3.0))
    assert features(case, "unknown")["unknown_above_reference"] == pytest.approx(least)
    alone = evidence(*rows, reference=False)
    assert features(alone, "strut_friction")["above_reference"] == 0.0
    assert features(alone)["none_above_reference"] == 0.0
    assert features(alone, "unknown")["unknown_above_reference"] == 0.0


def test_evidence_is_that_over_vehicles_with_and_without_what_was_there_before() -> None:
    some = row("payload", gain=2.0, left=0.5) | {"since": 1.5}
    case = evidence(some)
    case["base"]["since"] = 0.7
    wanted = np.log(np.exp(2.0) + np.exp(0.7 + 1.5)) - np.log(1.0 + np.exp(0.7))
    assert features(case, "payload")["gain"] == pytest.approx(np.arcsinh(wanted))


def test_a_sets_probability_is_shared_among_its_effects() -> None:
    rows = [row(e, gain=4.0, left=0.5) for e in ("payload", "strut_friction")]
    found = decide(evidence(row("payload", "strut_friction", gain=9.0, left=0.2), *rows))
    alone = {a.causes: p for a, p in zip(found.answers, found.probability, strict=True)}
    together = alone[("payload", "strut_friction")]
    assert found.effects["payload"] == pytest.approx(alone[("payload",)] + together / 2)
    assert sum(found.effects.values()) + found.no_gap + found.unknown == pytest.approx(1.0)


def test_a_set_is_compared_with_its_parts_and_a_cause_with_its_rivals() -> None:
    both = row("payload", "strut_friction", gain=9.0, left=0.2) | {"added_low": 0.3}
    single = (("payload", 2.0), ("strut_friction", 5.0), ("other", 7.0))
    rows = (both, *(row(effect, gain=gain, left=0.5) for effect, gain in single))
    case = evidence(*rows)
    found = {c: features(case, *c) for c in (("payload", "strut_friction"), ("strut_friction",), ("other",))}
    together, single, other = found.values()
    assert together["added"] == pytest.approx(np.arcsinh(9.0 - 5.0)) and together["added_proven"] == 0.3
    assert together["size"] == 1.0 and single["size"] == single["added"] == single["added_proven"] == 0.0
    assert together["margin"] == pytest.approx(np.arcsinh(9.0 - 7.0))
    assert single["margin"] == pytest.approx(np.arcsinh(5.0 - 7.0))  # a set that holds it is no rival
    assert other["margin"] == pytest.approx(np.arcsinh(7.0 - 9.0))
    assert single["gain"] == pytest.approx(np.arcsinh(5.0))
    assert {f["number"] for f in found.values()} == {np.log(3.0)}


def test_a_part_of_a_set_is_no_answer_of_its_own_without_a_road_and_nowhere_a_rival_of_the_set() -> None:
    both = row("payload", "strut_friction", gain=9.0, left=0.2) | {"added_low": 0.3}
    case = evidence(both, row("payload", gain=2.0), row("strut_friction", gain=5.0), row("other", gain=1.0))
    for kind, singles in (("road", 3), ("markers", 3), ("rig", 3), ("planar", 1)):
        case["case"]["kind"] = kind
        assert sum(len(a.causes) == 1 and a.row is not None for a in answers_of(case)) == singles, kind
        assert features(case, "payload", "strut_friction")["margin"] == pytest.approx(np.arcsinh(8.0))


def test_sizes_bounds_and_priors_of_the_parameters_count_by_the_worst_of_them() -> None:
    some = row("payload", gain=5.0, left=0.5) | {"usual": 0.5}
    some["parameters"]["payload"]["x"] |= {"far": 3.5}
    found = features(evidence(some, *others()), "payload")
    assert found["far"] == 1.5 and found["bound"] == 0.0
    assert found["usual"] == pytest.approx(np.log(1.5 / 0.5))
    some["parameters"]["payload"]["y"] |= {"bound": True}
    some["usual"] = 2.0
    found = features(evidence(some, *others()), "payload")
    assert found["bound"] == 1.0 and found["usual"] == 0.0
    for none in (1e-9, 0.0):
        assert features(evidence(some | {"usual": none}, *others()), "payload")["usual"] == 3.0
    assert features(evidence(some | {"usual": 0.4}, *others()), "payload")["usual"] == pytest.approx(
        np.log(1.5 / 0.4)
    )


def test_a_gap_that_grows_elsewhere_counts_where_it_is_above_the_noise() -> None:
    some = row("payload", gain=5.0, left=0.5)
    some["channels"]["pitch_rate"] |= {"worst": -0.7}
    assert features(evidence(some), "payload")["lost"] == pytest.approx(0.7)
    for quiet in ({"before": 0.019, "after": 0.02}, {"worst": None}, {"worst": 0.4}):
        silent = deepcopy(some)
        silent["channels"]["pitch_rate"] |= quiet
        assert features(evidence(silent), "payload")["lost"] == 0.0
    some["channels"]["vertical_acceleration"] |= {"worst": -9.0}
    assert features(evidence(some), "payload")["lost"] == 2.0


def test_tones_places_and_clocks_speak_against_no_gap() -> None:
    case = evidence(*others())
    case["base"] |= {"tone": 30.0, "band": 2.7, "place": 0.27 * 2.0}
    assert features(case)["none_pattern"] == pytest.approx(np.log(3.0) + np.log(2.0))
    case["base"] |= {"tone": 1e6}
    assert features(case)["none_pattern"] == pytest.approx(1.5 + np.log(2.0))
    case["base"] |= {"band": 0.0, "place": 0.0}
    assert features(case)["none_pattern"] == 1.5
    assert features(case)["none_clocks"] == 0.0
    case["base"] |= {"clocks": 2.5, "clocks_by_chance": 1e-2}
    assert features(case)["none_clocks"] == pytest.approx(0.5)
    case["base"] |= {"clocks": 7.0, "clocks_by_chance": 0.1}
    assert features(case)["none_clocks"] == pytest.approx(0.5)
    case["base"] |= {"clocks": 2.0}
    assert features(case)["none_clocks"] == 0.0


@pytest.mark.parametrize(
    ("said", "true", "cost"),
    [
        (("a",), ("a",), 0.0),
        (("unknown",), ("a",), 3.0),
        ((), ("a",), 2.0),
        (("a",), (), 5.0),
        (("a",), ("b",), 5.0),
        (("a",), ("a", "b"), 0.25),
        (("a", "b", "c"), ("a",), 0.5),
    ],
)
def test_what_a_verdict_costs(said: tuple[str, ...], true: tuple[str, ...], cost: float) -> None:
    assert Costs(wrong=5.0, missed=2.0, unknown=3.0, vague=0.25).of(said, true) == cost


@pytest.mark.parametrize("reference", [True, False])
def test_what_closes_the_gap_and_gains_far_more_than_all_others_is_named(reference: bool) -> None:
    found = decide(evidence(row("strut_friction", gain=60.0, left=0.2), *others(), reference=reference))
    assert found.chosen == ("strut_friction",) and found.candidates[0] == ("strut_friction",)
    assert answer_of(evidence(*others()), decide(evidence(*others())))["combination"] == []


def test_a_residual_that_nothing_explains_is_unknown_and_a_usual_one_no_gap() -> None:
    assert decide(evidence(*others())).chosen == ("unknown",)
    sound = evidence(*others())
    sound["base"] = row(left=0.25)
    sound["base"]["mean_squares"] = dict.fromkeys(CHANNELS, 1.2)
    assert decide(sound).chosen == ()


def test_no_cause_is_named_whose_shrink_may_be_none() -> None:
    sure = row("strut_friction", gain=60.0, left=0.2)
    for channel in sure["channels"].values():
        channel["low"] = -0.01
    found = decide(evidence(sure, *others()))
    assert found.chosen in ((), ("unknown",))


@given(
    st.lists(st.floats(-5.0, 200.0), min_size=1, max_size=8),
    st.lists(st.floats(0.0, 1.5), min_size=8, max_size=8),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_probabilities_are_ones_whatever_the_weights(
    gains: list[float], left: list[float], reference: bool, seed: int
) -> None:
    rows = [row(f"e{i}", gain=g, left=share) for i, (g, share) in enumerate(zip(gains, left, strict=False))]
    rows.append(row("shape", gain=3.0, left=0.6, decoy=True))
    given = evidence(*rows, reference=reference)
    weights = Weights(np.random.default_rng(seed).normal(size=len(FEATURES)), 0.1, {})
    for known in (None, weights):
        found = decide(given, weights=known)
        total = sum(found.effects.values()) + found.no_gap + found.unknown
        assert total == pytest.approx(1.0) and min(found.effects.values()) >= 0.0
        assert found.candidates


def test_no_set_is_named_whose_member_may_add_nothing() -> None:
    both = row("strut_friction", "payload", gain=90.0, left=0.2)
    rows = (row("strut_friction", gain=20.0, left=0.7), row("payload", gain=15.0, left=0.75), both, *others())
    assert len(decide(evidence(*rows)).chosen) == 2
    both["added_low"] = -0.01
    assert len(decide(evidence(*rows)).chosen) < 2


@given(st.floats(0.0, 100.0), st.floats(0.0, 50.0), st.booleans())
def test_more_evidence_makes_no_cause_less_probable(gain: float, more: float, reference: bool) -> None:
    def p(nats: float) -> float:
        rows = (row("strut_friction", gain=nats, left=0.4), *others())
        return decide(evidence(*rows, reference=reference)).effects["strut_friction"]

    assert p(gain + more) >= p(gain) - 1e-9


def test_weights_have_the_signs_that_physics_dictates_and_say_where_they_come_from() -> None:
    known = learnt()
    assert len(FEATURES) <= 40
    for value, (name, sign) in zip(known.values, FEATURES.items(), strict=True):
        assert sign == 0.0 or value * sign >= 0.0, name
    assert 0.0 < known.conformal < 0.5
    assert {"cases", "commit", "seeds", "evidence_sha256"} <= set(known.source)


def test_costs_decide_what_is_said() -> None:
    given = evidence(row("strut_friction", gain=6.0, left=0.5), *others())
    p = decide(given).effects["strut_friction"]
    assert 0.02 < p < 0.999
    assert decide(given, Costs(wrong=1e6)).chosen in ((), ("unknown",))
    assert decide(given, Costs(wrong=0.0, missed=1.0, unknown=1.0)).chosen == ("strut_friction",)
    assert Costs.parsed("wrong=10, vague=0.1") == Costs(wrong=10.0, vague=0.1)
    assert Costs.parsed("") == Costs()
    for text, word in (
        ("wrng=1", "wrng"),
        ("wrong=x", "'x'"),
        ("wrong=-1", "at least 0"),
        ("missed=nan", "at least 0"),
    ):
        with pytest.raises(InputError, match=word):
            Costs.parsed(text)


def test_part_of_a_set_is_vague_and_not_wrong() -> None:
    costs = Costs(wrong=4.0, vague=0.5)
    assert costs.of(("a",), ("a", "b")) == 0.5 and costs.of(("a", "b"), ("a",)) == 0.5
    assert costs.of(("a", "c"), ("a", "b")) == 1.0
    assert costs.of(("c",), ("a", "b")) == costs.of(("a",), ()) == costs.of(("a",), ("unknown",)) == 4.0
    assert costs.of(("a",), ("a",)) == costs.of((), ()) == 0.0


def test_a_set_is_named_where_both_of_its_effects_are_needed() -> None:
    one, two = row("strut_friction", gain=20.0, left=0.7), row("payload", gain=15.0, left=0.75)
    both = row("strut_friction", "payload", gain=70.0, left=0.2)
    found = decide(evidence(one, two, both, *others()))
    assert found.chosen == ("payload", "strut_friction")
    assert found.effects["payload"] == pytest.approx(found.effects["strut_friction"], rel=0.2)
    idle = row("strut_friction", "payload", gain=20.3, left=0.699)
    assert decide(evidence(row("strut_friction", gain=20.0, left=0.2), two, idle, *others())).chosen == (
        "strut_friction",
    )


def test_half_of_the_residual_that_stays_is_partly() -> None:
    for left, verdict in ((0.2, "effect"), (0.8, "partly")):
        rows = evidence(row("strut_friction", gain=200.0, left=left), *others())
        document = answer_of(rows, decide(rows, Costs(wrong=0.1)))
        assert document["verdict"] == verdict, left
        assert document["causes"][0]["channel"] in CHANNELS
        assert document["probability"] > 0.5


def test_evidence_of_another_format_is_refused() -> None:
    with pytest.raises(InputError, match="format 0"):
        answers_of({**evidence(*others()), "format": 0})


def test_a_kept_diagnosis_is_decided_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = evidence(row("strut_friction", gain=60.0, left=0.2), *others())
    before = answer_of(kept, decide(kept))
    before |= {"where": {"time": []}, "warnings": ["short"], "next_experiment": "Drive a bump.", "seed": 0}
    (tmp_path / "evidence.json").write_text(json.dumps(kept))
    (tmp_path / "diagnosis.json").write_text(json.dumps(before))
    assert main(["diagnose", "--from-evidence", str(tmp_path), "--out", str(tmp_path / "anew")]) == 0
    anew = json.loads((tmp_path / "anew" / "diagnosis.json").read_text())
    assert anew == {**deepcopy(before), "message": anew["message"]}
    assert "strut friction" in capsys.readouterr().out.lower().replace("_", " ")
    assert main(["diagnose", "--from-evidence", str(tmp_path), "--costs", "wrong=1e9"]) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("No cause is certain enough to be named")
    assert main(["diagnose", "--from-evidence", str(tmp_path / "nowhere")]) == 2
    assert "evidence.json" in capsys.readouterr().err
    (tmp_path / "evidence.json").write_text("{")
    assert main(["diagnose", "--from-evidence", str(tmp_path)]) == 2
    assert main(["diagnose", "--from-evidence", str(tmp_path), "--twin", "twin.yaml"]) == 2
