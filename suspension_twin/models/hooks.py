# SPDX-License-Identifier: Apache-2.0
"""How an effect plugs into a model: the one seam between ``models`` and ``effects``.

An effect is a module ``suspension_twin/effects/<id>.py`` with an object ``EFFECT`` whose ``hook``
is a :class:`Hook`. Its parameters appear in the parameter vector as ``effects.<id>.<name>``, so
that candidates may differ in them as in anything else. A hook has up to six parts; each gets
the parameters of all L candidates at once and must be exactly nothing where they are neutral:

``vehicle(numbers, values)``
    changes numbers of the twin, e.g. mass and centre of gravity by a payload or ``imu.position.0``
    by a misplaced sensor. ``numbers`` maps dotted keys to (L,) arrays; the geometry of the stance
    (static compression, what heights are counted from) stays that of the twin without it.
``corners(change, values)``
    changes springs, dampers, damper mounts and tyres corner by corner (:class:`CornerChange`).
``kernel``
    compiled terms with fields of their own in a block (:class:`KernelTerms`): forces of struts and tyres, masses
    on the body, what the sensor reads of them.
`road(change, values)``
    what each candidate sees of the road (:class:`RoadChange`).
``signal``
    a :class:`SignalStage` that the sensor's readings pass, in the order of ``SignalStage.order``.
``clock(change, values)``
    how the sensor's stamps differ from those of the pose (:class:`ClockChange`).

The kernel with effects runs only where a candidate has an effect that needs it, and in each block of
lanes only the terms of effects that one of these lanes has; roads and signal stages cost only the
candidates that have them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.models.rows import Fields
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "Check",
    "ClockChange",
    "CornerChange",
    "Hook",
    "KernelTerms",
    "RoadChange",
    "SignalStage",
    "Stage",
    "clocks_with",
    "gains_with",
    "load_hook",
    "turns_with",
    "upright_with",
]

#: Parameters (L,) of an effect by name.
Values = Mapping[str, Floats]
#: Reports a mask of lanes (L,), a key of the twin file and what is wrong with it.
Check = Callable[[NDArray[np.bool_] | np.bool_, str, str], None]


class MarkerExcitation(Protocol):
    """A run on which markers are measured: even stamps ``t`` (n,) s and the ``speed`` in m/s."""

    @property
    def t(self) -> Floats: ...

    @property
    def speed(self) -> float: ...


#: Where in a step a term of the kernel acts, in this order. ``dampers``: at the start of an interval, before the tables
#: of the dampers are made; multiply DAMPER_SHARE. ``strut``: add to STRUT, with positions at the end of the step and
#: velocities in its middle. ``tyre``: add to GROUND. ``body``: once the accelerations are known; may change those of
#: the body and its velocities. ``after``: the step is complete; change own states only. ``stamp``: the ideal sensor
#: has read; add to SIGNAL.
Stage = Literal["dampers", "strut", "tyre", "body", "after", "stamp"]


@dataclass(frozen=True, eq=False)
class KernelTerms:
    """Terms of an effect in the kernel of ``full_car``.

    Its functions are also written out in C and C# (``export.standalone.translate``), which know numbers, rows of the
    block, loops over ranges, conditions, functions of ``math`` and calls of such functions.

    Parameters
    ----------
    fields
        The rows of its constants and states. All are zero at first, for lanes without the effect for ever.
    constants
        Values of constants by field, from the parameters (L,): (rows, L), (L,) or a number.
    terms
        By stage an inlined function ``(w, e, c, i, h)``, and how often it runs in a step: for every CORNER, every AXLE
        or once for the LANE. ``w`` is the block, ``e`` the effect's first row, ``c`` the corner or axle, ``i`` the
        lane and ``h`` the step in s: its field F of corner c is ``w[(e + F + c) * WIDTH + i]``, the block's field F
        ``w[(rows.F + c) * WIDTH + i]``. With all constants zero a term must change no bit.
    elastic
        An inlined function ``(w, e, c, i, x)`` that gives force in N and stiffness in N/m of an elastic element at
        x m of compression beyond the static one, and CORNER for the compression of a corner or AXLE for the
        difference between left and right. It acts in the stage ``strut`` and in the static equilibrium.
    stiffness
        Constants in N/m that stiffen a wheel's suspension, for the check of the step.
    modes
        Constants that are the square of an angular frequency in 1/s², for the same.
    check
        ``check(rows, e, report)`` reports what else no kernel can simulate.
    """

    fields: Fields
    constants: Callable[[Values], Mapping[int, Floats | float]]
    terms: Mapping[Stage, tuple[Callable[[Floats, int, int, int, float], None], int]] = field(
        default_factory=dict
    )
    elastic: tuple[Callable[[Floats, int, int, int, float], tuple[float, float]], int] | None = None
    stiffness: tuple[int, ...] = ()
    modes: tuple[int, ...] = ()
    check: Callable[[Floats, int, Check], None] | None = None


@dataclass(frozen=True, eq=False)
class CornerChange:
    """Changes by effects at single corners: ``spring`` and ``damper`` (4, L) share added to the force of the corner's
    characteristic (0), ``compliance`` (4, L) m/N of an elastic mount in series with its damper (0), ``wheel_mass``
    (L,) kg of each wheel of ``msd`` (0), ``tyre`` (4, L) share added to the stiffness of the corner's tyre (0) and
    ``sag`` (4, L) m by which its spring is shorter when free (0)."""

    spring: Floats
    damper: Floats
    compliance: Floats
    wheel_mass: Floats
    tyre: Floats
    sag: Floats

    @classmethod
    def neutral(cls, count: int) -> CornerChange:
        """No change for ``count`` candidates."""
        spring, damper, compliance, tyre, sag = np.zeros((5, 4, count))
        return cls(spring, damper, compliance, np.zeros(count), tyre, sag)

    @property
    def changed(self) -> bool:
        """Whether any candidate's struts or tyres differ from those of its axles."""
        parts = (self.spring, self.damper, self.compliance, self.tyre, self.sag)
        return any(bool(part.any()) for part in parts)


