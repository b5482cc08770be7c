# SPDX-License-Identifier: Apache-2.0
"""One lane of a car's kernel by itself: its rows, and functions that start, advance and read it.

For code that walks one twin without this package, such as an FMU: the functions are made of those of the kernels, and
in the same part of Python, so that they can be written out in another language. ``WIDTH`` is 1 there: element r of
``w`` is row r. The whole-block kernels and these walk one interval by the same steps in the same order.

``road`` (4,) are heights in m, ``motion`` (6,) is ax, ay m/s², yaw rate rad/s, yaw acceleration rad/s², speed and
lateral speed m/s, as in :class:`~suspension_twin.models.types.Excitation`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import specialised
from suspension_twin.models.constants import Conditions, constants
from suspension_twin.models.parameters import layout, pack
from suspension_twin.models.rows import constants_for
from suspension_twin.vehicle.twin import Twin

__all__ = ["OneLane", "one_lane"]

Function = Callable[..., None]


@dataclass(frozen=True, eq=False)
class OneLane:
    """One twin as one lane.

    Parameters
    ----------
    values
        (rows,) constants and states before the start.
    start
        ``start(w, road, motion)`` puts it in equilibrium.
    advance
        ``advance(w, n, h, road0, road1, motion0, motion1)`` walks an interval in n steps of h s; heights and motion run
        linearly from the first to the second.
    read
        ``read(w, motion, out)`` fills ``out`` with what ``models.connectors`` gives, columns in its order.
    outside
        Effects of the twin, by id, that act on the road, on the sensor's signals or on its clock, and so are not in it.
    """

    values: Floats
    start: Function
    advance: Function
    read: Function
    outside: tuple[str, ...]


def one_lane(twin: Twin, max_step: float) -> OneLane:
    """A car as one lane for steps of up to ``max_step`` s; InputError names the key of what cannot be simulated."""
    shape = layout(twin)
    known = constants(pack(twin)[:, None], shape, Conditions(max_step, actuated=True))
    known.problems.raise_first()
    functions, own = known.kernel.one_lane(0 if known.flags is None else int(known.flags[0]))
    own |= {**constants_for(known.hinges), "_RADIUS": float(twin.vehicle.tyre.radius)}
    names = ("twin_start", "twin_advance", "twin_read")
    start, advance, read = (specialised(f, name, **own) for f, name in zip(functions, names, strict=True))
    inside = ("vehicle", "corners", "kernel")
    outside = [name for name, hook in shape.hooks.items() if all(getattr(hook, p) is None for p in inside)]
    return OneLane(np.ascontiguousarray(known.values[:, 0]), start, advance, read, tuple(outside))
