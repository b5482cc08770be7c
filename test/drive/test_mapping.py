# SPDX-License-Identifier: Apache-2.0
"""Tables of any shape by a mapping file: delimiters, units, axes, time bases, and what is wrong with a mapping."""

from __future__ import annotations

import csv
import io
import struct
import sys
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from suspension_twin.drive.clocks import iso_to_posix
from suspension_twin.drive.foreign_files import read_table
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.mapping import load_mapping
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError

G = 9.80665
RNG = np.random.default_rng(9)
N = 300
T = np.arange(N) / 100
FORCE = RNG.normal(size=(N, 3)) + np.array([0, 0, G])
RATE = RNG.normal(size=(N, 3))
START = iso_to_posix("2024-05-01T10:00:00")


# --- tables


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    rows=st.integers(2, 30),
    columns=st.integers(2, 6),
    delimiter=st.sampled_from([",", ";", "\t"]),
    comma=st.booleans(),
    header=st.booleans(),
    quoted=st.booleans(),
    newline=st.sampled_from(["\n", "\r\n"]),
    mark=st.booleans(),
)
def test_any_table_is_read_as_it_was_written(
    seed: int,
    rows: int,
    columns: int,
    delimiter: str,
    comma: bool,
    header: bool,
    quoted: bool,
    newline: str,
    mark: bool,
) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(rows, columns)) * 10.0 ** rng.integers(-8, 8, size=columns)
    # a comma as decimal sign needs quotes where it also parts the fields
    quoting = csv.QUOTE_ALL if quoted or (comma and delimiter == ",") else csv.QUOTE_MINIMAL
    text = io.StringIO()
    writer = csv.writer(text, delimiter=delimiter, quoting=quoting, lineterminator=newline)
    names = [f"Größe {i} (m/s²)" for i in range(columns)]
    if header:
        writer.writerow(names)
    for row in values:
        writer.writerow([repr(float(v)).replace(".", ",") if comma else repr(float(v)) for v in row])
    data = text.getvalue().encode("utf-8-sig" if mark else "utf-8")
    table = read_table(data, "t.csv")
    assert (table.rows, table.names) == (rows, names if header else [])
    np.testing.assert_array_equal(table.vector(list(range(columns))), values)
    if header:
        np.testing.assert_array_equal(table.numbers(names[-1].upper()), values[:, -1])


def test_lines_that_are_not_whole_are_left_out() -> None:
    data = b"7,8.5\n0.1,0.2,0.3\n0.4,0.5,0.6\n,nan,x\n0.7,0.8,0.9\n1.0,1"
    table = read_table(data, "imu.csv", header=False)
    np.testing.assert_array_equal(table.numbers(0), [0.1, 0.4, np.nan, 0.7])
    assert "2 lines are not whole" in table.warnings[0]


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize(
    "before", [[], [""], ["made by", "", "Format,3", ""], ["", "", "#c", "x"], ["a,b,c", "", "1,2,3"]]
)
def test_lines_to_skip_are_lines_of_the_file(before: list[str], newline: str) -> None:
    """As an editor counts them: empty ones and comments too."""
    data = newline.join([*before, "t,ax", "", "0.5,1", "1.5,2"]).encode()
    table = read_table(data, "t.csv", header=len(before))
    assert table.names == ["t", "ax"] and table.numbers("t").tolist() == [0.5, 1.5]
    with pytest.raises(InputError, match="no row of names after the lines to skip"):
        read_table(data, "t.csv", header=len(before) + 4)


