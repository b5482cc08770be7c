# SPDX-License-Identifier: Apache-2.0
"""The state of a calibration on disk: one npz of arrays and one yaml of plain values.

The yaml names the npz it belongs to and is put in place last, by rename: at any moment the
folder holds one whole state or none. No pickles.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = ["Checkpoint", "State"]

_INDEX = "state.yaml"
_FORMAT = 1
#: The same text, written by C where PyYAML was built with it.
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@dataclass(frozen=True, eq=False)
class State:
    """What was saved: the stage's name, its arrays and its plain values."""

    stage: str
    arrays: dict[str, Floats]
    plain: dict[str, Any]


class Checkpoint:
    """Saves and loads the state of one problem, told apart from others by ``fingerprint``."""

    def __init__(self, folder: Path, fingerprint: str) -> None:
        self.folder = folder
        self.fingerprint = fingerprint
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(folder, f"no state can be kept here: {error.strerror}") from None

    def load(self) -> State | None:
        """The last whole state of this very problem, or None: then the search starts anew."""
        try:
            index = yaml.safe_load((self.folder / _INDEX).read_text(encoding="utf-8"))
            if index["format"] != _FORMAT or index["fingerprint"] != self.fingerprint:
                return None
            with np.load(self.folder / index["arrays"], allow_pickle=False) as stored:
                arrays = {name: np.array(stored[name]) for name in stored.files}
            return State(str(index["stage"]), arrays, dict(index["plain"]))
        except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile, yaml.YAMLError):
            return None

    def save(self, state: State) -> None:
        """Write the state; a process killed within leaves the one before."""
        digest = hashlib.sha256()
        for name in sorted(state.arrays):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(state.arrays[name]).tobytes())
        arrays = f"{state.stage}-{digest.hexdigest()[:16]}.npz"
        target = self.folder / arrays
        part = self.folder / f"{arrays}.part"
        with part.open("wb") as stream:
            np.savez(stream, **state.arrays)  # type: ignore[arg-type]
            _flush(stream.fileno())
        os.replace(part, target)
        index = {
            "format": _FORMAT,
            "fingerprint": self.fingerprint,
            "stage": state.stage,
            "arrays": arrays,
            "plain": _plain(state.plain),
        }
        part = self.folder / f"{_INDEX}.part"
        with part.open("w", encoding="utf-8") as text:
            yaml.dump(index, text, Dumper=_DUMPER, sort_keys=False)
            text.flush()
            _flush(text.fileno())
        os.replace(part, self.folder / _INDEX)
        for old in self.folder.iterdir():
            if old.name not in (arrays, _INDEX) and old.suffix in (".npz", ".part"):
                old.unlink(missing_ok=True)

    def remove(self) -> None:
        """Forget the state: the calibration is done and its result written."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _flush(descriptor: int) -> None:
    with contextlib.suppress(OSError):
        os.fsync(descriptor)


def _plain(value: Any) -> Any:
    """Nested plain values; integers of any size survive yaml, floats keep all their bits."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
