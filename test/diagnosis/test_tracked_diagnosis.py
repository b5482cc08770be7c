# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a tracked vehicle on runs of a specimen that other code simulated (``benchmarks/tracked_reality.py``).

A diagnosis simulates the vehicle a thousand times, so runs are short and only camera effects are searched.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis.library import library
from suspension_twin.diagnosis.request import DiagnosisProgress, DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import InputError
from suspension_twin.inference.problem import Interrupted
from suspension_twin.vehicle.twin import load_twin

ROWS = 101  # 2 s at 50 Hz: over the obstacle's first edge
Cut = Callable[..., str]


@pytest.fixture(scope="module")
def file(repository: Path) -> str:
    return str(repository / "config" / "tracked" / "pt91.yaml")


@pytest.fixture(scope="module")
def cut(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Cut:
    """``cut(repeat, scale, late)``: the first two seconds of a bundled run, filmed by a camera of another scale whose
    clock was started ``late`` s earlier."""

    def build(repeat: int, scale: float = 1.0, late: float = 0.0) -> str:
        path = repository / "config" / "tracked" / "runs" / f"13kmh_{repeat}.csv"
        header, *lines = path.read_text(encoding="utf-8").splitlines()
        table = np.loadtxt(lines[: 2 * ROWS], delimiter=",")
        t = table[:ROWS, 0]
        motion = np.stack([np.interp(t - late, table[:, 0], c) for c in table[:, 1:].T], axis=1)
        table = np.concatenate([t[:, None], scale * motion], axis=1)
        out = tmp_path_factory.mktemp("runs") / path.name
        np.savetxt(out, table, delimiter=",", header=header, comments="", fmt="%.6g")
        return str(out)

    return build


@pytest.fixture(scope="module")
def scaled(file: str, cut: Cut) -> dict[str, Any]:
    """The document where the camera's scale has become wrong by a tenth."""
    request = DiagnosisRequest(file, (cut(3, 1.1),), (cut(1),), effects=("sensor_scale",))
    return diagnose(request).document


@pytest.mark.long
def test_a_camera_of_another_scale_is_named(scaled: dict[str, Any]) -> None:
    assert scaled["verdict"] in ("effect", "partly") and scaled["combination"] == ["sensor_scale"]
    top = scaled["causes"][0]
    assert top["probability"] > 0.9 and top["shrink"] > 0.3
    assert top["parameters"]["scale"] == pytest.approx(0.1, abs=0.03)
    low, high = top["shrink_interval"]
    assert low <= top["shrink"] <= high + 1e-9


@pytest.mark.long
def test_clocks_that_were_started_at_other_moments_are_no_fault(file: str, cut: Cut) -> None:
    """What the references leave is expected at the same place of the run, whenever its clock was started."""
    before = cut(1, late=0.015), cut(2, late=-0.015)
    found = diagnose(DiagnosisRequest(file, (cut(3),), before, effects=("time_offset",))).document
    assert found["verdict"] == "no_gap" and found["combination"] == []
    assert found["causes"][0]["probability"] < 0.1


@pytest.mark.long
def test_the_document_is_that_of_a_car(scaled: dict[str, Any]) -> None:
    total = sum(c["probability"] for c in scaled["causes"])
    assert total + scaled["no_gap_probability"] + scaled["unknown_probability"] == pytest.approx(
        1.0, abs=1e-4
    )
    assert {"where", "unexplained", "next_experiment", "recalibration", "seed"} <= set(scaled)
    assert scaled["gap"]["channel"] == "marker_A_displacement" and len(scaled["gap"]["channels"]) == 9
    assert scaled["gap"]["rms"] > 0.003  # m
    json.dumps(scaled, allow_nan=False)


def test_the_library_has_a_hypothesis_for_each_station(file: str) -> None:
    offered = library(load_twin(file), True)
    assert set(offered) == {name for name, found in EFFECTS.items() if "tracked" in found.models}
    stations = [dict(h.fixed)["effects.station_bar.station"] for h in offered["station_bar"]]
    assert stations == [1, 2, 3, 4, 5, 6]
    dampers = [dict(h.fixed)["effects.station_damper.station"] for h in offered["station_damper"]]
    assert dampers == [1, 2, 6]  # the others have none


def test_a_diagnosis_ends_when_asked(file: str, cut: Cut) -> None:
    heard: list[DiagnosisProgress] = []
    with pytest.raises(Interrupted):
        diagnose(DiagnosisRequest(file, (cut(2),)), heard.append, lambda: len(heard) >= 2)
    assert heard[-1].stage == "calibrating"


def test_what_cannot_be_diagnosed_is_named(file: str, cut: Cut, repository: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="drives: none are given"):
        diagnose(DiagnosisRequest(file, ()))
    run = cut(1)
    with pytest.raises(InputError, match="is given as a drive with the gap and as one from before it"):
        diagnose(DiagnosisRequest(file, (run,), (run,)))
    with pytest.raises(InputError, match="strut_friction: does not apply to a vehicle of the model tracked"):
        diagnose(DiagnosisRequest(file, (run,), effects=("payload", "strut_friction")))
    unnamed = tmp_path / "run.csv"
    unnamed.write_bytes(Path(run).read_bytes())
    with pytest.raises(InputError, match=r"run\.csv: speed"):
        diagnose(DiagnosisRequest(file, (str(unnamed),)))
