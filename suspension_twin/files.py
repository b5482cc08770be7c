# SPDX-License-Identifier: Apache-2.0
"""Files: YAML read with errors that name the file, and every file written whole or not at all."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from suspension_twin.errors import InputError, WorkError

__all__ = ["check_writable", "parse_yaml", "read_yaml", "replacing", "write_text"]


class _Loader(yaml.SafeLoader):
    """A date stays the text it is, so that ``start: 2024-05-01T12:00:00Z`` needs no quotes."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in pairs if tag != "tag:yaml.org,2002:timestamp"]
    for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parse_yaml(text: str, source: str | os.PathLike[str]) -> Any:
    """What a text in YAML holds; raises InputError that names ``source`` and the line."""
    try:
        return yaml.load(text, _Loader)  # a safe loader
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise InputError(source, f"not YAML{where}: {getattr(error, 'problem', None) or error}") from None
    except (RecursionError, ValueError):  # brackets without end
        raise InputError(source, "not YAML that can be read") from None


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """What a YAML file holds; raises InputError that names the file."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(path, error.strerror or "cannot be read") from None
    except UnicodeDecodeError:
        raise InputError(path, "not a text file") from None
    return parse_yaml(text, path)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file in the folder of ``path`` that takes its place if the block ends well.

    Missing folders are made. Raises WorkError where it cannot be written, such as on a full disk; then whatever
    ``path`` held is still there.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())  # some disks say only now that they are full
        temporary.replace(path)
    except OSError as error:
        raise WorkError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        if temporary.parent.is_dir():
            temporary.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file by :func:`replacing`."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise InputError if nothing can be made at ``path``, WorkError if the disk is full. Leaves nothing behind."""
    folder = Path(path).absolute().parent
    while not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        kind = WorkError if error.errno == errno.ENOSPC else InputError
        raise kind(f"{path}: cannot be written: {error.strerror or error}") from None
