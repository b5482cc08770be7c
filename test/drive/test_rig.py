# SPDX-License-Identifier: Apache-2.0
"""Runs of a rig: units in the header, recordings, and what is refused with one clear line."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from suspension_twin.cli.main import main
from suspension_twin.drive.importing import import_rig
from suspension_twin.drive.rig import RigRecord, driven_by_wheel, read_rig, write_rig
from suspension_twin.drive.write import BagWriter
from suspension_twin.errors import InputError, WorkError

T = np.arange(200) / 100
ROAD = 0.01 * np.sin(2 * np.pi * 2 * T)
BODY = 0.5 * np.cos(2 * np.pi * 2 * T)


def table(path: Path, header: str, *columns: np.ndarray, separator: str = ",") -> Path:
    rows = (separator.join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True))
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "separator"),
    [
        ("time_ms,road_displacement_mm,body_acceleration_g,actuator_force_kN", ","),
        ("Time [ms];Road_displacement (mm);Body_acceleration [g];Actuator_force_kn", ";"),
    ],
)
def test_units_are_in_the_header(tmp_path: Path, header: str, separator: str) -> None:
    file = table(
        tmp_path / "run.csv", header, 1e3 * T, 1e3 * ROAD, BODY / 9.80665, 0.1 + 0 * T, separator=separator
    )
    run = read_rig(file)
    assert run.name == "run" and run.t == pytest.approx(T) and run.warnings == ()
    assert run.columns["road_displacement"] == pytest.approx(ROAD, abs=1e-9)
    assert run.columns["body_acceleration"] == pytest.approx(BODY, abs=1e-8)
    assert run.columns["actuator_force"] == pytest.approx(100.0)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    columns = {"road_velocity": ROAD, "body_acceleration": BODY, "tyre_force": 1e3 * BODY}
    write_rig(RigRecord("run", 1.7e9 + T, columns), tmp_path / "new" / "run.csv", "a comment")
    run = read_rig(tmp_path / "new" / "run.csv")
    assert run.t == pytest.approx(1.7e9 + T, abs=1e-6) and set(run.columns) == set(columns)
    assert run.columns["tyre_force"] == pytest.approx(1e3 * BODY, rel=1e-5)
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkError, match="file"):
        write_rig(run, tmp_path / "file" / "run.csv")


def test_a_recording_has_joints_and_accelerometers(tmp_path: Path) -> None:
    """Joint states of another rate than the accelerometers, brought to the stamps of the body's."""
    fine = 1.7e9 + np.arange(-20, 420) / 200
    phase = 2 * np.pi * 2 * (fine - 1.7e9)
    joints = np.c_[0.002 * np.cos(phase), 0.01 * np.sin(phase)]
    with BagWriter(tmp_path / "run") as bag:
        for topic, scale in (("/imu/data_raw", 1.0), ("/wheel/imu/data_raw", 2.0)):
            # before the clock was set
            bag.write(topic, "sensor_msgs/msg/Imu", np.array([3, 3]), {"linear_acceleration.z": 9.81})
            bag.write(topic, "sensor_msgs/msg/Imu", 1.7e9 + T, {"linear_acceleration.z": 9.81 + scale * BODY})
        names = {"name": ["suspension", "road"], "position": joints, "effort": np.zeros_like(joints)}
        bag.write("/joint_states", "sensor_msgs/msg/JointState", fine, names)
    run = read_rig(tmp_path / "run")
    assert run.t == pytest.approx(1.7e9 + T, abs=1e-6)
    assert len(run.warnings) == 2 and "1 stamps lie far from the others" in run.warnings[0]
    assert run.columns["road_displacement"] == pytest.approx(ROAD, abs=1e-6)
    assert run.columns["suspension_deflection"] == pytest.approx(0.004 * BODY, abs=1e-6)
    assert run.columns["wheel_acceleration"] == pytest.approx(9.81 + 2 * BODY, abs=1e-9)
    assert not run.columns["actuator_force"].any() and "road_velocity" not in run.columns


def test_a_recording_without_a_body_accelerometer_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        bag.write("/fix", "sensor_msgs/msg/NavSatFix", 1.7e9 + T, {})
    with pytest.raises(InputError, match=r"run: /imu/data_raw: is missing, there are /fix"):
        read_rig(tmp_path / "run")


