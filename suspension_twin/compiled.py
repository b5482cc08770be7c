# SPDX-License-Identifier: Apache-2.0
"""How every kernel of this package is compiled, and where its machine code is kept.

No fast-math; a division by zero gives infinity or NaN, which the caller deals with, instead of
raising from the middle of a loop. Code is kept on disk by numba's own cache, so that a second start
compiles nothing. Numba compares the contents of the one file that holds the function and would go on
with stale helpers from other files; so the cache of a module lies in a folder named by a hash of that
file *and* every file of the package that it imports, however far down.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import TypeVar, cast

import numba
from numba import config, njit

__all__ = ["compiled", "compiled_later", "inlined", "linked", "sources", "specialised"]

Function = TypeVar("Function", bound=Callable[..., object])

#: Machine code of other sources is deleted when it has not been loaded for so long, in s.
_UNUSED = 30 * 86_400.0
#: The folder is a setting of the process: a thread beside would see that of another, or none while numba reads it.
_one_folder = threading.Lock()


class Locator(numba.core.caching.UserProvidedCacheLocator):  # type: ignore[misc]
    """Numba's own, which names a folder after the place of the source as well: a copy or a link would compile anew."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        return ""


def compiled(function: Function, modules: Iterable[str] = ()) -> Function:
    """Compile on first call, without the GIL, and keep the machine code on disk.

    ``modules`` are names of loaded modules, beside those imported by the function's own, that the code is made of.
    Where no folder can be written at all (no home, read-only installation) every process compiles
    anew instead of failing.
    """
    return _kept(function, modules, nogil=True)


def _kept(function: Function, modules: Iterable[str], **options: bool) -> Function:
    """Compile on first call and keep the machine code on disk, where a folder can be written."""
    with _one_folder:
        folder = _cache_folder(function.__module__, tuple(modules))
        given = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
        # numba reads both while it decorates
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = str(folder), f"{__name__}.{Locator.__name__}"
        try:
            return cast(Function, njit(cache=folder is not None, error_model="numpy", **options)(function))
        finally:
            config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = given


def specialised(function: Function, name: str, **constants: object) -> Function:
    """A copy of ``function`` called ``name`` in which some globals of its module are ``constants``: numbers that the
    compiler takes as such, or compiled functions. To be compiled by one of the functions here."""
    source = cast(FunctionType, function)
    out = FunctionType(source.__code__, source.__globals__ | constants, name)
    out.__qualname__, out.__module__ = name, function.__module__
    return cast(Function, out)


def compiled_later(function: Function) -> Function:
    """Mark the source of kernels: it is compiled once :func:`specialised` has given it what each kernel has of its
    own."""
    return function


def linked(function: Function) -> Function:
    """A function made in a process, compiled once there and linked to its callers; their machine code is kept."""
    return cast(Function, njit(nogil=True, error_model="numpy")(function))


def inlined(function: Function, modules: Iterable[str] = ()) -> Function:
    """A helper that disappears into its caller, so that the loop around it vectorises.

    The inlining is LLVM's: that of numba types the helper anew at every call, which takes twice as long. Those of this
    package are kept as kernels are, so that the second kernel that calls them compiles a sixth as long; of another
    package nobody would know when they are stale, as they are made of files of both.
    """
    if function.__module__.partition(".")[0] == __name__.partition(".")[0]:
        return _kept(function, modules, forceinline=True)
    return cast(Function, njit(forceinline=True, error_model="numpy")(function))


@cache
def _cache_folder(module: str, more: tuple[str, ...] = ()) -> Path | None:
    """Folder for the machine code of a module's functions, which ``more`` modules are a part of; None where none can be
    written.

    In ``NUMBA_CACHE_DIR`` if it is set, else in the package's ``__pycache__``, else in the user's cache.
    """
    own, whole = (getattr(sys.modules[m], "__file__", None) for m in (module, module.partition(".")[0]))
    if own is None or whole is None:  # of a notebook
        return None
    root = Path(whole).parent
    digest = hashlib.blake2b(numba.__version__.encode(), digest_size=16)
    for name in (module, *more):
        for file in _files(name, root):
            for source in sources(file, root):
                digest.update(f"{os.path.relpath(source, root)}\0".encode() + _digest(source))
    given = config.CACHE_DIR
    user = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", root.name).expanduser()
    for base in [Path(given)] if given else [root / "__pycache__", user]:
        folder = base / "kernels" / f"{module}.{digest.hexdigest()}"
        try:
            known = folder.is_dir()
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            os.utime(folder)
        except OSError:
            continue
        with suppress(OSError):  # another process may be deleting the same
            for other in () if known else folder.parent.glob(f"{module}.*"):
                if time.time() - other.stat().st_mtime > _UNUSED:
                    shutil.rmtree(other, ignore_errors=True)
        return folder
    return None


def _files(module: str, root: Path) -> list[Path]:
    """The file of a module of the package in ``root``; of another package (a plugin's) every file that it has."""
    top = Path(str(sys.modules[module.partition(".")[0]].__file__))
    if top.parent == root or top.name != "__init__.py":
        return [Path(str(sys.modules[module].__file__))]
    return sorted(top.parent.rglob("*.py"))


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
    name = re.escape(root.name)
    forms = (
        rf"from[ \t]+{name}((?:\.\w+)*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)",
        rf"import[ \t]+{name}((?:\.\w+)+)",
    )
    found: set[Path] = set()
    for match in re.finditer(
        rf"^[ \t]*(?:{'|'.join(forms)})", file.read_text(encoding="utf-8"), re.MULTILINE
    ):
        folder = root.joinpath(*filter(None, (match[1] or match[3] or "").split(".")))
        names = re.findall(r"\w+", match[2] or "")
        found |= {folder.with_suffix(".py"), folder / "__init__.py", *(folder / f"{n}.py" for n in names)}
    return tuple(sorted(path for path in found if path.is_file()))
