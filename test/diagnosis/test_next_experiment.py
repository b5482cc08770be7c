# SPDX-License-Identifier: Apache-2.0
"""The next drive of a diagnosis: over which obstacle two candidates differ most, and what it is worth."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from suspension_twin.diagnosis.next_experiment import next_experiment, planned_drive, separating_drive
from suspension_twin.road import bump_road, half_sine
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
    assert separating_drive(mondeo, mondeo, {}, 0.15)[0] == 0.0
    stiff = with_effect(mondeo, "anti_roll_bar", front_stiffness=2e4, rear_stiffness=2e4)
    nats, name = separating_drive(mondeo, stiff, {}, 0.15)
    assert nats > 10.0 and name == "a bump under the left wheels only at 20 km/h"
    noisy, _ = separating_drive(mondeo, stiff, {"roll_rate": 1e3}, 0.15)
    assert noisy < nats


def candidates(*effects):
    return [SimpleNamespace(effects=(e,), found=SimpleNamespace(fit=None)) for e in effects]


def test_a_next_drive_is_proposed_only_where_two_candidates_are_left():
    road, run = SimpleNamespace(kind="road"), SimpleNamespace(kind="run")
    assert next_experiment(road, candidates("payload"), "effect", None) == (
        "No further drive is needed to separate candidates."
    )
    assert next_experiment(run, candidates("payload", "spring_sag"), "unknown", None).startswith(
        "Repeat the run with another excitation to separate unlisted payload from "
    )


@pytest.mark.parametrize(
    ("nats", "says"),
    [
        (9.0, "Drive a bump: it separates clock offset from clock drift best; one pass should settle it."),
        (2.0, "one pass should make the right one 7 times as likely as the other."),
        (0.5, "Clock drift shows in: long drives, bumps early and late."),
    ],
)
def test_the_next_drive_says_how_much_it_is_worth(nats, says, monkeypatch):
    import suspension_twin.diagnosis.next_experiment as module

    monkeypatch.setattr(module, "twin_of", lambda problem, fit: None)
    monkeypatch.setattr(module, "separating_drive", lambda *_: (nats, "a bump"))
    judged = SimpleNamespace(problem=None, scale=SimpleNamespace(noise={}, reference=None))
    road = SimpleNamespace(kind="road")
    assert says in next_experiment(road, candidates("time_offset", "clock_drift"), "unknown", judged)
