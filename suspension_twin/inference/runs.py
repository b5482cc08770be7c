# SPDX-License-Identifier: Apache-2.0
"""Controlled runs: a corner on a test rig, or a tracked vehicle over an obstacle, as observations.

A run can be repeated with the same excitation, so that runs before and after a change differ by it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from suspension_twin.arrays import Floats
from suspension_twin.drive.rig import HUBS, QUANTITIES, RigRecord, driven_by_wheel, read_rig, write_rig
from suspension_twin.errors import InputError, WorkError
from suspension_twin.files import together
from suspension_twin.inference.gap import Comparison, Gap, write_gap
from suspension_twin.inference.linear_corner import CORNER_CHANNELS, LinearCorner, linear_corner
from suspension_twin.inference.marker_runs import CUTOFF, FLOORS, MARKERS, MarkerRun, low_pass, read_run
from suspension_twin.inference.nuisance import OF_A_RIG, OF_A_RUN, NuisancePriors
from suspension_twin.inference.observation import Grid, Observation, Usage, renamed
from suspension_twin.models.excitation import MAX_STEP, MOTION, excitation
from suspension_twin.models.parameters import pack
from suspension_twin.models.registry import model_of
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.models.tracked import ObstacleRun
from suspension_twin.models.types import Excitation, LaneResponse
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.clock import find_gaps, nominal_rate
from suspension_twin.signals.common_rate import PER_PERIOD
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.signals.noise_floor import spectral_floor
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "SimulatedRun",
    "is_actuated",
    "marker_observation",
    "observe_rig",
    "observe_runs",
    "repeats",
    "rig_run",
    "simulate_rig",
]

#: Share of an input's rms by which transducers let two runs of one program differ: 0.1 mm of 10 mm.
_SAME_INPUT = 0.01
#: The same for an actuator that repeats a program as well as it can: 3 to 10 % on rigs, 140 % between two programs.
_SAME_PROGRAM = 0.3
#: s: two periods of a body on its springs (1 Hz), beyond which residuals are independent, and as much of a rig run is
#: held out together.
TWO_PERIODS = 2.0
#: Stamps of a simulation for each of the comparison's grid, and how many times more a logger has to give before it is
#: worth the resampling.
_DENSE, _WORTHWHILE = 2.0, 1.26
#: Share of the weight of the main channel in a fit that all other channels have together: it is what a twin is judged
#: by, they settle what it does not show.
_BESIDE = 0.25
#: Standard deviations of the gain of an actuator's force from which on its sign is certain.
_SURE = 3.0
#: Correlation from which on two transducers saw one motion, and the factor between them from which on it is no gain: a
#: calibration is off by some per cent, the nearest wrong unit (feet) by 3.3.
_ALIKE, _OTHER_UNIT = 0.9, 2.0
_OBSTACLE_BLOCK = 0.5  # m of an obstacle run that is held out together
#: m between the places of two programs.
_APART = 1e4


#: What the road under a wheel is measured as.
_INPUTS: Final = ("road_displacement", "road_velocity")


class _Actuator:
    """A road that is the same under all wheels, or one under each: its height at x m is the displacement at x s."""

    wheel_positions = np.zeros((4, 2))

    def __init__(self, curve: CubicSpline) -> None:
        self._curve = curve

    def heights(self, x: Floats, y: Floats) -> Floats:
        return np.asarray(self._curve(x[..., 0] if self._curve.c.ndim > 2 else x), dtype=np.float64)


def rig_run(
    t: Floats,
    displacement: Floats | None = None,
    velocity: Floats | None = None,
    force: Floats | None = None,
    max_step: float = MAX_STEP,
) -> Excitation:
    """Excitation of a model by a recorded run: a road along which it moves at 1 m/s without turning.

    Parameters
    ----------
    t
        (n,) s, rising stamps. After a pause of more than 0.5 s the model starts again from rest.
    displacement, velocity
        (n,) m of the road under the tyre, or its rate in m/s where the displacement was not recorded; (n, 4) of one
        under each wheel. Between the stamps it follows a cubic spline.
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
    if given is None or t.ndim != 1 or t.size < 4 or any(len(x) != t.size for x in inputs):
        raise InputError("rig run", "needs displacement or velocity of the road at four stamps or more")
    if not (all(np.isfinite(x).all() for x in (t, *inputs)) and (np.diff(t) > 0).all()):
        raise InputError("rig run", "stamps, road and force must be finite, and stamps must rise")
    s, zero = t - t[0], np.zeros(t.size)
    curve = CubicSpline(s, given)
    road = _Actuator(curve if displacement is not None else curve.antiderivative())
    ahead, still = np.column_stack([zero + 1.0, zero]), np.zeros((t.size, 2))
    way = Trajectory(t, s, zero, zero, ahead, zero, still, np.ones(t.size, dtype=np.bool_))
    run = excitation(way, road, road, max_step)
    return run if force is None else replace(run, motion=np.column_stack([run.motion, force]))


