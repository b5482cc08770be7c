# SPDX-License-Identifier: Apache-2.0
"""Parameters of a node: declared with a description and a range, refused with a reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from suspension_twin.errors import InputError

__all__ = ["Param", "ParameterSet"]

Values = dict[str, Any]

_KINDS = {bool: "true or false", int: "a whole number", float: "a number with a point (20.0)", str: "a text"}


@dataclass(frozen=True)
class Param:
    """One parameter. ``low`` and ``high`` bound a number, ``choices`` a text.

    A ``read_only`` one is fixed once the node runs; every other can be set at any time.
    """

    name: str
    default: bool | int | float | str | list[float]
    text: str
    low: float | None = None
    high: float | None = None
    read_only: bool = False
    choices: tuple[str, ...] = ()

    def descriptor(self) -> ParameterDescriptor:
        """What ``ros2 param describe`` shows."""
        out = ParameterDescriptor(name=self.name, description=self.text, read_only=self.read_only)
        if self.low is not None and self.high is not None:
            if isinstance(self.default, float):
                out.floating_point_range = [FloatingPointRange(from_value=self.low, to_value=self.high)]
            elif isinstance(self.default, int):
                out.integer_range = [IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)]
        if self.choices:
            out.additional_constraints = "one of " + ", ".join(self.choices)
        return out

    def refuse(self, value: Any) -> str | None:
        """Why ``value`` cannot be taken; None if it can."""
        numbers = value if isinstance(self.default, list) else [value]
        for number in numbers if isinstance(self.default, (float, list)) else ():
            if not math.isfinite(number):
                return f"must be a finite number, is {number}"
            if self.low is not None and self.high is not None and not self.low <= number <= self.high:
                return f"must lie between {self.low:g} and {self.high:g}, is {number:g}"
        if self.choices and value not in self.choices:
            return f"must be one of {', '.join(self.choices)}, is {value!r}"
        return None


class ParameterSet:
    """The parameters of one node: ``values`` as they are in force.

    ``check`` sees the whole set before anything changes and raises InputError to refuse it;
    ``changed`` is told the names after a change.
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
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._after_set)

    def _declare(self, param: Param) -> Any:
        node = self._node
        try:
            value = node.declare_parameter(param.name, param.default, param.descriptor()).value
        except InvalidParameterTypeException:
            example = param.default[0] if isinstance(param.default, list) else param.default
            plural = " in a list" if isinstance(param.default, list) else ""
            raise InputError(
                node.get_name(), param.name, f"must be {_KINDS[type(example)]}{plural}"
            ) from None
        except ParameterException as error:
            reason = str(error).rpartition("Reason: ")[2].rstrip(".")
            bounds = "" if param.low is None else f" (from {param.low:g} to {param.high:g})"
            raise InputError(node.get_name(), param.name, reason + bounds) from None
        return list(value) if isinstance(param.default, list) else value

    def _refuse_unusable(self, values: Values) -> None:
        for name, value in values.items():
            reason = self._params[name].refuse(value)
            if reason is not None:
                raise InputError(self._node.get_name(), name, reason)
        self._check(values)

    def _merged(self, parameters: list[Parameter]) -> Values:
        return self.values | {p.name: p.value for p in parameters if p.name in self._params}

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                if parameter.name in self._params and parameter.value is None:
                    raise InputError(parameter.name, "cannot be unset")
            self._refuse_unusable(self._merged(parameters))
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _after_set(self, parameters: list[Parameter]) -> None:
        self.values = self._merged(parameters)
        names = {p.name for p in parameters} & self._params.keys()
        if names:
            self._changed(names)
