# SPDX-License-Identifier: Apache-2.0
"""The twins of a manifest for live use: the newest of each vehicle, by names that ROS can have."""

from __future__ import annotations

from pathlib import Path

import pytest

from suspension_twin.addons.fleet.manifest import Item
from suspension_twin.addons.fleet.twins import fleet_twins
from suspension_twin.errors import InputError
from suspension_twin.vehicle.twin import load_twin


def test_the_newest_row_of_each_vehicle_counts(fleet_folder: Path, repository: Path, tmp_path: Path) -> None:
    own, other = str(fleet_folder / "twin.yaml"), str(repository / "config/twins/ford_mondeo_mk4.yaml")
    rows = [("car 7", "2026-02-01", own), ("2nd", "", other), ("car 7", "2026-01-01", other)]
    found = fleet_twins([Item(v, d, t, ("x",)) for v, d, t in rows], tmp_path)
    assert [(name, str(file)) for name, file in found.items()] == [("car_7", own), ("v2nd", other)]


def test_a_road_of_the_manifest_takes_the_place_of_the_twins_own(
    fleet_folder: Path, repository: Path, tmp_path: Path
) -> None:
    twin = str(repository / "config/twins/ford_mondeo_mk4.yaml")
    road = fleet_folder / "road.crg"
    found = fleet_twins([Item("a", "", twin, ("x",), road=str(road))], tmp_path)
    moved = load_twin(found["a"])
    assert moved.road is not None and moved.road.file == road
    assert moved.vehicle == load_twin(twin).vehicle


def test_names_that_ros_cannot_tell_apart_or_have_are_refused(fleet_folder: Path, tmp_path: Path) -> None:
    twin = str(fleet_folder / "twin.yaml")
    with pytest.raises(InputError, match="car-1: has the same name in ROS as car 1: /car_1"):
        fleet_twins([Item(v, "", twin, ("x",)) for v in ("car 1", "car-1")], tmp_path)
    with pytest.raises(InputError, match="no letter or digit"):
        fleet_twins([Item("--", "", twin, ("x",))], tmp_path)
