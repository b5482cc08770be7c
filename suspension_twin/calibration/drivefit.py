# SPDX-License-Identifier: Apache-2.0
"""Each drive before and after a calibration: gaps, residuals with the nuisances corrected, eq. (1)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.calibration.recorder import SearchOutcome
from suspension_twin.calibration.request import DriveFit
from suspension_twin.calibration.searches import costs_of
from suspension_twin.calibration.setup import Setup, problem_of
from suspension_twin.calibration.squares import on_taped_road
from suspension_twin.inference.gap import main_channel
from suspension_twin.inference.nuisance import OF_A_CALIBRATION
from suspension_twin.inference.objectives import Term
from suspension_twin.inference.observation import Observation, observe
from suspension_twin.inference.problem import Data, Interrupted
from suspension_twin.inference.space import Space
from suspension_twin.vehicle.twin import Twin

__all__ = ["drive_fits", "paper_distance"]


def drive_fits(setup: Setup, outcome: SearchOutcome, after: Twin, values: Floats) -> tuple[DriveFit, ...]:
    """Compare every drive of a calibration with the twin as it was and as it is ``after``."""
    found = []
    data = setup.problem.data
    for number, drive in enumerate(setup.drives):
        if setup.problem.simulation.stop():
            raise Interrupted
        given, drive = drive, _displaced(drive, outcome)
        seen = drive
        if given.reading is not None and after.imu != given.twin.imu:
            # another latency or mounting gives other measured signals and another motion; a path that was found by
            # what was felt stays where it was found
            seen = observe(given.reading.drive, after, given.road, given.settings)
            placed = setup.placements[number] is not None
            seen = seen.on(drive.road).on_path(drive.trajectory) if placed else _displaced(seen, outcome)
        sides = [part.simulated(twin) for part, twin in ((drive, setup.original), (seen, after))]
        if not setup.on_road:  # some may validate
            number = next((k for k, part in enumerate(data.parts) if part is drive), -1)
        residual, correlation = _corrected(outcome, number, values)
        found.append(
            DriveFit(
                name=drive.name,
                channel=main_channel(drive.measured),
                gap_before=drive.gap(sides[0]),
                gap_after=seen.gap(sides[1]),
                nuisance_free=residual,
                correlation=correlation,
                rate=drive.rate,
                t=drive.t,
                position=drive.position,
                profile=_profile(drive) if setup.on_road else (drive.position, np.zeros((drive.t.size, 2))),
                measured=dict(seen.measured),
                before=sides[0],
                after=sides[1],
                received=_received(setup, number, given),
                compared=_compared_mask(data, drive, number)
                if setup.on_road
                else np.ones(drive.t.size, dtype=np.bool_),
            )
        )
    return tuple(found)


def _received(setup: Setup, number: int, drive: Observation) -> Floats | None:
    """(m,) m along the road by the receiver, where a drive was placed."""
    place = setup.placements[number] if setup.placements else None
    return None if place is None else drive.displaced(place.t, -place.ahead, -place.left).position


def _displaced(drive: Observation, outcome: SearchOutcome) -> Observation:
    """A whole drive on the road that was found, moved by the receiver's error at the knots of its parts."""
    nuisances, data = outcome.problem.nuisances, outcome.problem.data
    own = [k for k, part in enumerate(data.parts) if part.name == drive.name]
    knots = [nuisances.wander_of(number, outcome.nuisance) for number in own]
    t, ahead = (
        (np.concatenate(columns) for columns in zip(*knots, strict=True)) if knots else (np.empty(0),) * 2
    )
    drive = on_taped_road(drive, nuisances, outcome.nuisance)
    return drive.displaced(t, ahead) if t.size else drive


def _profile(drive: Observation) -> tuple[Floats, Floats]:
    """Distances along the road and the heights of both tracks where the drive went."""
    road, path = drive.road, drive.trajectory
    u, v = road.xy_to_uv(path.x, path.y)
    half = 0.5 * drive.twin.vehicle.front_track
    along = np.arange(
        max(u.min(), road.u_first), min(u.max() + drive.twin.vehicle.wheelbase, road.u_last), road.u_step
    )
    lane = float(np.median(v))
    return along, np.column_stack(
        [road.heights_uv(along, np.full(along.size, lane + side)) for side in (half, -half)]
    )


def paper_distance(setup: Setup, twin: Twin) -> float:
    """The car paper's eq. (1) for ``twin``: Euclidean distance in m/s² between measured and simulated vertical
    acceleration over the compared samples, each drive aligned in time and no other nuisance corrected;
    NaN of controlled runs."""
    if not setup.on_road:
        return float("nan")
    data, distance = setup.problem.data, (Term("euclidean", "vertical_acceleration"),)
    problem, objective = problem_of(
        twin, Space(twin, ()), data, distance, replace(OF_A_CALIBRATION, wander=0.0, tape=0.0)
    )
    nothing = np.zeros((0, 1))
    return float(costs_of(problem, objective, nothing, np.zeros(problem.q), synchronise=True)[0])


def _corrected(outcome: SearchOutcome, number: int, values: Floats) -> tuple[float, float]:
    """Residual rms of one drive's vertical acceleration with the nuisances corrected, and the correlation."""
    problem, data = outcome.problem, outcome.problem.data
    if number not in data.drive_of:  # it validates
        return float("nan"), float("nan")
    signals, _ = problem.signals_of(values[:, None], np.zeros((0, 1)))
    nuisance = (outcome.nuisance - outcome.placed)[:, None]
    simulated = problem.likelihood.compared(signals, nuisance)[:, :, 0]
    column = problem.channels.index(main_channel(problem.channels))
    own = np.concatenate(
        [np.full(rows.size, drive == number) for rows, drive in zip(data.rows, data.drive_of, strict=True)]
    )
    a, b = problem.measured.values[own, column], simulated[own, column]
    return float(np.sqrt(np.mean((a - b) ** 2))), float(np.corrcoef(a, b)[0, 1])


def _compared_mask(data: Data, drive: Observation, number: int) -> NDArray[np.bool_]:
    mask = np.zeros(drive.t.size, dtype=bool)
    for part, rows, owner in zip(data.parts, data.rows, data.drive_of, strict=True):
        if owner == number:
            mask[np.clip(np.searchsorted(drive.t, part.t[rows] - 0.5 / drive.rate), 0, mask.size - 1)] = True
    return mask
