# SPDX-License-Identifier: Apache-2.0
"""Files are written whole or not at all, and YAML is read with errors that name the place."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from suspension_twin.errors import InputError, WorkError, nearest
from suspension_twin.files import check_writable, parse_yaml, read_yaml, replacing, write_text
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
    [(b"a: [", "not YAML, line 1: "), (b"\xff\xfe\x00", "not a text file"), (b"[" * 3000, "not YAML")],
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
