# SPDX-License-Identifier: Apache-2.0
"""The record beside a road file that says what it was made from: ``road.json`` beside ``road.crg``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

__all__ = ["origin_of", "record_path", "scan_holes", "warning_of"]


def record_path(road: Path) -> Path:
    """Where the record of a road file lies."""
    return road.with_suffix(".json")


def origin_of(road: Path) -> dict[str, Any] | None:
    """The record of a road that was estimated from drives; None for any other."""
    return _record(road, "drives")


def scan_holes(road: Path) -> list[dict[str, float]]:
    """Places of a road from a scan where nothing was measured and its file has heights all the same; m."""
    record = _record(road, "scan")
    holes = [] if record is None else record.get("bridged", [])
    keys = {"u_low", "u_high", "v_low", "v_high", "nodes"}
    if not isinstance(holes, list):
        return []
    return [h for h in holes if isinstance(h, dict) and keys <= set(h)]


def _record(road: Path, origin: str) -> dict[str, Any] | None:
    try:
        record = json.loads(record_path(road).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and record.get("origin") == origin else None


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
