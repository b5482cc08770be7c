# SPDX-License-Identifier: Apache-2.0
"""A road as triangles for game engines: binary STL, and OBJ with normals and tiles.

The car paper (section 5.3) took a road to Unity through four programs (the OpenCRG tools, a
surface-to-STL script, a CAD program, an OBJ import); this is one step from the road itself.

Axes. ``up="z"``: those of ``map``, x east, y north, z up. ``up="y"``: x north, y up, z east, which
is right-handed as OBJ has it; Unity mirrors x when it reads a mesh, so that there x is south, y up
and z east, as :func:`suspension_twin.addons.view.axes.to_unity` has a pose on this road. Triangles
are counter-clockwise seen from above in either.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import replacing
from suspension_twin.road.road import Road

__all__ = ["MeshTile", "RoadMesh", "road_mesh", "write_mesh", "write_obj", "write_stl"]

Up = Literal["z", "y"]

#: Vertices of a tile: within a 16-bit index, as most engines want it.
TILE_VERTICES = 65_000
#: Length of a tile along the road, m: small enough to be left out when it is out of sight.
TILE_LENGTH = 50.0


@dataclass(frozen=True, eq=False)
class MeshTile:
    """A piece of the mesh: ``vertices`` and unit ``normals`` (n, 3), ``uv`` (n, 2) m, ``faces`` (m, 3).

    ``faces`` number the tile's own vertices from 0. Tiles side by side hold the vertices of their
    common border both, with the same place and normal, so that no seam shows.
    """

    name: str
    vertices: Floats
    normals: Floats
    uv: Floats
    faces: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RoadMesh:
    """A road's nodes as a mesh: ``points`` and ``normals`` (nu, nv, 3), NaN where there are no data;
    ``u`` (nu,), ``v`` (nv,) m. ``shift`` (3,) m was taken off the places in ``map``."""

    name: str
    points: Floats
    normals: Floats
    u: Floats
    v: Floats
    shift: tuple[float, float, float]

    def faces(self, rows: slice, columns: slice) -> NDArray[np.int64]:
        """Triangles (m, 3) of a block of nodes, numbered row by row; those without data left out."""
        shape = self.points[rows, columns].shape[:2]
        index = np.arange(shape[0] * shape[1], dtype=np.int64).reshape(shape)
        here, ahead = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
        left, across = index[:-1, 1:].ravel(), index[1:, 1:].ravel()
        triangles = np.stack([here, ahead, across, here, across, left], axis=1).reshape(-1, 3)
        known = np.isfinite(self.points[rows, columns, 2]).ravel()
        return np.asarray(triangles[known[triangles].all(axis=1)])

    def tiles(self, max_vertices: int = TILE_VERTICES, length: float = TILE_LENGTH) -> Iterator[MeshTile]:
        """The mesh in tiles of at most ``max_vertices`` vertices and about ``length`` m; empty ones left out."""
        if max_vertices < 4 or not length > 0.0:
            raise InputError("mesh", "tiles", "need 4 vertices or more and a length above 0 m")
        nu, nv = self.points.shape[:2]
        across = min(nv - 1, max(1, math.isqrt(max_vertices) - 1))
        step = float(self.u[1] - self.u[0])
        along = max(1, min(max_vertices // (across + 1) - 1, round(length / step)))
        for i in range(0, nu - 1, along):
            for j in range(0, nv - 1, across):
                rows, columns = slice(i, min(i + along, nu - 1) + 1), slice(j, min(j + across, nv - 1) + 1)
                faces = self.faces(rows, columns)
                if not faces.size:
                    continue
                used, inverse = np.unique(faces, return_inverse=True)
                u, v = np.meshgrid(self.u[rows], self.v[columns], indexing="ij")
                yield MeshTile(
                    name=f"road_{i // along:03d}_{j // across:02d}",
                    vertices=self.points[rows, columns].reshape(-1, 3)[used],
                    normals=self.normals[rows, columns].reshape(-1, 3)[used],
                    uv=np.column_stack([u.ravel(), v.ravel()])[used],
                    faces=inverse.reshape(-1, 3).astype(np.int64),
                )


def road_mesh(
    road: Road,
    *,
    spacing: float = 0.0,
    up: Up = "z",
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> RoadMesh:
    """The road's surface as a mesh over its nodes.

    ``spacing`` m leaves out nodes that are closer (0: every node; first and last stay); ``shift`` m
    is taken off every place, as STL keeps only seven digits. Raises InputError.
    """
    if up not in ("z", "y"):
        raise InputError("mesh", "up", f"must be z or y, is {up!r}")
    if not spacing >= 0.0:
        raise InputError("mesh", "spacing", f"must be 0 m or more, is {spacing}")
    rows, columns = _thinned(road.u, spacing), _thinned(road.v, spacing)
    u, v = road.u[rows], road.v[columns]
    x, y = road.uv_to_xy(u[:, None], v[None, :])
    z = road.heights_grid[np.ix_(rows, columns)]
    points = np.stack([x - shift[0], y - shift[1], z - shift[2]], axis=-1)
    normals = _normals(points)
    if up == "y":
        points, normals = (np.roll(c, -1, axis=-1) for c in (points, normals))
    return RoadMesh(road.name, points, normals, u, v, shift)


def write_mesh(
    road: Road,
    path: str | os.PathLike[str],
    *,
    spacing: float = 0.0,
    up: Up = "z",
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> int:
    """Write the surface of a road as a mesh.

    Parameters
    ----------
    road : Road
        The road.
    path : str or path-like
        A ``.stl`` or ``.obj`` file.
    spacing : float
        m; nodes that are closer are left out (0: none).
    up : {"z", "y"}
        Axis that points up; "y" gives Unity's axes.
    shift : tuple of float
        m taken off every position, since STL keeps only seven digits.

    Returns
    -------
    int
        Number of triangles.

    Raises
    ------
    InputError
        For a path of another kind or a spacing that leaves nothing.

    Examples
    --------
    >>> import tempfile
    >>> from suspension_twin.road import bump_road, half_sine
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_mesh(bump_road(half_sine(0.9, 0.05), width=2.0), f"{folder}/road.obj", spacing=1.0) > 50
    True
    """
    suffix = os.path.splitext(os.fspath(path))[1].lower()
    if suffix not in (".stl", ".obj"):
        raise InputError(path, "a mesh is written as .stl or .obj; name the file so")
    mesh = road_mesh(road, spacing=spacing, up=up, shift=shift)
    return (write_stl if suffix == ".stl" else write_obj)(mesh, path)


def write_stl(mesh: RoadMesh, path: str | os.PathLike[str]) -> int:
    """Write a mesh as one binary STL, facet normals included; returns the number of triangles.

    Raises WorkError if the file cannot be written.
    """
    nu, nv = mesh.points.shape[:2]
    corners = mesh.points.reshape(-1, 3)[mesh.faces(slice(0, nu), slice(0, nv))]
    facets = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    facets["corners"] = corners
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    # Readers take a file that begins with "solid" for text.
    header = f"binary STL of {mesh.name}, shift {mesh.shift}".encode("ascii", "replace")[:80].ljust(80)
    with replacing(path) as temporary, temporary.open("wb") as out:
        out.write(header)
        out.write(np.uint32(len(facets)).astype("<u4").tobytes())
        out.write(facets.tobytes())
    return len(facets)


def write_obj(mesh: RoadMesh, path: str | os.PathLike[str]) -> int:
    """Write a mesh as OBJ, one object a tile, with normals and texture places in m; returns its triangles.

    Raises WorkError if the file cannot be written.
    """
    count, base = 0, 1
    with replacing(path) as temporary, temporary.open("w", encoding="ascii", errors="replace") as out:
        out.write(f"# {' '.join(mesh.name.split())}, written by suspension_twin\n")
        out.write("# metres; vt: along and across the road, m\n")
        out.write("# shift taken off the places in map: {} {} {}\n".format(*mesh.shift))
        for tile in mesh.tiles():
            out.write(f"o {tile.name}\n")
            _lines(out.write, "v %.5f %.5f %.5f\n", tile.vertices)
            _lines(out.write, "vt %.4f %.4f\n", tile.uv)
            _lines(out.write, "vn %.5f %.5f %.5f\n", tile.normals)
            _lines(out.write, "f %d/%d/%d %d/%d/%d %d/%d/%d\n", np.repeat(tile.faces + base, 3, axis=1))
            base += len(tile.vertices)
            count += len(tile.faces)
    return count


def _lines(write: Callable[[str], object], form: str, table: NDArray[np.float64] | NDArray[np.int64]) -> None:
    """One line a row; a whole table at once is twenty times as fast as row by row."""
    write(form * len(table) % tuple(table.ravel().tolist()))


def _thinned(at: Floats, spacing: float) -> NDArray[np.intp]:
    """Indices of places at least ``spacing`` apart, the first and the last among them."""
    kept = [0]
    for i in range(1, at.size - 1):
        if at[i] - at[kept[-1]] >= spacing * (1.0 - 1e-9):
            kept.append(i)
    return np.array([*kept, at.size - 1], dtype=np.intp)


def _normals(points: Floats) -> Floats:
    """Unit normals (nu, nv, 3) at the nodes: the faces around each, weighted by their area."""
    here, ahead, left, across = points[:-1, :-1], points[1:, :-1], points[:-1, 1:], points[1:, 1:]
    right_face = np.cross(ahead - here, across - here)
    left_face = np.cross(across - here, left - here)
    total = np.zeros_like(points)
    for face, corners in ((right_face, ((0, 0), (1, 0), (1, 1))), (left_face, ((0, 0), (1, 1), (0, 1)))):
        face = np.where(np.isfinite(face), face, 0.0)
        for i, j in corners:
            total[i : total.shape[0] - 1 + i, j : total.shape[1] - 1 + j] += face
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    upward = np.array([0.0, 0.0, 1.0])
    return np.where(length > 0.0, total / np.where(length > 0.0, length, 1.0), upward)
