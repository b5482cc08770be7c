# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the models, as a whole on runs of seconds."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
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
def figures(repository: Path) -> Any:
    script = repository / "benchmarks" / "models.py"
    done = subprocess.run(
        [sys.executable, script, "--smoke", "--json"],
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
        cwd=repository,
    )
    return json.loads(done.stdout)


@pytest.mark.long
def test_every_figure_is_there(figures: Any) -> None:
    assert set(figures) == FIGURES | TABLES
    assert all(math.isfinite(figures[name]) and figures[name] > 0 for name in FIGURES)
    assert {row["who"] for row in figures["linear_car"]} > {"full_car, batched", "MuJoCo Euler"}


@pytest.mark.long
def test_every_effect_has_its_cost(figures: Any) -> None:
    assert set(figures["effects"]) == set(EFFECTS)
    assert all(ratio > 0 for ratio in figures["effects"].values())
