# SPDX-License-Identifier: Apache-2.0
"""How C and C# write what kernels are made of. Both agree in everything else that ``translate`` writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

__all__ = ["CSHARP", "C", "Language"]

#: Helpers of the written functions, alike in both languages. ``a * b + c`` may round twice: what processors without
#: the instruction do. ``larger`` and ``smaller`` are Python's ``max`` and ``min``.
_HELPERS: Final = """\
{0} double fma_(double a, double b, double c) {{ return a * b + c; }}
{0} double larger(double a, double b) {{ return b > a ? b : a; }}
{0} double smaller(double a, double b) {{ return b < a ? b : a; }}
"""


@dataclass(frozen=True)
class Language:
    """One of them.

    Parameters
    ----------
    function, helper
        What a function begins with, and a short one.
    constant
        A named integer.
    array, boolean
        Type of an array's argument, given that of its elements, and of a truth value.
    local
        A local array, given the type of its elements, its name and its size.
    out, put, hand
        An argument through which a number is returned, how it is assigned to, and how a variable is handed to it.
    truth
        How False and True are written.
    mathematics
        Functions of Python and of its module ``math``, by the name that they have there.
    reserved
        Words that no variable can be called.
    """

    function: str
    helper: str
    constant: str
    array: str
    boolean: str
    local: str
    out: str
    put: str
    hand: str
    truth: tuple[str, str]
    mathematics: Mapping[str, str]
    reserved: frozenset[str]

    @property
    def helpers(self) -> str:
        """What the functions need beside each other."""
        return _HELPERS.format(self.helper)

    def constants(self, values: Sequence[tuple[str, int]]) -> str:
        """Named integers."""
        return "".join(self.constant.format(name, value) for name, value in values)


_WORDS = "break case char const continue default do double else enum float for goto if int long return short sizeof "
_WORDS += "static struct switch void volatile while"

C: Final = Language(
    function="static",
    helper="static inline",
    constant="#define {} {}\n",
    array="{} *",
    boolean="int",
    local="{0} {1}[{2}];",
    out="double *{}",
    put="*{}",
    hand="&{}",
    truth=("0", "1"),
    mathematics={"abs": "fabs", "sin": "sin", "cos": "cos", "sqrt": "sqrt", "exp": "exp", "tanh": "tanh"},
    reserved=frozenset(f"{_WORDS} auto extern register signed typedef union unsigned inline".split()),
)
CSHARP: Final = Language(
    function="static",
    helper="static",
    constant="const int {} = {};\n",
    array="{}[] ",
    boolean="bool",
    local="{0}[] {1} = new {0}[{2}];",
    out="out double {}",
    put="{}",
    hand="out {}",
    truth=("false", "true"),
    mathematics={
        name: f"System.Math.{name.capitalize()}" for name in ("abs", "sin", "cos", "sqrt", "exp", "tanh")
    },
    reserved=frozenset(
        f"{_WORDS} as base bool byte checked class decimal delegate event fixed foreach implicit in interface internal "
        "is lock namespace new null object operator out override params private public readonly ref sealed string "
        "this throw try typeof using virtual".split()
    ),
)
