# SPDX-License-Identifier: Apache-2.0
"""The ground as it is: a height over (u, v) along a reference line laid out in ``map``.

The road files of the drives are made from these surfaces as a survey would: sampled more
coarsely, and smoothed. The car drives on the surface itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Floats = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights ``z`` (nu, nv) m on a regular grid; ``heading`` (nu,) rad of the reference line,
    which starts at ``start`` (x, y); v counts to the left, from ``v0``. Grid steps ``du``, ``dv``."""

    du: float
    dv: float
    v0: float
    start: tuple[float, float]
    heading: Floats
    z: Floats

    def __post_init__(self) -> None:
        middle = 0.5 * (self.heading[:-1] + self.heading[1:])
        line = np.zeros((self.heading.size, 2))
        line[1:, 0] = np.cumsum(np.cos(middle)) * self.du
        line[1:, 1] = np.cumsum(np.sin(middle)) * self.du
        object.__setattr__(self, "line", line + np.array(self.start))

    line: Floats = None  # type: ignore[assignment]

    @property
    def u(self) -> Floats:
        return np.arange(self.z.shape[0]) * self.du

    @property
    def v(self) -> Floats:
        return self.v0 + np.arange(self.z.shape[1]) * self.dv

    def to_map(self, u: Floats, v: Floats) -> Floats:
        """(n, 2) x and y of points (n,) given along and across the road."""
        at = np.arange(self.line.shape[0]) * self.du
        heading = np.interp(u, at, self.heading)
        x = np.interp(u, at, self.line[:, 0]) - v * np.sin(heading)
        y = np.interp(u, at, self.line[:, 1]) + v * np.cos(heading)
        return np.column_stack([x, y])

    def surveyed(self, du: float, dv: float, smoothing: float, noise: float, seed: int) -> Floats:
        """(mu, mv) what a scan gives: noise per point, a Gaussian filter, a coarser grid."""
        rng = np.random.default_rng(seed)
        scan = self.z + noise * rng.standard_normal(self.z.shape)
        if smoothing > 0:
            scan = gaussian_filter(scan, (smoothing / self.du, smoothing / self.dv), mode="nearest")
        every_u, every_v = round(du / self.du), round(dv / self.dv)
        return np.ascontiguousarray(scan[::every_u, ::every_v])


class Prober:
    """Heights and slopes under one moving point: bilinear, following the reference line.

    Keeps where it was, so that finding u for an (x, y) is a step or two; one prober a wheel.
    """

    def __init__(self, surface: Surface, u: float) -> None:
        self.s = surface
        self.nu, self.nv = surface.z.shape
        self.u = u
        self.z = surface.z
        self.cos = np.cos(surface.heading).tolist()
        self.sin = np.sin(surface.heading).tolist()
        self.lx = surface.line[:, 0].tolist()
        self.ly = surface.line[:, 1].tolist()

    def height(self, x: float, y: float) -> float:
        u = self.u
        for _ in range(4):
            i = min(max(int(u / self.s.du), 0), self.nu - 2)
            du = (x - self.lx[i]) * self.cos[i] + (y - self.ly[i]) * self.sin[i]
            new = i * self.s.du + du
            if abs(new - u) < 1e-4:
                u = new
                break
            u = new
        self.u = u
        v = -(x - self.lx[i]) * self.sin[i] + (y - self.ly[i]) * self.cos[i]
        a = min(max(u / self.s.du, 0.0), self.nu - 1.000001)
        b = min(max((v - self.s.v0) / self.s.dv, 0.0), self.nv - 1.000001)
        i, j = int(a), int(b)
        a -= i
        b -= j
        z = self.z
        return float(
            (1 - a) * ((1 - b) * z[i, j] + b * z[i, j + 1])
            + a * ((1 - b) * z[i + 1, j] + b * z[i + 1, j + 1])
        )


def roughness(shape: tuple[int, int], du: float, dv: float, gd: float, seed: int) -> Floats:
    """A random isotropic surface whose straight profiles have the displacement PSD
    ``gd`` (n / 0.1)^-2 of ISO 8608, ``gd`` in m³ at 0.1 cycles/m, waves of 0.1 to 40 m.

    An isotropic surface with profiles ~ n^-2 has a plane spectrum ~ n^-3; the factor between
    them is fixed afterwards by the surface's own profiles.
    """
    rng = np.random.default_rng(seed)
    big = (2 * shape[0], max(2 * shape[1], 64))  # larger than needed, so that it does not wrap around
    nu = np.fft.fftfreq(big[0], du)[:, None]
    nv = np.fft.rfftfreq(big[1], dv)[None, :]
    n = np.hypot(nu, nv)
    shape_n = np.where((n > 1 / 40) & (n < 10), np.maximum(n, 1e-3) ** -1.5, 0.0)
    spectrum = np.fft.rfft2(rng.standard_normal(big)) * shape_n
    z = np.fft.irfft2(spectrum, big)[: shape[0], : shape[1]]
    wave = np.fft.rfftfreq(shape[0], du)
    window = np.hanning(shape[0])[:, None]
    power = (np.abs(np.fft.rfft((z - z.mean(0)) * window, axis=0)) ** 2).mean(1) * 2 * du / np.sum(window**2)
    band = (wave > 0.1) & (wave < 3)
    level = np.exp(np.mean(np.log(power[band] * (wave[band] / 0.1) ** 2)))
    return np.asarray(z * np.sqrt(gd / level))
