# SPDX-License-Identifier: Apache-2.0
"""Point clouds: their files, read piece by piece, and their georeference.

LAS and LAZ, PLY, and text with x, y, z in its first columns are read. Axes, unit and a coordinate reference system with
the twin's datum take a cloud's own coordinates to ``map``.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError, shown
from suspension_twin.files import open_file, open_text, reading
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road.profile import UNITS
from suspension_twin.vehicle.twin import Datum

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

__all__ = ["SCAN_UNITS", "Cloud", "Georeference", "georeference_of", "open_cloud", "parse_axes"]

#: m for one of a unit in which clouds come; the US survey foot is 1200/3937 m (NIST SP 811).
SCAN_UNITS: dict[str, float] = {**{k: UNITS[k] for k in ("m", "cm", "mm", "ft")}, "us-ft": 1200.0 / 3937.0}
#: Points in a piece: 24 MB of coordinates.
_PIECE = 1_000_000
#: Bytes of a line of a header (tolerance, by hand).
_LINE = 4096
#: Added to the format of a point where points are compressed.
_COMPRESSED = 128
#: ASPRS classes of points that are no surface: noise low and high (LAS 1.4, table 17).
_NOISE = (7, 18)


@dataclass(frozen=True, eq=False)
class Cloud:
    """A file of points.

    Parameters
    ----------
    path : Path
        The file.
    count : int or None
        Points in it, where its header gives them.
    crs : pyproj.CRS or None
        Its coordinate reference system, where the file names one.
    pieces : callable
        Gives the points in order as arrays (n, 3), in the file's own unit and axes, all finite.
    """

    path: Path
    count: int | None
    crs: CRS | None
    pieces: Callable[[], Iterator[Floats]]


def open_cloud(path: Path) -> Cloud:
    """Open a point cloud: LAS and PLY by their first bytes, anything else as text.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    Cloud
        Nothing of its points is read yet.

    Raises
    ------
    InputError
        The file cannot be read as a point cloud, or a package that reads it is missing.

    Examples
    --------
    >>> import tempfile
    >>> from suspension_twin.files import write_text
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_text(Path(folder) / "a.xyz", "0 0 1.5\\n1 0 1.5\\n")
    ...     next(open_cloud(Path(folder) / "a.xyz").pieces()).shape
    (2, 3)
    """
    with reading(path, "a point cloud"), open_file(path) as file:
        head = file.read(4)
    if not head:
        raise InputError(path, "is empty")
    kind = _las if head == b"LASF" else _ply if head[:3] == b"ply" else _text
    with reading(path, "a point cloud"):
        cloud = kind(path)

    def pieces() -> Iterator[Floats]:
        with reading(path, "a point cloud"):
            for points in cloud.pieces():
                good = np.isfinite(points).all(axis=1)
                yield points if good.all() else points[good]

    return Cloud(path, cloud.count, cloud.crs, pieces)


def _optional(path: Path | str, module: str, packages: str) -> Any:
    """A module of the extra ``scan``."""
    try:
        return import_module(module)
    except ImportError:
        raise InputError(path, f'needs {packages}: pip install "suspension-twin[scan]"') from None


def _check_header(path: Path) -> None:
    """Refuse a LAS header that promises more records than its file holds, which would be read for hours.

    Places of the numbers: ASPRS LAS 1.4 R15, table 3. Compressed points may unpack to as much as any file may.
    """
    size = path.stat().st_size
    with open_file(path) as file:
        head = file.read(375)
    if len(head) < 227:
        raise InputError(path, "is cut off in its header")
    header, begin, records = struct.unpack_from("<HII", head, 94)
    kind, length, count = struct.unpack_from("<BHI", head, 104)
    extended = extended_begin = 0
    if head[25] >= 4 and len(head) == 375:
        extended_begin, extended, count = struct.unpack_from("<QIQ", head, 235)
    room = {
        "records": (54 * records, begin - header),
        "extended records": (60 * extended, size - extended_begin),
        "points": (count * length if kind < _COMPRESSED else 0, size - begin),
    }
    for name, (needed, held) in room.items():
        if needed > held:
            raise InputError(path, f"is cut off or damaged: its header promises more {name} than it holds")
    if kind < _COMPRESSED:
        return
    Budget(path, size).take(count * length)
    # LAZ: at the start of its points the place of the table of chunks, or -1 and the place at the end of the file.
    with open_file(path) as file:
        place = begin
        for _ in range(2):
            file.seek(place)
            (place,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
            if place != -1:
                break
            place = size - 8
        file.seek(min(max(place, 0), size))
        _, chunks = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    if not begin < place < size or chunks > count:
        raise InputError(
            path, "is cut off or damaged: the table of its compressed points is not where it should be"
        )


def _las(path: Path) -> Cloud:
    laspy = _optional(path, "laspy", "laspy and lazrs")
    _check_header(path)
    with laspy.open(open_file(path)) as reader:
        header = reader.header
        if header.are_points_compressed and not laspy.LazBackend.detect_available():
            _optional(path, "lazrs", "lazrs")
        try:
            crs = header.parse_crs()
        except ImportError:
            _optional(path, "pyproj", "pyproj")
            raise
        except Exception:  # a record that PROJ does not understand: --crs says it
            crs = None
        count = int(header.point_count)

    def pieces() -> Iterator[Floats]:
        with laspy.open(open_file(path)) as reader:
            for chunk in reader.chunk_iterator(_PIECE):
                points = np.column_stack([np.asarray(chunk[axis]) for axis in ("x", "y", "z")])
                yield points[~np.isin(np.asarray(chunk.classification), _NOISE)]

    return Cloud(path, count, crs, pieces)


#: Bytes of the types of a PLY file.
_SIZES: Final = {
    **dict.fromkeys((b"char", b"uchar", b"int8", b"uint8"), 1),
    **dict.fromkeys((b"short", b"ushort", b"int16", b"uint16"), 2),
    **dict.fromkeys((b"int", b"uint", b"int32", b"uint32", b"float", b"float32"), 4),
    **dict.fromkeys((b"double", b"float64"), 8),
}


def _check_declared(path: Path, file: BinaryIO) -> None:
    """Raise InputError where the header of a PLY file declares more elements than can stand below it: the library makes
    room for them first."""
    count = least = 0
    ascii_ = False
    for line in iter(lambda: file.readline(_LINE).split(), [b"end_header"]):
        if line[:1] == [b"format"]:
            ascii_ = line[1:2] == [b"ascii"]
        elif line[:1] == [b"element"]:
            count = max(int(line[2]), 0)
        elif line[:1] == [b"property"]:
            least += count * (2 if ascii_ else _SIZES[line[2] if line[1] == b"list" else line[1]])
        elif not line and not file.peek(1):  # type: ignore[attr-defined]
            break
    there = os.fstat(file.fileno()).st_size - file.tell()
    if least > there + 1:
        raise InputError(path, f"is cut off: {there} bytes are there of {least} or more")
    file.seek(0)


def _ply(path: Path) -> Cloud:
    with open_file(path) as file:
        _check_declared(path, file)
        data = _optional(path, "plyfile", "plyfile").PlyData.read(file, mmap="c")
    if "vertex" not in data:
        raise InputError(path, "has no element 'vertex'")
    vertex = data["vertex"]
    names = {p.name for p in vertex.properties}
    if not {"x", "y", "z"} <= names:
        raise InputError(path, "vertex", "needs the properties x, y and z")
    count = len(vertex.data)

    def pieces() -> Iterator[Floats]:
        for start in range(0, count, _PIECE):
            rows = vertex.data[start : start + _PIECE]
            yield np.column_stack([np.asarray(rows[axis], dtype=np.float64) for axis in "xyz"])

    return Cloud(path, count, None, pieces)


def _text(path: Path) -> Cloud:
    """Columns x, y, z first, or as a heading names them; a line with the number of points alone is skipped."""
    columns = 0, 1, 2
    with open_text(path) as file:
        for skip, line in enumerate(file):
            text = line.strip()
            comment = not text or text.startswith(("#", "//"))
            mark = ";" if ";" in text else "," if "," in text else None
            words = [w.strip().lower() for w in text.split(mark)]
            if comment:
                words = re.split(r"[,;\s]+", text.lstrip("#/ ").lower())
            named = _named(words)
            if named or comment or (len(words) == 1 and words[0].isdigit()):
                columns = named or columns
                continue
            try:
                [float(words[c]) for c in columns]
            except (ValueError, IndexError):
                raise InputError(
                    path, f"line {skip + 1}", f"no point cloud: {text[:40]!r} is not x, y, z"
                ) from None
            break
        else:
            raise InputError(path, "holds no points")

    def pieces() -> Iterator[Floats]:
        with open_text(path) as file:
            lines, row = islice(file, skip, None), skip
            while True:
                try:
                    points = np.loadtxt(
                        lines, delimiter=mark, usecols=columns, max_rows=_PIECE, comments=("#", "//"), ndmin=2
                    )
                except (ValueError, IndexError) as error:
                    words = str(error).partition(";")[0]
                    raise InputError(path, f"after line {row}", f"no point: {words}") from None
                if points.size:
                    row += points.shape[0]
                    yield points
                if points.shape[0] < _PIECE:
                    return

    return Cloud(path, None, None, pieces)


def _named(words: list[str]) -> tuple[int, int, int] | None:
    """Columns of x, y and z in a heading."""
    names = [re.sub(r"\W.*", "", w) for w in words]
    return (names.index("x"), names.index("y"), names.index("z")) if {"x", "y", "z"} <= set(names) else None


def parse_axes(text: str) -> tuple[tuple[int, float], ...]:
    """Column and sign of east, north and up, from ``xyz``, ``yxz`` or ``x-zy``; InputError for other texts."""
    parts = re.findall(r"(-?)([xyz])", text)
    if "".join(sign + axis for sign, axis in parts) != text or sorted(a for _, a in parts) != ["x", "y", "z"]:
        raise InputError("--axes", f"{shown(text)} are not x, y and z in an order, such as yxz or x-zy")
    return tuple(("xyz".index(axis), -1.0 if sign else 1.0) for sign, axis in parts)


@dataclass(frozen=True, eq=False)
class Georeference:
    """How a cloud lies in ``map``.

    Parameters
    ----------
    axes : tuple of (int, float)
        Columns and signs of x, y and z.
    unit, up : float
        m for one of the horizontal and of the vertical unit.
    crs : pyproj.CRS or None
        Taken to ``map`` by the datum; None where the coordinates are those of a plane.
    datum : Datum or None
        Origin of ``map``.
    turn : float
        rad about the vertical that take a plane to ``map``.
    move : tuple of float
        m east and north after the turn.
    """

    axes: tuple[tuple[int, float], ...] = ((0, 1.0), (1, 1.0), (2, 1.0))
    unit: float = 1.0
    up: float = 1.0
    crs: CRS | None = None
    datum: Datum | None = None
    turn: float = 0.0
    move: tuple[float, float] = (0.0, 0.0)

    def to_map(self, points: Floats) -> Floats:
        """Positions (n, 3) in ``map``, m, of points (n, 3) in the cloud's coordinates."""
        p = np.column_stack([sign * points[:, column] for column, sign in self.axes])
        p[:, 2] *= self.up
        if self.crs is None:
            p[:, :2] *= self.unit
            if self.turn or any(self.move):
                p[:, :2] = p[:, :2] @ self._rotation.T + self.move
            return p
        assert self.datum is not None
        longitude, latitude = self._to_geodetic.transform(p[:, 0], p[:, 1])
        return LocalMap(self.datum).to_map(latitude, longitude, p[:, 2])

    def box(self, x: Floats, y: Floats, margin: float) -> tuple[Floats, Floats] | None:
        """Lowest and highest (2,) cloud coordinates, axes turned, that hold map positions and ``margin`` m around."""
        if self.crs is None:
            own = (np.column_stack([x, y]) - self.move) @ self._rotation
            return (own.min(axis=0) - margin) / self.unit, (own.max(axis=0) + margin) / self.unit
        assert self.datum is not None
        e, n = np.meshgrid([x.min() - margin, x.max() + margin], [y.min() - margin, y.max() + margin])
        geodetic = LocalMap(self.datum).to_geodetic(np.column_stack([e.ravel(), n.ravel(), np.zeros(4)]))
        a, b = self._to_geodetic.transform(geodetic[:, 1], geodetic[:, 0], direction="INVERSE")
        corners = np.column_stack([a, b])
        if not np.isfinite(corners).all():
            return None
        slack = 0.05 * np.ptp(corners, axis=0)  # what a grid's lines bend within the box
        return corners.min(axis=0) - slack, corners.max(axis=0) + slack

    def within(self, points: Floats, box: tuple[Floats, Floats] | None) -> Floats:
        """The points (n, 3) whose horizontal coordinates lie in a box."""
        if box is None:
            return points
        c = np.column_stack([sign * points[:, column] for column, sign in self.axes[:2]])
        return points[((c >= box[0]) & (c <= box[1])).all(axis=1)]

    @property
    def _rotation(self) -> Floats:
        c, s = math.cos(self.turn), math.sin(self.turn)
        return np.array([[c, -s], [s, c]])

    @property
    def _to_geodetic(self) -> Transformer:
        from pyproj import Transformer

        assert self.crs is not None
        return Transformer.from_crs(self.crs.to_2d(), "EPSG:4326", always_xy=True)


