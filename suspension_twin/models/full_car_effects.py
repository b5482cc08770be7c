# SPDX-License-Identifier: Apache-2.0
"""``full_car`` with effects: the same step, with the terms of all effects in it.

The terms come from the files of the effects (``hooks.KernelTerms``). ``effect_kernels`` lays out their fields one
after the other, gives each effect a bit, and writes a function for each stage that runs the terms of the effects in
their order: a loop over lanes and corners or axles each, with the rows of their fields as constants. A block runs
only the terms that one of its lanes has, and a term is exactly nothing for a lane that has it not: with all of them at
zero the numbers are those of ``full_car`` to the last bit. Every corner has curves of its own here, every lane
may have a road of its own.
"""

from __future__ import annotations

import linecache
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, get_args

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, compiled_later, inlined, linked, specialised
from suspension_twin.models import rows
from suspension_twin.models.car import (
    Block,
    Candidates,
    LaneFunctions,
    Walk,
    compression_at,
    hinges_of,
    shorten_spring,
    write_curves,
)
from suspension_twin.models.connectors import see
from suspension_twin.models.corner import (
    close_interval,
    move,
    open_interval,
    strut_forces,
    touch,
    travel,
    tyre_forces,
    velocities,
)
from suspension_twin.models.curves import retable
from suspension_twin.models.equilibrium import stand, stand_with
from suspension_twin.models.full_car import KERNELS, block_rows, moments, open_lanes, record, watch, yaw_rate
from suspension_twin.models.hooks import KernelTerms, RoadChange, Stage
from suspension_twin.models.parts import LINKAGE
from suspension_twin.models.rows import KERNEL_HINGES, LINKS_ALONE, WIDTH, Hinges, constants_for, four, put
from suspension_twin.models.sensor import sense
from suspension_twin.models.types import Ints
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.corners import AXLES

__all__ = ["COMPLIANT", "SOFT", "EffectKernels", "constants_of", "effect_kernels", "one_lane", "walk"]


#: Bits of the flags of a block in which a damper has an elastic mount, and in which a tyre has a stiffness of its own.
#: Effects have the bits above them.
COMPLIANT, SOFT = 1, 2
#: Bit of a walk with an actuator in every strut.
_ACTUATED = 1 << 61


@inlined
def _no_term(w: Floats, flag: int, h: float) -> None:
    """A stage without terms."""


#: Values that each assembly of the kernel has of its own: hinges of springs and dampers, first row of the curves,
#: static equilibrium, the terms of the stages, and the flags of blocks that have one; flags and tyre radius in m of a
#: lane by itself.
_SPRING_HINGES = _DAMPER_HINGES = _CURVES = _FLAG = 0
_RADIUS = 0.0
_STAND = stand
_DAMPERS = _STRUT = _TYRE = _BODY = _AFTER = _STAMP = _no_term
_DAMPERS_OF = _STRUT_OF = _TYRE_OF = _BODY_OF = _AFTER_OF = _STAMP_OF = 0


@compiled
def _ground(w: Floats, road: Floats, candidate_road: Floats, row: int, per_second: float) -> None:
    """Bring the road heights of ``row`` into the block, and how fast they rose."""
    own = candidate_road.shape[0] > 0
    for c in range(4):
        for i in range(WIDTH):
            z = candidate_road[row, c, i] if own else road[row, c]
            w[(rows.ROAD_RATE + c) * WIDTH + i] = (z - w[(rows.ROAD + c) * WIDTH + i]) * per_second
            w[(rows.ROAD + c) * WIDTH + i] = z


@compiled
def _push(w: Floats, force: float) -> None:
    """The force in N of an actuator in every strut."""
    for c in range(4):
        for i in range(WIDTH):
            w[(rows.STRUT + c) * WIDTH + i] += force


@compiled
def _soften(w: Floats) -> None:
    """Each tyre with the stiffness of its own."""
    for c in range(4):
        for i in range(WIDTH):
            w[(rows.GROUND + c) * WIDTH + i] *= 1.0 + w[(rows.TYRE_CHANGE + c) * WIDTH + i]


