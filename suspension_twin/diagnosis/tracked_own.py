# SPDX-License-Identifier: Apache-2.0
"""By what one sound tracked vehicle differs from another of its type, and from the file of the type.

The five parameters of its track, by their places in the bounds of the tracked paper, how long the track is (a few
parts in a thousand of it are all of its tension), and of hull and suspension what no two vehicles have alike: dampers,
torsion bars, inertia, mass and where its centre lies; and how its driver holds the speed. With the track alone a search
makes up by the track for what it cannot say of the hull, and a fault then acts on a wrong vehicle.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.tracked_paper import unit_values, values_at
from suspension_twin.vehicle.tracked import BOUNDS, Driver, TrackedVehicle

__all__ = ["OWN_HIGH", "OWN_LOW", "OWN_SPREAD", "driven", "own_places", "own_vehicle"]

_TRACK: Final = len(BOUNDS)
#: Standard deviations: of the track's parameters in their ranges, then logarithms of the dampers' damping, of the bars'
#: stiffness, of the radius of gyration, of the mass (oil ages, steel and loads differ), m of the centre of gravity, the
#: logarithm of the driver's gain, and mm of the idler's setting by which the track is shorter.
OWN_SPREAD: Final = np.array([0.15] * _TRACK + [0.15, 0.05, 0.05, 0.03, 0.05, 0.5, 12.0])
OWN_LOW: Final = np.array([0.0] * _TRACK + [-3.0 * s for s in OWN_SPREAD[_TRACK:]])
OWN_HIGH: Final = np.array([1.0] * _TRACK + [3.0 * s for s in OWN_SPREAD[_TRACK:]])


def own_places(vehicle: TrackedVehicle) -> Floats:
    """(12,) where a vehicle stands in its own terms: its track's places, and no difference from itself."""
    return np.concatenate([unit_values(vehicle), np.zeros(OWN_SPREAD.size - _TRACK)])


def driven(vehicle: TrackedVehicle) -> TrackedVehicle:
    """The vehicle with somebody who drives it: nobody moves a tank along a prescribed way."""
    return vehicle if vehicle.driver is not None else vehicle.model_copy(update={"driver": Driver()})


def own_vehicle(vehicle: TrackedVehicle, places: Floats) -> TrackedVehicle:
    """The vehicle that differs from ``vehicle`` by ``places`` (12,), kept within their bounds."""
    places = np.clip(places, OWN_LOW, OWN_HIGH)
    damping, bars, gyration, mass = np.exp(places[_TRACK : _TRACK + 4])
    vehicle, held = driven(vehicle), np.exp(places[_TRACK + 5])
    assert vehicle.driver is not None
    changes = values_at(places[:_TRACK])
    changes |= {f"stations.{i}.damping": s.damping * damping for i, s in enumerate(vehicle.stations)}
    changes |= {
        "arm.stiffness": vehicle.arm.stiffness * bars,
        "gyration": vehicle.gyration * gyration,
        "mass": vehicle.mass * mass,
        "cog.0": vehicle.cog[0] + places[_TRACK + 4],
        "idler.taut_at": vehicle.idler.taut_at + places[-1],
    }
    changes |= {f"driver.{k}": getattr(vehicle.driver, k) * held for k in ("gain", "reset")}
    return vehicle.with_changes(changes)
