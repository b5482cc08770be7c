# SPDX-License-Identifier: Apache-2.0
"""A model over a whole excitation: one twin with everything recorded, or many candidates."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numba import config
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError, WorkError
from suspension_twin.models import rows
from suspension_twin.models.candidate_road import candidate_heights, wheel_paths_of
from suspension_twin.models.connectors import COLUMNS, OBSERVED, observe
from suspension_twin.models.constants import Conditions, Constants, Outside, constants
from suspension_twin.models.parameters import layout, pack
from suspension_twin.models.registry import model_of
from suspension_twin.models.sensor_chain import pass_chain
from suspension_twin.models.types import Excitation, Ints, LaneResponse, Response
from suspension_twin.vehicle.twin import Twin

if TYPE_CHECKING:
    from suspension_twin.models.tracked import ObstacleRun

__all__ = [
    "CAR_SIGNALS",
    "LaneBlocks",
    "Stretch",
    "car_lanes",
    "car_response",
    "cores",
    "full_response",
    "observed",
    "sensed_response",
    "share_out",
    "simulate_lanes",
    "simulate_twin",
]


#: Channels of a car's lanes: specific force and angular rate at the imu's place in base_link axes, and the vertical
#: specific force less gravity's part.
CAR_SIGNALS = (
    "longitudinal_acceleration",
    "lateral_acceleration",
    "vertical_force",
    "roll_rate",
    "pitch_rate",
    "yaw_rate",
    "vertical_acceleration",
)

#: Stamps walked at once where everything is recorded, so that an hour's recording fits in memory.
_CHUNK = 4096
#: Rows of road that lanes with roads of their own get at once.
_OWN_ROWS = 16384


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


@dataclass(frozen=True, eq=False)
class Stretch:
    """Stamps ``begin`` to ``end - 1`` of an excitation and the heights (rows, 4) m seen there.

    ``substeps`` and ``motion`` are those of the whole excitation. ``own`` makes the heights that the lanes of a block
    see, by its number: (rows, 4) of all, or (rows, 4, WIDTH) of each.
    """

    substeps: Ints
    motion: Floats
    begin: int
    end: int
    road: Floats
    own: Callable[[int], tuple[Floats, Floats]] | None = None


class LaneBlocks:
    """L lanes, WIDTH to a block, with their state; the last block is filled up with its last lane.

    Lanes that cannot be simulated are all zero and marked failed, so that they stay finite.
    """

    def __init__(self, known: Constants) -> None:
        self.known = known
        self.lanes = known.lanes
        self.count = -(-self.lanes // rows.WIDTH)
        self._data = _aligned(self.count, known.values.shape[0] * rows.WIDTH)
        self._view = self._data.reshape(self.count, -1, rows.WIDTH)
        _fill(self._view, known.values, known.problems.lanes)
        self._flags: Ints | None = None
        if known.flags is not None:
            self._flags = np.bitwise_or.reduceat(known.flags, np.arange(0, self.lanes, rows.WIDTH))

    @property
    def width(self) -> int:
        """Lanes with the filling: so many ``signals`` and ``states`` have to hold."""
        return int(self.count * rows.WIDTH)

    @property
    def failed(self) -> NDArray[np.bool_]:
        """(L,) lanes without a static equilibrium, and lanes that have diverged."""
        out: NDArray[np.bool_] = self._view[:, rows.FAILED].reshape(-1)[: self.lanes] > 0
        return out

    def restart(self, fresh: LaneBlocks) -> None:
        """Take over constants and state of blocks made from the same constants."""
        self._data[:] = fresh._data

    def walk(self, stretch: Stretch, signals: Floats, states: Floats = _NONE, threads: int = 1) -> None:
        """All lanes through a stretch; ``signals`` and ``states`` as in ``full_car._run``."""
        known, ends = self.known, (stretch.begin, stretch.end)

        def part(low: int, high: int) -> None:
            flags = None if self._flags is None else self._flags[low:high]
            road, own = (stretch.road, _NONE) if stretch.own is None else stretch.own(low)
            where = (stretch.substeps, stretch.motion, *ends, signals, states, low * rows.WIDTH)
            known.kernel.walk(known.hinges, self._data[low:high], flags, road, own, where)

        pieces = self.count if stretch.own is not None else min(self.count, max(1, threads))
        cuts = [k * self.count // pieces for k in range(pieces + 1)]
        share_out(part, list(zip(cuts[:-1], cuts[1:], strict=True)), threads)


def simulate_lanes(
    twin: Twin,
    params: Floats,
    excitation: Excitation | ObstacleRun,
    threads: int | None = None,
    **options: bool,
) -> LaneResponse:
    """Sensor signals of candidates of a twin on one excitation, by the model that the twin file names.

    Parameters
    ----------
    twin
        What the candidates are variants of.
    params
        (P, L) numbers of the candidates, see :func:`~suspension_twin.models.parameters.lanes`.
    excitation
        What drives the model, of the kind that the model takes.
    threads
        NUMBA_NUM_THREADS or the cores there are by default. Neither it nor L changes the numbers of a lane.

    Returns
    -------
    LaneResponse
        A candidate that has no static equilibrium, is unstable or diverges comes back as failed.

    Raises
    ------
    InputError
        Where ``params`` are not of this twin.
    """
    count = len(layout(twin).names)
    if params.ndim != 2 or params.shape[0] != count or params.shape[1] < 1:
        raise InputError("candidates", f"must be ({count}, L >= 1), are {params.shape}")
    return model_of(twin).lanes(twin, params, excitation, threads, **options)


def simulate_twin(twin: Twin, excitation: Excitation) -> Response:
    """Simulate one twin and record everything at the stamps.

    Parameters
    ----------
    twin : Twin
        The twin, its effects included.
    excitation : Excitation
        What excites it, of the kind that its model takes.

    Returns
    -------
    Response
        Heave, roll, pitch, wheels, deflections, tyre forces and the virtual sensor at the n stamps.

    Raises
    ------
    InputError
        A twin that cannot be simulated, naming the key.
    WorkError
        The simulation diverges.

    Examples
    --------
    >>> import numpy as np
    >>> from suspension_twin.inference.synthetic import path_along
    >>> from suspension_twin.models.excitation import excitation
    >>> from suspension_twin.road import bump_road, half_sine
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = load_twin("bags/bump_15kmh/twin.yaml")
    >>> road = bump_road(half_sine(0.9, 0.05), at=10.0, length=40.0)
    >>> path = path_along(road, np.arange(0.0, 3.0, 0.01), ((0.0, 5.0), (3.0, 5.0)), 3.0)
    >>> response = simulate_twin(twin, excitation(path, twin.vehicle, road))
    >>> response.deflection.shape
    (300, 4)
    """
    respond = model_of(twin).respond
    if respond is None:
        raise InputError("twin", "model", f"{twin.model} does not drive on a road")
    return respond(twin, excitation)


def car_lanes(
    twin: Twin,
    params: Floats,
    excitation: Excitation,
    threads: int | None = None,
    *,
    vertical_only: bool = False,
    fused: bool = False,
) -> LaneResponse:
    """``full_car`` and ``msd``, many candidates in blocks of lanes. With ``vertical_only`` the vertical acceleration
    is the only channel: less to write, the same numbers. ``fused``: the pose was fused with the sensor's own readings,
    so that the planar motion has the clock offset of the sensor; the offset then delays the road alone.
    """
    known = _constants(twin, params, Conditions.of(excitation, fused))
    blocks = LaneBlocks(known)
    full = not vertical_only or bool(known.stages)
    signals = np.empty((len(excitation), 7 if full else 1, blocks.width))
    for begin, end in _segments(known, excitation):
        stretch = _stretch(known, excitation, begin, end, strict=False)
        blocks.walk(stretch, signals[begin:end], threads=threads or cores())
    failed = blocks.failed
    signals = signals[:, :, : blocks.lanes]
    if known.reads_otherwise:
        signals = np.ascontiguousarray(signals)
        pass_chain(known, excitation, signals)
        failed |= ~np.isfinite(signals).all(axis=(0, 1))
    if failed.any():
        signals[:, :, failed] = 0.0
    if vertical_only:
        return LaneResponse(excitation.t, CAR_SIGNALS[-1:], signals[:, -1:], failed)
    return LaneResponse(excitation.t, CAR_SIGNALS, signals, failed)


_latest = threading.local()


def _constants(twin: Twin, params: Floats, conditions: Conditions) -> Constants:
    """The constants of candidates. Those that cannot be written to are often simulated over several drives in turn:
    the last ones of a thread are kept."""
    last = getattr(_latest, "asked", (None, None, None))
    if last[0] is not twin or last[1] is not params or last[2] != conditions or params.flags.writeable:
        _latest.asked = twin, params, conditions
        _latest.known = constants(params, layout(twin), conditions)
    known: Constants = _latest.known
    return known


def car_response(twin: Twin, excitation: Excitation) -> Response:
    """``full_car`` and ``msd``, one twin with everything recorded."""
    known = constants(pack(twin)[:, None], layout(twin), Conditions.of(excitation))
    return full_response(known, excitation, twin.vehicle.tyre.radius)


def observed(known: Constants, states: Floats, signals: Floats, radius: float) -> Floats:
    """(n, OBSERVED) of the first lane of ``known``: ``states`` (n, STATES, lanes) and ``signals`` (n, 7, lanes) as the
    kernel wrote them, ``radius`` m of the tyre."""
    out = np.empty((states.shape[0], OBSERVED))
    observe(states, signals, np.ascontiguousarray(known.values[:, 0]), radius, known.kernel.rigid, out)
    return out


def full_response(known: Constants, excitation: Excitation, radius: float) -> Response:
    """Everything that the first lane of ``known`` does; ``radius`` m of the tyre. Raises as ``simulate_twin`` does."""
    known.problems.raise_first()
    blocks = LaneBlocks(known)
    out = np.empty((len(excitation), OBSERVED))
    for begin, end in _segments(known, excitation, _CHUNK):
        signals = np.empty((end - begin, 7, rows.WIDTH))
        states = np.empty((end - begin, rows.STATES, rows.WIDTH))
        blocks.walk(_stretch(known, excitation, begin, end), signals, states)
        out[begin:end] = observed(known, states, signals, radius)
        if blocks.failed[0]:
            raise WorkError(
                f"the simulation diverges by t = {excitation.t[end - 1]:.3f} s: are the road's heights in m?"
            )
    return sensed_response(known, excitation, out)


def sensed_response(known: Outside, excitation: Excitation, out: Floats) -> Response:
    """The response of the first lane from OUTPUTS (n, OBSERVED) with an ideal sensor."""
    if known.reads_otherwise:
        read = np.ascontiguousarray(out[:, 20:27])[:, :, None]
        pass_chain(known, excitation, read)
        out[:, 20:27] = read[:, :, 0]
    return Response(t=excitation.t, **{name: out[:, column] for name, column in COLUMNS.items()})


def _segments(known: Constants, excitation: Excitation, most: int | None = None) -> Iterator[tuple[int, int]]:
    """Parts of the drive, begin and end, that are walked at once."""
    n = len(excitation)
    if known.road is not None:
        most = min(most or n, max(1, _OWN_ROWS * n // int(excitation.first[-1])))
    for begin in range(0, n, most or n):
        yield begin, min(begin + (most or n), n)


def _stretch(known: Constants, excitation: Excitation, begin: int, end: int, strict: bool = True) -> Stretch:
    """A stretch of an excitation, with the heights of each block where lanes see different roads; ``strict`` as in
    ``candidate_heights``."""
    part = slice(int(excitation.first[begin]), int(excitation.first[end]))
    where = excitation.substeps, excitation.motion, begin, end, excitation.road[part]
    change = known.road
    if change is None:
        return Stretch(*where)
    stretch = wheel_paths_of(excitation).stretch(excitation.road, part)

    def own(block: int) -> tuple[Floats, Floats]:
        lane0 = block * rows.WIDTH
        return candidate_heights(stretch, change, lane0, min(rows.WIDTH, known.lanes - lane0), strict)

    return Stretch(*where, own)
