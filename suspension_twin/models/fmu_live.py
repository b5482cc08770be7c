# SPDX-License-Identifier: Apache-2.0
"""An FMU that follows its vehicle stamp by stamp, by the same steps as over a whole drive."""

from __future__ import annotations

import weakref

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import WorkError
from suspension_twin.models.connectors import OUTPUTS
from suspension_twin.models.constants import outside
from suspension_twin.models.excitation import MAX_STEP
from suspension_twin.models.fmu import Body, communication_steps, numbers_and_place
from suspension_twin.models.fmu_slave import Slave
from suspension_twin.models.live import Following
from suspension_twin.models.parameters import layout, pack
from suspension_twin.models.types import HeightField
from suspension_twin.vehicle.twin import Twin

__all__ = ["LiveFmu"]


class LiveFmu(Following):
    """A twin whose vehicle is an FMU; see :class:`~suspension_twin.models.live.Following`.

    Raises InputError for a twin or an FMU that cannot be used, WorkError where it does not start on level ground.
    """

    def __init__(self, twin: Twin, road: HeightField, max_step: float = MAX_STEP) -> None:
        params, shape = pack(twin)[:, None], layout(twin)
        self._body = Body(twin)
        numbers, place = numbers_and_place(shape, params, self._body.place)
        self._numbers, self._place = numbers[:, 0], place[:, 0]
        self._slave: Slave | None = None
        self._out, self._before = np.zeros((1, len(OUTPUTS))), np.zeros(len(OUTPUTS))
        self._inputs = np.zeros(10)
        self._base = 0.0
        self._body.start(self._numbers, self._inputs).close()  # what is wrong with it is said now
        super().__init__(twin, road, outside(params, shape), max_step)

    def _restart(self) -> None:
        if self._slave is not None:
            self._end()
        self._slave = None

    def _advance(self, seen: Floats) -> bool:
        body, n = self._body, int(self._count[1])
        inputs = np.empty((len(seen) + 1, 10))
        try:
            if n == 0 or self._slave is None:
                self._restart()
                self._base = float(seen[-1].mean())
                inputs = self._between(seen[-1:], 0)
                slave = self._slave = body.start(self._numbers, inputs[-1])
                self._end = weakref.finalize(self, slave.close)
                steps: tuple[Floats, Floats | None, Floats] = inputs[:0], None, np.zeros(0)
            else:
                slave = self._slave
                inputs = np.vstack([self._inputs, self._between(seen, n)])
                h = float(self._motion[1, 0])
                steps = communication_steps(inputs, n, h, body.step, body.fmu.sloped)
            row = slave.walk(*steps, np.array([0, len(steps[2])]), inputs[-1:])[0]
        except WorkError as error:
            self._failure = f"{error}: "
            self._restart()
            return False
        self._before[:] = self._out[0]
        self._inputs = inputs[-1]
        if not np.isfinite(row).all():
            self._failure = f"{body.fmu.name} gives what is not finite: "
            return False
        self._out[0, list(body.fmu.outputs)] = row
        return True

    def _between(self, seen: Floats, n: int) -> Floats:
        """(rows, 10) inputs at the ends of the parts of the interval."""
        before, after = self._motion[0 if n else 1, 1:7], self._motion[1, 1:7]
        share = np.arange(1, len(seen) + 1)[:, None] / len(seen)
        planar = before + share * (after - before)
        square = before[2] ** 2 + share[:, 0] * (after[2] ** 2 - before[2] ** 2)
        planar[:, 2] = np.sign(after[2]) * np.sqrt(square)  # moments are linear in the square of the yaw rate
        return np.hstack([seen - self._base, planar])

    def _row(self) -> Floats:
        out, body = self._out.copy(), self._body
        inputs = self._inputs.copy()
        inputs[:4] += self._base
        n = int(self._count[1])
        out[:, body.heights] += self._base
        body.complete(out, inputs[None], np.array([n * self._motion[1, 0]]), self._before, self._place)
        row: Floats = out[0]
        return row
