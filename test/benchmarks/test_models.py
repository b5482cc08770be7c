# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the models, as a whole on runs of seconds."""

from __future__ import annotations

import contextlib
import io
import json
import math
import sys
from functools import cache
from typing import Any

import pytest

from suspension_twin.effects.registry import EFFECTS

pytest.importorskip("mujoco")

#: The figures that README and docs/benchmarks.md report.
FIGURES = {
    "simulated_s_per_s_all_cores",
    "simulated_s_per_s_one_core",
    "simulated_s_per_s_one_core_all_signals",
    "simulated_s_per_s_one_lane",
    "paper_budget_s",
    "cores",
    "mujoco_s_per_s",
    "mujoco_mj_step_alone_s_per_s",
    "ratio_to_mujoco_per_core",
    "ratio_to_mujoco_per_core_at_equal_error",
    "solve_ivp_s_per_s",
    "numpy_s_per_s",
    "peak_flop_per_s_one_core",
    "flop_per_step",
    "share_of_peak",
    "hour_at_1_khz_peak_bytes",
    "hour_at_1_khz_s",
    "linearity_lanes",
    "linearity_length_s",
}
TABLES = {"effects", "cost_against_lanes", "cost_against_length_s", "linear_car"}


@pytest.fixture(scope="module")
def said() -> list[str]:
    """What the program prints for people and with ``--json``, of figures that are measured once."""
    import models

    out = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models, "measure", cache(models.measure))
        for options in ([], ["--json"]):
            patch.setattr(sys, "argv", ["models.py", "--smoke", *options])
            with contextlib.redirect_stdout(io.StringIO()) as text:
                models.main()
            out.append(text.getvalue())
    return out


@pytest.fixture(scope="module")
def figures(said: list[str]) -> Any:
    return json.loads(said[1])


@pytest.mark.long
def test_the_tables_are_for_people(said: list[str]) -> None:
    assert "effect in every lane" in said[0] and "against MuJoCo per core" in said[0]


@pytest.mark.long
def test_every_figure_is_there(figures: Any) -> None:
    assert set(figures) == FIGURES | TABLES
    assert all(math.isfinite(figures[name]) and figures[name] > 0 for name in FIGURES)
    assert {row["who"] for row in figures["linear_car"]} > {"full_car, batched", "MuJoCo Euler"}


@pytest.mark.long
def test_every_effect_has_its_cost(figures: Any) -> None:
    assert set(figures["effects"]) == set(EFFECTS)
    assert all(ratio > 0 for ratio in figures["effects"].values())
