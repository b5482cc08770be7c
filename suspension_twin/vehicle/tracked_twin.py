# SPDX-License-Identifier: Apache-2.0
"""A twin whose vehicle runs on tracks: the twin file with ``model: tracked``.

``base_link`` is on the ground under the rearmost road wheels, as it is under a car's rear axle; what
``vehicle`` gives counts from the sprocket's axis, as the tracked paper's drawing does.
"""

from __future__ import annotations

from typing import Literal

from suspension_twin.vehicle.tracked import TrackedVehicle
from suspension_twin.vehicle.twin import Place, Twin

__all__ = ["TrackedTwin"]


class TrackedTwin(Twin):
    """As :class:`~suspension_twin.vehicle.twin.Twin`, around a :class:`TrackedVehicle`.

    ``imu`` may be left out where only markers are measured: it then sits at the centre of gravity's place.
    """

    model: Literal["tracked"] = "tracked"  # type: ignore[assignment]
    vehicle: TrackedVehicle  # type: ignore[assignment]
    imu: Place = Place(position=(2.1, 0.0, 1.1))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """One joint for each road wheel, front to rear, left side first."""
        count = len(self.vehicle.stations)
        return tuple(f"{side}_road_wheel_{i + 1}" for side in ("left", "right") for i in range(count))

    @property
    def cog_height(self) -> float:
        """Height in m of the centre of gravity above the ground."""
        return self.vehicle.cog[1] - self.vehicle.ground_height
