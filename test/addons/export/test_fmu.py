# SPDX-License-Identifier: Apache-2.0
"""FMUs: valid by FMPy, equal to the twin over the bundled drives and with every effect, tidy in failure."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from fmu_importers import columns, walk_2, walk_3, walked

from suspension_twin.addons.export import fmu as target
from suspension_twin.addons.export.registry import ExportSettings, export_twin
from suspension_twin.arrays import Floats
from suspension_twin.drive.read import read_drive
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import observe
from suspension_twin.inference.synthetic import path_along
from suspension_twin.models.connectors import INPUTS, OUTPUTS
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.models.types import Excitation
from suspension_twin.road import bump_road, half_sine
from suspension_twin.vehicle.twin import Twin, load_twin

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here: apt-get install gcc")
WALKS = {"2.0": walk_2, "3.0": walk_3}


Written = Callable[..., Path]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """Makes the FMU of a twin, once."""
    known: dict[tuple[str, str], Path] = {}

    def write(twin: Twin, version: str = "2.0") -> Path:
        key = twin.model_dump_json(exclude={"road", "datum", "gps"}), version
        if key not in known:
            known[key] = tmp_path_factory.mktemp("fmu") / "twin.fmu"
            export_twin(twin, "fmu", known[key], ExportSettings(fmi=version))
        return known[key]

    return write


def deviation(found: Floats, wanted: Floats) -> Floats:
    """(outputs,) largest difference as a share of the largest motion of each output."""
    return np.asarray(np.abs(found - wanted).max(axis=0) / np.maximum(np.ptp(wanted, axis=0), 1e-9))


@pytest.fixture(scope="module")
def bump(mondeo: Twin) -> Excitation:
    """Three seconds over a bump, braking and turning."""
    road = bump_road(half_sine(0.9, 0.05), at=8.0, length=40.0)
    path = path_along(road, np.arange(0.0, 3.0, 0.01), ((0.0, 7.0), (2.0, 6.0), (3.0, 3.0)), 2.0)
    driven = excitation(path, mondeo.vehicle, road)
    turning = np.sin(3.0 * driven.t)
    driven.motion[:, 2:5] = np.column_stack([2.0 * turning, 0.3 * turning, 0.9 * np.cos(3.0 * driven.t)])
    return driven


@pytest.mark.parametrize("drive", ["bump_15kmh", "crg_road"])
@pytest.mark.long
def test_it_is_the_twin_over_the_bundled_drives(drive: str, repository: Path, written: Written) -> None:
    folder = repository / "bags" / drive
    twin = load_twin(folder / "twin.yaml")
    driven = observe(read_drive(folder), twin).excitation
    wanted = columns(simulate_twin(twin, driven))
    for version, walk in WALKS.items():
        path = written(twin, version)
        assert validate_fmu(str(path)) == []
        assert deviation(walk(path, driven), wanted).max() < 1e-9


@pytest.mark.long
def test_every_effect_of_the_kernel_is_in_it(mondeo: Twin, bump: Excitation, written: Written) -> None:
    specs = []
    for name, effect in EFFECTS.items():
        if "full_car" in effect.models and (effect.hook.kernel or effect.hook.corners or effect.hook.vehicle):
            typical = {p.name: p.prior.typical for p in effect.parameters}
            strong = {n: typical[n] or 0.3 * effect.parameter(n).prior.spread for n in effect.severity}
            specs.append({"id": name, "parameters": {**typical, **strong}})
    assert len(specs) > 18
    # The heat of a fading damper is looked up once in a communication step, which is shorter here than between stamps;
    # beside friction and play, which stick a step earlier or later for it, such a difference would grow.
    fading = [s for s in specs if s["id"] == "damper_fade"]
    for kept, close in ((fading, 3e-5), ([s for s in specs if s not in fading], 1e-9)):
        twin = mondeo.with_changes({"effects": kept})
        wanted = columns(simulate_twin(twin, bump))
        assert deviation(walk_2(written(twin), bump), wanted).max() < close
        changed = deviation(columns(simulate_twin(mondeo, bump)), wanted)
        assert changed[:20].min() > (1e-3 if len(kept) > 1 else 1e-4)


def test_optional_parts_are_in_it(mondeo: Twin, bump: Excitation, written: Written) -> None:
    twin = mondeo.with_changes(
        {
            "vehicle.front.linkage": {"braking": 0.3, "recession": 0.1, "roll_center": 0.05},
            "vehicle.rear.linkage": {"braking": 0.5, "driving": 0.4},
            "vehicle.tyre.rolling_radius": 0.3,
            "vehicle.tyre.damping": 60.0,
            "vehicle.front.anti_roll_bar": 6e3,
            "vehicle.rear.friction": 25.0,
            "vehicle.rear.top_mount": 3e5,
        }
    )
    wanted = columns(simulate_twin(twin, bump))
    assert deviation(walk_2(written(twin), bump), wanted).max() < 1e-9
    assert deviation(columns(simulate_twin(mondeo, bump)), wanted)[:20].min() > 1e-4


def test_the_model_msd(mondeo: Twin, bump: Excitation, written: Written) -> None:
    spec = {"id": "unsprung_mass", "parameters": {"mass": 30.0}}
    for effects in ([], [spec]):
        twin = mondeo.with_changes({"model": "msd", "effects": effects})
        found = walk_3(written(twin, "3.0"), bump)
        assert deviation(found, columns(simulate_twin(twin, bump))).max() < 1e-9


def test_a_plain_importer_at_a_millisecond(mondeo: Twin, bump: Excitation, written: Written) -> None:
    """Inputs held over each step are half a millisecond late."""
    t, inputs, last = walked(bump)
    names = [variable.name for variable in INPUTS]
    table = np.array(
        [tuple(row) for row in np.column_stack([t, inputs])], dtype=[(n, float) for n in ("time", *names)]
    )
    wanted = columns(simulate_twin(mondeo, bump))[:, 0]
    for version in WALKS:
        path = str(written(mondeo, version))
        result = fmpy.simulate_fmu(path, stop_time=t[-1], output_interval=1e-3, input=table, output=["heave"])
        heave = np.interp(t[last], result["time"], result["heave"])
        assert np.abs(heave - wanted).max() < 0.02 * np.ptp(wanted)


def opened(path: Path, version: str) -> Any:
    description = fmpy.read_model_description(path)
    fmu = fmpy.instantiate_fmu(fmpy.extract(path), description, fmi_type="CoSimulation")
    if version == "2.0":
        fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    return fmu


@pytest.mark.parametrize("version", list(WALKS))
def test_states_come_back_and_bad_input_ends_a_step(version: str, mondeo: Twin, written: Written) -> None:
    path = written(mondeo, version)
    fmu = opened(path, version)
    get, put = (fmu.getReal, fmu.setReal) if version == "2.0" else (fmu.getFloat64, fmu.setFloat64)
    save, restore = (
        (fmu.getFMUstate, fmu.setFMUstate) if version == "2.0" else (fmu.getFMUState, fmu.setFMUState)
    )
    put([0, 1], [0.01, 0.01])
    loads = get([116, 117, 118, 119])  # already while it is initialized
    assert OUTPUTS[16].name == "tyre_force_front_left"
    assert sum(loads) == pytest.approx(mondeo.vehicle.mass * 9.80665, rel=1e-9)
    fmu.exitInitializationMode()
    fmu.doStep(0.0, 0.05)
    state = save()
    put([4], [3.0])
    fmu.doStep(0.05, 0.05)
    once = get(list(range(100, 134)))
    restore(state)
    put([4], [3.0])
    fmu.doStep(0.05, 0.05)
    assert get(list(range(100, 134))) == once
    put([0], [float("nan")])
    with pytest.raises(FMICallException):
        fmu.doStep(0.1, 0.01)
    with pytest.raises(FMICallException):
        put([100], [0.0])
    restore(state)
    put([0], [0.0])
    fmu.doStep(0.05, 0.05)
    assert np.isfinite(get(list(range(100, 134)))).all()
    fmu.freeFMUstate(state) if version == "2.0" else fmu.freeFMUState(state)
    fmu.terminate()
    fmu.freeInstance()


@pytest.mark.parametrize("version", list(WALKS))
def test_the_source_is_clean_and_the_archive_is_the_same_again(
    version: str, mondeo: Twin, written: Written, tmp_path: Path
) -> None:
    path = tmp_path / "twin.fmu"
    export_twin(mondeo, "fmu", path, ExportSettings(fmi=version))
    assert path.read_bytes() == written(mondeo, version).read_bytes()
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
        names = archive.namelist()
    if shutil.which("x86_64-w64-mingw32-gcc"):
        assert any(name.endswith(".dll") for name in names)
    main = f"fmi{version[0]}.c"
    strict = [
        "cc",
        "-std=c99",
        "-Wall",
        "-Wextra",
        "-Wpedantic",
        "-Wshadow",
        "-Werror",
        "-fsyntax-only",
        main,
    ]
    done = subprocess.run(strict, cwd=tmp_path / "sources", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_without_a_compiler_it_is_source_alone(
    mondeo: Twin, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(target.shutil, "which", lambda name: None)
    notes = export_twin(mondeo, "fmu", tmp_path / "twin.fmu")
    assert "no C compiler" in notes[-1]
    with zipfile.ZipFile(tmp_path / "twin.fmu") as archive:
        assert not any(name.startswith("binaries") for name in archive.namelist())
        assert "sources/fmi2.c" in archive.namelist()


def test_what_is_not_in_it_is_said(
    mondeo: Twin, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(target.shutil, "which", lambda name: None)
    specs = [{"id": "road_scale", "parameters": {"scale": 1.1}}, {"id": "strut_friction", "parameters": {}}]
    twin = mondeo.with_changes({"effects": specs, "imu.latency": 0.01})
    said = " ".join(export_twin(twin, "fmu", tmp_path / "twin.fmu"))
    assert "road_scale" in said
    assert "imu.latency" in said
    assert "strut_friction" not in said
    with pytest.raises(InputError, match="tracked cannot be written out"):
        export_twin(load_twin(repository / "config/tracked/pt91.yaml"), "fmu", tmp_path / "tank.fmu")
    assert not (tmp_path / "tank.fmu").exists()
