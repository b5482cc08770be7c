# SPDX-License-Identifier: Apache-2.0
"""FMUs behind the registry: of code and of a tool that share nothing with this package, and of its own export."""

from __future__ import annotations

import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from other_car import STIFFNESS, fmu_section, linear_car, other_car, vehicle_of
from scipy.signal import lsim

from suspension_twin.addons.export.registry import ExportSettings, export_twin
from suspension_twin.addons.fmu.slave import connected
from suspension_twin.addons.fmu.twin import Fmu
from suspension_twin.addons.plan.plan import plan
from suspension_twin.addons.roads.drives.drives import road_from_drives
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.models.excitation import excitation
from suspension_twin.models.live import LiveModel, LiveState, live_twin
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.models.types import Excitation, PoseSample, Response
from suspension_twin.pose.types import Trajectory
from suspension_twin.road import load_road
from suspension_twin.vehicle.twin import Twin, load_twin, parse_twin, save_twin

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here: apt-get install gcc")

MOTION = [
    "heave",
    "roll",
    "pitch",
    "z",
    "wheel_z",
    "deflection",
    "tyre_force",
    "force",
    "rate",
    "vertical_acceleration",
]


def fmu_twin(car: Twin, section: dict[str, Any], effects: tuple[Any, ...] = ()) -> Twin:
    """The twin of an FMU at the place of a full_car."""
    data = car.model_dump(mode="json", include={"imu", "gps", "datum", "road"}, exclude_none=True)
    return parse_twin(
        {"model": "fmu", "fmu": section, "vehicle": vehicle_of(car), "effects": effects, **data}
    )


def deviation(found: Response, wanted: Response) -> float:
    """The largest difference as a share of the range of its quantity."""
    pairs = ((getattr(found, name), getattr(wanted, name)) for name in MOTION)
    return max(float(np.abs(a - b).max() / np.ptp(b)) for a, b in pairs)


def followed(model: LiveModel, path: Trajectory) -> list[LiveState]:
    """The states of a live model along a path."""
    columns = [path.t, path.x, path.y, path.yaw, path.velocity, path.yaw_rate, path.acceleration]
    rows = np.column_stack(columns).tolist()
    return [model.step(t, PoseSample(*row)) for t, *row in rows]