def test_other_encodings() -> None:
    text = "Zeit (s);Länge (°)\n0,5;19,25\n1,5;19,5\n"
    for encoding, legacy in (("utf-8", False), ("utf-8-sig", False), ("utf-16", False), ("latin-1", True)):
        table = read_table(text.encode(encoding), "t.csv")
        assert table.names == ["Zeit (s)", "Länge (°)"]
        assert table.numbers("Länge (°)").tolist() == [19.25, 19.5]
        assert bool(table.warnings) == legacy


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "empty"),
        (b"\n \n# note\n", "empty"),
        (b"a,b\n", "no rows"),
        (bytes(500), "not a text"),
        (b"\0\1\2," * 9, "not a text"),
    ],
)
def test_what_is_no_table(data: bytes, words: str) -> None:
    with pytest.raises(InputError, match=rf"t\.csv: .*{words}"):
        read_table(data, "t.csv")


def test_a_column_that_is_not_there_lists_those_that_are() -> None:
    table = read_table(b"t,ax\n1,2\n", "t.csv")
    with pytest.raises(InputError, match=r"t\.csv: column az: is not there; the columns are t, ax"):
        table.numbers("az")
    with pytest.raises(InputError, match="column 5"):
        table.numbers(5)


# --- mappings


def _table(path: Path, t: Any, force: np.ndarray = FORCE, rate: np.ndarray = RATE) -> Path:
    rows = ["t,ax,ay,az,gx,gy,gz"]
    rows += [
        ",".join([str(stamp), *(repr(float(v)) for v in (*f, *r))])
        for stamp, f, r in zip(t, force, rate, strict=True)
    ]
    path.write_text("\n".join(rows) + "\n")
    return path


def _mapping(path: Path, imu: dict[str, Any] | None = None, **more: Any) -> Path:
    default: dict[str, Any] = {
        "time": {"column": "t"},
        "specific_force": {"columns": ["ax", "ay", "az"], "unit": "m/s2"},
        "angular_rate": {"columns": ["gx", "gy", "gz"], "unit": "rad/s"},
    }
    for key, value in (imu or {}).items():
        default[key] = {**default[key], **value} if isinstance(value, dict) else value
    path.write_text(yaml.safe_dump({"imu": default, **more}))
    return path


def _read(tmp_path: Path, t: Any, imu: dict[str, Any] | None = None, **more: Any) -> Drive:
    table = _table(tmp_path / "imu.csv", t)
    return import_drive([table], mapping=_mapping(tmp_path / "map.yaml", imu, **more)).drive


def test_columns_by_name_and_by_number(tmp_path: Path) -> None:
    drive = _read(tmp_path, START + T)
    np.testing.assert_array_equal(drive.imu.specific_force, FORCE)
    np.testing.assert_array_equal(drive.imu.angular_rate, RATE)
    np.testing.assert_allclose(drive.imu.t, START + T, atol=1e-6)
    imu = {
        "specific_force": {"columns": [1, 2, 3]},
        "angular_rate": {"columns": [4, 5, 6]},
        "time": {"column": 0},
    }
    np.testing.assert_array_equal(_read(tmp_path, START + T, imu).imu.angular_rate, RATE)


@pytest.mark.parametrize(
    ("force_unit", "force_scale", "rate_unit", "rate_scale"),
    [("g", G, "deg/s", np.pi / 180), ("mg", G / 1000, "dps", np.pi / 180), ("m/s²", 1.0, "°/s", np.pi / 180)],
)
def test_units(
    force_unit: str, force_scale: float, rate_unit: str, rate_scale: float, tmp_path: Path
) -> None:
    imu = {"specific_force": {"unit": force_unit}, "angular_rate": {"unit": rate_unit}}
    drive = _read(tmp_path, START + T, imu)
    np.testing.assert_allclose(drive.imu.specific_force, FORCE * force_scale, rtol=1e-14)
    np.testing.assert_allclose(drive.imu.angular_rate, RATE * rate_scale, rtol=1e-14)


