# SPDX-License-Identifier: Apache-2.0
"""A twin for CarMaker: tables as a vehicle file has them, put into a vehicle file without touching its other lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.addons.export.registry import ExportSettings, export_twin
from suspension_twin.errors import InputError
from suspension_twin.vehicle.twin import Twin, load_twin

VEHICLE = """#INFOFILE1.1 - Do not remove this line!
FileIdent = CarMaker-Car 8
Body.mass = 1301.0
## Suspensions ##
SuspF.Spring = 25000.0
SuspF.Spring.Amplify = 1.5
SuspF.Spring.l0 = 0.338
SuspF.SecSpring.Amplify = 1.0
SuspF.Damp_Push.Amplify = 2.0
SuspF.Damp_Push:
\t0.00 0
\t1.04 800
SuspF.Damp_Pull:
\t0.00 0
\t1.04 1150
SuspF.Buf_Push.tz0 = 0.055
SuspF.Buf_Push:
\t0.0 0.0
\t0.030 108691.0
SuspR.Spring:
\t0.0 0.0
\t1.0 24000.0
SuspR.Damp_Push = 3000
SuspR.Damp_Pull = 4000
Tire.0.Kind =
"""


def tables(text: str) -> dict[str, np.ndarray]:
    """Tables by key of a file of CarMaker."""
    found: dict[str, list[list[float]]] = {}
    key = ""
    for line in text.splitlines():
        if line.startswith("\t"):
            found[key].append([float(x) for x in line.split()])
        elif line.endswith(":"):
            key = line[:-1]
            assert key not in found, f"{key} stands twice"
            found[key] = []
    return {key: np.array(rows) for key, rows in found.items()}


def test_tables_are_the_characteristics(mondeo: Twin, tmp_path: Path) -> None:
    (note,) = export_twin(mondeo, "carmaker", tmp_path / "Mondeo")
    assert "at the wheel" in note
    found = tables((tmp_path / "Mondeo").read_text(encoding="utf-8"))
    assert len(found) == 6
    for axle, prefix in (("front", "SuspF"), ("rear", "SuspR")):
        for part, word in (("spring", "Spring"), ("damper_push", "Damp_Push"), ("damper_pull", "Damp_Pull")):
            wanted = np.column_stack(getattr(getattr(mondeo.vehicle, axle), part).points)
            np.testing.assert_array_equal(found[f"{prefix}.{word}"], np.vstack([[0.0, 0.0], wanted]))


def test_a_vehicle_file_keeps_its_other_lines(mondeo: Twin, tmp_path: Path) -> None:
    (tmp_path / "Car").write_bytes(VEHICLE.replace("1301.0", "1301.0 # gro\xdf").encode("latin-1"))
    export_twin(mondeo, "carmaker", tmp_path / "New", ExportSettings(into=tmp_path / "Car"))
    text = (tmp_path / "New").read_text(encoding="utf-8")
    found = tables(text)
    np.testing.assert_array_equal(found["SuspF.Buf_Push"], [[0.0, 0.0], [0.03, 108691.0]])
    np.testing.assert_array_equal(found["SuspF.Damp_Push"][2], [0.25, 420.0])
    assert found["SuspR.Spring"][-1].tolist() == [1.0, 23000.0]
    assert text.count("SuspF.Spring.Amplify = 1.0\n") == 1
    assert "25000" not in text
    kept = ["#INFOFILE1.1 - Do not remove this line!", "Body.mass = 1301.0 # groß", "SuspF.Spring.l0 = 0.338"]
    kept += ["SuspF.SecSpring.Amplify = 1.0", "SuspF.Buf_Push.tz0 = 0.055", "Tire.0.Kind ="]
    assert [line for line in text.splitlines() if line in kept] == kept


def test_what_is_no_vehicle_file(mondeo: Twin, tmp_path: Path) -> None:
    (tmp_path / "Car").write_text("SuspF.Spring = 1\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"Car: .*SuspF\.Damp_Push"):
        export_twin(mondeo, "carmaker", tmp_path / "New", ExportSettings(into=tmp_path / "Car"))
    assert not (tmp_path / "New").exists()


def test_effects_and_other_vehicles(mondeo: Twin, repository: Path, tmp_path: Path) -> None:
    spec = {"id": "worn_dampers", "parameters": {"front": 0.2}}
    assert (
        "worn_dampers"
        in export_twin(mondeo.with_changes({"effects": [spec]}), "carmaker", tmp_path / "C")[-1]
    )
    linked = mondeo.with_changes({"vehicle.rear.linkage": {"driving": 0.5}, "vehicle.tyre.damping": 50.0})
    assert export_twin(linked, "carmaker", tmp_path / "P")[-1] == "Not in the tables: linkage, tyre_damping"
    with pytest.raises(InputError, match="tracked has no front and rear axle"):
        export_twin(load_twin(repository / "config/tracked/pt91.yaml"), "carmaker", tmp_path / "D")