@pytest.mark.parametrize(
    ("header", "change", "message"),
    [
        (
            "time_s,road_displacement_m,body_acceleration",
            {},
            r"body_acceleration: needs a unit: body_acceleration_m_s2",
        ),
        (
            "time_s,road_displacement_m,body_acc_m_s2",
            {},
            "body_acceleration: is missing, there are time, road_disp",
        ),
        (
            "time_s,road_m,body_acceleration_m_s2",
            {},
            "road_displacement: is missing, and so is road_velocity",
        ),
        ("time_s,road_displacement_m,road_displacement_mm", {}, "road_displacement: has two columns"),
        ("time_s,road_displacement_m,body_acceleration_m_s2", {0: T[::-1]}, "time: does not rise in row 2"),
        (
            "time_s,road_displacement_m,body_acceleration_m_s2",
            {2: BODY * np.nan},
            "body_acceleration: is no number in",
        ),
        (
            "time_s,road_displacement_m,body_acceleration_m_s2",
            {1: 1e3 * ROAD},
            "ranges over 20 m: is its unit another",
        ),
    ],
)
def test_bad_tables(tmp_path: Path, header: str, change: dict[int, np.ndarray], message: str) -> None:
    columns = [change.get(i, values) for i, values in enumerate((T, ROAD, BODY))]
    with pytest.raises(InputError, match=message):
        read_rig(table(tmp_path / "run.csv", header, *columns))


def test_bad_files(tmp_path: Path) -> None:
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "zeros.csv").write_bytes(bytes(5000))
    for name, message in (
        ("none.csv", "No such file"),
        ("empty.csv", "empty"),
        ("zeros.csv", "not a text file"),
    ):
        with pytest.raises(InputError, match=f"{name}: {message}"):
            read_rig(tmp_path / name)
    with pytest.raises(InputError, match="no recording"):
        read_rig(tmp_path)


def test_columns_that_mean_nothing_are_named(tmp_path: Path) -> None:
    header = "time_s,road_displacement_m,body_acceleration_m_s2,oil_temperature"
    run = read_rig(table(tmp_path / "run.csv", header, T, ROAD, BODY, 0 * T))
    assert run.warnings == ("columns not used: oil_temperature",)


def test_other_columns_that_begin_with_time_are_not_the_time(tmp_path: Path) -> None:
    header = "time_s,time_offset,Time - Base Plate (m),road_displacement_m,body_displacement_mm"
    rows = np.column_stack([T, T + 5.0, ROAD, ROAD, 1e3 * BODY])
    path = tmp_path / "run.csv"
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    record = read_rig(path)
    np.testing.assert_allclose(record.t, T)
    assert record.warnings == ("columns not used: time_offset, Time - Base Plate (m)",)
    np.testing.assert_allclose(record.columns["body_displacement"], BODY)
    path.write_text(path.read_text().replace("time_s", "seconds"))
    with pytest.raises(InputError, match=r"time: is missing, .* a mapping file names"):
        read_rig(path)


def test_channels_follow_from_displacements() -> None:
    t = np.arange(0.0, 2.0, 0.004)
    body, wheel = np.sin(9.0 * t), 0.5 * np.sin(31.0 * t)
    record = RigRecord("run", t, {"body_displacement": body, "wheel_displacement": wheel})
    inner = slice(20, -20)
    for name, exact in (
        ("body_acceleration", -81.0 * body),
        ("wheel_acceleration", -(31.0**2) * wheel),
        ("suspension_deflection", wheel - body),
    ):
        found = record.channel(name)
        assert found is not None
        np.testing.assert_allclose(found[inner], exact[inner], atol=1e-3 * np.abs(exact).max())
    assert record.channel("tyre_force") is None


def mapped(folder: Path, columns: str) -> Path:
    """Two files of a logger, input and output apart at stamps of their own, and a mapping of them."""
    np.savetxt(
        folder / "a_output.csv",
        np.c_[T, ROAD, 1e3 * BODY],
        delimiter=",",
        header="Time,Plate,Body",
        comments="",
    )
    late = T[::2] + 0.001
    np.savetxt(folder / "a_input.csv", np.c_[late, late], delimiter=",", header="Time - Fc,Fc", comments="")
    path = folder / "map.yaml"
    path.write_text(f"name: a\nrig:\n  file: '*output*.csv'\n  time: {{column: Time}}\n  columns:\n{columns}")
    return path


