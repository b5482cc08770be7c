# SPDX-License-Identifier: Apache-2.0
"""Small things that the compiled kernels share.

Kernels are compiled without any fast-math flag and fuse multiply and add only where
:func:`fma` says so. A lane's numbers are therefore fixed by the source alone: they do not
depend on how many lanes run beside it, how the compiler vectorised the loop, or which of the
two kernels (with and without effects) computed them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import inlined
from suspension_twin.models.rows import WIDTH

__all__ = ["fma", "four", "prefetch", "put", "sin_cos"]

if TYPE_CHECKING:

    def fma(a: float, b: float, c: float) -> float:
        """``a * b + c`` with one rounding."""
        ...

    def prefetch(values: NDArray[Any], index: int) -> None:
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
