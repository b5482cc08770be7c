# SPDX-License-Identifier: Apache-2.0
"""Files made to break a reader: refused in one line, in little memory, whatever is in them."""

from __future__ import annotations

import resource
import sqlite3
import struct
import sys
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from io import BytesIO
from pathlib import Path

import h5py
import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings, strategies as st

from suspension_twin.drive.foreign_files import read_array, read_table
from suspension_twin.drive.importing import import_drive, import_rig
from suspension_twin.drive.mapping import load_mapping
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.recording import read_recording
from suspension_twin.drive.rig import read_rig
from suspension_twin.drive.unpack import VARIABLE, Budget
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.inference.marker_runs import read_markers
from suspension_twin.road import load_road
from suspension_twin.road.profile import read_profile
from suspension_twin.vehicle.twin import load_twin

MIB = 1 << 20
TOO_LARGE = rf"unpacks to more than \d+ MiB: if that is right, {VARIABLE}=\d+ in the environment allows more"


@contextmanager
def little_memory(most: int = 100 * MIB) -> Iterator[None]:
    """What the block takes stays below ``most`` bytes."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < most, f"{peak / MIB:.0f} MiB"


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def mcap(chunk: bytes, compression: str, *, declared: int) -> bytes:
    body = struct.pack("<QQQI", 0, 1, declared, 0) + text(compression) + struct.pack("<Q", len(chunk)) + chunk
    start = record(1, text("ros2") + text("made"))
    return b"\x89MCAP0\r\n" + start + record(6, body) + record(2, bytes(20)) + b"\x89MCAP0\r\n"


def zeros(count: int, compression: str) -> bytes:
    pack = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress}[compression]
    return pack(bytes(count))  # type: ignore[no-any-return, operator]


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("honest", [True, False])
def test_a_chunk_that_unpacks_to_a_thousand_times_its_size(
    compression: str, honest: bool, tmp_path: Path
) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(mcap(zeros(500 * MIB, compression), compression, declared=500 * MIB if honest else 100))
    with little_memory(), pytest.raises(InputError, match=TOO_LARGE) as caught:
        read_drive(path)
    assert str(caught.value).startswith(str(path))


def test_a_file_compressed_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "bomb.db3.zstd"
    path.write_bytes(zeros(500 * MIB, "zstd"))
    with little_memory(), pytest.raises(InputError, match=TOO_LARGE):
        read_drive(path)


def test_a_table_in_an_archive(tmp_path: Path) -> None:
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("Accelerometer.csv", b"time,seconds_elapsed,z,y,x\n" + b"1,0,2,3,4\n" * (8 * MIB))
        archive.writestr("Gyroscope.csv", b"time,seconds_elapsed,z,y,x\n1,0,2,3,4\n")
    with little_memory(), pytest.raises(InputError, match=TOO_LARGE) as caught:
        import_drive([path])
    assert str(caught.value).startswith(str(path))


def test_the_user_may_raise_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=TOO_LARGE):
        Budget("x", 1000).take(100 * MIB)
    Budget("x", 10 * MIB).take(100 * MIB)
    monkeypatch.setenv(VARIABLE, "200")
    Budget("x", 1000).take(100 * MIB)
    monkeypatch.setenv(VARIABLE, "lots")
    with pytest.raises(InputError, match=f"^{VARIABLE}: must be a number of MiB, is 'lots'"):
        Budget("x", 1000)


DEFINITION = {
    "view": "CREATE VIEW messages AS WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) "
    "SELECT n AS id, 9 AS topic_id, n AS timestamp, x'00' AS data FROM r",
    "generated": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB GENERATED ALWAYS AS (zeroblob(500000000)))",
    "virtual": "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
}


@pytest.mark.parametrize("kind", DEFINITION)
def test_a_database_that_computes_its_messages(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
            "offered_qos_profiles TEXT)"
        )
        database.execute("INSERT INTO topics VALUES(1, '/imu/data_raw', 'sensor_msgs/msg/Imu', 'cdr', '')")
        try:
            database.execute(DEFINITION[kind])
        except sqlite3.OperationalError:
            pytest.skip("this SQLite has no such tables")
        if kind != "view":
            database.execute("INSERT INTO messages(topic_id, timestamp) VALUES(1, 1)")
        database.commit()
    with little_memory(), pytest.raises(InputError):
        read_drive(path)


def test_chunks_within_chunks(tmp_path: Path) -> None:
    def header(**fields: bytes) -> bytes:
        parts = [
            struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in {**fields}.items()
        ]
        return struct.pack("<I", sum(map(len, parts))) + b"".join(parts)

    body = b""
    for _ in range(3000):
        size = struct.pack("<I", len(body))
        body = header(op=b"\x05", compression=b"none", size=size) + size + body
    head = header(op=b"\x03", index_pos=struct.pack("<Q", 0), conn_count=bytes(4), chunk_count=bytes(4))
    path = tmp_path / "nested.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + head + struct.pack("<I", 0) + body)
    with pytest.raises(InputError) as caught:
        read_drive(path)
    assert "no topics" in str(caught.value)
    chunk = b""
    for _ in range(3000):
        inner = struct.pack("<QQQI", 0, 1, len(chunk), 0) + text("") + struct.pack("<Q", len(chunk)) + chunk
        chunk = record(6, inner)
    (tmp_path / "nested.mcap").write_bytes(mcap(chunk, "", declared=len(chunk)))
    with pytest.raises(InputError):
        read_drive(tmp_path / "nested.mcap")


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (
            "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }",
            "1000000000000 numbers decl",
        ),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000000000000,), }", "numbers declared"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }", "not a NumPy array"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (((", "not a NumPy array"),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (3,), }", "not a NumPy array of numbers"),
        ("{'descr': '|V0', 'fortran_order': False, 'shape': (3,), }", "not a NumPy array of numbers"),
        ("__import__('os').abort()", "not a NumPy array"),
    ],
)
def test_an_array_that_declares_what_it_does_not_hold(header: str, words: str) -> None:
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header.encode() + b"\n" + bytes(24)
    with little_memory(10 * MIB), pytest.raises(InputError, match=words):
        read_array(data, "a.npy")


def test_an_array_keeps_its_order() -> None:
    for array in (
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6).reshape(2, 3)),
        np.arange(3.0),
    ):
        file = BytesIO()
        np.save(file, array)
        np.testing.assert_array_equal(read_array(file.getvalue(), "a"), array.reshape(len(array), -1))


def test_a_position_at_an_hour_that_no_day_has(tmp_path: Path) -> None:
    path = tmp_path / "a.pos"
    line = "2024/05/01 {}:00:00.000 47.4 19.2 100 1 9 0 0 0 0 0 0 0 0\n"
    path.write_text(line.format("9" * 400) + line.format("1" * 30) + line.format("12"))
    with pytest.raises(InputError, match=r"a\.pos"):  # and no accelerometer
        import_drive([path])


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no mat-io for Python 3.10")
@pytest.mark.long
def test_a_matlab_file_that_unpacks_or_declares_too_much(tmp_path: Path) -> None:
    packed = zlib.compress(bytes(200 * MIB), 9)
    v5, v73 = tmp_path / "v5.mat", tmp_path / "v73.mat"
    v5.write_bytes(b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed)
    with h5py.File(v73, "w", userblock_size=512) as file:
        file.create_dataset("Acceleration", shape=(3, 10**9), dtype="f8", chunks=(3, 1000))
    with v73.open("rb+") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    for path in (v5, v73):
        with little_memory(), pytest.raises(InputError, match=TOO_LARGE):
            import_drive([path])


def test_a_tdms_file_that_declares_too_much(tmp_path: Path) -> None:
    """A segment of one channel of 10^10 doubles, and none of them there."""
    pytest.importorskip("nptdms")

    def name(text: str) -> bytes:
        return struct.pack("<I", len(text)) + text.encode()

    index = struct.pack("<IIIQ", 20, 10, 1, 10**10)
    meta = struct.pack("<I", 1) + name("/'Rig'/'plate'") + index + struct.pack("<I", 0)
    lead = b"TDSm" + struct.pack("<IIQQ", 0b1110, 4713, len(meta) + 8 * 10**10, len(meta))
    (tmp_path / "bench.tdms").write_bytes(lead + meta + bytes(80))
    plate = "{column: Rig/plate, unit: m}"
    (tmp_path / "map.yaml").write_text(f"rig: {{time: {{}}, columns: {{road_displacement: {plate}}}}}")
    with little_memory(), pytest.raises(InputError, match=r"bench\.tdms: "):
        import_rig([tmp_path / "bench.tdms"], tmp_path / "map.yaml")


def element(kind: int, data: bytes) -> bytes:
    """An element of a MATLAB file of version 5."""
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def declared(kind: int, count: int) -> bytes:
    """A MATLAB file of version 5 that declares an array of ``count`` and holds nothing of it."""
    parts = (
        element(6, struct.pack("<II", kind, 0)),
        element(5, struct.pack("<ii", 1, count)),
        element(1, b"acc"),
    )
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + element(14, b"".join(parts))


def nested(file: h5py.File, depth: int = 40) -> None:
    """Cells of two references each to one that is the same, one in the other: 2 to the ``depth`` values."""
    inner = file.create_dataset("#refs#/z", data=np.zeros((1, 1)))
    inner.attrs["MATLAB_class"] = np.bytes_("double")
    for k in range(depth):
        name = "Acceleration" if k == depth - 1 else f"#refs#/{k}"
        outer = file.create_dataset(name, (2, 1), dtype=h5py.ref_dtype)
        outer[0, 0] = outer[1, 0] = inner.ref
        outer.attrs["MATLAB_class"] = np.bytes_("cell")
        inner = outer


def many(file: h5py.File) -> None:
    """400 references to one set of 8 MB, which takes 8 kB."""
    large = file.create_dataset("#refs#/a", data=np.zeros((1, 1_000_000)), compression="gzip")
    large.attrs["MATLAB_class"] = np.bytes_("double")
    cell = file.create_dataset("Acceleration", (400, 1), dtype=h5py.ref_dtype)
    for i in range(400):
        cell[i, 0] = large.ref
    cell.attrs["MATLAB_class"] = np.bytes_("cell")


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((3, 4), "f8")
    layout[:] = h5py.VirtualSource("another.mat", "Acceleration", (3, 4))
    file.create_virtual_dataset("Acceleration", layout)


def linked(link: object) -> Callable[[h5py.File], None]:
    return lambda file: file.__setitem__("Acceleration", link)


LINKS: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "a link into another file": (
        linked(h5py.ExternalLink("another.mat", "/a")),
        "a link that leads elsewhere",
    ),
    "a link by name": (linked(h5py.SoftLink("/Acceleration")), "a link that leads elsewhere"),
    "a part of another file": (virtual, "keeps its data in another file"),
    "many references": (many, "is not a .mat file that"),
    "nested references": (nested, r"is not a .mat file that can be read in \d s"),
}


def version_73(path: Path, fill: Callable[[h5py.File], None]) -> Path:
    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file)
    with path.open("rb+") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no mat-io for Python 3.10")
@pytest.mark.parametrize(
    "case", ["a cell", *list(LINKS)[:-1], pytest.param("nested references", marks=pytest.mark.long)]
)
def test_a_matlab_file_of_little_that_would_cost_much(case: str, tmp_path: Path) -> None:
    """Read in a process that has so much memory and time, and no more; no other file is read."""
    path, words = tmp_path / "log.mat", "is not a .mat file that fits into memory"
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    if case in LINKS:
        fill, words = LINKS[case]
        version_73(path, fill)
    else:
        path.write_bytes(declared(1, 300_000_000))
    with little_memory(), pytest.raises(InputError, match=words):
        import_drive([path])
    most = max(before, 500 << 10)  # KiB
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss <= most


def test_grids_that_a_few_lines_ask_for(tmp_path: Path) -> None:
    """Stamps and distances decide how many samples there are once they are even."""
    profile, markers = tmp_path / "a.csv", tmp_path / "b.csv"
    profile.write_text("0,0\n1e-7,0\n2e-7,0\n3e-7,0\n15,0\n")
    rows = [f"{t},0,0" for t in (*range(30), 1e9)]
    markers.write_text("\n".join(["t,A,B", *rows]))
    for read in (lambda: read_profile(profile), lambda: read_markers(markers, 5.0)):
        with little_memory(), pytest.raises(InputError, match=TOO_LARGE):
            read()


def test_a_line_without_end_is_no_table() -> None:
    with little_memory(), pytest.raises(InputError, match="holds a line of 1000000 characters: not a table"):
        read_table(b"a,b\n" + b"," * 1_000_000, "x.csv")


def test_an_error_names_some_of_a_thousand_columns() -> None:
    names = ",".join(f"column{i}" for i in range(1000))
    with pytest.raises(InputError, match="and 960 more") as caught:
        read_table(f"{names}\n{names}\n".encode(), "x.csv", header=True).numbers("t")
    assert len(str(caught.value)) < 700


def test_a_device_is_no_recording() -> None:
    for read in (
        read_recording,
        read_drive,
        lambda path: import_drive([path]),
        read_rig,
        load_road,
        load_twin,
    ):
        with pytest.raises(InputError, match=r"/dev/zero: is not a regular file"):
            read("/dev/zero")


# Whatever stands in a file, a reader gives a result or one line.

ROOT = Path(__file__).resolve().parents[2]
SAMPLES: dict[str, tuple[bytes, Callable[[Path], object]]] = {
    "a.csv": (b't,ax,ay\n0.0,1.0,2.0\n0.1,1.5,"2"\n', lambda p: read_table(p.read_bytes(), "a").numbers(0)),
    "a.npy": (b"", lambda p: read_array(p.read_bytes(), "a")),
    "a.pos": (
        b"%  GPST latitude(deg) longitude(deg) height(m) Q ns\n2024/05/01 12:00:00.000 47.4 19.2 100 1 9\n",
        lambda p: import_drive([p]),
    ),
    "Accelerometer.json": (
        b'[{"sensor":"Accelerometer","time":"1700000000000000000","seconds_elapsed":"0","x":"1","y":"2","z":"3"},'
        b'{"sensor":"Gyroscope","time":"1700000000000000000","seconds_elapsed":"0","x":"1","y":"2","z":"3"}]',
        lambda p: import_drive([p]),
    ),
    "rig.csv": (
        b"time_s,road_displacement_mm,body_acceleration_g\n0,0,0\n0.1,1,0\n0.2,2,0\n",
        read_rig,
    ),
    "13kmh_1.csv": (
        b"t,A,B\n" + b"".join(b"%g,1,2\n" % (0.1 * i) for i in range(30)),
        lambda p: read_markers(p, 3.0),
    ),
    "twin.yaml": ((ROOT / "config" / "twins" / "ford_mondeo_mk4.yaml").read_bytes(), load_twin),
    "map.yaml": (
        b"imu: {file: a.csv, time: {column: t}, specific_force: {columns: [x, y, z], unit: g}, "
        b"angular_rate: {columns: [p, q, r], unit: deg/s}}\n",
        load_mapping,
    ),
    "road.crg": (
        b"$ROAD_CRG\nREFERENCE_LINE_START_U = 0\nREFERENCE_LINE_END_U = 2\nREFERENCE_LINE_INCREMENT = 1\n"
        b"LONG_SECTION_V_RIGHT = -1\nLONG_SECTION_V_LEFT = 1\nLONG_SECTION_V_INCREMENT = 2\n$\n$KD_DEFINITION\n"
        b"#:LRFI\nD:reference line phi,rad\nD:long section 1,m\nD:long section 2,m\n$\n"
        + b"$" * 80
        + b"\n"
        + (b" 0.0000000" * 3 + b"\n") * 3,
        load_road,
    ),
}
_ARRAY = BytesIO()
np.save(_ARRAY, np.arange(12.0).reshape(4, 3))
SAMPLES["a.npy"] = (_ARRAY.getvalue(), SAMPLES["a.npy"][1])

#: What mutations put in: marks of the formats, and numbers at the ends of their types.
WORDS = st.sampled_from(
    [
        *(
            word.encode()
            for word in (
                "nan",
                "-inf",
                "1e308",
                "9" * 30,
                "-1",
                "²",
                "2554-01-01 00:00:00",
                "../../x",
                "[/b]",
            )
        ),
        *(bytes([c]) for c in b'\0[{"\n,$=\xff'),
        b"*a",
        b"&a ",
        b": ",
        b"!!python/name:os.system",
        b"",
    ]
)


@pytest.mark.parametrize("name", SAMPLES)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_mutated_file_gives_a_result_or_one_line(
    name: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    sample, read = SAMPLES[name]
    changed = sample
    for _ in range(data.draw(st.integers(0, 4))):
        at, end = sorted(data.draw(st.tuples(*[st.integers(0, len(changed))] * 2)))
        end = min(end, at + data.draw(st.sampled_from([0, 1, 3, 10_000])))
        changed = changed[:at] + data.draw(WORDS | st.binary(max_size=8)) + changed[end:]
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(changed)
    try:
        read(path)
    except SuspensionTwinError as error:
        assert error.exit_status == 2 and str(error).isprintable() and len(str(error)) < 2500
