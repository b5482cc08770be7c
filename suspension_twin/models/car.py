# SPDX-License-Identifier: Apache-2.0
"""What ``full_car`` and ``msd`` have in common: the numbers of a car, what is measured of it, its characteristics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.models import rows
from suspension_twin.models.registry import Model, deferred
from suspension_twin.vehicle.corners import AXLES
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "CHANNELS",
    "Characteristic",
    "Characteristics",
    "Check",
    "Problems",
    "car_model",
    "checker",
    "compression_at",
    "hinges_of",
    "read_curve",
    "shorten_spring",
    "write_curves",
]

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
#: Axle, part and abscissa of every characteristic.
CURVES = tuple(
    (axle, part, abscissa)
    for axle in AXLES
    for part, abscissa in (
        ("spring", "compression"),
        ("damper_push", "velocity"),
        ("damper_pull", "velocity"),
    )
)


def numbers(twin: Twin) -> tuple[str, ...]:
    """Keys of the numbers of a car: scalars, then the points of its characteristics."""
    names = list(_SCALARS)
    for axle, part, abscissa in CURVES:
        curve = getattr(getattr(twin.vehicle, axle), part)
        for quantity in (abscissa, "force"):
            names += [f"vehicle.{axle}.{part}.{quantity}.{j}" for j in range(len(curve.force))]
    return tuple(names)


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


#: What is wrong with which lanes: mask (L,), key of the twin, sentence.
Problems = list[tuple[NDArray[np.bool_], str, str]]
Check = Callable[[Any, str, str], None]


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


Characteristics = dict[tuple[str, str], Characteristic]


def checker(problems: Problems) -> Check:
    """A function that adds a mask of bad lanes, a key and a sentence to ``problems`` if any is bad."""

    def check(bad: Any, key: str, sentence: str) -> None:
        if bad.any():
            problems.append((bad, key, sentence))

    return check


def hinges_of(curves: Characteristics) -> int:
    """How many changes of slope the kernel for these curves has."""
    most = max(curve.x.shape[0] for curve in curves.values()) - 1
    return next(h for h in rows.HINGES if h >= most)


def read_curve(numbers: dict[str, Floats], prefix: str, abscissa: str) -> Characteristic:
    """The curve under ``prefix`` among a twin's numbers by dotted key."""
    count = 0
    while f"{prefix}.force.{count}" in numbers:
        count += 1
    x = np.stack([numbers[f"{prefix}.{abscissa}.{j}"] for j in range(count)])
    f = np.stack([numbers[f"{prefix}.force.{j}"] for j in range(count)])
    slope = np.empty_like(f)
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(f[0], x[0], out=slope[0])
        np.divide(f[1:] - f[:-1], x[1:] - x[:-1], out=slope[1:])
    return Characteristic(x, f, slope)


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


def write_curves(
    out: Floats,
    first: int,
    hinges: int,
    spring: Characteristic,
    push: Characteristic,
    pull: Characteristic,
    beta: Floats,
) -> None:
    """Write one corner's curves, ``rows.axle_rows`` of them, from row ``first`` on."""
    out[first] = spring.slope[0]
    out[first + 1] = -_hinge_rows(out, first + 2, hinges, spring)
    push, pull = push.implicit(beta), pull.implicit(beta)
    damper = first + 2 + 2 * hinges
    out[damper] = pull.slope[0]
    out[damper + 1] = push.slope[0] - pull.slope[0]
    constant = _hinge_rows(out, damper + 3, hinges, push)
    constant = constant + _hinge_rows(
        out, damper + 3 + 2 * hinges, hinges, Characteristic(-pull.x, pull.f, pull.slope)
    )
    out[damper + 2] = -constant


def shorten_spring(out: Floats, first: int, hinges: int, sag: Floats) -> None:
    """Shift the spring whose rows begin at ``first`` by ``sag`` (L,) m: it carries nothing until it is compressed so
    far. A lane whose sag is 0 keeps its rows to the last bit."""
    abscissae, changes = (out[first + 2 + k * hinges : first + 2 + (k + 1) * hinges] for k in range(2))
    # without branches the force is k0 x + sum of changes max(x, x_j) + constant: the sum of products goes along
    out[first + 1] -= sag * (out[first] + changes.sum(axis=0))
    abscissae += sag
