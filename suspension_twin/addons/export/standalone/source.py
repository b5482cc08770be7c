# SPDX-License-Identifier: Apache-2.0
"""A twin's equations and constants as source text in C or C#."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import jinja2

from suspension_twin.addons.export.standalone.translate import Language, Translation
from suspension_twin.errors import InputError
from suspension_twin.models import rows
from suspension_twin.models.excitation import MAX_STEP
from suspension_twin.models.one_lane import OneLane
from suspension_twin.models.registry import model_of
from suspension_twin.vehicle.twin import Twin

__all__ = ["ModelCode", "model_code", "rendered"]


@dataclass(frozen=True)
class ModelCode:
    """A twin in another language.

    Parameters
    ----------
    text : str
        The functions ``twin_start``, ``twin_advance`` and ``twin_read``.
    initial : str
        Constants and initial state of the twin, a list of numbers.
    rows, failed : int
        Length of that list, and the row that says that the twin has diverged.
    max_step : float
        Longest step in s.
    notes : tuple of str
        Parts of the twin that are not in the code.
    """

    text: str
    initial: str
    rows: int
    failed: int
    max_step: float
    notes: tuple[str, ...]


def model_code(twin: Twin, language: Language, to: str) -> ModelCode:
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
    return ModelCode(translation.text, initial, lane.values.size, rows.FAILED, MAX_STEP, tuple(notes))


def rendered(template: str, **values: object) -> str:
    """A text from a template beside this file; in XML values are escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("suspension_twin.addons.export", "standalone"),
        autoescape=template.endswith(".xml.j2"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(**values)
