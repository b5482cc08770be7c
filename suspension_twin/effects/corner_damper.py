# SPDX-License-Identifier: Apache-2.0
"""One wheel's damper differs from its axle's."""

from __future__ import annotations

from suspension_twin.effects._strut import odd_corner

EFFECT = odd_corner("damper", "spring", 0.1, order=100)
