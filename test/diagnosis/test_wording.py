# SPDX-License-Identifier: Apache-2.0
"""Words of a diagnosis: every effect with its parameters, and the answer in one sentence."""

from __future__ import annotations

from dataclasses import replace

import pytest

from suspension_twin.cli.common import print_diagnosis
from suspension_twin.diagnosis import wording
from suspension_twin.effects.registry import EFFECTS

ON_MODELS = [(e, model) for e, effect in EFFECTS.items() for model in effect.models]


def severe(effect, model):
    """Parameters of a severe effect."""
    own = EFFECTS[effect].on(model)
    more = {p.name: p.prior.typical for p in own.parameters}
    for name in own.severity:
        p = own.parameter(name)
        if not p.prior.log:
            more[name] = p.prior.typical + p.prior.spread
    return more


def document(verdict="effect", **changes):
    cause = {
        "effect": "corner_damper",
        "channel": "vertical_acceleration",
        "probability": 0.93,
        "parameters": {"corner": 2.0, "change": -0.4},
        "parameter_intervals": {"change": [-0.45, -0.35]},
        "gap_before": 0.41,
        "gap_after": 0.09,
        "shrink": 0.78,
        "shrink_interval": [0.74, 0.81],
        "indistinguishable_from": [],
    }
    return {
        "verdict": verdict,
        "probability": {"no_gap": 0.6, "unknown": 0.07}.get(verdict, 0.93),
        "gap": {"rms": 0.41, "noise_rms": 0.05, "channel": "vertical_acceleration"},
        "causes": [cause],
        "combination": ["corner_damper"] if verdict in ("effect", "partly") else [],
        "no_gap_probability": 0.6,
        "unknown_probability": 0.07,
        "unexplained": 0.3,
        "gap_after": 0.41,
        "candidates": [],
        "cannot_be_judged": [],
        "recalibration": {"gap_before": 0.4, "gap_after": 0.3, "shrink": 0.25, "shrink_interval": [0.1, 0.4]},
        "message": f"{verdict}: 0.3 m/s² remain",
        **changes,
    }


@pytest.mark.parametrize(("effect", "model"), ON_MODELS)
def test_every_effect_says_what_it_is(effect, model):
    values = severe(effect, model)
    text = wording.finding(effect, values)
    assert not set(text) & set("_{}\n")
    assert " nan" not in text
    assert "corner" not in text
    choices = [p.name for p in EFFECTS[effect].on(model).parameters if p.choices]
    other = {k: v if k in choices else 1.5 * v for k, v in values.items()}
    assert (
        wording.finding(effect, other) != text or effect == "progressive_spring"
    )  # of N/m² nobody has a notion


def test_a_damper_that_has_lost_force():
    text = wording.finding("corner_damper", {"corner": 0.0, "change": -0.4})
    assert text == "the front left damper has lost 40 % of its force"
    assert "gained 20 %" in wording.finding("corner_damper", {"corner": 3.0, "change": 0.2})


def test_a_tyre_an_axle_and_a_wheel_out_of_balance():
    assert wording.finding("tyre_pressure", {"corner": 1.0, "change": -0.3}) == (
        "the pressure of the front right tyre is 30 % too low"
    )
    assert "both rear tyres is 20 % too high" in wording.finding(
        "tyre_pressure", {"corner": 5.0, "change": 0.2}
    )
    found = wording.finding(
        "wheel_imbalance", {"corner": 0.0, "moment": 0.02, "rolling_radius": 0.31, "phase": 0.0}
    )
    assert found == "the front left wheel is out of balance, by 100 g at the rim"


def test_an_effect_without_a_phrase_is_named_with_its_parameters(monkeypatch):
    plain = replace(EFFECTS["corner_damper"], finding=None)
    monkeypatch.setattr("suspension_twin.diagnosis.wording.EFFECTS", {**EFFECTS, "corner_damper": plain})
    text = wording.finding("corner_damper", {"corner": 1.0, "change": -0.4})
    assert text == "one odd damper (wheel front right, change −40 %)"
    assert wording.finding("not_yet_known", {"size": 0.25}) == "not yet known (size 0.25)"


