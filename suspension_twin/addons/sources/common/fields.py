# SPDX-License-Identifier: Apache-2.0
"""Fields of messages from outside, checked."""

from __future__ import annotations

import json
import math
from typing import Any

from suspension_twin.errors import InputError

__all__ = ["number", "read_object"]


def read_object(text: bytes | str) -> dict[str, Any]:
    """A JSON object; InputError for anything else."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("message", "not JSON") from None
    if not isinstance(data, dict):
        raise InputError("message", "not a JSON object")
    return data


def number(value: Any) -> float:
    """A finite number of JSON; TypeError, ValueError or OverflowError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    found = float(value)
    if not math.isfinite(found):
        raise ValueError
    return found
