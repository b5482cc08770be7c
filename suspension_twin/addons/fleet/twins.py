# SPDX-License-Identifier: Apache-2.0
"""The twins of a fleet's vehicles as files here, each with a name that ROS can have as a namespace."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from suspension_twin.addons.fleet.manifest import Item
from suspension_twin.addons.fleet.storage import is_url, staged
from suspension_twin.addons.fleet.work import moved_twin, twin_and_road
from suspension_twin.errors import InputError

__all__ = ["fleet_twins"]


def fleet_twins(items: Sequence[Item], folder: Path) -> dict[str, Path]:
    """The twin of every vehicle of a manifest, as its newest row has it.

    Parameters
    ----------
    items : sequence of Item
        Rows of a manifest; of a vehicle the one with the latest date counts, of several the last.
    folder : Path
        Where copies from object storage are put, and twin files whose road the manifest replaces.

    Returns
    -------
    dict of str to Path
        Files here by namespace (letters, digits and underscores), in the order in which the manifest first names the
        vehicles.

    Raises
    ------
    InputError
        A twin file or a road cannot be used, or two vehicles would have one namespace.

    Examples
    --------
    >>> item = Item("car 1", "", "bags/bump_15kmh/twin.yaml", ("bags/bump_15kmh",))
    >>> list(fleet_twins([item], Path("copies")))
    ['car_1']
    """
    newest: dict[str, Item] = {}
    for item in items:
        if item.vehicle not in newest or item.date >= newest[item.vehicle].date:
            newest[item.vehicle] = item
    vehicles: dict[str, str] = {}
    for vehicle in newest:
        other = vehicles.setdefault(namespace := _namespace(vehicle), vehicle)
        if other != vehicle:
            raise InputError(vehicle, f"has the same name in ROS as {other}: /{namespace}; rename one")
    return {name: _local(newest[vehicle], folder / name) for name, vehicle in vehicles.items()}


def _namespace(vehicle: str) -> str:
    """A vehicle's name as a namespace: ROS allows letters, digits and single underscores, no digit first."""
    name = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", vehicle)).rstrip("_")
    if not re.search(r"[A-Za-z0-9]", name):
        raise InputError(vehicle, "has no letter or digit that a name in ROS could have; rename it")
    return name if not name[0].isdigit() else f"v{name}"


def _local(item: Item, folder: Path) -> Path:
    twin, road = twin_and_road(item, folder)
    if road and (item.road or is_url(road)):
        there = staged(road, folder)
        if not there.is_file():
            raise InputError(road, "No such file or directory")
        return moved_twin(twin, there, folder / "with_road.yaml")
    return staged(item.twin, folder)
