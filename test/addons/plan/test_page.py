# SPDX-License-Identifier: Apache-2.0
"""The page of a plan: smallest sizes that show, and pairs that look alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suspension_twin.addons.plan.page import plan_page, size_text
from suspension_twin.addons.plan.plan import Detectability, Pair, Plan

DAMPER = Detectability("corner_damper", "corner 0", "change", 0.12, 0.4, 1.2, 3.0, "roll_rate")
CLOCK = Detectability("time_offset", "", "offset", 0.008, 0.05, 0.15, 5.0, "vertical_acceleration")
CUTOFF = Detectability("sensor_bandwidth", "", "cutoff", 35.0, 15.0, 3.75, 6.0, "vertical_acceleration")
HIDDEN = replace(DAMPER, effect="bump_stop", place="", parameter="stiffness", size=None)


def found(mondeo, pairs):
    effects = ("corner_damper", "time_offset", "sensor_bandwidth", "bump_stop")
    angles = np.full((4, 4), np.nan)
    angles[1, 2] = 12.0
    return Plan(
        mondeo, "bumps", (20.0, 40.0), (30.0, 15.0), (DAMPER, CLOCK, CUTOFF, HIDDEN), effects, angles, pairs
    )


def test_it_lists_the_effects_that_show_and_those_that_never_do(mondeo):
    html = plan_page(found(mondeo, ())).render()
    assert "3 of 4 faults would show" in html
    assert "Not at any plausible size: bump stop." in html
    assert "One odd damper, front left" in html and ">12 %<" in html
    assert "Whatever shows can be distinguished from every other cause" in html
    assert "bumps at 20 km/h and 40 km/h" in html


def test_pairs_say_what_would_separate_them(mondeo):
    pairs = (
        Pair("t +", "time_offset", CLOCK, "position_offset", 1.0, None, "one more drive at 60 km/h", 0.008),
        Pair("c -", "sensor_bandwidth", CUTOFF, "time_offset", 20.0, 16.0),
    )
    html = plan_page(found(mondeo, pairs)).render()
    assert "Never told apart: clock offset from map shifted along the road." in html
    assert "one more drive at 60 km/h: as soon as it shows" in html
    assert "nothing that was tried" in html
    assert "16 Hz and below" in html


def test_sizes_have_units_and_a_low_pass_counts_downwards():
    assert size_text(DAMPER, 0.12) == "12 %"
    assert size_text(CLOCK, 0.008) == "8 ms"
    assert size_text(CUTOFF, 35.0) == "35 Hz and below"
    assert size_text(CLOCK, None) == "never"
