# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes: declared with a description and a range, checked, read from parameter files."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from suspension_twin.drive.unpack import Budget, within_limits
from suspension_twin.errors import InputError
from suspension_twin.files import Folders, for_peers, read_yaml, reader, reading
from suspension_twin.live.gap import CalibrationGap, calibration_gap
from suspension_twin.road import Road, load_road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = [
    "FILTER",
    "FOLDERS",
    "LOW_PASS",
    "TWIN",
    "NamedTwin",
    "Param",
    "ParameterSet",
    "Values",
    "check_names",
    "filter_of",
    "folders_of",
    "low_pass_text",
    "named_twin",
    "read_named",
    "read_param_file",
    "twin_of",
]

Values = dict[str, Any]

_TYPES = {
    bool: "true or false",
    int: "an integer",
    float: "a number with a decimal point (20.0)",
    str: "a string",
}
_KEY = "ros__parameters"
_OFF = "off"


@dataclass(frozen=True)
class Param:
    """One parameter. ``low`` and ``high`` bound a number, ``choices`` a string. A ``read_only`` one cannot be
    set while the node runs, all others can."""

    name: str
    default: bool | int | float | str | list[float]
    text: str
    low: float | None = None
    high: float | None = None
    read_only: bool = False
    choices: tuple[str, ...] = ()

    def descriptor(self) -> ParameterDescriptor:
        """Description for ``ros2 param describe``."""
        out = ParameterDescriptor(name=self.name, description=self.text, read_only=self.read_only)
        if self.low is not None and self.high is not None:
            if isinstance(self.default, float):
                out.floating_point_range = [FloatingPointRange(from_value=self.low, to_value=self.high)]
            elif isinstance(self.default, int):
                out.integer_range = [IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)]
        if self.choices:
            out.additional_constraints = "one of " + ", ".join(self.choices)
        out.dynamic_typing = _OFF in self.choices
        return out

    def read(self, value: Any) -> Any:
        """``value`` as meant: ROS reads the word off of a command line as false."""
        return _OFF if value is False and _OFF in self.choices else value

    def refuse(self, value: Any) -> str | None:
        """Why ``value`` is not accepted; None if it is."""
        numbers = value if isinstance(self.default, list) else [value]
        for number in numbers if isinstance(self.default, (float, list)) else ():
            if not math.isfinite(number):
                return f"must be a finite number, is {number}"
            if self.low is not None and self.high is not None and not self.low <= number <= self.high:
                return f"must be between {self.low:g} and {self.high:g}, is {number:g}"
        if self.choices and value not in self.choices:
            return f"must be one of {', '.join(self.choices)}, is {value!r}"
        return None


class ParameterSet:
    """The parameters of one node and their present ``values``.

    ``check`` gets the whole set before anything changes and raises InputError to refuse it;
    ``changed`` gets the names after a change.
    """

    def __init__(
        self,
        node: Node,
        params: Iterable[Param],
        check: Callable[[Values], None],
        changed: Callable[[set[str]], None],
    ) -> None:
        self._node = node
        self._params = {p.name: p for p in params}
        self._check = check
        self._changed = changed
        self.values: Values = {p.name: self._declare(p) for p in self._params.values()}
        self._refuse_unusable(self.values)
        self.folders = folders_of(self.values)
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._after_set)

    def _declare(self, param: Param) -> Any:
        node = self._node
        try:
            value = node.declare_parameter(param.name, param.default, param.descriptor()).value
        except InvalidParameterTypeException:
            many = isinstance(param.default, list)
            wanted = "numbers with a decimal point in a list" if many else _TYPES[type(param.default)]
            raise InputError(node.get_name(), param.name, f"must be {wanted}") from None
        except ParameterException as error:
            reason = str(error).rpartition("Reason: ")[2].rstrip(".")
            bounds = "" if param.low is None else f" (from {param.low:g} to {param.high:g})"
            raise InputError(node.get_name(), param.name, reason + bounds) from None
        return list(value) if isinstance(param.default, list) else param.read(value)

    def _refuse_unusable(self, values: Values) -> None:
        for name, value in values.items():
            reason = self._params[name].refuse(value)
            if reason is not None:
                raise InputError(self._node.get_name(), name, reason)
        self._check(values)

    def _merged(self, parameters: list[Parameter]) -> Values:
        known = self._params
        return self.values | {p.name: known[p.name].read(p.value) for p in parameters if p.name in known}

    def check_twin(self, path: str) -> None:
        """Raise InputError for a twin file that may not be named from elsewhere."""
        if path and path != self.values["twin"]:
            self.folders.check(path, ".yaml")

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            with reading("parameters", "a set of values"):  # anybody may set them: no value ends the node
                for parameter in parameters:
                    if parameter.name in self._params and parameter.value is None:
                        raise InputError(parameter.name, "cannot be unset")
                values = self._merged(parameters)
                self.check_twin(values.get("twin", ""))
                with for_peers(self._node.get_logger().warning):
                    self._refuse_unusable(values)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _after_set(self, parameters: list[Parameter]) -> None:
        self.values = self._merged(parameters)
        names = {p.name for p in parameters} & self._params.keys()
        if names:
            self._changed(names)