@pytest.mark.parametrize(
    ("verdict", "sentence"),
    [
        ("effect", "Very likely (93 %): the rear left damper has lost 40 % of its force."),
        (
            "partly",
            "Very likely (93 %): the rear left damper has lost 40 % of its force, but that is not all.",
        ),
        ("no_gap", "More likely than not (60 %): nothing is wrong that these drives could show."),
        (
            "unknown",
            "About as likely as not (40 %): something is wrong, but nothing in the library of causes explains it.",
        ),
        (
            "suspected",
            "Probably (93 %): the rear left damper has lost 40 % of its force; or else: something that is not in the "
            "library (7 %).",
        ),
    ],
)
def test_the_answer_is_one_sentence(verdict, sentence):
    likeliest = {"unknown": 0.05, "no_gap": 0.3}.get(verdict, 0.93)
    found = document(verdict)
    if verdict == "unknown":
        found |= {"probability": 0.4, "unknown_probability": 0.4, "no_gap_probability": 0.1}
    elif verdict == "suspected":
        found |= {"unknown_probability": 0.07, "no_gap_probability": 0.01, "combination": ["corner_damper"]}
    found["causes"][0]["probability"] = likeliest
    assert wording.answer(found) == sentence


def test_what_is_open_is_said_with_all_chances():
    found = document("unknown", probability=0.22, unknown_probability=0.22, no_gap_probability=0.1)
    found["causes"][0]["probability"] = 0.64
    assert wording.answer(found) == (
        "Something is wrong (90 %), no cause is certain enough to be named: the rear left damper has lost 40 % of its "
        "force (64 %), something that is not in the library (22 %) and nothing is wrong (10 %)."
    )
    assert wording.message(found).endswith("nothing is wrong (10 %); 0.41 m/s² of the gap remain")
    quiet = {**found, "gap_after": 0.0}
    assert wording.message(quiet).endswith("; no more of the gap remains than the noise of the sensor")


MOVED = {
    "characteristic": "rear damper, both ways",
    "keys": ["vehicle.rear.damper_pull.force", "vehicle.rear.damper_push.force"],
    "before": 1205.0,
    "after": 610.0,
    "unit": "N",
    "change": -0.494,
    "interval": [-0.55, -0.44],
    "relative": True,
    "share": 0.9,
    "stated": False,
}
HIGHER = {
    "characteristic": "cog 2",
    "keys": ["vehicle.cog.2"],
    "before": 0.0,
    "after": 0.05,
    "unit": "m",
    "change": 0.05,
    "interval": [0.03, 0.07],
    "relative": False,
    "share": 0.0,
    "stated": False,
}


def test_what_recalibration_moved_is_said_as_in_a_workshop():
    assert wording.moved_words(MOVED) == "rear damper, both ways: 49 % weaker (44 to 55)"
    assert wording.moved_words(HIGHER) == "cog 2: 5 cm higher (3 cm to 7 cm)"
    assert "softer" in wording.moved_words({**MOVED, "characteristic": "front spring rate"})
    found = document(
        "recalibration", probability=0.6, combination=[], recalibrated=[MOVED, HIGHER], no_gap_probability=0.6
    )
    assert wording.answer(found) == (
        "More likely than not (60 %): no effect is missing, but the twin's own values are off: rear damper, both ways: "
        "49 % weaker (44 to 55)."
    )
    text = " ".join(wording.remarks(found))
    assert "49 % weaker (44 to 55), which closes 90 % of it alone." in text
    assert "Moved as well, to little effect: cog 2: 5 cm higher (3 cm to 7 cm)." in text
    assert "a reference drive from before the gap tells which" in text
    text = " ".join(wording.remarks({**found, "reference": True}))
    assert "the file was off before the gap came" in text
    text = " ".join(wording.remarks({**found, "recalibrated": [{**MOVED, "stated": True}, HIGHER]}))
    assert "they have changed since" in text and "a reference drive" not in text


def test_a_size_that_may_be_none_is_not_said():
    cause = {
        "effect": "strut_friction",
        "probability": 0.9,
        "parameters": {"front_force": 0.5, "rear_force": 200.0},
        "parameter_intervals": {"front_force": [0.0, 5.0], "rear_force": [150.0, 250.0]},
    }
    assert "front" not in wording.said(cause) and "200 N at the rear" in wording.said(cause)
    cause["parameter_intervals"]["rear_force"] = [0.0, 250.0]  # neither is certain: both are said
    assert "front" in wording.said(cause)