def test_axes_and_angles(tmp_path: Path) -> None:
    imu: dict[str, Any] = {
        "specific_force": {"axes": ["-y", "x", "z"]},
        "angular_rate": {"rpy_deg": [180, 0, 90]},
    }
    drive = _read(tmp_path, START + T, imu)
    np.testing.assert_array_equal(
        drive.imu.specific_force, np.stack([-FORCE[:, 1], FORCE[:, 0], FORCE[:, 2]], axis=1)
    )
    # upside down (y and z reversed), then turned left: x to y, the new y to -x
    np.testing.assert_allclose(
        drive.imu.angular_rate, np.stack([RATE[:, 1], RATE[:, 0], -RATE[:, 2]], axis=1), atol=1e-12
    )
    imu = {"specific_force": {"rpy": [0.1, -0.2, 3.0]}}
    expected = Rotation.from_euler("ZYX", [3.0, -0.2, 0.1]).apply(FORCE)
    np.testing.assert_allclose(_read(tmp_path, START + T, imu).imu.specific_force, expected, atol=1e-12)


@pytest.mark.parametrize(("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("µs", 1e6), ("ns", 1e9)])
def test_time_units_and_starts(unit: str, scale: float, tmp_path: Path) -> None:
    numbers = [round(x * scale, 6) for x in T]
    time = {"unit": unit, "base": "start", "start": "2024-05-01T12:00:00+02:00"}
    np.testing.assert_allclose(_read(tmp_path, numbers, {"time": time}).imu.t, START + T, atol=1e-6)
    np.testing.assert_allclose(_read(tmp_path, numbers, {"time": {"unit": unit}}).imu.t, T, atol=1e-6)


def test_time_bases(tmp_path: Path) -> None:
    gps = START + 18 - 315_964_800
    for time, stamps in (
        ({"base": "gps"}, gps + T),
        ({"base": "text"}, [f"2024-05-01 10:00:{x:06.3f}" for x in T]),
    ):
        np.testing.assert_allclose(_read(tmp_path, stamps, {"time": time}).imu.t, START + T, atol=1e-6)
    rows = ["week,tow,ax,ay,az,gx,gy,gz"]
    for x, f, r in zip(T, FORCE, RATE, strict=True):
        moment = gps + x
        values = ",".join(repr(float(v)) for v in (*f, *r))
        rows.append(f"{moment // 604800:.0f},{moment % 604800:.3f},{values}")
    (tmp_path / "imu.csv").write_text("\n".join(rows))
    mapping = _mapping(tmp_path / "map.yaml", {"time": {"base": "gps_week", "columns": ["week", "tow"]}})
    drive = import_drive([tmp_path / "imu.csv"], mapping=mapping).drive
    np.testing.assert_allclose(drive.imu.t, START + T, atol=1e-6)


MOMENTS = {
    "2019-09-07 %H:%M:%S:{ms}": "",
    "2019-09-07 %H:%M:%S.{ms} UTC+00:00": "",
    "07/09/2019 %H:%M:%S.{ms}": "",  # Americans' July, at the same time of the day
    "13/09/2019 %H:%M:%S.{ms}": "",
    "%H:%M:%S.{ms}": "2019-09-07",
    "%H:%M:%S:{ms}": "2019-09-07T00:00:00Z",
}


@pytest.mark.parametrize("form", MOMENTS)
def test_times_as_apps_write_them(form: str, tmp_path: Path) -> None:
    start = datetime(2019, 9, 7, 23, 59, 59, 6000)
    moments = [start + timedelta(seconds=float(t)) for t in T if t < 0.99]
    if not MOMENTS[form]:
        moments = [moment - timedelta(hours=3) for moment in moments]
    stamps = [moment.strftime(form).format(ms=f"{moment.microsecond // 1000:03}") for moment in moments]
    n = len(stamps)
    table = _table(tmp_path / "log.csv", stamps, FORCE[:n], RATE[:n])
    time = {"column": "t", "base": "text"}
    if MOMENTS[form]:
        with pytest.raises(
            InputError, match=r"log\.csv: column t: '23:59:59.006' names no day: .* start: 2024"
        ):
            import_drive([table], mapping=_mapping(tmp_path / "map.yaml", {"time": time}))
        time["start"] = MOMENTS[form]
    imported = import_drive([table], mapping=_mapping(tmp_path / "map.yaml", {"time": time}))
    t = imported.drive.imu.t
    np.testing.assert_allclose(t - t[0], T[:n], atol=1e-6)
    assert t[0] % 86400 == pytest.approx((86399.006 if MOMENTS[form] else 75599.006), abs=1e-6)


def test_a_text_that_is_no_time_is_named(tmp_path: Path) -> None:
    table = _table(tmp_path / "log.csv", [f"half past {i}" for i in range(N)])
    mapping = _mapping(tmp_path / "map.yaml", {"time": {"column": "t", "base": "text"}})
    with pytest.raises(InputError, match=r"log\.csv: column t: 'half past 0' is no date and time"):
        import_drive([table], mapping=mapping)


def test_a_refusal_says_what_was_lost(tmp_path: Path) -> None:
    force = np.full_like(FORCE, np.nan)
    table = _table(tmp_path / "log.csv", T, force)
    with pytest.raises(
        InputError, match=r"no usable accelerometer data; 300 of 300 .* are no numbers: left out"
    ):
        import_drive([table], mapping=_mapping(tmp_path / "map.yaml"))


def _measurement(path: Path, fault: str = "") -> None:
    """MDF4: accelerations in g at 100 Hz, rates in deg/s at 50 Hz, positions at 1 Hz."""
    asammdf = pytest.importorskip("asammdf")
    measurement = asammdf.MDF(version="4.10")
    measurement.header.start_time = datetime.fromtimestamp(START, tz=timezone.utc)
    slow = np.arange(0.0, T[-1] + 0.001, 1.0)
    groups = [
        (T, dict(zip(("ax", "ay", "az"), FORCE.T / G, strict=True)), "g"),
        (T[::2], dict(zip(("gx", "gy", "gz"), np.degrees(RATE[::2]).T, strict=True)), "deg/s"),
        (slow, {"lat": 47.0 + 1e-4 * slow, "lon": 19.0 + 0.0 * slow}, "deg"),
    ]
    for stamps, channels, unit in groups:
        signals = [
            asammdf.Signal(np.array(v), stamps, name=n, unit=unit) for n, v in channels.items() if n != fault
        ]
        measurement.append(signals, common_timebase=True)
    measurement.save(path)


MDF_MAP = {
    "imu": {
        "time": {},
        "specific_force": {"columns": ["ax", "ay", "az"], "unit": "g"},
        "angular_rate": {"columns": ["gx", "gy", "gz"], "unit": "deg/s"},
    },
    "fix": {"time": {}, "latitude": "lat", "longitude": "lon"},
}


@pytest.mark.long
def test_an_mdf_file_by_its_channels(tmp_path: Path) -> None:
    _measurement(tmp_path / "bench.mf4")
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(MDF_MAP))
    drive = import_drive([tmp_path / "bench.mf4"], mapping=tmp_path / "map.yaml").drive
    np.testing.assert_allclose(drive.imu.t, START + T, atol=1e-6)
    np.testing.assert_allclose(drive.imu.specific_force, FORCE, atol=1e-9)
    np.testing.assert_allclose(drive.imu.angular_rate[::2], RATE[::2], atol=1e-9)
    np.testing.assert_allclose(drive.fix.t, START + np.arange(3.0), atol=1e-6)
    np.testing.assert_allclose(drive.fix.latitude, 47.0 + 1e-4 * np.arange(3.0))
    _measurement(tmp_path / "bench2.mf4", fault="ay")
    with pytest.raises(InputError, match=r"bench2\.mf4: channel ay: is not there; the channels are .*ax, az"):
        import_drive([tmp_path / "bench2.mf4"], mapping=tmp_path / "map.yaml")
    (tmp_path / "cut.mf4").write_bytes((tmp_path / "bench.mf4").read_bytes()[:900])
    with pytest.raises(InputError, match=r"cut\.mf4"):
        import_drive([tmp_path / "cut.mf4"], mapping=tmp_path / "map.yaml")


@pytest.mark.parametrize(
    ("magic", "module", "words"),
    [
        (b"MDF     4.10    ", "asammdf", r'an MDF file needs asammdf: pip install "suspension-twin\[mdf\]"'),
        (b"TDSm", "nptdms", r'a TDMS file needs npTDMS: pip install "suspension-twin\[tdms\]"'),
    ],
)
def test_without_its_library_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, magic: bytes, module: str, words: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / "bench.mf4").write_bytes(magic + bytes(200))
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(MDF_MAP))
    with pytest.raises(InputError, match=rf"bench\.mf4: {words}"):
        import_drive([tmp_path / "bench.mf4"], mapping=tmp_path / "map.yaml")