# Parameters that several nodes share

TWIN = Param("twin", "", "Path of the twin file; setting it resets the node. Empty: none.")

FOLDERS = Param(
    "folders",
    "",
    "Folders, with a colon between them, in which goals, services and parameters set later may name files; empty: the "
    "folder of the twin file and that in which the node was started.",
    read_only=True,
)


def folders_of(values: Values) -> Folders:
    """The folders that ``folders`` names, or those that it stands for where it is empty."""
    if values.get("folders"):
        return Folders(values["folders"].split(os.pathsep))
    return Folders([".", *([Path(values["twin"]).parent] if values.get("twin") else [])])


_FILTER = FilterSpec()
#: The same in imu_ingest and suspension_model, or measured and simulated signals cannot be compared.
FILTER = (
    Param("filter.order", _FILTER.order, "Order of the Butterworth low-pass.", 1, 8),
    Param("filter.cutoff", _FILTER.cutoff, "Cut-off frequency (-3 dB) of the low-pass in Hz.", 0.1, 800.0),
)


class NamedTwin(NamedTuple):
    """The twin behind a path that somebody names, the road that it drives on, and the residual of its calibration."""

    twin: Twin
    road: Road | None
    floor: CalibrationGap


#: What was read for services, by path: callbacks find it here and read nothing.
_NAMED: dict[str, NamedTwin] = {}
_MOST = 16


def read_named(path: str) -> NamedTwin:
    """Read all files of a twin, its road in a process with limits; :func:`named_twin` has it from then on.

    Raises InputError that names the file and the key.
    """
    with reading(path, "a twin file"):
        twin = load_twin(path)
        road = None
        if twin.road is not None and twin.program is None:
            file = twin.road.file
            budget = Budget(file, file.stat().st_size)
            road = within_limits(load_road, file, budget=budget, kind="an OpenCRG road", module="pycrg")
        named = NamedTwin(twin, road, calibration_gap(0.0, path))
    _NAMED.pop(path, None)
    _NAMED[path] = named
    for oldest in list(_NAMED)[:-_MOST]:
        _NAMED.pop(oldest, None)
    return named


def named_twin(values: Values) -> NamedTwin | None:
    """The files of the parameter ``twin``, where :func:`read_named` has read them."""
    return _NAMED.get(values["twin"])


@lru_cache(maxsize=16)
def _load(path: str, _changed: int) -> Twin:
    return load_twin(path)


def twin_of(values: Values) -> Twin | None:
    """The twin of the parameter ``twin``; None if not set. That which a node is started with is read again when the
    file has changed, one that a service names each time that it is named.

    Raises InputError that names the file and the key.
    """
    path = values["twin"]
    if not path:
        return None
    if (named := named_twin(values)) is not None:
        return named.twin
    with reading(path, "a twin file"):
        return _load(path, Path(path).stat().st_mtime_ns)


def filter_of(values: Values) -> FilterSpec:
    """The low-pass that the parameters describe."""
    return FilterSpec(values["filter.order"], values["filter.cutoff"])


#: Key of the low-pass in the diagnostics.
LOW_PASS = "low-pass"


def low_pass_text(values: Values) -> str:
    """The low-pass in words, equal for equal ones."""
    spec = filter_of(values)
    return f"{spec.cutoff:g} Hz, order {spec.order}"


# Parameter files, checked before ROS reads them: rcl ignores a name that no node has


@reader("a parameter file")
def read_param_file(path: Path) -> dict[str, dict[str, Any]]:
    """Values by node (as the file names it: a name, a path or a pattern) and dotted parameter name.

    Raises InputError for a file of another form.
    """
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise InputError(path, f"not a parameter file: a mapping of nodes with '{_KEY}' is expected")
    return {node: dict(_flat(values)) for node, values in _sections(path, data, "")}


def _sections(
    path: Path, data: Mapping[object, object], prefix: str
) -> Iterator[tuple[str, Mapping[object, object]]]:
    """Nodes and their parameters, namespaces nested or written out."""
    for name, inner in data.items():
        full = f"{prefix}/{name}" if prefix else str(name)
        if not isinstance(inner, dict):
            raise InputError(path, full, f"has no '{_KEY}'")
        if _KEY in inner:
            if not isinstance(inner[_KEY], dict):
                raise InputError(path, f"{full}: {_KEY}", "must be a mapping of parameters")
            yield full, inner[_KEY]
        else:
            yield from _sections(path, inner, full)


def _flat(values: Mapping[object, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def check_names(
    path: Path, wanted: Mapping[str, Mapping[str, Any]], known: Mapping[str, Iterable[str]]
) -> None:
    """Raise InputError for a parameter that none of the nodes it is meant for has.

    ``known`` are the parameters of each node by the node's name. The file may name nodes of other
    packages; a parameter given by a pattern must be one of ours.
    """
    names = {node: set(parameters) for node, parameters in known.items()}
    for section, parameters in wanted.items():
        own = section.rpartition("/")[2]
        have = set().union(*names.values()) if "*" in own else names.get(own, set(parameters))
        for name in parameters.keys() - have:
            if not name.startswith("qos_overrides."):
                raise InputError(path, f"{section}: {name}", "no such parameter")
