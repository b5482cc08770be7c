# SPDX-License-Identifier: Apache-2.0
"""A car with linear springs and dampers, and the matrices of its seven degrees of freedom from the numbers of its file.

The degrees of freedom are heave, roll (left side up) and pitch (nose down) of the sprung mass and the heights of the
four wheels, from standing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.twin import Twin

SPRING, DAMPER, WHEEL = 26e3, 1800.0, 40.0  # N/m, N s/m, kg


def linear(twin: Twin) -> Twin:
    """``twin`` with one straight spring and one straight damper at all wheels."""
    axle = {
        "unsprung_mass": WHEEL,
        "spring": {"compression": [0.5], "force": [0.5 * SPRING]},
        "damper_push": {"velocity": [1.0], "force": [DAMPER]},
        "damper_pull": {"velocity": [1.0], "force": [DAMPER]},
    }
    return twin.with_changes({"vehicle.front": axle, "vehicle.rear": axle})


@dataclass(frozen=True)
class Matrices:
    """M q'' + C q' + K q = forces; ``reach`` (4, 7) turns q into the compressions of the four struts, ``sensor`` (7,)
    into the height of the sensor, ``load`` (4,) N is what the tyres carry."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    reach: np.ndarray
    sensor: np.ndarray
    load: np.ndarray

    def amplitude(self, omega: float, force: np.ndarray) -> np.ndarray:
        """(7,) complex q for a harmonic force (7,) of angular frequency omega."""
        return np.asarray(
            np.linalg.solve(self.stiffness + 1j * omega * self.damping - omega**2 * self.mass, force)
        )


def matrices(twin: Twin, tyres: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)) -> Matrices:
    """Those of a ``linear`` car; ``tyres`` are factors on the stiffness of each."""
    v = twin.vehicle
    wheels = np.array([[v.wheelbase, v.front_track / 2], [v.wheelbase, -v.front_track / 2]])
    wheels = np.vstack([wheels, [[0.0, v.rear_track / 2], [0.0, -v.rear_track / 2]]])
    sprung = v.mass - 4 * WHEEL
    centre = (v.mass * np.array(v.cog[:2]) - WHEEL * wheels.sum(axis=0)) / sprung
    reach = np.zeros((4, 7))
    for i, (x, y) in enumerate(wheels - centre):
        reach[i, :3] = -1.0, -y, x
        reach[i, 3 + i] = 1.0
    mass = np.diag([sprung, v.sprung_inertia.roll, v.sprung_inertia.pitch, *[WHEEL] * 4])
    stiffness = SPRING * reach.T @ reach
    stiffness[range(3, 7), range(3, 7)] += v.tyre.vertical_stiffness * np.array(tyres)
    sensor = np.zeros(7)
    sensor[:3] = 1.0, twin.imu.position[1] - centre[1], -(twin.imu.position[0] - centre[0])
    front = sprung * G * centre[0] / v.wheelbase
    axles = ((front, v.front_track), (sprung * G - front, v.rear_track))
    load = np.array([WHEEL * G + w * (0.5 + side * centre[1] / t) for w, t in axles for side in (1, -1)])
    return Matrices(mass, DAMPER * reach.T @ reach, stiffness, reach, sensor, load)


def tone(t: np.ndarray, values: np.ndarray, omega: float) -> np.ndarray:
    """(k,) complex amplitudes of values (n, k) at angular frequency omega: least squares."""
    basis = np.stack([np.cos(omega * t), np.sin(omega * t), np.ones_like(t)], axis=1)
    found = np.linalg.lstsq(basis, values, rcond=None)[0]
    return np.asarray(found[0] - 1j * found[1])
