# SPDX-License-Identifier: Apache-2.0
"""Files of a diagnosis: ``diagnosis.json`` and ``twin.yaml``."""

from __future__ import annotations

import json
from pathlib import Path

from suspension_twin.diagnosis.request import DiagnosisResult
from suspension_twin.files import write_text
from suspension_twin.vehicle.twin import save_twin

__all__ = ["write"]


def write(result: DiagnosisResult, folder: Path) -> None:
    """``diagnosis.json`` and ``twin.yaml`` in ``folder``, which is made."""
    text = json.dumps(result.document, indent=2, ensure_ascii=False, allow_nan=False)
    write_text(folder / "diagnosis.json", text + "\n")
    save_twin(result.twin, folder / "twin.yaml")
