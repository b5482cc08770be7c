# SPDX-License-Identifier: Apache-2.0
"""Constants of units and standards, each in one place."""

from __future__ import annotations

from typing import Final

__all__ = ["STANDARD_GRAVITY"]

STANDARD_GRAVITY: Final = 9.80665  #: m/s², ISO 80000-3
