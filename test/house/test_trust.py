# SPDX-License-Identifier: Apache-2.0
"""Nothing from outside is trusted: there is one way to open a file, and one boundary around every reader."""

from __future__ import annotations

import ast
import os
import stat
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from suspension_twin.addons.fleet.manifest import read_manifest
from suspension_twin.addons.fleet.storage import identity
from suspension_twin.addons.roads.scan.clouds import open_cloud
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.mapping import load_mapping
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.rig import read_rig
from suspension_twin.errors import InputError
from suspension_twin.files import open_file, parse_json, read_json, read_yaml
from suspension_twin.inference.marker_runs import read_markers
from suspension_twin.road import load_road
from suspension_twin.road.opendrive import read_opendrive
from suspension_twin.road.profile import read_profile
from suspension_twin.vehicle.twin import load_twin

#: Methods and functions that open a path, whatever they are called on or by their full name.
METHODS = ("open", "read_text", "read_bytes")
FUNCTIONS = (
    *("open", "json.load", "yaml.safe_load", "ElementTree.parse", "sqlite3.connect", "h5py.File"),
    *(
        "np.load",
        "np.loadtxt",
        "np.genfromtxt",
        "np.fromfile",
        "np.memmap",
        "zipfile.ZipFile",
        "zipfile.is_zipfile",
    ),
    *("shutil.copyfile", "shutil.copy", "shutil.copy2", "shutil.copytree", "Ros1Reader", "PlyData.read"),
    *("matio.load_from_mat", "fmpy.read_model_description", "fmpy.supported_platforms", "fmpy.extract"),
)
#: Calls that open nothing that somebody gave, by module or for all: how the call begins or ends, and why.
HARMLESS = {
    "": (
        "Path(__file__)",  # a part of the package
        "resources.files(",  # a part of the package
        "bundled(",  # a part of the package
        "os.open(os.devnull",
        "temporary.open(",  # a file of replacing(), to be written
        "part.open(",  # a file of replacing(), to be written
        "np.load(file",  # what open_file() gave
        "np.load(opened",
        "np.loadtxt(lines",
        "np.loadtxt(file",
        "zipfile.is_zipfile(file)",
        "zipfile.ZipFile(file)",
        "zipfile.ZipFile(opened)",
        "zipfile.ZipFile(temporary",
        "laspy.open(open_file(",
        "fs.open(",  # an object in a store
    ),
    "addons/export/fmu.py": (
        "(folder / name).read_text",
        "Path(folder, library).read_bytes",
    ),  # what it compiled
    "addons/fmu/slave.py": (
        "fmpy.",
        "archive.open(member)",
    ),  # what it unpacked within a budget
    "addons/roads/scan/clouds.py": ("_optional(path, 'plyfile', 'plyfile').PlyData.read(file,",),
    "addons/sources/common/receiver.py": ("os.open(address.path",),  # a serial line that a URL names
    "addons/sources/common/server.py": ("os.open(path, os.O_WRONLY",),  # a token, made anew
    "addons/sources/iio.py": ("",),  # devices of the kernel
    "compiled.py": ("file.read_",),  # sources of the package
    "drive/foreign_files.py": ("self._archive.open(member)",),
    "drive/mat.py": (
        "h5py.File(path)",
        "matio.load_from_mat(path)",
    ),  # a copy, in a child
    "drive/importers/sensor_logger.py": ("sqlite3.connect(uri",),  # what open_file() has looked at
    "drive/measurement.py": ("import_module('nptdms').TdmsFile.open(BytesIO(",),
    "drive/recording.py": (
        "Ros1Reader(path)",  # what open_file() has looked at
        "reader.open()",
        "sqlite3.connect(uri",
        "sqlite3.connect(copy)",
        "copy.with_name(source.name).open('wb')",
    ),
    "drive/unpack.py": ("open('/proc/self/statm'",),
    "drive/write.py": ("self._bag.open()",),
    "inference/checkpoint.py": ("file.read_bytes()",),  # sources of the package
    "nodes/process.py": ("os.open(os.devnull",),
    "registry.py": ("open(os.path.join(directory",),  # an installed package
    "road/crg.py": ("pycrg.DataSet.open(path)",),  # what read_bytes() has read and checked
}


