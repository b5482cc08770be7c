# SPDX-License-Identifier: Apache-2.0
"""A model over a whole excitation: one twin with everything recorded, or many candidates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, WorkError
from suspension_twin.models import rows
from suspension_twin.models.blocks import Blocks, cores
from suspension_twin.models.candidate_road import own_road, tracks_of
from suspension_twin.models.constants import Constants, constants
from suspension_twin.models.observe import COLUMNS, OBSERVED, observe
from suspension_twin.models.parameters import layout, pack
from suspension_twin.models.sensor_chain import pass_chain
from suspension_twin.models.tracked_live import simulate_tracked_drive
from suspension_twin.models.types import Excitation, LaneResponse, Response
from suspension_twin.vehicle.tracked_twin import TrackedTwin
from suspension_twin.vehicle.twin import Twin

__all__ = ["simulate_lanes", "simulate_twin"]

#: Stamps walked at once where everything is recorded, so that an hour's recording fits in memory.
_CHUNK = 4096
#: Rows of road that lanes with roads of their own get at once.
_OWN_ROWS = 16384


def simulate_lanes(
    twin: Twin,
    params: Floats,
    excitation: Excitation,
    threads: int | None = None,
    *,
    vertical_only: bool = False,
    fused: bool = False,
) -> LaneResponse:
    """Sensor signals of candidates ``params`` (P, L) (see ``parameters.lanes``) on one excitation.

    ``threads`` defaults to NUMBA_NUM_THREADS or the cores there are. Neither it nor L changes the
    numbers of a lane. A lane that cannot stand, is unstable or diverges comes back as failed. With
    ``vertical_only`` force and rate come back with no components, (n, 0, L): less to write, the
    same numbers. ``fused``: the pose was fused with the sensor's own readings, so that the motion that it has
    is as late as the sensor is; late by that clock is then the road alone.
    """
    shape = layout(twin)
    if params.ndim != 2 or params.shape[0] != len(shape.names) or params.shape[1] < 1:
        raise InputError("candidates", f"must be ({len(shape.names)}, L >= 1), are {params.shape}")
    known = constants(params, shape, excitation.max_step, fused, excitation.antenna, excitation.late)
    blocks = Blocks(known)
    full = not vertical_only or bool(known.stages)
    signals = np.empty((len(excitation), 7 if full else 1, blocks.width))
    for begin, end in _stretches(known, excitation):
        road, own = _roads(known, blocks, excitation, begin, end, strict=False)
        blocks.walk(
            road,
            own,
            excitation.substeps,
            excitation.motion,
            begin,
            end,
            signals[begin:end],
            threads=threads or cores(),
        )
    failed = blocks.failed
    signals = signals[:, :, : blocks.lanes]
    if known.stages or known.clock is not None:
        signals = np.ascontiguousarray(signals)
        pass_chain(known, excitation, signals)
        failed |= ~np.isfinite(signals).all(axis=(0, 1))
    if failed.any():
        signals[:, :, failed] = 0.0
    rest = signals[:, : 0 if vertical_only else 6]
    return LaneResponse(
        t=excitation.t,
        force=rest[:, :3],
        rate=rest[:, 3:],
        vertical_acceleration=signals[:, -1],
        failed=failed,
    )


def simulate_twin(twin: Twin, excitation: Excitation) -> Response:
    """One twin over an excitation, everything recorded at the stamps.

    Raises InputError for a twin that cannot be simulated (naming the key) and WorkError when the
    simulation diverges.
    """
    if isinstance(twin, TrackedTwin):
        return simulate_tracked_drive(twin, excitation)
    most, antenna, late = excitation.max_step, excitation.antenna, excitation.late
    known = constants(pack(twin)[:, None], layout(twin), most, antenna=antenna, late=late)
    known.raise_first()
    blocks = Blocks(known)
    n = len(excitation)
    out = np.empty((n, OBSERVED))
    values = np.ascontiguousarray(known.values[:, 0])
    for begin, end in _stretches(known, excitation, _CHUNK):
        signals = np.empty((end - begin, 7, rows.WIDTH))
        states = np.empty((end - begin, rows.STATES, rows.WIDTH))
        road, own = _roads(known, blocks, excitation, begin, end)
        blocks.walk(road, own, excitation.substeps, excitation.motion, begin, end, signals, states)
        observe(states, signals, values, twin.vehicle.tyre.radius, twin.model == "msd", out[begin:end])
        if blocks.failed[0]:
            raise WorkError(
                f"the simulation diverges by t = {excitation.t[end - 1]:.3f} s: are the road's heights in m?"
            )
    if known.stages or known.clock is not None:
        read = np.ascontiguousarray(out[:, 20:27])[:, :, None]
        pass_chain(known, excitation, read)
        out[:, 20:27] = read[:, :, 0]
    return Response(t=excitation.t, **{name: out[:, column] for name, column in COLUMNS.items()})


def _stretches(
    known: Constants, excitation: Excitation, most: int | None = None
) -> Iterator[tuple[int, int]]:
    """Parts of the drive, begin and end, that are walked at once."""
    n = len(excitation)
    if known.road is not None:
        most = min(most or n, max(1, _OWN_ROWS * n // int(excitation.first[-1])))
    for begin in range(0, n, most or n):
        yield begin, min(begin + (most or n), n)


def _roads(
    known: Constants, blocks: Blocks, excitation: Excitation, begin: int, end: int, strict: bool = True
) -> tuple[Floats, Callable[[int], tuple[Floats, Floats]] | None]:
    """Road heights of a stretch, and a maker of every block's own where lanes see different roads;
    ``strict`` as in ``own_road``."""
    part = slice(int(excitation.first[begin]), int(excitation.first[end]))
    road, change = excitation.road[part], known.road
    if change is None:
        return road, None
    tracks = tracks_of(excitation)
    distance = tracks.distance[part]

    def own(block: int) -> tuple[Floats, Floats]:
        lane0 = block * rows.WIDTH
        count = min(rows.WIDTH, blocks.lanes - lane0)
        return own_road(
            tracks,
            change,
            lane0,
            count,
            road,
            distance,
            excitation.road[0],
            strict,
            partial(tracks.earlier, part),
        )

    return road, own
