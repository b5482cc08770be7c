# SPDX-License-Identifier: Apache-2.0
"""The state of a calibration on disk: one npz of arrays, its plain values in it as JSON text.

It is put in place by rename: at any moment the folder holds one whole state or none. No pickles. A diagnosis keeps
several states, one for each piece of its work.
"""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import check_writable, replacing

__all__ = ["STATE", "Checkpoint", "State"]

#: Name of the file in the folder.
STATE = "state.npz"
_FORMAT = 2
_INDEX = "index"
#: The files of a state, whole or in the making: what else is in the folder is not touched.
_OWN = re.compile(r"state(-[0-9a-f]+)?\.npz|\..*\.part(\.\w+)?")


@dataclass(frozen=True, eq=False)
class State:
    """What was saved: the stage's name, its arrays and its plain values."""

    stage: str
    arrays: dict[str, Floats]
    plain: dict[str, Any]


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
        try:
            with np.load(self._file(name), allow_pickle=False) as stored:
                arrays = {name: np.array(stored[name]) for name in stored.files}
            index = json.loads(str(arrays.pop(_INDEX)))
            if index["format"] != _FORMAT or index["fingerprint"] != self.fingerprint:
                return None
            return State(str(index["stage"]), arrays, dict(index["plain"]))
        except (OSError, KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile):
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
            np.savez(stream, **{**state.arrays, _INDEX: np.array(json.dumps(index, default=_plain))})  # type: ignore[arg-type]

    def remove(self) -> None:
        """Forget all states: the work is done and its result written."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _plain(value: np.generic) -> Any:
    """A NumPy scalar as the number that it is; floats keep all their bits."""
    return value.item()
