# SPDX-License-Identifier: Apache-2.0
"""What is compared with a model: channels measured over time, and what excited the vehicle meanwhile.

A recorded drive is one (:class:`~suspension_twin.inference.prepare.Prepared`). A controlled run is another: a vehicle
over an obstacle, a corner on a rig. Both have what :class:`Observation` names, and nothing else is asked of either.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import ArrayLike

from suspension_twin.arrays import Floats
from suspension_twin.drive.rig import read_rig
from suspension_twin.errors import InputError
from suspension_twin.inference.gap import Gap, main_channel, measure_gap
from suspension_twin.inference.marker_runs import CUTOFF, FLOORS, MARKERS, MarkerRun, low_pass, read_run
from suspension_twin.inference.nuisance import OF_A_RIG, OF_A_RUN, NuisancePriors
from suspension_twin.inference.rig import observe_rig
from suspension_twin.models.registry import model_of
from suspension_twin.models.tracked import ObstacleRun
from suspension_twin.models.types import Excitation
from suspension_twin.vehicle.twin import Twin

__all__ = ["OBSERVERS", "Observation", "Run", "marker_observation", "observe", "renamed"]

#: Share of an input's rms by which transducers let two runs of one program differ: 0.1 mm of 10 mm.
_SAME_INPUT = 0.01
#: s of a run that are held out together, two periods of a body's resonance; m between the places of two programs.
_BLOCK, _APART = 2.0, 1e4


class Conditioning(Protocol):
    """The linear path from simulated samples to the grid of comparison."""

    def apply(self, x: ArrayLike) -> Floats:
        """(n, ...) samples to (m, ...)."""


class Observation(Protocol):
    """A drive or run of m samples on a uniform grid, n simulated stamps and C channels."""

    @property
    def name(self) -> str: ...
    @property
    def t(self) -> Floats:
        """(m,) s, the grid."""

    @property
    def rate(self) -> float:
        """Samples a second."""

    @property
    def bandwidth(self) -> float:
        """Cut-off in Hz of the low-pass that both sides went through."""

    @property
    def excitation(self) -> Any:
        """What the model is driven by."""

    @property
    def conditioner(self) -> Conditioning: ...
    @property
    def measured(self) -> Mapping[str, Floats]:
        """(m,) of every channel."""

    @property
    def noise_rms(self) -> Mapping[str, float]:
        """Floor of every channel."""

    @property
    def position(self) -> Floats:
        """(m,) m along the road."""

    @property
    def along(self) -> Floats:
        """(m,) m/s, its rate."""

    @property
    def warnings(self) -> tuple[str, ...]: ...


@dataclass(frozen=True, eq=False)
class RunPath:
    """Low-pass without delay at ``rate`` Hz, and the samples from ``first`` on, ``count`` of them."""

    rate: float
    first: int
    count: int
    filter: Callable[[Floats, float], Floats]

    def apply(self, x: ArrayLike) -> Floats:
        """(n, ...) samples to (count, ...)."""
        smooth = self.filter(np.asarray(x, dtype=np.float64), self.rate)
        return np.ascontiguousarray(smooth[self.first : self.first + self.count])


@dataclass(frozen=True, eq=False)
class Run:
    """A controlled run: the same excitation can be had again, so that runs before and after a change differ by it.

    ``priors`` of its nuisance parameters; ``block`` m of ``position`` whose samples are held out together.
    """

    name: str
    t: Floats
    rate: float
    bandwidth: float
    excitation: Any
    conditioner: Conditioning
    measured: Mapping[str, Floats]
    noise_rms: Mapping[str, float]
    position: Floats
    along: Floats
    warnings: tuple[str, ...] = ()
    priors: NuisancePriors = OF_A_RUN
    block: float = 0.5
    position_sigma: float = 0.0

    def gap(self, simulated: Mapping[str, Floats]) -> Gap:
        """The gap to conditioned channels."""
        everything = np.ones(self.t.size, dtype=np.bool_)
        return measure_gap(
            self.measured, simulated, everything, self.rate, self.noise_rms[main_channel(self.measured)]
        )


def marker_observation(run: MarkerRun, known: Sequence[Run] = ()) -> Run:
    """A run with markers; repeats at one speed share the excitation of one in ``known``, so that they are simulated
    once."""
    channels = np.concatenate([run.markers, run.velocity, run.acceleration], axis=1)
    names = [f"marker_{m}_{kind}" for kind in ("displacement", "velocity", "acceleration") for m in MARKERS]
    seen = np.tile(run.seen, 3)
    last = round(float(run.t[-1]) * run.rate)
    excitation = next(
        (k.excitation for k in known if k.excitation.speed == run.speed and len(k.excitation) > last),
        ObstacleRun(np.arange(last + 1) / run.rate, run.speed),
    )
    return Run(
        name=run.name,
        t=run.t,
        rate=run.rate,
        bandwidth=CUTOFF,
        excitation=excitation,
        conditioner=RunPath(run.rate, round(float(run.t[0]) * run.rate), run.t.size, low_pass),
        measured={n: channels[:, i] for i, n in enumerate(names) if seen[i]},
        noise_rms={n: float(FLOORS[i]) for i, n in enumerate(names) if seen[i]},
        position=run.speed * run.t,
        along=np.full(run.t.size, run.speed),
    )


def _markers(twin: Twin, paths: Sequence[str]) -> list[Run]:
    read = [read_run(p, twin.vehicle) for p in paths]
    runs: dict[int, Run] = {}
    for i in sorted(
        range(len(read)), key=lambda i: -read[i].t[-1]
    ):  # the longest first: the others are a part of it
        runs[i] = marker_observation(read[i], list(runs.values()))
    return [runs[i] for i in range(len(read))]


def _rig(twin: Twin, paths: Sequence[str]) -> list[Run]:
    """Runs of one program share an excitation; all inputs and transducers have one clock."""
    found: list[Run] = []
    programs: list[Excitation] = []
    for path in paths:
        one = observe_rig(read_rig(path), model_of(twin).channels)
        program = next(
            (k for k, known in enumerate(programs) if _one_program(known, one.excitation)), len(programs)
        )
        if program == len(programs):
            programs.append(one.excitation)
        found.append(
            Run(
                name=one.name,
                t=one.t,
                rate=one.rate,
                bandwidth=one.bandwidth,
                excitation=programs[program],
                conditioner=one.conditioner,
                measured=one.measured,
                noise_rms=one.noise_rms,
                position=one.t + program * _APART,
                along=np.ones(one.t.size),
                warnings=one.warnings,
                priors=OF_A_RIG,
                block=_BLOCK,
            )
        )
    return found


def _one_program(one: Excitation, other: Excitation) -> bool:
    """Whether two runs had the same inputs but for the noise of their transducers."""
    if one.motion.shape != other.motion.shape:
        return False
    inputs = ([run.road[:, 0], *run.motion.T[7:]] for run in (one, other))
    return all(float(np.std(a - b)) <= _SAME_INPUT * float(np.std(a)) for a, b in zip(*inputs, strict=True))


#: How runs of each kind of recording are read: a model says which kind it has.
OBSERVERS: Final[dict[str, Callable[[Twin, Sequence[str]], list[Run]]]] = {"markers": _markers, "rig": _rig}


def observe(twin: Twin, paths: Sequence[str]) -> list[Run]:
    """Read controlled runs of a twin; InputError that names the file, or the model whose recordings are drives."""
    reader = OBSERVERS.get(model_of(twin).recordings)
    if reader is None:
        raise InputError("twin", "model", f"{twin.model} is compared with recorded drives")
    return renamed(reader(twin, paths))


def renamed(observations: Sequence[Any]) -> list[Any]:
    """Observations of one name get a number, so that each nuisance parameter has a name of its own."""
    names: list[str] = []
    for one in observations:
        name, k = one.name, 2
        while name in names:
            name, k = f"{one.name}_{k}", k + 1
        names.append(name)
    return [o if o.name == n else replace(o, name=n) for o, n in zip(observations, names, strict=True)]
