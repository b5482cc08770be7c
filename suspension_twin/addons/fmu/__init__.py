# SPDX-License-Identifier: Apache-2.0
"""``fmu``: a vehicle model that an FMU for co-simulation simulates."""

from suspension_twin.addons.fmu.model import MODEL
from suspension_twin.addons.fmu.twin import FmuTwin as TWIN

__all__ = ["MODEL", "TWIN"]
