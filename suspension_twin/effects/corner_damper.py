# SPDX-License-Identifier: Apache-2.0
"""One wheel's damper differs from its axle's."""

from __future__ import annotations

from suspension_twin.effects._strut import odd_corner
from suspension_twin.models.rows import DAMPER_SCALE

__all__ = ["EFFECT"]

EFFECT = odd_corner("damper", "spring", DAMPER_SCALE, 0.1)