def observe_rig(
    record: RigRecord,
    channels: Sequence[str],
    spec: FilterSpec | None = None,
    max_step: float = MAX_STEP,
) -> Observation:
    """A run as an observation of those of a model's ``channels`` that were measured, through the low-pass ``spec``.

    The mean of every signal is taken out: zeros of transducers and gravity are not compared. Raises InputError that
    names the run: too short, too slow for the filter, or with samples missing.
    """
    t, columns, spec = record.t - record.t[0], record.columns, spec or FilterSpec()
    road, speed, force = (_input(columns, q) for q in (*_INPUTS, "actuator_force"))
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
    rows = slice(int(valid[0]), int(valid[-1]) + 1, every)

    def apply(x: ArrayLike) -> Floats:
        filtered = path.apply(x)[rows]
        return np.asarray(filtered - filtered.mean(axis=0))

    derived = ((name, record.channel(name)) for name in channels)
    raw = {name: values for name, values in derived if values is not None}
    if not raw:
        raise InputError(record.name, channels[0], "is missing, and so is all else that the twin simulates")
    found = _run(
        record.name,
        run,
        {name: apply(values) for name, values in raw.items()},
        {name: spectral_floor(values, path) for name, values in raw.items()},
        _grid(path.grid[rows], path.rate / every, spec.cutoff, apply, 1.0),
        priors=OF_A_RIG,
        block=TWO_PERIODS,
    )
    return replace(found, warnings=(*record.warnings, *_contradictions(record, apply)))


def _input(columns: Mapping[str, Floats], quantity: str) -> Floats | None:
    """(n,) an input of a run, (n, 4) where each wheel has its own; None where it was not measured."""
    found = [values for name, values in columns.items() if name.endswith(quantity)]
    return np.column_stack(found) if len(found) > 1 else next(iter(found), None)


def _contradictions(record: RigRecord, apply: Callable[[ArrayLike], Floats]) -> list[str]:
    """Channels that move as other columns of the run say, but by another factor: a unit or a sign is wrong."""
    found = []
    for name in CORNER_CHANNELS:
        others = replace(record, columns={k: v for k, v in record.columns.items() if k != name})
        derived = others.channel(name)
        if name not in record.columns or derived is None:
            continue
        measured, said = apply(record.columns[name]), apply(derived)
        factor = float(measured @ said) / max(float(said @ said), 1e-300)
        alike = abs(float(np.corrcoef(measured, said)[0, 1])) > _ALIKE if np.ptp(measured) > 0.0 else False
        if alike and not 1.0 / _OTHER_UNIT < factor < _OTHER_UNIT:
            words = f"{factor:.2g} times what the displacements of body and wheel say"
            found.append(f"{name} is {words}: a unit or a sign is another than its column says")
    return found