def georeference_of(
    path: Path, crs: CRS | None, named: str | None, axes: str, unit: str | None, datum: Datum | None
) -> tuple[Georeference, str]:
    """The georeference of a cloud, and a sentence about it.

    ``crs`` is of the file, ``named`` of the user. Without a datum the cloud's coordinates are ``map``.
    """
    order = parse_axes(axes)
    if unit is not None and unit not in SCAN_UNITS:
        raise InputError("--unit", f"{shown(unit)} is not one of {', '.join(SCAN_UNITS)}")
    if named is not None:
        pyproj = _optional("--crs", "pyproj", "pyproj")
        try:
            crs = pyproj.CRS.from_user_input(named)
        except pyproj.exceptions.CRSError:
            raise InputError(
                "--crs", f"{shown(named)} is no coordinate reference system that PROJ knows"
            ) from None
        if datum is None:
            raise InputError("--crs", "needs a datum: --datum, a twin file with one, or a drive as the path")
    scales = (SCAN_UNITS[unit],) * 2 if unit is not None else (1.0, 1.0) if crs is None else _units(crs)
    words = "the cloud's own coordinates are map"
    if crs is None:
        return Georeference(order, *scales), words
    if datum is not None:
        return Georeference(order, 1.0, scales[1], crs, datum), f"{crs.name} to map by the datum"
    if crs.is_geographic:
        raise InputError(path, f"is in {crs.name}: give a datum with --datum or a twin file")
    return Georeference(order, *scales), f"{words} ({crs.name}, without a datum)"


def _units(crs: CRS) -> tuple[float, float]:
    """m for one of the horizontal and of the vertical unit of a CRS; a height without a unit has the horizontal one."""
    factors = [(a.direction, float(a.unit_conversion_factor), a.unit_name) for a in crs.axis_info]
    flat = [f for direction, f, name in factors if direction not in ("up", "down") and "degree" not in name]
    high = [f for direction, f, _ in factors if direction in ("up", "down")]
    horizontal = flat[0] if flat else 1.0
    return horizontal, high[0] if high else horizontal
