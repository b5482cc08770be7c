# SPDX-License-Identifier: Apache-2.0
"""Cars, as ``full_car`` and ``msd`` take them: their numbers, channels, characteristics and kernels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.models import rows
from suspension_twin.models.hooks import CornerChange, RoadChange, Values
from suspension_twin.models.parts import OPTIONAL_PARTS, has_part
from suspension_twin.models.registry import Model, deferred
from suspension_twin.models.rows import Hinges
from suspension_twin.models.types import Ints
from suspension_twin.vehicle.corners import AXLES
from suspension_twin.vehicle.twin import Damper, Spring, Twin

__all__ = [
    "CHANNELS",
    "PARTS",
    "Block",
    "Candidates",
    "CarKernel",
    "Characteristics",
    "LaneFunctions",
    "Numbers",
    "Problems",
    "StrutCharacteristics",
    "Walk",
    "car_kernel",
    "car_model",
    "compression_at",
    "hinges_of",
    "points",
    "read_characteristics",
    "shorten_spring",
    "write_curves",
]

Numbers = dict[str, Floats]

#: What an IMU in a car measures, in base_link axes; vertical acceleration without gravity.
CHANNELS = (
    "vertical_acceleration",
    "roll_rate",
    "pitch_rate",
    "longitudinal_acceleration",
    "lateral_acceleration",
    "yaw_rate",
)
_SCALARS = (
    "vehicle.mass",
    "vehicle.wheelbase",
    "vehicle.front_track",
    "vehicle.rear_track",
    "vehicle.cog.0",
    "vehicle.cog.1",
    "vehicle.cog.2",
    "vehicle.sprung_inertia.roll",
    "vehicle.sprung_inertia.pitch",
    "vehicle.tyre.radius",
    "vehicle.tyre.vertical_stiffness",
    "vehicle.front.unsprung_mass",
    "vehicle.rear.unsprung_mass",
    "imu.position.0",
    "imu.position.1",
    "imu.position.2",
    "imu.latency",
)
#: The road heights were looked up for these: a candidate cannot differ in them.
_FIXED = ("vehicle.wheelbase", "vehicle.front_track", "vehicle.rear_track")
#: Parts of a strut that have a characteristic, and the abscissa of each.
PARTS = (("spring", "compression"), ("damper_push", "velocity"), ("damper_pull", "velocity"))


def points(curve: Spring | Damper, prefix: str, abscissa: str) -> list[str]:
    """Keys of the points of a characteristic that the twin file has under ``prefix``."""
    return [f"{prefix}.{quantity}.{j}" for quantity in (abscissa, "force") for j in range(len(curve.force))]


def numbers(twin: Twin) -> tuple[str, ...]:
    """Keys of the numbers of a car: scalars, the points of its characteristics, then its optional parts."""
    names = list(_SCALARS)
    for axle in AXLES:
        for part, abscissa in PARTS:
            curve = getattr(getattr(twin.vehicle, axle), part)
            names += points(curve, f"vehicle.{axle}.{part}", abscissa)
    given = (key for part in OPTIONAL_PARTS.values() for key in part.keys.values())
    return (*names, *(key for key in given if has_part(twin, key)))


def car_model(name: str, title: str) -> Model:
    """The entry of a car's model in the registry."""
    return Model(
        name=name,
        title=title,
        recordings="drive",
        channels=CHANNELS,
        numbers=numbers,
        lanes=deferred("simulate", "car_lanes"),
        fixed=_FIXED,
        respond=deferred("simulate", "car_response"),
        live=deferred("live", "LiveTwin"),
        one_lane=deferred("one_lane", "one_lane"),
    )


@dataclass(frozen=True, eq=False)
class Problems:
    """Reasons why some of ``count`` lanes cannot be simulated: masks (L,), keys of the twin and sentences."""

    count: int
    found: list[tuple[NDArray[np.bool_], str, str]] = field(default_factory=list)

    def check(self, bad: NDArray[np.bool_] | np.bool_, key: str, sentence: str) -> None:
        """Add a mask of bad lanes, a key and a sentence, if any lane is bad."""
        if bad.any():
            self.found.append((np.asarray(bad), key, sentence))

    def check_finite(self, numbers: Numbers) -> None:
        """Add every number that is not finite."""
        if not np.isfinite(np.stack(list(numbers.values()))).all():
            for name, values in numbers.items():
                self.check(~np.isfinite(values), name, "is not finite")

    @property
    def lanes(self) -> NDArray[np.bool_]:
        """(L,) lanes that have any of the problems."""
        out = np.zeros(self.count, dtype=np.bool_)
        for mask, _, _ in self.found:
            out |= mask
        return out

    def raise_first(self, lane: int = 0) -> None:
        """Raise the first problem of a lane as the error that a user sees."""
        for mask, key, sentence in self.found:
            if mask[lane]:
                raise InputError("twin", key, sentence)


