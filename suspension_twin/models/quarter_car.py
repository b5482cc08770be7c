# SPDX-License-Identifier: Apache-2.0
"""``quarter_car``: one corner of a vehicle on a test rig, the sprung over the unsprung mass.

With z and u the heights of the sprung mass m_s and of the unsprung mass m_u above where they stand on a road at
height 0, r the road under the tyre and ``c = static + u - z`` the compression of the spring,

``m_s z'' = F - m_s g``, ``m_u u'' = N - F - m_u g``,
``F = spring(c) + damper(c') + f``, ``N = max(0, load + k (r - u))``

with f the known force of an actuator between the masses.

This is what each corner of a full car does that is symmetric about its middle, on a road that is the same
under all four wheels: it cannot roll or pitch. So the kernels of ``full_car`` simulate it, with four corners alike
and four times the masses, and every effect of a corner, of the sensor and of its clock acts by the same code.
Where the wheel's motion was measured (``excitation: wheel``) it is the u of the first equation, by the kernel of
``msd``, whose wheels have no mass and follow their road.

The inertias of that car move no body; they are chosen so that the effective mass at each of its dampers is that of
the corner, m_s m_u / (m_s + m_u), which the implicit damper needs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.models import rows
from suspension_twin.models.car import PARTS, Problems, points
from suspension_twin.models.constants import Conditions, Constants, constants
from suspension_twin.models.excitation import MOTION
from suspension_twin.models.hooks import Values
from suspension_twin.models.parameters import ParameterLayout, layout, pack
from suspension_twin.models.parts import has_part
from suspension_twin.models.registry import Model
from suspension_twin.models.sensor_chain import Chain, pass_clock
from suspension_twin.models.simulate import LaneBlocks, Stretch, cores, full_response
from suspension_twin.models.types import Excitation, LaneResponse, RepeatedRun, Response
from suspension_twin.vehicle.corners import AXLES
from suspension_twin.vehicle.twin import Twin

__all__ = ["CHANNELS", "MODEL"]

#: Body and wheel acceleration in m/s² upwards, without gravity; compression of the suspension in m from standing; force
#: of the road on the tyre in N.
CHANNELS = ("body_acceleration", "wheel_acceleration", "suspension_deflection", "tyre_force")
#: Those of a corner whose wheel's motion is given.
_ABOVE_WHEEL = ("body_acceleration", "suspension_deflection")
_DAMPING = "vehicle.tyre.damping"
_SCALARS = ("vehicle.sprung_mass", "vehicle.unsprung_mass", "vehicle.tyre.vertical_stiffness", "imu.latency")
#: The car with four such corners that is no number of the twin: a square, 2 m by 2 m, with everything at 1 m.
_SQUARE = {
    "vehicle.wheelbase": 2.0,
    "vehicle.front_track": 2.0,
    "vehicle.rear_track": 2.0,
    "vehicle.cog.0": 1.0,
    "vehicle.cog.1": 0.0,
    "vehicle.cog.2": 1.0,
    "vehicle.tyre.radius": 1.0,
    "imu.position.0": 1.0,
    "imu.position.1": 0.0,
    "imu.position.2": 1.0,
}
VehicleChange = Callable[[dict[str, Floats], Values], None]
#: Stamps whose states are kept at once.
_CHUNK = 1024


def _numbers(twin: Twin) -> Sequence[str]:
    names = list(_SCALARS)
    for part, abscissa in PARTS:
        names += points(getattr(twin.vehicle, part), f"vehicle.{part}", abscissa)
    return [*names, _DAMPING] if has_part(twin, _DAMPING) else names


def _car(numbers: dict[str, Floats], above: bool) -> dict[str, Floats]:
    """Numbers (L,) of the car with four such corners, or with what is above their wheels."""
    sprung = numbers["vehicle.sprung_mass"]
    unsprung = np.zeros_like(sprung) if above else numbers["vehicle.unsprung_mass"]
    car = {key: np.full(sprung.size, value) for key, value in _SQUARE.items()}
    car["vehicle.mass"] = 4.0 * (sprung + unsprung)
    car["vehicle.sprung_inertia.roll"] = car["vehicle.sprung_inertia.pitch"] = 8.0 / 3.0 * sprung
    for axle in AXLES:
        car[f"vehicle.{axle}.unsprung_mass"] = unsprung
        for key, values in numbers.items():
            if key.startswith(("vehicle.spring.", "vehicle.damper_")):
                car[key.replace("vehicle.", f"vehicle.{axle}.", 1)] = values
    return car


def _on_car(change: VehicleChange, own: Sequence[str], above: bool) -> VehicleChange:
    """The change of the car's numbers by an effect that changes the corner's ``own``."""

    def vehicle(numbers: dict[str, Floats], values: Values) -> None:
        change(numbers, values)
        numbers.update(_car({key: numbers[key] for key in own}, above))

    return vehicle


def _constants(twin: Twin, params: Floats, run: Excitation) -> Constants:
    """Constants of the kernel for candidates (P, L), whose problems are named by the keys of this twin."""
    shape, above = layout(twin), twin.on_wheel
    given = dict(zip(shape.names, params, strict=True))
    numbers = {**given, **_car(given, above)}
    kernel = "msd" if above else "full_car"
    hooks = {}
    if above and run.motion.shape[1] > len(MOTION):
        raise InputError("excitation", "wheel", "cannot be with the force of an actuator: give the road")
    for effect, hook in shape.hooks.items():
        neutral = dict(hook.neutral)
        for name in hook.neutral:  # what an effect does at the front it does at the rear
            if name.startswith("front"):
                rear = name.replace("front", "rear", 1)
                neutral[rear] = hook.neutral[name]
                numbers[f"effects.{effect}.{rear}"] = given[f"effects.{effect}.{name}"]
        hooks[effect] = replace(
            hook,
            neutral=neutral,
            vehicle=hook.vehicle and _on_car(hook.vehicle, tuple(given), above),
        )
    car = ParameterLayout(tuple(numbers), kernel, hooks, shape.mounting, shape.parts)
    known = constants(np.stack(list(numbers.values())), car, Conditions.of(run))
    problems = [
        (mask, key.replace(".front", "").replace(".rear", ""), text)
        for mask, key, text in known.problems.found
    ]
    return replace(known, problems=Problems(known.lanes, problems))


def _lanes(twin: Twin, params: Floats, excitation: Excitation, threads: int | None = None) -> LaneResponse:
    run, known, above = excitation, _constants(twin, params, excitation), twin.on_wheel
    blocks = LaneBlocks(known)
    n, count = len(run), blocks.lanes
    signals = np.empty((n, 10, count))
    for begin in range(0, n, _CHUNK):
        end = min(begin + _CHUNK, n)
        read = np.empty((end - begin, 7, blocks.width))
        states = np.empty((end - begin, rows.STATES, blocks.width))
        road = run.road[run.first[begin] : run.first[end]]
        stretch = Stretch(run.substeps, run.motion, begin, end, road)
        blocks.walk(stretch, read, states, threads or cores())
        body, wheel = states[:, rows.HEAVE, :count], states[:, rows.WHEEL, :count]
        if above:
            wheel = run.road[run.first[begin + 1 : end + 1] - 1, :1] + known.values[rows.STATIC]
        signals[begin:end, :7] = read[:, :, :count]
        signals[begin:end, 7] = states[:, rows.WHEEL_ACCELERATION, :count]
        signals[begin:end, 8] = wheel - body - known.values[rows.STATIC]
        signals[begin:end, 9] = states[:, rows.CONTACT, :count]
    if isinstance(run, RepeatedRun):
        for name, missed in zip(run.channels, run.missed.T, strict=True):
            at = [2, 6] if name == CHANNELS[0] else [6 + CHANNELS.index(name)]
            signals[:, at] += missed[:, None, None]
    # the chain changes what the accelerometer on the body reads; the clock stamps all channels
    Chain(known).process(signals, run.t, run.substeps == 0)
    names = _ABOVE_WHEEL if above else CHANNELS
    signals = np.ascontiguousarray(signals[:, [6 + CHANNELS.index(name) for name in names]])
    pass_clock(known, run, signals)
    failed = blocks.failed | ~np.isfinite(signals).all(axis=(0, 1))
    signals[:, :, failed] = 0.0
    return LaneResponse(run.t, names, signals, failed)


def _respond(twin: Twin, run: Excitation) -> Response:
    known = _constants(twin, pack(twin)[:, None], run)
    whole = full_response(known, run, twin.vehicle.tyre.radius or 0.0)
    corner: dict[str, Floats] = {
        name: getattr(whole, name)[:, :1]
        for name in ("wheel_z", "deflection", "deflection_rate", "tyre_force")
    }
    return replace(whole, acceleration=whole.acceleration[:, [0, 3]], **corner)


_ON_ROAD = Model(
    name="quarter_car",
    title="one corner on a rig: a sprung over an unsprung mass",
    recordings="rig",
    channels=CHANNELS,
    numbers=_numbers,
    lanes=_lanes,
    also=("vehicle.unsprung_mass", "vehicle.tyre.vertical_stiffness", _DAMPING, "imu.latency"),
    respond=_respond,
)
MODEL = replace(_ON_ROAD, on_wheel=replace(_ON_ROAD, channels=_ABOVE_WHEEL))