def test_rtklib_tag(tmp_path: Path) -> None:
    """The first and last sample stand at the tag's first and last time, GPS time taken to UTC."""
    duration = T[-1] * 1.001
    head = b"TIMETAG RTKLIB demo5".ljust(60, b"\0") + struct.pack("<IId", 77, int(START) + 18, 0.25)
    pairs = struct.pack("<IIII", 0, 10, round(duration * 1000), 99)
    (tmp_path / "imu.csv.tag").write_bytes(head + pairs)
    time = {"unit": "ms", "base": "rtklib_tag", "tag": "imu.csv.tag"}
    drive = _read(tmp_path, np.round(5000 + T * 1000), {"time": time})
    np.testing.assert_allclose(drive.imu.t, START + 0.25 + T * round(duration, 3) / T[-1], atol=1e-6)
    lines = (tmp_path / "imu.csv").read_text().splitlines()
    (tmp_path / "imu.csv").write_text("\n".join(lines[:101]))
    fault = r"imu\.csv: column t: runs for 1\.0 s and imu\.csv\.tag for 3\.0 s"
    with pytest.raises(InputError, match=fault) as cut:
        import_drive([tmp_path / "imu.csv"], mapping=tmp_path / "map.yaml")
    start = str(cut.value).split("start: ")[1].split(" instead")[0]
    alone = {"time": {"column": "t", "unit": "ms", "base": "start", "start": start}}
    drive = import_drive([tmp_path / "imu.csv"], mapping=_mapping(tmp_path / "map.yaml", alone)).drive
    np.testing.assert_allclose(drive.imu.t, START + 0.25 + T[:100], atol=1e-3)
    (tmp_path / "imu.csv.tag").write_bytes(head[:40])
    with pytest.raises(InputError, match=r"imu\.csv\.tag: not a time tag"):
        _read(tmp_path, T * 1000, {"time": time})
    (tmp_path / "imu.csv.tag").unlink()
    with pytest.raises(InputError, match=r"imu\.csv\.tag: is not there"):
        _read(tmp_path, T * 1000, {"time": time})