@dataclass(frozen=True, eq=False)
class Characteristic:
    """One characteristic for L lanes: ``x``, ``f`` (k, L), ``slope`` (k, L) of its k segments."""

    x: Floats
    f: Floats
    slope: Floats

    def implicit(self, beta: Floats) -> Characteristic:
        """The same curve as a function of ``x + beta f``."""
        return Characteristic(self.x + beta * self.f, self.f, self.slope / (1 + beta * self.slope))

    def scaled(self, factor: Floats) -> Characteristic:
        """The same curve with ``factor`` (L,) times the force."""
        return Characteristic(self.x, self.f * factor, self.slope * factor)


class StrutCharacteristics(NamedTuple):
    """The characteristics of one strut of L lanes."""

    spring: Characteristic
    push: Characteristic
    pull: Characteristic

    def scaled(self, spring: Floats, damper: Floats) -> StrutCharacteristics:
        """The same with ``spring`` and ``damper`` (L,) times the forces."""
        return StrutCharacteristics(
            self.spring.scaled(spring), self.push.scaled(damper), self.pull.scaled(damper)
        )


#: By axle.
Characteristics = dict[str, StrutCharacteristics]


def read_characteristics(numbers: Numbers, problems: Problems) -> Characteristics:
    """Characteristics by axle; adds to ``problems`` what is wrong with them or with any number."""
    problems.check_finite(numbers)
    return {
        axle: StrutCharacteristics(
            *(_read(numbers, f"vehicle.{axle}.{part}", abscissa, problems) for part, abscissa in PARTS)
        )
        for axle in AXLES
    }


def _read(numbers: Numbers, prefix: str, abscissa: str, problems: Problems) -> Characteristic:
    count = 0
    while f"{prefix}.force.{count}" in numbers:
        count += 1
    x = np.stack([numbers[f"{prefix}.{abscissa}.{j}"] for j in range(count)])
    f = np.stack([numbers[f"{prefix}.force.{j}"] for j in range(count)])
    slope = np.empty_like(f)
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(f[0], x[0], out=slope[0])
        np.divide(f[1:] - f[:-1], x[1:] - x[:-1], out=slope[1:])
    rising = (x[0] > 0) & (x[1:] > x[:-1]).all(axis=0)
    problems.check(~rising, f"{prefix}.{abscissa}", "must rise from above 0")
    falling = (f[0] < 0) | (f[1:] < f[:-1]).any(axis=0)
    problems.check(falling, f"{prefix}.force", "must not be negative or fall")
    return Characteristic(x, f, slope)


def hinges_of(characteristics: Characteristics) -> Hinges:
    """Changes of slope that the kernel for these characteristics has."""

    def enough(curves: Iterable[Characteristic]) -> int:
        most = max(curve.x.shape[0] for curve in curves) - 1
        return next(h for h in rows.HINGES if h >= most)

    struts = characteristics.values()
    return Hinges(enough(s.spring for s in struts), enough(c for s in struts for c in (s.push, s.pull)))


@dataclass(frozen=True, eq=False)
class Candidates:
    """Numbers (L,) of L candidates of a car by dotted key, and where they fail: the input of a kernel's constants.

    ``numbers`` as effects change them, ``stance`` without: heights count from the vehicle as it stands without its
    effects. ``corners`` is what effects change of single struts and tyres, ``effects`` has the parameters (L,) of those
    effects that have terms in the kernel, and which lanes have them.
    """

    numbers: Numbers
    stance: Numbers
    corners: CornerChange
    effects: Mapping[str, tuple[Values, NDArray[np.bool_]]]
    characteristics: Characteristics
    problems: Problems
    max_step: float


