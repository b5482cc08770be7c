# SPDX-License-Identifier: Apache-2.0
"""From a recorded run of a test rig to what a twin is compared with, and the twin over such a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from suspension_twin.arrays import Floats
from suspension_twin.drive.rig import RigRecord, write_rig
from suspension_twin.errors import InputError, WorkError
from suspension_twin.gap.measure import Gap, measure_gap, write_gap
from suspension_twin.gap.noise import floor_rms
from suspension_twin.models.excitation import MAX_STEP, excitation
from suspension_twin.models.parameters import pack
from suspension_twin.models.registry import model_of
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.models.types import Excitation, LaneResponse
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["CentredConditioner", "RigObservation", "SimulatedRun", "observe_rig", "rig_run", "simulate_rig"]


class _Actuator:
    """A road that is the same under all wheels: its height at x m is the displacement at x s."""

    wheel_positions = np.zeros((4, 2))

    def __init__(self, curve: CubicSpline) -> None:
        self._curve = curve

    def heights(self, x: Floats, y: Floats) -> Floats:
        return np.asarray(self._curve(x), dtype=np.float64)


def rig_run(
    t: Floats, displacement: Floats | None = None, velocity: Floats | None = None, max_step: float = MAX_STEP
) -> Excitation:
    """What a recorded run excites a model with: a road along which it moves at 1 m/s without turning.

    Parameters
    ----------
    t
        (n,) s, rising stamps. After a pause of more than 0.5 s the model starts again from rest.
    displacement, velocity
        (n,) m of the road under the tyre, or its rate in m/s where the displacement was not recorded. Between the
        stamps it follows a cubic spline.
    max_step
        s, the largest step of the simulation.

    Raises
    ------
    InputError
        Where there are fewer than four stamps, stamps that do not rise, or values that are not finite.
    """
    t, given = np.asarray(t, dtype=np.float64), displacement if displacement is not None else velocity
    if t.ndim != 1 or t.size < 4 or given is None or np.shape(given) != t.shape:
        raise InputError("rig run", "needs displacement or velocity of the road at four stamps or more")
    if not (np.isfinite(t).all() and np.isfinite(given).all() and (np.diff(t) > 0).all()):
        raise InputError("rig run", "stamps and road must be finite, and stamps must rise")
    s, zero = t - t[0], np.zeros(t.size)
    curve = CubicSpline(s, given)
    road = _Actuator(curve if displacement is not None else curve.antiderivative())
    way = Trajectory(t, s, zero, zero, zero + 1.0, zero, zero, zero, zero, np.ones(t.size, dtype=np.bool_))
    return excitation(way, road, road, max_step)


@dataclass(frozen=True, eq=False)
class CentredConditioner:
    """A low-pass, and of every signal its mean taken out: zeros of transducers and gravity are not compared."""

    path: Conditioner

    def apply(self, x: Floats) -> Floats:
        """(n, ...) samples at the stamps to (m, ...) on the uniform grid. Linear; every lane on its own."""
        filtered = self.path.apply(x)
        return np.asarray(filtered - filtered[self.path.valid].mean(axis=0))


@dataclass(frozen=True, eq=False)
class RigObservation:
    """One run of a rig, ready for comparison on a uniform grid of m samples.

    ``t`` (m,) s; ``rate`` Hz; ``excitation`` what drives the model; ``conditioner`` what simulated channels
    (n, C, L) pass, as ``measured`` (m,) of each channel did; ``noise_rms`` its floor; ``position`` (m,) s since the
    start; ``mask`` (m,) where a comparison means something.
    """

    name: str
    t: Floats
    rate: float
    excitation: Excitation
    conditioner: CentredConditioner
    measured: dict[str, Floats]
    noise_rms: dict[str, float]
    position: Floats
    mask: NDArray[np.bool_]
    warnings: tuple[str, ...] = ()


def observe_rig(
    record: RigRecord,
    channels: tuple[str, ...],
    spec: FilterSpec | None = None,
    max_step: float = MAX_STEP,
) -> RigObservation:
    """A run as an observation of those of a model's ``channels`` that were measured, through the low-pass ``spec``.

    Raises InputError that names the run: too short, or too slow for the filter.
    """
    road, speed = (record.columns.get(f"road_{kind}") for kind in ("displacement", "velocity"))
    run = rig_run(record.t, road, speed, max_step)
    try:
        path = Conditioner.for_stamps(record.t, spec or FilterSpec())
    except InputError as error:
        raise InputError(record.name, str(error)) from None
    if not path.valid.any():
        raise InputError(
            record.name, f"lasts {np.ptp(record.t):.2f} s, which is too short for the filter to settle"
        )
    conditioner = CentredConditioner(path)
    raw = {name: record.columns[name] for name in channels if name in record.columns}
    still = np.zeros(record.t.size, dtype=np.bool_)
    return RigObservation(
        record.name,
        path.grid,
        path.rate,
        run,
        conditioner,
        {name: conditioner.apply(values) for name, values in raw.items()},
        {name: floor_rms(values, path, still) for name, values in raw.items()},
        path.grid - path.grid[0],
        path.valid,
        record.warnings,
    )


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A twin over a run of a rig: its ``response`` at the stamps of ``record``, and the ``gap``."""

    record: RigRecord
    observation: RigObservation
    response: LaneResponse
    gap: Gap
    warnings: tuple[str, ...]

    @property
    def name(self) -> str:
        """Of the run."""
        return self.record.name

    @property
    def noise_rms(self) -> Mapping[str, float]:
        """Floor of each channel of the gap."""
        return self.observation.noise_rms

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

    def write(self, folder: Path) -> Path:
        """Write ``gap.json``, and ``simulated.csv`` with the run's own inputs and every simulated channel."""
        write_gap(self.as_dict(), folder)
        inputs = {k: v for k, v in self.record.columns.items() if k not in self.response.names}
        simulated = {name: self.response.channel(name)[:, 0] for name in self.response.names}
        file = folder / "simulated.csv"
        write_rig(
            RigRecord(self.name, self.record.t, {**inputs, **simulated}), file, f"simulated over {self.name}"
        )
        return file


def simulate_rig(record: RigRecord, twin: Twin) -> SimulatedRun:
    """Simulate ``twin`` over a run and measure the gap; raises as :func:`observe_rig` and ``simulate_twin`` do."""
    observation = observe_rig(record, model_of(twin).channels)
    response = simulate_lanes(twin, pack(twin)[:, None], observation.excitation)
    if response.failed[0]:
        simulate_twin(twin, observation.excitation)  # says why
        raise WorkError(f"{record.name}: the simulation has failed")
    simulated = {
        name: observation.conditioner.apply(response.channel(name)[:, 0]) for name in observation.measured
    }
    gap = measure_gap(
        observation.measured, simulated, observation.mask, observation.rate, observation.noise_rms
    )
    warnings = list(record.warnings)
    for name, values in observation.measured.items():
        if (
            np.corrcoef(values, simulated[name])[0, 1] < -0.5
        ):  # half or more of it would be explained upside down
            warnings.append(f"{name} looks upside down: upwards and compression are positive")
    return SimulatedRun(record, observation, response, gap, tuple(warnings))
