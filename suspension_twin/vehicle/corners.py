# SPDX-License-Identifier: Apache-2.0
"""Order and names of the four corners, the same in every array of the package."""

from __future__ import annotations

from typing import Final

__all__ = ["AXLES", "CORNERS", "FRONT", "REAR", "SHORT", "WHEELS"]

#: Axis of length four in every array: front left, front right, rear left, rear right.
CORNERS: Final = ("front_left", "front_right", "rear_left", "rear_right")
SHORT: Final = ("FL", "FR", "RL", "RR")
#: As people say it.
WHEELS: Final = tuple(name.replace("_", " ") for name in CORNERS)
AXLES: Final = ("front", "rear")
FRONT: Final = (0, 1)
REAR: Final = (2, 3)
