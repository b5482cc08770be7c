# SPDX-License-Identifier: Apache-2.0
"""Mutated files of every format: a result or one line with exit status 2, in little memory and time."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from torture.commands import ROOT, environment
from torture.ledger import Tally

__all__ = ["BAR", "torture"]

BAR = "a result or one line with exit 2; below 1 GB and 20 s for a file of 1 MB"
_MOST_MEMORY, _MOST_SECONDS = 1000.0, 20.0  # MB, s

#: A word in a text that a reader may stumble over.
_WORDS = (
    *(
        word.encode()
        for word in ("nan", "-inf", "1e308", "-1", "0", "9" * 40, "1e-320", "", "[/b]", "<script>", "²")
    ),
    *(b"\0", b"\xff\xfe", b"\x1b[31m", b"\r\n", b"$", b"=", b"*a", b"&a ", b"[" * 3000, b"," * 2000),
    *(b"../../../etc/passwd", b"!!python/object/apply:os.system [false]"),
    *(b"9999-99-99 99:99:99", b"2554-01-01 00:00:00"),
)
_SIZES = (0, 1, 2, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)


def make_samples(folder: Path) -> list[Path]:
    """One small file of each format, from the bundled drive."""
    import scipy.io
    from rosbags.rosbag2 import StoragePlugin, Writer

    from suspension_twin.drive.cdr import ros2_types
    from suspension_twin.drive.read import read_drive
    from suspension_twin.drive.recording import read_recording
    from suspension_twin.drive.types import cut
    from suspension_twin.drive.write import write_drive

    drive = read_drive(ROOT / "bags" / "crg_road")
    drive = cut(drive, drive.imu.t[0], drive.imu.t[0] + 6.0)
    t, f, w = drive.imu.t, drive.imu.specific_force, drive.imu.angular_rate
    samples = [folder / "bag.mcap"]
    write_drive(drive, samples[0])
    contents = read_recording(samples[0])
    writer = Writer(folder / "sqlite", version=9, storage_plugin=StoragePlugin.SQLITE3)
    with writer:
        for name, topic in contents.topics.items():
            connection = writer.add_connection(name, topic.msgtype, typestore=ros2_types())
            for stamp, data in zip(topic.stamps, topic.data, strict=True):
                writer.write(connection, stamp, data)
    samples.append(folder / "bag.db3")
    shutil.move(next((folder / "sqlite").glob("*.db3")), samples[-1])
    samples.append(folder / "bag.bag")
    subprocess.run(
        [sys.executable, "-m", "rosbags.convert.cli", "--src", str(samples[0]), "--dst", str(samples[-1])],
        capture_output=True,
        check=False,
    )
    if not samples[-1].is_file():
        samples.pop()
    rows = "\n".join(f"{int(s * 1e9)},{s - t[0]:.3f},{a[2]},{a[1]},{a[0]}" for s, a in zip(t, f, strict=True))
    turns = "\n".join(
        f"{int(s * 1e9)},{s - t[0]:.3f},{a[2]},{a[1]},{a[0]}" for s, a in zip(t, w, strict=True)
    )
    head = "time,seconds_elapsed,z,y,x\n"
    with zipfile.ZipFile(folder / "logger.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("Accelerometer.csv", head + rows)
        archive.writestr("Gyroscope.csv", head + turns)
        archive.writestr("Metadata.csv", "platform\nandroid\n")
    records = [
        {"sensor": name, "time": str(int(s * 1e9)), "seconds_elapsed": str(s - t[0])}
        | dict(zip("xyz", map(str, a), strict=True))
        for name, values in (("Accelerometer", f), ("Gyroscope", w))
        for s, a in zip(t[:100], values, strict=False)
    ]
    (folder / "logger.json").write_text(json.dumps(records))
    scipy.io.savemat(
        folder / "mobile.mat",
        {"Acceleration": f, "Acceleration_t": t, "AngularVelocity": w, "AngularVelocity_t": t},
        do_compression=True,
    )
    lines = [
        f"2024/05/01 12:00:{i:06.3f} 47.40{i:02d} 19.28 100.0 1 9 0.1 0.1 0.2 0 0 0 0 0" for i in range(50)
    ]
    (folder / "track.pos").write_text(
        "%  GPST latitude(deg) longitude(deg) height(m) Q ns\n" + "\n".join(lines) + "\n"
    )
    np.save(folder / "array.npy", np.column_stack([t, f, w]))
    (folder / "mapped.yaml").write_text(
        "imu: {file: array.npy, time: {column: 0}, specific_force: {columns: [1, 2, 3], unit: m/s2}, "
        "angular_rate: {columns: [4, 5, 6], unit: rad/s}}\n"
    )
    shutil.copy(ROOT / "bags" / "crg_road" / "road.crg", folder / "road.crg")
    shutil.copy(ROOT / "config" / "twins" / "ford_mondeo_mk4.yaml", folder / "twin.yaml")
    shutil.copy(ROOT / "config" / "nodes.yaml", folder / "params.yaml")
    (folder / "rig.csv").write_text(
        "time_s,road_displacement_mm,body_acceleration_g\n"
        + "".join(f"{0.01 * i:.2f},{i % 7},{0.01 * (i % 5)}\n" for i in range(200))
    )
    (folder / "13kmh_1.csv").write_text(
        "t,A,B\n" + "".join(f"{0.01 * i:.2f},{i % 7},{i % 5}\n" for i in range(200))
    )
    return [*samples, *(folder / name for name in _TEXTS)]


_TEXTS = (
    *(
        "logger.zip",
        "logger.json",
        "mobile.mat",
        "track.pos",
        "array.npy",
        "mapped.yaml",
        "road.crg",
        "twin.yaml",
    ),
    *("params.yaml", "rig.csv", "13kmh_1.csv"),
)


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four changes: bits, bytes, a length word, a word of text, a line doubled or lost, a cut, a loop."""
    for _ in range(int(rng.integers(1, 5))):
        if not data:
            return data
        at = int(rng.integers(len(data)))
        kind = int(rng.integers(8))
        if kind == 0:
            data = data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]
        elif kind == 1:
            data = data[:at] + rng.bytes(int(rng.integers(1, 9))) + data[at + int(rng.integers(9)) :]
        elif kind == 2:
            size = _SIZES[int(rng.integers(len(_SIZES)))]
            word = struct.pack(("<I", ">I", "<Q")[int(rng.integers(3))], size & 0xFFFFFFFF)
            data = data[:at] + word + data[at + len(word) :]
        elif kind == 3:
            data = data[:at]
        elif kind == 4:
            lines = data.split(b"\n")
            i = int(rng.integers(len(lines)))
            lines[i : i + 1] = [lines[i]] * int(rng.integers(0, 4))
            data = b"\n".join(lines)
        elif kind in (5, 6):  # a number or word of text becomes another
            found = list(re.finditer(rb"[\w.+-]+", data[at : at + 400]))
            if found:
                here = found[int(rng.integers(len(found)))]
                word = _WORDS[int(rng.integers(len(_WORDS)))]
                data = data[: at + here.start()] + word + data[at + here.end() :]
        else:
            data = data[:at] + data[at : at + 2000] * int(rng.integers(2, 20)) + data[at:]
    return data


