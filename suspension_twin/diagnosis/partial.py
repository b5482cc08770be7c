# SPDX-License-Identifier: Apache-2.0
"""Partial results of a diagnosis on disk, from which an interrupted one goes on.

A diagnosis is a sequence of rounds; a round is one piece of work on each of some items (the fit of every effect). The
result of a piece is kept in a file named by the digest of what it follows from: request, twin, data, code, and which
piece of which round it is. Rounds follow in the same order from the same data, so that a piece found on disk has the
bits that it would have if it were done again. The files are the checkpoints of a calibration: each whole or not there,
no pickles.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import suspension_twin
from suspension_twin.arrays import Floats
from suspension_twin.calibration.checkpoint import Checkpoint, State
from suspension_twin.compiled import sources
from suspension_twin.inference.parallel import no_progress, side_by_side

__all__ = ["PartialResults", "code_digest", "decoded", "encoded", "kept"]

Item = TypeVar("Item")
Found = TypeVar("Found")
Record = TypeVar("Record", bound=type)

#: Records that a partial result may consist of, by name.
_RECORDS: dict[str, type] = {}


def kept(record: Record) -> Record:
    """Declare a dataclass as one that partial results consist of."""
    _RECORDS[record.__name__] = record
    return record


@cache
def code_digest() -> str:
    """Digest of the code of the diagnosis and of all that it imports of this package."""
    root = Path(suspension_twin.__file__).parent
    digest = hashlib.sha256()
    for file in sources(Path(__file__).with_name("run.py"), root):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def encoded(value: Any, arrays: dict[str, Floats]) -> Any:
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


def decoded(value: Any, arrays: Mapping[str, Floats]) -> Any:
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


@dataclass(eq=False)
class PartialResults:
    """The partial results of one diagnosis; without a ``store`` nothing is kept."""

    store: Checkpoint | None = None
    _rounds: int = field(default=0, init=False)

    def side_by_side(
        self,
        work: Callable[[Item], Found],
        items: Sequence[Item],
        on_progress: Callable[[float, Item], None] = no_progress,
    ) -> list[Found]:
        """As :func:`~suspension_twin.inference.parallel.side_by_side`, one round; called by one thread."""
        store, this = self.store, self._rounds
        self._rounds += 1
        if store is None:
            return side_by_side(work, items, on_progress)

        def once(number: int) -> Found:
            part = hashlib.sha256(f"{store.fingerprint} {this} {number}".encode()).hexdigest()[:32]
            known = store.load(part)
            if known is None:
                arrays: dict[str, Floats] = {}
                plain = {"found": encoded(work(items[number]), arrays)}
                store.save(State(f"round {this}", arrays, plain), part)
                known = store.load(part)
                assert known is not None
            found: Found = decoded(known.plain["found"], known.arrays)
            return found

        return side_by_side(once, range(len(items)), lambda done, number: on_progress(done, items[number]))
