# SPDX-License-Identifier: Apache-2.0
"""Add-ons: live sources, roads from scans and drives, fleets, exports, the live view, plans, vehicles in an FMU.

The core imports none of them: :mod:`suspension_twin.registry` reads :data:`PLUGINS`, as it reads the entry points of
other packages.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

__all__ = ["PLUGINS"]

#: By group and name the place of each object: ``module:attribute``, or ``module`` with the attribute of its group.
PLUGINS: Final[Mapping[str, Mapping[str, str]]] = {
    "commands": {
        "first-drive": f"{__name__}.cli:FIRST_DRIVE",
        "connect": f"{__name__}.cli:CONNECT",
        "record": f"{__name__}.cli:RECORD",
        "fleet": f"{__name__}.cli:FLEET",
        "export": f"{__name__}.cli:EXPORT",
        "plan": f"{__name__}.cli:PLAN",
    },
    "road_commands": {
        "drives": f"{__name__}.cli.road_drives:command",
        "scan": f"{__name__}.cli.road_scan:command",
    },
    "companions": {
        "source": f"{__name__}.cli.companions:Sources",
        "record": f"{__name__}.cli.companions:Recording",
        "learn-road": f"{__name__}.cli.companions:LearntRoad",
        "view": f"{__name__}.cli.pages:Viewer",
        "foxglove": f"{__name__}.cli.pages:Foxglove",
    },
    "models": {"fmu": f"{__name__}.fmu"},
    "fleets": {"live": f"{__name__}.cli.live_fleet:run_fleet"},
    "nodes": {
        "source": f"{__name__}.nodes.source:SourceNode",
        "road_learner": f"{__name__}.nodes.road_learner:RoadLearnerNode",
        "viewer": f"{__name__}.nodes.viewer:ViewerNode",
        "foxglove_bridge": f"{__name__}.nodes.foxglove_bridge:FoxgloveBridgeNode",
    },
}