def mutated(sample: Path, rng: np.random.Generator) -> bytes:
    """A changed copy; of an archive now and then the content of a member, packed anew."""
    data = sample.read_bytes()
    if sample.suffix != ".zip" or rng.random() < 0.4:
        return mutate(data, rng)
    file = io.BytesIO()
    with zipfile.ZipFile(sample) as old, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            text = old.read(name)
            new.writestr(name, mutate(text, rng) if rng.random() < 0.6 else text)
    return file.getvalue()


def read(path: Path, folder: Path) -> str:
    """Read one file as its format's commands do; the one line of error, or nothing. Anything else is raised."""
    from suspension_twin.cli.main import main
    from suspension_twin.errors import InputError

    out, err = io.StringIO(), io.StringIO()
    calls: dict[str, Callable[[], object]] = {}
    if path.name == "params.yaml":
        from suspension_twin.nodes.parameters import read_param_file

        calls["params.yaml"] = lambda: read_param_file(path)
    elif path.name == "twin.yaml":
        from suspension_twin.vehicle.twin import load_twin

        calls["twin.yaml"] = lambda: load_twin(path)
    elif path.name == "rig.csv":
        from suspension_twin.drive.rig import read_rig

        calls["rig.csv"] = lambda: read_rig(path)
    elif path.name == "13kmh_1.csv":
        from suspension_twin.inference.marker_runs import read_markers

        calls["13kmh_1.csv"] = lambda: read_markers(path, 3.6)
    if path.name in calls:
        try:
            calls[path.name]()
        except InputError as error:
            return str(error)
        return ""
    arguments = ["import", str(path), "--out", str(folder / "out"), "--force"]
    if path.suffix == ".crg":
        arguments = ["road", "check", str(path)]
    elif path.name in ("mapped.yaml", "array.npy"):
        arguments = [
            "import",
            str(path.with_name("array.npy")),
            "--mapping",
            str(path.with_name("mapped.yaml")),
        ]
        arguments += ["--out", str(folder / "out"), "--force"]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(arguments)
    lines = err.getvalue().splitlines()
    allowed = (0, 1, 2) if path.suffix == ".crg" else (0, 2)
    if (
        status not in allowed
        or "unexpected error" in err.getvalue()
        or len(lines) > 1
        or (status == 2) != bool(lines)
    ):
        raise AssertionError(f"status {status}: {lines[-1] if lines else ''}")
    if "\x1b" in out.getvalue() + err.getvalue():
        raise AssertionError("codes of the terminal get through")
    return lines[0] if lines else ""


