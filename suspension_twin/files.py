# SPDX-License-Identifier: Apache-2.0
"""Files: one way to open them, one boundary around their readers, YAML and JSON within limits, and every file written
whole or not at all."""

from __future__ import annotations

import errno
import io
import itertools
import json
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Any, BinaryIO, Final, ParamSpec, TextIO, TypeVar

import yaml

try:  # ten times as fast, with a limit to nesting
    from yaml import CSafeLoader as SafeLoader
except ImportError:  # PyYAML was built without libyaml
    from yaml import SafeLoader  # type: ignore[assignment]

from suspension_twin.errors import InputError, SuspensionTwinError, WorkError, printable, shown

__all__ = [
    "NO_SPACE",
    "Folders",
    "Json",
    "check_writable",
    "comment_lines",
    "explained",
    "for_peers",
    "open_file",
    "open_text",
    "parse_json",
    "parse_yaml",
    "read_bytes",
    "read_json",
    "read_text",
    "read_yaml",
    "reader",
    "reading",
    "remove_leftovers",
    "replacing",
    "synchronise",
    "temporary_beside",
    "together",
    "unused",
    "write_text",
    "writing",
]

#: An object of JSON: a document, or a part of one.
Json = dict[str, Any]

#: A disk or quota that is full: the input was usable, so the work failed.
NO_SPACE: Final = (errno.ENOSPC, errno.EDQUOT)


# Errors of the operating system about a path that the user named.
_PATH_ERRORS: Final = (
    FileNotFoundError,
    PermissionError,
    IsADirectoryError,
    NotADirectoryError,
    FileExistsError,
)


def explained(error: Exception) -> tuple[int, str]:
    """Exit status and one line for an error that ended a piece of work."""
    if isinstance(error, SuspensionTwinError):
        return error.exit_status, str(error)
    if isinstance(error, OSError) and error.filename is not None:
        status = InputError.exit_status if isinstance(error, _PATH_ERRORS) else WorkError.exit_status
        return status, f"{os.fsdecode(error.filename)}: {error.strerror}"
    if isinstance(error, OSError) and error.errno in NO_SPACE:
        return WorkError.exit_status, "no space left to write the results"
    if isinstance(error, MemoryError):
        return WorkError.exit_status, "out of memory"
    cause = f"{type(error).__name__}: {error}".rstrip(": ")
    return WorkError.exit_status, f"unexpected error, {cause} (--debug shows where)"


@contextmanager
def reading(source: str | os.PathLike[str], kind: str) -> Iterator[None]:
    """The boundary around a reader: whatever a parser raises becomes one line about ``source``.

    Parsers of other people raise anything on bytes that they were not made for. Errors of this package pass; a full
    disk (of temporary files) is a WorkError; everything else is an InputError: ``source`` is not
    ``kind`` ("a recording"), with the cause kept for ``--debug``. Numbers that are too large become infinite without a
    warning of NumPy: a value that is not finite is missing.
    """
    import numpy as np

    try:
        with np.errstate(all="ignore"):
            yield
    except InputError as error:
        error.place = error.place or ""
        raise
    except SuspensionTwinError:
        raise
    except OSError as error:
        if error.errno in NO_SPACE:
            raise WorkError(f"{os.fspath(source)}: no space left for temporary files") from error
        wrong = InputError(source, error.strerror or _damaged(kind, error))  # h5py's have no number
        wrong.place = error.strerror or ""
        raise wrong from error
    except MemoryError as error:
        raise InputError(source, f"is not {kind} that fits into memory: damaged, or too large") from error
    except RecursionError as error:
        raise InputError(source, f"is not {kind} that can be read: nested too deep") from error
    except Exception as error:
        raise InputError(source, _damaged(kind, error)) from error


P = ParamSpec("P")
Read = TypeVar("Read")