def test_lag_and_drift_are_taken_out(tmp_path: Path) -> None:
    """Stamps made late and by a fast clock come back to the truth."""
    fast = START + T * (1 + 500e-6) + 0.125
    drive = _read(tmp_path, fast, {"time": {"lag": 0.125, "drift_ppm": 500}})
    np.testing.assert_allclose(drive.imu.t, START + T, atol=1e-6)


def test_positions_velocities_and_headings(tmp_path: Path) -> None:
    tl = np.arange(4.0)
    rows = ["time;lat;lon;h;v;course;q;se;sn;su"]
    for i, x in enumerate(tl):
        rows.append(
            f"{START + x:.1f};{np.radians(47 + 1e-4 * x)};{np.radians(19.0)};{100 + x};36;90;{i - 1};1;2;3"
        )
    (tmp_path / "gps.csv").write_text("\n".join(rows))
    time = {"column": "time"}
    more: dict[str, Any] = {
        "fix": {
            "file": "gps.csv",
            "time": time,
            "latitude": "lat",
            "longitude": "lon",
            "altitude": "h",
            "unit": "rad",
            "sigma": ["se", "sn", "su"],
            "status": "q",
        },
        "vel": {"file": "gps.csv", "time": time, "speed": "v", "bearing": "course", "unit": "km/h"},
        "heading": {
            "file": "gps.csv",
            "time": time,
            "column": "course",
            "unit": "deg",
            "convention": "compass",
        },
    }
    drive = _read(tmp_path, START + T, **more)
    np.testing.assert_allclose(drive.fix.latitude, 47 + 1e-4 * tl)
    assert drive.fix.status.tolist() == [-1, 0, 1, 2]
    np.testing.assert_array_equal(drive.fix.sigma, np.tile([1.0, 2.0, 3.0], (4, 1)))
    np.testing.assert_allclose(drive.velocity.enu, np.tile([10.0, 0, 0], (4, 1)), atol=1e-12)
    assert drive.heading is not None
    np.testing.assert_allclose(drive.heading.yaw, 0, atol=1e-12)
    more["vel"] = {"file": "gps.csv", "time": time, "east": "v", "north": "se", "unit": "m/s", "lag": 0.5}
    drive = _read(tmp_path, START + T, **more)
    np.testing.assert_allclose(drive.velocity.enu[0], [36, 1, 0])
    np.testing.assert_allclose(drive.velocity.t, START + tl - 0.5)
    more["vel"] = {"derive": True}
    assert _read(tmp_path, START + T, **more).velocity.enu[0, 1] == pytest.approx(11.12, abs=0.05)