@compiled_later
def _step(
    w: Floats,
    flag: int,
    h: float,
    share: float,
    speed: float,
    turn: float,
    force: float,
    curves: int,
    springs: int,
    dampers: int,
) -> None:
    """All lanes a step on, over the heights in their rows ROAD.

    ``share`` of the interval has passed then; ``speed`` m/s in the middle of the step, ``turn`` rad/s at its end,
    ``force`` N of an actuator in every strut; the curves of the corners begin at the row ``curves``.
    """
    lag, stride, push = rows.LAG, 5 + 2 * springs + 4 * dampers, 2 + 2 * springs
    c0, c1, c2, c3 = curves, curves + stride, curves + 2 * stride, curves + 3 * stride
    p0, p1, p2, p3 = c0 + push, c1 + push, c2 + push, c3 + push
    for i in range(WIDTH):
        w[rows.SPEED * WIDTH + i] = speed
        w[rows.YAW_RATE * WIDTH + i] = turn
        w[rows.SHARE * WIDTH + i] = share
        move(w, i, h)
        strut_forces(w, i, c0, c1, c2, c3, springs)
        r0, r1, r2, r3 = four(w, rows.ROAD, i)
        n0, n1, n2, n3 = tyre_forces(w, i, r0, r1, r2, r3)
        put(w, rows.GROUND, i, n0, n1, n2, n3)
    if flag & SOFT:
        _soften(w)
    if flag & _STRUT_OF:
        _STRUT(w, flag, h)
    if flag & _ACTUATED:
        _push(w, force)
    if flag & _TYRE_OF:
        _TYRE(w, flag, h)
    for i in range(WIDTH):
        n0, n1, n2, n3 = four(w, rows.GROUND, i)
        velocities(w, i, h, share, n0, n1, n2, n3, lag, lag + 1, lag + 2, lag + 3, p0, p1, p2, p3, dampers)
    if flag & _BODY_OF:
        _BODY(w, flag, h)
    if flag & _AFTER_OF:
        _AFTER(w, flag, h)


@compiled_later
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
    stride = 5 + 2 * _SPRING_HINGES + 4 * _DAMPER_HINGES
    beta = rows.CORNER_IMPLICIT
    c0, c1, c2, c3 = _CURVES, _CURVES + stride, _CURVES + 2 * stride, _CURVES + 3 * stride
    actuated = motion.shape[1] > 7
    for block in range(blocks.shape[0]):
        w = blocks[block]
        flag = flags[block] | (_ACTUATED if actuated else 0)
        row = 0
        for k in range(begin, end):
            n = substeps[k]
            h = motion[k, 0]
            ax, ay, yaw, dyaw = motion[k, 1], motion[k, 2], motion[k, 3], motion[k, 4]
            if n == 0:
                _ground(w, road, candidate_road, row, 0.0)
                for i in range(WIDTH):
                    w[rows.ACTUATOR * WIDTH + i] = motion[k, 7] if actuated else 0.0
                    mx, my = moments(w, i, ax, ay, yaw * yaw, dyaw)
                    _STAND(w, i, mx, my, motion[k, 5], motion[k, 6], c0, c1, c2, c3, _SPRING_HINGES)
                row += 1
            else:
                if flag & (_DAMPERS_OF | COMPLIANT):
                    for i in range(WIDTH):
                        put(w, rows.DAMPER_SHARE, i, 1.0, 1.0, 1.0, 1.0)
                    _DAMPERS(w, flag, h)
                    retable(w, h, _CURVES, _SPRING_HINGES, _DAMPER_HINGES)
                open_lanes(w, k, motion, beta, beta + 1, beta + 2, beta + 3)
                for j in range(n):
                    share = (j + 1.0) / n
                    _ground(w, road, candidate_road, row, 1.0 / h)
                    row += 1
                    speed = motion[k - 1, 5] + (share - 0.5 / n) * (motion[k, 5] - motion[k - 1, 5])
                    turn = yaw_rate(motion[k - 1, 3], yaw, share)
                    force = motion[k - 1, 7] + share * (motion[k, 7] - motion[k - 1, 7]) if actuated else 0.0
                    _step(w, flag, h, share, speed, turn, force, _CURVES, _SPRING_HINGES, _DAMPER_HINGES)
                for i in range(WIDTH):
                    close_interval(w, i, h)
            last = row - 1
            watch(w, road[last, 0], road[last, 1], road[last, 2], road[last, 3])
            for i in range(WIDTH):
                n0, n1, n2, n3 = four(w, rows.GROUND, i)
                touch(w, i, n0, n1, n2, n3)
                sense(w, i, ax, ay, yaw, dyaw)
            if flag & _STAMP_OF:
                _STAMP(w, flag, h)
            record(w, lane0 + block * WIDTH, k - begin, signals, states)


