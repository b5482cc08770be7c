# SPDX-License-Identifier: Apache-2.0
"""By what one sound tracked vehicle differs from another of its type, and from the file of the type.

The five parameters of its track, by their places in the bounds of the tracked paper, and of hull and
suspension what no two vehicles have alike: dampers, torsion bars, inertia, mass and where its centre lies. With the
track alone a search makes up by the track for what it cannot say of the hull, and a fault then acts on a wrong vehicle.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from suspension_twin.calibration.tracked_paper import unit_values, values_at
from suspension_twin.drive.types import Floats
from suspension_twin.vehicle.tracked import BOUNDS, TrackedVehicle

__all__ = ["OWN_HIGH", "OWN_LOW", "OWN_SPREAD", "own_places", "own_vehicle"]

_TRACK: Final = len(BOUNDS)
#: Standard deviations: of the track's parameters in their ranges, then logarithms of the dampers' damping, of the bars'
#: stiffness, of the radius of gyration, of the mass (oil ages, steel and loads differ), and m of the centre of gravity.
OWN_SPREAD: Final = np.array([0.15] * _TRACK + [0.15, 0.05, 0.05, 0.03, 0.05])
OWN_LOW: Final = np.array([0.0] * _TRACK + [-3.0 * s for s in OWN_SPREAD[_TRACK:]])
OWN_HIGH: Final = np.array([1.0] * _TRACK + [3.0 * s for s in OWN_SPREAD[_TRACK:]])


def own_places(vehicle: TrackedVehicle) -> Floats:
    """(10,) where a vehicle stands in its own terms: its track's places, and no difference from itself."""
    return np.concatenate([unit_values(vehicle), np.zeros(OWN_SPREAD.size - _TRACK)])


def own_vehicle(vehicle: TrackedVehicle, places: Floats) -> TrackedVehicle:
    """The vehicle that differs from ``vehicle`` by ``places`` (10,), kept within their bounds."""
    places = np.clip(places, OWN_LOW, OWN_HIGH)
    damping, bars, gyration, mass = np.exp(places[_TRACK : _TRACK + 4])
    changes = values_at(places[:_TRACK])
    changes |= {f"stations.{i}.damping": s.damping * damping for i, s in enumerate(vehicle.stations)}
    changes |= {
        "arm.stiffness": vehicle.arm.stiffness * bars,
        "gyration": vehicle.gyration * gyration,
        "mass": vehicle.mass * mass,
        "cog.0": vehicle.cog[0] + places[-1],
    }
    return vehicle.with_changes(changes)
