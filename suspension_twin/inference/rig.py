# SPDX-License-Identifier: Apache-2.0
"""From a recorded run of a test rig to what a twin is compared with, and the twin over such a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from suspension_twin.arrays import Floats
from suspension_twin.drive.rig import RigRecord, write_rig
from suspension_twin.errors import InputError, WorkError
from suspension_twin.files import together
from suspension_twin.inference.common_rate import PER_PERIOD
from suspension_twin.inference.gap import Comparison, Gap, main_channel, measure_gap, write_gap
from suspension_twin.inference.noise_floor import floor_rms
from suspension_twin.models.excitation import MAX_STEP, excitation
from suspension_twin.models.parameters import pack
from suspension_twin.models.registry import model_of
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.models.types import Excitation, LaneResponse
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["RigObservation", "RigPath", "SimulatedRun", "observe_rig", "rig_run", "simulate_rig"]


class _Actuator:
    """A road that is the same under all wheels: its height at x m is the displacement at x s."""

    wheel_positions = np.zeros((4, 2))

    def __init__(self, curve: CubicSpline) -> None:
        self._curve = curve

    def heights(self, x: Floats, y: Floats) -> Floats:
        return np.asarray(self._curve(x), dtype=np.float64)


def rig_run(
    t: Floats,
    displacement: Floats | None = None,
    velocity: Floats | None = None,
    force: Floats | None = None,
    max_step: float = MAX_STEP,
) -> Excitation:
    """What a recorded run excites a model with: a road along which it moves at 1 m/s without turning.

    Parameters
    ----------
    t
        (n,) s, rising stamps. After a pause of more than 0.5 s the model starts again from rest.
    displacement, velocity
        (n,) m of the road under the tyre, or its rate in m/s where the displacement was not recorded. Between the
        stamps it follows a cubic spline.
    force
        (n,) N of an actuator between the masses, pushing them apart; linear between the stamps.
    max_step
        s, the largest step of the simulation.

    Raises
    ------
    InputError
        Where there are fewer than four stamps, stamps that do not rise, or values that are not finite.
    """
    t, given = np.asarray(t, dtype=np.float64), displacement if displacement is not None else velocity
    inputs = [x for x in (given, force) if x is not None]
    if given is None or t.ndim != 1 or t.size < 4 or any(np.shape(x) != t.shape for x in inputs):
        raise InputError("rig run", "needs displacement or velocity of the road at four stamps or more")
    if not (np.isfinite([t, *inputs]).all() and (np.diff(t) > 0).all()):
        raise InputError("rig run", "stamps, road and force must be finite, and stamps must rise")
    s, zero = t - t[0], np.zeros(t.size)
    curve = CubicSpline(s, given)
    road = _Actuator(curve if displacement is not None else curve.antiderivative())
    way = Trajectory(t, s, zero, zero, zero + 1.0, zero, zero, zero, zero, np.ones(t.size, dtype=np.bool_))
    run = excitation(way, road, road, max_step)
    return run if force is None else replace(run, motion=np.column_stack([run.motion, force]))


@dataclass(frozen=True, eq=False)
class RigPath:
    """A low-pass, ``rows`` of its grid, and of every signal its mean taken out: zeros of transducers and gravity are
    not compared."""

    path: Conditioner
    rows: slice

    def apply(self, x: ArrayLike) -> Floats:
        """(n, ...) samples at the stamps to (m, ...) on the grid of comparison. Linear; every lane on its own."""
        filtered = self.path.apply(x)[self.rows]
        return np.asarray(filtered - filtered.mean(axis=0))


@dataclass(frozen=True, eq=False)
class RigObservation:
    """One run of a rig, ready for comparison on a uniform grid of m samples.

    ``t`` (m,) s since the run's first stamp; ``excitation`` what drives the model; ``conditioner`` what simulated
    channels (n, C, L) pass, as ``measured`` (m,) of each channel did; ``noise_rms`` its floor.
    """

    name: str
    t: Floats
    rate: float
    bandwidth: float
    excitation: Excitation
    conditioner: RigPath
    measured: dict[str, Floats]
    noise_rms: dict[str, float]
    warnings: tuple[str, ...] = ()


def observe_rig(
    record: RigRecord,
    channels: Sequence[str],
    spec: FilterSpec | None = None,
    max_step: float = MAX_STEP,
) -> RigObservation:
    """A run as an observation of those of a model's ``channels`` that were measured, through the low-pass ``spec``.

    Raises InputError that names the run: too short, too slow for the filter, or with samples missing.
    """
    t, columns, spec = record.t - record.t[0], record.columns, spec or FilterSpec()
    road, speed, force = (
        columns.get(f"{q}") for q in ("road_displacement", "road_velocity", "actuator_force")
    )
    run = rig_run(t, road, speed, force, max_step)
    try:
        path = Conditioner.for_stamps(t, spec)
    except InputError as error:
        raise InputError(record.name, str(error)) from None
    valid = np.flatnonzero(path.valid)
    if valid.size < 2:
        raise InputError(record.name, f"lasts {t[-1]:.2f} s, which is too short for the filter to settle")
    missing = np.flatnonzero(np.diff(valid) > 1)
    if missing.size:
        raise InputError(
            record.name, f"misses samples at {record.t[0] + path.grid[valid[missing[0]]]:.3f} s: cut it"
        )
    every = max(1, int(path.rate / (PER_PERIOD * spec.cutoff) + 1e-6))
    conditioner = RigPath(path, slice(int(valid[0]), int(valid[-1]) + 1, every))
    raw = {name: columns[name] for name in channels if name in columns}
    still = np.zeros(t.size, dtype=np.bool_)
    return RigObservation(
        record.name,
        path.grid[conditioner.rows],
        path.rate / every,
        spec.cutoff,
        run,
        conditioner,
        {name: conditioner.apply(values) for name, values in raw.items()},
        {name: floor_rms(values, path, still) for name, values in raw.items()},
        record.warnings,
    )


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedRun(Comparison):
    """A twin over a run of a rig: its ``response`` at the stamps of ``record``, and the ``gap``."""

    record: RigRecord
    observation: RigObservation
    response: LaneResponse
    gap: Gap

    @property
    def observed(self) -> RigObservation:
        """The recording as it is compared."""
        return self.observation

    @cached_property
    def simulated(self) -> Mapping[str, Floats]:
        """(m,) simulated signal of each channel, m/s² and rad/s."""
        apply, response = self.observation.conditioner.apply, self.response
        return {name: apply(response.channel(name)[:, 0]) for name in self.measured}

    def as_dict(self) -> dict[str, Any]:
        """What ``gap.json`` holds: the gap, and how it was measured."""
        spec = self.observation.conditioner.path.spec
        low_pass = {
            "kind": "Butterworth low-pass",
            "order": spec.order,
            "cutoff_hz": spec.cutoff,
            "zero_phase": True,
        }
        return {**self.gap.as_dict(), "run": self.name, "filter": low_pass, "warnings": list(self.warnings)}

    def write(self, folder: Path) -> None:
        """Write ``gap.json``, and ``simulated.csv`` with the run's own inputs and every simulated channel."""
        inputs = {k: v for k, v in self.record.columns.items() if k not in self.response.names}
        simulated = {name: self.response.channel(name)[:, 0] for name in self.response.names}
        record = RigRecord(self.name, self.record.t, {**inputs, **simulated})
        with together():
            write_rig(record, folder / "simulated.csv", f"simulated over {self.name}")
            write_gap(self.as_dict(), folder)


def simulate_rig(record: RigRecord, twin: Twin) -> SimulatedRun:
    """Simulate ``twin`` over a run and measure the gap; raises as :func:`observe_rig` and ``simulate_twin`` do."""
    observation = observe_rig(record, model_of(twin).channels)
    response = simulate_lanes(twin, pack(twin)[:, None], observation.excitation)
    if response.failed[0]:
        simulate_twin(twin, observation.excitation)  # says why
        raise WorkError(f"{record.name}: the simulation has failed")
    measured = observation.measured
    simulated = {name: observation.conditioner.apply(response.channel(name)[:, 0]) for name in measured}
    everything = np.ones(observation.t.size, dtype=np.bool_)
    floor = observation.noise_rms[main_channel(measured)]
    gap = measure_gap(measured, simulated, everything, observation.rate, floor)
    warnings = list(record.warnings)
    for name, values in measured.items():
        if (
            np.corrcoef(values, simulated[name])[0, 1] < -0.5
        ):  # half or more of it would be explained upside down
            warnings.append(f"{name} looks upside down: upwards and compression are positive")
    return SimulatedRun(record, replace(observation, warnings=tuple(warnings)), response, gap)
