# SPDX-License-Identifier: Apache-2.0
"""A residual concentrated on one section of road: its place, and the error of the road file that explains it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis.decision import usual
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.diagnosis.shrink import RemainingResidual
from suspension_twin.diagnosis.where import concentrated_section
from suspension_twin.report.diagnosis import diagnosis_page
from suspension_twin.road import load_road, write_road

CHANNEL = "vertical_acceleration"
NOISE = {CHANNEL: 0.02}
SPEEDS = (12.0, 8.0, 10.0)  # m/s


def problem(active: tuple[bool, ...], seed: int = 0) -> tuple[Any, list[np.ndarray]]:
    """A problem of drives over 200 m whose motion varies along the road, and the positions of each drive."""
    rng = np.random.default_rng(seed)
    positions = [np.arange(0.0, 200.0, v / 100.0) for v in SPEEDS[: len(active)]]
    motion = [(1.0 + np.sin(x / 9.0)) * rng.standard_normal(x.size) for x in positions]
    ends = np.cumsum([0, *(x.size for x in positions)])
    measured = SimpleNamespace(
        channels=(CHANNEL,),
        values=np.concatenate(motion)[:, None],
        drives=list(range(len(active))),
        segments=[slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)],
    )
    data = SimpleNamespace(
        parts=[SimpleNamespace(position=x) for x in positions],
        drive_of=list(range(len(active))),
        rows=[np.arange(x.size) for x in positions],
        active=active,
    )
    return SimpleNamespace(measured=measured, data=data, channels=(CHANNEL,)), positions


def rest(
    seen: Any, positions: list[np.ndarray], wrong: list[tuple[float, float] | None], seed: int = 1
) -> RemainingResidual:
    """A residual of a fifth of the motion, and two or three times that on the ``wrong`` section of a drive."""
    rng = np.random.default_rng(seed)
    left = 0.2 * seen.measured.values[:, 0]
    more = []
    for x, where in zip(positions, wrong, strict=True):
        own = np.zeros(x.size) if where is None else 1.0 * ((x > where[0]) & (x < where[1]))
        size = np.sqrt(x.size / max(own.sum(), 1.0)) * 0.4
        more.append(size * own * rng.standard_normal(x.size))
    left = (left + np.concatenate(more))[:, None]
    return RemainingResidual(left, left)


@pytest.mark.parametrize("seed", range(5))
def test_model_discrepancy_is_spread_over_the_road(seed: int) -> None:
    seen, positions = problem((True, True), seed)
    found = concentrated_section(seen, rest(seen, positions, [None, None], seed), NOISE)
    assert found is not None and found.beyond < 0.1


@pytest.mark.parametrize(("start", "end"), [(0.0, 20.0), (61.0, 97.0), (170.0, 199.0)])
def test_a_residual_of_every_pass_on_one_section_is_found_there(start: float, end: float) -> None:
    seen, positions = problem((True, True))
    found = concentrated_section(seen, rest(seen, positions, [(start, end)] * 2), NOISE)
    assert found is not None and found.beyond > 1.5 * usual("place")
    assert start - 4.0 <= found.start < found.end <= end + 4.0
    assert found.end - found.start > 0.7 * (end - start) and found.share > 0.5


def test_a_residual_of_one_pass_is_no_local_road_error() -> None:
    seen, positions = problem((True, True))
    found = concentrated_section(seen, rest(seen, positions, [(60.0, 90.0), None]), NOISE)
    assert found is not None and found.beyond < usual("place")
    elsewhere = concentrated_section(seen, rest(seen, positions, [(20.0, 50.0), (140.0, 170.0)]), NOISE)
    assert elsewhere is not None and elsewhere.beyond < usual("place")


def test_a_residual_of_the_reference_is_none_of_the_gap() -> None:
    seen, positions = problem((True, True, False))
    before = concentrated_section(seen, rest(seen, positions, [(60.0, 90.0)] * 3), NOISE)
    assert before is not None and before.beyond < usual("place")
    now = concentrated_section(seen, rest(seen, positions, [(60.0, 90.0), (60.0, 90.0), None]), NOISE)
    assert now is not None and now.beyond > 1.5 * usual("place")


def test_a_residual_within_the_noise_and_drives_without_vertical_acceleration_have_no_section() -> None:
    seen, positions = problem((True, True))
    quiet = RemainingResidual(*(np.full((sum(x.size for x in positions), 1), 0.01),) * 2)
    found = concentrated_section(seen, quiet, NOISE)
    assert found is not None and found.beyond < usual("place")
    seen.measured.channels = ("yaw_rate",)
    assert concentrated_section(seen, quiet, NOISE) is None


@pytest.mark.long
def test_a_road_file_that_is_wrong_on_one_section_is_unknown_with_its_place(
    make: Any, tmp_path: Path
) -> None:
    right, bags, _ = make()
    twin = Path(shutil.copy(right, tmp_path))
    road = load_road(right.parent / "road.crg")
    u = road.u_first + road.u_step * np.arange(road.z.shape[0])
    there = 0.5 * (np.tanh((u - 22.0) / 0.3) - np.tanh((u - 42.0) / 0.3))[:, None]
    write_road(
        replace(road, z=road.z * (1.0 + 2.0 * there)), tmp_path / "road.crg"
    )  # three times as high as it is
    few = ("strut_friction", "tyre_damping", "road_scale", "lateral_offset")
    result = diagnose(DiagnosisRequest(str(twin), tuple(bags), effects=few))
    document = result.document
    assert document["verdict"] == "unknown", document["message"]
    stretch = document["signature"]["stretch"]
    assert 16.0 <= stretch["start_m"] < stretch["end_m"] <= 46.0 and stretch["share"] > 0.4
    like = stretch["resembles"][0]
    assert like["effect"] == "road_scale" and like["shrink"] > 0.4
    assert like["parameters"]["scale"] == pytest.approx(-2.0 / 3.0, abs=0.1)
    assert "m of the road, where it is like road heights off by a factor" in document["message"]
    assert document["next_experiment"].startswith("Survey the road from ")
    assert document["no_gap_probability"] < 0.1
    assert "which holds a smaller share of the motion" in diagnosis_page(result).render()
