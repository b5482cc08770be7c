# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: the states of a piece of work on disk, from which it goes on after an interruption.

A state is one npz of arrays, its plain values in it as JSON text. It is put in place by rename: at any moment the
folder holds one whole state or none. No pickles.

A calibration has one state. A diagnosis is a sequence of rounds; a round is one piece of work on each of some items
(the fit of every effect). The result of a piece is a state of its own, named by the digest of request, twin, data,
code, round and piece. It follows from these alone, so that a piece found on disk has the bits that it would have if it
were done again.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import suspension_twin
from suspension_twin.arrays import Floats
from suspension_twin.compiled import sources
from suspension_twin.errors import InputError
from suspension_twin.files import Json, check_writable, open_file, reading, replacing
from suspension_twin.inference.parallel import no_progress, side_by_side

__all__ = ["STATE", "Checkpoint", "Rounds", "State", "code_digest", "decoded", "encoded", "stored"]

#: Name of the file in the folder.
STATE = "state.npz"
_FORMAT = 3  # version of that file
_INDEX = "index"
#: The files of a state, whole or in the making: what else is in the folder is not touched.
_OWN = re.compile(r"state(-[0-9a-f]+)?\.npz|\..*\.part(\.\w+)?")


@dataclass(frozen=True, eq=False)
class State:
    """A state: the stage's name, its arrays and its plain values."""

    stage: str
    arrays: dict[str, Floats]
    plain: Json


class Checkpoint:
    """Saves and loads the states of one problem, identified by its ``fingerprint``; one of several has a hexadecimal
    ``name``."""

    def __init__(self, folder: Path, fingerprint: str, work: str = "a calibration") -> None:
        self.folder = folder
        self.fingerprint = fingerprint
        check_writable(folder / STATE)
        strange = [p.name for p in folder.iterdir() if not _OWN.fullmatch(p.name)] if folder.is_dir() else []
        if strange:
            raise InputError(folder, f"holds {strange[0]}, which is no state of {work}: name another folder")

    def _file(self, name: str) -> Path:
        return self.folder / (f"state-{name}.npz" if name else STATE)

    def load(self, name: str = "") -> State | None:
        """The last whole state of this very problem, or None: then the search starts anew."""
        path = self._file(name)
        with suppress(InputError), reading(path, "a state"), open_file(path) as file:
            with np.load(file, allow_pickle=False) as stored:
                arrays = {name: np.array(stored[name]) for name in stored.files}
            index = json.loads(str(arrays.pop(_INDEX)))  # a cost may be infinite here
            if index["format"] == _FORMAT and index["fingerprint"] == self.fingerprint:
                return State(str(index["stage"]), arrays, dict(index["plain"]))
        return None

    def save(self, state: State, name: str = "") -> None:
        """Write the state; a process killed within leaves the one before."""
        index = {
            "format": _FORMAT,
            "fingerprint": self.fingerprint,
            "stage": state.stage,
            "plain": state.plain,
        }
        with replacing(self._file(name)) as part, part.open("wb") as stream:
            np.savez(stream, **{**state.arrays, _INDEX: np.array(json.dumps(index))})  # type: ignore[arg-type]

    def remove(self) -> None:
        """Forget all states: the work is done and its result written."""
        shutil.rmtree(self.folder, ignore_errors=True)


Item = TypeVar("Item")
Found = TypeVar("Found")
Record = TypeVar("Record", bound=type)

#: Records that a partial result may consist of, by name.
_RECORDS: dict[str, type] = {}


def stored(record: Record) -> Record:
    """Declare a dataclass as one that partial results consist of."""
    _RECORDS[record.__name__] = record
    return record


@cache
def code_digest(module: Path) -> str:
    """Digest of the code of a module and of all that it imports of this package."""
    root = Path(suspension_twin.__file__).parent
    digest = hashlib.sha256()
    for file in sources(module, root):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def encoded(value: object, arrays: dict[str, Floats]) -> Any:
    """A value as plain JSON; its arrays go into ``arrays``. TypeError for what is no partial result."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, slice):
        return {"slice": [value.start, value.stop]}
    if isinstance(value, list | tuple):
        kind = "list" if isinstance(value, list) else "tuple"
        return {kind: [encoded(one, arrays) for one in value]}
    if isinstance(value, dict):
        return {"dict": [[encoded(k, arrays), encoded(v, arrays)] for k, v in value.items()]}
    if is_dataclass(value) and type(value).__name__ in _RECORDS:
        own = {f.name: encoded(getattr(value, f.name), arrays) for f in fields(value)}
        return {"record": type(value).__name__, "fields": own}
    raise TypeError(f"{type(value).__name__} is no partial result")


def decoded(value: object, arrays: Mapping[str, Floats]) -> Any:
    """The inverse of ``encoded``."""
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    if "slice" in value:
        return slice(*value["slice"])
    if "list" in value:
        return [decoded(one, arrays) for one in value["list"]]
    if "tuple" in value:
        return tuple(decoded(one, arrays) for one in value["tuple"])
    if "dict" in value:
        return {decoded(k, arrays): decoded(v, arrays) for k, v in value["dict"]}
    record = _RECORDS[value["record"]]
    return record(**{name: decoded(own, arrays) for name, own in value["fields"].items()})


@dataclass(frozen=True, eq=False)
class Rounds:
    """The rounds of a diagnosis, kept on disk where there is a ``store``."""

    store: Checkpoint | None = None

    def side_by_side(
        self,
        name: str,
        work: Callable[[Item], Found],
        items: Sequence[Item],
        on_progress: Callable[[float, Item], None] = no_progress,
    ) -> list[Found]:
        """As :func:`~suspension_twin.inference.parallel.side_by_side`, for the round of that ``name``."""
        store = self.store
        if store is None:
            return side_by_side(work, items, on_progress)

        def once(number: int) -> Found:
            part = hashlib.sha256(f"{store.fingerprint} {name} {number}".encode()).hexdigest()[:32]
            known = store.load(part)
            if known is None:
                arrays: dict[str, Floats] = {}
                plain = {"found": encoded(work(items[number]), arrays)}
                store.save(State(name, arrays, plain), part)
                known = store.load(part)
                assert known is not None
            found: Found = decoded(known.plain["found"], known.arrays)
            return found

        return side_by_side(once, range(len(items)), lambda done, number: on_progress(done, items[number]))
