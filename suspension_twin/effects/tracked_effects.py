# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a tracked vehicle, or with the camera that films it.

Ids that a car has too mean the same (``payload``, ``sensor_scale``, ``sensor_tilt``, ``time_offset``).
An effect changes the vehicle's description, or what the camera makes of its markers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Parameter
from suspension_twin.errors import InputError
from suspension_twin.vehicle.tracked import BOUNDS, TrackedVehicle

__all__ = ["TRACKED_EFFECTS", "Camera", "TrackedEffect", "apply_tracked", "camera_of", "tracked_effect"]

Given = Mapping[str, float]


@dataclass(frozen=True)
class Camera:
    """What a camera does to markers: ``scale``, a clock ``late`` by s, an axis rolled by ``tilt`` rad."""

    scale: float = 1.0
    late: float = 0.0
    tilt: float = 0.0

    def see(self, t: Floats, z: Floats, v: Floats, a: Floats, speed: float) -> tuple[Floats, Floats, Floats]:
        """Displacement, velocity and acceleration (n, k) as they are measured at the stamps ``t`` (n,)."""
        at = t - self.late
        z, v, a = (np.stack([np.interp(at, t, c) for c in m.T], axis=1) for m in (z, v, a))
        drift = self.tilt * speed
        return self.scale * (z - drift * at[:, None]), self.scale * (v - drift), self.scale * a


@dataclass(frozen=True)
class TrackedEffect:
    """One effect; see ``effects.base.Effect`` for the words. ``vehicle`` or ``camera`` says what it changes."""

    id: str
    title: str
    where: str
    doc: str
    parameters: tuple[Parameter, ...]
    excited_by: tuple[str, ...]
    confused_with: tuple[str, ...]
    vehicle: Callable[[TrackedVehicle, Given], TrackedVehicle] | None = None
    camera: Callable[[Given], Camera] | None = None

    def values(self, given: Given) -> dict[str, float]:
        """All parameters: what is ``given``, else neutral. InputError names what is not one or out of bounds."""
        known = {p.name: p for p in self.parameters}
        for name in given:
            if name not in known:
                key = f"effects.{self.id}.{name}"
                raise InputError("twin", key, f"is not a parameter of it: {', '.join(known)}")
        return {name: p.check(self.id, float(given.get(name, p.neutral))) for name, p in known.items()}


def _tension(vehicle: TrackedVehicle, v: Given) -> TrackedVehicle:
    low, high = BOUNDS["idler.setting"]
    # beyond the range in which an idler can be set a track is simply slack, or as tight as it goes
    return vehicle.with_changes(
        {"idler.setting": float(np.clip(vehicle.idler.setting - v["tighter"], low, high))}
    )


def _wear(vehicle: TrackedVehicle, v: Given) -> TrackedVehicle:
    changes = {}
    for key in ("track.stiffness", "track.bending_stiffness"):
        low, high = BOUNDS[key]
        changes[key] = float(np.clip(getattr(vehicle.track, key.split(".")[1]) * v["stiffness"], low, high))
    longer = v["elongation"] * 1e3 / 2  # both the run above and the run below reach as far
    return vehicle.with_changes({**changes, "idler.taut_at": vehicle.idler.taut_at - longer})


def _station(vehicle: TrackedVehicle, v: Given) -> int:
    count = len(vehicle.stations)
    if not 1 <= v["station"] <= count:
        raise InputError("twin", "station", f"must be one of 1 to {count}, is {v['station']:g}")
    return int(v["station"]) - 1


def _damper(vehicle: TrackedVehicle, v: Given) -> TrackedVehicle:
    i = _station(vehicle, v)
    return vehicle.with_changes({f"stations.{i}.damping": vehicle.stations[i].damping * v["share"]})


def _bar(vehicle: TrackedVehicle, v: Given) -> TrackedVehicle:
    i = _station(vehicle, v)
    return vehicle.with_changes({f"stations.{i}.sag": vehicle.stations[i].sag + v["sag"]})


def _payload(vehicle: TrackedVehicle, v: Given) -> TrackedVehicle:
    # a lump on the hull: it moves the centre towards itself and adds no more inertia than its distance gives it
    hull, lump = vehicle.hull_mass, 0.5 * v["mass"]
    inertia = hull * vehicle.gyration**2 + hull * lump / (hull + lump) * v["x"] ** 2
    return vehicle.with_changes(
        {
            "mass": vehicle.mass + v["mass"],
            "cog.0": vehicle.cog[0] + lump / (hull + lump) * v["x"],
            "gyration": float(np.sqrt(max(inertia, 0.0) / (hull + lump))),
        }
    )


