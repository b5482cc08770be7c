# SPDX-License-Identifier: Apache-2.0
"""Standard deviations of the values of a twin file."""

from __future__ import annotations

from pathlib import Path

import pytest

from suspension_twin.errors import InputError
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

KNOWN = {"vehicle.mass": 12.0, "vehicle.front.spring.force": (5.0, 10.0, 20.0, 40.0)}


@pytest.fixture
def sure(mondeo: Twin) -> Twin:
    return mondeo.with_changes({"uncertainty": KNOWN})


def test_a_file_keeps_them(sure: Twin, mondeo: Twin, tmp_path: Path) -> None:
    save_twin(sure, tmp_path / "twin.yaml")
    assert load_twin(tmp_path / "twin.yaml") == sure != mondeo
    save_twin(mondeo, tmp_path / "without.yaml")
    assert "uncertainty" not in (tmp_path / "without.yaml").read_text()


def test_a_number_has_its_own_and_a_point_that_of_its_place(sure: Twin, mondeo: Twin) -> None:
    assert sure.deviation("vehicle.mass") == 12.0
    assert [sure.deviation(f"vehicle.front.spring.force.{i}") for i in range(4)] == [5.0, 10.0, 20.0, 40.0]
    assert sure.deviation("vehicle.rear.spring.force.0") == sure.deviation("vehicle.wheelbase") == 0.0
    assert mondeo.deviation("vehicle.mass") == 0.0


@pytest.mark.parametrize(
    ("changed", "left"),
    [
        ({"vehicle.mass": 1800.0}, {"vehicle.front.spring.force"}),
        ({"vehicle.front.spring.force.1": 4000.0}, {"vehicle.mass"}),
        ({"vehicle.front_track": 1.6}, set(KNOWN)),
        ({"vehicle.mass": 1800.0, "vehicle.front.spring.force": [1000.0, 4000.0, 8000.0, 16000.0]}, set()),
    ],
)
def test_a_value_that_is_replaced_loses_its_own(
    sure: Twin, changed: dict[str, object], left: set[str]
) -> None:
    assert set(sure.with_changes(changed).uncertainty or {}) == left


@pytest.mark.parametrize(
    ("key", "sigma", "said"),
    [
        ("vehicle.mas", 1.0, "no such key"),
        ("vehicle.mass", -1.0, "negative"),
        ("vehicle.mass", float("nan"), "infinite"),
        ("vehicle.mass", (1.0, 2.0), "needs one, has 2"),
        ("vehicle.front.spring.force", (1.0, 2.0), "needs 4, has 2"),
        ("vehicle.front.spring.force", 1.0, "needs 4, has one"),
        ("vehicle.name", 1.0, "not a number"),
        ("vehicle.front", 1.0, "not a number"),
    ],
)
def test_one_that_fits_nothing_is_an_error_that_names_it(
    mondeo: Twin, key: str, sigma: object, said: str
) -> None:
    with pytest.raises(InputError, match=f"uncertainty.*{key}.*{said}"):
        mondeo.with_changes({"uncertainty": {key: sigma}})
