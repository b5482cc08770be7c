# SPDX-License-Identifier: Apache-2.0
"""How an effect plugs into a model: the one seam between ``models`` and ``effects``.

An effect is a module ``suspension_twin/effects/<id>.py`` with an object ``EFFECT`` whose ``hook``
is a :class:`Hook`. Its parameters appear in the parameter vector as ``effects.<id>.<name>``, so
that candidates may differ in them as in anything else. A hook has up to five parts; each gets
the parameters of all L candidates at once and must be exactly nothing where they are neutral:

``vehicle(numbers, values)``
    changes numbers of the twin, e.g. mass and centre of gravity by a payload or ``imu.position.0``
    by a misplaced sensor. ``numbers`` maps dotted keys to (L,) arrays; the geometry of the stance
    (static compression, what heights are counted from) stays that of the twin without it.
``terms(rows, values)``
    sets constants of terms in the kernel (``models.rows``, ``models.effect_terms``): dry friction, stops,
    anti-roll bars, top mounts, fading, one corner's spring or damper, viscous tyres, engine, body
    bending; for ``msd`` there is only the mass of its wheels, ``rows.UNSPRUNG``. ``rows`` is (rows, L),
    all zero at first; add to it, another effect may have been there.
``road(change, values)``
    what each candidate sees of the road (:class:`RoadChange`).
``signal``
    a :class:`SignalStage` that the sensor's readings pass, in the order of ``SignalStage.order``.
``clock(change, values)``
    how the sensor's stamps differ from those of the pose (:class:`ClockChange`).

Cost: the kernel with terms runs only where a candidate has one, and then only the loops of those
terms; roads of their own and signal stages cost only the candidates that have them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = [
    "ClockChange",
    "Hook",
    "RoadChange",
    "SignalStage",
    "gains_with",
    "load_hook",
    "turns_with",
    "upright_with",
]

Values = Mapping[str, Floats]


@dataclass(frozen=True, eq=False)
class RoadChange:
    """What L candidates see of the road, all (L,): ``scale`` of its heights (1), ``ahead`` and
    ``left`` m that the map is looked up ahead of and left of the vehicle (0), ``smoothing`` m the
    sigma of a Gaussian along the track (0), ``sharpening`` m the sigma of one that is to be undone
    (0), ``patch`` m the length that a tyre averages over (0), ``delay`` s and ``drift`` s/s from the first
    stamp on: the road is seen where the vehicle was so long ago (0)."""

    scale: Floats
    ahead: Floats
    left: Floats
    smoothing: Floats
    sharpening: Floats
    patch: Floats
    delay: Floats
    drift: Floats

    @classmethod
    def neutral(cls, count: int) -> RoadChange:
        """No change for ``count`` candidates."""
        return cls(np.ones(count), *(np.zeros(count) for _ in range(7)))

    @property
    def changed(self) -> Any:
        """(L,) bool: candidates that need a road of their own."""
        moved = (self.ahead != 0) | (self.left != 0) | (self.delay != 0) | (self.drift != 0)
        filtered = (self.smoothing != 0) | (self.sharpening != 0) | (self.patch != 0)
        return (self.scale != 1) | moved | filtered

    def alike(self, first: int, count: int) -> list[int]:
        """For each of ``count`` candidates from ``first`` on, which of them is the first to see the same road."""
        seen = list(
            zip(*(getattr(self, f.name)[first : first + count].tolist() for f in fields(self)), strict=True)
        )
        known: dict[tuple[float, ...], int] = {}
        return [known.setdefault(each, i) for i, each in enumerate(seen)]


@dataclass(frozen=True, eq=False)
class ClockChange:
    """How late the sensor's stamps are, (L,) each: ``delay`` s (0), ``drift`` s/s from the first stamp on (0).

    A reading stamped t was taken at ``t - delay - drift (t - t0)`` on the clock of the pose. A whole
    drive is read between its stamps; a live twin goes back along its velocity instead, as it
    cannot know the pose of a later stamp.
    """

    delay: Floats
    drift: Floats


@dataclass(frozen=True)
class SignalStage:
    """One stage of the sensor's chain, compiled, and the same for a whole drive and for one stamp.

    ``process(signals, t, fresh, values, state)`` changes ``signals`` (n, 7, L) in place: specific
    force 3, angular rate 3 in base_link axes, vertical acceleration (which has to follow force z).
    ``t`` (n,) s, ``fresh`` (n,) bool marks a fresh start, ``values`` (parameters, L) in the order
    of ``Hook.neutral``, ``state`` (states, L) zeros at first, carried on from call to call.

    ``order``: mount 10, tilt 20, scale 30, bandwidth 40, range 50. With ``own_axes`` the specific
    force comes in the axes of the sensor as it is mounted, and the vertical acceleration follows by itself.
    """

    process: Callable[[Floats, Floats, Any, Floats, Floats], None]
    states: int = 0
    order: int = 30
    own_axes: bool = False


@dataclass(frozen=True)
class Hook:
    """What one effect does to a model. ``neutral`` names its parameters and their neutral values."""

    neutral: Mapping[str, float]
    vehicle: Callable[[dict[str, Floats], Values], None] | None = None
    terms: Callable[[Floats, Values], None] | None = None
    road: Callable[[RoadChange, Values], None] | None = None
    signal: SignalStage | None = None
    clock: Callable[[ClockChange, Values], None] | None = None
    #: (L,) s by which ``signal`` delays what is slow: a pose that is fused with such a sensor is as late.
    lag: Callable[[Values], Floats] | None = None
    models: tuple[str, ...] = field(default=("full_car",))
    #: With the effect it is known how the vehicle leans: what more the sensor leans by is its own.
    upright: bool = False
    #: Roll, pitch and yaw in rad by which the effect turns the sensor on its mount: such a sensor takes braking for a
    #: push to the side, and what moves the vehicle has to be read from it turned back.
    turned: Callable[[Mapping[str, float]], tuple[float, float, float]] | None = None
    #: How many times the specific force the sensor reads with the effect: what moves the vehicle is so much less.
    gained: Callable[[Mapping[str, float]], float] | None = None
    #: Changes readings (n, C, L) in place of a model whose sensors are no IMU: signals, excitation, parameters.
    reading: Callable[[Floats, Any, Values], None] | None = None
    #: Whether the effect with these parameters makes sense on a twin: a station that there is, say.
    possible: Callable[[Any, Mapping[str, float]], bool] | None = None
    #: Raises InputError for parameters (of a twin file) that the effect cannot have.
    check: Callable[[Mapping[str, float]], object] | None = None


def load_hook(effect: str, model: str = "full_car") -> Hook:
    """The hook of an effect on a model; InputError names an effect that there is not."""
    name = f"suspension_twin.effects.{effect}"
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise InputError("twin", "effects", f"there is no effect {effect}") from None
    known = getattr(module, "EFFECT", None)
    if known is None:
        raise InputError("twin", "effects", f"there is no effect {effect}")
    hook: Hook = known.on(model).hook
    return hook


def turns_with(effects: Iterable[str], model: str = "full_car") -> bool:
    """Whether one of these effects, by id, turns the sensor on its mount."""
    return any(load_hook(effect, model).turned is not None for effect in effects)


def clocks_with(effects: Iterable[str], model: str = "full_car") -> bool:
    """Whether one of these effects, by id, is a late clock."""
    change = ClockChange(np.zeros(1), np.zeros(1))
    for hook in (load_hook(effect, model) for effect in effects):
        if hook.clock is not None:
            hook.clock(change, dict.fromkeys(hook.neutral, np.ones(1)))
    return bool(change.delay[0])


def gains_with(effects: Iterable[str], model: str = "full_car") -> bool:
    """Whether one of these effects, by id, is a gain of the sensor."""
    return any(load_hook(effect, model).gained is not None for effect in effects)


def upright_with(effects: Iterable[str], model: str = "full_car") -> bool:
    """Whether it is known how a vehicle with these effects, by id, leans."""
    return any(load_hook(effect, model).upright for effect in effects)