@cache
def modules(repository: Path) -> list[tuple[str, ast.Module]]:
    package = repository / "suspension_twin"
    return [
        (path.relative_to(package).as_posix(), ast.parse(path.read_text(encoding="utf-8")))
        for path in sorted(package.rglob("*.py"))
    ]


@cache
def opened(repository: Path) -> list[tuple[str, str]]:
    """Every call in the package that opens a path: its module, and the call as text."""
    found = []
    for name, tree in modules(repository):
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call) or name == "files.py":
                continue
            called = ast.unparse(node.func)
            method = isinstance(node.func, ast.Attribute) and node.func.attr in METHODS
            if (
                method
                or called in FUNCTIONS
                or called.endswith(tuple(f".{f}" for f in FUNCTIONS if "." in f))
            ):
                found.append((name, ast.unparse(node)))
    return found


@pytest.mark.long
def test_only_files_py_opens_a_path(repository: Path) -> None:
    found = [
        f"{name}: {call}"
        for name, call in opened(repository)
        if not any(call.startswith(text) for text in (*HARMLESS[""], *HARMLESS.get(name, ())))
    ]
    assert found == []


def test_no_exception_is_for_nothing(repository: Path) -> None:
    calls = opened(repository)
    unused = [
        f"{module}: {text}"
        for module, texts in HARMLESS.items()
        for text in texts
        if not any((not module or name == module) and call.startswith(text) for name, call in calls)
    ]
    assert unused == []


def test_every_public_reader_stands_behind_the_boundary(repository: Path) -> None:
    """A function for everybody that takes a path and gives its content makes one line of whatever a parser raises."""
    bare = []
    for name, tree in modules(repository):
        for node in tree.body if name != "files.py" else ():
            if not isinstance(node, ast.FunctionDef) or not node.args.args:
                continue
            first = node.args.args[0]
            path = "Path" in ast.unparse(first.annotation or ast.Constant(0)) or first.arg == "folder"
            verb = node.name.startswith(("read_", "load_", "open_", "examine", "decided_", "continued"))
            marked = any("reader(" in ast.unparse(mark) for mark in node.decorator_list)
            if node.name == "read_whole":  # hands the damage to read_recording(), which salvages
                continue
            if path and verb and not marked and "with reading(" not in ast.unparse(node):
                bare.append(f"{name}: {node.name}")
    assert bare == []


READERS: dict[str, Callable[[Path], object]] = {
    "twin.yaml": load_twin,
    "mapping.yaml": load_mapping,
    "fleet.yaml": read_manifest,
    "fleet.csv": read_manifest,
    "any.yaml": read_yaml,
    "any.json": read_json,
    "road.crg": load_road,
    "road.xodr": read_opendrive,
    "profile.csv": read_profile,
    "profile.erd": read_profile,
    "cloud.xyz": open_cloud,
    "run.csv": lambda path: read_markers(path, 5.0),
    "rig.csv": read_rig,
    "drive.mcap": read_drive,
    "log.csv": lambda path: import_drive([path]),
    "anything": open_file,
}


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_and_a_device_hold_nobody_up(name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="is not a regular file"):
        READERS[name](tmp_path / name)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("/dev/zero")
    with pytest.raises(InputError, match="is not a regular file"):
        READERS[name](tmp_path / name)


def test_a_file_that_becomes_a_pipe_before_it_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "a")
    regular = os.stat(__file__)
    assert stat.S_ISREG(regular.st_mode)
    monkeypatch.setattr("suspension_twin.files.os.stat", lambda path: regular)
    with pytest.raises(InputError, match="is not a regular file"):
        open_file(tmp_path / "a")


def test_what_a_fleet_hashes_is_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a")
    with pytest.raises(InputError, match="is not a regular file"):
        identity(str(tmp_path / "a"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": NaN}', "a.json: holds NaN, which is no number of JSON"),
        ("[-Infinity]", "a.json: holds -Infinity, which is no number of JSON"),
        ("[1,\n2", "a.json: not JSON, line 2"),
        ("[" * 200_000, "a.json: not JSON that can be read"),
        ("9" * 10_000, "a.json: not JSON that can be read"),
    ],
)
def test_json_holds_numbers(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_json(text, "a.json")
