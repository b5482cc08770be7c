# SPDX-License-Identifier: Apache-2.0
"""Each thing that can be wrong with an OpenCRG file is said by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycrg
import pytest

from suspension_twin.errors import InputError
from suspension_twin.road import load_road

TEXT = """$CT
made by hand
$
$ROAD_CRG
reference_line_start_u = 0
reference_line_end_u = 3   ! and a remark
reference_line_increment = 1.0
long_section_v_right = -1
long_section_v_left = 1
long_section_v_increment = 1
$
$KD_DEFINITION
#:LRFI
D:reference line phi,rad
D:long section 1,m
D:long section 2,m
D:long section 3,m
$
$$$$
**unused** 0.0000000 0.0000000 0.0000000
 0.0000000 0.0000000*missing** 0.0100000
 0.0000000 0.0000000 0.0200000 0.0100000
 0.0000000 0.0000000 0.0000000-0.0100000
"""


def _load(tmp_path: Path, content: str | bytes) -> None:
    path = tmp_path / "made.crg"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    load_road(path)


def test_the_text_itself_is_sound(tmp_path: Path) -> None:
    (tmp_path / "made.crg").write_text(TEXT)
    road = load_road(tmp_path / "made.crg")
    assert road.heights_uv(2.0, 0.0) == pytest.approx(0.02, abs=1e-8)
    assert road.heights_uv(3.0, 1.0) == pytest.approx(-0.01, abs=1e-8)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("_increment = 1.0", "_increment = 1,0", "line 7: reference_line_increment: '1,0' is not a number"),
        ("_increment = 1.0", "_increment = 1.0 m", "'1.0 m' is not a number"),
        ("_increment = 1.0", "_increment = nan", "'nan' is not a number"),
        ("_increment = 1.0", "_increment = 1e999", "too large"),
        ("_increment = 1.0", "_increment = 1e300", "reference_line_increment: is 1e\\+300 m: no road"),
        ("_increment = 1.0", "_increment = 1e-9", "reference_line_increment: is 1e-09 m: no road"),
        ("_increment = 1\n", "_increment = 1e300\n", "long_section_v_increment: is 1e\\+300 m: no road"),
        ("_increment = 1\n", "_increment = 6e3\n", "long_section_v_increment: is 6000 m: no road"),
        ("_increment = 1.0", "_increment = 0", "reference_line_increment: must be given and above 0"),
        ("_increment = 1.0", "_increment 1.0", "expected a line of the form name = number"),
        ("long_section_v_increment = 1", "", "long_section_v_increment: must be given"),
        ("end_u = 3 ", "end_u = 9 ", "4 cross sections where the header .* says 10"),
        ("end_u = 3 ", "end_u = 3e12 ", "reference_line_end_u"),
        ("#:LRFI", "#:LXFI", "data format 'LXFI' is none of"),
        ("#:LRFI\n", "", "names no data format"),
        ("D:long section 2,m", "D:long section 2", "has no unit"),
        ("D:long section 2,m", "D:temperature,K", "unknown channel"),
        ("D:long section 2,m\nD:long section 3,m\n", "", "needs 2 long sections or more, has 1"),
        ("D:long section 2,m", "D:long section at v = 0,m", "some long sections say their v"),
        ("$$$$\n", "", "no data section"),
        ("0.0200000 0.0100000", "0.0200000 O.0100000", "line 22: value 4: ' O.0100000' is not a number"),
        ("0.0200000 0.0100000", "0.0200000 0.01", "line 22: value 4: cut off"),
        ("0.0200000 0.0100000", "0.0200000", "line 22: value 4: cut off"),
        ("0.0200000 0.0100000", "0.0200000 0.0100000 0.0000000", "line 22: more than 4 values"),
        ("0.0200000 0.0100000", "0.0200000 9.9999e30", "is 1e\\+31 in cross section 3: no road is"),
        (
            " 0.0000000 0.0000000 0.0200000",
            "*missing** 0.0000000 0.0200000",
            "phi has no value in cross section 3",
        ),
        ("$CT\nmade by hand\n$\n", "$ROAD_CRG_FILE\nmade.crg\n$\n", "refers to made.crg, which refers back"),
        ("$CT\nmade by hand\n$\n", "$ROAD_CRG_FILE\nother.crg\n$\n", "other.crg, which does not exist"),
    ],
)
def test_faults_of_a_text_file(tmp_path: Path, old: str, new: str, fault: str) -> None:
    assert TEXT.count(old) >= 1
    with pytest.raises(InputError, match=fault) as caught:
        _load(tmp_path, TEXT.replace(old, new, 1))
    assert "made.crg" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"", "is empty"),
        (b"\0\1\2 binary", "is not an OpenCRG file"),
        (b"x,y,z\n1,2,3\n", "no data section"),
        ("\n".join(TEXT.splitlines()[:19]) + "\n", "0 cross sections"),
        ("\n".join(TEXT.splitlines()[:20]) + "\n", "1 cross sections"),
        (TEXT.replace("*missing**", " 0.000000\0"), "is not a number"),
    ],
)
def test_files_that_are_no_roads(tmp_path: Path, content: str | bytes, fault: str) -> None:
    with pytest.raises(InputError, match=fault):
        _load(tmp_path, content)


def test_paths_that_are_no_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_road(tmp_path / "none.crg")
    with pytest.raises(InputError, match="is a folder"):
        load_road(tmp_path)


@pytest.mark.parametrize("fmt", ["KRBI", "KDBI"])
def test_faults_of_a_binary_file(tmp_path: Path, fmt: str) -> None:
    path = tmp_path / "whole.crg"
    z = np.random.default_rng(2).normal(0, 0.1, (50, 4))
    pycrg.write(path, z, 0.1, np.arange(4.0), fmt=fmt)
    raw = path.read_bytes()
    size = 4 if fmt == "KRBI" else 8
    load_road(path)
    for lost in (1, 5, 79, 80, 400):
        with pytest.raises(InputError, match="bytes are missing"):
            _load(tmp_path, raw[:-lost] if lost != 5 else raw[:-100] + raw[-95:])
    with pytest.raises(InputError, match="bytes too many"):
        _load(tmp_path, raw + b"\0" * 7)
    # The same number of bytes, but out of step by one: heights of no road.
    at = len(raw) - 50 * 4 * size
    with pytest.raises(InputError, match="out of step|not one height"):
        _load(tmp_path, raw[:at] + raw[-1:] + raw[at:-1])


def test_a_road_of_nothing_but_missing_heights(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not one height"):
        _load(
            tmp_path,
            TEXT.split("$$$$\n", maxsplit=1)[0] + "$$$$\n" + 4 * " 0.0000000*missing***missing***missing**\n",
        )


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("_start_u = 0", "_start_u = " + "9" * 20_000),
        ("_start_u = 0", "x" * 20_000 + " = a"),
        ("_start_u = 0", "x" * 20_000),
        ("#:LRFI", "#:" + "Q" * 20_000),
        ("D:long section 1,m", "D:" + "wide " * 5000),
        ("D:long section 1,m", "D:long section " + "1" * 20_000),
        ("$CT\nmade by hand\n$\n", "$ROAD_CRG_FILE\n" + "other" * 5000 + "\n$\n"),
        (" 0.0000000 0.0000000 0.0200000", "x" * 20_000),
    ],
)
def test_a_fault_in_a_long_line_is_a_short_line(tmp_path: Path, old: str, new: str) -> None:
    with pytest.raises(InputError) as caught:
        _load(tmp_path, TEXT.replace(old, new, 1))
    assert len(str(caught.value)) < 400 + len(str(tmp_path))
