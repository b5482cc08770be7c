# SPDX-License-Identifier: Apache-2.0
"""The record beside a road file that says what it was made from: ``road.json`` beside ``road.crg``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

__all__ = ["origin_of", "record_path", "warning_of"]


def record_path(road: Path) -> Path:
    """Where the record of a road file lies."""
    return road.with_suffix(".json")


def origin_of(road: Path) -> dict[str, Any] | None:
    """The record of a road that was estimated from drives; None for any other."""
    try:
        record = json.loads(record_path(road).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and record.get("origin") == "drives" else None


def warning_of(road: Path) -> str | None:
    """One line on what a comparison on this road cannot show; None where there is nothing to say."""
    record = origin_of(road)
    if record is None:
        return None
    names = ", ".join(str(d.get("name", "?")) for d in record.get("drives", []))
    return (
        f"{road.name} was estimated from drives ({names}): it has absorbed whatever of vehicle and sensor was the "
        "same in them; only what changed since shows as a gap"
    )
