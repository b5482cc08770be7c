# SPDX-License-Identifier: Apache-2.0
"""Options of a command in groups: a parameter of the command is a record whose fields are options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from inspect import Parameter, Signature, signature
from typing import Any, get_type_hints

__all__ = ["grouped"]


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """A function for typer with the options of ``command`` one by one.

    A parameter of ``command`` annotated with a dataclass stands for the fields of that class, each an
    ``Annotated[type, typer.Option(...)]`` with a default; ``command`` gets the record.
    """
    hints = get_type_hints(command, include_extras=True)
    records = {name: kind for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)}
    parameters = []
    for given in signature(command).parameters.values():
        if given.name in records:
            kind = records[given.name]
            types = get_type_hints(kind, include_extras=True)
            options = [(f.name, types[f.name], f.default) for f in fields(kind)]
        else:
            options = [(given.name, hints[given.name], given.default)]
        parameters += [
            Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
            for name, annotation, default in options
        ]

    def run(**values: Any) -> None:
        filled = {
            name: kind(**{f.name: values.pop(f.name) for f in fields(kind)}) for name, kind in records.items()
        }
        command(**filled, **values)

    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    return run
