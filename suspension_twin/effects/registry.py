# SPDX-License-Identifier: Apache-2.0
"""The library of effects: each file of this folder that has an object ``EFFECT``."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import Final

import suspension_twin.effects as folder
from suspension_twin.effects.base import Effect
from suspension_twin.errors import InputError

__all__ = ["EFFECTS", "effect"]


def _found() -> dict[str, Effect]:
    names = sorted(module.name for module in iter_modules(folder.__path__) if not module.name.startswith("_"))
    modules = [import_module(f"{folder.__name__}.{name}") for name in names if name != "registry"]
    effects = [module.EFFECT for module in modules if hasattr(module, "EFFECT")]
    return {effect.id: effect for effect in sorted(effects, key=lambda effect: (effect.order, effect.id))}


#: Effects by id, in the order in which they act.
EFFECTS: Final = _found()


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
