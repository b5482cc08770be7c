# SPDX-License-Identifier: Apache-2.0
"""Files are written whole or not at all, and YAML is read with errors that name the place."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
import tokenize
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from suspension_twin.errors import InputError, WorkError, nearest, shown
from suspension_twin.files import (
    check_writable,
    comment_lines,
    parse_yaml,
    read_yaml,
    reading,
    replacing,
    together,
    write_text,
)
from suspension_twin.report import Page, style
from suspension_twin.road import write_road
from suspension_twin.road.build import flat_road
from suspension_twin.road.mesh import write_mesh
from suspension_twin.road.plots import save_road_picture
from suspension_twin.vehicle.twin import load_twin, save_twin

WRITERS: dict[str, Callable[[Path], object]] = {
    "a.txt": lambda path: write_text(path, "new"),
    "report.html": lambda path: Page("t").write(path),
    "plot.png": lambda path: style.save(style.figure(4, 3), path),
    "road.png": lambda path: save_road_picture(flat_road(10, 10), path),
    "road.stl": lambda path: write_mesh(flat_road(10, 10), path),
    "road.obj": lambda path: write_mesh(flat_road(10, 10), path),
    "road.crg": lambda path: write_road(flat_road(10, 10), path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_what_was_there(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / name
    path.write_text("old")
    monkeypatch.setattr("suspension_twin.files.os.fsync", full)
    with pytest.raises(WorkError, match=rf"{name}: cannot be written: No space left") as caught:
        WRITERS[name](path)
    assert caught.value.exit_status == 1
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_appears_with_its_folders_and_nothing_beside_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / name
    WRITERS[name](path)
    assert [p.name for p in path.parent.iterdir()] == [name] and path.stat().st_size > 0


def test_an_interrupt_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_as_public_as_others(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "x")
    (tmp_path / "b").write_text("x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_every_file_of_the_package_is_written_so(repository: Path) -> None:
    """Recordings, which are folders, have a writer of their own, that renames too."""
    direct = re.compile(
        r"(?<!temporary)\.write_(?:text|bytes)\(.*|(?<!temporary)(?<!part)\.open\(\s*\"[wxa].*"
        r"|\.savefig\((?!\s*(?:temporary|buffer))"
    )
    found = []
    for path in sorted((repository / "suspension_twin").rglob("*.py")):
        if path.parts[-2] == "drive" or path.name == "files.py":
            continue
        found += [f"{path.name}: {call}" for call in direct.findall(path.read_text(encoding="utf-8"))]
    assert found == []


def test_what_cannot_be_written_is_said_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/a/b\.yaml: cannot be written: Not a directory"):
        check_writable(tmp_path / "file" / "a" / "b.yaml")
    check_writable(tmp_path / "new" / "folder" / "b.yaml")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_date_in_yaml_stays_text() -> None:
    text = "start: 2024-05-01T12:00:00Z\nday: 2024-05-01\nmass: 1.5\nimpossible: 2020-99-99\n"
    assert parse_yaml(text, "x") == {
        "start": "2024-05-01T12:00:00Z",
        "day": "2024-05-01",
        "mass": 1.5,
        "impossible": "2020-99-99",
    }


@pytest.mark.parametrize(
    ("data", "words"),
    [(b"a: [", r"not YAML, line \d: "), (b"\xff\xfe\x00", "not a text file"), (b"[" * 3000, "not YAML")],
)
def test_what_is_no_yaml_is_one_line(data: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(data)
    with pytest.raises(InputError, match=words) as caught:
        read_yaml(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_mistyped_word_is_met_with_the_nearest() -> None:
    assert nearest("whelbase", ["mass", "wheelbase"]) == ", did you mean wheelbase?"
    assert nearest("xyz", ["mass", "wheelbase"]) == ""


def test_a_twin_is_written_whole(repository: Path, tmp_path: Path) -> None:
    twin = load_twin(repository / "config" / "twins" / "ford_mondeo_mk4.yaml")
    save_twin(twin, tmp_path / "new" / "twin.yaml", "# of a test\n")
    assert (tmp_path / "new" / "twin.yaml").read_text(encoding="utf-8").startswith("# of a test\nmodel: ")
    assert load_twin(tmp_path / "new" / "twin.yaml") == twin


LAUGHS = "a0: &a0 [x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (LAUGHS, "holds more than 100000 values with its aliases written out"),
        ("a: &a [*a]", "an alias refers to what it stands in"),
        ("a: &a {b: {<<: *a}}", "an alias refers to what it stands in"),
        ("a: " + "x" * (1 << 20), "is larger than 1024 KiB|is larger than 1 MiB"),
        ("a: " + "9" * 5000, "a number of too many digits"),
        ("a: 1" + ":1" * 3000, "a number of too many digits"),
        ("? [a]\n: b", "unhashable"),
        ("[" * 100_000, "not YAML"),
        ("a: !!python/object/apply:os.system [exit]", "could not determine a constructor"),
    ],
)
def test_yaml_that_grows_without_end_is_refused_at_once(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        parse_yaml(text, "x.yaml")
    assert len(str(caught.value)) < 300


def test_yaml_may_share_values() -> None:
    shared = "low: &low {mass: 1.0}\nfront: *low\nrear: {<<: *low, stiffness: 2.0}\n"
    assert parse_yaml(shared, "x")["rear"] == {"mass": 1.0, "stiffness": 2.0}


def test_what_a_parser_raises_is_one_line_about_the_file() -> None:
    cases: dict[BaseException, str] = {
        tokenize.TokenError("EOF in multi-line statement"): "cut off or damaged (TokenError)",
        MemoryError(): "fits into memory",
        RecursionError(): "nested too deep",
        OverflowError("too large"): "cut off or damaged (OverflowError)",
        PermissionError(errno.EACCES, os.strerror(errno.EACCES)): "Permission denied",
    }
    for raised, words in cases.items():
        with pytest.raises(InputError, match=re.escape(words)) as caught, reading("a.npy", "an array"):
            raise raised
        assert str(caught.value).startswith("a.npy: ") and caught.value.__cause__ is raised
    for number in (errno.ENOSPC, errno.EDQUOT):
        with pytest.raises(WorkError, match=r"^a\.npy: no space left") as full, reading("a.npy", "an array"):
            raise OSError(number, os.strerror(number))
        assert full.value.exit_status == 1
    with pytest.raises(InputError, match="^own$"), reading("a.npy", "an array"):
        raise InputError("own")
    with pytest.raises(KeyboardInterrupt), reading("a.npy", "an array"):
        raise KeyboardInterrupt


@given(st.text())
def test_an_error_is_one_line_that_a_terminal_does_not_obey(text: str) -> None:
    for error in (InputError(text, text), WorkError(text)):
        assert str(error).isprintable() and len(str(error)) < 2100
    assert len(shown([text] * 50)) <= 80 and shown(text).isprintable()


def test_an_error_quotes_a_large_value_shortly(tmp_path: Path) -> None:
    path = tmp_path / "twin.yaml"
    path.write_text(f"model: full_car\nvehicle: [{', '.join(['1234567.0'] * 50_000)}]\nimu: {'x' * 99_999}\n")
    with pytest.raises(InputError) as caught:
        load_twin(path)
    assert len(str(caught.value)) < 500 + len(str(path))


@given(st.lists(st.text(), max_size=4))
def test_a_comment_stays_one(lines: list[str]) -> None:
    text = comment_lines(*lines)
    assert all(line.startswith("# ") for line in text.splitlines()) and text.count("\n") == len(lines)
    assert parse_yaml(text + "a: 1\n", "x") == {"a": 1}


def test_files_written_together_are_all_there_or_none(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).write_text("old")
    with pytest.raises(WorkError), together():
        write_text(tmp_path / "a", "new")
        write_text(tmp_path / "new" / "b", "new")
        write_text(tmp_path / "a" / "c", "a is no folder")
    assert (tmp_path / "a").read_text() == (tmp_path / "b").read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b", "new"] and not list(
        tmp_path.glob("new/*")
    )
    with together():
        for name in "ab":
            write_text(tmp_path / name, "new")
        assert (tmp_path / "a").read_text() == "old"
    assert (tmp_path / "a").read_text() == (tmp_path / "b").read_text() == "new"


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    left, of_another = tmp_path / f".a.{ended.pid}.0.part.yaml", tmp_path / f".b.{ended.pid}.0.part.yaml"
    running = tmp_path / f".a.{os.getpid()}.99.part.yaml"
    for path in (left, of_another, running):
        path.write_text("")
    write_text(tmp_path / "a.yaml", "x")
    assert not left.exists() and of_another.exists() and running.exists()


@pytest.mark.parametrize("name", ["x" * 250, "a\0b", "x" * 250 + "/b.yaml"])
def test_a_name_that_cannot_be_made_is_refused_before_the_work(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written: "):
        check_writable(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_device_or_a_huge_file_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_bytes(b" " * (1 << 20) + b"a: 1")
    with pytest.raises(InputError, match="is larger than 1 MiB"):
        read_yaml(tmp_path / "a.yaml")
    with pytest.raises(InputError, match="is not a regular file"):
        read_yaml("/dev/zero")


def test_numbers_that_are_too_large_are_no_warning() -> None:
    """What a parser computes from bytes that it was not made for is no news for the terminal."""
    with warnings.catch_warnings(), reading("drive.npy", "an array"):
        warnings.simplefilter("error")
        assert np.isinf(np.float64(1e308) * 10.0) and np.isnan(np.float64(np.inf) * 0.0)
