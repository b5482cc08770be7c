# SPDX-License-Identifier: Apache-2.0
"""What a twin file's errors say, and where its road is looked for."""

from __future__ import annotations

import copy
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from suspension_twin.errors import InputError
from suspension_twin.inference.observation import road_of
from suspension_twin.vehicle.twin import load_twin, parse_twin, save_twin, value_at, with_value


@pytest.fixture
def data(repository: Path) -> dict[str, Any]:
    path = repository / "config" / "twins" / "ford_mondeo_mk4.yaml"
    return dict(yaml.safe_load(path.read_text(encoding="utf-8")))


def test_a_typo_is_said_with_what_is_missing_for_it(data: dict[str, Any]) -> None:
    data["vehicle"]["whelbase"] = data["vehicle"].pop("wheelbase")
    with pytest.raises(InputError) as caught:
        parse_twin(data, "twin.yaml")
    assert str(caught.value) == (
        "twin.yaml: vehicle.whelbase: is not a key of a twin file, did you mean wheelbase?; "
        "vehicle.wheelbase: is missing"
    )


def test_every_error_is_in_the_one_line(data: dict[str, Any]) -> None:
    data["vehicle"]["mass"] = 1.7
    data["vehicle"]["front"]["spring"]["force"] = "stiff"
    del data["vehicle"]["cog"], data["imu"]
    data["colour"] = "red"
    with pytest.raises(InputError) as caught:
        parse_twin(data, "twin.yaml")
    text = str(caught.value)
    for words in (
        "colour: is not a key of a twin file;",
        "vehicle.mass: must lie between 50 and 100000 kg, is 1.7 (is it in t?)",
        "vehicle.front.spring.force: ",
        "vehicle.cog, imu: are missing",
    ):
        assert words in text
    assert "\n" not in text


@pytest.mark.parametrize(("model", "near"), [("fullcar", "full_car"), ("trackd", "tracked")])
def test_an_unknown_model_is_met_with_all_of_them(model: str, near: str, data: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        parse_twin({**data, "model": model, "rode": {}}, "twin.yaml")
    text = str(caught.value)
    assert "full_car" in text and "msd" in text and "tracked" in text and f"did you mean {near}?" in text
    assert "rode: is not a key of a twin file, did you mean road?" in text


@pytest.mark.parametrize("place", [".", "below/it", "../beside"])
def test_a_twin_and_its_road_are_moved_together(
    place: str, repository: Path, data: dict[str, Any], tmp_path: Path
) -> None:
    """Wherever a twin is written, its road is named from there."""
    here = tmp_path / "all" / "project"
    here.mkdir(parents=True)
    shutil.copy(repository / "bags" / "bump_15kmh" / "road.crg", here / "road.crg")
    (here / "twin.yaml").write_text(yaml.safe_dump({**data, "road": {"file": "road.crg"}}))
    save_twin(load_twin(here / "twin.yaml"), here / place / "written.yaml")
    written = yaml.safe_load((here / place / "written.yaml").read_text())["road"]["file"]
    assert not Path(written).is_absolute()
    (tmp_path / "all").rename(tmp_path / "moved")
    moved = load_twin(tmp_path / "moved" / "project" / place / "written.yaml")
    assert road_of(moved).name == "road.crg"


def test_a_missing_road_says_where_it_was_looked_for(data: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump({**data, "road": {"file": "../roads/a.crg"}}))
    with pytest.raises(InputError) as caught:
        road_of(load_twin(tmp_path / "twin.yaml"))
    looked = tmp_path.parent.resolve() / "roads" / "a.crg"
    assert f"road.file: there is no {looked}: it is looked for from the folder of the twin file" in str(
        caught.value
    )


def test_dotted_keys_of_a_twin_and_of_plain_values_are_one(data: dict[str, Any]) -> None:
    twin = parse_twin(data)
    for key in ("vehicle.mass", "vehicle.front.spring.force.2", "imu.position.0", "effects"):
        assert value_at(twin, key) == value_at(twin.model_dump(), key)
    assert value_at(twin, "vehicle.front.spring.force.2") == twin.vehicle.front.spring.force[2]


def test_a_changed_value_leaves_the_given_ones_as_they_were(data: dict[str, Any]) -> None:
    before = copy.deepcopy(data)
    changed = with_value(data, "vehicle.front.spring.force.1", 1.0)
    assert data == before
    assert value_at(changed, "vehicle.front.spring.force.1") == 1.0
    before["vehicle"]["front"]["spring"]["force"][1] = 1.0
    assert changed == before


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("vehicle.whelbase", "did you mean wheelbase?"),
        ("vehicle.foo", "(name, mass, wheelbase, "),
        ("vehicle.front.spring.force.9", "did you mean"),
        ("vehicle.front.spring.force.-1", "did you mean 1?"),
        ("vehicle.mass.x", "no such key in the twin file"),
        ("", "no such key in the twin file (model, "),
    ],
)
def test_a_key_that_is_none_is_named_with_the_nearest(key: str, words: str, data: dict[str, Any]) -> None:
    twin = parse_twin(data)
    with pytest.raises(InputError) as read:
        value_at(twin, key)
    with pytest.raises(InputError) as written:
        with_value(twin.model_dump(), key, 1.0)
    for error in (read, written):
        assert str(error.value).startswith(f"twin: {key}: no such key")
        assert words in str(error.value) or "force" in key
