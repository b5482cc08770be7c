# SPDX-License-Identifier: Apache-2.0
"""The file of a tracked vehicle and what is refused in one."""

from __future__ import annotations

from pathlib import Path

import pytest

from suspension_twin.errors import InputError
from suspension_twin.vehicle.tracked import BOUNDS, TrackedTwin, TrackedVehicle, load_tracked, parse_tracked
from suspension_twin.vehicle.twin import load_twin, save_twin


@pytest.fixture(scope="module")
def vehicle(repository: Path) -> TrackedVehicle:
    return load_tracked(repository / "config" / "tracked" / "pt91.yaml")


def test_the_papers_numbers(vehicle: TrackedVehicle) -> None:
    assert vehicle.mass == 42600
    assert (vehicle.markers.A, vehicle.markers.B) == ((-3347, 587), (-1445, 620))
    assert vehicle.track.stiffness == 2.676e7 and vehicle.idler.setting == -5563
    assert BOUNDS["track.damping"] == (1.0, 1e6)
    # what the bodies of the paper's model are taken for adds up to its number
    assert 1 + 2 * len(vehicle.stations) + 3 + 2 + 3 + vehicle.track.links == 118


def test_masses_add_up(vehicle: TrackedVehicle) -> None:
    parts = 6 * vehicle.wheel.mass + 97 * vehicle.track.link_mass
    assert 2 * (vehicle.hull_mass + parts) == pytest.approx(vehicle.mass)


@pytest.mark.parametrize(
    ("key", "value", "word"),
    [
        ("idler.setting", -5600.0, "between -5590 and -5550 mm"),
        ("track.stiffness", 1e10, "between 100000 and 1e\\+09 N/m"),
        ("markers.A.0", -1000.0, "front to rear"),
        ("obstacle.height", 0.7, "cannot be passed"),
        ("obstacle.ramp", 0.1, "45 degrees"),
        ("mass", 42.6, "is it in t"),
        ("mass", float("nan"), "must lie between"),
        ("cog.0", 9.0, "between the outer wheels"),
        ("stations.1.x", 4.95, "fall from front to rear"),
        ("nothing", 1.0, "no such key"),
        ("stations.9.x", 1.0, "no such key"),
    ],
)
def test_what_cannot_be_is_refused(vehicle: TrackedVehicle, key: str, value: float, word: str) -> None:
    with pytest.raises(InputError, match=word) as error:
        vehicle.with_changes({key: value})
    assert "\n" not in str(error.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.yaml"):
        load_tracked(tmp_path / "gone.yaml")
    (tmp_path / "bad.yaml").write_text("a: [1,", encoding="utf-8")
    with pytest.raises(InputError, match="not YAML"):
        load_tracked(tmp_path / "bad.yaml")
    with pytest.raises(InputError, match="a mapping"):
        parse_tracked([1])
    with pytest.raises(InputError, match="cog, gyration, .*: are missing"):
        parse_tracked({"name": "x"})


def test_dampers_change_where_there_are_some(vehicle: TrackedVehicle) -> None:
    dampings = [s.damping for s in vehicle.with_dampers(11272.0).stations]
    assert dampings == [11272.0, 11272.0, 0.0, 0.0, 0.0, 11272.0]


def test_the_file_is_a_twin_file_and_goes_there_and_back(repository: Path, tmp_path: Path) -> None:
    twin = load_twin(repository / "config" / "tracked" / "pt91.yaml")
    assert isinstance(twin, TrackedTwin) and twin.model == "tracked"
    assert len(set(twin.joint_names)) == 12 and twin.joint_names[0] == "left_road_wheel_1"
    assert twin.cog_height == pytest.approx(1.144)
    save_twin(twin, tmp_path / "twin.yaml")
    assert load_twin(tmp_path / "twin.yaml") == twin
    changed = twin.with_changes({"vehicle.track.stiffness": 1e6})
    assert isinstance(changed, TrackedTwin) and changed.vehicle.track.stiffness == 1e6
    with pytest.raises(InputError, match=r"vehicle\.idler\.setting: must lie between -5590 and -5550 mm"):
        twin.with_changes({"vehicle.idler.setting": -5600.0})
