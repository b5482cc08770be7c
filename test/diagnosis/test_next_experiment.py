# SPDX-License-Identifier: Apache-2.0
"""The next drive of a diagnosis: over which obstacle two candidates differ most, and what it is worth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from suspension_twin.diagnosis.next_experiment import (
    ProposedDrive,
    next_experiment,
    planned_drive,
    separating_drive,
)
from suspension_twin.road import add_bump, bump_road, half_sine
from suspension_twin.vehicle.twin import EffectSpec


def across(height=0.06):
    return bump_road(half_sine(0.9, height), at=20.0, length=50.0)


def test_a_drive_stays_on_the_road_at_its_speed(mondeo):
    road = across()
    drive = planned_drive(mondeo, road, 9.0)
    assert drive.along.max() == pytest.approx(2.5, rel=1e-3)
    assert drive.along[0] == 0.0 and drive.along[-1] < 0.1  # it stands at both ends
    assert road.u_first < drive.position.min() and drive.position.max() + 2.85 < road.u_last
    assert planned_drive(mondeo, road, 72.0).along.min() > 19.0  # too short a road to speed up on


def with_effect(twin, name, **parameters):
    return twin.model_copy(update={"effects": (EffectSpec(id=name, parameters=parameters),)})


def test_the_drive_that_separates_two_twins_is_the_one_on_which_they_differ_most(mondeo):
    assert separating_drive(mondeo, mondeo, {}, 0.15).nats == 0.0
    stiff = with_effect(mondeo, "anti_roll_bar", front_stiffness=2e4, rear_stiffness=2e4)
    found = separating_drive(mondeo, stiff, {}, 0.15)
    assert found.nats > 10.0 and found.name == "a bump under the left wheels only at 20 km/h"
    assert found.channel == "roll_rate" and found.as_dict()["road"] == "a bump under the left wheels only"
    assert separating_drive(mondeo, stiff, {"roll_rate": 1e3}, 0.15).nats < found.nats


def test_the_road_of_the_twin_is_driven_again_where_that_settles_it(mondeo):
    stiff = with_effect(mondeo, "anti_roll_bar", front_stiffness=2e4, rear_stiffness=2e4)
    level, one_sided = across(), add_bump(across(1e-6), half_sine(0.9, 0.06), 25.0, v_low=0.1)
    # both wheels of an axle at once: the bar does nothing, and an obstacle is better
    assert separating_drive(mondeo, stiff, {}, 0.15, [(level, 20.0)]).road
    found = separating_drive(mondeo, stiff, {}, 0.15, [(level, 20.0), (one_sided, 10.0), (one_sided, 20.0)])
    assert found.road == "" and found.name.startswith("the road of the twin once more at ")
    assert found.as_dict() == {
        "speed_kmh": found.kmh,
        "channel": "roll_rate",
        "difference": pytest.approx(found.rms, rel=1e-2),
    }
    drives = [
        planned_drive(t.model_copy(update={"road": None}), one_sided, found.kmh) for t in (mondeo, stiff)
    ]
    apart = (drives[0].measured["roll_rate"] - drives[1].measured["roll_rate"])[drives[0].mask]
    assert found.rms == pytest.approx(float(np.sqrt(np.mean(apart**2))))


def candidates(*effects):
    return [SimpleNamespace(effects=(e,) if e else (), found=SimpleNamespace(fit=None)) for e in effects]


def test_a_next_drive_is_proposed_only_where_two_candidates_are_left():
    road, run = SimpleNamespace(kind="road"), SimpleNamespace(kind="run")
    assert next_experiment(road, candidates("payload"), "effect", None) == (
        "No further drive is needed to separate candidates.",
        {},
    )
    text, drive = next_experiment(run, candidates("payload", "spring_sag"), "unknown", None)
    assert text.startswith("Repeat the run with another excitation to separate unlisted payload from ")
    assert drive == {}


@pytest.mark.parametrize(
    ("nats", "says"),
    [
        (
            9.0,
            "Drive a bump at 20 km/h: there clock offset and clock drift differ most, by 0.3 rad/s in roll rate.",
        ),
        (
            2.0,
            "by 0.3 rad/s in roll rate; one pass should make the right one 7 times as likely as the other.",
        ),
        (0.5, "Clock drift shows in: long drives, bumps early and late."),
    ],
)
def test_the_next_drive_says_how_much_it_is_worth(nats, says, monkeypatch):
    import suspension_twin.diagnosis.next_experiment as module

    monkeypatch.setattr(module, "twin_of", lambda problem, fit: None)
    monkeypatch.setattr(
        module, "separating_drive", lambda *_: ProposedDrive("a bump", 20.0, nats, "roll_rate", 0.3)
    )
    judged = SimpleNamespace(problem=None, scale=SimpleNamespace(noise={}, reference=None))
    road = SimpleNamespace(kind="road", road=False)
    text, drive = next_experiment(road, candidates("time_offset", "clock_drift"), "unknown", judged)
    assert says in text and bool(drive) is (nats > 1.0)


def test_a_vehicle_without_a_missing_effect_is_a_rival(monkeypatch):
    import suspension_twin.diagnosis.next_experiment as module

    monkeypatch.setattr(module, "twin_of", lambda problem, fit: None)
    monkeypatch.setattr(
        module, "separating_drive", lambda *_: ProposedDrive("", 30.0, 9.0, "pitch_rate", 0.02)
    )
    judged = SimpleNamespace(problem=None, scale=SimpleNamespace(noise={}, reference=None))
    road = SimpleNamespace(kind="road", road=False)
    text, drive = next_experiment(road, candidates("payload", ""), "suspected", judged)
    assert text.startswith(
        "Drive the road of the twin once more at 30 km/h: there unlisted payload and no missing effect differ"
    )
    assert drive == {"speed_kmh": 30.0, "channel": "pitch_rate", "difference": 0.02}