def _on_coarse_stamps(record: RigRecord, channels: Sequence[str]) -> RigRecord:
    """The run with the channels that it holds on stamps dense enough for the comparison: fast loggers are low-passed,
    inputs and responses alike, and sampled more slowly. One with a pause stays as it is."""
    rate, target = nominal_rate(record.t), _DENSE * PER_PERIOD * FilterSpec().cutoff
    derived = {name: values for name in channels if (values := record.channel(name)) is not None}
    columns = {**record.columns, **derived}
    if rate <= _WORTHWHILE * target or len(find_gaps(record.t, rate)):
        return replace(record, columns=columns)
    path = Conditioner.for_stamps(record.t, FilterSpec(4, 0.4 * target))
    t = np.arange(record.t[0], record.t[-1], 1.0 / target)
    slower = {}
    for name, values in columns.items():
        # the filter starts from zero
        smooth = path.apply(values - values[0]) + values[0]
        slower[name] = np.asarray(CubicSpline(path.grid, smooth)(t))
    return replace(record, t=t, columns=slower)


def _grid(t: Floats, rate: float, cutoff: float, apply: Callable[[ArrayLike], Floats], speed: float) -> Grid:
    """The grid of a run at a constant speed in m/s, all samples of which are compared."""
    everything = np.ones(t.size, dtype=np.bool_)
    along = np.full(t.size, speed)
    return Grid(
        t=t, rate=rate, bandwidth=cutoff, apply=apply, position=speed * t, along=along, mask=everything
    )


def _run(
    name: str,
    driven: Excitation | ObstacleRun,
    measured: dict[str, Floats],
    noise_rms: dict[str, float],
    grid: Grid,
    *,
    priors: NuisancePriors,
    block: float,
) -> Observation:
    """A run with the priors of its nuisance parameters; ``block`` m of the position are held out together."""
    names = tuple(measured)
    place = np.floor(grid.position / block).astype(np.intp)
    usage = Usage(names, names, priors, place)
    return Observation(
        **vars(grid), name=name, excitation=driven, measured=measured, noise_rms=noise_rms, usage=usage
    )


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedRun(Comparison):
    """A twin over a run of a rig: its ``response`` at the stamps of ``record``, and the ``gap``."""

    record: RigRecord
    observation: Observation
    response: LaneResponse
    gap: Gap

    @cached_property
    def simulated(self) -> Mapping[str, Floats]:
        """(m,) simulated signal of each channel, m/s² and rad/s."""
        apply, response = self.observation.apply, self.response
        return {name: apply(response.channel(name)[:, 0]) for name in self.measured}

    def as_dict(self) -> dict[str, Any]:
        """The content of ``gap.json``: the gap, and how it was measured."""
        spec = FilterSpec()
        low_pass = {
            "kind": "Butterworth low-pass",
            "order": spec.order,
            "cutoff_hz": spec.cutoff,
            "zero_phase": True,
        }
        return {**self.gap.as_dict(), "run": self.name, "filter": low_pass, "warnings": list(self.warnings)}

    def write(self, folder: Path) -> None:
        """Write ``gap.json``, and ``simulated.csv`` with the run's own inputs and every simulated channel."""
        known = [name for name in self.response.names if name in QUANTITIES]
        inputs = {k: v for k, v in self.record.columns.items() if k not in known}
        simulated = {name: self.response.channel(name)[:, 0] for name in known}
        record = RigRecord(self.name, self.record.t, {**inputs, **simulated})
        with together():
            write_rig(record, folder / "simulated.csv", f"simulated over {self.name}")
            write_gap(self.as_dict(), folder)


def input_of(twin: Twin, record: RigRecord) -> RigRecord:
    """A run with what drives the twin as its road: the road, or the measured motion of the wheel."""
    if twin.on_wheel:
        return driven_by_wheel(record, ("",) if len(twin.joint_names) == 1 else HUBS)
    if not set(_INPUTS) & set(record.columns):
        raise InputError(record.name, "has no road: the twin file has to say excitation: wheel")
    return record