def test_arrays(tmp_path: Path) -> None:
    """NumPy files, whatever they are called, a clock of their own tied to POSIX time by another file."""
    folder = tmp_path / "rec"
    (folder / "imu").mkdir(parents=True)
    for name, array in (("t", 500 + T), ("acc", FORCE), ("gyro", RATE)):
        with (folder / "imu" / name).open("wb") as file:
            np.save(file, array)
    np.save(folder / "ticks.npy", np.column_stack([500 + np.arange(3.0), START + np.arange(3.0)]))
    time = {
        "file": "imu/t",
        "base": "clock",
        "tie": {"file": "ticks.npy", "column": 0, "posix": {"file": "ticks.npy", "column": 1}},
    }
    imu = {
        "time": time,
        "specific_force": {"file": "imu/acc", "columns": [0, 1, 2], "unit": "m/s2"},
        "angular_rate": {"file": "imu/gyro", "columns": [0, 1, 2], "unit": "rad/s"},
    }
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"imu": imu}))
    drive = import_drive([folder], mapping=tmp_path / "map.yaml").drive
    np.testing.assert_array_equal(drive.imu.specific_force, FORCE)
    np.testing.assert_allclose(drive.imu.t, START + T, atol=1e-6)
    data = (folder / "imu" / "gyro").read_bytes()
    (folder / "imu" / "gyro").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"imu/gyro: not a NumPy array"):
        import_drive([folder], mapping=tmp_path / "map.yaml")
    np.save(folder / "imu" / "gyro.npy", np.array([{"a": 1}], dtype=object))
    (folder / "imu" / "gyro.npy").rename(folder / "imu" / "gyro")
    with pytest.raises(InputError, match="not a NumPy array"):  # pickles are never opened
        import_drive([folder], mapping=tmp_path / "map.yaml")


