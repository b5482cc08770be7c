# SPDX-License-Identifier: Apache-2.0
"""From a twin's numbers to the constants of many lanes: the changes by effects, then the constants of the kernel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.models.car import (
    Candidates,
    CarKernel,
    Numbers,
    Problems,
    car_kernel,
    hinges_of,
    read_characteristics,
)
from suspension_twin.models.excitation import MOTION
from suspension_twin.models.hooks import ClockChange, CornerChange, RoadChange, SignalStage, Values
from suspension_twin.models.parameters import ParameterLayout
from suspension_twin.models.rows import LINKS_ALONE, Hinges
from suspension_twin.models.types import Excitation, Ints

__all__ = ["Conditions", "Constants", "Outside", "constants", "outside"]

Stage = tuple[SignalStage, Floats, Floats]  # with its parameters (k, L), and their neutral values (k, 1)

#: How far off in m, and through how wide a window in m, a candidate may look at the road.
FARTHEST, WIDEST = 100.0, 20.0


@dataclass(frozen=True, eq=False)
class Outside:
    """Changes of L lanes outside the vehicle's equations, and the lanes that cannot be simulated.

    ``road`` is what lanes see of the road where it is not the plain one, ``stages`` the sensor's chain in order, with
    the parameters of each (k, L), ``clock`` its stamps, ``mounting`` roll, pitch and yaw of its axes in rad.
    """

    problems: Problems
    road: RoadChange | None
    stages: tuple[tuple[SignalStage, Floats], ...]
    clock: ClockChange | None
    mounting: tuple[float, float, float]

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return self.problems.count

    @property
    def reads_otherwise(self) -> bool:
        """Whether the sensor reads anything else than an ideal one."""
        return bool(self.stages) or self.clock is not None


@dataclass(frozen=True, eq=False)
class Constants(Outside):
    """Constants of a car's kernel: ``values`` (rows, L) in the order of its block, ``hinges`` of springs and dampers.

    ``flags`` (L,) are bits of the terms that each lane needs where the rows are those of a block with effects, else
    None.
    """

    kernel: CarKernel
    values: Floats
    flags: Ints | None
    hinges: Hinges


class Conditions(NamedTuple):
    """Conditions of a run: steps of up to ``max_step`` s, and how its recording was made.

    ``fused``: a clock offset delays the road instead of the sensor's stamps. ``antenna`` m is the height of the antenna
    whose position gives the vehicle's: roll and pitch of the static attitude displace it. ``clock_offset`` s of the
    sensor's clock are in the excitation already. ``actuated``: the excitation has forces of actuators.
    """

    max_step: float
    fused: bool = False
    antenna: float = 0.0
    clock_offset: float = 0.0
    actuated: bool = False

    @classmethod
    def of(cls, excitation: Excitation, fused: bool = False) -> Conditions:
        """The conditions of an excitation."""
        actuated = excitation.motion.shape[1] > len(MOTION)
        return cls(excitation.max_step, fused, excitation.path.antenna, excitation.late, actuated)


def constants(params: Floats, layout: ParameterLayout, conditions: Conditions) -> Constants:
    """Constants of the kernel for candidates ``params`` (P, L)."""
    numbers = {name: params[row] for name, row in layout.index.items()}
    change = _Changes.of(numbers, layout, conditions)
    problems, kernel = Problems(params.shape[1]), car_kernel(layout.model)
    curves = read_characteristics(change.numbers, problems)
    given = (change.numbers, numbers, change.corners, change.kernel, curves, problems, conditions.max_step)
    candidates = Candidates(*given)
    values, flags, road = kernel.block(candidates, change.road, conditions.antenna, conditions.actuated)
    known = replace(change, road=road).outside(problems, layout)
    if flags is not None:
        flags[problems.lanes] &= LINKS_ALONE
    return Constants(**vars(known), kernel=kernel, values=values, flags=flags, hinges=hinges_of(curves))


def outside(params: Floats, layout: ParameterLayout, conditions: Conditions) -> Outside:
    """Changes by the effects of a vehicle whose equations are not the kernel's: road, sensor's chain and clock.

    Arguments as of :func:`constants`.
    """
    numbers = {name: params[row] for name, row in layout.index.items()}
    problems = Problems(params.shape[1])
    problems.check_finite(numbers)
    return _Changes.of(numbers, layout, conditions).outside(problems, layout)


@dataclass(eq=False)
class _Changes:
    """Changes by the effects for L candidates: numbers of the twin, corners, road and clock, the parameters of terms
    in the kernel and which lanes have them, by effect, and the sensor's chain."""

    numbers: Numbers
    corners: CornerChange
    road: RoadChange
    clock: ClockChange
    kernel: dict[str, tuple[Values, NDArray[np.bool_]]] = field(default_factory=dict)
    stages: list[Stage] = field(default_factory=list)

    @classmethod
    def of(cls, numbers: Numbers, layout: ParameterLayout, conditions: Conditions) -> _Changes:
        """All changes by the effects of ``layout``, with road and clock as the candidates have them."""
        count = numbers["imu.latency"].size
        lag, delay, drift = np.zeros((3, count))
        out = cls(
            dict(numbers), CornerChange.neutral(count), RoadChange.neutral(count), ClockChange(delay, drift)
        )
        with np.errstate(all="ignore"):
            for effect, hook in layout.hooks.items():
                values = layout.values(effect, numbers)
                if hook.vehicle is not None:
                    hook.vehicle(out.numbers, values)
                if hook.corners is not None:
                    hook.corners(out.corners, values)
                if hook.road is not None:
                    hook.road(out.road, values)
                if hook.clock is not None:
                    hook.clock(out.clock, values)
                if hook.kernel is not None:
                    out.kernel[effect] = values, hook.armed(values)
                if hook.signal is not None:
                    given = np.stack([values[name] for name in hook.neutral])
                    neutral = np.array(list(hook.neutral.values()))[:, None]
                    if (given != neutral).any():
                        out.stages.append((hook.signal, given, neutral))
                    if hook.signal.lag is not None:
                        lag += hook.signal.lag(values)
        out.stages.sort(key=lambda stage: stage[0].order)
        delay += numbers["imu.latency"]
        delay -= conditions.clock_offset
        if not conditions.fused:
            return out
        # low frequencies of the planar motion have the delay of the sensor's filter, as the pose has: it is taken out
        road = replace(out.road, delay=delay + lag, drift=drift)
        return replace(out, road=road, clock=ClockChange(-lag, np.zeros(count)))

    def outside(self, problems: Problems, layout: ParameterLayout) -> Outside:
        """The part that is outside the vehicle; lanes that cannot be simulated get the plain road, sensor and clock."""
        road, clock = self.road, self.clock
        # nobody looks at a road farther off or through a wider window than these: it would only take memory
        far = np.maximum(np.abs(road.ahead), np.abs(road.left))
        wide = np.maximum(np.maximum(road.smoothing, road.sharpening), road.patch)
        problems.check(~(far <= FARTHEST), "effects", f"look at the road more than {FARTHEST:g} m off")
        problems.check(~(wide <= WIDEST), "effects", f"look at the road through more than {WIDEST:g} m")
        problems.check(~np.isfinite(road.scale), "effects", "scale the road by what is not finite")
        bad = problems.lanes
        if bad.any():
            for name, plain in vars(RoadChange.neutral(1)).items():
                getattr(road, name)[bad] = plain
            clock.delay[bad] = clock.drift[bad] = 0.0
            for _, values, neutral in self.stages:
                values[:, bad] = neutral
        return Outside(
            problems,
            road if road.changed.any() else None,
            tuple((stage, given) for stage, given, _ in self.stages),
            clock if clock.delay.any() or clock.drift.any() else None,
            layout.mounting,
        )
