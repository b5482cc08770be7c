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

    Parameters
    ----------
    t : (n,) array
        s, strictly rising.
    x, y : (n,) array
        m.
    yaw : (n,) array
        rad from east, counter-clockwise, continuous.
    speed, lateral_speed : (n,) array
        m/s along x and y of ``base_link``.
    yaw_rate : (n,) array
        rad/s.
    ax, ay : (n,) array
        m/s² along x and y of ``base_link`` of the body above its origin, at the height of the centre of
        gravity, the centripetal part included, gravity not.
    valid : (n,) array of bool
        False where no fix supports the pose.

    Examples
    --------
    >>> import numpy as np
    >>> from suspension_twin.inference.synthetic import path_along
    >>> from suspension_twin.road import flat_road
    >>> t = np.arange(0.0, 2.0, 0.1)
    >>> path = path_along(flat_road(), t, ((0.0, 10.0), (2.0, 10.0)), 100.0)
    >>> round(float(path.x[-1] - path.x[0]), 1)
    19.0
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
