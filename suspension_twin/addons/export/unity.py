# SPDX-License-Identifier: Apache-2.0
"""Unity: a C# class with the equations of a car, such as the car paper's mass-spring-damper model (``msd``).

The class does not depend on Unity: call ``Step`` from ``FixedUpdate``, or anywhere else in C#.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from suspension_twin.addons.export.registry import ExportSettings, Target
from suspension_twin.addons.export.standalone.source import model_code
from suspension_twin.addons.export.standalone.translate import CSHARP
from suspension_twin.errors import printable
from suspension_twin.files import write_text
from suspension_twin.models.connectors import INPUTS, OUTPUTS
from suspension_twin.vehicle.corners import CORNERS
from suspension_twin.vehicle.twin import Twin

__all__ = ["TARGET"]

_CLASS: Final = """\
// {heading}
// Equations and constants of a suspension's twin, model {model}. SI units; x forward, y left, z up; pitch nose down and
// roll left side up are positive. Corners: 0 front left, 1 front right, 2 rear left, 3 rear right.
using System;

public sealed class {name}
{{
    /// <summary>Longest step of the integration, s.</summary>
    public const double MaxStep = {max_step!r};

    /// <summary>Inputs, as they are where the next Step ends.</summary>
    public readonly double[] RoadHeight = new double[4];
{inputs}
{outputs}

    /// <summary>Whether it has diverged, or has no static equilibrium: call Restart.</summary>
    public bool Failed {{ get; private set; }}

    readonly double[] w = new double[{rows}];
    readonly double[] output = new double[{count}];
    double[] road = new double[4], lastRoad = new double[4];
    double[] motion = new double[{motions}], lastMotion = new double[{motions}];

    /// <summary>In static equilibrium on a road at height 0. To begin elsewhere: set inputs, call Restart.</summary>
    public {name}()
    {{
        Restart();
    }}

    /// <summary>Static equilibrium under the inputs as they are.</summary>
    public void Restart()
    {{
        Array.Copy(Initial, w, w.Length);
        Take();
        twin_start(w, road, motion);
        Look();
    }}

    /// <summary>
    /// Go on by so many seconds, to where the inputs are as they are now. They run linearly from the last call's.
    /// </summary>
    public void Step(double seconds)
    {{
        if (!(seconds >= 0.0) || double.IsInfinity(seconds))
            throw new ArgumentOutOfRangeException("seconds");
        if (seconds == 0.0 || Failed)
            return;
        Take();
        int n = Math.Max(1, (int)Math.Ceiling(seconds / MaxStep - 2e-3));
        twin_advance(w, n, seconds / n, lastRoad, road, lastMotion, motion);
        Look();
    }}

    void Take()
    {{
        double[] before = lastRoad;
        lastRoad = road;
        road = before;
        before = lastMotion;
        lastMotion = motion;
        motion = before;
        Array.Copy(RoadHeight, road, 4);
{take}
    }}

    void Look()
    {{
        twin_read(w, motion, output);
        Failed = w[{failed}] != 0.0;
        foreach (double value in output)
            Failed |= double.IsNaN(value) || double.IsInfinity(value);
    }}

    // What follows is written out from the kernel of the twin.

{functions}

    static readonly double[] Initial =
    {{
{initial}
    }};
}}
"""


def _pascal(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_"))


def _inputs() -> Iterator[str]:
    for variable in INPUTS[len(CORNERS) :]:
        yield f"    /// <summary>{variable.description}, {variable.unit}.</summary>"
        yield f"    public double {_pascal(variable.name)};"


def _outputs() -> Iterator[str]:
    """Properties; outputs of the corners are one method, such as ``TyreForce`` of ``tyre_force_front_left`` to
    ``tyre_force_rear_right``."""
    for index, variable in enumerate(OUTPUTS):
        name, meaning = variable.name, variable.description
        corner = next((c for c in CORNERS if name.endswith(f"_{c}")), None)
        getter = f" {{ get {{ return output[{index}]; }} }}"
        if corner == CORNERS[0]:
            name, meaning = name.removesuffix(f"_{corner}"), f"{meaning.partition(',')[0]} at a corner"
            getter = f"(int corner) {{ return output[{index} + corner]; }}"
        if corner in (None, CORNERS[0]):
            yield f"    /// <summary>{meaning}, {variable.unit}.</summary>"
            yield f"    public double {_pascal(name)}{getter}"


def _write(twin: Twin, path: Path, settings: ExportSettings) -> Sequence[str]:
    code = model_code(twin, CSHARP, "C#")
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    motions = INPUTS[len(CORNERS) :]
    take = (f"        motion[{k}] = {_pascal(variable.name)};" for k, variable in enumerate(motions))
    text = _CLASS.format(
        heading=printable(twin.vehicle.name),
        model=twin.model,
        name=name if re.match("[A-Za-z]", name) else f"Twin{name}",
        max_step=code.max_step,
        inputs="\n".join(_inputs()),
        outputs="\n".join(_outputs()),
        rows=code.rows,
        count=len(OUTPUTS),
        motions=len(motions),
        take="\n".join(take),
        failed=code.failed,
        functions=textwrap.indent(code.text.strip(), "    "),
        initial=textwrap.indent(code.initial, "    "),
    )
    write_text(path, text)
    return code.notes


TARGET = Target("a C# class with the equations of the twin, for Unity", (".cs",), _write)
