# SPDX-License-Identifier: Apache-2.0
"""Lanes in blocks, and a stretch of a drive for all of them: what batch and live have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
from numba import config
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models import rows
from suspension_twin.models.constants import Constants
from suspension_twin.models.full_car import KERNELS
from suspension_twin.models.full_car_effects import effect_kernels
from suspension_twin.models.msd import MSD_KERNELS
from suspension_twin.models.types import Ints

__all__ = ["LaneBlocks", "cores", "share_out"]

_NONE = np.zeros((0, 0, 0))


def cores() -> int:
    """Threads to use: NUMBA_NUM_THREADS where it is set, else the cores there are."""
    return max(1, int(config.NUMBA_NUM_THREADS))


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=cores(), thread_name_prefix="lanes")


def share_out(work: Callable[[int, int], None], parts: Sequence[tuple[int, int]], threads: int) -> None:
    """``work`` on every part (from, to), on several threads if there are: it has to let go of the GIL."""
    if threads <= 1 or len(parts) == 1:
        for low, high in parts:
            work(low, high)
        return
    for job in [_pool().submit(work, low, high) for low, high in parts]:
        job.result()


def _aligned(count: int, size: int) -> Floats:
    """Zeros (count, size) that start on a cache line; vectors that straddle two cost double."""
    room = np.zeros(count * size + 8)
    skip = -(room.ctypes.data // 8) % 8
    return room[skip : skip + count * size].reshape(count, size)


@compiled
def _fill(blocks: Floats, values: Floats, bad: NDArray[np.bool_]) -> None:
    """Write ``values`` (rows, L) into blocks (B, rows, WIDTH) of zeros."""
    lanes = values.shape[1]
    for block in range(blocks.shape[0]):
        lane0 = block * rows.WIDTH
        for row in range(values.shape[0]):
            for i in range(rows.WIDTH):
                lane = min(lane0 + i, lanes - 1)
                if not bad[lane]:
                    blocks[block, row, i] = values[row, lane]
        for i in range(rows.WIDTH):
            if bad[min(lane0 + i, lanes - 1)]:
                blocks[block, rows.FAILED, i] = 1.0


class LaneBlocks:
    """L lanes, WIDTH to a block, with their state; the last block is filled up with its last lane.

    Lanes that cannot be simulated are all zero and marked failed, so that they stay finite.
    """

    def __init__(self, known: Constants) -> None:
        self.known = known
        self.lanes = known.values.shape[1]
        self.count = -(-self.lanes // rows.WIDTH)
        values, bad = known.values, known.bad
        self._data = _aligned(self.count, values.shape[0] * rows.WIDTH)
        self._view = self._data.reshape(self.count, -1, rows.WIDTH)
        _fill(self._view, values, bad)
        flags = np.zeros(self.lanes, dtype=np.int64) if known.flags is None else known.flags
        self._flags = np.bitwise_or.reduceat(flags, np.arange(0, self.lanes, rows.WIDTH))

    @property
    def width(self) -> int:
        """Lanes with the filling, which is what ``signals`` and ``states`` have to hold."""
        return int(self.count * rows.WIDTH)

    @property
    def failed(self) -> NDArray[np.bool_]:
        """(L,) lanes without a static equilibrium, and lanes that have diverged."""
        out: NDArray[np.bool_] = self._view[:, rows.FAILED].reshape(-1)[: self.lanes] > 0
        return out

    def restart(self, fresh: LaneBlocks) -> None:
        """Take over constants and state of blocks made from the same constants."""
        self._data[:] = fresh._data

    def walk(
        self,
        road: Floats,
        candidate_road: Callable[[int], tuple[Floats, Floats]] | None,
        substeps: Ints,
        motion: Floats,
        begin: int,
        end: int,
        signals: Floats,
        states: Floats = _NONE,
        threads: int = 1,
    ) -> None:
        """All lanes through the stamps begin..end-1; arguments as in ``full_car._run``.

        ``candidate_road`` makes the heights that the lanes of a block see, by its number: (rows, 4) of all, or
        (rows, 4, WIDTH) of each.
        """

        def part(low: int, high: int) -> None:
            data, lane0, hinges = self._data[low:high], low * rows.WIDTH, self.known.hinges
            shared, own = (road, _NONE) if candidate_road is None else candidate_road(low)
            where = substeps, motion, begin, end, signals, states, lane0
            if self.known.model == "msd":
                MSD_KERNELS[hinges](data, shared, own, *where)
            elif self.known.flags is not None:
                effect_kernels().kernels[hinges](data, self._flags[low:high], shared, own, *where)
            else:
                KERNELS[hinges](data, shared, *where)

        pieces = self.count if candidate_road is not None else min(self.count, max(1, threads))
        cuts = np.linspace(0, self.count, pieces + 1).astype(int)
        parts = list(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))
        share_out(part, parts, threads)
