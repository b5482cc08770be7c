# SPDX-License-Identifier: Apache-2.0
"""A twin for MATLAB and Simulink: script and MAT-file hold the same struct, tables are the twin's curves."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

from suspension_twin.addons.export.registry import export_twin
from suspension_twin.vehicle.twin import Twin, load_twin


def flat(name: str, value: Any) -> dict[str, Any]:
    """Values by dotted name of what loadmat gives for a struct."""
    if hasattr(value, "_fieldnames"):
        parts = [flat(f"{name}.{key}", getattr(value, key)) for key in value._fieldnames]
        return {key: item for part in parts for key, item in part.items()}
    return {name: value}


def assigned(script: str) -> dict[str, Any]:
    """Values by dotted name of the assignments in a script of MATLAB."""
    joined = script.replace("...\n", "")
    found: dict[str, Any] = {}
    for line in joined.splitlines():
        if line.startswith("%"):
            continue
        name, value = re.fullmatch(r"([\w.]+) = (.*);", line).groups()  # type: ignore[union-attr]
        if value.startswith("'"):
            found[name] = value[1:-1].replace("''", "'")
        else:
            numbers = [float(x) for x in value.strip("[]").split(",")]
            found[name] = np.array(numbers) if value.startswith("[") else numbers[0]
    return found


@pytest.mark.parametrize("name", ["bags/crg_road/twin", "config/twins/quarter_car", "config/tracked/pt91"])
def test_script_and_mat_file_hold_the_same(name: str, repository: Path, tmp_path: Path) -> None:
    twin = load_twin(repository / f"{name}.yaml")
    for file in ("twin.m", "twin.mat"):
        assert export_twin(twin, "simulink", tmp_path / file) == ()
    text = (tmp_path / "twin.m").read_text(encoding="utf-8")
    assert max(map(len, text.splitlines())) <= 160
    script = assigned(text)
    mat = flat("twin", loadmat(tmp_path / "twin.mat", squeeze_me=True, struct_as_record=False)["twin"])
    assert script.keys() == mat.keys()
    for key, value in script.items():
        if isinstance(value, str):
            assert mat[key] == value
        else:
            np.testing.assert_array_equal(np.squeeze(value), mat[key], err_msg=key)
    assert script["twin.vehicle.name"] == twin.vehicle.name


def test_tables_are_the_characteristics(mondeo: Twin, tmp_path: Path) -> None:
    spec = {"id": "strut_friction", "parameters": {"front_force": 50.0}}
    twin = mondeo.with_changes({"vehicle.name": "Otto's car", "effects": [spec]})
    export_twin(twin, "simulink", tmp_path / "twin.m")
    found = assigned((tmp_path / "twin.m").read_text(encoding="utf-8"))
    assert found["twin.vehicle.name"] == "Otto's car"
    assert found["twin.effects.strut_friction.front_force"] == 50.0
    table = "twin.vehicle.front.damper_table"
    velocity, force = found[f"{table}.breakpoints"], found[f"{table}.values"]
    assert (np.diff(velocity) > 0).all()
    np.testing.assert_allclose(
        np.interp([-0.25, 0.0, 0.25, 0.3], velocity, force), [-900.0, 0.0, 420.0, 520.0]
    )
    spring = "twin.vehicle.rear.spring_table"
    static = found["twin.vehicle.rear.static_compression"]
    carried = np.interp(static, found[f"{spring}.breakpoints"], found[f"{spring}.values"])
    np.testing.assert_allclose(carried, twin.axles["rear"].load, rtol=1e-12)


def test_a_name_that_matlab_does_not_run(mondeo: Twin, tmp_path: Path) -> None:
    (note,) = export_twin(mondeo, "simulink", tmp_path / "my-car.m")
    assert "my-car" in note
