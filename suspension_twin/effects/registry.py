# SPDX-License-Identifier: Apache-2.0
"""The library of effects: each file of this folder, and each entry point ``suspension_twin.effects``.

Both have an object ``EFFECT``, whose ``id`` is the name of the file or of the entry point.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pkgutil import iter_modules
from typing import Final

import suspension_twin.effects as folder
from suspension_twin.effects.base import Effect
from suspension_twin.errors import InputError
from suspension_twin.registry import Registry

__all__ = ["EFFECTS", "effect"]


class _Effects(Registry[Effect]):
    """Effects by id; iterating imports all of them and gives the order in which they act."""

    @cached_property
    def _order(self) -> list[str]:
        return sorted(super().__iter__(), key=lambda name: (self[name].order, name))

    def __iter__(self) -> Iterator[str]:
        return iter(self._order)


#: Effects by id, each imported when it is asked for.
EFFECTS: Final = _Effects(
    "effects",
    {
        name: f"{folder.__name__}.{name}:EFFECT"
        for _, name, _ in iter_modules(folder.__path__)
        if name not in ("base", "registry") and not name.startswith("_")
    },
    attribute="EFFECT",
    kind=Effect,
    identity="id",
)


def effect(name: str, model: str = "full_car") -> Effect:
    """An effect of the library.

    Parameters
    ----------
    name : str
        Its id.
    model : str
        The model on which it is wanted: parameters may differ.

    Returns
    -------
    Effect
        Parameters with bounds and priors, what excites it, what it is confused with.

    Raises
    ------
    InputError
        There is no such effect.

    Examples
    --------
    >>> effect("strut_friction").severity
    ('front_force', 'rear_force')
    """
    try:
        return EFFECTS[name].on(model)
    except KeyError:
        raise InputError("twin", "effects", f"{name} is not an effect ({', '.join(EFFECTS)})") from None
