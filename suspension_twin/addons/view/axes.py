# SPDX-License-Identifier: Apache-2.0
"""Poses of ROS (x forward, y left, z up, right-handed) in the left-handed axes of game engines."""

from __future__ import annotations

import math
from collections.abc import Sequence

__all__ = ["to_unity", "to_unreal", "unreal_rotator"]

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def to_unity(place: Sequence[float], turn: Sequence[float]) -> tuple[Vector, Quaternion]:
    """A pose in Unity's axes: x right, y up, z forward.

    Parameters
    ----------
    place : sequence of 3 floats
        x, y, z in ``map``, m.
    turn : sequence of 4 floats
        Quaternion x, y, z, w.

    Returns
    -------
    tuple
        Position in m and quaternion x, y, z, w in Unity's axes. On the map Unity's z is then east and its x south.

    Examples
    --------
    >>> to_unity((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))[0]
    (-2.0, 3.0, 1.0)
    """
    x, y, z = place
    a, b, c, w = turn
    return (-y, z, x), (b, -c, -a, w)


def to_unreal(place: Sequence[float], turn: Sequence[float]) -> tuple[Vector, Quaternion]:
    """A pose in the axes of CARLA and Unreal: x forward, y right, z up.

    Parameters
    ----------
    place : sequence of 3 floats
        x, y, z in ``map``, m.
    turn : sequence of 4 floats
        Quaternion x, y, z, w.

    Returns
    -------
    tuple
        Position in m (CARLA's unit; Unreal's own is cm) and quaternion x, y, z, w.

    Examples
    --------
    >>> to_unreal((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))[0]
    (1.0, -2.0, 3.0)
    """
    x, y, z = place
    a, b, c, w = turn
    return (x, -y, z), (-a, b, -c, w)


def unreal_rotator(turn: Sequence[float]) -> Vector:
    """Roll, pitch, yaw in degrees as ``carla.Rotation`` and Unreal's ``FRotator`` have them.

    Parameters
    ----------
    turn : sequence of 4 floats
        Quaternion x, y, z, w in ROS's axes.

    Returns
    -------
    tuple of float
        Roll (right side down), pitch (nose up) and yaw (clockwise from above).

    Examples
    --------
    >>> tuple(round(v, 6) for v in unreal_rotator((0.0, 0.0, math.sin(0.25), math.cos(0.25))))
    (0.0, -0.0, -28.64789)
    """
    x, y, z, w = turn
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return math.degrees(roll), -math.degrees(pitch), -math.degrees(yaw)
