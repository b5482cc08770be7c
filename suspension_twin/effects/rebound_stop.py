# SPDX-License-Identifier: Apache-2.0
"""A progressive stop at the end of rebound travel."""

from __future__ import annotations

from suspension_twin.effects._strut import stop

EFFECT = stop("rebound", "rebound", "extends", "damper_pull", 0.3, order=40)
