# SPDX-License-Identifier: Apache-2.0
"""Live mixed-reality twins of a vehicle's suspension for ROS 2, calibrated from recorded drives.

``import suspension_twin as st`` gives what a program begins with, each imported at its first use::

    drive, twin = st.read_drive("drive"), st.load_twin("twin.yaml")
    result = st.simulate(drive, twin)
    print(result)
    result.plot()
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from suspension_twin.api import calibrate, diagnose, import_drive, read_road, simulate
    from suspension_twin.drive.read import read_drive
    from suspension_twin.vehicle.twin import load_twin, save_twin

__all__ = [
    "__version__",
    "calibrate",
    "diagnose",
    "import_drive",
    "load_twin",
    "read_drive",
    "read_road",
    "save_twin",
    "simulate",
]

__version__ = "0.2.0"

#: Modules of the names that do not live in ``api``.
_HOMES = {"read_drive": "drive.read", "load_twin": "vehicle.twin", "save_twin": "vehicle.twin"}


def __getattr__(name: str) -> object:
    """A public name, from its module."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES.get(name, 'api')}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