class Block(NamedTuple):
    """``values`` (rows, L) in the order of a kernel's block, ``flags`` (L,) of the terms of effects that each lane
    needs, None in a block without effects, and the road that the lanes see."""

    values: Floats
    flags: Ints | None
    road: RoadChange


#: Substeps, motion, first and last stamp, signals, states and first lane of a walk, as in ``full_car._run``.
Walk = tuple[Ints, Floats, int, int, Floats, Floats, int]


LaneFunctions = tuple[tuple[Callable[..., None], ...], dict[str, object]]


@dataclass(frozen=True, eq=False)
class CarKernel:
    """The compiled part of a car's model.

    Parameters
    ----------
    block
        Constants of the kernel for candidates that see a road, from the position of an antenna at a height in m (0 for
        that of the vehicle itself), with or without actuators.
    walk
        ``walk(hinges, blocks, flags, road, candidate_road, walk)`` takes blocks of lanes along.
    one_lane
        Functions that start, advance and read a lane with flags by itself, see ``one_lane.OneLane``, and what they have
        of their own beside the number of hinges and the tyre radius.
    rigid
        Whether the four corners lie in a plane; where they do not, the states hold the springs' compressions.
    """

    block: Callable[[Candidates, RoadChange, float, bool], Block]
    walk: Callable[[Hinges, Floats, Ints | None, Floats, Floats, Walk], None]
    one_lane: Callable[[int], LaneFunctions]
    rigid: bool = True


def car_kernel(model: str) -> CarKernel:
    """The object ``KERNEL`` in the file of a car's model."""
    kernel: CarKernel = import_module(f"{__package__}.{model}").KERNEL
    return kernel


def compression_at(curve: Characteristic, load: Floats) -> Floats:
    """Smallest compression (L,) at which a spring carries ``load``; not finite where it never does."""
    segment = np.minimum((curve.f < load).sum(axis=0), curve.x.shape[0] - 1)
    lane = np.arange(load.size)
    before = np.maximum(segment - 1, 0)
    inner = segment > 0
    x0, f0 = np.where(inner, curve.x[before, lane], 0.0), np.where(inner, curve.f[before, lane], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        out: Floats = x0 + (load - f0) / curve.slope[segment, lane]
    return out


def _hinge_rows(out: Floats, first: int, count: int, curve: Characteristic) -> Floats:
    """Write abscissae and slope changes of the inner points; return their sum of products (L,)."""
    inner = curve.x.shape[0] - 1
    out[first : first + inner] = curve.x[:-1]
    out[first + inner : first + count] = curve.x[-1]  # slope change 0: no hinge
    change = curve.slope[1:] - curve.slope[:-1]
    out[first + count : first + count + inner] = change
    products: Floats = (curve.x[:-1] * change).sum(axis=0)
    return products


def write_curves(out: Floats, first: int, hinges: Hinges, strut: StrutCharacteristics, beta: Floats) -> None:
    """Write the characteristics of one corner, ``rows.axle_rows`` of them, from row ``first`` on."""
    out[first] = strut.spring.slope[0]
    out[first + 1] = -_hinge_rows(out, first + 2, hinges.spring, strut.spring)
    push, pull = strut.push.implicit(beta), strut.pull.implicit(beta)
    damper = first + 2 + 2 * hinges.spring
    out[damper] = pull.slope[0]
    out[damper + 1] = push.slope[0] - pull.slope[0]
    constant = _hinge_rows(out, damper + 3, hinges.damper, push)
    constant = constant + _hinge_rows(
        out, damper + 3 + 2 * hinges.damper, hinges.damper, Characteristic(-pull.x, pull.f, pull.slope)
    )
    out[damper + 2] = -constant


def shorten_spring(out: Floats, first: int, hinges: int, sag: Floats) -> None:
    """Shift the spring whose rows begin at ``first`` by ``sag`` (L,) m: it carries nothing until it is compressed so
    far. A lane whose sag is 0 keeps its rows to the last bit."""
    abscissae, changes = (out[first + 2 + k * hinges : first + 2 + (k + 1) * hinges] for k in range(2))
    # without branches the force is k0 x + sum of changes max(x, x_j) + constant: the sum of products goes along
    out[first + 1] -= sag * (out[first] + changes.sum(axis=0))
    abscissae += sag
