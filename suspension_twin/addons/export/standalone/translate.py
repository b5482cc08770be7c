# SPDX-License-Identifier: Apache-2.0
"""Kernels of the models, written out as functions of C or C#.

The kernels are written in a small part of Python: numbers, rows of one array, loops over ranges, conditions and calls
of each other. ``Translation`` reads their source and writes each function that is called, once for every set of
arguments that are known integers: those, the constants of the modules and what follows from them are put in, and
branches that cannot be taken are left out. What it does not know it refuses. So there is one source of the equations,
and an effect that somebody adds to the library is in the written code as well.
"""

from __future__ import annotations

import ast
import inspect
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NoReturn

import numpy as np

from suspension_twin.addons.export.standalone.languages import Language
from suspension_twin.errors import WorkError
from suspension_twin.models import rows

__all__ = ["Translation"]

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
    ast.Mult: lambda a, b: a * b,
    ast.FloorDiv: lambda a, b: a // b,
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.BitAnd: lambda a, b: a & b,
    ast.BitOr: lambda a, b: a | b,
    ast.Lt: lambda a, b: a < b,
    ast.LtE: lambda a, b: a <= b,
    ast.Gt: lambda a, b: a > b,
    ast.GtE: lambda a, b: a >= b,
    ast.Eq: lambda a, b: a == b,
    ast.NotEq: lambda a, b: a != b,
}
_SYMBOL = re.compile(r"[A-Z][A-Z0-9_]*")


