# SPDX-License-Identifier: Apache-2.0
"""The locked pose: where the real vehicle was, in the plane, at given stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats

__all__ = ["Trajectory"]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Planar motion of ``base_link`` in ``map``; every array (n,).

    ``t`` s, strictly rising; ``x``, ``y`` m; ``yaw`` rad, continuous (not wrapped), from east,
    counter-clockwise; ``speed`` and ``lateral_speed`` m/s along base_link x and y; ``yaw_rate``
    rad/s; ``ax``, ``ay`` m/s² the acceleration along base_link's x and y of the body above its origin,
    at the height of the centre of gravity (centripetal part included, gravity not); ``valid`` False
    where no fix supports the pose.
    """

    t: Floats
    x: Floats
    y: Floats
    yaw: Floats
    speed: Floats
    lateral_speed: Floats
    yaw_rate: Floats
    ax: Floats
    ay: Floats
    valid: NDArray[np.bool_]

    def __len__(self) -> int:
        return int(self.t.size)