def test_a_bag_with_other_topics(make: Any, same: Any, tmp_path: Path) -> None:
    from suspension_twin.drive.read import Topics

    drive = make(100)
    write_drive(drive, tmp_path / "bag", topics=Topics(imu="/phone/imu", fix="/gnss/fix", vel="/gnss/vel"))
    bag = {"imu": "/phone/imu", "fix": "/gnss/fix", "vel": "/gnss/vel"}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"name": "renamed", "bag": bag}))
    imported = import_drive([tmp_path / "bag"], mapping=tmp_path / "map.yaml")
    same(imported.drive, drive)
    assert imported.drive.name == "renamed"
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"bag": {**bag, "lag": 0.25}}))
    lagging = import_drive([tmp_path / "bag"], mapping=tmp_path / "map.yaml").drive
    np.testing.assert_allclose(lagging.imu.t, drive.imu.t - 0.25)
    np.testing.assert_array_equal(lagging.fix.t, drive.fix.t)


# --- doubtful content is said


def test_doubtful_units_are_said(tmp_path: Path) -> None:
    for force, rate, words in (
        (FORCE / G, RATE, "so it is in g: give g as its unit"),
        (3.0 * RATE + [0.0, 0.0, 0.7 * G], FORCE, "not 9.81: check the unit and the columns"),  # exchanged
        (FORCE - [0, 0, G], RATE, "gravity seems to be removed"),
        (FORCE * 10, RATE, "check the unit"),
        (FORCE * 0.8, RATE, "check the unit"),
        (FORCE, RATE * 57, "deg/s"),
    ):
        table = _table(tmp_path / "imu.csv", START + T, force, rate)
        drive = import_drive([table], mapping=_mapping(tmp_path / "map.yaml")).drive
        assert any(words in line for line in drive.warnings), words


def test_samples_out_of_order_repeated_or_missing(tmp_path: Path) -> None:
    t = (START + T).tolist()
    t[10], t[11] = t[11], t[10]
    t[20] = t[21]
    force = FORCE.copy()
    force[30, 2] = np.nan
    t[40] = 1e300
    table = _table(tmp_path / "imu.csv", t, force)
    drive = import_drive([table], mapping=_mapping(tmp_path / "map.yaml")).drive
    assert (np.diff(drive.imu.t) > 0).all()
    text = " | ".join(drive.warnings)
    for words in ("no numbers", "out of order", "repeat a stamp", "no usable stamp"):
        assert words in text
    np.testing.assert_array_equal(drive.imu.specific_force[[10, 11]], FORCE[[11, 10]])


# --- what is wrong with a mapping