@dataclass(frozen=True, eq=False)
class RoadChange:
    """The road as L candidates see it, all (L,): ``scale`` of its heights (1), ``ahead`` and
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
    def changed(self) -> NDArray[np.bool_]:
        """(L,) candidates that need a road of their own."""
        moved = (self.ahead != 0) | (self.left != 0) | (self.delay != 0) | (self.drift != 0)
        filtered = (self.smoothing != 0) | (self.sharpening != 0) | (self.patch != 0)
        return np.asarray((self.scale != 1) | moved | filtered)

    def alike(self, first: int, count: int) -> list[int]:
        """For each of ``count`` candidates from ``first`` on, which of them is the first to see the same road."""
        seen = list(
            zip(*(getattr(self, f.name)[first : first + count].tolist() for f in fields(self)), strict=True)
        )
        known: dict[tuple[float, ...], int] = {}
        return [known.setdefault(each, i) for i, each in enumerate(seen)]


@dataclass(frozen=True, eq=False)
class ClockChange:
    """Clock offset of the sensor's stamps, (L,) each: ``delay`` s (0), ``drift`` s/s from the first stamp on (0).

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
    force comes in the axes of the sensor as it is mounted, and the vertical acceleration follows by itself. ``lag``
    gives (L,) s by which the stage delays low frequencies: a pose that is fused with such a sensor has the same delay.
    """

    process: Callable[[Floats, Floats, NDArray[np.bool_], Floats, Floats], None]
    states: int = 0
    order: int = 30
    own_axes: bool = False
    lag: Callable[[Values], Floats] | None = None


@dataclass(frozen=True)
class VehicleHook:
    """Changes of the vehicle by one effect: its numbers, its corners, terms in the kernel."""

    vehicle: Callable[[dict[str, Floats], Values], None] | None = None
    corners: Callable[[CornerChange, Values], None] | None = None
    kernel: KernelTerms | None = None


@dataclass(frozen=True)
class SensorHook:
    """Changes of the sensor by one effect, and how a recording of such a sensor has to be read."""

    signal: SignalStage | None = None
    clock: Callable[[ClockChange, Values], None] | None = None
    #: Changes readings (n, C, L) in place of a model whose sensors are no IMU: signals, excitation, parameters.
    reading: Callable[[Floats, MarkerExcitation, Values], None] | None = None
    #: The parameters give the static attitude of the vehicle: further roll and pitch of the sensor are its mount's.
    upright: bool = False
    #: Roll, pitch and yaw in rad by which the effect turns the sensor on its mount: such a sensor takes braking for a
    #: lateral acceleration, so the planar motion has to be read from it turned back.
    turned: Callable[[Mapping[str, float]], tuple[float, float, float]] | None = None
    #: Gain of the specific force that the sensor reads with the effect; the planar motion is read divided by it.
    gained: Callable[[Mapping[str, float]], float] | None = None


@dataclass(frozen=True)
class Hook(VehicleHook, SensorHook):
    """Changes of a model by one effect. ``neutral`` names its parameters and their neutral values."""

    neutral: Mapping[str, float] = field(default_factory=dict)
    road: Callable[[RoadChange, Values], None] | None = None
    models: tuple[str, ...] = ("full_car",)
    #: Whether the effect with these parameters makes sense on a twin: a station that there is, say.
    possible: Callable[[Twin, Mapping[str, float]], bool] | None = None
    #: Raises InputError for parameters (of a twin file) that the effect cannot have.
    check: Callable[[Mapping[str, float]], object] | None = None
    #: Parameters that switch the effect off when all are neutral.
    severity: tuple[str, ...] = ()

    @property
    def outside(self) -> bool:
        """Whether the effect acts outside the vehicle: on road, sensor's signals or clock alone."""
        return self.vehicle is None and self.corners is None and self.kernel is None and self.reading is None

    def armed(self, values: Values) -> NDArray[np.bool_]:
        """(L,) candidates that have the effect."""
        return np.asarray(np.any([values[name] != self.neutral[name] for name in self.severity], axis=0))


def load_hook(effect: str, model: str = "full_car") -> Hook:
    """The hook of an effect on a model; InputError names an effect that there is not."""
    from suspension_twin.effects.registry import EFFECTS  # whose files import this one

    try:
        found = EFFECTS[effect]
    except KeyError:
        raise InputError("twin", "effects", f"there is no effect {effect}") from None
    hook: Hook = found.on(model).hook
    return hook


def turns_with(effects: Iterable[str], model: str = "full_car") -> bool:
    """Whether one of these effects, by id, turns the sensor on its mount."""
    return any(load_hook(effect, model).turned is not None for effect in effects)


def clocks_with(effects: Iterable[str], model: str = "full_car") -> bool:
    """Whether one of these effects, by id, is a clock offset."""
    change = ClockChange(np.zeros(1), np.zeros(1))
    for hook in (load_hook(effect, model) for effect in effects):
        if hook.clock is not None:
            hook.clock(change, dict.fromkeys(hook.neutral, np.ones(1)))
    return bool(change.delay[0])


def gains_with(effects: Iterable[str], model: str = "full_car") -> bool:
    """Whether one of these effects, by id, is a gain of the sensor."""
    return any(load_hook(effect, model).gained is not None for effect in effects)


def upright_with(effects: Iterable[str], model: str = "full_car") -> bool:
    """Whether one of these effects, by id, gives the static attitude of the vehicle."""
    return any(load_hook(effect, model).upright for effect in effects)
