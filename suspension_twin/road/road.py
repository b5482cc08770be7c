# SPDX-License-Identifier: Apache-2.0
"""A road surface in memory and its evaluation under any number of positions.

A road is a regular grid of heights along a reference line, as in ASAM OpenCRG: ``u`` runs
along the line, ``v`` across it (positive to the left), and the line lies in ``map``. The
height at a position is ``z(u, v) + ref_z(u) + bank(u) * v``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from suspension_twin.arrays import Floats
from suspension_twin.display import axes_or_new, bulleted
from suspension_twin.errors import InputError
from suspension_twin.road import kernels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "Border",
    "Borders",
    "Fade",
    "Outside",
    "ReferenceLine",
    "Road",
    "RoadHeights",
    "single_precision",
]

#: Height of a position off the road. ``road``: by the options of the road's file, ``hold``
#: by default; ``hold``: the height of the nearest point of the border, across
#: the road where data are missing; ``zero``: height 0; ``error``: an :class:`InputError`.
Outside = Literal["road", "hold", "zero", "error"]


_MODES: Final = {"hold": (2, 2), "zero": (1, 1), "error": (2, 2)}


@dataclass(frozen=True)
class Border:
    """Heights beyond a border by OpenCRG: ``mode`` 0 none, 1 zero, 2 keep the last height, 3 repeat, 4 reflect;
    ``offset`` m is added."""

    mode: int = 2
    offset: float = 0.0


@dataclass(frozen=True)
class Fade:
    """A smoothing zone of OpenCRG: over ``length`` m an end of the road fades to the height ``base`` m."""

    length: float
    base: float = 0.0


@dataclass(frozen=True)
class Borders:
    """OpenCRG's options of a road beyond its borders; the defaults are OpenCRG's.

    ``u``, ``v`` along and across; ``begin``, ``end`` the ends that fade; ``close`` whether the track closes, between
    the u of ``close_span`` m where it can.
    """

    u: Border = Border()
    v: Border = Border()
    begin: Fade | None = None
    end: Fade | None = None
    close: bool = False
    close_span: tuple[float, float] | None = None

    def moved(self, factor: float = 1.0, lift: float = 0.0) -> Borders:
        """The same for heights multiplied by ``factor`` and raised by ``lift`` m."""
        u, v = (replace(border, offset=border.offset * factor) for border in (self.u, self.v))
        begin, end = (
            None if fade is None else replace(fade, base=fade.base * factor + lift)
            for fade in (self.begin, self.end)
        )
        return replace(self, u=u, v=v, begin=begin, end=end)


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """The line that a road's heights lie along, in ``map``.

    Parameters
    ----------
    x, y : (nu,) array
        Its points at the cross sections in m.
    z : (nu,) array
        Its height in m.
    bank : (nu,) array
        Cross slope in m/m, positive with the left side high.
    step : float
        Distance of the cross sections in m.
    headings : tuple of float
        rad before the first and after the last cross section.
    u_first : float
        u of the first cross section in m.
    """

    x: Floats
    y: Floats
    z: Floats
    bank: Floats
    step: float
    headings: tuple[float, float]
    u_first: float = 0.0

    @classmethod
    def level(cls, x: Floats, y: Floats, step: float, headings: tuple[float, float]) -> ReferenceLine:
        """A line at height 0 without banking."""
        return cls(x, y, np.zeros(x.size), np.zeros(x.size), step, headings)


@dataclass(frozen=True, eq=False)
class RoadHeights:
    """Heights, and which of them rest on data; arrays of the positions' shape.

    ``z`` m, never a NaN; ``inside`` False where the road has no data.
    """

    z: Floats
    inside: NDArray[np.bool_]


def single_precision(z: ArrayLike) -> Floats:
    """Heights as an OpenCRG file can hold them."""
    return np.asarray(z, dtype=np.float64).astype(np.float32).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Road:
    """A road: heights on a grid along a reference line in ``map``. It is never changed: functions that alter a road
    return a new one.

    Parameters
    ----------
    name : str
        Name of the road.
    z : (nu, nv) array
        Heights in m at the nodes, NaN where there are no data.
    v : (nv,) array
        Lateral positions of the long sections in m, rising.
    reference : ReferenceLine
        The reference line, a point a cross section.
    borders : Borders
        OpenCRG's options beyond the borders.
    notes : tuple of str
        Warnings of the reader.

    Raises
    ------
    InputError
        The arrays do not fit each other or hold values that cannot be evaluated.

    Examples
    --------
    >>> from suspension_twin.road import bump_road, half_sine
    >>> road = bump_road(half_sine(0.9, 0.05), at=20.0)
    >>> round(float(road.heights(20.45, 0.0)), 3)
    0.05
    """

    name: str
    z: Floats
    v: Floats
    reference: ReferenceLine
    borders: Borders = field(default_factory=Borders)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        line = self.reference
        for name in ("z", "v"):
            object.__setattr__(self, name, _frozen(getattr(self, name)))
        x, y, z, bank = map(_frozen, (line.x, line.y, line.z, line.bank))
        line = ReferenceLine(x, y, z, bank, float(line.step), line.headings, float(line.u_first))
        object.__setattr__(self, "reference", line)
        nu, nv = self.z.shape if self.z.ndim == 2 else (0, 0)
        if nu < 2 or nv < 2:
            raise InputError(self.name, "z", f"needs at least 2 by 2 heights, has shape {self.z.shape}")
        along = {name: (getattr(self, name), nu) for name in ("x", "y", "ref_z", "bank")}
        for name, (array, size) in ({"v": (self.v, nv)} | along).items():
            if array.shape != (size,):
                raise InputError(self.name, name, f"needs {size} values to fit z, has shape {array.shape}")
            if not np.isfinite(array).all():
                raise InputError(self.name, name, "must be finite everywhere")
        if not (np.diff(self.v) > 0.0).all():
            raise InputError(self.name, "v", "must rise from one long section to the next")
        if not (np.isfinite(line.step) and line.step > 0.0 and np.isfinite(line.u_first)):
            raise InputError(self.name, "u_step", f"must be above 0 m, is {line.step}")
        if not (np.hypot(np.diff(self.x), np.diff(self.y)) > 0.0).all():
            raise InputError(self.name, "x, y", "the reference line stands still between two cross sections")
        if np.isinf(self.z).any():
            raise InputError(self.name, "z", "holds an infinite height")
        if np.isnan(self.z).all():
            raise InputError(self.name, "z", "holds no height at all")

    @property
    def x(self) -> Floats:
        """x of the reference line at the cross sections (nu,), m."""
        return self.reference.x

    @property
    def y(self) -> Floats:
        """y of the reference line at the cross sections (nu,), m."""
        return self.reference.y

    @property
    def ref_z(self) -> Floats:
        """Height of the reference line (nu,), m."""
        return self.reference.z

    @property
    def bank(self) -> Floats:
        """Cross slope (nu,), m/m."""
        return self.reference.bank

    @property
    def headings(self) -> tuple[float, float]:
        """Headings before the first and after the last cross section, rad."""
        return self.reference.headings

    @property
    def u_step(self) -> float:
        """Distance of the cross sections, m."""
        return self.reference.step

    @property
    def u_first(self) -> float:
        """u of the first cross section, m."""
        return self.reference.u_first

    def __str__(self) -> str:
        low, high = float(np.nanmin(self.heights_grid)), float(np.nanmax(self.heights_grid))
        steps = f"{self.u_step:g} m by {self.width / (self.v.size - 1):.3g} m"
        size = f"{self.length:.2f} m long, {self.width:.2f} m wide, grid {steps}"
        heights = f"heights {low:.3f} to {high:.3f} m, {np.isnan(self.z).mean():.1%} of the grid without data"
        return bulleted(f"Road {self.name}", [size, heights], self.notes)

    __repr__ = __str__

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the heights in m over the road coordinates u and v in m, as colours; returns the axes."""
        ax = axes_or_new(ax, "u, along the road [m]", "v, to the left [m]", self.name)
        drawn = ax.pcolormesh(self.u, self.v, self.heights_grid.T, shading="nearest", rasterized=True)
        ax.figure.colorbar(drawn, ax=ax, label="height [m]")
        return ax

    @cached_property
    def u(self) -> Floats:
        """u of the cross sections (nu,), m."""
        return self.u_first + self.u_step * np.arange(self.z.shape[0], dtype=np.float64)

    @property
    def u_last(self) -> float:
        """u of the last cross section, m."""
        return self.u_first + self.length

    @property
    def length(self) -> float:
        """Length of the reference line, m."""
        return self.u_step * (int(self.z.shape[0]) - 1)

    @property
    def width(self) -> float:
        """Distance of the outermost long sections, m."""
        return float(self.v[-1] - self.v[0])

    @property
    def heights_grid(self) -> Floats:
        """Heights (nu, nv) at the nodes, slope and banking included; NaN where there are no data."""
        return self.z + self.ref_z[:, None] + self.bank[:, None] * self.v

    @cached_property
    def straight(self) -> bool:
        """True where the reference line is one straight line with even steps."""
        s = np.arange(self.x.size) * self.u_step
        cos, sin = np.cos(self.headings[0]), np.sin(self.headings[0])
        off = max(
            float(np.abs(self.x[0] + s * cos - self.x).max()),
            float(np.abs(self.y[0] + s * sin - self.y).max()),
        )
        turn = np.hypot(np.cos(self.headings[1]) - cos, np.sin(self.headings[1]) - sin)
        return bool(off < 1e-9 and turn < 1e-12)

    @cached_property
    def line(self) -> kernels.Line:
        """The reference line as the compiled kernels take it."""
        ends = np.array([f(h) for h in self.headings for f in (np.cos, np.sin)], dtype=np.float64)
        u = (self.u_first, self.u_last, self.u_step)
        return self.x, self.y, ends, *u, self.straight, self.borders.close_span is not None

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(np.column_stack([self.x, self.y]))

    def nearest_point(self, x: Floats, y: Floats) -> NDArray[np.int64]:
        """Index (n,) of the reference point nearest to each map position (n,); 0 on a straight line."""
        if self.straight:
            return np.zeros(x.size, dtype=np.int64)
        found = self._tree.query(np.nan_to_num(np.column_stack([x, y]), posinf=0.0, neginf=0.0))[1]
        return np.asarray(found, dtype=np.int64)

    @cached_property
    def grid(self) -> kernels.Grid:
        """The heights as the compiled kernels take them."""
        missing = np.isnan(self.z)
        if missing.any():
            void = missing[:-1, :-1] | missing[1:, :-1] | missing[:-1, 1:] | missing[1:, 1:]
            z = _held(self.z)
            z.flags.writeable = False  # as the other, or numba compiles for both
        else:
            void, z = np.zeros((0, 0), dtype=np.bool_), self.z
        even = float(np.ptp(np.diff(self.v))) <= 1e-9 * self.width
        fades = [fade or Fade(-1.0) for fade in (self.borders.begin, self.borders.end)]
        smooth = np.array([float(number) for fade in fades for number in (fade.length, fade.base)])
        v_step = self.width / (self.v.size - 1) if even else 0.0
        u = (self.u_first, self.u_last, self.u_step)
        return z, void, self.v, v_step, self.ref_z, self.bank, smooth, *u

    def heights(self, x: ArrayLike, y: ArrayLike, outside: Outside = "road") -> Floats:
        """Heights at map positions, m; x and y broadcast, the result has their shape.

        Raises InputError for a position that is not finite, and for one off the road where the
        policy or the road's file has no height for it.
        """
        return self._evaluate(*self.xy_to_uv(x, y), outside)[0]

    def heights_uv(self, u: ArrayLike, v: ArrayLike, outside: Outside = "road") -> Floats:
        """As :meth:`heights` at road coordinates."""
        return self._evaluate(u, v, outside)[0]

    def sample(self, x: ArrayLike, y: ArrayLike, outside: Outside = "road") -> RoadHeights:
        """As :meth:`heights`, with which positions are on the road."""
        return self.sample_uv(*self.xy_to_uv(x, y), outside)

    def sample_uv(self, u: ArrayLike, v: ArrayLike, outside: Outside = "road") -> RoadHeights:
        """As :meth:`sample` at road coordinates."""
        z, seen = self._evaluate(u, v, outside)
        return RoadHeights(z, seen == kernels.INSIDE)

    def inside(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """True where the road has data under a map position."""
        return self.sample(x, y, "hold").inside

    def _evaluate(self, u: ArrayLike, v: ArrayLike, outside: Outside) -> tuple[Floats, NDArray[np.uint8]]:
        """Heights, and the bits of :mod:`suspension_twin.road.kernels` for each position."""
        if outside == "road":
            borders = (self.borders.u, self.borders.v)
            modes = int(borders[0].mode), int(borders[1].mode)
            offsets = float(borders[0].offset), float(borders[1].offset)
        elif outside in _MODES:
            modes, offsets = _MODES[outside], (0.0, 0.0)
        else:
            raise InputError("outside", f"must be road, hold, zero or error, is {outside!r}")
        first, second, shape = _pair(u, v)
        if self.borders.close:
            first = self._closed(first)
        z = np.empty(first.size)
        seen = np.empty(first.size, dtype=np.uint8)
        met = kernels.heights_uv(self.grid, first, second, modes, offsets, z, seen)
        if met & kernels.NOT_FINITE:
            raise InputError(self.name, "position", f"{_count(seen, kernels.NOT_FINITE)} not finite")
        if met & kernels.REFUSED or (met and outside == "error"):
            raise InputError(self.name, self._off_road(seen, first, second))
        if met & kernels.VOID and outside == "zero":
            z[(seen & kernels.VOID) > 0] = 0.0
        return z.reshape(shape), seen.reshape(shape)

    def _closed(self, u: Floats) -> Floats:
        """u on a track that closes by its file: counted on from lap to lap, within the first."""
        if self.borders.close_span is None:
            return u
        low, high = self.borders.close_span
        lap = np.fmod(u - low, high - low)
        return np.where((u < low) | (u > high), lap + np.where(lap > 0.0, low, high), u)

    def _off_road(self, seen: NDArray[np.uint8], u: Floats, v: Floats) -> str:
        """An error's text for positions (n,) that were not all on the road."""
        i = int(np.flatnonzero(seen != kernels.INSIDE)[0])
        return (
            f"{_count(seen, kernels.OUTSIDE | kernels.VOID)} off the road, the first at u {u[i]:.2f} m, "
            f"v {v[i]:.2f} m{', where data are missing' if seen[i] == kernels.VOID else ''} "
            f"(the road: u {self.u_first:.2f} to {self.u_last:.2f} m, "
            f"v {self.v[0]:.2f} to {self.v[-1]:.2f} m)"
        )

    def xy_to_uv(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """Road coordinates (u, v) of map positions, m; of the shape of x and y broadcast.

        Before the start and after the end the line goes on straight. Each position is taken to
        the nearest part of the line, whatever came before it; :class:`RoadTracker` follows one.
        """
        first, second, shape = _pair(x, y)
        u, v = np.empty(first.size), np.empty(first.size)
        kernels.xy_to_uv(self.line, self.nearest_point(first, second), first, second, u, v)
        return u.reshape(shape), v.reshape(shape)

    def uv_to_xy(self, u: ArrayLike, v: ArrayLike) -> tuple[Floats, Floats]:
        """Map positions (x, y) of road coordinates, m; of the shape of u and v broadcast."""
        first, second, shape = _pair(u, v)
        if self.borders.close:
            first = self._closed(first)
        x, y = np.empty(first.size), np.empty(first.size)
        kernels.uv_to_xy(self.line, first, second, x, y)
        return x.reshape(shape), y.reshape(shape)

    def with_line(self, **changes: Floats | float | tuple[float, float]) -> Road:
        """The road over a changed reference line: ``with_line(bank=...)``, names as in :class:`ReferenceLine`."""
        return replace(self, reference=replace(self.reference, **changes))  # type: ignore[arg-type]

    def with_heights(self, z: Floats) -> Road:
        """The road with other heights (nu, nv) m, in single precision."""
        return replace(self, z=single_precision(z))

    def part(self, first: int, end: int) -> Road:
        """The cross sections from ``first`` up to ``end`` alone, without ends that fade or close."""
        line, kept = self.reference, slice(first, end)
        x, y, z, bank = (a[kept] for a in (line.x, line.y, line.z, line.bank))
        before, after = self.headings
        if first > 0:
            before = float(np.arctan2(y[1] - y[0], x[1] - x[0]))
        if end < self.x.size:
            after = float(np.arctan2(y[-1] - y[-2], x[-1] - x[-2]))
        cut = ReferenceLine(x, y, z, bank, line.step, (before, after), float(self.u[first]))
        borders = Borders(self.borders.u, self.borders.v)
        return replace(self, z=self.z[kept], reference=cut, borders=borders)

    def scaled(self, factor: float) -> Road:
        """The road with every height multiplied by ``factor``."""
        scaled = replace(self, z=self.z * factor, borders=self.borders.moved(factor))
        return scaled.with_line(z=self.ref_z * factor, bank=self.bank * factor)

    def placed(self, x: float, y: float, heading: float, z: float | None = None) -> Road:
        """The road moved so that its reference line starts at (x, y) with ``heading`` (rad) in ``map``.

        ``z`` m the height of the line's start; None leaves the heights as they are.
        """
        turn = heading - self.headings[0]
        cos, sin = np.cos(turn), np.sin(turn)
        dx, dy = self.x - self.x[0], self.y - self.y[0]
        lift = 0.0 if z is None else z - float(self.ref_z[0])
        return replace(self, borders=self.borders.moved(lift=lift)).with_line(
            x=x + cos * dx - sin * dy,
            y=y + sin * dx + cos * dy,
            z=self.ref_z + lift,
            headings=(heading, self.headings[1] + turn),
        )


def _frozen(given: Floats) -> Floats:
    """An array or a view of it, contiguous and not to be written to."""
    array = np.ascontiguousarray(given, dtype=np.float64).view()
    array.flags.writeable = False
    return array


def _held(z: Floats) -> Floats:
    """Heights with the missing ones taken from the data of their cross section.

    Between data linearly, beyond them the last one; a cross section without data from its
    neighbours along the road.
    """
    held = np.array(z)
    columns = np.arange(z.shape[1])
    good = ~np.isnan(z)
    some = good.any(axis=1)
    for i in np.flatnonzero(some & ~good.all(axis=1)):
        held[i] = np.interp(columns, columns[good[i]], z[i, good[i]])
    if not some.all():
        rows = np.arange(z.shape[0])
        for j in columns:
            held[~some, j] = np.interp(rows[~some], rows[some], held[some, j])
    return held


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[Floats, Floats, tuple[int, ...]]:
    """Both as flat, contiguous, writable arrays, and the shape of the result.

    Writable although nothing writes to them: to numba a read-only array is another type, and every
    type compiles a kernel anew.
    """
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    shape = first.shape
    if shape != second.shape:
        shape = np.broadcast_shapes(shape, second.shape)
        first, second = (np.array(np.broadcast_to(c, shape), order="C") for c in (first, second))
    return _plain(first), _plain(second), shape


def _plain(array: Floats) -> Floats:
    flat = np.ascontiguousarray(array).reshape(-1)
    return flat if flat.flags.writeable else flat.copy()


def _count(seen: NDArray[np.uint8], bits: int) -> str:
    n = int(np.count_nonzero(seen & bits))
    return f"1 of {seen.size} positions is" if n == 1 else f"{n} of {seen.size} positions are"