@pytest.fixture(scope="module")
def car(repository: Path) -> Twin:
    """The car of other_car.c as a full_car."""
    return linear_car(repository / "bags" / "bump_15kmh" / "twin.yaml")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The FMU by other code."""
    path = tmp_path_factory.mktemp("fmu") / "other_car.fmu"
    other_car(path)
    return path


@pytest.fixture(scope="module")
def other(car: Twin, file: Path) -> Twin:
    return fmu_twin(car, fmu_section(file, **STIFFNESS))


@pytest.fixture
def driven(car: Twin, drive: Callable[..., Any], ground: Any, rough: Any) -> Excitation:
    """Braking in a wide bend, on a rough road 110 m above the datum, with stamps that jitter."""
    high = ground(lambda x, y: 110.0 + rough.heights(x, y) * np.clip((x - 4.0) / 8.0, 0.0, 1.0) ** 2)
    return excitation(drive(3.0, jitter=0.4, ax=-1.0, yaw_rate=0.02), car.vehicle, high)


def test_other_code_moves_as_the_same_car_here(car: Twin, other: Twin, driven: Excitation) -> None:
    assert deviation(simulate_twin(other, driven), simulate_twin(car, driven)) < 5e-3


def test_longer_communication_steps(car: Twin, file: Path, driven: Excitation) -> None:
    coarse = fmu_twin(car, {**fmu_section(file, **STIFFNESS), "step": 0.005})
    assert deviation(simulate_twin(coarse, driven), simulate_twin(car, driven)) < 0.05


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_exported_twin_comes_back(version: str, car: Twin, driven: Excitation, tmp_path: Path) -> None:
    export_twin(car, "fmu", tmp_path / "car.fmu", ExportSettings(fmi=version))
    open_sensor = {f"specific_force_{axis}": "" for axis in "xyz"} | {"z": "", "wheel_z_front_left": ""}
    wanted = simulate_twin(car, driven)
    for outputs in ({}, open_sensor):  # what the FMU says, and what is computed of it
        twin = fmu_twin(car, {"file": str(tmp_path / "car.fmu"), "outputs": outputs})
        assert deviation(simulate_twin(twin, driven), wanted) < (1e-9 if version == "2.0" else 0.05)


def test_live_it_says_the_same_as_over_the_whole_drive(other: Twin, driven: Excitation, drive: Any) -> None:
    path, model = drive(3.0, jitter=0.4, ax=-1.0, yaw_rate=0.02), live_twin(other, driven.path.ground)
    states = followed(model, path)
    whole = simulate_twin(other, driven)
    for name in (*MOTION, "deflection_rate"):
        found = np.array([getattr(s, name) for s in states])
        np.testing.assert_allclose(found, getattr(whole, name), rtol=1e-9, atol=1e-9)


def test_candidates_differ_in_parameters_and_in_the_place_of_the_sensor(
    car: Twin, other: Twin, driven: Excitation
) -> None:
    place = ("imu.position.0", "imu.position.2")
    stiffer = simulate_lanes(
        other,
        lanes(
            other, ("fmu.parameters.k_front.value", *place), np.array([[26e3, 0.2, 1.0], [40e3, 2.4, 0.5]])
        ),
        driven,
    )
    here = lanes(
        car, ("vehicle.front.spring.force.0", *place), np.array([[26e3, 0.2, 1.0], [40e3, 2.4, 0.5]])
    )
    # heave counts from standstill in both, so that only the acceleration can be compared
    wanted = simulate_lanes(car, here, driven).vertical_acceleration
    assert np.abs(stiffer.vertical_acceleration - wanted).max() < 0.01 * np.ptp(wanted)
    assert not stiffer.failed.any()


@pytest.mark.long
def test_effects_act_outside_of_it(car: Twin, other: Twin, file: Path, driven: Excitation) -> None:
    effects = tuple(
        {"id": name, "parameters": {key: value}}
        for name, key, value in (("road_scale", "scale", 0.8), ("time_offset", "offset", 0.013))
    )
    changed = fmu_twin(car, fmu_section(file, **STIFFNESS), effects)
    wanted = simulate_twin(car.with_changes({"effects": effects}), driven)
    assert deviation(simulate_twin(changed, driven), wanted) < 5e-3
    friction = fmu_twin(car, fmu_section(file, **STIFFNESS), ({"id": "strut_friction"},))
    with pytest.raises(
        InputError, match="strut_friction is not an effect of the model fmu, which has equations"
    ):
        simulate_twin(friction, driven)


def test_a_population_search_finds_its_parameters(
    car: Twin, file: Path, repository: Path, tmp_path: Path
) -> None:
    road = load_road(repository / "bags" / "bump_15kmh" / "road.crg")
    knots = ((0.0, 0.0), (2.0, 0.0), (5.0, 4.2), (12.0, 4.2))
    write_drive(synthetic_drive(car, road, knots, seed=3), tmp_path / "drive")
    start = {"c_front": (1300.0, 500.0, 6000.0), "c_rear": (4000.0, 500.0, 6000.0)}
    section = fmu_section(file, **{**STIFFNESS, **start}) | {"settle": 0.0}
    twin = fmu_twin(car, section)
    save_twin(twin, tmp_path / "twin.yaml")
    assert load_twin(tmp_path / "twin.yaml") == twin
    request = CalibrationRequest(
        twin=str(tmp_path / "twin.yaml"),
        bags=(str(tmp_path / "drive"),),
        preset="tracked_paper",
        max_generations=4,
    )
    result = calibrate(request)
    found = {e.key.split(".")[2]: e.value for e in result.estimates}
    assert found == pytest.approx({"c_front": 2600.0, "c_rear": 2200.0}, rel=0.15)
    assert result.drives[0].gap_after.rms < 0.5 * result.drives[0].gap_before.rms


TOOL = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

CORNERS = [f"{end}_{side}" for end in ("front", "rear") for side in ("left", "right")]
OUT = ["heave", "roll", "pitch", "angular_rate_x", "angular_rate_y", "heave_acceleration", "roll_acceleration"]
OUT += ["pitch_acceleration"] + [f"{n}_{c}" for n in ("deflection", "tyre_force") for c in CORNERS]


class Bounce(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        for name in OUT:
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        for corner in CORNERS:
            setattr(self, f"road_height_{corner}", 0.0)
            self.register_variable(Real(f"road_height_{corner}", causality=Fmi2Causality.input))
        self.square = 100.0
        kind = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.tunable}
        self.register_variable(Real("square", **kind))
        self.rate = 0.0

    def do_step(self, t, h):
        ground = sum(getattr(self, f"road_height_{corner}") for corner in CORNERS) / 4
        self.heave_acceleration = self.square * (ground - self.heave) - 3.0 * self.rate
        self.rate += h * self.heave_acceleration
        self.heave += h * self.rate
        return True
"""


