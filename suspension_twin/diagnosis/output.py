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

__all__ = ["write", "write_document"]


def write(result: DiagnosisResult, folder: Path) -> None:
    """``diagnosis.json``, ``evidence.json`` and ``twin.yaml`` in ``folder``, which is made."""
    write_text(folder / "evidence.json", json.dumps(result.evidence, allow_nan=False) + "\n")
    write_document(result.document, folder)
    save_twin(result.twin, folder / "twin.yaml")


def write_document(document: Mapping[str, Any], folder: Path) -> None:
    """``diagnosis.json`` in ``folder``."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)
    write_text(folder / "diagnosis.json", text + "\n")
