# SPDX-License-Identifier: Apache-2.0
"""The live gap over a sliding window and over all driving, sample by sample."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.output import details_path
from suspension_twin.errors import InputError
from suspension_twin.files import read_yaml, reading
from suspension_twin.pose.types import STANDING_SPEED

__all__ = ["CalibrationGap", "GapNow", "GapTile", "GapTiles", "RunningGap", "calibration_gap", "gap_warning"]

#: Seconds of standing before noise is learnt.
STANDING_TIME = 1.0
#: Rows that the ring grows by.
_GROW = 1024
#: Parts of the window, of which two make a piece of the spectrum: 4 s of 10, so that the lowest band, from 0.5 Hz on,
#: begins at the second line.
_PIECES = 5
#: Edge of a tile in m and the number of tiles kept: the last two kilometres; samples from which a tile is shown.
TILE_EDGE, _MOST_TILES, _FEWEST = 1.0, 2000, 3


@dataclass(frozen=True)
class GapNow:
    """``rms``, ``measured_rms``, ``bands`` m/s²; ``noise_rms`` and ``normalised`` NaN while not known, ``normalised``
    the ratio to the residual of the calibration where it is ``calibrated``, else to the noise; ``samples`` in the
    window."""

    rms: float
    measured_rms: float
    noise_rms: float
    normalised: float
    bands: tuple[float, ...]
    samples: int
    calibrated: bool = False

    def __str__(self) -> str:
        floor = "calibrated" if self.calibrated else "noise"
        times = "" if math.isnan(self.normalised) else f" ({self.normalised:.1f} × {floor})"
        return f"{self.rms:.2f} m/s²{times}"


class RunningGap:
    """Measured minus simulated vertical acceleration, both through the same filter: over the window :meth:`now`, over
    all driving on the road :attr:`driving_rms`.

    ``window`` s; ``edges`` Hz of adjoining bands, rising; ``floor`` m/s² residual rms of the calibration, 0
    where unknown (then the noise at standstill is used); ``settle`` s after a restart of the twin that do not count,
    for the transient from rest to decay."""

    def __init__(
        self,
        window: float = 10.0,
        edges: Sequence[float] = (0.5, 3.0, 8.0, 20.0),
        floor: float = 0.0,
        settle: float = 2.0,
    ) -> None:
        if not (math.isfinite(window) and window > 0):
            raise InputError("gap", "window", f"must be above 0 s, is {window}")
        if any(not 0 <= a < b for a, b in zip(edges, edges[1:], strict=False)) or len(edges) == 1:
            raise InputError(
                "gap", "bands", f"must rise from 0 Hz or more, at least two edges, are {list(edges)}"
            )
        if not (math.isfinite(floor) and floor >= 0):
            raise InputError("gap", "floor", f"must not be negative, is {floor}")
        self.window = window
        self.edges = tuple(float(e) for e in edges)
        self.floor = floor
        self._settle = settle
        self._ring = np.zeros((4 * _GROW, 3))
        #: Samples of driving since the beginning, the sum of their squared differences, and the stamp of the first:
        #: what a reset leaves.
        self._driven, self._squares, self.driving_since = 0, 0.0, math.nan
        self.reset()

    def reset(self) -> None:
        """Clear the window and the noise estimate."""
        self._head = 0  # rows written, counted without end
        self._tail = 0  # oldest row in the window
        self._from = -math.inf
        self._still_since = math.nan
        self._noise: list[float] = [0.0, 0.0, 0.0]  # count, mean, sum of squared deviations

    def restart(self, t: float) -> None:
        """The twin was restarted at ``t`` s: samples do not count until it has settled."""
        self._tail = self._head
        self._from = t + self._settle

    def push(self, t: float, measured: float, simulated: float, speed: float, on_road: bool = True) -> None:
        """One sample: ``t`` s, accelerations m/s², ``speed`` m/s of the vehicle, and whether its place on the road is
        known."""
        self._learn(t, measured, speed)
        if t < self._from:
            return
        size = len(self._ring)
        if self._head - self._tail >= size:
            self._ring = np.roll(self._ring, -(self._tail % size), axis=0)
            self._ring = np.concatenate([self._ring, np.zeros_like(self._ring)])
            self._head, self._tail, size = self._head - self._tail, 0, 2 * size
        if on_road and abs(speed) > STANDING_SPEED:
            if not self._driven:
                self.driving_since = t
            self._driven += 1
            self._squares += (measured - simulated) ** 2
        self._ring[self._head % size] = (t, measured, simulated)
        self._head += 1
        while self._ring[self._tail % size, 0] <= t - self.window:
            self._tail += 1

    def _learn(self, t: float, measured: float, speed: float) -> None:
        if not abs(speed) < STANDING_SPEED:
            self._still_since = math.nan
            return
        if math.isnan(self._still_since):
            self._still_since = t
        if t - self._still_since < STANDING_TIME:
            return
        noise = self._noise
        noise[0] += 1
        off = measured - noise[1]
        noise[1] += off / noise[0]
        noise[2] += off * (measured - noise[1])

    @property
    def driving_rms(self) -> float:
        """The gap in m/s²: over all driving on the road since the twin has settled; NaN before."""
        return math.sqrt(self._squares / self._driven) if self._driven else math.nan

    @property
    def settled(self) -> bool:
        """Whether the newest sample counts: the twin has settled after its last restart."""
        return self._head > self._tail

    @property
    def noise_rms(self) -> float:
        """Spread of the measured signal at standstill in m/s²; NaN before a second of it was seen."""
        count, _, squares = self._noise
        return math.sqrt(squares / (count - 1)) if count >= 32 else math.nan

    def now(self) -> GapNow | None:
        """The gap over the window; None while it holds fewer than two samples."""
        rows = self._rows()
        if len(rows) < 2:
            return None
        difference = rows[:, 1] - rows[:, 2]
        rms = float(np.sqrt(np.mean(difference**2)))
        noise = self.noise_rms
        floor = self.floor or noise
        return GapNow(
            rms=rms,
            measured_rms=float(np.sqrt(np.mean(rows[:, 1] ** 2))),
            noise_rms=noise,
            normalised=rms / floor if floor > 0 else math.nan,
            bands=self._bands(rows[:, 0], difference),
            samples=len(rows),
            calibrated=self.floor > 0,
        )

    def _rows(self) -> Floats:
        return np.asarray(self._ring[np.arange(self._tail, self._head) % len(self._ring)])

    def _bands(self, t: Floats, difference: Floats) -> tuple[float, ...]:
        """Rms in each band: the square of the whole in the shares of the spectrum, so that the squares of the bands,
        with what lies outside of them, add up to it.

        The pieces of the spectrum overlap by half under sine tapers, whose squares add up to one: but for the ends,
        every sample counts as much as in the whole, wherever in the window it lies.
        """
        if len(self.edges) < 2:
            return ()
        n = difference.size
        half = max(n // _PIECES, 1)
        taper = np.sin(np.pi * (np.arange(2 * half) + 0.5) / (2 * half))
        newest = difference[n % half :]
        pieces = np.lib.stride_tricks.sliding_window_view(newest, 2 * half)[::half] * taper
        power = np.sum(np.abs(np.fft.rfft(pieces, axis=1)) ** 2, axis=0)
        power[[0, -1]] /= 2.0
        power *= float(np.mean(difference**2)) / (float(power.sum()) or 1.0)
        # Samples are nearly even; the mean rate is what the frequencies need.
        frequency = np.arange(power.size) * ((n - 1) / (float(t[-1] - t[0]) * 2 * half))
        at = np.searchsorted(frequency, self.edges)
        return tuple(float(np.sqrt(power[a:b].sum())) for a, b in zip(at, at[1:], strict=False))


class CalibrationGap(NamedTuple):
    """The residual of a calibration on its worst drive: rms in m/s², and as a ``share`` of the measured rms, which
    scales it to a rougher road. Both 0 where not known."""

    rms: float
    share: float


def calibration_gap(given: float, twin_file: str) -> CalibrationGap:
    """The residual of the calibration: ``given`` in m/s², or where that is 0 from the details beside the twin file.

    Raises InputError for details that cannot be read.
    """
    if given or not twin_file:
        return CalibrationGap(given, 0.0)
    with reading(twin_file, "a twin file"):
        details = details_path(Path(twin_file))
        if not details.is_file():
            return CalibrationGap(given, 0.0)
    try:
        drives = read_yaml(details)["drives"]
        # The live gap includes clock, gain and tilt errors: the larger of the two values is to be expected.
        residuals = [
            max(d["gap_after"]["rms"], d["residual_with_nuisances_corrected"] or 0.0) for d in drives
        ]
        shares = [math.sqrt(1.0 - min(abs(d["correlation"] or 1.0), 1.0) ** 2) for d in drives]
    except (InputError, ValueError, KeyError, TypeError):
        raise InputError(details, "drives", "has no residual of the calibration") from None
    finite = filter(math.isfinite, residuals)
    return CalibrationGap(max(finite, default=0.0), max(shares, default=0.0))


def gap_warning(gap: GapNow | None, expected: CalibrationGap, ratio: float, place: float = 0.0) -> str:
    """The warning of a gap of more than ``ratio`` times the residual of the calibration, scaled to the roughness of
    the present road; empty if there is nothing to warn of. Where the ``place`` along the road was known to as many m
    only, the gap is no sign of another vehicle."""
    if gap is None or not expected.rms:
        return ""
    residual = max(expected.rms, expected.share * gap.measured_rms)
    if gap.rms <= ratio * residual:
        return ""
    grown = (
        f"the gap is {gap.rms:.3g} m/s², {gap.rms / residual:.1f} times the residual of the calibration "
        f"({residual:.3g} m/s²)"
    )
    if place:
        return f"{grown}, by the place: known to {place:.2g} m, it puts bumps as far too early or too late"
    return f"{grown}: run a diagnosis"


class GapTile(NamedTuple):
    """Its centre in ``map`` in m and the rms gap in m/s² of the newest pass over it."""

    x: float
    y: float
    z: float
    rms: float


class GapTiles:
    """Collects the gap sample by sample on a grid of ``map``; a new pass over a tile replaces the old one."""

    def __init__(self) -> None:
        self.tiles: OrderedDict[tuple[int, int], GapTile] = OrderedDict()
        self.reset()

    def reset(self) -> None:
        """Discard everything."""
        self.tiles.clear()
        self._under: tuple[int, int] | None = None
        self._count, self._squares = 0, 0.0

    def push(self, x: float, y: float, z: float, difference: float) -> None:
        """One sample: the position in m, measured minus simulated in m/s²."""
        under = math.floor(x / TILE_EDGE), math.floor(y / TILE_EDGE)
        if under != self._under:
            self._under, self._count, self._squares = under, 0, 0.0
        self._count += 1
        self._squares += difference * difference
        if self._count < _FEWEST:
            return
        centre = (under[0] + 0.5) * TILE_EDGE, (under[1] + 0.5) * TILE_EDGE
        self.tiles[under] = GapTile(*centre, z, math.sqrt(self._squares / self._count))
        self.tiles.move_to_end(under)
        if len(self.tiles) > _MOST_TILES:
            self.tiles.popitem(last=False)