def simulate_rig(record: RigRecord, twin: Twin) -> SimulatedRun:
    """Simulate ``twin`` over a run and measure the gap; raises as :func:`observe_rig` and ``simulate_twin`` do."""
    driven = input_of(twin, record)
    observation = observe_rig(driven, model_of(twin).channels)
    response = simulate_lanes(twin, pack(twin)[:, None], observation.excitation)
    if response.failed[0]:
        simulate_twin(twin, observation.road_excitation)  # says why
        raise WorkError(f"{record.name}: the simulation has failed")
    measured = observation.measured
    simulated = {name: observation.apply(response.channel(name)[:, 0]) for name in measured}
    # of correlation -0.5 half or more of the signal would be explained upside down
    reversed_signs = [n for n, v in measured.items() if np.corrcoef(v, simulated[n])[0, 1] < -0.5]
    signs = (f"{name} looks upside down: upwards and compression are positive" for name in reversed_signs)
    observation = replace(observation, warnings=(*record.warnings, *signs))
    return SimulatedRun(record, observation, response, observation.gap(simulated))


def marker_observation(run: MarkerRun, known: Sequence[Observation] = ()) -> Observation:
    """A run with markers; repeats at one speed share the excitation of one in ``known``, so that they are simulated
    once."""
    channels = np.concatenate([run.markers, run.velocity, run.acceleration], axis=1)
    names = [f"marker_{m}_{kind}" for kind in ("displacement", "velocity", "acceleration") for m in MARKERS]
    seen = np.tile(run.seen, 3)
    last = round(float(run.t[-1]) * run.rate)
    same = (k.excitation for k in known if isinstance(k.excitation, ObstacleRun))
    driven = next(
        (e for e in same if e.speed == run.speed and len(e) > last),
        ObstacleRun(np.arange(last + 1) / run.rate, run.speed),
    )
    first, count, rate = round(float(run.t[0]) * run.rate), run.t.size, run.rate

    def apply(x: ArrayLike) -> Floats:
        smooth = low_pass(np.asarray(x, dtype=np.float64), rate)
        return np.ascontiguousarray(smooth[first : first + count])

    return _run(
        run.name,
        driven,
        {n: channels[:, i] for i, n in enumerate(names) if seen[i]},
        {n: float(FLOORS[i]) for i, n in enumerate(names) if seen[i]},
        _grid(run.t, rate, CUTOFF, apply, run.speed),
        priors=OF_A_RUN,
        block=_OBSTACLE_BLOCK,
    )


def _markers(twin: Twin, paths: Sequence[str]) -> list[Observation]:
    read = [read_run(p, twin.vehicle) for p in paths]
    runs: dict[int, Observation] = {}
    # the longest first: the others are a part of it
    for i in sorted(range(len(read)), key=lambda i: -read[i].t[-1]):
        runs[i] = marker_observation(read[i], list(runs.values()))
    return [runs[i] for i in range(len(read))]


def _rig(twin: Twin, paths: Sequence[str]) -> list[Observation]:
    """Runs of one program have one place, and share an excitation where transducers alone let it differ; all inputs and
    transducers have one clock."""
    found: list[Observation] = []
    programs: list[Excitation] = []
    known: list[Excitation] = []
    channels = model_of(twin).channels
    for path in paths:
        one = observe_rig(_on_coarse_stamps(input_of(twin, read_rig(path)), channels), channels)
        driven = one.excitation
        assert isinstance(driven, Excitation)
        program = next(
            (k for k, one in enumerate(programs) if _apart(one, driven) <= _SAME_PROGRAM), len(programs)
        )
        if program == len(programs):
            programs.append(driven)
        driven = next((one for one in known if _apart(one, driven) <= _SAME_INPUT), driven)
        known.append(driven)
        place = one.t + program * _APART
        block = np.floor(place / TWO_PERIODS).astype(np.intp)
        found.append(
            replace(
                one,
                excitation=driven,
                position=place,
                usage=replace(one.usage, block=block),
            )
        )
    return beside_linear(found)