def worker(folder: Path, name: str, start: int) -> None:
    """Trials from ``start`` on, a line of JSON each; run in a process of its own, which may die of a trial."""
    samples = [folder / line for line in (folder / "samples.txt").read_text().split()]
    tally, number = Tally(name, BAR), start
    while True:
        rng = tally.rng(number)
        sample = samples[number % len(samples)]
        place = folder / "work"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        for other in ("array.npy", "mapped.yaml"):
            shutil.copy(folder / other, place / other)
        path = place / sample.name
        path.write_bytes(mutated(sample, rng))
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # the peak is that of the trial
        began, problem = time.monotonic(), ""
        print(json.dumps({"begins": number, "file": sample.name}), flush=True)
        try:
            text = read(path, place)
            if len(text) > 2500 or not text.isprintable():
                problem = f"a line of {len(text)} characters"
        except BaseException as error:
            problem = f"{type(error).__name__}: {error}"
        peak = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
        memory = int(peak[1]) / 1000 if peak else 0.0
        result = {
            "n": number,
            "file": sample.name,
            "problem": problem,
            "MB": memory,
            "s": time.monotonic() - began,
        }
        print(json.dumps(result), flush=True)
        number += 1


def torture(tally: Tally) -> None:
    """Watch a worker; a trial in which it dies or hangs has failed, and the next worker goes on after it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        samples = make_samples(folder)
        (folder / "samples.txt").write_text("\n".join(p.name for p in samples))
        process, file = None, "?"
        for number in tally.numbers():
            while True:  # lines of the trial
                if process is None:
                    code = "import sys; from pathlib import Path; from torture.files import worker; "
                    code += "worker(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))"
                    process = subprocess.Popen(
                        [sys.executable, "-c", code, name, tally.name, str(number)],
                        stdout=subprocess.PIPE,
                        stderr=subprocess.DEVNULL,
                        env=environment(PYTHONPATH=os.pathsep.join([str(ROOT), str(ROOT / "benchmarks")])),
                    )
                    patience = 60.0
                assert process.stdout is not None
                ready, _, _ = select.select([process.stdout], [], [], patience)
                line = process.stdout.readline() if ready else b""
                patience = 2 * _MOST_SECONDS
                if not line:
                    process.kill()
                    process.wait()
                    tally.fail(
                        f"{file}: {'hangs' if not ready else f'the process died ({process.returncode})'}"
                    )
                    process = None
                    break
                said = json.loads(line)
                file = said["file"]
                if "begins" in said:
                    continue
                tally.count(file)
                tally.measure("memory, MB", said["MB"])
                tally.measure("time, s", said["s"])
                if said["problem"]:
                    tally.fail(f"{file}: {said['problem']}")
                elif said["MB"] > _MOST_MEMORY or said["s"] > _MOST_SECONDS:
                    tally.fail(f"{file}: {said['MB']:.0f} MB, {said['s']:.0f} s")
                break
        if process is not None:
            process.kill()
            process.wait()
