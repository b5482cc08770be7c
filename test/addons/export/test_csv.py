# SPDX-License-Identifier: Apache-2.0
"""A twin as CSV holds every number, to the last bit, with its unit."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from suspension_twin.addons.export.registry import export_twin
from suspension_twin.vehicle.twin import Twin, load_twin


def rows(twin: Twin, folder: Path) -> dict[str, tuple[float, str]]:
    assert export_twin(twin, "csv", folder / "twin.csv") == ()
    with (folder / "twin.csv").open(encoding="utf-8", newline="") as file:
        return {row["key"]: (float(row["value"]), row["unit"]) for row in csv.DictReader(file)}


def test_the_numbers_make_the_twin_again(mondeo: Twin, tmp_path: Path) -> None:
    spec = {"id": "strut_friction", "parameters": {"front_force": 123.456}}
    odd = mondeo.with_changes({"vehicle.mass": 1725.1 + 1e-10, "effects": [spec]})
    table = rows(odd, tmp_path)
    plain = {key: value for key, (value, _) in table.items() if not key.startswith("effects.")}
    assert mondeo.with_changes(plain).model_copy(update={"effects": odd.effects}) == odd
    assert table["effects.strut_friction.front_force"] == (123.456, "N")


def test_units(mondeo: Twin, tmp_path: Path) -> None:
    table = rows(mondeo, tmp_path)
    units = {key.removeprefix("vehicle."): unit for key, (_, unit) in table.items()}
    assert units["mass"] == "kg"
    assert units["front.spring.compression.0"] == units["cog.2"] == "m"
    assert units["front.damper_pull.velocity.3"] == "m/s"
    assert units["rear.damper_push.force.0"] == "N"
    assert units["tyre.vertical_stiffness"] == "N/m"
    assert units["sprung_inertia.pitch"] == "kg m²"
    assert units["imu.latency"] == "s"


@pytest.mark.parametrize("name", ["twins/quarter_car", "tracked/pt91"])
def test_every_model_has_numbers(name: str, repository: Path, tmp_path: Path) -> None:
    twin = load_twin(repository / "config" / f"{name}.yaml")
    assert len(rows(twin, tmp_path)) > 20
