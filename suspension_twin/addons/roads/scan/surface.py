# SPDX-License-Identifier: Apache-2.0
"""The surface through noisy points that keeps its edges, with its uncertainty.

Heights z at the nodes of a grid, bilinear between them. A point p observes z with noise of scale s, heavy-tailed; the
differences of neighbouring nodes are those of a random walk, whose slope is white noise as that of an ISO 8608 road of
waviness 2 is, and heavy-tailed too: at an edge a few of them are many times as large as elsewhere. Both are Student t
distributions, written as normal ones with a weight each (Lange, Little and Taylor, J. Am. Stat. Assoc. 84 (1989) 881),
so that z follows from

    (B' W B + D_u' Q_u D_u + D_v' Q_v D_v) z = B' W h,

solved by a banded Cholesky factor L; draws of the posterior are L'^-1 times white noise. Weights and the scales of
noise and differences are estimated anew from z and the draws (expectation maximisation). The weights of differences
are shared with those beside them along an edge. On an even grid the differences along u, of variance a, have the share
2/pi atan(sqrt(b/a)) of the degrees of freedom, those across, of variance b, the rest: the resistance between
neighbours in a lattice of resistors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.ndimage import uniform_filter
from threadpoolctl import threadpool_limits

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import WorkError

__all__ = ["Points", "Surface", "SurfaceGrid", "fit_surface"]

#: Degrees of freedom of both Student t distributions, as is usual for robust fits (Lange et al., section 5).
_FREEDOM = 4.0
#: Differences that share a weight along an edge, beside each other.
_POOL = 5
_ITERATIONS, _DRAWS = 6, 8
#: Blocks in which the scale of the noise is estimated, m, and points' worth of the whole tile's in each.
_BLOCK_U, _BLOCK_V, _BLOCK_PRIOR = 1.0, 0.5, 50.0
_FIRST_NOISE = 0.005
#: Length of a tile and of its overlap with the next, m; the reach of a datum is some decimetres.
_TILE, _OVERLAP = 20.0, 2.0
#: A node without any datum near is held by this, m: only so that the factor exists.
_LOOSE = 30.0


@dataclass(frozen=True, eq=False)
class Points:
    """Ground points (n,): ``u``, ``v``, ``z`` m, sorted by u."""

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    z: NDArray[np.float32]

    def __getitem__(self, rows: slice | NDArray[np.bool_]) -> Points:
        """Some of them."""
        return Points(self.u[rows], self.v[rows], self.z[rows])


@dataclass(frozen=True)
class SurfaceGrid:
    """Nodes at ``u`` = u0 + i du and ``v`` = v0 + j dv, m."""

    nu: int
    nv: int
    du: float
    dv: float
    v0: float
    u0: float = 0.0

    @property
    def v(self) -> Floats:
        """(nv,) m across."""
        return np.asarray(self.v0 + self.dv * np.arange(self.nv, dtype=np.float64))

    def rows(self, begin: int, end: int) -> SurfaceGrid:
        """The nodes from row ``begin`` to before ``end``."""
        return replace(self, nu=end - begin, u0=begin * self.du)

    def sums(self, points: Points, values: NDArray[np.floating] | None = None) -> Floats:
        """(nu, nv) sum of ``values`` (n,), or number, of the points nearest to each node."""
        at = np.clip(np.rint((points.u - self.u0) / self.du), 0, self.nu - 1).astype(np.int64) * self.nv
        at += np.clip(np.rint((points.v - self.v0) / self.dv), 0, self.nv - 1).astype(np.int64)
        return np.bincount(at, values, self.nu * self.nv).astype(np.float64).reshape(self.nu, self.nv)


@dataclass(frozen=True, eq=False)
class Surface:
    """A fitted surface on the nodes of a grid.

    Parameters
    ----------
    z, sigma : (nu, nv) array
        Heights and their standard deviation in m.
    draws : (2, nu, nv) array
        Draws of the heights' error in m.
    noise, count : (nu, nv) array
        Scale in m of the noise of the points about each node, and their number.
    """

    z: Floats
    sigma: Floats
    draws: Floats
    noise: Floats
    count: Floats


def fit_surface(
    points: Points, grid: SurfaceGrid, seed: int = 0, progress: Callable[[float], None] = lambda share: None
) -> Surface:
    """Fit the surface tile by tile along u; neighbouring tiles are faded into each other."""
    rows_tile = max(4, round(_TILE / grid.du))
    rows_over = max(2, round(_OVERLAP / grid.du))
    starts = list(range(0, max(1, grid.nu - rows_over), rows_tile))
    shape = (grid.nu, grid.nv)
    out = Surface(np.zeros(shape), np.zeros(shape), np.zeros((2, *shape)), np.zeros(shape), np.zeros(shape))
    rng = np.random.default_rng(seed)
    with threadpool_limits(1, "blas"):
        for k, start in enumerate(starts):
            end = grid.nu if k == len(starts) - 1 else min(grid.nu, start + rows_tile + rows_over)
            begin = max(0, start - rows_over) if k else 0
            low, high = np.searchsorted(points.u, [(begin - 0.5) * grid.du, (end - 0.5) * grid.du])
            tile = _fit_tile(points[low:high], grid.rows(begin, end), rng)
            fade = np.ones(end - begin)
            if k:
                shared = 2 * rows_over
                fade[:shared] = (np.arange(shared) + 0.5) / shared
            for name in ("z", "sigma", "noise", "count"):
                mixed, new = getattr(out, name), getattr(tile, name)
                mixed[begin:end] = (1.0 - fade[:, None]) * mixed[begin:end] + fade[:, None] * new
            # Draws of two tiles are independent: their squares add up.
            keep = np.sqrt(np.maximum(0.0, 1.0 - fade))[:, None]
            out.draws[:, begin:end] = keep * out.draws[:, begin:end] + np.sqrt(fade)[:, None] * tile.draws
            progress((k + 1) / len(starts))
    return out


def _fit_tile(points: Points, grid: SurfaceGrid, rng: np.random.Generator) -> Surface:
    """The surface on some rows of nodes."""
    nu, nv, n = grid.nu, grid.nv, grid.nu * grid.nv
    place = (grid.u0, grid.v0, grid.du, grid.dv)
    level = float(np.median(points.z)) if points.z.size else 0.0
    u, v, z = (np.ascontiguousarray(c) for c in (points.u, points.v, points.z - np.float32(level)))
    across = max(1, math.ceil((nv - 1) * grid.dv / _BLOCK_V) + 1)
    which = np.clip(((u - grid.u0) / _BLOCK_U).astype(np.int64), 0, None) * across
    which += np.clip(((v - grid.v0) / _BLOCK_V).astype(np.int64), 0, across - 1)
    w = np.full(z.size, 1.0 / _FIRST_NOISE**2)
    scale = np.full(z.size, _FIRST_NOISE)
    # A tenth of a percent of slope at first: the estimate follows within two iterations.
    along, beside = _Differences(0, nu, nv, grid.du), _Differences(1, nu, nv, grid.dv)
    r = np.empty(z.size)
    for _ in range(_ITERATIONS):
        band, right = np.zeros((nv + 2, n)), np.zeros(n)
        _accumulate(u, v, z, w, *place, nu, nv, band, right)
        along.add(band)
        beside.add(band)
        band[0] += 1.0 / _LOOSE**2
        factor, failed = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
        if failed:
            raise WorkError("scan: the surface cannot be fitted: its equations are singular")
        heights = lapack.dpbtrs(factor, right[:, None], lower=1)[0].reshape(nu, nv)
        white = rng.standard_normal((n, _DRAWS))
        draws = lapack.dtbtrs(factor, white, uplo="L", trans="T")[0].T.reshape(_DRAWS, nu, nv)
        share = 2.0 / math.pi * math.atan2(beside.scale, along.scale)
        along.learn(heights, draws, share)
        beside.learn(heights, draws, 1.0 - share)
        _residuals(u, v, z, *place, heights, r)
        if z.size:
            square = (_FREEDOM + 1.0) / (_FREEDOM + (r / scale) ** 2) * r**2
            counts = np.bincount(which)
            prior = _BLOCK_PRIOR * float(square.mean())
            blocks = (np.bincount(which, square) + prior) / (counts + _BLOCK_PRIOR)
            scale = np.sqrt(np.maximum(blocks, 1e-10))[which]
        w = (_FREEDOM + 1.0) / (_FREEDOM + (r / scale) ** 2) / scale**2
    count = grid.sums(points)
    with np.errstate(invalid="ignore"):
        noise = np.nan_to_num(grid.sums(points, scale) / count)
    spread = np.sqrt(uniform_filter(np.mean(draws**2, axis=0), 3))
    return Surface(heights + level, spread, draws[:2].copy(), noise, count)


class _Differences:
    """The prior of the differences along one axis: their scale, and a weight for each."""

    def __init__(self, axis: int, nu: int, nv: int, step: float) -> None:
        self._axis, self._nu, self._nv = axis, nu, nv
        self.scale = 1e-3 * math.sqrt(step / 0.05)
        self._weight = np.ones((nu - 1, nv) if axis == 0 else (nu, nv - 1))

    def add(self, band: Floats) -> None:
        """Add the precision of the differences to a banded matrix."""
        p = self._weight / self.scale**2
        diagonal, beside = np.zeros((2, self._nu, self._nv))
        # Views in which the differences run along the first axis.
        own, next_, q = (np.swapaxes(c, 0, self._axis) for c in (diagonal, beside, p))
        own[:-1] += q
        own[1:] += q
        next_[:-1] = -q
        band[self._nv if self._axis == 0 else 1] += beside.ravel()
        band[0] += diagonal.ravel()

    def learn(self, z: Floats, draws: Floats, share: float) -> None:
        """Weights and scale from the surface and draws of its error.

        A grid has two differences a node but one degree of freedom: each expects ``share`` of its own variance.
        """
        square = np.diff(z, axis=self._axis) ** 2
        square += np.mean(np.diff(draws, axis=self._axis + 1) ** 2, axis=0)
        square /= share
        pool = (1, _POOL) if self._axis == 0 else (_POOL, 1)
        shared = _POOL * uniform_filter(square, pool) / self.scale**2
        self._weight = (_FREEDOM + _POOL) / (_FREEDOM + shared)
        self.scale = max(math.sqrt(float(np.mean(self._weight * square))), 1e-6)


@compiled
def _accumulate(
    u: NDArray[np.float32], v: NDArray[np.float32], z: NDArray[np.float32], w: Floats,
    u0: float, v0: float, du: float, dv: float, nu: int, nv: int,
    band: Floats, right: Floats,
) -> None:  # fmt: skip
    """Add weighted points (n,) to the normal equations of the nodes.

    A point observes the bilinear interpolation of the four nodes around it. Nodes are numbered i * nv + j; a matrix
    over them is banded, stored as LAPACK's lower form: band[k, j] = A[j + k, j].
    """
    beyond = (0, 1, nv, nv + 1)
    for p in range(u.size):
        fu, fv = (u[p] - u0) / du, (v[p] - v0) / dv
        i, j = min(max(int(fu), 0), nu - 2), min(max(int(fv), 0), nv - 2)
        a, c = fu - i, fv - j
        shares = ((1.0 - a) * (1.0 - c), (1.0 - a) * c, a * (1.0 - c), a * c)
        for m in range(4):
            k, share = i * nv + j + beyond[m], w[p] * shares[m]
            right[k] += w[p] * z[p] * shares[m]
            for n in range(m, 4):
                band[beyond[n] - beyond[m], k] += share * shares[n]


@compiled
def _residuals(
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    z: NDArray[np.float32],
    u0: float,
    v0: float,
    du: float,
    dv: float,
    x: Floats,
    out: Floats,
) -> None:
    """Heights (n,) of points above the surface of nodes ``x`` (nu, nv)."""
    nu, nv = x.shape
    for p in range(u.size):
        fu, fv = (u[p] - u0) / du, (v[p] - v0) / dv
        i, j = min(max(int(fu), 0), nu - 2), min(max(int(fv), 0), nv - 2)
        a, c = fu - i, fv - j
        low = x[i, j] + c * (x[i, j + 1] - x[i, j])
        top = x[i + 1, j] + c * (x[i + 1, j + 1] - x[i + 1, j])
        out[p] = z[p] - (low + a * (top - low))
