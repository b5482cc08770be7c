# SPDX-License-Identifier: Apache-2.0
"""The ready sensors: every value is a setting that exists and is allowed."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest
import yaml

from suspension_twin.pose.types import PoseSettings
from suspension_twin.signals.imu import ImuSettings, StillLimits

FOLDER = Path(__file__).resolve().parents[2] / "config" / "sensors"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yaml")), ids=lambda p: p.stem)
def test_sensor_file(path: Path) -> None:
    nodes = yaml.safe_load(path.read_text(encoding="utf-8"))
    imu = nodes.pop("/**/imu_ingest")["ros__parameters"]
    still = StillLimits(**imu.pop("still", {}))
    settings = ImuSettings(**imu, still=still)
    assert settings.full_scale is not None
    assert settings.full_scale / 9.80665 == pytest.approx(8.0, rel=1e-3)
    pose = nodes.pop("/**/pose_injector", {"ros__parameters": {}})["ros__parameters"]
    assert replace(PoseSettings(), **pose) != PoseSettings() or not pose
    assert set(pose) <= {f.name for f in fields(PoseSettings)}
    assert nodes == {}


def test_there_are_some() -> None:
    assert {p.stem for p in FOLDER.glob("*.yaml")} >= {"phone", "bmi160"}
