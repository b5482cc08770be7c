# SPDX-License-Identifier: Apache-2.0
"""The IMU of a twin file: its latency and its bounds."""

from __future__ import annotations

from pathlib import Path

import pytest

from suspension_twin.errors import InputError
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin


def test_a_latency_is_read_back_as_it_was_written(mondeo: Twin, tmp_path: Path) -> None:
    assert mondeo.imu.latency == 0.0
    save_twin(mondeo.with_changes({"imu.latency": 0.0061}), tmp_path / "twin.yaml")
    assert load_twin(tmp_path / "twin.yaml").imu.latency == 0.0061


def test_a_latency_in_milliseconds_is_refused(mondeo: Twin) -> None:
    with pytest.raises(InputError, match=r"imu.latency: must lie between -2 and 2 s, is 6 \(is it in ms\?\)"):
        mondeo.with_changes({"imu.latency": 6.0})
    with pytest.raises(InputError, match="imu.latency: must lie between -2 and 2 s, is nan"):
        mondeo.with_changes({"imu.latency": float("nan")})


def test_a_receiver_has_none(mondeo: Twin) -> None:
    with pytest.raises(InputError, match="gps.latency: no such key"):
        mondeo.with_changes({"gps.latency": 0.1})
