# SPDX-License-Identifier: Apache-2.0
"""Roads from scans: the road comes back with its edges and its uncertainty, and what is no ground does not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pytest

from suspension_twin.addons.roads.scan.clouds import (
    Cloud,
    Georeference,
    georeference_of,
    open_cloud,
    parse_axes,
)
from suspension_twin.addons.roads.scan.scan import ScanSettings, road_from_scan
from suspension_twin.arrays import Floats
from suspension_twin.cli.main import main
from suspension_twin.errors import InputError
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road import Road, load_road, write_road
from suspension_twin.road.build import Centreline
from suspension_twin.road.recipe import make_road, parse_feature
from suspension_twin.vehicle.twin import Datum

BAGS = Path(__file__).resolve().parents[4] / "bags"
LENGTH = 30.0


@pytest.fixture(scope="module")
def truth() -> Road:
    features = [parse_feature("bump", "0.9x0.05@8"), parse_feature("pothole", "0.6x0.06@18:left")]
    return make_road(LENGTH, 8.0, features=features, iso="B", seed=4, step=0.02)


def sampled(road: Road, density: float, noise: float, seed: int = 0) -> Floats:
    """Points (n, 3) on a road, in its own (u, v)."""
    rng = np.random.default_rng(seed)
    n = int(density * road.length * 6.0)
    u, v = rng.uniform(0.0, road.length, n), rng.uniform(-3.0, 3.0, n)
    return np.column_stack([u, v, road.heights_uv(u, v) + noise * rng.standard_normal(n)])


@pytest.fixture(scope="module")
def points(truth: Road) -> Floats:
    """A scan with noise of 4 mm, a car over the lane that leaves a hole under it, a person, a hanging branch, a
    wet patch of 0.3 m and one of 1 m, and single points below and above."""
    rng = np.random.default_rng(1)
    p = sampled(truth, 2500.0, 0.004)

    def gone(u: float, v: float, du: float, dv: float) -> None:
        nonlocal p
        p = p[(np.abs(p[:, 0] - u) > du) | (np.abs(p[:, 1] - v) > dv)]

    gone(25.0, 0.75, 0.15, 0.15)
    gone(22.0, 0.0, 0.5, 0.5)
    gone(28.0, -2.2, 1.5, 0.9)
    box = rng.uniform([26.5, -3.1, 0.2], [29.5, -1.3, 1.4], (20000, 3))
    box[:, 2] += truth.heights_uv(28.0, 0.0)
    legs = rng.uniform([13.0, -0.9, 0.0], [13.3, -0.6, 1.7], (3000, 3))
    gone(13.15, -0.75, 0.15, 0.15)
    branch = rng.uniform([3.0, -2.0, 2.4], [6.0, 2.0, 3.5], (5000, 3))
    strays = rng.uniform([0.0, -2.0, -1.0], [LENGTH, 2.0, 2.0], (300, 3))
    return np.vstack([p, box, legs, branch, strays])[rng.permutation(len(p) + 28300)]


def as_cloud(points: Floats) -> list[tuple[Cloud, Georeference]]:
    return [(Cloud(Path("made"), len(points), None, lambda: iter(np.array_split(points, 3))), Georeference())]


STRAIGHT = Centreline([0.0, LENGTH], [0.0, 0.0], 0.025)


@pytest.mark.long
def test_the_road_comes_back_with_its_edges(points: Floats, truth: Road) -> None:
    found = road_from_scan(as_cloud(points), STRAIGHT, "line")
    edges, gaussian, road = found.edges, found.gaussian, found.road
    u, v = np.meshgrid(road.u, road.v, indexing="ij")
    true = truth.heights_uv(u, v)
    error = road.heights_grid - true
    # The sill of a pothole lies between two nodes: there heights of one side may stand beside the other's.
    sill = (np.abs(u - 18.3) < 0.34) & (v > -0.1)
    measured = (found.status == 0) & ~sill
    assert np.sqrt(np.mean(error[measured] ** 2)) < 1.2e-3
    assert np.abs(error[measured]).max() < 8e-3
    covered = np.abs(error[measured]) < 1.645 * found.surface.sigma[measured]
    assert 0.75 < covered.mean() < 0.97
    # The rim of the pothole: 0.1 m beside it the road is level, on its floor it is 6 cm lower.
    j = int(np.abs(road.v - 1.0).argmin())
    for at in (17.9, 18.1, 18.5, 18.7):
        i = int(np.abs(road.u - at).argmin())
        assert abs(edges.heights_grid[i, j] - true[i, j]) < 3e-3
    rim = (np.abs(u - 18.0) < 0.12) & (v > 0.2)
    kept, smoothed = (np.sqrt(np.mean((r.heights_grid - true)[rim] ** 2)) for r in (edges, gaussian))
    assert kept < 0.4 * smoothed
    # Holes: the small one is filled, the large one is marked and known to the check, that under the car open.
    status = {place: found.status[np.abs(road.u - place[0]).argmin(), np.abs(road.v - place[1]).argmin()]
              for place in ((25.0, 0.75), (22.0, 0.0), (28.0, -1.9), (13.15, -0.75), (10.0, 0.0))}  # fmt: skip
    assert status == {(25.0, 0.75): 1, (22.0, 0.0): 2, (28.0, -1.9): 2, (13.15, -0.75): 1, (10.0, 0.0): 0}
    middle = np.hypot(u - 22.0, v) < 0.2
    assert found.surface.sigma[middle].mean() > 1.3 * found.surface.sigma[found.status == 0].mean()
    filled = found.status == 1
    assert np.sqrt(np.mean(error[filled] ** 2)) < 1.5e-3


def test_an_obstacle_narrower_than_two_cells_keeps_its_top() -> None:
    true = make_road(10.0, 8.0, features=[parse_feature("bump", "0.2x0.1@5")], step=0.01)
    cloud = sampled(true, 3000.0, 0.003)
    found = road_from_scan(as_cloud(cloud), Centreline([0.0, 10.0], [0.0, 0.0], 0.025), "line")
    i = int(np.abs(found.road.u - 5.1).argmin())
    top = true.heights_uv(found.road.u[i], found.road.v)
    np.testing.assert_allclose(found.road.heights_grid[i], top, atol=8e-3)


def test_the_command_makes_a_road_that_can_be_driven(
    points: Floats, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud, line, out, picture = (tmp_path / n for n in ("a.laz", "line.csv", "road.crg", "road.png"))
    save_las(points, cloud)
    line.write_text("x;y\n0;0\n15;0\n30;0\n")
    command = ["road", "scan", str(cloud), "--path", str(line), "--out", str(out), "--picture", str(picture)]
    assert main([*command, "--step", "0.05", "0.1"]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"Writes {out}, {tmp_path / 'road.json'}, {tmp_path / 'road.npz'}, {picture}\n")
    record = json.loads((tmp_path / "road.json").read_text())
    responses = {row["name"]: row for row in record["felt"]}
    assert (
        responses["Gaussian, 0.1 m"]["difference"]
        > 2 * responses["another draw within its uncertainty"]["difference"]
    )
    nodes = np.load(tmp_path / "road.npz")
    road = load_road(out)
    assert nodes["z"].shape == road.z.shape and np.isnan(nodes["z"][nodes["status"] == 2]).all()
    np.testing.assert_allclose(
        nodes["z"][nodes["status"] == 0], road.heights_grid[nodes["status"] == 0], atol=1e-6
    )
    assert picture.stat().st_size > 50_000
    assert main(["road", "check", str(out)]) == 1
    assert "nothing was measured at u 21." in capsys.readouterr().out
    assert main(command) == 2 and "--force" in capsys.readouterr().err


def save_las(points: Floats, path: Path, crs: str | None = None) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(points.min(axis=0))
    if crs is not None:
        import pyproj

        header.add_crs(pyproj.CRS.from_user_input(crs))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    data.write(path)


def save_ply(text: bool) -> Callable[[Floats, Path], None]:
    def save(points: Floats, path: Path) -> None:
        rows = np.rec.fromarrays(points.T, names="x,y,z")
        plyfile.PlyData([plyfile.PlyElement.describe(np.array(rows), "vertex")], text=text).write(str(path))

    return save


def save_text(head: str, mark: str, order: str) -> Callable[[Floats, Path], None]:
    def save(points: Floats, path: Path) -> None:
        columns = ["xyz".index(c) if c in "xyz" else 0 for c in order]
        np.savetxt(path, points[:, columns], delimiter=mark, header=head, comments="", fmt="%.4f")

    return save


@pytest.mark.parametrize(
    ("name", "save"),
    [
        ("a.las", save_las),
        ("a.laz", save_las),
        ("a.ply", save_ply(False)),
        ("text.ply", save_ply(True)),
        ("a.xyz", save_text("# made by hand", " ", "xyzi")),
        ("a.csv", save_text("i,z,y,x", ",", "izyx")),
        ("a.pts", save_text("500", " ", "xyz")),
    ],
)
def test_every_format_gives_the_same_points(
    name: str, save: Callable[[Floats, Path], None], points: Floats, tmp_path: Path
) -> None:
    save(points[:500], tmp_path / name)
    cloud = open_cloud(tmp_path / name)
    np.testing.assert_allclose(np.concatenate(list(cloud.pieces())), points[:500], atol=1e-4)
    assert cloud.count in (None, 500)


@pytest.mark.parametrize(
    ("form", "origin", "axes", "coarse"),
    [
        ("<f4", (691000.0, 5334000.0), "xyz", True),
        ("<f8", (691000.0, 5334000.0), "xyz", False),
        ("<f4", (20.0, 30.0), "yxz", False),
        ("<f4", (1000.0, 2_000_000.0), "yxz", True),
    ],
)
def test_coordinates_that_are_coarser_than_the_nodes_are_noted(
    form: str, origin: tuple[float, float], axes: str, coarse: bool, truth: Road, tmp_path: Path
) -> None:
    """Single precision has steps of 0.5 m at the northing of a UTM zone."""
    own = sampled(truth, 1000.0, 0.004) + np.array([*origin, 0.0])
    path = tmp_path / "a.ply"
    save_ply(False)(own[:, ["xyz".index(axis) for axis in axes]].astype(form), path)
    georeference = Georeference(parse_axes(axes), move=(-origin[0], -origin[1]))
    try:
        settings = ScanSettings(width=3.0)
        said = road_from_scan([(open_cloud(path), georeference)], STRAIGHT, "line", settings).facts.get(
            "note", ""
        )
    except InputError as error:  # whose reason it may be
        said = str(error)
    assert ("a.ply: coordinates in steps of" in said) is coarse


@pytest.mark.parametrize("crs", ["EPSG:32634", "EPSG:2263", "EPSG:23700", "EPSG:4326"])
def test_a_crs_comes_to_map_by_the_datum(crs: str, points: Floats, tmp_path: Path) -> None:
    import pyproj

    datum = Datum(latitude=40.7, longitude=-74.0, altitude=12.0)
    if crs in ("EPSG:32634", "EPSG:23700"):
        datum = Datum(latitude=47.4, longitude=19.3, altitude=12.0)
    geodetic = LocalMap(datum).to_geodetic(points[:200])
    to = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    x, y = to.transform(geodetic[:, 1], geodetic[:, 0])
    feet = 3937.0 / 1200.0 if crs == "EPSG:2263" else 1.0
    own = np.column_stack([x, y, geodetic[:, 2] * feet])
    georeference, words = georeference_of(
        Path("a"), pyproj.CRS.from_user_input(crs), None, "xyz", None, datum
    )
    np.testing.assert_allclose(georeference.to_map(own), points[:200], atol=2e-3)
    assert "by the datum" in words
    box = georeference.box(points[:200, 0], points[:200, 1], 1.0)
    assert len(georeference.within(own, box)) == 200
    assert len(georeference.within(own + np.array([1e5, 1e5, 0.0]), box)) == 0


def test_axes_are_an_order_with_signs() -> None:
    assert Georeference(parse_axes("x-zy")).to_map(np.array([[1.0, 2.0, 3.0]])).tolist() == [[1.0, -3.0, 2.0]]
    for text in ("xyy", "xy", "abc", "xyz "):
        with pytest.raises(InputError, match="--axes"):
            parse_axes(text)


FEET = 1.0 / 0.3048
EAST = np.array([400.0, 200.0, 0.0])  # so that a mistake takes the cloud off the path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda p: p + np.array([5000.0, 0.0, 0.0]),
            r"is of another place than line: it lies at x 5400 .* 4970 m off",
        ),
        (
            lambda p: p + np.array([4e5, 5e6, 0.0]),
            r" m off, as coordinates of a national grid are: --crs names it$",
        ),
        (lambda p: p * FEET, r"does if it is in ft: --unit ft$"),
        (lambda p: p[:, [1, 0, 2]], r"with other axes: --axes yxz$"),
        (lambda p: p[:, [0, 2, 1]] * [1, 1, -1], r"with other axes: --axes x-zy$"),
        (
            lambda p: p + np.random.default_rng(0).uniform(0, 2, p.shape) * [0, 0, 1],
            r"has no ground along the path",
        ),
        (lambda p: p[p[:, 0] < 420.0], r"leaves the cloud at 20 m of its 30 m: --section 0 20 takes"),
        (lambda p: p[::4000], r"has too few points|has ground in|does not cover|is of another place"),
    ],
)
def test_a_cloud_that_does_not_fit_is_one_line(
    change: Callable[[Floats], Floats], words: str, truth: Road
) -> None:
    cloud = change(sampled(truth, 400.0, 0.003) + EAST)
    line = Centreline(STRAIGHT.x + EAST[0], STRAIGHT.y + EAST[1], 0.025)
    with pytest.raises(InputError, match=words) as caught:
        road_from_scan(as_cloud(cloud), line, "line")
    assert "\n" not in str(caught.value)


def test_a_cloud_at_the_origin_that_may_be_in_feet_is_noted(truth: Road) -> None:
    cloud = sampled(truth, 400.0, 0.003)
    for unit, noted in ((1.0, False), (FEET, True)):
        facts = road_from_scan(as_cloud(cloud * unit), STRAIGHT, "line", ScanSettings(width=2.0)).facts
        assert ("--unit ft" in facts.get("note", "")) is noted


def test_a_section_and_another_unit_are_taken(truth: Road) -> None:
    cloud = (sampled(truth, 600.0, 0.002) + EAST) * FEET
    placed = [(as_cloud(cloud)[0][0], Georeference(unit=0.3048, up=0.3048))]
    line = Centreline(STRAIGHT.x + EAST[0], STRAIGHT.y + EAST[1], 0.025)
    found = road_from_scan(
        placed, line, "line", ScanSettings(width=2.0, section=(5.0, 15.0), filter="gaussian")
    )
    assert found.road.length == pytest.approx(10.0, abs=0.1)
    at = np.linspace(1.0, 9.0, 50)
    error = found.road.heights_uv(at, 0.3) - truth.heights_uv(at + 5.0, 0.3)
    assert np.abs(np.where(np.abs(at - 3.4) < 0.8, 0.0, error)).max() < 4e-3


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.xyz", "", "is empty"),
        ("a.xyz", "# nothing\n", "holds no points"),
        ("a.xyz", "1 2 3\n1 2\n", "no point"),
        ("a.xyz", "1 2 3\n1 2 x\n", "no point: could not convert string 'x'"),
        ("a.las", "LASF and no more", "is cut off in its header"),
        *(
            (
                "a.ply",
                f"ply\nformat {form} 1.0\nelement {name} 2000000000\nproperty {kind} x\nend_header\n1 2\n",
                "bytes are there of",
            )
            for form in ("ascii", "binary_little_endian")
            for name, kind in (("face", "list uint int"), ("vertex", "double"))
        ),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "x, y and z"),
    ],
)
def test_a_damaged_cloud_is_one_line(
    name: str, text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text(text)
    (tmp_path / "line.csv").write_text("0,0\n30,0\n")
    command = ["road", "scan", str(tmp_path / name), "--path", str(tmp_path / "line.csv"), "--out"]
    assert main([*command, str(tmp_path / "road.crg")]) == 2
    said = capsys.readouterr().err
    assert name in said and words in said and said.count("\n") == 1
    assert not (tmp_path / "road.crg").exists()


@pytest.mark.parametrize(
    ("name", "at", "value"),
    [
        ("a.las", 100, b"\xff\xff\xff\x7f"),  # records before the points
        ("a.las", 247, b"\xff\xff\xff\x7f"),  # points
        ("a.laz", 247, b"\xff\xff\xff\x7f"),
        ("a.laz", None, b"\xff\xff\xff\x7f"),  # chunks of compressed points
    ],
)
def test_a_header_that_promises_what_is_not_there_is_refused_at_once(
    name: str, at: int | None, value: bytes, points: Floats, tmp_path: Path
) -> None:
    save_las(points[:500], tmp_path / name)
    raw = bytearray((tmp_path / name).read_bytes())
    if at is None:
        begin = int.from_bytes(raw[96:100], "little")
        at = int.from_bytes(raw[begin : begin + 8], "little") + 4
    raw[at : at + 4] = value
    (tmp_path / name).write_bytes(raw)
    with pytest.raises(InputError, match=r"promises more|unpacks to more|is cut off or damaged"):
        open_cloud(tmp_path / name)


def test_a_drive_is_the_path_and_its_gap_is_reported(tmp_path: Path) -> None:
    """The bundled drive over its own road, scanned along the drive's path."""
    true = load_road(BAGS / "bump_15kmh" / "road.crg")
    rng = np.random.default_rng(3)
    u, v = rng.uniform(true.u_first, true.u_last, 150_000), rng.uniform(-2.4, 2.4, 150_000)
    x, y = true.uv_to_xy(u, v)
    np.savetxt(tmp_path / "a.xyz", np.column_stack([x, y, true.heights_uv(u, v)]), fmt="%.4f")
    write_road(true, tmp_path / "true.crg")
    twin = BAGS / "bump_15kmh" / "twin.yaml"
    command = [
        "road",
        "scan",
        str(tmp_path / "a.xyz"),
        "--path",
        str(BAGS / "bump_15kmh"),
        "--twin",
        str(twin),
    ]
    assert (
        main([*command, "--out", str(tmp_path / "road.crg"), "--width", "3", "--section", "66", "108"]) == 0
    )
    response = json.loads((tmp_path / "road.json").read_text())["felt"][0]
    assert response["gap"] < 0.7 * response["rms"]
    road = load_road(tmp_path / "road.crg")
    places = road.uv_to_xy(np.linspace(2.0, road.length - 2.0, 200), np.full(200, 0.7))
    np.testing.assert_allclose(road.heights(*places), true.heights(*places), atol=4e-3)
