# SPDX-License-Identifier: Apache-2.0
"""Against a multibody car that no one here wrote: ``benchmarks/multibody.py`` on its dense truth.

The bars are rough: that a calibrated twin is the same car. How near it is stands in benchmarks/results.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("SUSPENSION_TWIN_WITHHELD", str(ROOT.parent / "shared" / "withheld")))


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    if not (DATA / "no_effect_added" / "twin.yaml").is_file():
        pytest.skip(f"no measured data: drives of a multibody car under {DATA}")
    out = tmp_path_factory.mktemp("multibody")
    run = subprocess.run(
        [
            sys.executable,
            str(ROOT / "benchmarks" / "multibody.py"),
            "--data",
            str(DATA),
            "--out",
            str(out),
            "--json",
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    found: dict[str, Any] = json.loads(run.stdout)
    assert json.loads((out / "multibody.json").read_text(encoding="utf-8")) == found
    assert (out / "multibody.png").stat().st_size > 50_000
    return found


@pytest.mark.long
def test_the_road_is_where_the_car_was(figures: dict[str, Any]) -> None:
    for name, row in figures["drives"].items():
        assert row["calibrated"]["road_height_rms_off_m"] < 0.0005, name


@pytest.mark.long
def test_held_out_drives_are_followed(figures: dict[str, Any]) -> None:
    """Body, wheels, suspension and tyres alike, and far better than before the calibration."""
    for name in ("drive_slow", "drive_other", "drive_fast"):
        given, calibrated = (figures["drives"][name][k]["signals"] for k in ("given", "calibrated"))
        for signal, after in calibrated.items():
            assert after["correlation"] > 0.93, (name, signal)
            assert after["share"] < 0.7 * given[signal]["share"], (name, signal)


@pytest.mark.long
def test_what_is_left_is_named_by_evidence(figures: dict[str, Any]) -> None:
    """Forces through the links, common to left and right, grow with travel and braking; tyres push along the normal."""
    for name, rows in figures["beyond_seven_degrees"].items():
        for axle in ("front", "rear"):
            both = rows[f"{axle}, both wheels: left by spring and damper (links)"]
            assert both > 2 * rows[f"{axle}, left less right: left by spring and damper (links)"], name
            assert rows[f"{axle}, both wheels: and by the square of the travel"] < 0.7 * both, name
            upright = rows[f"{axle} tyres: left by a linear upright spring"]
            assert rows[f"{axle} tyres: left by a linear spring along the normal"] < 0.6 * upright, name


@pytest.mark.long
def test_a_missing_truth_is_named(tmp_path: Path) -> None:
    script = str(ROOT / "benchmarks" / "multibody.py")
    run = subprocess.run(
        [sys.executable, script, "--data", str(tmp_path)], capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 2 and run.stderr.count("\n") == 1 and "no_effect_added" in run.stderr
