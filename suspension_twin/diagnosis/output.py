# SPDX-License-Identifier: Apache-2.0
"""Files of a diagnosis: ``diagnosis.json``, ``evidence.json`` and ``twin.yaml``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from suspension_twin.diagnosis.request import DiagnosisResult
from suspension_twin.files import write_text
from suspension_twin.vehicle.twin import save_twin

__all__ = ["values_of", "write", "write_document"]


def write(result: DiagnosisResult, folder: Path) -> None:
    """``diagnosis.json``, ``evidence.json`` and ``twin.yaml`` in ``folder``, which is made."""
    write_text(folder / "evidence.json", json.dumps(result.evidence, allow_nan=False) + "\n")
    write_document(result.document, folder)
    save_twin(result.twin, folder / "twin.yaml")


def write_document(document: Mapping[str, Any], folder: Path) -> None:
    """``diagnosis.json`` in ``folder``."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)
    write_text(folder / "diagnosis.json", text + "\n")


def values_of(cause: Mapping[str, Any]) -> str:
    """A cause's parameters in a line, with their 90 % intervals where there are any."""
    ends = cause.get("parameter_intervals", {})
    return ", ".join(
        f"{name} {_plain(value)}" + (f" ({' to '.join(map(_plain, ends[name]))})" if name in ends else "")
        for name, value in cause["parameters"].items()
    )


def _plain(value: float) -> str:
    """Four digits, and no powers of ten for a stiffness in N/m."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