def _start(w: Floats, road: Floats, motion: Floats) -> None:
    """Put the vehicle in equilibrium on four heights."""
    stride = 5 + 2 * _SPRING_HINGES + 4 * _DAMPER_HINGES
    c0, c1, c2, c3 = _CURVES, _CURVES + stride, _CURVES + 2 * stride, _CURVES + 3 * stride
    for c in range(4):
        w[(rows.ROAD + c) * WIDTH] = road[c]
        w[(rows.ROAD_RATE + c) * WIDTH] = 0.0
    mx, my = moments(w, 0, motion[0], motion[1], motion[2] * motion[2], motion[3])
    _STAND(w, 0, mx, my, motion[4], motion[5], c0, c1, c2, c3, _SPRING_HINGES)


@compiled_later
def _advance(
    w: Floats, n: int, h: float, road0: Floats, road1: Floats, motion0: Floats, motion1: Floats
) -> None:
    """Walk an interval in n steps of h s, from one road and motion to another."""
    beta = rows.CORNER_IMPLICIT
    if _FLAG & (_DAMPERS_OF | COMPLIANT):
        put(w, rows.DAMPER_SHARE, 0, 1.0, 1.0, 1.0, 1.0)
        _DAMPERS(w, _FLAG, h)
        retable(w, h, _CURVES, _SPRING_HINGES, _DAMPER_HINGES)
    mx, my = moments(w, 0, motion0[0], motion0[1], motion0[2] * motion0[2], motion0[3])
    to_x, to_y = moments(w, 0, motion1[0], motion1[1], motion1[2] * motion1[2], motion1[3])
    open_interval(w, 0, h, beta, beta + 1, beta + 2, beta + 3, mx, my, to_x - mx, to_y - my)
    for j in range(n):
        share = (j + 1.0) / n
        for c in range(4):
            z = road1[c] - (1.0 - share) * (road1[c] - road0[c])
            w[(rows.ROAD_RATE + c) * WIDTH] = (z - w[(rows.ROAD + c) * WIDTH]) / h
            w[(rows.ROAD + c) * WIDTH] = z
        speed = motion0[4] + (share - 0.5 / n) * (motion1[4] - motion0[4])
        turn = yaw_rate(motion0[2], motion1[2], share)
        _step(w, _FLAG, h, share, speed, turn, 0.0, _CURVES, _SPRING_HINGES, _DAMPER_HINGES)
    close_interval(w, 0, h)


