# SPDX-License-Identifier: Apache-2.0
"""The library: which hypotheses are tried on a twin.

A discrete parameter of an effect (``choices``) has no search coordinate: each of its values is a hypothesis of its own,
a variant, and the best variant represents the effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from suspension_twin.effects.base import Effect
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.vehicle.twin import Twin

__all__ = ["NUISANCE_COUNTERPART", "OF_PLACE", "SETUP_CATEGORIES", "decoys", "library"]

#: Categories of effects that are set-up errors: any size within their range is possible.
SETUP_CATEGORIES = ("time", "road", "sensor")
#: Nuisance parameters that have the same action as an effect.
NUISANCE_COUNTERPART = {
    "sensor_tilt": ("tilt_roll", "tilt_pitch"),
    "time_offset": ("clock_offset",),
    "position_offset": ("map_position",),
}
#: Effects that the planar motion shows without a road. Positions at a few hertz show neither bandwidth nor range of a
#: sensor.
WITHOUT_ROAD = ("time_offset", "clock_drift", "sensor_tilt", "sensor_scale")
#: Decoy hypotheses: generic shapes of progressive stiffness and play that many mechanisms share. If one explains the
#: gap best, no effect of the library does, and the answer is unknown. They are causes only where a request names them.
DECOYS = ("progressive_spring", "damper_play")
#: Effects with the action of a pass's place and of a receiver's lateness, which are nuisance parameters where the
#: receiver leaves them open.
OF_PLACE = ("position_offset", "lateral_offset", "time_offset", "clock_drift")


def variants(effect: Effect, twin: Twin, drives: int = 1) -> list[Hypothesis]:
    """The hypotheses of an effect on a twin: one, or one for each possible combination of its choices; ``drives`` is
    the number of all drives. Of an effect that the twin has it is another size, where the twin has it."""
    counting = [p for p in effect.parameters if p.choices]
    keys = [f"effects.{effect.id}.{p.name}" for p in counting]
    possible = effect.hook.possible or (lambda twin, given: True)
    own = next((effect.values(e.parameters) for e in twin.effects if e.id == effect.id), {})
    held = tuple(
        (f"effects.{effect.id}.{p.name}", own[p.name]) for p in effect.parameters if own and not p.choices
    )
    choices = [(own[p.name],) if own else p.choices for p in counting]
    return [
        Hypothesis(
            (effect.id,), tuple(zip(keys, chosen, strict=True)), model=twin.model, drives=drives, held=held
        )
        for chosen in product(*choices)
        if possible(twin, {p.name: c for p, c in zip(counting, chosen, strict=True)})
    ]


def library(
    twin: Twin, excited: bool, only: Sequence[str] = (), drives: int = 1
) -> dict[str, list[Hypothesis]]:
    """The hypotheses of every applicable effect, by id; ``excited``: whether the excitation is known, ``drives``: how
    many there are, those of a reference included.

    Effects that the twin file has already are offered with another size.
    """
    return _offered(twin, excited, only or [name for name in EFFECTS if name not in DECOYS], drives)


def decoys(twin: Twin, excited: bool, only: Sequence[str] = ()) -> dict[str, list[Hypothesis]]:
    """The applicable decoy hypotheses that ``only`` does not name."""
    own = {e.id for e in twin.effects}
    return _offered(twin, excited, [name for name in DECOYS if name not in only and name not in own], 1)


def _offered(twin: Twin, excited: bool, names: Sequence[str], drives: int) -> dict[str, list[Hypothesis]]:
    return {
        name: variants(effect.on(twin.model), twin, drives)
        for name, effect in EFFECTS.items()
        if set(twin.acted_on) <= set(effect.models) and (excited or name in WITHOUT_ROAD) and name in names
    }
