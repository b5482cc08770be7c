# SPDX-License-Identifier: Apache-2.0
"""A car by other code than this project's, as an FMU compiled from ``other_car.c``, and the same car as a ``full_car``.

For the tests and benchmarks of ``model: fmu``.
"""

from __future__ import annotations

import subprocess
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from extras import missing

from suspension_twin.vehicle.corners import CORNERS
from suspension_twin.vehicle.twin import Twin, load_twin

try:
    import fmpy
except ImportError:
    missing("fmpy", "fmu")

__all__ = ["SIDES", "STIFFNESS", "fmu_section", "linear_car", "other_car", "vehicle_of"]

SIDES = dict(zip(CORNERS, ("fl", "fr", "rl", "rr"), strict=True))
#: N/m and N s/m of ``linear_car``, which the FMU has by its parameters.
STIFFNESS = {"k_front": 26e3, "k_rear": 23e3, "c_front": 2600.0, "c_rear": 2200.0}
_PARAMETERS = (
    "k_front",
    "k_rear",
    "c_front",
    "c_rear",
    "k_tyre",
    "m_body",
    "m_wheel",
    "i_roll",
    "i_pitch",
    "limit",
)
_OUTPUTS = {
    "heave": "z",
    "roll": "phi",
    "pitch": "theta",
    "angular_rate_x": "w_x",
    "angular_rate_y": "w_y",
    "heave_acceleration": "z_dd",
    "roll_acceleration": "phi_dd",
    "pitch_acceleration": "theta_dd",
    **{f"deflection_{c}": f"travel_{s}" for c, s in SIDES.items()},
    **{f"tyre_force_{c}": f"load_{s}" for c, s in SIDES.items()},
}
_INPUTS = {
    **{f"road_height_{c}": f"ground_{s}" for c, s in SIDES.items()},
    "longitudinal_acceleration": "a_x",
    "lateral_acceleration": "a_y",
    "yaw_acceleration": "turn",
}


def other_car(path: Path, **attributes: str) -> None:
    """Compile the FMU; ``attributes`` replace those of its element CoSimulation."""
    source = Path(__file__).with_suffix(".c")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder, "other_car.so")
        headers = Path(fmpy.__file__).parent / "c-code"
        command = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", f"-I{headers}", str(source), "-lm"]
        subprocess.run([*command, "-o", str(library)], check=True)
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("modelDescription.xml", _description(attributes))
            archive.write(library, f"binaries/{fmpy.platform}/other_car{fmpy.sharedLibraryExtension}")


def _description(attributes: dict[str, str]) -> str:
    def variable(name: str, reference: int, causality: str, start: str) -> str:
        kind = "tunable" if causality == "parameter" else "continuous"
        return (
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
            f'variability="{kind}"><Real{start}/></ScalarVariable>'
        )

    inputs = [variable(name, k, "input", ' start="0"') for k, name in enumerate(_INPUTS.values())]
    known = [
        variable(name, len(_INPUTS) + k, "parameter", ' start="1"') for k, name in enumerate(_PARAMETERS)
    ]
    outputs = [variable(name, 100 + k, "output", "") for k, name in enumerate(_OUTPUTS.values())]
    given = {"modelIdentifier": "other_car", "canHandleVariableCommunicationStepSize": "true", **attributes}
    said = " ".join(f'{key}="{value}"' for key, value in given.items())
    unknown = "".join(f'<Unknown index="{len(inputs + known) + 1 + k}"/>' for k in range(len(outputs)))
    return (
        '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="other car" '
        f'guid="{{other-car}}"><CoSimulation {said}/>'
        f"<ModelVariables>{''.join(inputs + known + outputs)}</ModelVariables>"
        f"<ModelStructure><Outputs>{unknown}</Outputs></ModelStructure></fmiModelDescription>"
    )


def fmu_section(file: Path, **parameters: Any) -> dict[str, Any]:
    """The section ``fmu`` of a twin file for it, with values or (value, low, high) of ``parameters``."""
    known = {
        key: {"value": value}
        if isinstance(value, float)
        else dict(zip(("value", "low", "high"), value, strict=True))
        for key, value in parameters.items()
    }
    return {"file": str(file), "settle": 2.0, "inputs": _INPUTS, "outputs": _OUTPUTS, "parameters": known}


def vehicle_of(twin: Any) -> dict[str, Any]:
    """The section ``vehicle`` of a twin file of the model ``fmu`` for a vehicle that a ``full_car`` describes."""
    vehicle, (x, y, z), radius = twin.vehicle, twin.vehicle.cog, twin.vehicle.tyre.radius
    front, rear = vehicle.front.unsprung_mass, vehicle.rear.unsprung_mass
    sprung = vehicle.mass - 2 * (front + rear)
    body = (
        (vehicle.mass * x - 2 * front * vehicle.wheelbase) / sprung,
        vehicle.mass * y / sprung,
        (vehicle.mass * z - 2 * (front + rear) * radius) / sprung,
    )
    return {
        "name": vehicle.name,
        "wheelbase": vehicle.wheelbase,
        "front_track": vehicle.front_track,
        "rear_track": vehicle.rear_track,
        "cog": [x, y, z],
        "sprung_cog": list(body),
        "tyre": {"radius": radius},
        "static_deflection": [a.static_compression for a in vehicle.axles.values()],
    }


def linear_car(twin_file: Path) -> Twin:
    """A twin with one slope in each characteristic, tracks of 1.6 m: the car of ``other_car.c``."""
    changes: dict[str, Any] = {"vehicle.front_track": 1.6, "vehicle.rear_track": 1.6}
    for axle in ("front", "rear"):
        changes[f"vehicle.{axle}.spring"] = {"compression": (1.0,), "force": (STIFFNESS[f"k_{axle}"],)}
        for side in ("push", "pull"):
            changes[f"vehicle.{axle}.damper_{side}"] = {
                "velocity": (1.0,),
                "force": (STIFFNESS[f"c_{axle}"],),
            }
    return load_twin(twin_file).with_changes(changes)
