# SPDX-License-Identifier: Apache-2.0
"""Point clouds in files, read piece by piece: LAS and LAZ, PLY, and text with x, y, z in its first columns."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError
from suspension_twin.files import reading

__all__ = ["Cloud", "open_cloud"]

#: Points in a piece: 24 MB of coordinates.
_PIECE = 1_000_000
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
        Points in it, where its header says so.
    crs : pyproj.CRS or None
        Its coordinate reference system, where the file names one.
    pieces : callable
        Gives the points in order as arrays (n, 3), in the file's own unit and axes, all finite.
    """

    path: Path
    count: int | None
    crs: Any
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
    with reading(path, "a point cloud"), path.open("rb") as file:
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


def _missing(path: Path, package: str) -> InputError:
    return InputError(path, f'needs {package}: pip install "suspension-twin[scan]"')


def _check_header(path: Path) -> None:
    """Refuse a LAS header that promises more records than its file holds, which would be read for hours.

    Places of the numbers: ASPRS LAS 1.4 R15, table 3. What is compressed may unpack to what any file may.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if len(head) < 227:
        raise InputError(path, "is cut off in its header")
    header, begin, records = struct.unpack_from("<HII", head, 94)
    kind, length, count = struct.unpack_from("<BHI", head, 104)
    extended = extended_begin = 0
    if head[25] >= 4 and len(head) == 375:
        extended_begin, extended, count = struct.unpack_from("<QIQ", head, 235)
    for what, needed, held in (
        ("records", 54 * records, begin - header),
        ("extended records", 60 * extended, size - extended_begin),
        ("points", count * length if kind < _COMPRESSED else 0, size - begin),
    ):
        if needed > held:
            raise InputError(path, f"is cut off or damaged: its header promises more {what} than it holds")
    if kind < _COMPRESSED:
        return
    Budget(path, size).take(count * length)
    # LAZ: at the start of its points the place of the table of chunks, or -1 and the place at the end of the file.
    with path.open("rb") as file:
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
    try:
        import laspy
    except ImportError:
        raise _missing(path, "laspy and lazrs") from None
    _check_header(path)
    with laspy.open(path) as reader:
        header = reader.header
        if header.are_points_compressed and not laspy.LazBackend.detect_available():
            raise _missing(path, "lazrs")
        try:
            crs = header.parse_crs()
        except ImportError:
            raise _missing(path, "pyproj") from None
        except Exception:  # a record that PROJ does not understand: --crs says it
            crs = None
        count = int(header.point_count)

    def pieces() -> Iterator[Floats]:
        with laspy.open(path) as reader:
            for chunk in reader.chunk_iterator(_PIECE):
                points = np.column_stack([np.asarray(chunk[axis]) for axis in ("x", "y", "z")])
                yield points[~np.isin(np.asarray(chunk.classification), _NOISE)]

    return Cloud(path, count, crs, pieces)


def _ply(path: Path) -> Cloud:
    try:
        from plyfile import PlyData
    except ImportError:
        raise _missing(path, "plyfile") from None
    data = PlyData.read(str(path), mmap="c")
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
    skip, columns, mark, found = 0, (0, 1, 2), None, False
    with path.open(encoding="utf-8-sig") as file:
        for line in file:
            skip += 1
            text = line.strip()
            if not text or text.startswith(("#", "//")):
                words = re.split(r"[,;\s]+", text.lstrip("#/ ").lower())
                columns = _named(words) or columns
                continue
            mark = ";" if ";" in text else "," if "," in text else None
            words = [w.strip().lower() for w in (text.split(mark) if mark else text.split())]
            if len(words) == 1 and words[0].isdigit():
                continue
            try:
                [float(words[c]) for c in columns]
            except (ValueError, IndexError):
                named = _named(words)
                if named is None:
                    raise InputError(
                        path, f"line {skip}", f"no point cloud: {text[:40]!r} is not x, y, z"
                    ) from None
                columns = named
                continue
            found, skip = True, skip - 1
            break
    if not found:
        raise InputError(path, "holds no points")

    def pieces() -> Iterator[Floats]:
        with path.open(encoding="utf-8-sig") as file:
            for _ in range(skip):
                next(file)
            row = skip
            while True:
                try:
                    points = np.loadtxt(
                        file, delimiter=mark, usecols=columns, max_rows=_PIECE, comments=("#", "//"), ndmin=2
                    )
                except (ValueError, IndexError) as error:
                    words = str(error).partition(";")[0]
                    raise InputError(path, f"after line {row}", f"no point: {words}") from None
                if not points.size:
                    return
                row += points.shape[0]
                yield points
                if points.shape[0] < _PIECE:
                    return

    return Cloud(path, None, None, pieces)


def _named(words: list[str]) -> tuple[int, int, int] | None:
    """Columns of x, y and z in a heading."""
    names = [re.sub(r"\W.*", "", w) for w in words]
    if {"x", "y", "z"} <= set(names):
        return names.index("x"), names.index("y"), names.index("z")
    return None