COLUMNS = """
    road_displacement: {column: Plate, unit: m}
    body_displacement: {column: 2, unit: mm, sign: -1}
    actuator_force: {file: "*input*.csv", column: Fc, unit: kN, sign: -1, time: {column: 0}}
"""


def test_a_mapping_joins_files_with_their_units_and_signs(tmp_path: Path) -> None:
    mapping, out = mapped(tmp_path, COLUMNS), tmp_path / "run.csv"
    files = [str(tmp_path / f"a_{kind}.csv") for kind in ("output", "input")]
    assert main(["import", *files, "--mapping", str(mapping), "--out", str(out)]) == 0
    record = read_rig(out)
    t = record.t + T[T >= 0.001][0]  # from the first stamp of both files on
    np.testing.assert_allclose(record.columns["body_displacement"], -np.interp(t, T, BODY), atol=1e-5)
    np.testing.assert_allclose(record.columns["actuator_force"], -1e3 * t, rtol=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("unit: kN", "unit: lbf", r"actuator_force: unit must be one of n, kn, is 'lbf'"),
        ("road_displacement", "road_height", "road_height is none of road_displacement"),
        (", time: {column: 0}", "", r"actuator_force.*rows for .* stamps"),
        ("column: Plate", "column: Nothing", "Nothing"),
    ],
)
def test_a_wrong_mapping_of_a_rig_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    mapping = mapped(tmp_path, COLUMNS.replace(old, new))
    with pytest.raises(InputError, match=message):
        import_rig([tmp_path / "a_output.csv", tmp_path / "a_input.csv"], mapping)


MAT_MAP = """
name: bench
rig:
  file: "*.mat"
  time: {column: log.time}
  columns:
    road_displacement: {column: plate, unit: mm}
    body_displacement: {column: log.heights.1, unit: m, sign: -1}
    actuator_force: {column: force.signals.values, unit: kN, time: {column: force.time}}
"""


@pytest.mark.parametrize("compressed", [False, True])
def test_a_mat_file_is_mapped_by_the_names_of_its_variables(tmp_path: Path, compressed: bool) -> None:
    """Vectors, columns of a matrix, fields of structs as Simulink writes them, each at stamps of its own."""
    late = T[::2] + 0.001
    content = {
        "plate": 1e3 * ROAD,
        "log": {"time": T, "heights": np.c_[ROAD, -BODY, BODY]},
        "force": {"time": late, "signals": {"values": late, "label": "F"}},
        "comment": "a rig",
    }
    savemat(tmp_path / "bench.mat", content, do_compression=compressed)
    (tmp_path / "map.yaml").write_text(MAT_MAP)
    record = import_rig([tmp_path / "bench.mat"], tmp_path / "map.yaml")
    t = record.t + T[T >= 0.001][0]
    np.testing.assert_allclose(record.columns["body_displacement"], np.interp(t, T, BODY), atol=1e-6)
    np.testing.assert_allclose(record.columns["road_displacement"], np.interp(t, T, ROAD), atol=1e-6)
    np.testing.assert_allclose(record.columns["actuator_force"], 1e3 * t, rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("column: plate", "column: plates", r"plates.*plate, log\.time, log\.heights\.0"),
        ("column: plate,", "column: 3,", r"column 3: name one of plate, log\.time"),
        (", time: {column: force.time}", "", r"actuator_force.*rows for .* stamps"),
    ],
)
def test_a_wrong_name_of_a_variable_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    savemat(
        tmp_path / "bench.mat",
        {
            "plate": ROAD,
            "log": {"time": T, "heights": np.c_[ROAD, BODY]},
            "force": {"time": T[::2], "signals": {"values": T[::2]}},
        },
    )
    (tmp_path / "map.yaml").write_text(MAT_MAP.replace(old, new))
    with pytest.raises(InputError, match=message):
        import_rig([tmp_path / "bench.mat"], tmp_path / "map.yaml")