def reader(kind: str) -> Callable[[Callable[P, Read]], Callable[P, Read]]:
    """Decorate a public reader, whose first argument names its source, with the boundary of :func:`reading`."""

    def decorate(read: Callable[P, Read]) -> Callable[P, Read]:
        @wraps(read)
        def within(*args: P.args, **kwargs: P.kwargs) -> Read:
            source = args[0] if args else next(iter(kwargs.values()), kind)
            with reading(str(source), kind):
                return read(*args, **kwargs)

        return within

    return decorate


def _damaged(kind: str, error: Exception) -> str:
    if isinstance(error, KeyError) and error.args and isinstance(error.args[0], str):
        return f"is not {kind} that can be read: {shown(error.args[0])} is missing"
    return f"is not {kind} that can be read: cut off or damaged ({type(error).__name__})"


#: A pipe without a writer would hold up whoever opens it; a terminal would become that of this process.
_FLAGS: Final = os.O_RDONLY | sum(
    getattr(os, f"O_{n}", 0) for n in ("NONBLOCK", "NOCTTY", "CLOEXEC", "BINARY")
)


def open_file(path: str | os.PathLike[str]) -> BinaryIO:
    """A regular file, open to be read. The one way in which this package opens a path that somebody gave.

    Raises OSError, and InputError for a folder, a device, a pipe or a socket: it is looked at before it is opened, as
    opening a device may do something, and once more after, as it may have been replaced.
    """
    _check_regular(path, os.stat(path))
    descriptor = os.open(path, _FLAGS)
    try:
        _check_regular(path, os.fstat(descriptor))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def _check_regular(path: str | os.PathLike[str], status: os.stat_result) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise InputError(path, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(status.st_mode):
        raise InputError(path, "is not a regular file")


def open_text(path: str | os.PathLike[str]) -> TextIO:
    """As :func:`open_file`, for text in UTF-8, to be read line by line."""
    return io.TextIOWrapper(open_file(path), encoding="utf-8-sig")


def read_bytes(path: str | os.PathLike[str], most: int) -> bytes:
    """Content of a regular file of at most ``most`` bytes; InputError for a larger one, a device or a pipe."""
    with reading(path, "a file"), open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise InputError(path, f"is larger than {_size(most)}")
        return file.read(size)


#: Bytes of a text that a person wrote or of a document of ours: a twin file has 2 kB, an evidence folder 2 MB.
_LARGEST_TEXT: Final = 64 << 20


def read_text(path: str | os.PathLike[str], most: int = _LARGEST_TEXT) -> str:
    """Content of a text file in UTF-8 of at most ``most`` bytes; InputError where it is none."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "not a text file") from None


def parse_json(text: str | bytes, source: str | os.PathLike[str]) -> Any:
    """Contents of a text in JSON; InputError that names ``source`` where it is none or holds a number that is none."""

    def refuse(word: str) -> None:
        raise InputError(source, f"holds {word}, which is no number of JSON")

    try:
        return json.loads(text, parse_constant=refuse)
    except json.JSONDecodeError as error:
        raise InputError(source, f"not JSON, line {error.lineno}: {error.msg}") from None
    except (
        ValueError,
        RecursionError,
    ):  # a number of too many digits, bytes that are no text, brackets without end
        raise InputError(source, "not JSON that can be read") from None


def read_json(path: str | os.PathLike[str], most: int = _LARGEST_TEXT) -> Any:
    """Contents of a JSON file; InputError that names the file."""
    return parse_json(read_text(path, most), path)


def _size(count: int) -> str:
    return f"{count >> 20} MiB" if count >= 1 << 20 else f"{count >> 10} KiB"


# YAML. A twin file has 2 kB, the details of a calibration 20 kB.

_LARGEST: Final = 1 << 20  # bytes
_MOST_VALUES: Final = 100_000  # aliases written out
_DIGITS: Final = 64  # of a number: the time to read one grows with the square of it


class _Loader(SafeLoader):
    """A date stays the text it is, so that ``start: 2024-05-01T12:00:00Z`` needs no quotes."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        number = node.tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
        if number and isinstance(node, yaml.ScalarNode) and len(node.value) > _DIGITS:
            raise yaml.constructor.ConstructorError(
                None, None, "a number of too many digits", node.start_mark
            )
        return super().construct_object(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in pairs if tag != "tag:yaml.org,2002:timestamp"]
    for first, pairs in SafeLoader.yaml_implicit_resolvers.items()
}


