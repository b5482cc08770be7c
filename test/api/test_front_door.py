# SPDX-License-Identifier: Apache-2.0
"""``import suspension_twin as st``: imported at first use, on paths or objects; results print, plot and give arrays."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.axes import Axes

import suspension_twin as st
from suspension_twin.diagnosis.request import DiagnosisResult
from suspension_twin.drive.rig import read_rig
from suspension_twin.drive.types import Drive, cut
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.gap import Comparison, measure_gap

ROOT = Path(__file__).resolve().parents[2]
BAG = ROOT / "bags" / "crg_road"
CHANNEL = "vertical_acceleration"
CAUSE = {"parameters": {}, "gap_before": 0.4, "gap_after": 0.1, "shrink": 0.75}


@pytest.fixture(autouse=True)
def no_figure_is_left() -> Any:
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Twelve seconds of a bundled drive."""
    whole = st.read_drive(BAG)
    return cut(whole, whole.imu.t[0], whole.imu.t[0] + 12.0)


@pytest.fixture(scope="module")
def compared(drive: Drive) -> Comparison:
    return st.simulate(drive, BAG / "twin.yaml")


@pytest.fixture(scope="module")
def diagnosis() -> DiagnosisResult:
    """The answer to a diagnosis that nobody made."""
    causes = [{**CAUSE, "effect": "payload", "probability": 0.2}]
    document = {
        "verdict": "unknown",
        "gap": {"rms": 0.4, "channel": CHANNEL},
        "causes": causes,
        "combination": [],
        "probability": 0.7,
        "gap_after": 0.4,
        "candidates": [],
        "cannot_be_judged": [],
        "no_gap_probability": 0.1,
        "unknown_probability": 0.7,
        "next_experiment": "Drive over a sharp edge.",
    }
    return DiagnosisResult(document, st.load_twin(BAG / "twin.yaml"), (), 1.0, ("a warning\x1b[2J",))


def modules_after(code: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return set(done.stdout.split())


def test_importing_the_package_imports_nothing_else() -> None:
    plain = modules_after("import __future__, typing, importlib")
    named = modules_after("import suspension_twin as st; dir(st); st.__version__") - plain
    assert named == {"suspension_twin"}
    reading = modules_after("import suspension_twin as st; st.read_drive('bags/crg_road')")
    assert not {"numba", "matplotlib", "pandas", "rclpy", "pymoo"} & reading


def test_every_public_name_is_there_and_no_other() -> None:
    for name in st.__all__:
        assert getattr(st, name) is not None and name in dir(st)
    with pytest.raises(AttributeError, match="module 'suspension_twin' has no attribute 'simulat'"):
        getattr(st, "simulat")  # noqa: B009


def test_everything_that_is_read_prints_in_a_few_lines_and_draws_itself(drive: Drive) -> None:
    twin, road = st.load_twin(BAG / "twin.yaml"), st.read_road(BAG / "road.crg")
    said = {
        str(drive): ("Drive crg_road", "samples at", "gravity", "GPS"),
        str(st.import_drive(BAG)): ("Drive crg_road", "from: bag", "topics: /imu/data_raw"),
        str(twin): ("Ford Mondeo", "full_car", "effects: none", "road.crg"),
        str(road): ("Road", "m long", "heights", "without data"),
    }
    for text, words in said.items():
        assert len(text.splitlines()) < 10 and "array" not in text
        assert all(word in text for word in words), text
    assert repr(drive) == str(drive) and repr(twin) == str(twin) and repr(road) == str(road)
    assert repr(drive.imu) == f"ImuData({len(drive.imu)} samples)"
    for thing, lines in ((drive, 3), (road, 0)):
        ax = pyplot.subplots()[1]
        assert thing.plot(ax) is ax and len(ax.lines) == lines
        assert isinstance(thing.plot(), Axes)
    springs, dampers = twin.plot()
    assert dampers.lines[0].get_xdata().tolist() == [-0.4, -0.35, -0.25, -0.125, 0.0, 0.125, 0.25, 0.35, 0.4]
    assert twin.plot([springs, dampers])[1] is dampers and len(dampers.lines) == 4
    with pytest.raises(InputError, match="tracked has no characteristics"):
        st.load_twin(ROOT / "config" / "tracked" / "pt91.yaml").plot()


def test_measured_beside_simulated(drive: Drive, compared: Comparison) -> None:
    difference = (compared.measured[CHANNEL] - compared.simulated[CHANNEL])[compared.observation.driving]
    assert compared.t.shape == compared.measured[CHANNEL].shape
    assert np.sqrt(np.mean(difference**2)) == compared.gap.rms
    text = str(compared)
    assert f"{compared.gap.rms:.4f} m/s²" in text and "roll rate" in text and text.count("\n") < 12
    ax = compared.plot(channel="roll_rate")
    assert ax.get_ylabel() == "roll rate [rad/s]"
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), compared.simulated["roll_rate"])
    assert compared.plot(ax) is ax and ax.get_ylabel() == "vertical acceleration [m/s²]"


