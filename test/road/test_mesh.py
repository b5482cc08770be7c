# SPDX-License-Identifier: Apache-2.0
"""Meshes read back: the triangles lie on the road, face up, and the tiles leave no seam."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from suspension_twin.addons.view.axes import to_unity, to_unreal
from suspension_twin.cli.main import main
from suspension_twin.errors import InputError, WorkError
from suspension_twin.road import Road, curved_road, flat_road, grid_road, load_road
from suspension_twin.road.mesh import road_mesh, write_mesh
from suspension_twin.road.roughness import iso8608_road

Floats = NDArray[np.float64]


class Stl(NamedTuple):
    normals: Floats
    corners: Floats  # (n, 3, 3)


class Obj(NamedTuple):
    vertices: Floats
    normals: Floats
    places: Floats
    faces: NDArray[np.int64]  # (n, 3), from 0
    objects: list[tuple[str, int]]  # name and its first face


def read_stl(path: Path) -> Stl:
    """A binary STL as its description has it: 80 bytes, a count, 50 bytes a facet."""
    raw = path.read_bytes()
    assert not raw.startswith(b"solid")
    (count,) = struct.unpack_from("<I", raw, 80)
    assert len(raw) == 84 + 50 * count
    facets = [struct.unpack_from("<12fH", raw, 84 + 50 * i) for i in range(count)]
    table = np.array([f[:12] for f in facets])
    return Stl(table[:, :3], table[:, 3:].reshape(-1, 3, 3))


def read_obj(path: Path) -> Obj:
    """The lines of an OBJ that a mesh is made of; every corner must number all three things alike."""
    rows: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    faces, objects = [], []
    for line in path.read_text("ascii").splitlines():
        word, *rest = line.split()
        if word in rows:
            rows[word].append([float(n) for n in rest])
        elif word == "f":
            corners = [tuple(map(int, c.split("/"))) for c in rest]
            assert all(a == b == c for a, b, c in corners)
            faces.append([c[0] - 1 for c in corners])
        elif word == "o":
            objects.append((rest[0], len(faces)))
        else:
            assert word.startswith("#"), line
    return Obj(*(np.array(rows[k]) for k in ("v", "vn", "vt")), np.array(faces), objects)


@pytest.fixture(scope="module")
def winding() -> Road:
    road = iso8608_road("E", 130, width=4, v_step=0.4, step=0.2, seed=2, x=30, y=-10, heading=2.0)
    return curved_road(road, 0.03 * np.sin(road.u[1:] / 9))


def _facing_up(corners: Floats, up: int) -> bool:
    return bool((np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, up] > 0).all())


def test_stl_lies_on_the_road(winding: Road, tmp_path: Path) -> None:
    count = write_mesh(winding, tmp_path / "road.stl")
    stl = read_stl(tmp_path / "road.stl")
    nu, nv = winding.z.shape
    assert len(stl.corners) == count == 2 * (nu - 1) * (nv - 1)
    points = stl.corners.reshape(-1, 3)
    # Single precision of STL: 4e-6 m at 50 m, times the road's slope for the height.
    np.testing.assert_allclose(winding.heights(points[:, 0], points[:, 1]), points[:, 2], atol=2e-5)
    assert _facing_up(stl.corners, 2)
    expected = np.cross(stl.corners[:, 1] - stl.corners[:, 0], stl.corners[:, 2] - stl.corners[:, 0])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(stl.normals, expected, atol=2e-4)
    # Seen from above the triangles fill the road and do not overlap.
    a, b = stl.corners[:, 1, :2] - stl.corners[:, 0, :2], stl.corners[:, 2, :2] - stl.corners[:, 0, :2]
    area = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    edge = [np.column_stack(winding.uv_to_xy(winding.u, np.full(nu, v))) for v in winding.v[[0, -1]]]
    x, y = np.vstack([edge[0], edge[1][::-1]]).T
    assert area == pytest.approx(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)), rel=1e-5)


def test_obj_lies_on_the_road_with_true_normals(winding: Road, tmp_path: Path) -> None:
    count = write_mesh(winding, tmp_path / "road.obj")
    obj = read_obj(tmp_path / "road.obj")
    assert len(obj.faces) == count
    assert len(obj.vertices) == len(obj.normals) == len(obj.places)
    x, y, z = obj.vertices.T
    np.testing.assert_allclose(winding.heights(x, y), z, atol=3e-5)
    np.testing.assert_allclose(winding.uv_to_xy(*obj.places.T), (x, y), atol=2e-4)
    assert _facing_up(obj.vertices[obj.faces], 2)
    np.testing.assert_allclose(np.linalg.norm(obj.normals, axis=1), 1, atol=2e-5)
    # Inside the road the normal is that of the surface, up to the unevenness within a cell.
    smooth = curved_road(
        grid_road(0.1 * np.sin(0.2 * np.arange(200))[:, None] * np.ones(9), 0.1, np.arange(9.0)), 0.02
    )
    mesh = road_mesh(smooth)
    step = 1e-4
    px, py = mesh.points[5:-5, 2:-2, 0], mesh.points[5:-5, 2:-2, 1]
    along = [
        (smooth.heights(px + dx, py + dy) - smooth.heights(px - dx, py - dy)) / (2 * step)
        for dx, dy in ((step, 0), (0, step))
    ]
    slope = np.stack([-along[0], -along[1], np.ones_like(px)], axis=-1)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    assert np.abs(mesh.normals[5:-5, 2:-2] - slope).max() < 0.02


@pytest.mark.long
def test_tiles_are_small_whole_and_share_their_borders(tmp_path: Path) -> None:
    road = iso8608_road("C", 170, width=6, v_step=0.02, step=0.1, seed=1)  # 1701 by 301 points
    mesh = road_mesh(road)
    tiles = list(mesh.tiles(max_vertices=20_000, length=50.0))
    assert sum(len(t.faces) for t in tiles) == 2 * 1700 * 300
    assert max(len(t.vertices) for t in tiles) <= 20_000
    assert max(np.ptp(t.uv[:, 0]) for t in tiles) <= 50.0 + 1e-9
    assert len({t.name for t in tiles}) == len(tiles)
    # Each place has one height and one normal, in how many tiles it may lie; inner borders lie in two or more.
    everything = np.round(np.vstack([np.hstack([t.uv, t.vertices, t.normals]) for t in tiles]), 9)
    assert len(np.unique(everything, axis=0)) == len(np.unique(everything[:, :2], axis=0)) == road.z.size
    # Along an inner border both sides have the same edges: no T-joints, no gaps.
    first, second = tiles[0], tiles[1]
    border = set(map(tuple, np.round(first.uv, 6))) & set(map(tuple, np.round(second.uv, 6)))
    assert len(border) > 10

    def edges(tile: object) -> Counter[tuple[tuple[float, ...], ...]]:
        uv = [tuple(p) for p in np.round(tile.uv, 6).tolist()]  # type: ignore[attr-defined]
        pairs = [(uv[f[i]], uv[f[(i + 1) % 3]]) for f in tile.faces for i in range(3)]  # type: ignore[attr-defined]
        return Counter(tuple(sorted(p)) for p in pairs if p[0] in border and p[1] in border)

    assert set(edges(first)) == set(edges(second))
    assert len(edges(first)) == len(border) - 1


def test_obj_tiles_number_only_their_own_vertices(tmp_path: Path) -> None:
    road = iso8608_road("C", 160, width=2, v_step=0.5, step=0.2, seed=1)
    write_mesh(road, tmp_path / "a.obj")
    obj = read_obj(tmp_path / "a.obj")
    assert [name for name, _ in obj.objects] == [f"road_{i:03d}_00" for i in range(4)]
    starts = [first for _, first in obj.objects] + [len(obj.faces)]
    blocks = [set(obj.faces[a:b].ravel()) for a, b in zip(starts[:-1], starts[1:], strict=True)]
    assert sum(len(b) for b in blocks) == len(obj.vertices)
    assert set().union(*blocks) == set(range(len(obj.vertices)))


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("drive", ["bump_15kmh", "crg_road"])
def test_the_road_of_a_drive_is_whole_where_an_engine_reads_it(
    drive: str, up: str, repository: Path, tmp_path: Path
) -> None:
    """The file of the command read back into the axes of Unity or Unreal, which mirror one when they import it: under
    every wheel of the drive lies the height that the twin drives on, and no two tiles gape."""
    bag, path = repository / "bags" / drive, tmp_path / "road.obj"
    command = ["road", "mesh", str(bag / "road.crg"), "--up", up, "--spacing", "0.25", "--out", str(path)]
    assert main(command) == 0
    road, obj = load_road(bag / "road.crg"), read_obj(path)
    mirrored, convert = {"y": ([-1, 1, 1], to_unity), "z": ([1, -1, 1], to_unreal)}[up]
    x, y = road.uv_to_xy(*obj.places.T)
    level = (0.0, 0.0, 0.0, 1.0)
    wanted = [convert(p, level)[0] for p in np.column_stack([x, y, road.heights(x, y)]).tolist()]
    np.testing.assert_allclose(obj.vertices * mirrored, wanted, atol=2e-4)
    # Of the edges, by the places of their ends, inner ones belong to two triangles and outer ones to one.
    place = np.unique(np.round(obj.places, 3), axis=0, return_inverse=True)[1].ravel()[obj.faces]
    edges = np.sort(np.concatenate([place[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    nu, nv = road_mesh(road, spacing=0.25).points.shape[:2]
    assert set(count) == {1, 2} and (count == 1).sum() == 2 * (nu + nv - 2)
    assert len(obj.objects) >= (road.u[-1] - road.u[0]) // 50.0


def test_up_y_turns_the_road_and_does_not_mirror_it(winding: Road) -> None:
    z_up, y_up = road_mesh(winding), road_mesh(winding, up="y")
    north_up_east = np.stack([z_up.points[..., 1], z_up.points[..., 2], z_up.points[..., 0]], axis=-1)
    np.testing.assert_array_equal(y_up.points, north_up_east)
    faces = y_up.faces(slice(None), slice(None))
    assert _facing_up(y_up.points.reshape(-1, 3)[faces], 1)
    assert (y_up.normals[..., 1] > 0.5).all()


def test_missing_heights_are_left_out(tmp_path: Path) -> None:
    z = np.zeros((60, 8))
    z[20:40, 5:], z[50, 3] = np.nan, np.nan
    road = grid_road(z, 0.1, np.arange(8.0))
    # A cell with one corner missing keeps the triangle of the other three.
    for suffix in ("stl", "obj"):
        count = write_mesh(road, tmp_path / f"a.{suffix}")
        assert 2 * 59 * 7 - 2 * 21 * 3 - 6 <= count < 2 * 59 * 7 - 2 * 19 * 2
    corners = read_stl(tmp_path / "a.stl").corners
    assert np.isfinite(corners).all()
    obj = read_obj(tmp_path / "a.obj")
    assert np.isfinite(obj.vertices).all()
    assert np.isfinite(obj.normals).all()
    assert not ((obj.places[:, 0] > 2.05) & (obj.places[:, 0] < 3.85) & (obj.places[:, 1] > 4.5)).any()


def test_spacing_leaves_points_out_and_keeps_the_border(winding: Road) -> None:
    mesh = road_mesh(winding, spacing=1.0)
    assert (np.diff(mesh.u)[:-1] >= 1 - 1e-9).all()
    assert (mesh.u[0], mesh.u[-1]) == (winding.u[0], winding.u[-1])
    assert (mesh.v[0], mesh.v[-1]) == (winding.v[0], winding.v[-1])
    assert mesh.points.shape[:2] == (mesh.u.size, mesh.v.size)


def test_far_off_roads_are_shifted_on_request(tmp_path: Path) -> None:
    road = iso8608_road("C", 20, x=4_000_000.0, y=5_000_000.0)
    write_mesh(road, tmp_path / "far.stl")
    write_mesh(road, tmp_path / "near.stl", shift=(4_000_000.0, 5_000_000.0, 0.0))
    far, near = read_stl(tmp_path / "far.stl").corners, read_stl(tmp_path / "near.stl").corners
    assert len(np.unique(far[..., 0])) < 0.3 * len(np.unique(near[..., 0]))
    points = near.reshape(-1, 3) + np.array([4_000_000.0, 5_000_000.0, 0.0])
    np.testing.assert_allclose(road.heights(points[:, 0], points[:, 1]), points[:, 2], atol=1e-5)


def test_every_road_at_hand_becomes_a_mesh(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "ASAM_OpenCRG/crg-txt/handmade_curved_banked_sloped.crg"
    road = load_road(path)
    write_mesh(road, tmp_path / "a.obj")
    x, y, z = read_obj(tmp_path / "a.obj").vertices.T
    np.testing.assert_allclose(road.heights(x, y), z, atol=2e-5)


def test_what_cannot_be_written_is_said(
    winding: Road, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=r"\.stl or \.obj"):
        write_mesh(winding, tmp_path / "a.fbx")
    with pytest.raises(InputError, match="up"):
        road_mesh(winding, up="x")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="spacing"):
        road_mesh(winding, spacing=-1.0)
    with pytest.raises(InputError, match="tiles"):
        next(road_mesh(winding).tiles(max_vertices=3))

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "kept.stl").write_bytes(b"old")
    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(WorkError, match="No space left"):
        write_mesh(flat_road(10, 10), tmp_path / "kept.stl")
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["kept.stl"]
    assert (tmp_path / "kept.stl").read_bytes() == b"old"
