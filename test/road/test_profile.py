# SPDX-License-Identifier: Apache-2.0
"""Roads of profilers' files: CSV, ERD in text and binary, OpenDRIVE with OpenCRG surfaces."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate

from suspension_twin.cli.main import main
from suspension_twin.errors import InputError
from suspension_twin.road import grid_road, load_road, write_road
from suspension_twin.road.opendrive import read_opendrive
from suspension_twin.road.profile import profile_road, read_profile, together

S = 0.1 * np.arange(201)
LEFT, RIGHT = 0.02 * np.sin(S), 0.01 * np.cos(2.0 * S)


def csv_text(head: str, mark: str, *lines: np.ndarray, scale: float = 1.0) -> str:  # type: ignore[type-arg]
    rows = [mark.join(f"{value * scale:.7g}" if j else f"{s:.2f}" for j, value in enumerate((s, *z)))
            for s, *z in zip(S, *lines, strict=True)]  # fmt: skip
    return "\n".join([head, *rows] if head else rows)


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        (csv_text("distance [m],left [mm],right [mm]", ",", LEFT, RIGHT, scale=1e3), None),
        (
            csv_text("# by hand\ns (m);right (cm);left (cm)", ";", RIGHT, LEFT, scale=1e2).replace(".", ","),
            None,
        ),
        (csv_text("", "\t", LEFT, RIGHT, scale=1 / 0.0254), "in"),
        (csv_text("", " ", LEFT, RIGHT), None),
    ],
    ids=["units in the heading", "decimal comma, right first", "no heading, inches", "blanks"],
)
def test_csv_of_two_wheel_paths(text: str, unit: str | None, tmp_path: Path) -> None:
    file, out = tmp_path / "a.csv", tmp_path / "a.crg"
    file.write_text(text)
    arguments = ["--unit", unit] if unit else []
    command = ["road", "profile", str(file), "--track", "1.6", "--at", "3", "4", "90", "--out", str(out)]
    assert main([*command, *arguments]) == 0
    road = load_road(out)
    assert (road.x[0], road.y[0], road.length) == pytest.approx((3, 4, 20), abs=1e-6)
    u = road.u
    for v, z in ((0.8, LEFT), (0.9, LEFT), (0.6, LEFT), (-0.8, RIGHT), (-1.9, RIGHT)):
        np.testing.assert_allclose(road.heights_uv(u, v), z, atol=2e-7)
    np.testing.assert_allclose(road.heights_uv(u, 0.0), 0.5 * (LEFT + RIGHT), atol=2e-7)


def test_one_line_and_many_lines(tmp_path: Path) -> None:
    one, many = tmp_path / "one.csv", tmp_path / "many.csv"
    one.write_text(csv_text("", ",", LEFT))
    many.write_text(csv_text("s,-1.5,0,0.5,1.5", ",", LEFT, RIGHT, 2 * LEFT, 0 * LEFT))
    road = profile_road(read_profile(one))
    np.testing.assert_allclose(road.heights_uv(S, 1.3), LEFT, atol=2e-7)
    road = profile_road(read_profile(many))
    assert road.v.tolist() == [-2.0, -1.5, 0.0, 0.5, 1.5, 2.0]
    np.testing.assert_allclose(road.heights_uv(S, 0.5), 2 * LEFT, atol=2e-7)
    with pytest.raises(InputError, match="--v says where"):
        profile_road(together([read_profile(one)] * 3))
    road = profile_road(together([read_profile(one)] * 3), v=[0.7, 0.0, -0.7])
    np.testing.assert_allclose(road.heights_uv(S, -0.35), LEFT, atol=2e-7)


def test_uneven_steps_are_made_even(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    s = np.sort(np.concatenate([S, [3.33, 7.77]]))
    file.write_text("\n".join(f"{a:.3f},{0.02 * np.sin(a):.8f}" for a in s))
    read = read_profile(file)
    assert read.step == pytest.approx(0.1, abs=1e-3)
    np.testing.assert_allclose(read.z[0], 0.02 * np.sin(read.step * np.arange(read.z.shape[1])), atol=5e-5)


def erd(kind: int, lines: list[np.ndarray], *more: str, samples: int | None = None) -> str:  # type: ignore[type-arg]
    count = len(lines[0]) if samples is None else samples
    return "\n".join([
        "ERDFILEV2.00",
        f"{len(lines)}, {count}, -1, 1, {kind}, 0.1, -1,",
        "TITLE   A test section",
        *more,
        "XUNITS  m",
        "END",
        "",
    ])  # fmt: skip


def test_erd_text(tmp_path: Path) -> None:
    file = tmp_path / "a.erd"
    lines = [RIGHT * 1e3, LEFT * 1e3, np.ones(S.size)]
    names = f"{'SHORTNAM'}{'RElev.':8}{'LElev.':8}{'Speed':8}", f"{'UNITSNAM'}{'mm':8}{'mm':8}{'km/h':8}"
    text = erd(5, lines, *names)
    file.write_text(text + "\n".join(" ".join(f"{v:.5f}" for v in row) for row in zip(*lines, strict=True)))
    read = read_profile(file)
    assert (read.names, read.step) == (("RElev.", "LElev."), 0.1)
    road = profile_road(read, track=1.5)
    np.testing.assert_allclose(road.heights_uv(S, 0.75), LEFT, atol=1e-7)
    np.testing.assert_allclose(road.heights_uv(S, -0.75), RIGHT, atol=1e-7)


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize(("kind", "code"), [(0, "h"), (1, "f")])
def test_erd_binary(kind: int, code: str, beside: bool, tmp_path: Path) -> None:
    file = tmp_path / "a.erd"
    scale = 1e-5 if kind == 0 else 1.0
    lines = [np.round(line / scale) * 1.0 if kind == 0 else line for line in (LEFT, RIGHT)]
    more = [f"GAINS   {scale}, {scale}", "OFFSETS 0, 0.5"] if kind == 0 else []
    flat = np.column_stack(lines).ravel()
    data = struct.pack(f"<{flat.size}{code}", *(flat.astype(int) if kind == 0 else flat))
    head = erd(kind, lines, *more).encode()
    file.write_bytes(head if beside else head + data)
    if beside:
        (tmp_path / "a.erd.bin").write_bytes(data)
    read = read_profile(file)
    np.testing.assert_allclose(read.z, [LEFT, RIGHT + 0.5 * (kind == 0)], atol=6e-6)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is empty"),
        ("0,1\n", "two rows or more"),
        ("0,1\n1,2\n1,3\n", "distance: must rise; after 1 m comes 1 m"),
        ("0,1\n1,x\n", "row 2, column 2: 'x' is not a number"),
        ("0,1\n1,2,3\n", "row 2: has 3 columns instead of 2"),
        ("s,left [furlong]\n0,1\n1,2\n", "'furlong' is not a length"),
        ("0,nan\n1,nan\n", "heights: none that is finite"),
        ("ERDFILEV1.00\n", "another version"),
        ("ERDFILEV2.00\n1,2,3\nEND\n1 2", "line 2: needs numbers"),
        ("ERDFILEV2.00\n1,2,-1,1,5,0.1,-1\n1 2", "no line END"),
        ("ERDFILEV2.00\n1,2,-1,1,7,0.1,-1\nEND\n1 2", "data of kind 7"),
        ("ERDFILEV2.00\n1,3,-1,1,5,0.1,-1\nEND\n1 2", "2 samples, the header says 3"),
        ("ERDFILEV2.00\n2,2,-1,1,5,0.1,-1\nEND\n1 2 3", "3 values for 2 channels"),
        ("ERDFILEV2.00\n1,2,-1,1,5,0.1,-1\nUNITSNAMm/s\nEND\n1 2", "no channel is a height: m/s"),
        ("ERDFILEV2.00\n1,2,-1,1,5,0.1,-1\nEND\n1 a", "not a number"),
        ("PPF\0", "export it from ProVAL as ERD"),
    ],
)
def test_bad_profiles_are_one_line(
    content: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bad.dat"
    file.write_text(content)
    assert main(["road", "profile", str(file), "--out", str(tmp_path / "a.crg")]) == 2
    said = capsys.readouterr().err
    assert "bad.dat" in said
    assert words in said
    assert said.count("\n") == 1
    assert not (tmp_path / "a.crg").exists()


XODR = """<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="8"/>
<road id="7" length="120"><planView>{plan}</planView>
<elevationProfile><elevation s="0" a="5" b="0.01" c="0" d="0"/></elevationProfile>
<lateralProfile><superelevation s="0" a="0.02" b="0" c="0" d="0"/></lateralProfile>
<surface><CRG file="bumps.crg" {crg}/></surface></road></OpenDRIVE>"""
ARC = """<geometry s="0" x="10" y="20" hdg="0" length="20"><line/></geometry>
<geometry s="20" x="30" y="20" hdg="0" length="100"><arc curvature="0.02"/></geometry>"""


@pytest.fixture
def bumps(tmp_path: Path) -> Path:
    v = np.array([-2.0, 0.0, 2.0])
    u = 0.1 * np.arange(401)
    write_road(grid_road(0.05 * np.sin(u)[:, None] + 0.01 * v, 0.1, v), tmp_path / "bumps.crg")
    return tmp_path


def test_an_attached_surface_follows_the_road(bumps: Path) -> None:
    file = bumps / "map.xodr"
    crg = 'mode="attached" orientation="same" sStart="15" sEnd="50" sOffset="12" tOffset="0.5" zOffset="0.1" zScale="2"'
    file.write_text(XODR.format(plan=ARC, crg=crg))
    out = bumps / "out.crg"
    assert main(["road", "profile", str(file), "--out", str(out)]) == 0
    road = load_road(out)
    # A place 20 m along the arc of 50 m radius, 1 m to the left of the line.
    angle, s, t = 0.4, 40.0, 1.0
    x, y = 30 + (50 - t) * np.sin(angle), 20 + 50 - (50 - t) * np.cos(angle)
    wanted = 5 + 0.01 * s + 0.1 + np.tan(0.02) * t + 2 * (0.05 * np.sin(s - 12) + 0.01 * (t - 0.5))
    assert float(road.heights(x, y)) == pytest.approx(wanted, abs=2e-3)
    assert road.length == pytest.approx(35.0, abs=0.11)
    file.write_text(XODR.format(plan=ARC, crg=crg.replace("attached", "attached0")))
    assert float(read_opendrive(file).heights(x, y)) == pytest.approx(
        wanted - 5 - 0.01 * s - np.tan(0.02) * t, abs=2e-3
    )


@pytest.mark.parametrize("start", [0.0, 15.0])
@pytest.mark.parametrize("offset", [0.0, 10.0, -5.0])
@pytest.mark.parametrize("mode", ["attached", "attached0", "genuine", "global"])
def test_limits_and_offsets_of_a_surface(mode: str, offset: float, start: float, bumps: Path) -> None:
    """The formulas of ASAM OpenDRIVE 1.9, 10.6.1, along a straight road that starts at (10, 20) and heads 0.3 rad."""
    file = bumps / "map.xodr"
    plan = '<geometry s="0" x="10" y="20" hdg="0.3" length="120"><line/></geometry>'
    turned = 'hOffset="0.2"' if mode in ("genuine", "global") else ""
    moved = f'sOffset="{offset}" tOffset="0.4"'
    if mode == "global":
        moved = f'xOffset="{15 + offset}" yOffset="21"'
    crg = f'mode="{mode}" sStart="{start}" sEnd="30" {moved} {turned} zOffset="0.5" zScale="2"'
    file.write_text(XODR.format(plan=plan, crg=crg))
    road = read_opendrive(file)
    crg_road = load_road(bumps / "bumps.crg")
    for s, t in ((16.0, 0.3), (22.0, -0.7), (26.0, 1.1)):
        x, y = 10 + s * np.cos(0.3) - t * np.sin(0.3), 20 + s * np.sin(0.3) + t * np.cos(0.3)
        if mode.startswith("attached"):
            z = crg_road.heights_uv(s - offset, t - 0.4)
        else:
            x0, y0 = 15 + offset, 21.0
            heading = 0.2
            if mode == "genuine":
                x0 = 10 + offset * np.cos(0.3) - 0.4 * np.sin(0.3)
                y0 = 20 + offset * np.sin(0.3) + 0.4 * np.cos(0.3)
                heading = 0.3 + 0.2
            cos, sin = np.cos(heading), np.sin(heading)
            z = crg_road.heights(cos * (x - x0) + sin * (y - y0), cos * (y - y0) - sin * (x - x0))
        wanted = 2 * float(z) + 0.5 + (mode == "attached") * (5 + 0.01 * s + np.tan(0.02) * t)
        assert float(road.heights(x, y)) == pytest.approx(wanted, abs=1e-4)
    inside = (road.x - 10) * np.cos(0.3) + (road.y - 20) * np.sin(0.3)
    assert start - 1e-6 <= inside.min() and inside.max() <= 30 + 1e-6


LATERAL = """
<lateralProfile>{profile}</lateralProfile>
<lanes><laneOffset s="0" a="{offset}" b="0" c="0" d="0"/><laneSection s="0">
<left><lane id="1" level="{level}"><width sOffset="0" a="2" b="0" c="0" d="0"/>
<height sOffset="0" inner="0" outer="0"/><height sOffset="10" inner="0.1" outer="0.2"/></lane></left>
<center><lane id="0"/></center>
<right><lane id="-1"><width sOffset="0" a="1" b="0.02" c="0" d="0"/></lane>
<lane id="-2"><width sOffset="0" a="3" b="0" c="0" d="0"/><height sOffset="0" inner="0.12" outer="0.12"/></lane></right>
</laneSection></lanes>"""


@pytest.mark.parametrize("level", ["false", "true"])
@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_an_attached_surface_lies_on_the_lateral_profile_and_the_lanes(
    level: str, offset: float, bumps: Path
) -> None:
    file = bumps / "map.xodr"
    plan = '<geometry s="0" x="0" y="0" hdg="0" length="120"><line/></geometry>'
    shape = (
        '<shape s="0" t="-4" a="-0.08" b="0.02" c="0" d="0"/><shape s="0" t="0" a="0" b="0" c="-0.01" d="0"/>'
        '<shape s="40" t="-4" a="0.4" b="0" c="0" d="0"/>'
    )
    fall = (
        '<crossfall side="both" s="0" a="0.03" b="0" c="0" d="0"/>'
        '<crossfall side="left" s="20" a="0" b="0" c="0" d="0"/>'
    )
    text = XODR.replace(
        '<lateralProfile><superelevation s="0" a="0.02" b="0" c="0" d="0"/></lateralProfile>', "{lateral}"
    )
    crg = 'mode="attached" sStart="0" sEnd="40"'
    for profile in (shape, fall):
        lateral = LATERAL.format(profile=profile, level=level, offset=offset)
        file.write_text(text.format(plan=plan, crg=crg, lateral=lateral))
        road = read_opendrive(file)
        for s in (4.0, 18.0, 33.0):
            for t in (-1.9, -1.2, -0.4, 0.3, 1.3, 2.0):
                flat = min(t, offset) if level == "true" else t
                if profile is shape:
                    first = -0.08 + 0.02 * (flat + 4) if flat < 0 else -0.01 * flat**2
                    height = first * (1 - s / 40) + 0.4 * s / 40
                else:
                    # The last entry of a side holds.
                    height = -np.tan(0.0 if flat > 0 and s > 20 else 0.03) * abs(flat)
                if s > 10 and offset < t <= offset + 2:
                    height += 0.1 + 0.1 * (t - offset) / 2
                if t < offset - 1 - 0.02 * s:
                    height += 0.12
                wanted = 5 + 0.01 * s + 0.05 * np.sin(s) + 0.01 * t + height
                assert float(road.heights(s, t)) == pytest.approx(wanted, abs=2e-3), (s, t)


def test_a_clothoid_and_a_cubic_lie_where_they_should(bumps: Path) -> None:
    file = bumps / "map.xodr"
    for plan in (
        '<geometry s="0" x="0" y="0" hdg="0" length="120"><spiral curvStart="0" curvEnd="0.012"/></geometry>',
        '<geometry s="0" x="0" y="0" hdg="0" length="120"><paramPoly3 aU="0" bU="120" cU="0" dU="0" '
        'aV="0" bV="0" cV="0" dV="30" pRange="normalized"/></geometry>',
    ):
        file.write_text(XODR.format(plan=plan, crg='mode="attached" sStart="0" sEnd="40"'))
        road = read_opendrive(file)
        u = road.u[-1]
        if "spiral" in plan:  # independent: integrated in small steps
            s = np.linspace(0, u, 200001)
            direction = 0.5 * 1e-4 * s**2
            x, y = (integrate.trapezoid(f(direction), s) for f in (np.cos, np.sin))
        else:
            x = road.x[-1]
            y = 30 * (x / 120) ** 3
        assert (road.x[-1], road.y[-1]) == pytest.approx((x, y), abs=1e-3)
        assert np.hypot(np.diff(road.x), np.diff(road.y)) == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<a/>", "its root is <a>"),
        ("<OpenDRIVE>", "not XML"),
        ("<OpenDRIVE/>", "no road has a <surface>"),
        (
            XODR.format(plan="<geometry s='0' x='0' y='0' hdg='0' length='9'><poly3/></geometry>", crg=""),
            "poly3",
        ),
        (XODR.format(plan=ARC, crg='orientation="opposite"'), "opposite orientation"),
        (XODR.format(plan=ARC, crg='mode="global" orientation="opposite"'), "opposite orientation"),
        (
            XODR.format(plan=ARC, crg='mode="global" sOffset="1"'),
            "sOffset: is 1, has no meaning in mode global",
        ),
        (XODR.format(plan=ARC, crg='mode="attached" hOffset="1"'), "hOffset: is 1, has no meaning"),
        (XODR.format(plan=ARC, crg='mode="genuine" sStart="90"'), "between sStart and sEnd"),
        (XODR.format(plan="", crg=""), "no plan view"),
        (
            XODR.replace("<superelevation", "<crossSectionSurface/><superelevation").format(plan=ARC, crg=""),
            "<crossSectionSurface> is not read",
        ),
        (XODR.format(plan=ARC, crg='mode="wrong"'), "mode 'wrong'"),
        (XODR.format(plan=ARC, crg='sStart="a"'), "<CRG> sStart: 'a' is not a number"),
        (XODR.replace("bumps", "none").format(plan=ARC, crg=""), "none.crg"),
    ],
)
def test_bad_opendrive_is_one_line(text: str, words: str, bumps: Path) -> None:
    file = bumps / "map.xodr"
    file.write_text(text)
    with pytest.raises(InputError, match="xodr|crg") as caught:
        read_opendrive(file)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
