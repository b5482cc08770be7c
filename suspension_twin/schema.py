# SPDX-License-Identifier: Apache-2.0
"""Schemas of YAML files as pydantic models; whatever is wrong becomes one line that names the keys."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from os import PathLike
from typing import Any, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from suspension_twin.errors import InputError, nearest, shown

__all__ = ["Strict", "checked", "problems", "within"]


class Strict(BaseModel):
    """A part of a file: unknown keys are errors, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


def within(low: float, high: float, unit: str, hint: str = "") -> AfterValidator:
    """Bounds of any real value in ``unit``; outside them the unit is wrong, and ``hint`` asks for it."""

    def check(value: float) -> float:
        if not (math.isfinite(value) and low <= value <= high):
            tail = f" ({hint})" if hint else ""
            limits = f"between {low:g} and {high:g} {unit}".rstrip()
            raise ValueError(f"must lie {limits}, is {value:g}{tail}")
        return value

    return AfterValidator(check)


Model = TypeVar("Model", bound=BaseModel)


def checked(model: type[Model], data: object, source: str | PathLike[str], kind: str) -> Model:
    """``data`` as a ``model``; raises InputError with every problem. ``kind`` of ``source``: "a twin file"."""
    found = problems(model, data, kind)
    if found:
        error = InputError(source, "; ".join(found))
        error.place = ", ".join(dict.fromkeys(_places(model, data)))
        raise error
    return model.model_validate(data)


def problems(model: type[BaseModel], data: object, kind: str) -> list[str]:
    """Everything that is wrong with ``data``: unknown keys, wrong values, and in one text the missing keys."""
    try:
        model.model_validate(data)
    except ValidationError as error:
        details = error.errors(include_url=False)
        missing = [_dotted(d) for d in details if d["type"] == "missing"]
        present = [d for d in details if d["type"] != "missing"]
        present.sort(key=lambda d: d["type"] != "extra_forbidden")
        texts = [_problem(model, d, kind) for d in present]
        if missing:
            texts.append(f"{', '.join(missing)}: {'is' if len(missing) == 1 else 'are'} missing")
        return texts
    return []


def _problem(model: type[BaseModel], detail: Mapping[str, Any], kind: str) -> str:
    text = detail["msg"].removeprefix("Value error, ")
    if detail["type"] == "extra_forbidden":
        *path, last = detail["loc"]
        text = f"is not a key of {kind}{nearest(str(last), _keys(model, path))}"
    elif detail["type"] != "value_error" and not isinstance(detail["input"], dict):
        text = f"{text[0].lower()}{text[1:]}, is {shown(detail['input'])}"
    return ": ".join(part for part in (_dotted(detail), text) if part)


def _places(model: type[BaseModel], data: object) -> Iterator[str]:
    """Keys of ``model`` where ``data`` are wrong; of keys that are none of it, the part that they stand in."""
    try:
        model.model_validate(data)
    except ValidationError as error:
        for detail in error.errors(include_url=False):
            known: list[int | str] = []
            for part in detail["loc"]:
                if not isinstance(part, int) and part not in _keys(model, known):
                    break
                known.append(part)
            yield ".".join(map(str, known)) or "its first level"


def _dotted(detail: Mapping[str, Any]) -> str:
    return ".".join(str(part) for part in detail["loc"])


def _keys(model: type[BaseModel], path: list[int | str]) -> list[str]:
    """The keys that a file may have at ``path``."""
    for part in path:
        field = model.model_fields.get(str(part))
        if field is None:  # a place in a list
            continue
        kinds = (field.annotation, *get_args(field.annotation))
        models = [k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)]
        if not models:
            return []
        model = models[0]
    return list(model.model_fields)
