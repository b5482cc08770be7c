# SPDX-License-Identifier: Apache-2.0
"""``full_car`` with effects: the same step, with the terms of all effects in it.

The terms come from the files of the effects (``hooks.KernelTerms``). ``effect_kernels`` lays out their fields one
after the other, gives each effect a bit and chains the terms of each stage, in the order of the effects. A block runs
only the terms that one of its lanes has, and a term is exactly nothing for a lane that has it not: with all of them at
zero the numbers are those of ``full_car`` to the last bit. Every corner has curves of its own here, every lane
may have a road of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, inlined, linked, specialised
from suspension_twin.models import rows
from suspension_twin.models.corner import (
    close_interval,
    move,
    strut_forces,
    touch,
    travel,
    tyre_forces,
    velocities,
)
from suspension_twin.models.damper_tables import retable
from suspension_twin.models.equilibrium import stand
from suspension_twin.models.full_car import moments, open_lanes, record, watch
from suspension_twin.models.hooks import KernelTerms
from suspension_twin.models.numerics import four, put
from suspension_twin.models.rows import WIDTH
from suspension_twin.models.sensor import sense
from suspension_twin.models.settle import settle
from suspension_twin.models.types import Ints

__all__ = ["COMPLIANT", "EffectKernels", "effect_kernels"]

#: Bit of the flags of a block in which a damper has an elastic mount. Effects have the bits above it.
COMPLIANT = 1

Chain = Callable[..., Any]


@inlined
def _nothing(w: Floats, flag: int, h: float) -> None:
    """The chain of a stage without terms."""


#: What each assembly of the kernel has of its own: hinges of a curve, first row of the curves, flags of blocks whose
#: damper tables change, static equilibrium, and the chains of the stages.
_HINGES, _CURVES, _RETABLED = 0, 0, 0
_SETTLE: Chain = settle
_DAMPERS = _STRUT = _TYRE = _BODY = _AFTER = _STAMP = _nothing


@compiled
def _ground(w: Floats, road: Floats, candidate_road: Floats, row: int, per_second: float) -> None:
    """Bring the road heights of ``row`` into the block, and how fast they rose."""
    own = candidate_road.shape[0] > 0
    for c in range(4):
        for i in range(WIDTH):
            z = candidate_road[row, c, i] if own else road[row, c]
            w[(rows.ROAD_RATE + c) * WIDTH + i] = (z - w[(rows.ROAD + c) * WIDTH + i]) * per_second
            w[(rows.ROAD + c) * WIDTH + i] = z


def _run(
    blocks: Floats,
    flags: Ints,
    road: Floats,
    candidate_road: Floats,
    substeps: Ints,
    motion: Floats,
    begin: int,
    end: int,
    signals: Floats,
    states: Floats,
    lane0: int,
) -> None:
    """As ``full_car._run``; ``flags`` (B,) says which terms each block needs.

    ``candidate_road`` (rows, 4, WIDTH) gives every lane heights of its own, or has length 0; with it
    ``blocks`` holds one block.
    """
    stride = 5 + 6 * _HINGES
    c0 = _CURVES + 2 * stride
    c1, c2, c3 = c0 + stride, c0 + 2 * stride, c0 + 3 * stride
    beta, lag = rows.CORNER_IMPLICIT, rows.LAG
    for block in range(blocks.shape[0]):
        w = blocks[block]
        flag = flags[block]
        row = 0
        for k in range(begin, end):
            n = substeps[k]
            h = motion[k, 0]
            ax, ay, yaw, dyaw = motion[k, 1], motion[k, 2], motion[k, 3], motion[k, 4]
            if n == 0:
                _ground(w, road, candidate_road, row, 0.0)
                for i in range(WIDTH):
                    mx, my = moments(w, i, ax, ay, yaw * yaw, dyaw)
                    stand(w, i, mx, my, motion[k, 5], motion[k, 6], _CURVES, _HINGES)
                    _SETTLE(w, i, mx, my, _CURVES, _HINGES)
                row += 1
            else:
                if flag & _RETABLED:
                    for i in range(WIDTH):
                        put(w, rows.DAMPER_SHARE, i, 1.0, 1.0, 1.0, 1.0)
                    _DAMPERS(w, flag, h)
                    retable(w, h, _CURVES, _HINGES)
                open_lanes(w, k, motion, beta, beta + 1, beta + 2, beta + 3)
                for j in range(n):
                    share = (j + 1.0) / n
                    _ground(w, road, candidate_road, row, 1.0 / h)
                    row += 1
                    for i in range(WIDTH):
                        move(w, i, h)
                        strut_forces(w, i, c0, c1, c2, c3, _HINGES)
                        r0, r1, r2, r3 = four(w, rows.ROAD, i)
                        n0, n1, n2, n3 = tyre_forces(w, i, r0, r1, r2, r3)
                        put(w, rows.GROUND, i, n0, n1, n2, n3)
                    _STRUT(w, flag, h)
                    _TYRE(w, flag, h)
                    for i in range(WIDTH):
                        n0, n1, n2, n3 = four(w, rows.GROUND, i)
                        velocities(
                            w,
                            i,
                            h,
                            share,
                            n0,
                            n1,
                            n2,
                            n3,
                            lag,
                            lag + 1,
                            lag + 2,
                            lag + 3,
                            c0,
                            c1,
                            c2,
                            c3,
                            _HINGES,
                        )
                    _BODY(w, flag, h)
                    _AFTER(w, flag, h)
                for i in range(WIDTH):
                    close_interval(w, i, h)
            last = row - 1
            watch(w, road[last, 0], road[last, 1], road[last, 2], road[last, 3])
            for i in range(WIDTH):
                n0, n1, n2, n3 = four(w, rows.GROUND, i)
                touch(w, i, n0, n1, n2, n3)
                sense(w, i, ax, ay, yaw, dyaw)
            _STAMP(w, flag, h)
            record(w, lane0 + block * WIDTH, k - begin, signals, states)


def _everywhere(term: Chain, e: int, count: int) -> Chain:
    """A term at ``count`` corners or axles, or once, of every lane."""

    def run(w: Floats, h: float) -> None:
        for c in range(count):
            for i in range(WIDTH):
                term(w, e, c, i, h)

    return linked(run)


def _strut_of(law: Chain, e: int, count: int) -> Chain:
    """An elastic element in the stage ``strut``."""

    def corners(w: Floats, h: float) -> None:
        for c in range(4):
            for i in range(WIDTH):
                w[(rows.STRUT + c) * WIDTH + i] += law(w, e, c, i, travel(w, c, i))[0]

    def axles(w: Floats, h: float) -> None:
        for a in range(2):
            for i in range(WIDTH):
                force = law(w, e, a, i, travel(w, 2 * a, i) - travel(w, 2 * a + 1, i))[0]
                w[(rows.STRUT + 2 * a) * WIDTH + i] += force
                w[(rows.STRUT + 2 * a + 1) * WIDTH + i] -= force

    return linked(corners if count == rows.CORNER else axles)


def _then(before: Chain, run: Chain, bit: int) -> Chain:
    """The chain ``before`` and then ``run`` in blocks that have the effect."""

    def both(w: Floats, flag: int, h: float) -> None:
        before(w, flag, h)
        if flag & bit:
            run(w, h)

    return inlined(both)


@linked
def _no_force(w: Floats, i: int, travel: Floats, force: Floats, stiffness: Floats) -> None:
    """The elastic elements of no effect."""


def _static(before: Chain, law: Chain, e: int, count: int) -> Chain:
    """``before`` and the force and stiffness of an elastic element, for ``settle``."""
    first = 0 if count == rows.CORNER else 4

    def both(w: Floats, i: int, travel: Floats, force: Floats, stiffness: Floats) -> None:
        before(w, i, travel, force, stiffness)
        for c in range(count):
            f, k = law(w, e, c, i, travel[first + c])
            force[first + c] += f
            stiffness[first + c] += k

    return linked(both)


@dataclass(frozen=True, eq=False)
class EffectKernels:
    """The kernel with all effects.

    ``terms``, ``first`` and ``bit`` give by id of an effect its terms, the first row of its fields and its bit in the
    flags of a block; ``curves`` is the first row of the curves and ``kernels`` has a kernel for each number of hinges.
    """

    terms: Mapping[str, KernelTerms]
    first: Mapping[str, int]
    bit: Mapping[str, int]
    curves: int
    kernels: Mapping[int, Any]

    def rows(self, hinges: int) -> int:
        """Rows of a block."""
        return self.curves + 6 * rows.axle_rows(hinges) + 4 * 2 * 3 * (hinges + 1)


@cache
def effect_kernels() -> EffectKernels:
    """The kernel with the effects of the registry, compiled when it is first run."""
    from suspension_twin.effects.registry import EFFECTS  # whose files import models.hooks

    terms = {name: effect.hook.kernel for name, effect in EFFECTS.items() if effect.hook.kernel is not None}
    first, bit, end = {}, {}, rows.CURVES
    chains = dict.fromkeys(("dampers", "strut", "tyre", "body", "after", "stamp"), _nothing)
    static = _no_force
    restarted: list[int] = []
    retabled = COMPLIANT
    for index, (name, own) in enumerate(terms.items(), 1):
        e = first[name] = end
        bit[name] = COMPLIANT << index
        end += own.fields.count
        restarted += [e + f + j for f in own.fields.restarted for j in range(own.fields.sizes[f])]
        if own.elastic is not None:
            law, count = own.elastic
            static = _static(static, law, e, count)
            chains["strut"] = _then(chains["strut"], _strut_of(law, e, count), bit[name])
        for stage, (term, count) in own.terms.items():
            chains[stage] = _then(chains[stage], _everywhere(term, e, count), bit[name])
        if "dampers" in own.terms:
            retabled |= bit[name]
    settled = linked(specialised(settle, "settle", _ELASTIC=static, _RESTARTED=tuple(restarted)))
    parts = {f"_{stage.upper()}": chain for stage, chain in chains.items()}
    modules = [f"suspension_twin.effects.{name}" for name in terms]
    kernels = {
        hinges: compiled(
            specialised(
                _run,
                f"_run_{hinges}",
                _HINGES=hinges,
                _CURVES=end,
                _RETABLED=retabled,
                _SETTLE=settled,
                **parts,
            ),
            modules,
        )
        for hinges in rows.HINGES
    }
    return EffectKernels(terms, first, bit, end, kernels)
