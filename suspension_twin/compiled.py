# SPDX-License-Identifier: Apache-2.0
"""How every kernel of this package is compiled, and when machine code on disk still counts.

No fast-math; a division by zero gives infinity or NaN, which the caller deals with, instead of
raising from the middle of a loop. Code is kept on disk, so that a second start compiles nothing.
Numba drops it when the one file that holds the function has changed and would go on with stale
helpers from other files; here it counts as long as that file *and* every file of the package that it
imports, however far down, have the same contents. A file that was only touched or copied compiles nothing.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar

from numba import njit

__all__ = ["compiled", "inlined", "linked", "sources", "specialised"]

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function, modules: Iterable[str] = ()) -> Function:
    """Compile on first call, without the GIL, and keep the machine code on disk.

    ``modules`` are names of loaded modules, beside those imported by the function's own, that the code is made of.
    Where no folder can be written at all (no home, read-only installation) every process compiles
    anew instead of failing.
    """
    try:
        out: Any = njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # numba: "no locator available"
        out = njit(nogil=True, error_model="numpy")(function)
    file = getattr(getattr(out, "_cache", None), "_cache_file", None)
    if file is not None and hasattr(file, "_source_stamp"):
        file._source_stamp = _stamp(function.__module__, modules)
    return out  # type: ignore[no-any-return]


def specialised(function: Any, name: str, **constants: Any) -> Any:
    """A copy of ``function`` called ``name`` in which some globals of its module are ``constants``: numbers that the
    compiler takes as such, or compiled functions. To be compiled by one of the functions here."""
    out = FunctionType(function.__code__, function.__globals__ | constants, name)
    out.__qualname__, out.__module__ = name, function.__module__
    return out


def linked(function: Function) -> Function:
    """A function that is made in a process, compiled once there and linked to its callers; they are what is kept."""
    out: Any = njit(nogil=True, error_model="numpy")(function)
    return out  # type: ignore[no-any-return]


def inlined(function: Function) -> Function:
    """A helper that disappears into its caller, so that the loop around it vectorises.

    The inlining is LLVM's: that of numba types the helper anew at every call, which takes twice as long.
    """
    out: Any = njit(forceinline=True, error_model="numpy")(function)
    return out  # type: ignore[no-any-return]


def _stamp(module: str, modules: Iterable[str] = ()) -> tuple[str, str]:
    """What has to be the same for machine code of a module's functions to count."""
    package, _, below = module.partition(".")
    loaded = sys.modules.get(package)
    if not below or loaded is None or not loaded.__file__:
        return "no package", ""
    root = Path(loaded.__file__).parent
    file = root.joinpath(*below.split(".")).with_suffix(".py")
    if not file.is_file():
        return "no file", ""
    digest = hashlib.blake2b(digest_size=16)
    for start in (file, *(Path(str(sys.modules[name].__file__)) for name in modules)):
        for source in sources(start, root):
            place = source.relative_to(root) if source.is_relative_to(root) else source.name
            digest.update(f"{place}\0".encode() + _digest(source))
    return "contents", digest.hexdigest()


@cache
def _digest(file: Path) -> bytes:
    return hashlib.blake2b(file.read_bytes(), digest_size=16).digest()


def sources(file: Path, root: Path) -> list[Path]:
    """``file`` and every file of the package in ``root`` that it imports, directly or not, in order."""
    seen: set[Path] = set()
    todo = [file]
    while todo:
        this = todo.pop()
        if this not in seen:
            seen.add(this)
            todo += _imported(this, root)
    return sorted(seen)


@cache
def _imported(file: Path, root: Path) -> tuple[Path, ...]:
    """Files of the package that a file names in its import statements."""
    return tuple(sorted({path for path in _named(file, root) if path.is_file()}))


def _named(file: Path, root: Path) -> Iterator[Path]:
    name = re.escape(root.name)
    text = file.read_text(encoding="utf-8")
    some = rf"from[ \t]+{name}((?:\.\w+)*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)"
    whole = rf"import[ \t]+{name}((?:\.\w+)+)"
    for match in re.finditer(rf"^[ \t]*(?:{some}|{whole})", text, re.MULTILINE):
        below = (match[1] or match[3] or "").strip(".")
        folder = root.joinpath(*below.split(".")) if below else root
        yield folder.with_suffix(".py")
        yield folder / "__init__.py"
        for imported in re.findall(r"\w+", match[2] or ""):
            yield folder / f"{imported}.py"