def test_paths_and_objects_give_the_same(drive: Drive, compared: Comparison) -> None:
    twin, road = st.load_twin(BAG / "twin.yaml"), st.read_road(BAG / "road.crg")
    for other in (st.simulate(drive, twin), st.simulate(drive, twin, road=road, outside="hold")):
        assert other.gap == compared.gap
    whole = st.simulate(st.import_drive(BAG), twin)
    assert whole.gap == st.simulate(str(BAG), twin, road=BAG / "road.crg").gap != compared.gap


def test_a_run_of_a_rig(drive: Drive) -> None:
    twin, run = (ROOT / "config" / part for part in ("twins/quarter_car.yaml", "rig/drops.csv"))
    result, other = st.simulate(run, twin), st.simulate(read_rig(run), st.load_twin(twin))
    assert result.gap == other.gap and "body acceleration" in str(result)
    everything = np.ones(result.t.size, dtype=np.bool_)
    again = measure_gap(result.measured, result.simulated, everything, 1.0, 0.0)
    assert again.rms == result.gap.rms
    assert result.plot().get_title().startswith("drops: gap")
    with pytest.raises(InputError, match="must be a path or a RigRecord, is a Drive"):
        st.simulate(drive, twin)


def test_a_calibration_of_objects_is_that_of_files(pass_case: Any) -> None:
    choices: dict[str, Any] = {"free": ["vehicle.front.damper_push"], "seed": 3, "max_generations": 4}
    choices["bounds"] = {"vehicle.front.damper_push.force.0": (150.0, 250.0)}
    seen: list[str] = []
    by_path = st.calibrate(pass_case.twin, pass_case.bag("pass"), **choices)
    by_object = st.calibrate(
        st.load_twin(pass_case.twin),
        [st.read_drive(pass_case.bag("pass"))],
        on_progress=lambda step: seen.append(step.stage),
        **choices,
    )
    assert by_path.twin == by_object.twin and by_path.cost == by_object.cost < by_path.initial_cost
    assert (by_path.estimates[0].lower, by_path.estimates[0].upper) == (150.0, 250.0) and "search" in seen
    text = str(by_object)
    assert text.startswith("Calibration of Ford Mondeo") and text.count("\n") < 12
    assert "pass: gap in vertical acceleration" in text and "4 parameters" in text
    ax = by_object.plot()
    assert by_object.plot(ax) is ax and [line.get_label() for line in ax.lines[:3]] == [
        "before",
        "measured",
        "after",
    ]
    table = by_object.to_frame()
    assert table.index.tolist() == [e.key for e in by_object.estimates]
    assert table["value"].tolist() == [e.value for e in by_object.estimates]


def test_a_diagnosis_prints_and_draws_what_is_likeliest(diagnosis: DiagnosisResult) -> None:
    assert diagnosis.probabilities == {"unknown": 0.7, "payload": 0.2, "no_gap": 0.1}
    assert list(diagnosis.probabilities) == ["unknown", "payload", "no_gap"]
    text = str(diagnosis)
    assert text.startswith("Diagnosis of Ford Mondeo") and "\x1b" not in text
    assert "unknown 0.700, payload 0.200" in text and "sharp edge" in text
    ax = diagnosis.plot(most=2)
    assert [label.get_text() for label in ax.get_yticklabels()] == ["payload", "unknown"]
    assert diagnosis.to_frame().loc["payload", "probability"] == 0.2


@pytest.mark.long
def test_a_diagnosis_takes_objects() -> None:
    twin, drive = st.load_twin(BAG / "truth.yaml"), st.read_drive(BAG)
    result = st.diagnose(twin, drive, effects=["strut_friction"])
    assert result.drives[0].name == drive.name
    assert set(result.probabilities) == {"strut_friction", "no_gap", "unknown"}


def test_tables_and_what_is_missing_without_pandas(
    drive: Drive, compared: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples, signals = drive.to_frame(), compared.to_frame()
    np.testing.assert_array_equal(samples["force_z"], drive.imu.specific_force[:, 2])
    np.testing.assert_array_equal(samples.index, drive.imu.t)
    np.testing.assert_array_equal(signals[f"simulated_{CHANNEL}"], compared.simulated[CHANNEL])
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(WorkError, match="pip install pandas"):
        drive.to_frame()


@pytest.mark.parametrize(
    ("work", "named"),
    [
        (lambda: st.read_road(ROOT / "nowhere.crg"), r"nowhere\.crg"),
        (lambda: st.import_drive([]), "no file given"),
        (lambda: st.simulate(BAG, ROOT / "nowhere.yaml"), r"nowhere\.yaml"),
        (lambda: st.simulate(np.zeros(3), BAG / "twin.yaml"), "must be a path or a Drive, is a ndarray"),  # type: ignore[arg-type]
        (lambda: st.calibrate(BAG / "twin.yaml", [3]), "must be paths or drives, not a int"),  # type: ignore[list-item]
        (lambda: st.calibrate(BAG / "twin.yaml", BAG, free=["vehicle.wings"]), "vehicle.wings"),
        (lambda: st.diagnose(BAG / "twin.yaml", ROOT / "nowhere"), "nowhere"),
    ],
)
def test_what_cannot_be_used_is_named(work: Callable[[], object], named: str) -> None:
    with pytest.raises((InputError, OSError), match=named):
        work()