def parse_yaml(text: str, source: str | os.PathLike[str]) -> Any:
    """Contents of a text in YAML; raises InputError that names ``source`` and the line.

    A text larger than 1 MiB, an alias that refers to the node it stands in, and aliases that make more than 100 000
    values are refused before anything is made of them.
    """
    if len(text) > _LARGEST:
        raise InputError(source, f"is larger than {_size(_LARGEST)}: no such file is")
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            count = _values(node)
            if count is None:
                raise InputError(source, "an alias refers to what it stands in")
            if count > _MOST_VALUES:
                raise InputError(
                    source, f"holds more than {_MOST_VALUES} values with its aliases written out"
                )
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        wrong = InputError(source, f"not YAML{where}: {getattr(error, 'problem', None) or error}")
        wrong.place = f"not YAML{where}"
        raise wrong from None
    except (
        RecursionError,
        ValueError,
        OverflowError,
        TypeError,
    ):  # brackets without end, a key that is a list
        raise InputError(source, "not YAML that can be read") from None


def _values(root: yaml.Node) -> int | None:
    """How many values a document has with its aliases written out; None if one of them holds itself.

    Each node is counted once: the time grows with the text, not with the values that it unfolds to.
    """
    counts: dict[yaml.Node, int] = {}
    above: set[yaml.Node] = set()
    stack: list[tuple[yaml.Node, bool]] = [(root, False)]
    while stack:
        node, done = stack.pop()
        parts: list[yaml.Node] = node.value if isinstance(node, yaml.SequenceNode) else []
        if isinstance(node, yaml.MappingNode):
            parts = [part for pair in node.value for part in pair]
        if done:
            above.discard(node)
            counts[node] = min(1 + sum(counts[part] for part in parts), _MOST_VALUES + 1)
        elif node in above:
            return None
        elif node not in counts:
            above.add(node)
            stack += [(node, True), *((part, False) for part in parts)]
    return counts[root]


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """Contents of a YAML file; raises InputError that names the file."""
    return parse_yaml(read_text(path, _LARGEST).replace("\r\n", "\n"), path)


# Writing

_COUNT = itertools.count()
_STAGED: ContextVar[list[tuple[Path, Path]] | None] = ContextVar("staged", default=None)


