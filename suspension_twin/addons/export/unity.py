# SPDX-License-Identifier: Apache-2.0
"""Unity: a C# class with the equations of a car, such as the car paper's mass-spring-damper model (``msd``).

The class does not depend on Unity: call ``Step`` from ``FixedUpdate``, or anywhere else in C#.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from suspension_twin.addons.export.registry import ExportSettings, Target
from suspension_twin.addons.export.standalone.source import model_code, rendered
from suspension_twin.addons.export.standalone.translate import CSHARP
from suspension_twin.errors import printable
from suspension_twin.files import write_text
from suspension_twin.models.connectors import INPUTS, OUTPUTS
from suspension_twin.vehicle.corners import CORNERS
from suspension_twin.vehicle.twin import Twin

__all__ = ["TARGET"]


def _pascal(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_"))


def _outputs() -> Iterator[tuple[str, str]]:
    """Meaning and member of each output; those of the corners are one method, such as ``TyreForce`` of
    ``tyre_force_front_left`` to ``tyre_force_rear_right``."""
    for index, variable in enumerate(OUTPUTS):
        corner = next((c for c in CORNERS if variable.name.endswith(f"_{c}")), None)
        if corner is None:
            member = f"{_pascal(variable.name)} {{ get {{ return output[{index}]; }} }}"
            yield f"{variable.description}, {variable.unit}", member
        elif corner == CORNERS[0]:
            name = _pascal(variable.name.removesuffix(f"_{corner}"))
            meaning = f"{variable.description.partition(',')[0]} at a corner, {variable.unit}"
            yield meaning, f"{name}(int corner) {{ return output[{index} + corner]; }}"


def _write(twin: Twin, path: Path, settings: ExportSettings) -> Sequence[str]:
    code = model_code(twin, CSHARP, "C#")
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    text = rendered(
        "unity.cs.j2",
        heading=printable(twin.vehicle.name),
        model=twin.model,
        name=name if re.match("[A-Za-z]", name) else f"Twin{name}",
        max_step=code.max_step,
        inputs=INPUTS[len(CORNERS) :],
        outputs=_outputs(),
        rows=code.rows,
        count=len(OUTPUTS),
        failed=code.failed,
        functions=code.text.strip(),
        initial=code.initial,
        pascal=_pascal,
    )
    write_text(path, text)
    return code.notes


TARGET = Target("a C# class with the equations of the twin, for Unity", (".cs",), _write)