def test_remarks_name_the_channel_the_candidates_and_what_is_not_new():
    d = document(probability=0.97, candidates=["corner_damper", "no_gap"], before_and_after=True)
    d["causes"][0]["channel"] = "roll_rate"
    assert wording.answer(d).startswith("Extremely likely (97 %)")
    text = " ".join(wording.remarks(d))
    assert "gap in roll rate falls from 0.41 to 0.09 rad/s" in text
    assert "among: one odd damper, nothing is wrong." in text
    assert "Not new: before and after alike." in text


@pytest.mark.parametrize("verdict", ["no_gap", "unknown", "partly"])
def test_remarks_hold_no_id(verdict):
    assert all("unknown:" not in line and "no_gap" not in line for line in wording.remarks(document(verdict)))


def test_an_interval_says_of_which_drives_it_is(capsys):
    """On one more drive it is wider than on the drives of the diagnosis: what is printed has one of them."""
    beyond = {"shrink_beyond_recalibration": 0.77, "shrink_beyond_recalibration_interval": [0.76, 0.79]}
    d = document(warnings=[])
    d["causes"][0] |= {**beyond, "presence": 0.93}
    assert "by 78 % (74 % to 81 % on one more drive, at 90 % confidence)" in " ".join(wording.remarks(d))
    assert "77 % smaller (76 % to 79 % on these drives) than by recalibration alone" in wording.message(d)
    print_diagnosis(d, None)
    table = capsys.readouterr().out
    assert "its interval on one more drive" in table and "76 %" not in table
    assert "78 %" in table.splitlines()[-3] and "74 % to 81 %" in table.splitlines()[-3]


@pytest.mark.parametrize(("effect", "model"), ON_MODELS)
def test_no_quantity_is_a_bare_place(effect, model):
    names = {wording.parameter_name(effect, p.name) for p in EFFECTS[effect].on(model).parameters}
    assert not names & {"front", "rear"}


def test_parameters_have_names_units_and_intervals():
    cause = document()["causes"][0]
    assert wording.parameters_of(cause) == [("wheel", "rear left"), ("change", "−40 % (−45 % to −35 %)")]
    assert wording.parameter_name("bump_stop", "front_clearance") == "clearance, front"
    assert wording.parameter_name("clock_drift", "drift_ppm") == "drift"


@pytest.mark.parametrize(
    ("probability", "text"),
    [(0.93, "93 %"), (0.999, "more than 99 %"), (1.0, "more than 99 %"), (0.0, "less than 1 %")],
)
def test_nothing_is_certain_or_impossible(probability, text):
    assert wording.chance(probability) == text


def test_an_effect_of_no_size_is_not_called_a_finding():
    text = wording.finding("strut_friction", {"front_force": 0.3, "rear_force": 0.0})
    assert text == "no sign of this: dry friction in the struts"


def test_several_causes_close_the_gap_together():
    second = {
        **document()["causes"][0],
        "effect": "payload",
        "parameters": {"mass": 90.0, "x": 1.0, "y": 0.0},
    }
    d = document(combination=["corner_damper", "payload"], unexplained=0.25, probability=0.8)
    d["causes"].append(second)
    assert "its force; and the vehicle carries 90 kg more" in wording.answer(d)
    assert (
        "With them in the twin the gap in vertical acceleration falls from 0.41 to 0.1 m/s², by 75 %,"
        in (wording.remarks(d)[0])
    )


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [("x", 5.65e-16, "0 mm"), ("x", -3e-7, "0 mm"), ("x", 0.004, "4 mm"), ("z", 0.5, "50 cm")],
)
def test_rounding_errors_of_a_fit_are_nothing(name, value, text):
    assert wording.parameter_value("sensor_offset", name, value) == text


def test_effects_that_the_drives_do_not_excite_are_a_remark():
    assert "judged" not in " ".join(wording.remarks(document()))
    assert wording.remarks(document(cannot_be_judged=["clock_drift", "bump_stop"]))[-1] == (
        "Cannot be judged, as these drives do not excite them: clock drift, bump stop."
    )
