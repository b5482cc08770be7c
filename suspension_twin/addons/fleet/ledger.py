# SPDX-License-Identifier: Apache-2.0
"""The folder of a fleet's results: one folder for every task, by its key, written whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from suspension_twin.errors import InputError
from suspension_twin.files import check_writable, parse_yaml, together, write_text
from suspension_twin.vehicle.twin import RoadFile, parse_twin, save_twin

__all__ = ["MARK", "TWIN", "Ledger"]

#: The file by which a folder is known as one of a fleet.
MARK = "fleet.json"
TWIN = "twin.yaml"
_RECORD = "record.json"
_FORMAT = 1


class Ledger:
    """What has been done. A record that is there is whole, and is never computed again.

    Raises InputError for a folder that holds something else.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        mark = folder / MARK
        if folder.is_dir() and any(folder.iterdir()) and not mark.is_file():
            raise InputError(folder, "holds something else than a fleet's results: name another folder")
        check_writable(mark)

    def begin(self) -> None:
        """Make the folder, and mark it as one of a fleet."""
        if not (self.folder / MARK).exists():
            write_text(self.folder / MARK, json.dumps({"format": _FORMAT}) + "\n")

    def place(self, key: str) -> Path:
        """The folder of a task's results."""
        return self.folder / "items" / key[:2] / key

    def load(self, key: str) -> dict[str, Any] | None:
        """The record of a task, or None: it has to be done."""
        try:
            record = json.loads((self.place(key) / _RECORD).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        whole = (
            isinstance(record, dict)
            and record.get("key") == key
            and record.get("status") in ("done", "failed")
        )
        return record if whole else None

    def save(self, record: dict[str, Any]) -> dict[str, Any]:
        """Write a record and its files; returns the record as it is kept."""
        kept = {k: v for k, v in record.items() if k != "files"}
        place = self.place(record["key"])
        with together():  # the record takes its place last: where it is, its files are
            for name, text in record.get("files", {}).items():
                if name == TWIN and (record.get("road") or record.get("program")):
                    _write_twin(place / name, text, record.get("road", ""), record.get("program", ""))
                else:
                    write_text(place / name, text)
            write_text(place / _RECORD, json.dumps(kept, ensure_ascii=False, allow_nan=False) + "\n")
        return kept


def _write_twin(path: Path, text: str, road: str, program: str) -> None:
    """A twin file whose road and program are named from where it now lies."""
    heading = "".join(line for line in text.splitlines(keepends=True) if line.startswith("#"))
    twin = parse_twin(parse_yaml(text, path), path)
    if program:
        twin = twin.with_paths(lambda file: Path(program) if file == twin.program else file)
    if road:
        twin = twin.model_copy(update={"road": RoadFile(file=Path(road))})
    save_twin(twin, path, heading)
