# SPDX-License-Identifier: Apache-2.0
"""Order and names of the four corners, the same in every array of the package, and the joints of the wheels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

__all__ = ["AXLES", "CORNERS", "WHEELS", "Joint"]

#: Axis of length four in every array: front left, front right, rear left, rear right.
CORNERS: Final = ("front_left", "front_right", "rear_left", "rear_right")
#: The same in words.
WHEELS: Final = tuple(name.replace("_", " ") for name in CORNERS)
AXLES: Final = ("front", "rear")

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Joint:
    """A joint between body and wheel, in ``base_link`` axes, m and rad.

    ``prismatic``: ``position`` m moves the wheel along ``axis``. ``revolute``: it turns the arm about ``axis``.
    ``origin`` is the joint's place, ``wheel`` the wheel's centre from there where ``position`` is 0, ``standing`` the
    position of a vehicle at rest on level ground.
    """

    name: str
    kind: Literal["prismatic", "revolute"]
    origin: Vector
    axis: Vector
    wheel: Vector
    standing: float
    radius: float
    width: float

    def centre(self, position: float) -> Vector:
        """The wheel's centre in ``base_link`` at a position of the joint."""
        (x, y, z), (a, b, c), (u, v, w) = self.origin, self.axis, self.wheel
        if self.kind == "prismatic":
            return x + u + position * a, y + v + position * b, z + w + position * c
        cos, sin = math.cos(position), math.sin(position)  # about y, the only axis of an arm
        return x + u * cos + b * w * sin, y + v, z + w * cos - b * u * sin