@contextmanager
def together() -> Iterator[None]:
    """Files written within take their places only when the block ends well: all of them, or none.

    A power cut between two renames can still leave some new and some old; each is whole.
    """
    if _STAGED.get() is not None:  # part of a larger set
        yield
        return
    staged: list[tuple[Path, Path]] = []
    token = _STAGED.set(staged)
    try:
        yield
        while staged:
            temporary, path = staged[0]
            with writing(path):
                _put(temporary, path)
            staged.pop(0)
    finally:
        _STAGED.reset(token)
        for temporary, _ in staged:
            _remove(temporary)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file in the folder of ``path`` that takes its place if the block ends well.

    Missing folders are made. Raises WorkError where it cannot be written, such as on a full disk; then the old
    content of ``path`` is still there, and nothing else. The new one is on the disk when the block ends. Leftovers of a
    process that was killed while it wrote this file are removed.
    """
    path = Path(path)
    temporary = temporary_beside(path)
    staged = _STAGED.get()
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(path)
            yield temporary
            synchronise(temporary)  # some disks say only now that they are full
            if staged is None:
                _put(temporary, path)
        if staged is not None:
            staged.append((temporary, path))
    except BaseException:
        _remove(temporary)
        raise


def temporary_beside(path: Path) -> Path:
    """A name beside ``path`` that no other process and no other thread writes to; the ending stays."""
    return path.with_name(f".{path.stem}.{os.getpid()}.{next(_COUNT)}.part{path.suffix}")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """The boundary around a writer: an error of the operating system becomes a WorkError about ``path``."""
    try:
        yield
    except OSError as error:
        raise WorkError(f"{path}: cannot be written: {error.strerror or error}") from error


def _put(temporary: Path, path: Path) -> None:
    temporary.replace(path)
    with suppress(OSError):  # a folder cannot be synchronised everywhere
        synchronise(path.parent)


def synchronise(path: Path) -> None:
    """Return when the content of a file, or the names in a folder, are on the disk; OSError where it is full."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def _remove(temporary: Path) -> None:
    with suppress(OSError, ValueError):
        temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove the files and folders that processes that are no more left of writing ``path``."""
    own = re.compile(rf"\.{re.escape(path.stem)}\.(\d+)\.\d+\.part{re.escape(path.suffix)}")
    for entry in os.scandir(path.parent):
        found = own.fullmatch(entry.name)
        if found and not _runs(int(found[1])):
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            else:
                _remove(Path(entry.path))


def _runs(process: int) -> bool:
    if os.name != "posix":  # elsewhere the question ends the process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file by :func:`replacing`; bytes of file names that are no text are written as escapes."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def comment_lines(*lines: str) -> str:
    """Lines of a comment in YAML, CSV and the like, ``# `` before each; no text in them begins a line of its own."""
    return "".join(f"# {printable(line)}\n" for line in lines)


def unused(path: Path) -> Path:
    """``path``, or where it is taken the first of ``path_2``, ``path_3`` that is not."""
    numbered = (path.with_name(f"{path.stem}_{k}{path.suffix}") for k in itertools.count(2))
    return next(free for free in itertools.chain([path], numbered) if not free.exists())


class Folders:
    """The folders, named by who started a node, in which others may have it read and write files."""

    def __init__(self, folders: Iterable[str | os.PathLike[str]]) -> None:
        self._places = [Path(folder).expanduser().resolve() for folder in folders]

    def check(self, path: str | os.PathLike[str], ending: str = "") -> None:
        """Raise InputError for a path that leads out of the folders, links followed, or has another ending."""
        place = Path(path).resolve()
        if not any(place.is_relative_to(folder) for folder in self._places):
            raise InputError(path, "lies in none of the folders that the parameter folders names")
        if ending and place.suffix != ending:
            raise InputError(path, f"must end in {ending}")


@contextmanager
def for_peers(log: Callable[[str], object]) -> Iterator[None]:
    """The boundary around what others ask a node to read.

    They get the place of a fault in a file, and ``log`` the whole line. Errors about what they asked for pass.
    """
    try:
        yield
    except InputError as error:
        if error.place is None:
            raise
        log(str(error))
        place = f" ({error.place})" if error.place else ""
        raise InputError(error.source, f"cannot be used{place}: the log of the node says why") from error


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise InputError if nothing can be made at ``path``, WorkError if the disk is full. Leaves nothing behind.

    Every name that has to be made, of missing folders too, is tried with the affixes that it has while it is written.
    """
    target = Path(path).absolute()
    trial = target
    try:
        missing = [target.name]
        folder = target.parent
        while not folder.exists():
            missing.append(folder.name)
            folder = folder.parent
        for name in missing:
            trial = temporary_beside(folder / name)
            trial.write_bytes(b"0")
            trial.unlink()
    except (OSError, ValueError) as error:  # ValueError: a zero byte in a name
        if trial is not target:
            _remove(trial)
        kind = WorkError if getattr(error, "errno", None) in NO_SPACE else InputError
        why = getattr(error, "strerror", None) or str(error)
        raise kind(f"{os.fspath(path)}: cannot be written: {why}") from None
