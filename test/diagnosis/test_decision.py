# SPDX-License-Identifier: Apache-2.0
"""The learnt decision: probabilities, signs, costs, candidate sets, and deciding anew from a file."""

from __future__ import annotations

import json
from collections.abc import Iterable
from copy import deepcopy
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.cli.main import main
from suspension_twin.diagnosis.answer import answer_of, hand_on
from suspension_twin.diagnosis.decision import (
    FEATURES,
    USES,
    Costs,
    Weights,
    answers_of,
    decide,
    learnt,
    prior_means,
    usual_level,
)
from suspension_twin.errors import InputError
from suspension_twin.files import together
from suspension_twin.vehicle.twin import RoadFile, Twin, load_twin, save_twin

PARAMETERS = {"strut_friction": ("front_force", "rear_force"), "payload": ("mass", "x", "y")}
SIZE = {"value": 200.0, "far": 0.5, "bound": False}
CHANNELS = ("vertical_acceleration", "pitch_rate")


def row(*effects: str, gain: float = 0.0, left: float = 1.0, decoy: bool = False) -> dict[str, Any]:
    """Row of a hypothesis with a tempered gain in nats that leaves a share of a gap of 0.4 of the motion."""
    shrink = 1.0 - left
    channel = {
        "before": 0.4,
        "after": 0.4 * left,
        "shrink": shrink,
        "low": shrink - 0.05,
        "high": shrink + 0.05,
        "worst": shrink,
        "written": {"before": 0.5, "after": 0.4 * left, "shrink": 1 - 0.8 * left, "low": 0.0, "high": 0.9},
    }
    return {
        "effects": list(effects),
        "decoy": decoy,
        "tempered_gain": gain,
        "gain": 10.0 * gain,
        "gain_fitted": 11.0 * gain,
        "level": 0.4 * left,
        "level_fitted": 0.4 * left,
        "mean_squares": dict.fromkeys(CHANNELS, 8.0 * left**2 + 1.0),
        "channels": {name: dict(channel) for name in CHANNELS},
        "parameters": {e: {p: dict(SIZE) for p in PARAMETERS.get(e, ("size",))} for e in effects},
        "added_low": shrink - 0.05,
        "usual": None,
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
    """Features of an answer."""
    (answer,) = (a for a in answers_of(case) if a.causes == causes)
    return dict(zip(FEATURES, answer.features.tolist(), strict=True))


@pytest.mark.parametrize("reference", [True, False])
@pytest.mark.parametrize("share", [1e-9, 0.25, 0.9, 1.0, 1.3])
def test_explained_is_a_share_of_the_mean_square_of_a_large_residual(reference: bool, share: float) -> None:
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
def test_excess_of_a_cause_is_that_of_no_gap_times_the_unexplained_share(
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


def test_the_remaining_residual_counts_by_its_logarithm() -> None:
    case = evidence(*others())
    found = []
    for square in (4.2, 7.0):
        case["base"]["mean_squares"] = {"vertical_acceleration": square, "pitch_rate": 1.0}
        found.append(features(case)["none_excess"])
    assert found[1] - found[0] == pytest.approx(0.5 * np.log(7.0 / 4.2))


@pytest.mark.parametrize("left, above", [(0.1, 0.0), (0.25, 0.0), (0.5, np.log(2.0)), (1.0, np.log(4.0))])
def test_the_remaining_residual_is_compared_with_that_on_the_reference(left: float, above: float) -> None:
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


def test_evidence_is_marginal_over_vehicles_with_and_without_pre_existing_effects() -> None:
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


def test_evidence_beside_usual_errors_is_at_most_the_plain_one_and_that_where_nothing_was_linearised() -> (
    None
):
    rows = (
        row("payload", gain=9.0) | {"beside": -2.0},
        row("other", gain=5.0),
        row("third", gain=1.0) | {"beside": 7.0},
    )
    found = {c: features(evidence(*rows), c) for c in ("payload", "other", "third")}
    assert [f["beside"] for f in found.values()] == pytest.approx(np.arcsinh([-2.0, 5.0, 1.0]))
    assert [f["beside_margin"] for f in found.values()] == pytest.approx(np.arcsinh([-7.0, 4.0, -4.0]))
    assert [f["gain"] for f in found.values()] == pytest.approx(np.arcsinh([9.0, 5.0, 1.0]))


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
    ("costs", "least"),
    [
        (Costs(), 0.8),
        (Costs(wrong=1.0), 0.5),
        (Costs(wrong=19.0), 0.95),
        (Costs(wrong=0.0), 0.0),
        (Costs(wrong=3.0, unknown=0.0), 1.0),
    ],
)
def test_a_cause_is_sure_where_a_wrong_name_is_expected_to_cost_no_more_than_one_kept_back(
    costs: Costs, least: float
) -> None:
    assert costs.sure == pytest.approx(least)
    if 0.0 < least < 1.0:
        assert (1.0 - least) * costs.wrong == pytest.approx(least * costs.unknown)


def test_no_gap_is_said_where_it_is_expected_to_cost_less_than_unknown() -> None:
    costs = Costs()
    assert costs.nothing(0.5, 0.5) and costs.nothing(0.6, 0.3)
    assert not costs.nothing(0.23, 0.22)  # three of four that something is wrong
    assert costs.nothing(0.45, 0.10) and not costs.nothing(0.45, 0.55)  # "unknown" is half right of a cause
    assert not Costs(missed=2.0).nothing(0.5, 0.5)


def test_uses_have_costs_of_their_own() -> None:
    assert {name: Costs.parsed(f" {name} ").sure for name in USES} == {"workshop": 0.5, "release": 0.95}


@pytest.mark.parametrize("reference", [True, False])
def test_an_effect_that_closes_the_gap_and_gains_far_more_than_all_others_is_named(reference: bool) -> None:
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
    for value, name, sign in zip(known.values, FEATURES, prior_means(), strict=True):
        assert sign == 0.0 or value * sign >= 0.0, name
    assert 0.0 < known.conformal < 0.5
    assert {"cases", "commit", "seeds", "evidence_sha256"} <= set(known.source)


def test_costs_decide_what_is_said() -> None:
    given = evidence(row("strut_friction", gain=6.0, left=0.5), *others())
    p = decide(given).effects["strut_friction"]
    assert 0.02 < p < 0.999
    careful = decide(given, Costs(wrong=1e6))
    assert not careful.sure and (careful.chosen == ("strut_friction",)) == (
        p > max(careful.no_gap, careful.unknown)
    )
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
    printed = capsys.readouterr().out
    assert "dry friction in the struts" in printed and "strut_friction" not in printed
    assert main(["diagnose", "--from-evidence", str(tmp_path), "--costs", "wrong=1e9"]) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("Probably (more than 99 %): the struts")
    assert main(["diagnose", "--from-evidence", str(tmp_path / "nowhere")]) == 2
    assert "evidence.json" in capsys.readouterr().err
    (tmp_path / "evidence.json").write_text("{")
    assert main(["diagnose", "--from-evidence", str(tmp_path)]) == 2
    assert main(["diagnose", "--from-evidence", str(tmp_path), "--twin", "twin.yaml"]) == 2


# -- every feature by the formula of its table, between its limits and at them --------------------------------------

#: Of docs/numbers.md: residual of cars without any fault, and the severity up to which an effect is as small as errors
#: of twin files are.
SQUARE, LEVEL, TONE, BAND, PLACE, RATIO = 1.5, 0.14, 10.0, 2.7, 0.27, 1.5
#: Features that raise and that lower the probability of an answer; the sign for a car without a reference is free.
FOR = {
    "gain", "margin", "beside", "beside_margin", "shrink", "proven", "throughout", "tone", "explained", "complete",
    "added", "added_proven",
    "unknown_best_excess", "unknown_above_reference", "unknown_open",
}  # fmt: skip
AGAINST = {
    "number", "chance", "excess", "above_reference", "lost", "usual", "far", "bound", "size", "none_excess",
    "none_above_reference", "none_gain", "none_pattern", "none_clocks", "unknown",
}  # fmt: skip


def cause(*effects: str, gain: float = 3.0, left: float = 0.5, **changes: Any) -> dict[str, Any]:
    return row(*effects, gain=gain, left=left) | changes


def in_three_channels(*rows: dict[str, Any], reference: bool = True) -> dict[str, Any]:
    """Evidence with a third channel, which no road drives and in which all values differ."""
    case = evidence(*rows, reference=reference)
    case["case"]["channels"]["roll_rate"] = {"noise": 0.02, "motion": 9.0, "gap": 0.5, "driven": False}
    for one in (case["base"], *rows):
        one["mean_squares"] = {**one["mean_squares"], "roll_rate": 1e3}
        one["channels"]["roll_rate"] = {
            **one["channels"]["pitch_rate"],
            "before": 9.0, "after": 9.0, "shrink": -0.9, "low": -0.95, "high": -0.85, "worst": None,
        }  # fmt: skip
    return case


def of_channels(one: dict[str, Any], key: str, values: Iterable[float]) -> dict[str, Any]:
    """The hypothesis with these values in its channels."""
    changed = deepcopy(one)
    for channel, value in zip(changed["channels"].values(), values, strict=True):
        channel[key] = value
    return changed


def unknown(case: dict[str, Any]) -> dict[str, float]:
    """Features of unknown itself, not of the decoys that mean it too."""
    (answer,) = (a for a in answers_of(case) if a.causes == ("unknown",) and a.row is None)
    return dict(zip(FEATURES, answer.features.tolist(), strict=True))


def test_every_feature_speaks_for_or_against_an_answer() -> None:
    priors = dict(zip(FEATURES, prior_means(), strict=True))
    assert {name for name, prior in priors.items() if prior > 0.0} == FOR
    assert {name for name, prior in priors.items() if prior < 0.0} == AGAINST
    assert {name for name, prior in priors.items() if prior == 0.0} == {"unknown_blind"}


def test_weights_are_those_of_the_file_by_name() -> None:
    folder = resources.files("suspension_twin.diagnosis")
    kept = json.loads((folder / "decision.json").read_text(encoding="utf-8"))
    assert dict(zip(FEATURES, learnt().values.tolist(), strict=True)) == kept["weights"]
    assert learnt().conformal == kept["conformal_probability"] and learnt().source == kept["source"]


def test_features_of_one_kind_of_answer_are_zero_for_the_others() -> None:
    case = evidence(cause("payload", "strut_friction"), cause("payload"), cause("strut_friction"))
    of_unknown = {name for name in FEATURES if name.startswith("unknown")}
    of_none = {name for name in FEATURES if name.startswith("none")}
    of_cause = set(FEATURES) - of_unknown - of_none
    assert not any(features(case)[name] for name in of_cause | of_unknown)
    assert not any(unknown(case)[name] for name in of_cause | of_none) and unknown(case)["unknown"] == 1.0
    for causes in (("payload",), ("payload", "strut_friction")):
        assert not any(features(case, *causes)[name] for name in of_none | of_unknown)


def test_no_gap_and_unknown_are_answers_whatever_was_tried() -> None:
    found = decide(evidence())
    assert [a.causes for a in found.answers] == [(), ("unknown",)]
    assert all(a.row is None for a in found.answers) and found.effects == {} and found.row is None
    assert features(evidence())["none_gain"] == unknown(evidence())["unknown_open"] == 0.0
    assert unknown(evidence())["unknown_above_reference"] == pytest.approx(np.log(4.0))  # of the twin itself


def test_the_prior_is_shared_among_the_effects_of_the_library() -> None:
    both, shape = cause("payload", "strut_friction"), row("shape", decoy=True)
    rows = [both, shape, *(cause(e) for e in ("payload", "strut_friction", "other"))]
    case = evidence(*rows)
    assert features(case, "other")["number"] == pytest.approx(np.log(3.0))
    for library, number in ((2, 3), (3, 3), (17, 17)):
        case["case"]["library"] = library
        assert features(case, "other")["number"] == pytest.approx(np.log(number)), library
    (alone,) = (a for a in answers_of(evidence(shape)) if a.row is not None)
    assert alone.features[list(FEATURES).index("number")] == 0.0  # of at least one


@pytest.mark.parametrize("gain", [-40.0, -0.3, 0.0, 0.2, 7.0, 900.0])
def test_gains_count_in_proportion_when_small_and_by_their_logarithm_when_large(gain: float) -> None:
    found = features(evidence(cause("payload", gain=gain)), "payload")["gain"]
    assert found == pytest.approx(np.log(gain + np.sqrt(gain**2 + 1.0)), abs=1e-9)


def test_evidence_counts_beyond_pre_existing_effects_only_where_these_are_known() -> None:
    def nats(base: float | None, **own: Any) -> float:
        case = evidence(cause("payload", gain=2.0, **own))
        case["base"]["since"] = base
        return float(np.sinh(features(case, "payload")["gain"]))

    assert nats(None, since=5.0) == pytest.approx(2.0)
    for own in ({}, {"since": None}, {"since": 0.0}):
        wanted = np.log(np.exp(2.0) + np.exp(0.7)) - np.log(1.0 + np.exp(0.7))
        assert nats(0.7, **own) == pytest.approx(wanted)


def test_a_margin_is_over_the_best_rival_or_over_none() -> None:
    """Sets that share a member are rivals; one that holds or is held is none."""
    both, wide = cause("a", "b", gain=9.0), cause("a", "b", "c", gain=30.0)
    rows = [both, wide, cause("b", "c", gain=12.0), cause("a", gain=4.0), cause("b", gain=6.0), cause("c")]
    case = evidence(*rows)
    for causes, margin in (
        (("a", "b"), 9.0 - 12.0),
        (("a", "b", "c"), 30.0),
        (("b", "c"), 12.0 - 9.0),
        (("a",), 4.0 - 12.0),
        (("b",), 6.0 - 4.0),
        (("c",), 3.0 - 9.0),
    ):
        assert features(case, *causes)["margin"] == pytest.approx(np.arcsinh(margin)), causes
    worse = evidence(cause("a", gain=2.0), cause("b", gain=-5.0))
    assert features(worse, "a")["margin"] == pytest.approx(np.arcsinh(2.0))
    assert features(worse, "b")["margin"] == pytest.approx(np.arcsinh(-5.0 - 2.0))
    assert features(evidence(cause("a", gain=0.4)), "a")["margin"] == pytest.approx(np.arcsinh(0.4))


def test_evidence_added_by_a_set_is_over_its_best_part_or_over_nothing() -> None:
    def added(*rows: dict[str, Any]) -> float:
        return float(np.sinh(features(evidence(*rows), "a", "b", "c")["added"]))

    whole = cause("a", "b", "c", gain=30.0)
    parts = [cause("a", gain=5.0), cause("a", "c", gain=12.0), cause("b", gain=7.0)]
    assert added(whole, *parts, cause("d", gain=29.0), cause("c", "d", gain=28.0)) == pytest.approx(18.0)
    assert added(whole, parts[0], parts[2]) == pytest.approx(23.0)
    assert added(whole, cause("a", gain=-4.0)) == added(whole) == pytest.approx(30.0)


@pytest.mark.parametrize(("added_low", "proven"), [(0.05, 0.05), (0.9, 0.9), (1.7, 1.0)])
def test_lower_end_of_the_shrink_that_each_effect_of_a_set_adds(added_low: float, proven: float) -> None:
    case = evidence(cause("a", "b", added_low=added_low), cause("a", added_low=0.4))
    assert features(case, "a", "b")["added_proven"] == pytest.approx(proven)
    assert features(case, "a")["added_proven"] == features(case, "a")["added"] == 0.0


@pytest.mark.parametrize("kind", ["road", "markers", "rig", "planar"])
def test_effects_beyond_the_first_count_but_for_set_up_errors(kind: str) -> None:
    """As they are read from a file."""
    case = evidence(cause("a", "b", "c"), cause("b", "d"), cause("d"))
    case["case"]["kind"] = kind
    case = json.loads(json.dumps(case))
    on_road = kind != "planar"
    assert features(case, "a", "b", "c")["size"] == 2.0 * on_road
    assert features(case, "b", "d")["size"] == 1.0 * on_road
    assert any(a.causes == ("d",) for a in answers_of(case)) == on_road


def test_of_set_up_errors_only_sets_that_no_larger_one_holds_are_answers() -> None:
    rows = [cause(*name) for name in ("a", "b", "c", "ab", "bc", "abd", "e")]
    refused = cause("c", "e", added_low=-0.1)  # holds c and e, and is no answer itself
    case = evidence(*rows, refused)
    case["case"]["kind"] = "planar"
    found = [a.causes for a in answers_of(case) if a.row is not None]
    assert found == [("b", "c"), ("a", "b", "d"), ("e",)]
    assert set(decide(case).effects) == set("abcde")


@pytest.mark.parametrize(
    ("changes", "answers"),
    [
        ({"added_low": 0.0}, False),
        ({"added_low": 1e-6}, True),
        ({"usual": RATIO}, False),  # up to which it is as small as errors of twin files
        ({"usual": RATIO + 1e-6}, True),
        ({"usual": None}, True),
        ({"usual": 9.0, "added_low": -0.2}, False),
    ],
)
def test_a_set_is_an_answer_if_each_member_adds_and_it_is_larger_than_usual_errors(
    changes: dict[str, Any], answers: bool
) -> None:
    both = cause("strut_friction", "payload") | changes
    single = cause("payload", added_low=-0.2, usual=0.1)  # a single effect always is
    found = [a.causes for a in answers_of(evidence(both, single))]
    assert (("payload", "strut_friction") in found) == answers and ("payload",) in found
    assert set(decide(evidence(both, single)).effects) == {"payload"} | (
        {"strut_friction"} if answers else set()
    )


@pytest.mark.parametrize(
    ("shrinks", "best", "worst"),
    [((0.3, 0.7, 0.9), 0.7, 0.3), ((-0.2, -0.6, 0.9), 0.0, -0.6), ((1.4, 1.2, 0.0), 1.0, 1.0)],
)
def test_shrinks_count_in_the_driven_channels(shrinks: tuple[float, ...], best: float, worst: float) -> None:
    """The best and, of the lower ends, the worst; what is proven may be so in any channel."""
    case = in_three_channels(cause("payload"))
    case["hypotheses"] = [of_channels(case["hypotheses"][0], "shrink", shrinks)]
    assert features(case, "payload")["shrink"] == pytest.approx(best)
    case["hypotheses"] = [of_channels(case["hypotheses"][0], "low", shrinks)]
    found = features(case, "payload")
    assert found["throughout"] == pytest.approx(worst)
    assert found["proven"] == pytest.approx(min(max(shrinks), 1.0))


def test_without_a_driven_channel_nothing_shrinks_and_the_proven_shrink_has_limits() -> None:
    case = in_three_channels(cause("payload"))
    del case["case"]["channels"]["vertical_acceleration"], case["case"]["channels"]["pitch_rate"]
    for one in (case["base"], *case["hypotheses"]):
        one["channels"] = {"roll_rate": one["channels"]["roll_rate"] | {"shrink": 0.9, "low": 0.8}}
        one["mean_squares"] = {"roll_rate": one["mean_squares"]["roll_rate"]}
    case["case"]["reference"] = False  # of whose drives a channel that is driven would be compared
    found = features(case, "payload")
    assert found["shrink"] == found["throughout"] == found["lost"] == 0.0 and found["proven"] == 0.8
    case["hypotheses"][0]["channels"]["roll_rate"]["low"] = -0.3
    assert features(case, "payload")["proven"] == 0.0
    low = in_three_channels(cause("payload"))
    low["hypotheses"] = [of_channels(low["hypotheses"][0], "low", (-1.7, 0.5, 0.0))]
    assert features(low, "payload")["throughout"] == -1.0


@pytest.mark.parametrize(
    ("gain", "fitted", "lost"),
    [
        (8.0, 10.0, 0.2),
        (12.0, 10.0, 0.0),
        (-3.0, 10.0, 1.3),
        (-40.0, 10.0, 2.0),
        (0.0, 0.0, 1.0),
        (1.0, -5.0, 0.0),
        (-1.0, -5.0, 2.0),
    ],
)
def test_the_share_of_a_gain_that_is_lost_on_held_out_road_is_chance(
    gain: float, fitted: float, lost: float
) -> None:
    case = evidence(cause("payload") | {"gain": gain, "gain_fitted": fitted})
    assert features(case, "payload")["chance"] == pytest.approx(lost)


@pytest.mark.parametrize(
    ("before", "after", "fall"),
    [
        (40.0, 20.0, np.log(2.0)),
        (40.0, 3.0, np.log(4.0)),  # as far as it is above those of model discrepancy
        (1e4, 20.0, 2.0),
        (20.0, 40.0, 0.0),
        (9.0, 3.0, 0.0),
        (0.0, 0.0, 0.0),
        (25.0, 10.0, np.log(2.5)),
        (12.0, 11.0, np.log(12.0 / 11.0)),
    ],
)
def test_fall_of_the_strongest_tone(before: float, after: float, fall: float) -> None:
    case = evidence(cause("payload", tone=after))
    case["base"]["tone"] = before
    assert features(case, "payload")["tone"] == pytest.approx(fall)
    for one in (case["base"], case["hypotheses"][0]):
        silent = one.pop("tone")
        assert features(case, "payload")["tone"] == 0.0  # where either has none
        one["tone"] = silent


def test_patterns_and_clocks_that_were_not_evaluated_are_zero() -> None:
    case = evidence(*others())
    del case["base"]["tone"]
    case["base"] |= {"band": 1e3, "place": 1.0}
    assert features(case)["none_pattern"] == features(case)["none_clocks"] == 0.0


@pytest.mark.parametrize("name", ["tone", "band", "place"])
def test_each_pattern_counts_above_that_of_model_discrepancy(name: str) -> None:
    usual = {"tone": TONE, "band": BAND, "place": PLACE}
    case = evidence(*others())
    for share, over in ((0.0, 0.0), (0.9, 0.0), (1.0, 0.0), (2.0, np.log(2.0)), (1e3, 1.5)):
        case["base"] |= {other: 0.5 * value for other, value in usual.items()} | {name: share * usual[name]}
        assert features(case)["none_pattern"] == pytest.approx(over), share


@pytest.mark.parametrize(
    ("clocks", "chance", "speaks"),
    [
        (1.0, 1e-9, 0.0),
        (2.25, 1e-9, 0.25),
        (3.0, 1e-9, 1.0),
        (9.0, 1e-9, 1.0),
        (3.0, 1e-1, 0.5),
        (2.5, 1e-1, 0.25),
        (3.0, 1.0, 0.0),
        (3.0, 10.0, 0.0),
        (3.0, 0.0, 1.0),
    ],
)
def test_clocks_near_their_bounds_that_are_so_by_chance(clocks: float, chance: float, speaks: float) -> None:
    case = evidence(*others())
    case["base"] |= {"clocks": clocks, "clocks_by_chance": chance}
    assert features(case)["none_clocks"] == pytest.approx(speaks)


@pytest.mark.parametrize(
    ("level", "motion", "noise", "left"),
    [
        (LEVEL, 1.0, 1e-6, 0.0),
        (0.1, 1.0, 1e-6, 0.0),
        (2.0 * LEVEL, 1.0, 1e-6, np.log(2.0)),
        (100.0, 1.0, 1e-6, 3.0),
        (0.5, 3.0, 0.6, np.log(0.5 * 3.0 / 1.2)),  # over the noise
        (0.5, 0.2, 0.06, 0.0),
        (0.0, 1e9, 1e-6, 0.0),
    ],
)
def test_excess_without_a_reference(level: float, motion: float, noise: float, left: float) -> None:
    """Over what a complete model leaves and over twice the noise, whichever is less; of the first channel."""
    case = evidence(reference=False)
    case["base"]["level_fitted"] = level
    case["case"]["channels"]["vertical_acceleration"] |= {"motion": motion, "noise": noise}
    case["case"]["channels"]["pitch_rate"] |= {"motion": 70.0, "noise": 7e-9}
    assert features(case)["none_excess"] == pytest.approx(left)
    if left:
        assert usual_level(case["case"]) == LEVEL


@pytest.mark.parametrize(
    ("squares", "level", "left"),
    [
        ((6.0, 3.0, 1e3), 0.4, 0.5 * np.log(6.0 / SQUARE)),
        ((3.0, 6.0, 1e3), 0.4, 0.5 * np.log(6.0 / SQUARE)),
        ((1.4, 1.2, 1e3), 0.4, 0.0),
        ((1e9, 1.0, 0.1), 1e4, 3.0),
        ((1e9, 1.0, 0.1), 0.1, np.log(0.1 * 1.5 / 0.1)),  # over the noise
        ((1e9, 1.0, 0.1), 0.01, 0.0),
    ],
)
def test_excess_with_a_reference(squares: tuple[float, ...], level: float, left: float) -> None:
    """In units of the noise model of the reference, in the worst driven channel."""
    case = in_three_channels()
    case["case"]["channels"]["vertical_acceleration"] |= {"motion": 1.5, "noise": 0.05}
    case["base"]["mean_squares"] = dict(zip((*CHANNELS, "roll_rate"), squares, strict=True))
    case["base"]["level_fitted"] = level
    assert features(case)["none_excess"] == pytest.approx(left)
    assert usual_level(case["case"]) == 0.1


def explained_and_complete(case: dict[str, Any]) -> tuple[float, float]:
    found = features(case, "payload")
    return found["explained"], found["complete"]


def test_explained_and_complete_with_a_reference() -> None:
    """Of the mean squares of the driven channels; levels do not count."""
    some, other = cause("payload", level_fitted=77.0), cause("other", level_fitted=1e-9)
    case = in_three_channels(some, other)
    of = {"base": (8.0, 5.0, 1e3), "some": (2.0, 4.0, 9e3), "other": (1.0, 1.5, 7.0)}
    for one, name in ((case["base"], "base"), (some, "some"), (other, "other")):
        one["mean_squares"] = dict(zip((*CHANNELS, "roll_rate"), of[name], strict=True))
    beyond = {n: sum(m**2 / (m + SQUARE) for m in squares[:2]) for n, squares in of.items()}
    explained, complete = explained_and_complete(case)
    assert explained == pytest.approx(1.0 - beyond["some"] / beyond["base"])
    assert complete == pytest.approx((13.0 - 6.0) / (13.0 - 2.5))
    assert features(case, "other")["complete"] == pytest.approx(1.0)


def test_explained_and_complete_without_a_reference() -> None:
    """Of the square of the residual as a share of the motion; mean squares do not count."""
    some, other = cause("payload", level_fitted=0.3), cause("other", level_fitted=0.2)
    case = in_three_channels(some, other, reference=False)
    case["base"]["level_fitted"] = 0.5
    some["mean_squares"] = dict.fromkeys(some["mean_squares"], 1e9)
    beyond = {m: (m**2) ** 2 / (m**2 + LEVEL**2) for m in (0.3, 0.5)}
    explained, complete = explained_and_complete(case)
    assert explained == pytest.approx(1.0 - beyond[0.3] / beyond[0.5])
    assert complete == pytest.approx((0.25 - 0.09) / (0.25 - 0.04))


@pytest.mark.parametrize("reference", [True, False])
def test_a_hypothesis_that_increases_the_residual_explains_nothing(reference: bool) -> None:
    worse, better = cause("payload", left=2.0), cause("other", left=0.5)
    assert explained_and_complete(evidence(worse, better, reference=reference)) == (0.0, 0.0)
    # where no hypothesis removes anything there is no share of it
    assert explained_and_complete(evidence(worse, reference=reference)) == (0.0, 0.0)
    same = cause("payload", left=1.0)
    assert explained_and_complete(evidence(same, reference=reference)) == (0.0, 0.0)
    nothing = evidence(cause("payload"), reference=reference)
    for one in (nothing["base"], *nothing["hypotheses"]):
        one |= {"level_fitted": 1e-9, "mean_squares": dict.fromkeys(CHANNELS, 1e-11)}
    assert features(nothing, "payload")["explained"] == pytest.approx(1.0)  # nothing is left of nothing


@pytest.mark.parametrize(
    ("level", "reference", "above"),
    [(0.3, 0.1, np.log(3.0)), (0.05, 0.1, 0.0), (9.0, 0.1, 3.0), (0.02, 0.0, np.log(20.0)), (0.0, 0.0, 0.0)],
)
def test_held_out_residual_over_that_on_the_reference(level: float, reference: float, above: float) -> None:
    """Both at least a thousandth of the motion."""
    case = evidence(cause("payload", level=level), cause("other", level=10.0))
    case["case"]["level_on_reference"] = reference
    assert features(case, "payload")["above_reference"] == pytest.approx(above)
    assert unknown(case)["unknown_above_reference"] == pytest.approx(above)
    case["base"]["level"] = level
    assert features(case)["none_above_reference"] == pytest.approx(above)


@pytest.mark.parametrize(
    ("change", "lost"),
    [
        ({"worst": -0.7}, 0.7),
        ({"worst": -5.0}, 2.0),
        ({"worst": -0.7, "before": 0.01, "after": 0.3}, 0.7),
        ({"worst": -0.7, "before": 0.3, "after": 0.01}, 0.7),
        ({"worst": -0.7, "before": 0.02, "after": 0.02}, 0.0),
        ({"worst": 0.5}, 0.0),
        ({"worst": None}, 0.0),
    ],
)
def test_largest_growth_of_the_gap_in_another_channel(change: dict[str, Any], lost: float) -> None:
    some = cause("payload")
    some["channels"]["pitch_rate"] |= change
    assert features(evidence(some), "payload")["lost"] == pytest.approx(lost)


@pytest.mark.parametrize(
    ("usual", "feature"),
    [(None, 0.0), (RATIO, 0.0), (4.0, 0.0), (1.0, np.log(RATIO)), (0.2, np.log(RATIO / 0.2)), (1e-6, 3.0)],
)
def test_an_effect_as_small_as_errors_of_twin_files_are(usual: float | None, feature: float) -> None:
    assert features(evidence(cause("payload", usual=usual)), "payload")["usual"] == pytest.approx(feature)


def test_sizes_far_beyond_their_prior_count_from_two_spreads_on() -> None:
    some = cause("payload", "strut_friction")
    sizes = some["parameters"]
    assert features(evidence(some), "payload", "strut_friction")["far"] == 0.0
    sizes["payload"]["mass"]["far"], sizes["strut_friction"]["rear_force"]["far"] = 2.5, 4.0
    assert features(evidence(some), "payload", "strut_friction")["far"] == pytest.approx(2.0)
    for parameters in sizes.values():
        for one in parameters.values():
            del one["far"], one["bound"]
    found = features(evidence(some), "payload", "strut_friction")
    assert found["far"] == found["bound"] == 0.0
    sizes["strut_friction"]["front_force"]["bound"] = True
    assert features(evidence(some), "payload", "strut_friction")["bound"] == 1.0


def test_no_gap_is_unlikely_where_a_hypothesis_gains_that_is_larger_than_usual_errors() -> None:
    rows = [
        cause("a", gain=9.0, usual=RATIO),
        cause("b", gain=5.0, usual=RATIO + 0.1),
        cause("c", gain=4.0, usual=None),
        cause("d", gain=8.0, usual=0.2),
    ]
    assert features(evidence(*rows))["none_gain"] == pytest.approx(np.arcsinh(5.0))
    assert features(evidence(rows[0], *rows[2:]))["none_gain"] == pytest.approx(np.arcsinh(4.0))
    assert features(evidence(rows[0], rows[3]))["none_gain"] == 0.0
    assert features(evidence(cause("a", gain=-3.0)))["none_gain"] == 0.0


def test_unknown_is_likely_where_only_a_set_explains() -> None:
    def open_(*rows: dict[str, Any]) -> float:
        return float(np.sinh(unknown(evidence(*rows))["unknown_open"]))

    both, single, idle = cause("a", "b", gain=9.0), cause("a", gain=4.0), cause("b", gain=-6.0)
    assert open_(both, single, idle) == pytest.approx(5.0)
    assert open_(both, idle) == open_(both) == pytest.approx(9.0)
    assert open_(single, idle) == open_(idle) == 0.0


@pytest.mark.parametrize("reference", [True, False])
def test_unknown_is_as_likely_as_the_best_cause_leaves_much(reference: bool) -> None:
    """The best cause explains most; it counts no more than recalibration alone."""
    left = {"a": 0.9, "b": 0.5, "c": 0.7}
    rows = [cause(e, left=share) for e, share in left.items()]
    found = unknown(evidence(*rows, reference=reference))
    square, level = 8.0 * 0.25 + 1.0, 0.4 * 0.5
    wanted = 0.5 * np.log(square / SQUARE) if reference else np.log(level / LEVEL)
    assert found["unknown_best_excess"] == pytest.approx(wanted)
    assert found["unknown_blind"] == float(not reference)
    worse = evidence(cause("a", left=3.0), reference=reference)
    assert unknown(worse)["unknown_best_excess"] == features(worse)["none_excess"] > 0.0


# -- from features to a verdict --------------------------------------------------------------------------------------


def test_costs_are_as_documented() -> None:
    costs = Costs()
    assert (costs.wrong, costs.missed, costs.unknown, costs.vague) == (4.0, 1.0, 1.0, 0.5)


@pytest.mark.parametrize("name", ["wrong", "missed", "unknown", "vague"])
def test_each_cost_is_read_by_its_name(name: str) -> None:
    assert Costs.parsed(f" {name}=2.5 ,") == Costs(**{name: 2.5})
    assert Costs.parsed(f"{name}=0") == Costs(**{name: 0.0})
    for value, word in (
        ("inf", "at least 0"),
        ("-inf", "at least 0"),
        ("nan", "at least 0"),
        ("-1e-9", "at least 0"),
        ("", "'' is no number"),
        ("1=2", "'1=2' is no number"),
    ):
        with pytest.raises(InputError, match=f"{name}.*{word}"):
            Costs.parsed(f"{name}={value}")
    with pytest.raises(InputError, match="right.*is not one of missed, unknown, vague, wrong"):
        Costs.parsed(f"{name}=1,right=2")


def test_evidence_of_no_format_is_refused() -> None:
    case = evidence(*others())
    del case["format"]
    with pytest.raises(InputError, match="format None, not 1"):
        decide(case)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_verdict_names_by_presence_under_a_conditional_logit(seed: int, reference: bool) -> None:
    rng = np.random.default_rng(seed)
    names = [*"abcd", "ab", "bcd", "ac", "x", "y"]
    rows = [
        row(*name, gain=float(g), left=float(share), decoy=name in "xy")
        for name, g, share in zip(names, rng.normal(3, 4, 9), rng.uniform(0.0, 1.3, 9), strict=True)
    ]
    case = evidence(*rows, reference=reference)
    costs = Costs(*rng.uniform(0.0, 5.0, 4))
    weights = Weights(rng.normal(scale=0.5, size=len(FEATURES)), float(rng.uniform(0.0, 0.4)), {})
    found = decide(case, costs, weights)

    odds = [np.exp(float(a.features @ weights.values)) for a in answers_of(case)]
    np.testing.assert_allclose(found.probability, np.array(odds) / sum(odds), rtol=1e-9)
    masses: dict[tuple[str, ...], float] = {}
    for a, odd in zip(found.answers, odds, strict=True):
        masses[a.causes] = masses.get(a.causes, 0.0) + odd / sum(odds)
    known = {a.causes: a.row for a in found.answers if a.row is not None and not a.row["decoy"]}
    assert found.no_gap == pytest.approx(masses[()]) and found.unknown == pytest.approx(masses[("unknown",)])
    assert set(found.effects) == set("abcd")
    for effect, p in found.effects.items():
        assert p == pytest.approx(sum(m / len(c) for c, m in masses.items() if effect in c))
    able = {e for c, r in known.items() if r["channels"]["pitch_rate"]["low"] > 0.0 for e in c}
    presence = {e: sum(m for c, m in masses.items() if e in c) for e in able}
    for effect, p in presence.items():
        assert found.presence(effect) == pytest.approx(p)
    best = max(presence.values(), default=0.0)
    named = found.chosen not in ((), ("unknown",))
    assert named == bool(able and (best >= costs.sure or best > max(found.no_gap, found.unknown)))
    assert found.sure == bool(able and best >= costs.sure)
    if named:
        assert best == pytest.approx(max(found.presence(e) for e in found.chosen))
        assert found.row is known[found.chosen]
    else:
        assert found.row is None and found.chosen == (
            () if costs.nothing(found.no_gap, found.unknown) else ("unknown",)
        )
    held = [masses[c] for c in found.candidates]
    assert held == sorted(held, reverse=True) and len(set(found.candidates)) == len(held)
    if held[0] >= weights.conformal:
        assert set(found.candidates) == {c for c, m in masses.items() if m >= weights.conformal}
    else:
        assert len(held) == 1 and held[0] == max(masses.values())


def test_the_set_of_candidates_holds_all_of_a_probability_or_the_most_probable_alone() -> None:
    case, alike = evidence(cause("a"), cause("b")), np.zeros(len(FEATURES))
    every = {(), ("unknown",), ("a",), ("b",)}
    assert set(decide(case, weights=Weights(alike, 0.25, {})).candidates) == every  # of at least that
    assert len(decide(case, weights=Weights(alike, 0.2501, {})).candidates) == 1
    by_gain = np.array([float(name == "gain") for name in FEATURES])
    case = evidence(cause("a", gain=2.0), cause("b", gain=5.0))
    ranked = [("b",), ("a",), (), ("unknown",)]
    assert decide(case, weights=Weights(by_gain, 0.0, {})).candidates == ranked
    assert decide(case, weights=Weights(by_gain, 1.0, {})).candidates == ranked[:1]


def test_a_cause_is_suspected_only_if_it_is_more_probable_than_no_gap_and_unknown() -> None:
    case, alike = evidence(cause("a"), cause("b")), Weights(np.zeros(len(FEATURES)), 0.1, {})
    assert decide(case, Costs(), alike).chosen == ("unknown",)  # all alike, a quarter each
    assert decide(case, Costs(vague=2.0), alike).chosen == ()
    assert decide(case, Costs(wrong=0.2), alike).chosen == ("a",)  # sure from a sixth on
    by_gain = Weights(np.array([0.3 * (name == "gain") for name in FEATURES]), 0.1, {})
    found = decide(evidence(cause("a", gain=2.0), cause("b", gain=5.0)), Costs(), by_gain)
    assert found.chosen == ("b",) and not found.sure and found.presence("b") < 0.5


def test_presence_counts_all_sets_that_hold_a_cause() -> None:
    """A cause alone and within sets: it is sure, though no answer is."""
    by_gain = Weights(np.array([1.0 * (name == "gain") for name in FEATURES]), 0.1, {})
    rows = [cause("a", gain=20.0), cause("b", gain=1.0), cause("c", gain=1.0)]
    sets = [row("a", other, gain=20.0, left=0.2) for other in "bc"]
    found = decide(evidence(*rows, *sets), Costs(), by_gain)
    assert found.presence("a") > 0.8 > max(found.masses.values())
    assert found.sure and found.chosen == ("a",) and found.row is not None and found.row["effects"] == ["a"]


@pytest.mark.parametrize(
    ("lows", "named"),
    [((0.0, 0.0, 0.0), False), ((-0.1, 1e-9, -0.1), True), ((-0.1, -0.1, 0.2), True), ((-1.0,) * 3, False)],
)
def test_a_cause_is_named_only_if_it_shrinks_the_gap_in_some_channel(
    lows: tuple[float, ...], named: bool
) -> None:
    """Its interval excludes zero there, be the channel driven or not."""
    case = in_three_channels(cause("payload"))
    case["hypotheses"] = [of_channels(case["hypotheses"][0], "low", lows)]
    weights = Weights(np.array([5.0 * (name == "gain") for name in FEATURES]), 0.1, {})
    found = decide(case, weights=weights)
    assert found.effects["payload"] > 0.99 and found.candidates == [("payload",)]
    assert found.chosen == (("payload",) if named else ("unknown",))
    assert found.row == (case["hypotheses"][0] if named else None)


def test_shapes_that_are_no_causes_are_unknown() -> None:
    rows = [row("shape", gain=6.0, left=0.2, decoy=True), row("play", gain=5.0, left=0.2, decoy=True)]
    found = decide(evidence(*rows, cause("payload", gain=0.1)))
    assert [a.causes for a in found.answers] == [(), ("unknown",), ("unknown",), ("unknown",), ("payload",)]
    assert [a.row for a in found.answers][2:4] == rows
    assert found.unknown == pytest.approx(found.probability[1:4].sum()) and set(found.effects) == {"payload"}
    assert found.chosen == ("unknown",) and found.row is None


@pytest.mark.parametrize("name", ["road.crg", "./road.crg", "a"])
def test_a_twin_handed_on_keeps_the_text_of_its_file_and_finds_its_road(
    name: str, mondeo: Twin, tmp_path: Path
) -> None:
    """Also where the path of the road stands elsewhere in the text, as a part of other words."""
    given = tmp_path / "given.yaml"
    road = RoadFile(file=(tmp_path / name).resolve())
    save_twin(mondeo.model_copy(update={"road": road}), given)
    text = "# weighed in May\n" + given.read_text().replace(f"file: {Path(name)}", f"file: {name}")
    given.write_text(text)
    twin = load_twin(given)
    hand_on(twin, given, tmp_path / "same.yaml")
    assert (tmp_path / "same.yaml").read_bytes() == given.read_bytes()
    with together():  # a file of a set is not there before the set is
        hand_on(twin, given, tmp_path / "out" / "twin.yaml")
    assert load_twin(tmp_path / "out" / "twin.yaml") == twin
    changed = twin.with_changes({"vehicle.mass": 1800.0})
    hand_on(changed, given, tmp_path / "out" / "twin.yaml")
    assert load_twin(tmp_path / "out" / "twin.yaml") == changed