def beside_linear(runs: Sequence[Observation]) -> list[Observation]:
    """Runs as they are, those of a corner with the residual of a linear model of all of them: it caps the noise, and a
    fit counts each channel in units of it.

    One set of transducers has one noise: a floor counts motion as noise, so the least is it.
    """
    channels = [c for c in CORNER_CHANNELS if all(c in run.measured for run in runs)]
    if not channels:
        return list(runs)
    corner, sign = linear_corner(runs, channels)
    beside = np.sqrt(max(len(channels) - 1, 1) / _BESIDE)
    turned = [_reversed(runs, corner, channels[0])] if sign < -_SURE else []
    found = []
    known = {c for run in runs for c in run.noise_rms}
    least = {c: min(run.noise_rms[c] for run in runs if c in run.noise_rms) for c in known}
    for run in runs:
        simulated = corner.signals(run)
        left = {c: float(np.std(run.measured[c] - simulated[c])) for c in channels}
        floors = {c: min(least[c], left.get(c, least[c])) for c in run.noise_rms}
        unit = {c: rms if c == channels[0] else beside * rms for c, rms in left.items()}
        usage = replace(run.usage, unit=unit)
        warnings = (*run.warnings, *turned)
        found.append(replace(run, noise_rms=floors, usage=usage, warnings=warnings))
    return found


def _reversed(runs: Sequence[Observation], corner: LinearCorner, channel: str) -> str:
    """The warning of a force of the other sign, with what a linear ``corner`` explains of ``channel`` by either."""

    def explained(model: LinearCorner) -> str:
        left = sum(float(np.var(run.measured[channel] - model.signals(run)[channel])) for run in runs)
        return f"{100.0 * (1.0 - left / sum(float(np.var(run.measured[channel])) for run in runs)):.0f} %"

    up = replace(corner, force=-corner.force)
    return (
        f"actuator_force acts the other way round: a linear model explains {explained(corner)} of the "
        f"{channel.replace('_', ' ')} where the force pushes the body down, {explained(up)} where it pushes it up as "
        "recorded. Write sign: -1 for actuator_force into the mapping file, or turn the column"
    )


def repeats(one: Observation, other: Observation) -> bool:
    """Whether two runs are of one program."""
    if isinstance(one.excitation, ObstacleRun) or isinstance(other.excitation, ObstacleRun):
        return one.excitation is other.excitation
    return bool(one.position[0] // _APART == other.position[0] // _APART)


def _apart(one: Excitation, other: Excitation) -> float:
    """Rms by which the inputs of two runs differ as a share of their own; infinite where their stamps do."""
    if one.motion.shape != other.motion.shape or one.road.shape != other.road.shape:
        return float("inf")
    if np.abs(one.t - other.t).max() > 0.5 * float(np.median(np.diff(one.t))):
        return float("inf")
    inputs = ([*run.road.T, *run.motion.T[len(MOTION) :]] for run in (one, other))
    return max(float(np.std(a - b)) / max(float(np.std(a)), 1e-12) for a, b in zip(*inputs, strict=True))


def is_actuated(run: Observation) -> bool:
    """Whether a run has a known force between the masses."""
    return isinstance(run.excitation, Excitation) and run.excitation.motion.shape[1] > len(MOTION)


#: How runs of each kind of recording are read: a model says which kind it has.
_READERS: Final[dict[str, Callable[[Twin, Sequence[str]], list[Observation]]]] = {
    "markers": _markers,
    "rig": _rig,
}


def observe_runs(twin: Twin, paths: Sequence[str]) -> list[Observation]:
    """Read controlled runs of a twin; InputError that names the file, or the model whose recordings are drives."""
    reader = _READERS.get(model_of(twin).recordings)
    if reader is None:
        raise InputError("twin", "model", f"{twin.model} is compared with recorded drives")
    return renamed(reader(twin, paths))