def test_an_fmu_of_another_tool(car: Twin, tmp_path: Path, drive: Any, ground: Any) -> None:
    """A mass on a spring, made by PythonFMU, on a harmonic road."""
    builder = pytest.importorskip("pythonfmu.builder").FmuBuilder
    (tmp_path / "bounce.py").write_text(TOOL)
    path = builder.build_FMU(tmp_path / "bounce.py", dest=tmp_path)
    section = {"file": str(path), "parameters": {"stiffness": {"value": 200.0, "variable": "square"}}}
    wave = ground(lambda x, y: 110.0 + 0.02 * np.sin(0.5 * x))
    run = excitation(drive(2.0, speed=8.0), car.vehicle, wave)
    try:
        found = simulate_twin(fmu_twin(car, section), run)
    except InputError as error:  # it comes for x86-64, and wants Python as a shared library
        if "has no binary" in str(error) or "libpython" in str(error):
            pytest.skip(str(error))
        raise
    mean = run.road[run.first[1:] - 1].mean(axis=1)
    _, wanted, _ = lsim(([200.0], [1.0, 3.0, 200.0]), mean - mean[0], np.arange(mean.size) * 0.01)
    np.testing.assert_allclose(found.heave - mean[0], wanted, atol=2e-4)
    np.testing.assert_allclose(found.z, found.heave, atol=1e-12)  # it does not pitch


def changed(file: Path, out: Path, change: Callable[[str, bytes], tuple[str, bytes]]) -> Path:
    """A copy of an archive with names and contents changed."""
    with zipfile.ZipFile(file) as before, zipfile.ZipFile(out, "w") as after:
        for name in before.namelist():
            after.writestr(*change(name, before.read(name)))
    return out


def test_what_is_wrong_is_one_line(car: Twin, file: Path, driven: Excitation, tmp_path: Path) -> None:
    def said(section: dict[str, Any], kind: type[Exception] = InputError) -> str:
        with pytest.raises(kind) as raised:
            simulate_twin(fmu_twin(car, section), driven)
        return str(raised.value)

    good = fmu_section(file, **STIFFNESS)
    assert "fmu.file: there is no " in said({**good, "file": str(tmp_path / "none.fmu")})
    (tmp_path / "text.fmu").write_text("no archive")
    assert "text.fmu: is no FMU that can be read" in said({**good, "file": str(tmp_path / "text.fmu")})
    there = changed(
        file, tmp_path / "w.fmu", lambda n, b: (n.replace("linux64", "win64").replace(".so", ".dll"), b)
    )
    assert "has no binary for linux64, but for win64" in said({**good, "file": str(there)})
    old = changed(
        file, tmp_path / "o.fmu", lambda n, b: (n, b.replace(b'fmiVersion="2.0"', b'fmiVersion="1.0"'))
    )
    assert "o.fmu: " in said({**good, "file": str(old)})
    even = b'canHandleVariableCommunicationStepSize="true"'
    fixed = changed(
        file, tmp_path / "f.fmu", lambda n, b: (n, b.replace(even, even.replace(b"true", b"false")))
    )
    assert "takes steps of one length only" in said({**good, "file": str(fixed)})
    broken = changed(file, tmp_path / "b.fmu", lambda n, b: (n, b[:64] if n.endswith(".so") else b))
    assert "b.fmu: cannot be loaded" in said({**good, "file": str(broken)})
    text = said({**good, "outputs": {"heave": "z"}})
    assert "has no roll, pitch, " in text
    assert "under fmu.outputs" in text
    text = said({**good, "inputs": {**good["inputs"], "lateral_acceleration": "a_z"}})
    assert (
        "fmu.inputs.lateral_acceleration: a_z is not among its inputs of other_car.fmu, did you mean a_"
        in text
    )
    assert "fmu.outputs.heaven: is no connector, did you mean heave?" in said(
        {**good, "outputs": {"heaven": "z"}}
    )
    assert "fmu.parameters.k_fron: other_car.fmu has no k_fron, did you mean k_front?" in said(
        {**good, "parameters": {"k_fron": {"value": 1.0}}}
    )
    assert "z of other_car.fmu is no number that can be set" in said(
        {**good, "parameters": {"z": {"value": 1.0}}}
    )
    refused = said(fmu_section(file, k_front=-1.0), WorkError)
    assert "refuses its parameters" in refused
    assert "(a parameter must be above 0)" in refused
    stopped = said(fmu_section(file, **STIFFNESS, limit=0.01), WorkError)
    assert "fails in the step at " in stopped
    assert "(the suspension is at its stop)" in stopped


