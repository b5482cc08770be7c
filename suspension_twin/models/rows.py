# SPDX-License-Identifier: Apache-2.0
"""The fields of a block of lanes, the rows that they take, and the arithmetic that all kernels share.

A block is one flat array of ``rows * WIDTH`` float64: row ``r`` of lane ``l`` is element
``r * WIDTH + l``. ``WIDTH`` is a constant of the source: with it the compiler sees that no two
rows overlap and turns the loop over lanes into vector instructions. A field is a name for one or
more rows: four are the four corners in the usual order, two are front and rear. Fields are declared
here one after the other, and :class:`Fields` computes where each begins. The fields of an effect are
declared in the file of the effect, with rows counted from the effect's first.

The fields below are followed by the fields of all effects, in a block with effects, and then by the curves.

Kernels are compiled without any fast-math flag and fuse multiply and add only where
:func:`fma` says so. A lane's numbers are therefore fixed by the source alone: they do not
depend on how many lanes run beside it, how the compiler vectorised the loop, or which of the
two kernels (with and without effects) computed them.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Final, NamedTuple

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from suspension_twin.arrays import Floats
from suspension_twin.compiled import inlined

__all__ = [
    "AXLE",
    "CORNER",
    "CURVES",
    "HINGES",
    "KERNEL_HINGES",
    "LANE",
    "LINKS_ALONE",
    "STATES",
    "STRETCH",
    "WIDTH",
    "Fields",
    "Hinges",
    "axle_rows",
    "block_rows",
    "constants_for",
    "fma",
    "four",
    "prefetch",
    "put",
    "sin_cos",
]

#: Lanes of a block. One block's rows stay within the first-level cache; searches ask for a dozen lanes at a time more
#: often than for many, and twice the width would gain a twentieth where there are hundreds.
WIDTH: Final = 16
#: Stamps that one block walks before the next one does: what they write stays in the cache.
STRETCH: Final = 64
#: Rows of a field that every corner, every axle or every lane has one of.
CORNER, AXLE, LANE = 4, 2, 1


class Fields:
    """Fields of a block or of an effect, laid out in the order of their declaration."""

    def __init__(self) -> None:
        #: rows of each field by its first row
        self.sizes: dict[int, int] = {}
        #: first rows of the states that a fresh start from rest sets to zero
        self.restarted: list[int] = []

    @property
    def count(self) -> int:
        """Rows of all fields together."""
        return sum(self.sizes.values())

    def add(self, size: int = LANE) -> int:
        """First row of a new field of ``size`` rows, constant or state: zero at first."""
        first = self.count
        self.sizes[first] = size
        return first

    def state(self, size: int = LANE) -> int:
        """First row of a new state that every fresh start sets to zero."""
        first = self.add(size)
        self.restarted.append(first)
        return first


_core = Fields()

# -- state: displacement from standing on a level road at height 0, and its derivatives
#: Heave, roll, pitch in m and rad, four wheels in m; a wheel's height has its spring's static compression added, so
#: that the compression is what it is above the body.
POSITION = HEAVE = _core.add()
ROLL, PITCH, WHEEL = _core.add(), _core.add(), _core.add(CORNER)
VELOCITY = HEAVE_RATE = _core.add()
ROLL_RATE, PITCH_RATE, WHEEL_RATE = _core.add(), _core.add(), _core.add(CORNER)
ACCELERATION = HEAVE_ACCELERATION = _core.add()
ROLL_ACCELERATION, PITCH_ACCELERATION, WHEEL_ACCELERATION = _core.add(), _core.add(), _core.add(CORNER)
DAMPER = _core.add(CORNER)  # damper force at the last step, N
CONTACT = _core.add(CORNER)  # tyre force at the last stamp, N
DEFLECTION_RATE = _core.add(CORNER)  # rate of the springs' compression, m/s, recorded by msd alone
STATES = _core.count  # so many rows are recorded
FAILED = _core.add()  # 0 while the lane is sound, 1 once it has diverged or has no static equilibrium
#: What the virtual sensor reads at the last stamp: specific force 3, rate 3, vertical acceleration.
SIGNAL = _core.add(7)
STRUT = _core.add(CORNER)  # within a step: strut force less the damper's, N
GROUND = _core.add(CORNER)  # within a step: tyre force, negative where the tyre would have to pull, N
LAG = _core.add(CORNER)  # within an interval: weight of the last damper force in the next, s/kg
#: Within an interval: moments in roll and pitch of the planar accelerations at its beginning, and
#: what they gain until its end, N m.
MOMENT = _core.add(4)
ROAD = _core.add(CORNER)  # height under each wheel at this step, m
ROAD_RATE = _core.add(CORNER)  # and how fast it rises, m/s
SPEED = _core.add()  # forward speed in the middle of this step, m/s, in blocks with effects
YAW_RATE = _core.add()  # and yaw rate at its end, rad/s
SHARE = _core.add()  # share of the interval that has passed then
ACTUATOR = _core.add()  # at a fresh start: force of an actuator in every strut, N

# -- constants of a lane
INV_MASS, INV_ROLL, INV_PITCH = _core.add(), _core.add(), _core.add()  # 1 / sprung mass and inertias
ARM_X = _core.add(AXLE)  # wheels ahead of the sprung centre of gravity, m
ARM_Y = _core.add(CORNER)  # wheels to the left of it, m
INV_WHEEL = _core.add(AXLE)  # 1 / unsprung mass
IMPLICIT = _core.add(AXLE)  # beta of the damper tables, s/kg
STATIC = _core.add(CORNER)  # static compression of the springs, m
LOAD = _core.add(CORNER)  # static tyre load, N
TOUCH = _core.add(CORNER)  # tyre force on a road at height 0 of a wheel whose row of POSITION is 0, N
TYRE = _core.add()  # tyre stiffness, N/m
TYRE_CHANGE = _core.add(CORNER)  # share by which the stiffness of one tyre is more, in blocks with effects
TRANSFER = _core.add()  # mass times height of the centre of gravity, kg m
COG = _core.add(2)  # centre of gravity of the whole vehicle: x, y in base_link, m
HEIGHT = _core.add()  # and its height above base_link, m
SPRUNG = _core.add(3)  # centre of gravity of the sprung mass: x, y, z in base_link, m
SENSOR = _core.add(3)  # place of the virtual sensor in base_link, m

# -- dampers that change on the way, in blocks with effects
DAMPER_SHARE = _core.add(CORNER)  # share of its force that each damper has in this interval, 1 when cold
COMPLIANCE = _core.add(CORNER)  # of an elastic mount in series with each damper, m/N
CORNER_IMPLICIT = _core.add(CORNER)  # beta of each corner's table, s/kg

# -- rows of the model msd
HUB, HUB_RATE, HUB_ACCELERATION = (
    _core.add(CORNER),
    _core.add(CORNER),
    _core.add(CORNER),
)  # heights of wheels, m
WEIGHT = _core.add()  # weight of the vehicle, N
SHARE = _core.add(AXLE)  # share of the weight on each axle
PITCH_SHIFT = _core.add()  # share that moves from front to rear for each m/s² ahead, s²/m
ROLL_SHIFT = _core.add(AXLE)  # share of an axle's load that moves to the right for each m/s² left, s²/m
SIDE = _core.add(AXLE)  # share of an axle's load that is more on the left than half of it
INV_CORNER = _core.add()  # 1 / mass above each spring, 1/kg
INV_UNSPRUNG = _core.add()  # 1 / mass of each wheel, 0 where it has none, 1/kg

#: First row after these fields. A block without effects has the curves of the axles here, front then rear; with K
#: hinges of springs and D of dampers: first slope and constant of the spring, K abscissae and K changes of slope; then
#: the damper's table: slope of the first pull segment, change of slope at rest, constant, D abscissae and D changes of
#: slope of push, and of pull. A block with effects has their fields here; then the curves of the four corners, laid
#: out alike, and the dampers as they are, from which tables that change on the way are made: for each corner, push then
#: pull, D + 1 speeds, D + 1 forces and D + 1 slopes.
CURVES = _core.count
#: Kernels are compiled for these numbers of hinges; a curve of k points has k - 1.
HINGES: Final = (3, 7, 31)


class Hinges(NamedTuple):
    """Hinges of every spring and of every damper that a kernel is compiled for."""

    spring: int
    damper: int


#: Bit of the flags of a block for the kernel that has links alone, which is compiled in a fraction of the time.
LINKS_ALONE: Final = 1 << 62
#: The pairs that there are kernels for.
KERNEL_HINGES: Final = tuple(Hinges(*pair) for pair in product(HINGES, HINGES))


def constants_for(hinges: Hinges) -> dict[str, int]:
    """The constants of a kernel for so many hinges, by their names in its module."""
    return {"_SPRING_HINGES": hinges.spring, "_DAMPER_HINGES": hinges.damper}


def axle_rows(hinges: Hinges) -> int:
    """Rows that the curves of one axle take, or, with effects, of one corner."""
    return 5 + 2 * hinges.spring + 4 * hinges.damper


def block_rows(hinges: Hinges) -> int:
    """Rows of a block without effects."""
    return CURVES + 2 * axle_rows(hinges)


if TYPE_CHECKING:

    def fma(a: float, b: float, c: float) -> float:
        """``a * b + c`` with one rounding."""
        ...

    def prefetch(values: Floats, index: int) -> None:
        """Ask for the cache line of element ``index`` of a contiguous array, to write to it soon."""
        ...

else:

    @intrinsic
    def fma(_context, _a, _b, _c):
        """``a * b + c`` with one rounding."""
        signature = types.float64(types.float64, types.float64, types.float64)

        def code(_context, builder, _signature, args):
            return builder.fma(*args)

        return signature, code

    @intrinsic
    def prefetch(_context, values, index):
        """Ask for the cache line of element ``index`` of a contiguous array, to write to it soon."""
        signature = types.void(values, index)

        def code(context, builder, signature, args):
            array = context.make_array(signature.args[0])(context, builder, args[0])
            byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
            address = builder.bitcast(builder.gep(array.data, [args[1]]), byte)
            kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
            hint = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
            builder.call(hint, [address, word(1), word(3), word(1)])
            return context.get_dummy_value()

        return signature, code


@inlined
def four(w: Floats, row: int, i: int) -> tuple[float, float, float, float]:
    """The rows ``row``.. of the four corners, of lane ``i``."""
    return w[row * WIDTH + i], w[(row + 1) * WIDTH + i], w[(row + 2) * WIDTH + i], w[(row + 3) * WIDTH + i]


@inlined
def put(w: Floats, row: int, i: int, v0: float, v1: float, v2: float, v3: float) -> None:
    """Write the rows ``row``.. of the four corners, of lane ``i``."""
    w[row * WIDTH + i], w[(row + 1) * WIDTH + i] = v0, v1
    w[(row + 2) * WIDTH + i], w[(row + 3) * WIDTH + i] = v2, v3


@inlined
def sin_cos(x: float) -> tuple[float, float]:
    """Sine and cosine without a branch, to 1e-15 for |x| <= 0.8 and 1e-11 up to 1.2 rad.

    Roll and pitch of a lane that has not been failed stay below 1 rad.
    """
    q = x * x
    s = fma(q, fma(q, -1 / 1307674368000.0, 1 / 6227020800.0), -1 / 39916800.0)
    s = fma(q, fma(q, fma(q, s, 1 / 362880.0), -1 / 5040.0), 1 / 120.0)
    s = fma(q, fma(q, s, -1 / 6.0), 1.0)
    c = fma(q, fma(q, 1 / 20922789888000.0, -1 / 87178291200.0), 1 / 479001600.0)
    c = fma(q, fma(q, fma(q, c, -1 / 3628800.0), 1 / 40320.0), -1 / 720.0)
    c = fma(q, fma(q, fma(q, c, 1 / 24.0), -0.5), 1.0)
    return s * x, c
