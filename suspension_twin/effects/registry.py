# SPDX-License-Identifier: Apache-2.0
"""Every effect there is, found by the name of its file."""

from __future__ import annotations

from importlib import import_module
from typing import Final

from suspension_twin.effects.base import Effect
from suspension_twin.errors import InputError

__all__ = ["EFFECTS", "effect"]

#: The files of this folder that hold an effect, in the order in which effects act.
_FILES: Final = (
    "payload",
    "strut_friction",
    "bump_stop",
    "rebound_stop",
    "progressive_spring",
    "top_mount",
    "damper_play",
    "anti_roll_bar",
    "damper_fade",
    "corner_damper",
    "corner_spring",
    "tyre_damping",
    "unsprung_mass",
    "track_tension",
    "track_wear",
    "station_damper",
    "station_bar",
    "body_bending",
    "powertrain_mount",
    "sensor_offset",
    "road_smoothing",
    "tyre_envelope",
    "road_scale",
    "position_offset",
    "lateral_offset",
    "time_offset",
    "clock_drift",
    "mount_resonance",
    "sensor_tilt",
    "sensor_scale",
    "sensor_bandwidth",
    "sensor_clipping",
)

#: Effects by id. Within a stage they act in this order: a sensor's chain ends in its range.
EFFECTS: Final[dict[str, Effect]] = {name: import_module(f"{__package__}.{name}").EFFECT for name in _FILES}


def effect(name: str, model: str = "full_car") -> Effect:
    """The effect called ``name`` as it is on a model; InputError names it where there is none."""
    try:
        return EFFECTS[name].on(model)
    except KeyError:
        raise InputError("twin", "effects", f"{name} is not an effect ({', '.join(EFFECTS)})") from None