def test_without_fmpy_the_extra_is_named(
    other: Twin, driven: Excitation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(InputError, match=r"suspension-twin\[fmu\]"):
        simulate_twin(other, driven)


def test_a_step_that_fails_ends_one_candidate_and_no_live_twin(
    car: Twin, file: Path, driven: Excitation, drive: Any
) -> None:
    twin = fmu_twin(car, fmu_section(file, **STIFFNESS, limit=1.0))
    both = lanes(twin, ("fmu.parameters.limit.value",), np.array([[1.0], [0.01]]))
    assert simulate_lanes(twin, both, driven).failed.tolist() == [False, True]
    tight = fmu_twin(car, fmu_section(file, **STIFFNESS, limit=0.01))
    path, model = drive(3.0), live_twin(tight, driven.path.ground)
    states = followed(model, path)
    assert any("other_car.fmu: fails in the step" in s.event and "at its stop" in s.event for s in states)
    assert all(np.isfinite(s.vertical_acceleration) for s in states)


def test_a_twin_of_object_storage_brings_no_program(other: Twin, tmp_path: Path) -> None:
    filesystem = pytest.importorskip("fsspec").filesystem("memory")
    work = pytest.importorskip("suspension_twin.addons.fleet.work")
    save_twin(other, tmp_path / "twin.yaml")
    filesystem.pipe("/fleet/twin.yaml", (tmp_path / "twin.yaml").read_bytes())
    item = work.Item("car", "", "memory://fleet/twin.yaml", ("memory://fleet/drive.mcap",))
    with pytest.raises(InputError, match="fmu runs a program: such a twin must be a file here"):
        work.twin_and_road(item, tmp_path)


def test_a_result_of_a_fleet_names_its_program_from_where_it_lies(
    other: Twin, file: Path, tmp_path: Path
) -> None:
    ledger = pytest.importorskip("suspension_twin.addons.fleet.results").Ledger(tmp_path / "results")
    (tmp_path / "work" / "out").mkdir(parents=True)
    save_twin(other, tmp_path / "work" / "out" / "twin.yaml")  # where a worker writes it, and removes it
    text = (tmp_path / "work" / "out" / "twin.yaml").read_text()
    assert other.road is not None
    record = {
        "key": "ab" * 16,
        "road": str(other.road.file),
        "program": str(file),
        "files": {"twin.yaml": text},
    }
    ledger.save(record)
    assert load_twin(ledger.place("ab" * 16) / "twin.yaml") == other


def test_what_needs_the_equations_is_refused(other: Twin, repository: Path) -> None:
    with pytest.raises(InputError, match="fmu has equations of its own"):
        plan(other)
    with pytest.raises(InputError, match="a road is estimated with the axles of a car, fmu has none"):
        road_from_drives([read_drive(repository / "bags" / "bump_15kmh")], other)


def test_who_sends_a_goal_does_not_choose_a_program(other: Twin, repository: Path, tmp_path: Path) -> None:
    jobs = pytest.importorskip("suspension_twin.nodes.jobs")
    save_twin(other, tmp_path / "twin.yaml")
    goal = SimpleNamespace(
        twin=str(tmp_path / "twin.yaml"), bags=[str(repository / "bags" / "bump_15kmh")], preset="fast",
        output=str(tmp_path / "out.yaml"), seed=0, free=[], max_generations=1,
    )  # fmt: skip
    with pytest.raises(InputError, match="fmu runs a program: name it when the node is started"):
        jobs.calibration_job(goal, str(repository / "bags" / "bump_15kmh" / "twin.yaml"), 1)
    assert jobs.calibration_job(goal, goal.twin, 1).request.twin == goal.twin


def test_an_fmu_that_unpacks_to_a_thousand_times_its_size(tmp_path: Path) -> None:
    """Refused while it unpacks; so is a member that leads out of the archive."""
    for name, content, words in (
        ("resources/zeros", bytes(200 << 20), "unpacks to more than 64 MiB"),
        ("../outside", b"x", "leads out of the archive"),
        ("modelDescription.xml", b"<" + bytes(100 << 20), "unpacks to more than 64 MiB"),
    ):
        path = tmp_path / "bomb.fmu"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(name, content)
        with pytest.raises(InputError, match=words):
            connected(Fmu(file=path))
        assert not (tmp_path / "outside").exists()
