# SPDX-License-Identifier: Apache-2.0
"""Registries of what can be added: models, effects, importers, sources, exporters, commands, nodes.

A registry maps names to objects. They come from three places, in this order: its built-in table, the table
``PLUGINS`` of the package's own add-ons where these are installed, and the entry points of installed distributions in
the group ``suspension_twin.<group>``. An entry point names a module; the registry takes its attribute:

    [project.entry-points."suspension_twin.effects"]
    quadratic_damping = "my_package.quadratic_damping"

An object is imported when it is asked for. A plugin that cannot be used, or whose name is taken, is one line that names
its distribution and its entry point: an error for who asks for it, a line of the log for everybody else.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from functools import cache, cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from suspension_twin.errors import InputError, nearest

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints

__all__ = ["ADDONS", "PluginError", "Registry", "missing_addons"]

#: The package of our own add-ons; nothing but this module knows of it.
ADDONS = "suspension_twin.addons"
_PREFIX = "suspension_twin."

T = TypeVar("T")


class PluginError(InputError):
    """An entry point that cannot be used: names its distribution, its group and itself."""


class EntryPoint(NamedTuple):
    """One entry point of an installed distribution; ``value`` is the module."""

    distribution: str
    group: str
    name: str
    value: str

    def __str__(self) -> str:
        return f"{self.distribution}: entry point {self.name} of {self.group}"


@cache
def entry_points() -> tuple[EntryPoint, ...]:
    """Entry points of all groups of ours, in the order of their distributions; read once.

    Almost no distribution has any: of most, one look at a small file is enough, without importlib.metadata, which takes
    longer to import than a short command to run.
    """
    found: dict[str, EntryPoints] = {}
    for folder in sys.path:
        for directory in _distributions(folder or "."):
            from importlib.metadata import Distribution

            distribution = Distribution.at(directory)
            # An earlier folder hides a later one.
            found.setdefault(distribution.metadata["Name"], distribution.entry_points)
    return tuple(
        EntryPoint(name, point.group, point.name, point.value.partition(":")[0])
        for name, points in sorted(found.items())
        for point in points
        if point.group.startswith(_PREFIX)
    )


def _distributions(folder: str) -> Iterator[str]:
    """Directories of the distributions in a folder of ``sys.path`` that have an entry point for us."""
    try:
        names = sorted(os.listdir(folder))
    except OSError:  # a zip file, or no longer there
        return
    for name in names:
        if name.endswith((".dist-info", ".egg-info")):
            directory = os.path.join(folder, name)
            try:
                with open(os.path.join(directory, "entry_points.txt"), "rb") as file:
                    if f"[{_PREFIX}".encode() in file.read():
                        yield directory
            except OSError:  # most have none
                continue


@cache
def _addons() -> Mapping[str, Mapping[str, str]]:
    """References of the package's own add-ons by group and name; empty where they are not installed."""
    try:
        table: Mapping[str, Mapping[str, str]] = getattr(import_module(ADDONS), "PLUGINS", {})
    except ModuleNotFoundError as error:
        if error.name != ADDONS:
            raise
        return {}
    return table


def missing_addons() -> str:
    """``"; suspension_twin.addons is not installed"`` to end an error with, or nothing."""
    return "" if _addons() else f"; {ADDONS} is not installed"


class Registry(Mapping[str, T], Generic[T]):
    """Objects by name. Iterating gives the names of all that can be used, and imports the plugins alone.

    Parameters
    ----------
    group : str
        The word after ``suspension_twin.`` in the name of the group of entry points.
    builtin : mapping, optional
        By name ``module:attribute`` of the built-in ones, or ``module`` for the module itself.
    attribute : str
        Name of the object in a plugin's module; empty: the module itself.
    kind : type
        The class (or runtime protocol) of the objects.
    identity : str
        Attribute of an object that has to equal its name, if any.
    """

    def __init__(
        self,
        group: str,
        builtin: Mapping[str, str] | None = None,
        *,
        attribute: str = "",
        kind: type = object,
        identity: str = "",
    ) -> None:
        self.group = group
        self._builtin = builtin or {}
        self._attribute, self._kind, self._identity = attribute, kind, identity
        self._loaded: dict[str, T] = {}
        self._reported: set[str] = set()

    @cached_property
    def _references(self) -> dict[str, str]:
        added = _addons().get(self.group, {})
        return {**self._builtin, **{n: r if ":" in r else f"{r}:{self._attribute}" for n, r in added.items()}}

    @cached_property
    def _plugins(self) -> dict[str, EntryPoint | PluginError]:
        """Entry points by name; those whose name is taken are errors."""
        found: dict[str, EntryPoint | PluginError] = {}
        for point in entry_points():
            if point.group != f"{_PREFIX}{self.group}":
                continue
            other = found.get(point.name)
            if point.name in self._references:
                found[point.name] = PluginError(str(point), "its name is that of a built-in one")
            elif isinstance(other, EntryPoint):
                found[point.name] = PluginError(
                    str(point), f"its name is taken by {other.distribution} as well"
                )
            else:
                found.setdefault(point.name, point)
        return found

    def _load(self, name: str) -> T:
        found: T
        if name in self._references:
            found = _resolved(self._references[name])
            return found
        point = self._plugins[name]
        if isinstance(point, PluginError):
            raise point
        try:
            found = _resolved(f"{point.value}:{self._attribute}")
        except Exception as error:
            raise PluginError(str(point), f"cannot be loaded: {type(error).__name__}: {error}") from error
        if not isinstance(found, self._kind):
            raise PluginError(str(point), f"{self._attribute or point.value} is no {self._kind.__name__}")
        if self._identity and getattr(found, self._identity) != name:
            raise PluginError(str(point), f"its {self._identity} is {getattr(found, self._identity)}")
        return found

    def __getitem__(self, name: str) -> T:
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        yield from self._references
        for name, point in self._plugins.items():
            try:
                if isinstance(point, PluginError):
                    raise point
                self[name]
            except PluginError as error:
                self._report(name, error)
            else:
                yield name

    def _report(self, name: str, error: PluginError) -> None:
        """One line of the log, which goes to standard error where nobody has set up another place for it."""
        if name not in self._reported:
            self._reported.add(name)
            import logging

            logging.getLogger("suspension_twin").error("%s", error)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def named(self, name: str, what: str) -> T:
        """The object of a name that a user gave.

        Raises InputError, which begins with ``what`` is asked for and lists the names there are.
        """
        try:
            return self[name]
        except KeyError:
            known = ", ".join(self)
            there = f"{nearest(name, self)}; there are {known}" if known else ""
            raise InputError(what, f"{name} is not known{there}{missing_addons()}") from None

    def module(self, name: str) -> str:
        """Name of the module that holds an object."""
        if name in self._references:
            return self._references[name].partition(":")[0]
        point = self._plugins[name]
        if isinstance(point, PluginError):
            raise point
        return point.value


def _resolved(reference: str) -> Any:
    """The object ``module:attribute``, or the module where there is no attribute."""
    module, _, attribute = reference.partition(":")
    found = import_module(module)
    return getattr(found, attribute) if attribute else found