@dataclass(frozen=True)
class _Value:
    """An expression: its text, what it is, how tightly it binds, and its value where that is known."""

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
    language
        The language.
    """

    def __init__(self, language: Language) -> None:
        self.language = language
        self._known: dict[object, _Function] = {}
        self._names: dict[str, int] = {}
        self._texts: list[str] = []
        self._symbols: dict[str, int] = {}

    @property
    def text(self) -> str:
        """Everything written so far: named rows, helpers, and functions after those that they call."""
        symbols = sorted(self._symbols.items(), key=lambda item: (item[1], item[0]))
        parts = [self.language.constants(symbols), self.language.helpers, *self._texts]
        return "\n".join(parts)

    def add(self, function: Any, **known: int) -> str:
        """Write a function and what it calls; returns its name. ``known`` are arguments with values to put in."""
        python = getattr(function, "py_func", function)
        arguments = [
            _Value(
                str(known.get(name, name)),
                "int" if kind == "int" else "double",
                known=known.get(name),
                shape=() if kind == "Floats" else None,
            )
            for name, kind in _annotated(python)
        ]
        return self.function(python, arguments).name

    def function(self, python: Any, arguments: Sequence[_Value]) -> _Function:
        """The written function for a call with such arguments."""
        put_in = tuple(_put_in(value) for value in arguments)
        shapes = tuple(value.shape for value in arguments)
        key = (python.__code__, id(python.__globals__), put_in, shapes)
        if key not in self._known:
            # an entry that keeps the globals alive, so that their id stays theirs
            writer = _Writer(self, python, arguments)
            self._known[key] = _Function(self.name(python), writer.results)
            self._texts.append(writer.write(self._known[key].name))
            self._alive = [*getattr(self, "_alive", []), python]
        return self._known[key]

    def name(self, python: Any) -> str:
        """A name for a function that no other has."""
        stem = python.__module__.rpartition(".")[2] if isinstance(python.__module__, str) else ""
        own = python.__name__.strip("_")
        own = f"{stem}_{own}" if python.__name__.startswith("_") and stem else own
        count = self._names[own] = self._names.get(own, 0) + 1
        return own if count == 1 else f"{own}_{count}"

    def symbol(self, name: str, value: int) -> str:
        """A constant by its name, or by its value where the name means another one."""
        if _SYMBOL.fullmatch(name) and self._symbols.setdefault(name, value) == value:
            return name
        return str(value)


def _tree(python: Any) -> ast.FunctionDef:
    """The source of a function."""
    found = ast.parse(textwrap.dedent(inspect.getsource(python))).body[0]
    assert isinstance(found, ast.FunctionDef)
    return found


def _annotated(python: Any) -> list[tuple[str, str]]:
    """Arguments of a function with the words of their types."""
    return [(node.arg, ast.unparse(node.annotation or ast.Name("float"))) for node in _tree(python).args.args]


def _put_in(value: _Value) -> tuple[str, int] | None:
    """A known integer, with the text that stands for it."""
    return (value.text, int(value.known)) if value.kind == "int" and value.known is not None else None


class _Writer:
    """Writes one function for one set of arguments."""

    def __init__(self, program: Translation, python: Any, arguments: Sequence[_Value]) -> None:
        self.program, self.language, self.python = program, program.language, python
        self.tree = _tree(python)
        closure = inspect.getclosurevars(python).nonlocals
        self.scope = {**python.__globals__, **closure}
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
        returns = self.tree.returns
        if returns is None or (isinstance(returns, ast.Constant) and returns.value is None):
            return 0
        if isinstance(returns, ast.Subscript):  # tuple[float, ...]
            assert isinstance(returns.slice, ast.Tuple)
            return len(returns.slice.elts)
        return -1

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
        signature += [self.language.out.format(f"r{k}_") for k in range(max(self.results, 0))]
        return ", ".join(signature) or ("void" if self.language.put.startswith("*") else "")

    def write(self, name: str) -> str:
        body = self.tree.body
        comment = ""
        if isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
            first = str(body[0].value.value).partition("\n\n")[0]
            comment = "/* " + " ".join(first.split()).replace("``", "").replace("*/", "") + " */\n"
            body = body[1:]
        self.statements(body)
        kind = "double" if self.results < 0 else "void"
        locals_ = self._declarations()
        head = f"{comment}{self.language.function} {kind} {name}({self.signature})"
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
            "bool": (self.language.boolean, self.language.truth[0]),
        }[value.kind]
        self.locals[text] = kind, f"{text} = {start}"
        return found

    def temporary(self, value: _Value) -> _Value:
        self.temporaries += 1
        return self.local(f"t{self.temporaries}_", value)

    def array(self, name: str, kind: Kind, shape: tuple[int, ...]) -> _Value:
        text = self._named(name)
        self.locals[text] = "", self.language.local.format(kind, text, math.prod(shape))
        found = self.variables[name] = _Value(text, kind, shape=shape)
        return found

    def resolve(self, node: ast.expr) -> Any:
        """The object of Python that a name or an attribute means."""
        if isinstance(node, ast.Name) and node.id in self.scope:
            return self.scope[node.id]
        if isinstance(node, ast.Name):
            return {"abs": abs, "max": max, "min": min, "range": range, "float": float, "int": int}.get(
                node.id
            )
        if isinstance(node, ast.Attribute):
            return getattr(self.resolve(node.value), node.attr, None)
        return None

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
            method = getattr(self, f"_{type(node).__name__.lower()}", None)
            if method is None:
                self.refuse(node, type(node).__name__)
            method(node)

    def _pass(self, node: ast.Pass) -> None:
        pass

    def _expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Call):
            self.refuse(node, "an expression without an effect")
        self.call(node.value, as_statement=True)

    def _return(self, node: ast.Return) -> None:
        if self.results < 0:
            assert node.value is not None
            self.line(f"return {self.number(node.value).text};")
            return
        assert isinstance(node.value, ast.Tuple)
        for k, value in enumerate([self.number(item) for item in node.value.elts]):
            self.line(f"{self.language.put.format(f'r{k}_')} = {value.text};")
        if node is not self.tree.body[-1]:
            self.line("return;")

    def _break(self, node: ast.Break) -> None:
        if self.breaks[-1]:
            self.line(f"{self.breaks[-1]} = {self.language.truth[1]};")
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

    def _for(self, node: ast.For) -> None:
        if not (isinstance(node.iter, ast.Call) and self.resolve(node.iter.func) is range):
            self.refuse(node, "a loop over what is no range")
        assert isinstance(node.target, ast.Name)
        bounds = [self.expression(argument) for argument in node.iter.args]
        begin = bounds[0] if len(bounds) > 1 else _Value("0", "int", known=0)
        end = bounds[1] if len(bounds) > 1 else bounds[0]
        step = bounds[2].known if len(bounds) > 2 else 1
        if begin.known is not None and end.known == begin.known + 1 and not node.orelse and step == 1:
            self.variables[node.target.id] = replace(begin)  # once: such as over the lanes of a block of one
            self.statements(node.body)
            del self.variables[node.target.id]
            return
        self.variables.pop(node.target.id, None)
        index = self.local(node.target.id, _Value("", "int")).text
        flag = ""
        if node.orelse:
            flag = self.temporary(_Value("", "bool")).text
            self.line(f"{flag} = {self.language.truth[0]};")
        self.breaks.append(flag)
        towards, move = ("<", f"{index}++") if step == 1 else (">", f"{index}--")
        if step not in (1, -1):
            self.refuse(node, "a loop with such a step")
        with self.block(f"for ({index} = {begin.text}; {index} {towards} {end.text}; {move})"):
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
        found = self.temporary(value)
        self.line(f"{found.text} = {value.text};")
        return found

    def _annassign(self, node: ast.AnnAssign) -> None:
        assert node.value is not None
        self._single(node.target, node.value)

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
        count = 0
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Name) and node.id == name and isinstance(node.ctx, ast.Store):
                count += 1
        return count == 1

    @contextmanager
    def _each(self, array: _Value) -> Iterator[str]:
        """A loop over the elements of an array."""
        assert array.shape is not None
        index = self.local("n_", _Value("", "int")).text
        with self.block(f"for ({index} = 0; {index} < {math.prod(array.shape)}; {index}++)"):
            yield index

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
        self.variables.pop(loop.target.id, None)
        index = self.local(loop.target.id, _Value("", "int")).text
        with self.block(f"for ({index} = 0; {index} < {count}; {index}++)"):
            self.line(f"{array.text}[{index}] = {self.number(node.elt).text};")

    def _take(self, targets: Sequence[ast.expr], node: ast.Call) -> None:
        """Several names from a call that returns several numbers."""
        names = [target.id for target in targets if isinstance(target, ast.Name)]
        into = (
            [self.local(name, _Value("", "double")) for name in names] if len(names) == len(targets) else []
        )
        results = self.results_of(node, into)
        if len(results) != len(targets):
            self.refuse(node, "a call that returns another number of values")
        if into:
            return
        for target, value in zip(targets, results, strict=True):
            self.store(target, value)

    def _augassign(self, node: ast.AugAssign) -> None:
        operator, _ = _OPERATORS[type(node.op)]
        if isinstance(node.target, ast.Name) and (array := self.variables.get(node.target.id)) is not None:
            if array.shape is not None:
                with self._each(array) as index:
                    value = self._elementwise(node.value, index)
                    self.line(f"{array.text}[{index}] {operator}= {value.text};")
                return
            if array.known is not None:
                self.refuse(node, "a change of a known number")
        value = self.expression(node.value)
        self.line(f"{self.expression(node.target).text} {operator}= {value.text};")

    def _elementwise(self, node: ast.expr, index: str) -> _Value:
        """An expression in which whole arrays stand for their element ``index``."""
        before = dict(self.variables)
        for name, value in before.items():
            if value.shape is not None:
                self.variables[name] = _Value(f"{value.text}[{index}]", value.kind)
        try:
            return self.number(node)
        finally:
            self.variables = before | {k: v for k, v in self.variables.items() if k not in before}

    # -- expressions

    def number(self, node: ast.expr) -> _Value:
        """An expression as a number with a point."""
        value = self.expression(node)
        if value.kind == "int" and value.known is not None:
            return _Value(_literal(float(value.known)), "double", known=float(value.known))
        return value

    def expression(self, node: ast.expr) -> _Value:
        method = getattr(self, f"_of_{type(node).__name__.lower()}", None)
        if method is None:
            self.refuse(node, type(node).__name__)
        found: _Value = method(node)
        return found

    def _of_constant(self, node: ast.Constant) -> _Value:
        return self.literal(node, node.value)

    def literal(self, node: ast.AST, value: Any) -> _Value:
        if isinstance(value, bool):
            return _Value(self.language.truth[value], "bool", known=value)
        if isinstance(value, int):
            return _Value(str(value), "int", _TIGHT if value >= 0 else _UNARY_BINDS, known=value)
        if isinstance(value, float):
            return _Value(_literal(value), "double", _TIGHT if value >= 0 else _UNARY_BINDS, known=value)
        self.refuse(node, f"a {type(value).__name__}")

    def _of_name(self, node: ast.Name) -> _Value:
        if node.id in self.variables:
            return self.variables[node.id]
        return self._global(node, node.id, self.resolve(node))

    def _of_attribute(self, node: ast.Attribute) -> _Value:
        return self._global(node, node.attr, self.resolve(node))

    def _global(self, node: ast.AST, name: str, value: Any) -> _Value:
        found = self.literal(node, value)
        if found.kind == "int" and name != "WIDTH":
            return replace(found, text=self.program.symbol(name, int(value)))
        return _Value("1", "int", known=1) if name == "WIDTH" else found

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

    def joined(self, operator: type[ast.AST], left: _Value, right: _Value) -> _Value:
        """Two expressions with an operator between them; a factor of 1 and a summand of 0 are left away."""
        both_int = left.kind == "int" and right.kind == "int"
        if both_int and operator is ast.Mult and "1" in (left.text, right.text):
            return left if right.text == "1" else right
        if both_int and operator is ast.Add and "0" in (left.text, right.text):
            return left if right.text == "0" else right
        symbol, binds = _OPERATORS[operator]
        if operator in (ast.BitAnd, ast.BitOr):  # compilers warn of a comparison beside it
            left, right = (_Value(_within(side, 10), side.kind, known=side.known) for side in (left, right))
        kind: Kind = left.kind if left.kind == right.kind else "double"
        if operator is ast.Div:
            kind = "double"
            left, right = (_floating(side) for side in (left, right))
        known = None
        if both_int and left.known is not None and right.known is not None and operator in _PYTHON:
            known = _PYTHON[operator](left.known, right.known)
            if (left.text.isdigit() and right.text.isdigit()) or operator in (ast.BitAnd, ast.BitOr):
                return _Value(str(known), "int", known=known)
        return _Value(f"{_within(left, binds)} {symbol} {_within(right, binds + 1)}", kind, binds, known)

    def _of_compare(self, node: ast.Compare) -> _Value:
        terms = [self.expression(item) for item in (node.left, *node.comparators)]
        parts = []
        for operator, left, right in zip(node.ops, terms, terms[1:], strict=False):
            if type(operator) not in _OPERATORS:
                self.refuse(node, "a comparison")
            if left.known is not None and right.known is not None:
                parts.append(self.literal(node, bool(_PYTHON[type(operator)](left.known, right.known))))
                continue
            symbol, binds = _OPERATORS[type(operator)]
            parts.append(
                _Value(f"{_within(left, binds + 1)} {symbol} {_within(right, binds + 1)}", "bool", binds)
            )
        return self.all_of(ast.And, parts)

    def _of_boolop(self, node: ast.BoolOp) -> _Value:
        return self.all_of(type(node.op), [self.expression(item) for item in node.values])

    def all_of(self, operator: type[ast.AST], parts: Sequence[_Value]) -> _Value:
        ends = operator is ast.Or  # the known value that decides
        if any(part.known is not None and bool(part.known) is ends for part in parts):
            return _Value(self.language.truth[ends], "bool", known=ends)
        parts = [part for part in parts if part.known is None]
        if not parts:
            return _Value(self.language.truth[not ends], "bool", known=not ends)
        if len(parts) == 1:
            return parts[0]
        symbol, binds = _OPERATORS[operator]
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

    def _of_call(self, node: ast.Call) -> _Value:
        return self.call(node)

    def call(self, node: ast.Call, as_statement: bool = False) -> _Value:
        function = self.resolve(node.func)
        if function is float:
            return self.number(node.args[0])
        if function is int:
            return _Value(f"(int){_within(self.number(node.args[0]), _TIGHT)}", "int", _UNARY_BINDS)
        if function is rows.fma:
            return self._helper("fma_", node)
        if function in (max, min):
            return self._helper("larger" if function is max else "smaller", node)
        name = getattr(function, "__name__", "")
        if function is abs or function is getattr(math, name, None):
            if name not in self.language.mathematics:
                self.refuse(node, f"{name}()")
            return self._helper(self.language.mathematics[name], node)
        python = getattr(function, "py_func", function)
        if not inspect.isfunction(python):
            self.refuse(node, f"a call of {ast.unparse(node.func)}")
        written, arguments = self._called(node, python)
        if as_statement:
            if written.results:
                self.refuse(node, "a call whose result is not used")
            self.line(f"{written.name}({', '.join(arguments)});")
            return _Value("", "double")
        if written.results != -1:
            self.refuse(node, "a call that returns several numbers, or none, in an expression")
        return _Value(f"{written.name}({', '.join(arguments)})", "double")

    def _helper(self, name: str, node: ast.Call) -> _Value:
        values = [self.number(argument) for argument in node.args]
        return _Value(f"{name}({', '.join(value.text for value in values)})", "double")

    def _called(self, node: ast.Call, python: Any) -> tuple[_Function, list[str]]:
        values = []
        for argument, (_, kind) in zip(node.args, _annotated(python), strict=True):
            values.append(self.number(argument) if kind == "float" else self.expression(argument))
        written = self.program.function(python, values)
        return written, [value.text for value in values if _put_in(value) is None]

    def results_of(self, node: ast.Call, into: Sequence[_Value] = ()) -> list[_Value]:
        """Variables with the numbers that a call returns: these, or new ones."""
        python = getattr(self.resolve(node.func), "py_func", self.resolve(node.func))
        if not inspect.isfunction(python):
            self.refuse(node, f"a call of {ast.unparse(node.func)}")
        written, arguments = self._called(node, python)
        results = list(into) or [self.temporary(_Value("", "double")) for _ in range(written.results)]
        arguments += [self.language.hand.format(result.text) for result in results]
        self.line(f"{written.name}({', '.join(arguments)});")
        return results


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