def _read(w: Floats, motion: Floats, out: Floats) -> None:
    """Outputs at a stamp."""
    r0, r1, r2, r3 = four(w, rows.ROAD, 0)
    watch(w, r0, r1, r2, r3)
    n0, n1, n2, n3 = four(w, rows.GROUND, 0)
    touch(w, 0, n0, n1, n2, n3)
    sense(w, 0, motion[0], motion[1], motion[2], motion[3])
    if _FLAG & _STAMP_OF:
        _STAMP(w, _FLAG, 0.0)
    see(w, out)
    for c in range(4):
        x, y = w[(rows.ARM_X + c // 2) * WIDTH], w[(rows.ARM_Y + c) * WIDTH]
        u, v = w[(rows.WHEEL + c) * WIDTH], w[(rows.WHEEL_RATE + c) * WIDTH]
        body = out[0] + y * out[1] - x * out[2]
        out[4 + c] = u - w[(rows.STATIC + c) * WIDTH] + _RADIUS
        out[8 + c] = u - body
        out[12 + c] = v - (w[rows.HEAVE_RATE] + y * w[rows.ROLL_RATE] - x * w[rows.PITCH_RATE])
        out[30 + c] = w[(rows.WHEEL_ACCELERATION + c) * WIDTH]


_AT_CORNERS = "        for i in range(WIDTH):\n            for c in range({count}):\n"
#: Source of a term in its stage, and of an elastic element of a corner and of an axle in the stage ``strut``.
_TERM = _AT_CORNERS + "                {call}h)\n"
_AT_CORNER = _AT_CORNERS + "                w[(STRUT + c) * WIDTH + i] += {call}travel(w, c, i))[0]\n"
_AT_AXLE = (
    _AT_CORNERS
    + "                force = {call}travel(w, 2 * c, i) - travel(w, 2 * c + 1, i))[0]\n"
    + "                w[(STRUT + 2 * c) * WIDTH + i] += force\n"
    + "                w[(STRUT + 2 * c + 1) * WIDTH + i] -= force\n"
)
#: And of either in the static equilibrium of a lane.
_STATIC = (
    "    for c in range({count}):\n"
    "        f, k = {call}travel[{first} + c])\n"
    "        force[{first} + c] += f\n"
    "        stiffness[{first} + c] += k\n"
)


def _made(name: str, arguments: str, lines: list[str], names: Mapping[str, object]) -> Callable[..., None]:
    """The compiled function with a body of ``lines`` in which ``names`` are known; its source can be inspected."""
    text = f"def {name}({arguments}) -> None:\n" + "".join(lines or ["    pass\n"])
    file = f"<{__name__}.{name}>"
    linecache.cache[file] = len(text), None, text.splitlines(keepends=True), file
    scope: dict[str, Any] = dict(names)
    exec(compile(text, file, "exec"), scope)
    function: Callable[..., None] = linked(scope[name])
    return function


@dataclass(frozen=True, eq=False)
class EffectKernels:
    """The kernel with all effects.

    ``terms``, ``first`` and ``bit`` give by id of an effect its terms, the first row of its fields and its bit in the
    flags of a block; ``curves`` is the first row of the curves and ``kernels`` has a kernel for each number of hinges.
    ``parts`` are what the kernels are assembled of, by the name that they have there.
    """

    terms: Mapping[str, KernelTerms]
    first: Mapping[str, int]
    bit: Mapping[str, int]
    curves: int
    kernels: Mapping[Hinges, Callable[..., None]]
    parts: Mapping[str, object]

    def rows(self, hinges: Hinges) -> int:
        """Rows of a block."""
        return self.curves + 4 * rows.axle_rows(hinges) + 4 * 2 * 3 * (hinges.damper + 1)


@cache
def effect_kernels(links_alone: bool = False) -> EffectKernels:
    """The kernel with links and the effects of the registry, or with ``links_alone``, compiled when it is first run."""
    from suspension_twin.effects.registry import EFFECTS  # whose files import models.hooks

    hooks, suffix = {"linkage": LINKAGE}, "_links" if links_alone else ""
    if not links_alone:
        hooks |= {name: effect.hook for name, effect in EFFECTS.items()}
    terms = {name: hook.kernel for name, hook in hooks.items() if hook.kernel is not None}
    first, bit, end = {}, {}, rows.CURVES
    stages: dict[str, list[str]] = {stage: [] for stage in get_args(Stage)}
    flags = dict.fromkeys(stages, 0)
    static: list[str] = []
    restart: list[str] = []
    names: dict[str, object] = {"WIDTH": WIDTH, "STRUT": rows.STRUT, "travel": travel, "Floats": Floats}
    for index, (name, own) in enumerate(terms.items(), 1):
        e, first[name], bit[name] = end, end, SOFT << index
        names[name.upper()] = e
        end += own.fields.count
        for field in own.fields.restarted:
            last = e + field + own.fields.sizes[field]
            restart.append(
                f"    for row in range({e + field}, {last}):\n        w[row * WIDTH + lane] = 0.0\n"
            )
        if own.elastic is not None:
            names[name], count = own.elastic
            call = f"{name}(w, {name.upper()}, c, i, "
            corner = count == rows.CORNER
            source = _AT_CORNER if corner else _AT_AXLE
            flags["strut"] |= bit[name]
            stages["strut"].append(f"    if flag & {bit[name]}:\n{source.format(count=count, call=call)}")
            static.append(_STATIC.format(count=count, call=call, first=0 if corner else 4))
        for stage, (term, count) in own.terms.items():
            names[f"{name}_{stage}"] = term
            source = _TERM.format(count=count, call=f"{name}_{stage}(w, {name.upper()}, c, i, ")
            flags[stage] |= bit[name]
            stages[stage].append(f"    if flag & {bit[name]}:\n{source}")
    elastic = _made(
        f"elastic{suffix}",
        "w: Floats, i: int, travel: Floats, force: Floats, stiffness: Floats",
        static,
        names,
    )
    standing = stand_with(_made(f"restart{suffix}", "w: Floats, lane: int", restart, names), elastic)
    parts: dict[str, object] = {
        f"_{stage.upper()}": _made(f"{stage}_of{suffix}", "w: Floats, flag: int, h: float", lines, names)
        for stage, lines in stages.items()
    }
    parts |= {f"_{stage.upper()}_OF": own for stage, own in flags.items()}
    parts |= {"_CURVES": end, "_STAND": standing}
    modules = [EFFECTS.module(name) for name in terms if name in EFFECTS]
    parts["_step"] = inlined(specialised(_step, f"step{suffix}", **parts), modules)
    kernels = {
        hinges: compiled(
            specialised(
                _run,
                f"_run_{hinges.spring}_{hinges.damper}" + suffix,
                **constants_for(hinges),
                **parts,
            ),
            modules,
        )
        for hinges in KERNEL_HINGES
    }
    return EffectKernels(terms, first, bit, end, kernels, parts)


#: Largest product of step and frequency with everything that a term can add to a wheel's stiffness.
_MAX_PHASE = 1.5


def constants_of(given: Candidates, road: RoadChange, antenna: float, actuated: bool) -> Block:
    """Constants of the kernel, of the block without effects where that is enough; see ``car.CarKernel``."""
    out = stance = block_rows(given)
    if any(given.numbers[name] is not given.stance[name] for name in given.stance):
        # heights count from the static equilibrium without the load that effects add
        stance = block_rows(given, stance=True)
    has_effects = given.corners.changed or any(armed.any() for _, armed in given.effects.values())
    if antenna and (has_effects or stance is not out):
        with np.errstate(all="ignore"):
            pitch, roll = static_attitude(out, stance, given)
        road = replace(road, ahead=road.ahead - antenna * pitch, left=road.left + antenna * roll)
    if stance is not out:
        for row in (rows.STATIC, rows.LOAD):
            out[row : row + 4] = stance[row : row + 4]
    out[rows.TOUCH : rows.TOUCH + 4] = (
        out[rows.LOAD : rows.LOAD + 4] + out[rows.TYRE] * out[rows.STATIC : rows.STATIC + 4]
    )
    if not (has_effects or actuated or road.changed.any()):
        return Block(out, None, road)
    return Block(*_with_effects(out, given), road)


def one_lane(flag: int) -> LaneFunctions:
    """A lane by itself, see ``car.CarKernel``."""
    return (_start, _advance, _read), {
        **effect_kernels(bool(flag & LINKS_ALONE)).parts,
        "_FLAG": flag & ~LINKS_ALONE,
    }


def walk(
    hinges: Hinges, blocks: Floats, flags: Ints | None, road: Floats, candidate_road: Floats, walk: Walk
) -> None:
    """Take blocks of lanes along; see ``car.CarKernel``."""
    if flags is None:
        KERNELS[hinges](blocks, road, *walk)
    else:
        kernels = effect_kernels(bool(flags[0] & LINKS_ALONE)).kernels
        kernels[hinges](blocks, flags, road, candidate_road, *walk)


def _with_effects(base: Floats, given: Candidates) -> tuple[Floats, Ints]:
    """Rows of a block with effects (rows, L) from those without (block_rows, L), and the flags (L,) of the lanes."""
    alone = all(name == "linkage" or not armed.any() for name, (_, armed) in given.effects.items())
    kernels, hinges, corners = effect_kernels(alone), hinges_of(given.characteristics), given.corners
    max_step, check = given.max_step, given.problems.check
    count = base.shape[1]
    out = np.zeros((kernels.rows(hinges), count))
    flags = np.full(count, LINKS_ALONE if alone else 0, dtype=np.int64)
    stride = rows.axle_rows(hinges)
    first, master = kernels.curves, kernels.curves + 4 * stride
    out[: rows.CURVES] = base[: rows.CURVES]
    out[rows.DAMPER_SHARE : rows.DAMPER_SHARE + 4] = 1.0
    out[rows.COMPLIANCE : rows.COMPLIANCE + 4] = corners.compliance
    out[rows.TYRE_CHANGE : rows.TYRE_CHANGE + 4] = corners.tyre
    flags[corners.compliance.any(axis=0)] |= COMPLIANT
    flags[corners.tyre.any(axis=0)] |= SOFT
    for c in range(4):
        strut = given.characteristics[AXLES[c // 2]].scaled(1 + corners.spring[c], 1 + corners.damper[c])
        beta = out[rows.CORNER_IMPLICIT + c] = base[rows.IMPLICIT + c // 2]
        with np.errstate(all="ignore"):
            write_curves(out, first + c * stride, hinges, strut, beta)
            shorten_spring(out, first + c * stride, hinges.spring, corners.sag[c])
        for curve in (strut.push, strut.pull):
            for row in (curve.x, curve.f, curve.slope):  # the last point repeated up to the number of hinges
                out[master : master + len(row)] = row
                out[master + len(row) : master + hinges.damper + 1] = row[-1]
                master += hinges.damper + 1

    with np.errstate(all="ignore"):
        springs = [given.characteristics[axle].spring.slope.max(axis=0) for axle in AXLES]
        tyre = out[rows.TYRE] * (1.0 + np.maximum(corners.tyre.max(axis=0), 0.0))
        stiff, fastest = tyre + np.maximum(*springs), np.zeros(count)
        parts = (corners.spring, corners.damper, corners.compliance, corners.tyre, corners.sag)
        finite = np.isfinite(np.concatenate(parts)).all(axis=0)
        check(~(corners.tyre > -1.0).all(axis=0), "effects", "leave a tyre no stiffness")
        for name, (values, armed) in given.effects.items():
            if name not in kernels.terms:  # no lane has it
                continue
            terms, e = kernels.terms[name], kernels.first[name]
            flags[armed] |= kernels.bit[name]
            for field, value in terms.constants(values).items():
                size = terms.fields.sizes[field]
                own = out[e + field : e + field + size]
                own[:] = value
                finite &= np.isfinite(own).all(axis=0)
                if field in terms.stiffness:  # of an axle: between left and right, which feel it twice
                    stiff = stiff + (2 if size == rows.AXLE else 1) * own.max(axis=0)
                if field in terms.modes:
                    fastest = np.maximum(fastest, own[0])
            if terms.check is not None:
                terms.check(out, e, check)
        check(~finite, "effects", "a parameter is not finite")
        phase = np.sqrt(stiff * out[rows.INV_WHEEL : rows.INV_WHEEL + 2].max(axis=0)) * max_step
        smaller = f"for a step of {max_step:g} s: take a smaller step"
        check(~(phase < _MAX_PHASE), "effects", f"too stiff {smaller}")
        check(~(np.sqrt(fastest) * max_step < 1.0), "effects", f"a mode is too fast {smaller}")
    return out, flags


#: Share of its load by which a spring's rate about it is taken.
_ABOUT = 0.1


def static_attitude(loaded: Floats, stance: Floats, given: Candidates) -> tuple[Floats, Floats]:
    """Pitch (nose down positive) and roll (right side down positive) in rad, (L,) each, against the vehicle without
    its effects.

    ``loaded`` and ``stance`` are rows of blocks with and without the load that effects add. A rigid body on four
    springs in series with tyres: the unbalanced loads of the corners over the rates there. Exactly 0 without any.
    """
    count, change = loaded.shape[1], given.corners
    force, stiffness = np.zeros((3, count)), np.zeros((3, 3, count))
    for i in range(4):
        spring, scale = given.characteristics[AXLES[i // 2]].spring, 1.0 + change.spring[i]
        carried = stance[rows.LOAD + i] - G / stance[rows.INV_WHEEL + i // 2]
        wanted = loaded[rows.LOAD + i] - G / loaded[rows.INV_WHEEL + i // 2]
        more = wanted - scale * carried
        # about the middle of the way from the one load to the other
        middle = carried + 0.5 * more / scale
        low, high = (compression_at(spring, (1.0 + s * _ABOUT) * middle) for s in (-1.0, 1.0))
        rate = scale * 2.0 * _ABOUT * middle / (high - low)
        tyre = loaded[rows.TYRE] * (1.0 + change.tyre[i])
        rate = 1.0 / (1.0 / rate + 1.0 / tyre)
        # a shorter spring and a softer tyre let the corner down by as much as they give more
        more = more + rate * (change.sag[i] - change.tyre[i] * loaded[rows.LOAD + i] / tyre)
        arm = np.stack([np.ones(count), stance[rows.ARM_X + i // 2], -stance[rows.ARM_Y + i]])
        force += more * arm
        stiffness += rate * arm[:, None] * arm[None]
    good = np.isfinite(stiffness).all(axis=(0, 1)) & np.isfinite(force).all(axis=0)
    out = np.zeros((3, count))
    out[:, good] = np.linalg.solve(stiffness[:, :, good].transpose(2, 0, 1), force[:, good].T[:, :, None])[
        :, :, 0
    ].T
    return out[1], out[2]
