# SPDX-License-Identifier: Apache-2.0
"""The state of a calibration on disk: one npz of arrays and one yaml of plain values.

The yaml names the npz it belongs to and is put in place last, by rename: at any moment the
folder holds one whole state or none. No pickles.
"""

from __future__ import annotations

import hashlib
import re
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
from suspension_twin.files import check_writable, replacing, write_text

__all__ = ["STATE", "Checkpoint", "State"]

STATE = "state.yaml"
_FORMAT = 1
#: The files of a state, whole or in the making: what else is in the folder is not touched.
_OWN = re.compile(r"state\.yaml|\w+-[0-9a-f]{16}\.npz|\..*\.part\.(npz|yaml)")
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
        check_writable(folder / STATE)
        strange = [p.name for p in folder.iterdir() if not _OWN.fullmatch(p.name)] if folder.is_dir() else []
        if strange:
            raise InputError(
                folder, f"holds {strange[0]}, which is no state of a calibration: name another folder"
            )

    def load(self) -> State | None:
        """The last whole state of this very problem, or None: then the search starts anew."""
        try:
            index = yaml.safe_load((self.folder / STATE).read_text(encoding="utf-8"))
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
        with replacing(self.folder / arrays) as part, part.open("wb") as stream:
            np.savez(stream, **state.arrays)  # type: ignore[arg-type]
        index = {
            "format": _FORMAT,
            "fingerprint": self.fingerprint,
            "stage": state.stage,
            "arrays": arrays,
            "plain": _plain(state.plain),
        }
        write_text(self.folder / STATE, yaml.dump(index, Dumper=_DUMPER, sort_keys=False))
        for old in self.folder.iterdir():
            if old.name not in (
                arrays,
                STATE,
            ):  # the state before this one, or parts of a process that was killed
                old.unlink(missing_ok=True)

    def remove(self) -> None:
        """Forget the state: the calibration is done and its result written."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _plain(value: Any) -> Any:
    """Nested plain values; integers of any size survive yaml, floats keep all their bits."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
