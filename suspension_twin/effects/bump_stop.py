# SPDX-License-Identifier: Apache-2.0
"""A progressive stop at the end of jounce travel."""

from __future__ import annotations

from suspension_twin.effects._strut import stop

EFFECT = stop("bump", "jounce", "compresses", "damper_push", 0.25, order=30)