_STATION = Parameter(
    "station", "", 1, 12, 1, 1, 3, "Which road wheel, 1 in front.", choices=tuple(range(1, 13))
)
_EFFECTS: Final = (
    TrackedEffect(
        "track_tension",
        "Track tension off",
        "track",
        "The idler is set further out (tighter) or in than said.",
        (Parameter("tighter", "mm", -40.0, 40.0, 0.0, 0.0, 10.0, "How much further out the idler stands."),),
        ("an approach to an obstacle", "ends of obstacles"),
        ("track_wear",),
        vehicle=_tension,
    ),
    TrackedEffect(
        "track_wear",
        "Worn track",
        "track",
        "Links softer than the file says, in pull and in bending, and longer.",
        (
            Parameter("stiffness", "", 0.02, 2.0, 1.0, 0.5, 0.7, "What is left of the links' stiffness."),
            Parameter(
                "elongation", "m", 0.0, 0.06, 0.0, 0.01, 0.01, "How much longer the whole track has become."
            ),
        ),
        ("an approach to an obstacle",),
        ("track_tension",),
        vehicle=_wear,
    ),
    TrackedEffect(
        "station_damper",
        "Weak damper",
        "station",
        "One station's damper has lost some or all of its damping.",
        (_STATION, Parameter("share", "", 0.0, 2.0, 1.0, 0.3, 0.5, "What is left of its damping.")),
        ("speed over an obstacle",),
        ("station_damper of another station",),
        vehicle=_damper,
    ),
    TrackedEffect(
        "station_bar",
        "Sagged torsion bar",
        "station",
        "One station's torsion bar has set: its arm hangs higher.",
        (
            _STATION,
            Parameter("sag", "rad", -0.2, 0.3, 0.0, 0.05, 0.06, "How far its free angle has gone up."),
        ),
        ("edges of obstacles",),
        ("payload", "station_bar of another station"),
        vehicle=_bar,
    ),
    TrackedEffect(
        "payload",
        "Unlisted mass",
        "body",
        "Mass on board that the file does not know.",
        (
            Parameter("mass", "kg", -8000.0, 12000.0, 0.0, 2000.0, 2500.0, "How much more it weighs."),
            Parameter("x", "m", -2.5, 2.5, 0.0, 0.0, 1.0, "Where it lies ahead of the centre of gravity."),
        ),
        ("speed over an obstacle",),
        ("station_bar",),
        vehicle=_payload,
    ),
    TrackedEffect(
        "sensor_scale",
        "Camera scale",
        "sensor",
        "All that the camera measures is too large by this factor.",
        (Parameter("gain", "", 0.5, 2.0, 1.0, 1.0, 0.08, "Factor on what is measured."),),
        ("any motion",),
        (),
        camera=lambda v: Camera(scale=v["gain"]),
    ),
    TrackedEffect(
        "sensor_tilt",
        "Camera rolled",
        "sensor",
        "Travel is taken for height: the camera's horizon is not level.",
        (Parameter("roll", "rad", -0.1, 0.1, 0.0, 0.0, 0.02, "Roll of the camera about its axis of view."),),
        ("travel",),
        (),
        camera=lambda v: Camera(tilt=v["roll"]),
    ),
    TrackedEffect(
        "time_offset",
        "Camera clock",
        "time",
        "The camera's clock is late.",
        (Parameter("seconds", "s", -0.5, 0.5, 0.0, 0.0, 0.1, "How late."),),
        ("any motion",),
        (),
        camera=lambda v: Camera(late=v["seconds"]),
    ),
)

#: Effects of a tracked vehicle by id.
TRACKED_EFFECTS: Final[dict[str, TrackedEffect]] = {e.id: e for e in _EFFECTS}


def tracked_effect(name: str) -> TrackedEffect:
    """The effect called ``name``; InputError names it where there is none."""
    try:
        return TRACKED_EFFECTS[name]
    except KeyError:
        known = ", ".join(TRACKED_EFFECTS)
        raise InputError(
            "twin", "effects", f"{name} is not an effect of a tracked vehicle ({known})"
        ) from None


def apply_tracked(vehicle: TrackedVehicle, effects: Mapping[str, Given]) -> TrackedVehicle:
    """The vehicle with effects by id added; InputError names an unknown one or a value out of bounds."""
    for name, given in effects.items():
        found = tracked_effect(name)
        values = found.values(given)
        if found.vehicle is not None:
            vehicle = found.vehicle(vehicle, values)
    return vehicle


def camera_of(effects: Mapping[str, Given]) -> Camera:
    """What the camera does with all effects by id."""
    camera = Camera()
    for name, given in effects.items():
        found = tracked_effect(name)
        if found.camera is not None:
            own = found.camera(found.values(given))
            camera = Camera(camera.scale * own.scale, camera.late + own.late, camera.tilt + own.tilt)
    return camera
