# SPDX-License-Identifier: Apache-2.0
"""One wheel's spring differs from its axle's."""

from __future__ import annotations

from suspension_twin.effects._strut import odd_corner

EFFECT = odd_corner("spring", "damper", 0.05, order=110, upright=True)