GOOD: dict[str, Any] = {
    "time": {"column": "t"},
    "specific_force": {"columns": ["ax", "ay", "az"], "unit": "g"},
    "angular_rate": {"columns": ["gx", "gy", "gz"], "unit": "rad/s"},
}


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([], "not a mapping file"),
        ({}, "name either imu"),
        ({"imu": GOOD, "bag": {}}, "name either imu"),
        ({"bag": {}, "fix": {"importer": "rtklib"}}, "topics of the bag"),
        ({"imu": GOOD, "colour": "red"}, "colour: is not a key"),
        ({"imu": {**GOOD, "time": None}}, "time: is missing"),
        ({"imu": {k: v for k, v in GOOD.items() if k != "angular_rate"}}, r"imu\.angular_rate: is missing"),
        (
            {"imu": {**GOOD, "specific_force": {"columns": ["a", "b"], "unit": "g"}}},
            r"imu\.specific_force\.columns",
        ),
        (
            {"imu": {**GOOD, "specific_force": {"columns": [0, 1, 2], "unit": "ft/s2"}}},
            r"unit: must be one of.*ft/s2",
        ),
        (
            {"imu": {**GOOD, "angular_rate": {"columns": [0, 1, 2], "unit": "g"}}},
            r"unit: must be one of rad/s",
        ),
        (
            {"imu": {**GOOD, "specific_force": {"columns": [0, 1, 2], "unit": "g", "axes": ["x", "x", "z"]}}},
            "axes: must name x, y and z once",
        ),
        (
            {
                "imu": {
                    **GOOD,
                    "specific_force": {
                        "columns": [0, 1, 2],
                        "unit": "g",
                        "rpy": [0, 0, 0],
                        "rpy_deg": [0, 0, 0],
                    },
                }
            },
            "not both",
        ),
        (
            {"imu": {**GOOD, "time": {"column": 0, "base": "rtklib_tag"}}},
            "rtklib_tag and key tag belong together",
        ),
        ({"imu": {**GOOD, "time": {"column": 0, "tag": "x"}}}, "rtklib_tag and key tag belong together"),
        (
            {"imu": {**GOOD, "time": {"column": 0, "base": "start", "start": "noon"}}},
            "start: 'noon' is no date",
        ),
        ({"imu": {**GOOD, "time": {"column": 0, "unit": "hours"}}}, "unit: must be one of s"),
        (
            {"imu": {**GOOD, "time": {"column": 0, "lag": float("nan")}}},
            r"lag: input should be a finite number",
        ),
        ({"imu": {**GOOD, "time": {"column": 0, "drift_ppm": 1e6}}}, "no clock's drift"),
        ({"imu": GOOD, "fix": {"latitude": 0, "longitude": 1}}, r"fix: time: is missing"),
        ({"imu": GOOD, "vel": {"time": {"column": 0}, "speed": 1}}, r"vel: bearing: is missing"),
        ({"imu": GOOD, "vel": {"time": {"column": 0}}}, r"vel: east: is missing"),
    ],
)
def test_a_wrong_mapping_names_its_key(data: Any, words: str, tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=words) as caught:
        load_mapping(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_mapping_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    for data, words in (
        (b"imu: [", "line"),
        (b"\xff\xfe\x00", "not a text"),
        (b"[" * 3000, "not YAML"),
        (b"bga: 2020-99-99", "bga: is not a key of a mapping file, did you mean bag"),
        (None, "No such file"),
    ):
        if data is None:
            path.unlink()
        else:
            path.write_bytes(data)
        with pytest.raises(InputError, match=words):
            load_mapping(path)


def test_the_start_needs_no_quotes(tmp_path: Path) -> None:
    """As ``config/import/README.md`` writes it: a reader of YAML makes a date of it, if it is let."""
    mapping = {"imu": {**GOOD, "time": {"column": 0, "base": "start", "start": "2024-05-01T12:00:00Z"}}}
    text = yaml.safe_dump(mapping).replace("'2024-05-01T12:00:00Z'", "2024-05-01T12:00:00Z")
    assert "'2024" not in text
    (tmp_path / "map.yaml").write_text(text)
    read = load_mapping(tmp_path / "map.yaml")
    assert read.imu is not None and read.imu.time is not None
    assert read.imu.time.start == "2024-05-01T12:00:00Z"


def test_files_and_columns_a_mapping_asks_for(tmp_path: Path) -> None:
    _table(tmp_path / "imu.csv", START + T)
    cases: list[tuple[dict[str, Any], dict[str, Any], str]] = [
        ({"specific_force": {"columns": ["ax", "ay", "up"]}}, {}, r"imu\.csv: column up: is not there"),
        ({"time": {"column": "stamp"}}, {}, r"imu\.csv: column stamp"),
        ({"time": {"column": "ax", "base": "text"}}, {}, r"imu\.csv: column ax: '.*' is no date and time"),
        ({"file": "other.csv"}, {}, r"other\.csv: is not there"),
        ({}, {"fix": {"importer": "rtklib", "file": "gnss.pos"}}, r"gnss\.pos: is not there"),
        ({}, {"fix": {"importer": "abacus", "file": "imu.csv"}}, "abacus"),
    ]
    for imu, more, words in cases:
        with pytest.raises(InputError, match=words):
            import_drive([tmp_path / "imu.csv"], mapping=_mapping(tmp_path / "map.yaml", imu, **more))
