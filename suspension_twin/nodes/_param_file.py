# SPDX-License-Identifier: Apache-2.0
"""A parameter file checked before ROS reads it: rcl passes over a name that no node has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from suspension_twin.errors import InputError

__all__ = ["check_names", "read_param_file"]

_KEY = "ros__parameters"


def read_param_file(path: Path) -> dict[str, dict[str, Any]]:
    """Values by node (as the file names it: a name, a path or a pattern) and dotted parameter name.

    Raises InputError that says what is wrong with the file.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, error.strerror or "cannot be read") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark else ""
        raise InputError(path, f"{where}{getattr(error, 'problem', None) or 'not YAML'}") from None
    except (RecursionError, ValueError):  # brackets without end, an impossible date
        raise InputError(path, "not YAML that can be read") from None
    if not isinstance(data, dict):
        raise InputError(path, f"not a parameter file: a mapping of nodes with '{_KEY}' is expected")
    return {node: dict(_flat(path, values)) for node, values in _sections(path, data, "")}


def _sections(path: Path, data: Mapping[Any, Any], prefix: str) -> Iterator[tuple[str, Mapping[Any, Any]]]:
    """Nodes and their parameters, namespaces nested or written out."""
    for name, inner in data.items():
        full = f"{prefix}/{name}" if prefix else str(name)
        if not isinstance(inner, dict):
            raise InputError(path, full, f"holds no '{_KEY}'")
        if _KEY in inner:
            if not isinstance(inner[_KEY], dict):
                raise InputError(path, f"{full}: {_KEY}", "must be a mapping of parameters")
            yield full, inner[_KEY]
        else:
            yield from _sections(path, inner, full)


def _flat(path: Path, values: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        full = f"{prefix}{name}"
        if isinstance(value, dict):
            yield from _flat(path, value, f"{full}.")
        else:
            yield full, value


def check_names(
    path: Path, wanted: Mapping[str, Mapping[str, Any]], known: Mapping[str, Iterable[str]]
) -> None:
    """Raise InputError for a parameter that none of the nodes it is meant for has.

    ``known`` are the parameters of each node by the node's name. Nodes that are not ours may stand in
    the file; what a pattern gives must be known to one of ours.
    """
    names = {node: set(parameters) for node, parameters in known.items()}
    for section, parameters in wanted.items():
        own = section.rpartition("/")[2]
        if "*" in own:
            have = set().union(*names.values())
        elif own in names:
            have = names[own]
        else:
            continue
        for name in parameters:
            if name not in have and not name.startswith("qos_overrides."):
                raise InputError(path, f"{section}: {name}", "no such parameter")
