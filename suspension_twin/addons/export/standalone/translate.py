# SPDX-License-Identifier: Apache-2.0
"""Kernels of the models, written out as functions of C or C#.

The kernels are written in a small part of Python: numbers, rows of one array, loops over ranges, conditions and calls
of each other. ``Translation`` reads their source and writes each function that is called, once for every set of
arguments that are known integers: those, the constants of the modules and what follows from them are put in, and
branches that cannot be taken are left out. Other syntax is refused. So there is one source of the equations,
and an effect that somebody adds to the library is in the written code as well.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import operator
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from types import FunctionType
from typing import Any, Final, Literal, NoReturn

import numpy as np

from suspension_twin.errors import WorkError
from suspension_twin.models import rows

__all__ = ["CSHARP", "C", "Language", "Translation"]

Kind = Literal["int", "double", "bool"]

#: How tightly operators bind; a name, a call or a subscript binds tightest.
_TIGHT = 20
_OPERATORS: Final[Mapping[type[ast.AST], tuple[str, int]]] = {
    ast.Mult: ("*", 12),
    ast.Div: ("/", 12),
    ast.FloorDiv: ("/", 12),
    ast.Add: ("+", 11),
    ast.Sub: ("-", 11),
    ast.Lt: ("<", 9),
    ast.LtE: ("<=", 9),
    ast.Gt: (">", 9),
    ast.GtE: (">=", 9),
    ast.Eq: ("==", 8),
    ast.NotEq: ("!=", 8),
    ast.BitAnd: ("&", 7),
    ast.BitOr: ("|", 5),
    ast.And: ("&&", 4),
    ast.Or: ("||", 3),
}
_IF_BINDS, _UNARY_BINDS = 2, 14
_PYTHON: Final[Mapping[type[ast.AST], Callable[[Any, Any], Any]]] = {
    ast.Mult: operator.mul,
    ast.FloorDiv: operator.floordiv,
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_SYMBOL = re.compile(r"[A-Z][A-Z0-9_]*")
#: Helpers of the written functions, alike in both languages. ``a * b + c`` may round twice: what processors without
#: the instruction do. ``larger`` and ``smaller`` are Python's ``max`` and ``min``.
_HELPERS: Final = """\
{0} double fma_(double a, double b, double c) {{ return a * b + c; }}
{0} double larger(double a, double b) {{ return b > a ? b : a; }}
{0} double smaller(double a, double b) {{ return b < a ? b : a; }}
"""


@dataclass(frozen=True)
class Language:
    """Syntax of a language where C and C# differ.

    Parameters
    ----------
    helper : str
        Beginning of a short function.
    constant : str
        A named integer, given name and value.
    array : str
        Type of an array's argument, given that of its elements.
    local : str
        A local array, given the type of its elements, its name and its size.
    out : tuple of str
        An argument through which a number is returned, as the target of an assignment, and a variable handed to it,
        each given the name.
    boolean : tuple of str
        Type of a truth value, False and True.
    mathematics : mapping
        Functions of Python and of its module ``math``, by the name that they have there.
    reserved : frozenset of str
        Words that no variable can be called.
    """

    helper: str
    constant: str
    array: str
    local: str
    out: tuple[str, str, str]
    boolean: tuple[str, str, str]
    mathematics: Mapping[str, str]
    reserved: frozenset[str]


_WORDS = (
    "break case char const continue default do double else enum float for goto if int long return short sizeof "
    "static struct switch void volatile while"
)

C: Final = Language(
    helper="static inline",
    constant="#define {} {}\n",
    array="{} *",
    local="{0} {1}[{2}];",
    out=("double *{}", "*{}", "&{}"),
    boolean=("int", "0", "1"),
    mathematics={"abs": "fabs", "sin": "sin", "cos": "cos", "sqrt": "sqrt", "exp": "exp", "tanh": "tanh"},
    reserved=frozenset(f"{_WORDS} auto extern register signed typedef union unsigned inline".split()),
)
CSHARP: Final = Language(
    helper="static",
    constant="const int {} = {};\n",
    array="{}[] ",
    local="{0}[] {1} = new {0}[{2}];",
    out=("out double {}", "{}", "out {}"),
    boolean=("bool", "false", "true"),
    mathematics={
        name: f"System.Math.{name.capitalize()}" for name in ("abs", "sin", "cos", "sqrt", "exp", "tanh")
    },
    reserved=frozenset(
        f"{_WORDS} as base bool byte checked class decimal delegate event fixed foreach implicit in interface internal "
        "is lock namespace new null object operator out override params private public readonly ref sealed string "
        "this throw try typeof using virtual".split()
    ),
)


@dataclass(frozen=True)
class _Value:
    """An expression: its text, its type, how tightly it binds, and its value where that is known."""

    text: str
    kind: Kind
    binds: int = _TIGHT
    known: int | float | bool | None = None
    shape: tuple[int, ...] | None = None  # of an array; () where it has one dimension of unknown length


@dataclass(frozen=True)
class _Function:
    """A written function: its name, and how many numbers it returns, -1 for one by its value."""

    name: str
    results: int


class Translation:
    """Functions of Python written out in a language, as they are called.

    Parameters
    ----------
    language : Language
        The language.
    """

    def __init__(self, language: Language) -> None:
        self.language = language
        self._written: dict[tuple[object, ...], _Function] = {}
        self._names: Counter[str] = Counter()
        self._texts: list[str] = []
        self._symbols: dict[str, int] = {}

    @property
    def text(self) -> str:
        """Everything written so far: named rows, helpers, and functions after those that they call."""
        symbols = sorted(self._symbols.items(), key=lambda item: (item[1], item[0]))
        constants = "".join(self.language.constant.format(name, value) for name, value in symbols)
        return "\n".join([constants, _HELPERS.format(self.language.helper), *self._texts])

    def add(self, function: Callable[..., object]) -> str:
        """Write a function and those that it calls; returns its name."""
        python = _python(function)
        arguments = [
            _Value(name, "int" if kind == "int" else "double", shape=() if kind == "Floats" else None)
            for name, kind in _annotated(python)
        ]
        return self.function(python, arguments).name

    def function(self, python: FunctionType, arguments: Sequence[_Value]) -> _Function:
        """The written function for a call with such arguments."""
        key = (python, *((_put_in(value), value.shape) for value in arguments))
        if key not in self._written:
            writer = _Writer(self, python, arguments)
            self._written[key] = _Function(self._name(python), writer.results)
            self._texts.append(writer.write(self._written[key].name))
        return self._written[key]

    def _name(self, python: FunctionType) -> str:
        """A name for a function that no other has."""
        stem = str(python.__module__).rpartition(".")[2]
        own = python.__name__.strip("_")
        own = f"{stem}_{own}" if python.__name__.startswith("_") and stem else own
        self._names[own] += 1
        return own if self._names[own] == 1 else f"{own}_{self._names[own]}"

    def symbol(self, name: str, value: int) -> str:
        """A constant by its name, or by its value where the name means another one."""
        if _SYMBOL.fullmatch(name) and self._symbols.setdefault(name, value) == value:
            return name
        return str(value)


def _python(function: object) -> FunctionType:
    """The Python function behind a compiled one."""
    found = getattr(function, "py_func", function)
    assert inspect.isfunction(found)
    return found


def _tree(python: FunctionType) -> ast.FunctionDef:
    """The source of a function."""
    found = ast.parse(textwrap.dedent(inspect.getsource(python))).body[0]
    assert isinstance(found, ast.FunctionDef)
    return found


def _annotated(python: FunctionType) -> list[tuple[str, str]]:
    """Arguments of a function with the words of their types."""
    return [(node.arg, ast.unparse(node.annotation or ast.Name("float"))) for node in _tree(python).args.args]


def _put_in(value: _Value) -> tuple[str, int] | None:
    """A known integer, with the text that stands for it."""
    return (value.text, int(value.known)) if value.kind == "int" and value.known is not None else None


class _Writer:
    """Writes one function for one set of arguments."""

    def __init__(self, program: Translation, python: FunctionType, arguments: Sequence[_Value]) -> None:
        self.program, self.language, self.python = program, program.language, python
        self.tree = _tree(python)
        closure = inspect.getclosurevars(python).nonlocals
        self.scope = {**vars(builtins), **python.__globals__, **closure}
        self.lines: list[str] = []
        self.depth = 1
        self.variables: dict[str, _Value] = {}
        self.locals: dict[str, tuple[str, str]] = {}
        self.temporaries = 0
        self.breaks: list[str] = []
        self.results = self._results()
        self.signature = self._arguments(arguments)

    # -- the function as a whole

    def refuse(self, node: ast.AST, why: str) -> NoReturn:
        line = getattr(node, "lineno", 0)
        raise WorkError(
            f"{self.python.__module__}.{self.python.__name__}, line {line}: {why} cannot be written out"
        )

    def _results(self) -> int:
        """Numbers that the function returns in a tuple, -1 for one by its value."""
        returns = ast.unparse(self.tree.returns or ast.Constant(None))
        if returns.startswith("tuple"):  # tuple[float, ...]
            return returns.count("float")
        return 0 if returns == "None" else -1

    def _arguments(self, arguments: Sequence[_Value]) -> str:
        signature = []
        for node, value in zip(self.tree.args.args, arguments, strict=True):
            if _put_in(value) is not None:
                self.variables[node.arg] = value
                continue
            name = self._named(node.arg)
            if value.shape is not None:
                signature.append(self.language.array.format(value.kind) + name)
                self.variables[node.arg] = _Value(name, value.kind, shape=value.shape)
            else:
                kind: Kind = "int" if value.kind == "int" else "double"
                signature.append(f"{kind} {name}")
                self.variables[node.arg] = _Value(name, kind)
        signature += [self.language.out[0].format(f"r{k}_") for k in range(max(self.results, 0))]
        return ", ".join(signature) or ("void" if self.language is C else "")

    def write(self, name: str) -> str:
        doc = ast.get_docstring(self.tree, clean=False) or ""
        text = " ".join(doc.partition("\n\n")[0].split()).replace("``", "").replace("*/", "")
        comment = f"/* {text} */\n" if doc else ""
        self.statements(self.tree.body[bool(doc) :])
        kind = "double" if self.results < 0 else "void"
        locals_ = list(self._declarations())
        if self.language is C:  # an argument that nothing reads: said, for compilers that ask
            read = set(re.findall(r"\w+", "\n".join(self.lines)))
            given = re.findall(r"(\w+)(?:,|$)", self.signature.replace("void", ""))
            locals_ += [f"    (void){argument};" for argument in given if argument not in read]
        head = f"{comment}static {kind} {name}({self.signature})"
        return "\n".join([head, "{", *locals_, *self.lines, "}", ""])

    def _declarations(self) -> Iterator[str]:
        """Lines that declare the local variables: numbers of one kind together, arrays each."""
        for kind in dict.fromkeys(kind for kind, _ in self.locals.values()):
            texts = [text for of, text in self.locals.values() if of == kind]
            if kind:
                yield from textwrap.wrap(
                    f"{kind} {', '.join(texts)};", 100, initial_indent="    ", subsequent_indent="        "
                )
            else:
                yield from (f"    {text}" for text in texts)

    # -- names

    def _named(self, name: str) -> str:
        name = "round" if name == "_" else name
        return f"{name}_" if name in self.language.reserved else name

    def local(self, name: str, value: _Value) -> _Value:
        """A variable that takes values like this one, declared when it is met first."""
        found = self.variables.get(name)
        if found is not None and found.known is None and found.text in (self._named(name), name):
            if found.kind == "int" and value.kind == "double":
                self.refuse(self.tree, f"{name}, an integer that becomes a number,")
            return found
        text = self._named(name)
        found = self.variables[name] = _Value(text, value.kind)
        kind, start = {
            "int": ("int", "0"),
            "double": ("double", "0.0"),
            "bool": self.language.boolean[:2],
        }[value.kind]
        self.locals[text] = kind, f"{text} = {start}"
        return found

    def temporary(self, kind: Kind) -> _Value:
        self.temporaries += 1
        return self.local(f"t{self.temporaries}_", _Value("", kind))

    def array(self, name: str, kind: Kind, shape: tuple[int, ...]) -> _Value:
        text = self._named(name)
        self.locals[text] = "", self.language.local.format(kind, text, math.prod(shape))
        found = self.variables[name] = _Value(text, kind, shape=shape)
        return found

    def resolve(self, node: ast.expr) -> Any:
        """The object of Python that a name or an attribute means."""
        if isinstance(node, ast.Attribute):
            return getattr(self.resolve(node.value), node.attr, None)
        return self.scope.get(node.id) if isinstance(node, ast.Name) else None

    # -- statements

    def line(self, text: str) -> None:
        self.lines.append("    " * self.depth + text)

    @contextmanager
    def block(self, head: str) -> Iterator[None]:
        self.line(f"{head} {{")
        self.depth += 1
        yield
        self.depth -= 1
        self.line("}")

    def statements(self, nodes: Sequence[ast.stmt]) -> None:
        for node in nodes:
            self.method("_", node)(node)

    def method(self, prefix: str, node: ast.AST) -> Any:
        """The method that writes nodes of this type."""
        name = type(node).__name__
        return getattr(self, prefix + name.lower(), None) or self.refuse(node, name)

    def _pass(self, node: ast.Pass) -> None:
        pass

    def _expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Call):
            self.refuse(node, "an expression without an effect")
        self._of_call(node.value, as_statement=True)

    def _return(self, node: ast.Return) -> None:
        if self.results < 0 and node.value is not None:
            self.line(f"return {self.number(node.value).text};")
            return
        values = node.value.elts if isinstance(node.value, ast.Tuple) else []
        for k, value in enumerate([self.number(item) for item in values]):
            self.line(f"{self.language.out[1].format(f'r{k}_')} = {value.text};")
        if node is not self.tree.body[-1]:
            self.line("return;")

    def _break(self, node: ast.Break) -> None:
        if self.breaks[-1]:
            self.line(f"{self.breaks[-1]} = {self.language.boolean[2]};")
        self.line("break;")

    def _if(self, node: ast.If) -> None:
        test = self.expression(node.test)
        if test.known is not None:
            self.statements(node.body if test.known else node.orelse)
            return
        with self.block(f"if ({self.truth(test)})"):
            self.statements(node.body)
        if node.orelse:
            with self.block("else"):
                self.statements(node.orelse)

    def truth(self, value: _Value) -> str:
        return value.text if value.kind == "bool" else f"{value.text} != 0"

    @contextmanager
    def loop(self, name: str, begin: str, end: str, step: int = 1) -> Iterator[str]:
        """A loop of a variable over integers from ``begin`` to before ``end``; gives the variable's text."""
        self.variables.pop(name, None)
        index = self.local(name, _Value("", "int")).text
        towards, move = ("<", "++") if step == 1 else (">", "--")
        with self.block(f"for ({index} = {begin}; {index} {towards} {end}; {index}{move})"):
            yield index

    def _each(self, array: _Value) -> AbstractContextManager[str]:
        """A loop over the elements of an array."""
        assert array.shape is not None
        return self.loop("n_", "0", str(math.prod(array.shape)))

    def _for(self, node: ast.For) -> None:
        if not (
            isinstance(node.iter, ast.Call)
            and isinstance(node.target, ast.Name)
            and self.resolve(node.iter.func) is range
        ):
            self.refuse(node, "a loop over what is no range")
        bounds = [self.expression(argument) for argument in node.iter.args]
        begin, end = (bounds if len(bounds) > 1 else [_Value("0", "int", known=0), *bounds])[:2]
        step = bounds[2].known if len(bounds) > 2 else 1
        if begin.known is not None and end.known == begin.known + 1 and not node.orelse and step == 1:
            self.variables[node.target.id] = begin  # once: such as over the lanes of a block of one
            self.statements(node.body)
            del self.variables[node.target.id]
            return
        if step not in (1, -1):
            self.refuse(node, "a loop with such a step")
        flag = ""
        if node.orelse:
            flag = self.temporary("bool").text
            self.line(f"{flag} = {self.language.boolean[1]};")
        self.breaks.append(flag)
        with self.loop(node.target.id, begin.text, end.text, int(step)):
            self.statements(node.body)
        self.breaks.pop()
        if node.orelse:
            with self.block(f"if (!{flag})"):
                self.statements(node.orelse)

    def _assign(self, node: ast.Assign) -> None:
        for target in node.targets:
            pairs = [(target, node.value)]
            if isinstance(target, ast.Tuple):
                if isinstance(node.value, ast.Call):
                    self._take(target.elts, node.value)
                    continue
                if not isinstance(node.value, ast.Tuple):
                    self.refuse(node, "an assignment to several names of what is no tuple")
                pairs = list(zip(target.elts, node.value.elts, strict=True))
            if len(pairs) > 1 and _depend(pairs):
                values = [self.kept(value) for _, value in pairs]
                for (to, _), kept in zip(pairs, values, strict=True):
                    self.store(to, kept)
            else:
                for to, value in pairs:
                    self._single(to, value)

    def kept(self, node: ast.expr) -> _Value:
        """The value of an expression, in a variable of its own unless it is known."""
        value = self.expression(node)
        if value.known is not None:
            return value
        found = self.temporary(value.kind)
        self.line(f"{found.text} = {value.text};")
        return found

    def _annassign(self, node: ast.AnnAssign) -> None:
        self._single(node.target, node.value or ast.Constant(None))

    def _single(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Name):
            if isinstance(value, ast.Call) and self.resolve(value.func) in (np.empty, np.zeros):
                self._allocate(target.id, value)
                return
            if isinstance(value, ast.Tuple | ast.List):
                items = [self.expression(item) for item in value.elts]
                kind: Kind = "int" if all(item.kind == "int" for item in items) else "double"
                made = self.array(target.id, kind, (len(items),))
                for k, item in enumerate(items):
                    self.line(f"{made.text}[{k}] = {item.text};")
                return
            if isinstance(value, ast.ListComp):
                self._listed(target.id, value)
                return
        self.store(target, self.expression(value))

    def store(self, target: ast.expr, value: _Value) -> None:
        if isinstance(target, ast.Name):
            if value.kind == "int" and value.known is not None and self._constant(target.id):
                self.variables[target.id] = value
                return
            self.line(f"{self.local(target.id, value).text} = {value.text};")
        elif isinstance(target, ast.Subscript) and isinstance(target.slice, ast.Slice):
            array = self.expression(target.value)
            assert array.shape
            with self._each(array) as index:
                self.line(f"{array.text}[{index}] = {value.text};")
        else:
            self.line(f"{self.expression(target).text} = {value.text};")

    def _constant(self, name: str) -> bool:
        """Whether a local name is assigned to only once."""
        stores = (
            n.id for n in ast.walk(self.tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
        )
        return list(stores).count(name) == 1

    def _allocate(self, name: str, node: ast.Call) -> None:
        shape = node.args[0]
        sizes = shape.elts if isinstance(shape, ast.Tuple) else [shape]
        known = tuple(int(self.expression(size).known or 0) for size in sizes)
        array = self.array(name, "double", known)
        if self.resolve(node.func) is np.zeros:
            with self._each(array) as index:
                self.line(f"{array.text}[{index}] = 0.0;")

    def _listed(self, name: str, node: ast.ListComp) -> None:
        (loop,) = node.generators
        assert isinstance(loop.target, ast.Name)
        assert isinstance(loop.iter, ast.Call)
        count = self.expression(loop.iter.args[0]).known
        assert count is not None
        array = self.array(name, "double", (int(count),))
        with self.loop(loop.target.id, "0", str(count)) as index:
            self.line(f"{array.text}[{index}] = {self.number(node.elt).text};")

    def _take(self, targets: Sequence[ast.expr], node: ast.Call) -> None:
        """Several names from a call that returns several numbers."""
        names = [target.id for target in targets if isinstance(target, ast.Name)]
        plain = len(names) == len(targets)
        results = self.results_of(node, [self.local(n, _Value("", "double")) for n in names] if plain else ())
        if len(results) != len(targets):
            self.refuse(node, "a call that returns another number of values")
        for target, value in () if plain else zip(targets, results, strict=True):
            self.store(target, value)

    def _augassign(self, node: ast.AugAssign) -> None:
        symbol, _ = _OPERATORS[type(node.op)]
        if isinstance(node.target, ast.Name) and (array := self.variables.get(node.target.id)) is not None:
            if array.shape is not None:
                with self._each(array) as index:
                    value = self._elementwise(node.value, index)
                    self.line(f"{array.text}[{index}] {symbol}= {value.text};")
                return
            if array.known is not None:
                self.refuse(node, "a change of a known number")
        value = self.expression(node.value)
        self.line(f"{self.expression(node.target).text} {symbol}= {value.text};")

    def _elementwise(self, node: ast.expr, index: str) -> _Value:
        """An expression in which whole arrays stand for their element ``index``."""
        arrays = {name: value for name, value in self.variables.items() if value.shape is not None}
        for name, array in arrays.items():
            self.variables[name] = _Value(f"{array.text}[{index}]", array.kind)
        value = self.number(node)
        self.variables |= arrays
        return value

    # -- expressions

    def number(self, node: ast.expr) -> _Value:
        """An expression as a number with a point."""
        value = self.expression(node)
        return _floating(value) if value.known is not None else value

    def expression(self, node: ast.expr) -> _Value:
        found: _Value = self.method("_of_", node)(node)
        return found

    def _of_constant(self, node: ast.Constant) -> _Value:
        return self.literal(node, node.value)

    def literal(self, node: ast.AST, value: Any) -> _Value:
        if isinstance(value, bool):
            return _Value(self.language.boolean[1 + value], "bool", known=value)
        if isinstance(value, int):
            return _Value(str(value), "int", _TIGHT if value >= 0 else _UNARY_BINDS, known=value)
        if isinstance(value, float):
            return _Value(_literal(value), "double", _TIGHT if value >= 0 else _UNARY_BINDS, known=value)
        self.refuse(node, f"a {type(value).__name__}")

    def _of_name(self, node: ast.Name | ast.Attribute) -> _Value:
        if isinstance(node, ast.Name) and node.id in self.variables:
            return self.variables[node.id]
        name = node.id if isinstance(node, ast.Name) else node.attr
        value = self.resolve(node)
        found = self.literal(node, 1 if name == "WIDTH" else value)
        if found.kind == "int" and name != "WIDTH":
            return replace(found, text=self.program.symbol(name, int(value)))
        return found

    _of_attribute = _of_name

    def _of_unaryop(self, node: ast.UnaryOp) -> _Value:
        value = self.expression(node.operand)
        if isinstance(node.op, ast.Not):
            if value.known is not None:
                return self.literal(node, not value.known)
            return _Value(f"!({self.truth(value)})", "bool", _UNARY_BINDS)
        if not isinstance(node.op, ast.USub):
            self.refuse(node, "an operator")
        known = None if value.known is None else -value.known
        text = value.text if value.binds > _UNARY_BINDS else f"({value.text})"
        return _Value(f"-{text}", value.kind, _UNARY_BINDS, known)

    def _of_binop(self, node: ast.BinOp) -> _Value:
        left, right = self.expression(node.left), self.expression(node.right)
        if isinstance(node.op, ast.Pow):
            if right.known != 2:
                self.refuse(node, "a power other than the square")
            return self.joined(ast.Mult, left, left)
        if left.shape is not None or right.shape is not None:
            self.refuse(node, "an operation on whole arrays")
        if type(node.op) not in _OPERATORS:
            self.refuse(node, "an operator")
        return self.joined(type(node.op), left, right)

    def joined(self, how: type[ast.AST], left: _Value, right: _Value) -> _Value:
        """Two expressions with an operator between them; a factor of 1 and a summand of 0 are left away."""
        both_int = left.kind == "int" and right.kind == "int"
        if both_int and how is ast.Mult and "1" in (left.text, right.text):
            return left if right.text == "1" else right
        if both_int and how is ast.Add and "0" in (left.text, right.text):
            return left if right.text == "0" else right
        symbol, binds = _OPERATORS[how]
        if how in (ast.BitAnd, ast.BitOr):  # compilers warn of a comparison beside it
            left, right = (_Value(_within(side, 10), side.kind, known=side.known) for side in (left, right))
        kind: Kind = left.kind if left.kind == right.kind else "double"
        if how is ast.Div:
            kind = "double"
            left, right = (_floating(side) for side in (left, right))
        known = None
        if both_int and left.known is not None and right.known is not None and how in _PYTHON:
            known = _PYTHON[how](left.known, right.known)
            if (left.text.isdigit() and right.text.isdigit()) or how in (ast.BitAnd, ast.BitOr):
                return _Value(str(known), "int", known=known)
        return _Value(f"{_within(left, binds)} {symbol} {_within(right, binds + 1)}", kind, binds, known)

    def _of_compare(self, node: ast.Compare) -> _Value:
        terms = [self.expression(item) for item in (node.left, *node.comparators)]
        parts = []
        for how, left, right in zip(node.ops, terms, terms[1:], strict=False):
            if type(how) not in _OPERATORS:
                self.refuse(node, "a comparison")
            if left.known is not None and right.known is not None:
                parts.append(self.literal(node, bool(_PYTHON[type(how)](left.known, right.known))))
                continue
            symbol, binds = _OPERATORS[type(how)]
            parts.append(
                _Value(f"{_within(left, binds + 1)} {symbol} {_within(right, binds + 1)}", "bool", binds)
            )
        return self.all_of(ast.And, parts)

    def _of_boolop(self, node: ast.BoolOp) -> _Value:
        return self.all_of(type(node.op), [self.expression(item) for item in node.values])

    def all_of(self, how: type[ast.AST], parts: Sequence[_Value]) -> _Value:
        ends = how is ast.Or  # the known value that decides
        if any(part.known is not None and bool(part.known) is ends for part in parts):
            return self.literal(self.tree, ends)
        parts = [part for part in parts if part.known is None]
        if not parts:
            return self.literal(self.tree, not ends)
        if len(parts) == 1:
            return parts[0]
        symbol, binds = _OPERATORS[how]
        both = _OPERATORS[ast.And][1] + 1  # compilers warn of one within the other
        text = f" {symbol} ".join(_within(replace(p, text=self.truth(p)), both) for p in parts)
        return _Value(text, "bool", binds)

    def _of_ifexp(self, node: ast.IfExp) -> _Value:
        test = self.expression(node.test)
        if test.known is not None:
            return self.expression(node.body if test.known else node.orelse)
        body, other = self.expression(node.body), self.expression(node.orelse)
        kind: Kind = body.kind if body.kind == other.kind else "double"
        condition = _within(replace(test, text=self.truth(test)), _IF_BINDS + 1)
        text = f"{condition} ? {_within(body, _IF_BINDS + 1)} : {_within(other, _IF_BINDS)}"
        return _Value(text, kind, _IF_BINDS)

    def _of_subscript(self, node: ast.Subscript) -> _Value:
        if isinstance(node.value, ast.Call):
            which = self.expression(node.slice).known
            assert which is not None
            return self.results_of(node.value)[int(which)]
        array = self.expression(node.value)
        if array.shape is None:
            self.refuse(node, "a subscript of what is no array")
        if isinstance(node.slice, ast.Tuple):
            row, column = (self.expression(item) for item in node.slice.elts)
            wide = array.shape[1]
            start = self.joined(ast.Mult, row, _Value(str(wide), "int", known=wide))
            index = self.joined(ast.Add, start, column)
        else:
            index = self.expression(node.slice)
        return _Value(f"{array.text}[{index.text}]", array.kind)

    def _of_call(self, node: ast.Call, as_statement: bool = False) -> _Value:
        function = self.resolve(node.func)
        name = getattr(function, "__name__", "")
        if function is float:
            return self.number(node.args[0])
        if function is int:
            return _Value(f"(int){_within(self.number(node.args[0]), _TIGHT)}", "int", _UNARY_BINDS)
        if function is abs or function is getattr(math, name, None):
            if name not in self.language.mathematics:
                self.refuse(node, f"{name}()")
            helper = self.language.mathematics[name]
        else:
            helper = _HELPER_OF.get(function, "")
        if helper:
            texts = [self.number(argument).text for argument in node.args]
            return _Value(f"{helper}({', '.join(texts)})", "double")
        written, arguments = self._called(node)
        if written.results != (0 if as_statement else -1):
            self.refuse(
                node, "a call whose results are not used, or one with none or several in an expression"
            )
        text = f"{written.name}({', '.join(arguments)})"
        if as_statement:
            self.line(f"{text};")
        return _Value(text, "double")

    def _called(self, node: ast.Call) -> tuple[_Function, list[str]]:
        """The written function of a call, and the texts of its arguments."""
        function = self.resolve(node.func)
        if not inspect.isfunction(getattr(function, "py_func", function)):
            self.refuse(node, f"a call of {ast.unparse(node.func)}")
        python = _python(function)
        values = [
            self.number(argument) if kind == "float" else self.expression(argument)
            for argument, (_, kind) in zip(node.args, _annotated(python), strict=True)
        ]
        written = self.program.function(python, values)
        return written, [value.text for value in values if _put_in(value) is None]

    def results_of(self, node: ast.Call, into: Sequence[_Value] = ()) -> list[_Value]:
        """Variables with the numbers that a call returns: these, or new ones."""
        written, arguments = self._called(node)
        results = list(into) or [self.temporary("double") for _ in range(written.results)]
        arguments += [self.language.out[2].format(result.text) for result in results]
        self.line(f"{written.name}({', '.join(arguments)});")
        return results


#: Functions that have a helper in the written code.
_HELPER_OF: Final[Mapping[object, str]] = {rows.fma: "fma_", max: "larger", min: "smaller"}


def _within(value: _Value, binds: int) -> str:
    return value.text if value.binds >= binds else f"({value.text})"


def _floating(value: _Value) -> _Value:
    """A side of a true division: an integer becomes a number."""
    if value.kind != "int":
        return value
    if value.known is not None:
        return _Value(_literal(float(value.known)), "double", known=float(value.known))
    return _Value(f"(double){_within(value, _TIGHT)}", "double", _UNARY_BINDS)


def _literal(value: float) -> str:
    if not math.isfinite(value):
        raise WorkError(f"a constant of a kernel is {value}")
    return repr(value)


def _depend(pairs: Sequence[tuple[ast.expr, ast.expr]]) -> bool:
    """Whether one of several assignments reads what an earlier one of them has changed."""
    changed: set[str] = set()
    for target, value in pairs:
        if changed & {node.id for node in ast.walk(value) if isinstance(node, ast.Name)}:
            return True
        node = target.value if isinstance(target, ast.Subscript) else target
        changed |= {node.id} if isinstance(node, ast.Name) else set()
    return False
