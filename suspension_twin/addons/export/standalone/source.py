# SPDX-License-Identifier: Apache-2.0
"""A twin's equations and constants as source text in C or C#."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

from suspension_twin.addons.export.standalone.languages import Language
from suspension_twin.addons.export.standalone.translate import Translation
from suspension_twin.errors import InputError
from suspension_twin.models import rows
from suspension_twin.models.excitation import MAX_STEP
from suspension_twin.models.one_lane import OneLane
from suspension_twin.models.registry import model_of
from suspension_twin.vehicle.twin import Twin

__all__ = ["Source", "written_out"]


@dataclass(frozen=True)
class Source:
    """``text`` of the functions ``twin_start``, ``twin_advance`` and ``twin_read``, the constants of the twin as a list
    of numbers, how many they are, the row that says that the twin has diverged, the longest step in s, and notes on
    what of the twin is not in it."""

    text: str
    initial: str
    rows: int
    failed: int
    max_step: float
    notes: tuple[str, ...]


def written_out(twin: Twin, language: Language, to: str) -> Source:
    """The source of a twin; InputError where its model has no kernel of one lane."""
    make = model_of(twin).one_lane
    if make is None:
        raise InputError("twin", "model", f"{twin.model} cannot be written out for {to}")
    lane: OneLane = make(twin, MAX_STEP)
    translation = Translation(language)
    for function in (lane.start, lane.advance, lane.read):
        translation.add(function)
    numbers = ", ".join(repr(value) for value in lane.values.tolist())
    initial = "\n".join(textwrap.wrap(numbers, 100, initial_indent="    ", subsequent_indent="    "))
    notes = [f"Not in it, as it acts on the sensor, its clock or the road: {name}" for name in lane.outside]
    if twin.imu.latency:
        notes.append("Not in it: imu.latency")
    return Source(translation.text, initial, lane.values.size, rows.FAILED, MAX_STEP, tuple(notes))
