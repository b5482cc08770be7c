# SPDX-License-Identifier: Apache-2.0
"""Faults so large that the twin follows nothing: a clock half a second late, a sensor that stands sideways."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis import coarse_search
from suspension_twin.diagnosis.library import SETUP_CATEGORIES, variants
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.hypothesis import combined
from suspension_twin.vehicle.twin import Twin

SIDEWAYS = (0.0, 0.0, 1.5)
SOME = ("time_offset", "sensor_tilt", "position_offset", "corner_spring")


@pytest.mark.parametrize(
    ("effect", "given", "exact"),
    [
        ("time_offset", {"offset": 0.6}, 0.01),
        ("position_offset", {"offset": -3.0}, 0.05),
        ("sensor_tilt", {"roll": 0.0, "pitch": 0.0, "yaw": math.pi / 2}, 0.03),
    ],
    ids=["late", "elsewhere", "sideways"],
)
@pytest.mark.long
def test_a_gross_fault_is_named_with_its_size(
    make: Any, effect: str, given: dict[str, float], exact: float
) -> None:
    twin, bags, _ = make(effect, given)
    document = diagnose(DiagnosisRequest(str(twin), (bags[0],), effects=SOME)).document
    assert document["combination"] == [effect], document["message"]
    lead = document["causes"][0]
    assert lead["probability"] > 0.6
    assert lead["parameters"] == pytest.approx(given, abs=exact)
    intervals = lead["parameter_intervals"]
    assert all(low <= lead["parameters"][name] <= high for name, (low, high) in intervals.items())


def test_a_prior_moves_to_what_is_far_and_stays_for_what_is_near(car: Twin) -> None:
    tilt, clock = variants(EFFECTS["sensor_tilt"], car)[0], variants(EFFECTS["time_offset"], car)[0]
    moved = coarse_search.recentred(tilt, np.array([0.5, -1.0, 31.0]))
    assert moved.centre().tolist() == [0.0, 0.0, 31.0]
    assert coarse_search.recentred(tilt, np.array([0.5, -1.0, 2.9])) is tilt
    both = combined(moved, clock)
    assert both.centre().tolist() == [0.0, 0.0, 31.0, 0.0]
    assert both.without("time_offset") == moved
    assert both.without("sensor_tilt").centre().tolist() == [0.0]
    charged = coarse_search.waived_penalty(tilt, np.array([[0.5, 31.0], [2.0, 0.0], [0.0, 0.0]]))
    assert charged.tolist() == [0.0, 31.0**2 - coarse_search.MISALIGNMENT_PENALTY]
    held = replace(
        clock, held=(("effects.time_offset.offset", 0.2),)
    )  # four standard deviations: its own place
    assert coarse_search.recentred(held, np.array([5.0])) is held
    assert coarse_search.recentred(held, np.array([0.0])).centre().tolist() == [0.0]
    assert not coarse_search.waived_penalty(held, np.array([[4.0]])).any()


def test_only_what_can_be_set_wrong_is_looked_for_everywhere(car: Twin) -> None:
    for name, effect in EFFECTS.items():
        if "full_car" not in effect.hook.models:
            continue
        points = coarse_search._severity_grid(variants(effect, car)[0], SIDEWAYS)
        if effect.where not in SETUP_CATEGORIES:
            assert points is None, name
        elif points is not None:
            low, high = variants(effect, car)[0].bounds()
            assert (points >= low[:, None] - 1e-9).all() and (points <= high[:, None] + 1e-9).all()
    assert np.shape(coarse_search._severity_grid(variants(EFFECTS["time_offset"], car)[0], SIDEWAYS)) == (
        1,
        201,
    )
    assert coarse_search._measured_turn(variants(EFFECTS["sensor_tilt"], car)[0], (0.0, 0.0, 0.1)) is None
