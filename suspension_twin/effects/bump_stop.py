# SPDX-License-Identifier: Apache-2.0
"""A progressive stop at the end of jounce travel."""

from __future__ import annotations

from suspension_twin.effects._strut import stop
from suspension_twin.models.rows import BUMP_GAP, BUMP_RATE, BUMP_RISE

__all__ = ["EFFECT"]

EFFECT = stop("bump", "jounce", "compresses", "damper_push", 0.25, (BUMP_GAP, BUMP_RATE, BUMP_RISE))