MEASURED_MAP = """
name: bench
rig:
  time: {}
  columns:
    road_displacement: {column: Rig/plate, unit: mm}
    body_displacement: {column: Rig/body, unit: m, sign: -1}
    actuator_force: {column: Drive/force, unit: kN}
"""
RIG_CHANNELS = {"Rig/plate": (T, 1e3 * ROAD), "Rig/body": (T, -BODY), "Drive/force": (T[::2] + 0.001, T[::2])}


def write_mdf(path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    measurement = asammdf.MDF(version="4.10")
    for name, (t, values) in RIG_CHANNELS.items():
        measurement.append([asammdf.Signal(values, t, name=name)])
    measurement.save(path)


def write_tdms(path: Path, *, waveforms: bool = True) -> None:
    """By npTDMS' own writer; without ``waveforms`` as LabVIEW writes XY data, with channels for the time."""
    nptdms = pytest.importorskip("nptdms")
    start, channels = datetime(2024, 5, 1), []
    for name, (t, values) in RIG_CHANNELS.items():
        late = start + timedelta(seconds=float(t[0]))
        stamps = {"wf_start_time": late, "wf_start_offset": 0.0, "wf_increment": float(t[1] - t[0])}
        group, _, own = name.partition("/")
        channels.append(nptdms.ChannelObject(group, own, values, stamps if waveforms else {}))
        if not waveforms:
            channels.append(nptdms.ChannelObject(group, f"time of {own}", t))
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(channels)


@pytest.mark.parametrize(("write", "name"), [(write_mdf, "bench.mf4"), (write_tdms, "bench.tdms")])
def test_channels_of_a_measurement_are_a_run(
    tmp_path: Path, write: Callable[[Path], None], name: str
) -> None:
    write(tmp_path / name)
    (tmp_path / "map.yaml").write_text(MEASURED_MAP)
    record = import_rig([tmp_path / name], tmp_path / "map.yaml")
    t = record.t + T[T >= 0.001][0]
    # POSIX times in a double are 0.2 µs apart
    np.testing.assert_allclose(record.columns["road_displacement"], np.interp(t, T, ROAD), atol=1e-6 * 0.13)
    np.testing.assert_allclose(record.columns["body_displacement"], np.interp(t, T, BODY), atol=1e-6 * 6.3)
    np.testing.assert_allclose(record.columns["actuator_force"], 1e3 * (t - 0.001), atol=1e-6 * 1e3)


def test_channels_of_tdms_without_stamps_are_rows(tmp_path: Path) -> None:
    write_tdms(tmp_path / "bench.tdms", waveforms=False)
    (tmp_path / "map.yaml").write_text(MEASURED_MAP)
    with pytest.raises(InputError, match=r"channel Drive/force: has \d+ values and no stamps for \d+ rows"):
        import_rig([tmp_path / "bench.tdms"], tmp_path / "map.yaml")
    without = MEASURED_MAP.replace("    actuator_force: {column: Drive/force, unit: kN}\n", "")
    (tmp_path / "map.yaml").write_text(without)
    with pytest.raises(InputError, match="channels without stamps: name the one that is their time"):
        import_rig([tmp_path / "bench.tdms"], tmp_path / "map.yaml")
    (tmp_path / "map.yaml").write_text(without.replace("time: {}", "time: {column: Rig/time of body}"))
    record = import_rig([tmp_path / "bench.tdms"], tmp_path / "map.yaml")
    np.testing.assert_allclose(record.t, T - T[0], atol=1e-9)
    np.testing.assert_allclose(record.columns["body_displacement"], BODY, atol=1e-12)
    (tmp_path / "map.yaml").write_text(without.replace("Rig/body", "Rig/bodies"))
    with pytest.raises(InputError, match=r"channel Rig/bodies: is not there; the channels are Drive/force, "):
        import_rig([tmp_path / "bench.tdms"], tmp_path / "map.yaml")


def test_both_hubs_of_an_axle_are_their_mean(tmp_path: Path) -> None:
    """Each in its own unit, sign and stamps."""
    mapped(tmp_path, COLUMNS)
    right = '{file: "*input*.csv", column: Fc, unit: m, time: {column: 0}}'
    hubs = f"[{{column: Plate, unit: mm, sign: -1}}, {right}]"
    mapping = mapped(tmp_path, f"{COLUMNS}    wheel_displacement: {hubs}\n")
    record = import_rig([tmp_path / f"a_{kind}.csv" for kind in ("output", "input")], mapping)
    t = record.t + T[T >= 0.001][0]
    wanted = 0.5 * (-1e-3 * np.interp(t, T, ROAD) + t)
    np.testing.assert_allclose(record.columns["wheel_displacement"], wanted, atol=1e-9)


SPIN_MAP = """
rig:
  time: {column: 0}
  columns:
    body_acceleration: {column: 1, unit: m/s2}
    wheel_acceleration: {column: [2, 3], unit: g, spin: {column: 4, unit: deg/s}}
"""


@pytest.mark.parametrize("side", [1, -1])
def test_an_accelerometer_that_turns_with_its_wheel_is_turned_upright(tmp_path: Path, side: int) -> None:
    """What it reads follows from where it is, by differences of its path: beside the axle of a hub that moves forwards
    and up and down, on a wheel that speeds up; on the other ``side`` of the car its axle points the other way."""
    t = np.arange(0.0, 40.0, 0.005)
    fine = np.arange(-2, t.size * 5 + 3) * 0.001
    driven = 2.0 * fine + 0.15 * fine**2 + 0.01 * np.sin(2 * np.pi * 1.1 * fine)
    height = 0.004 * np.sin(2 * np.pi * 3.0 * fine) + 0.001 * np.sin(2 * np.pi * 9.0 * fine)
    angle = -side * driven / 0.3 + 1.0
    path = side * driven + 1j * height + (0.02 - 0.013j) * np.exp(1j * angle)
    felt = np.gradient(np.gradient(path, 0.001), 0.001) + 9.81j
    read = felt * np.exp(-1j * angle) + (0.05 + 0.02j)  # a bias of its own
    at = slice(2, -5, 5)
    spin = np.gradient(angle, 0.001)
    columns = [t, 0.0 * t, read.real[at] / 9.80665, read.imag[at] / 9.80665, np.degrees(spin[at])]
    table(tmp_path / "hub.csv", "t,body,x,y,spin", *(x[: t.size] for x in columns))
    (tmp_path / "map.yaml").write_text(SPIN_MAP)
    found = import_rig([tmp_path / "hub.csv"], tmp_path / "map.yaml").columns["wheel_acceleration"]
    wanted = np.gradient(np.gradient(height, 0.001), 0.001)[at][: t.size]
    inside = (t > 5.0) & (t < 35.0)
    off = found - found.mean() - wanted
    assert np.std(off[inside]) < 0.02 * np.std(wanted)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("column: [2, 3]", "column: 2", "two columns and spin belong together"),
        ("unit: deg/s", "unit: rpm", "must be one of rad/s"),
        (
            "{column: [2, 3], unit: g, spin: {column: 4, unit: deg/s}}",
            "[]",
            "wheel_acceleration.* at least 1",
        ),
        ("", "", r"hub\.csv: spin: which way is up shows in 20 s or more, not in 1\.99"),
    ],
)
def test_a_spin_that_cannot_be_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    table(tmp_path / "hub.csv", "t,body,x,y,spin", *[T] * 5)
    (tmp_path / "map.yaml").write_text(SPIN_MAP.replace(old, new))
    with pytest.raises(InputError, match=message):
        import_rig([tmp_path / "hub.csv"], tmp_path / "map.yaml")


@pytest.mark.parametrize("seconds", [10.0, 12.3])
def test_a_wheel_that_moves_to_the_end_of_a_run(seconds: float) -> None:
    """Its accelerometer gives its velocity from the first to the last sample."""
    t, w = np.arange(0.0, seconds, 0.0025), 2 * np.pi * 1.3
    pull = {"body_acceleration": 0.0 * t, "wheel_acceleration": 9.81 - w * np.sin(w * t)}
    found = driven_by_wheel(RigRecord("run", t, pull)).columns["road_velocity"]
    assert np.abs(found - np.cos(w * t)).max() < 0.1
