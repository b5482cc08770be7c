# SPDX-License-Identifier: Apache-2.0
"""The manifest of a fleet: which drives of which vehicle, with which twin, over which road, on which date.

CSV with a header, or YAML with ``defaults`` and ``items``. A relative name is looked for from the folder of the
manifest; a URL (``s3://``, ``gs://``, ``file://``, whatever ``fsspec`` knows) is taken as it is.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date as Date
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from suspension_twin.errors import InputError, nearest, shown
from suspension_twin.files import read_bytes, read_yaml

__all__ = ["Item", "is_url", "read_manifest"]

#: Bytes of a manifest: a million rows.
_LARGEST = 256 << 20
_COLUMNS = ("vehicle", "date", "twin", "drives", "references", "road")
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")


@dataclass(frozen=True)
class Item:
    """One piece of work: the drives of one vehicle on one date.

    Parameters
    ----------
    vehicle : str
        Name of the vehicle.
    date : str
        ``YYYY-MM-DD``, or with a time; empty: the day on which the first drive was recorded.
    twin : str
        Absolute path or URL of the twin file.
    drives : tuple of str
        Absolute paths or URLs of recordings.
    references : tuple of str
        The same, of drives from before the gap; a calibration does not use them.
    road : str
        Absolute path or URL of an OpenCRG road; empty: the twin file's.

    Examples
    --------
    >>> Item("car_01", "2026-03-01", "s3://fleet/car_01.yaml", ("s3://fleet/a.mcap",)).road
    ''
    """

    vehicle: str
    date: str
    twin: str
    drives: tuple[str, ...]
    references: tuple[str, ...] = ()
    road: str = ""

    @property
    def title(self) -> str:
        """Vehicle and date, or the first drive where there is no date."""
        return f"{self.vehicle} {self.date or Path(self.drives[0]).name}"


def is_url(name: str) -> bool:
    """Whether a name is a URL of object storage; ``file://`` is none, it names a file here."""
    return _URL.match(name) is not None and not name.startswith("file://")


def read_manifest(path: str | Path) -> tuple[Item, ...]:
    """Read a manifest.

    Parameters
    ----------
    path : str or Path
        CSV (``.csv``) or YAML (``.yaml``, ``.yml``). Columns or keys: ``vehicle``, ``date``, ``twin``, ``drives``,
        ``references``, ``road``. In CSV several drives are separated by ``;``.

    Returns
    -------
    tuple of Item
        In the order of the file.

    Raises
    ------
    InputError
        Names file, row and column.

    Examples
    --------
    >>> read_manifest("fleet.csv")[0].vehicle  # doctest: +SKIP
    'car_01'
    """
    path = Path(path)
    if path.suffix.lower() in (".yaml", ".yml"):
        rows = _yaml_rows(path)
    elif path.suffix.lower() == ".csv":
        rows = _csv_rows(path)
    else:
        raise InputError(path, "is no manifest: a name that ends in .csv, .yaml or .yml is expected")
    items = tuple(_item(path, where, row) for where, row in rows)
    if not items:
        raise InputError(path, "holds no drives")
    seen: dict[tuple[str, ...], str] = {}
    for (where, _), item in zip(rows, items, strict=True):
        key = (item.vehicle, item.date, *item.drives)
        if key in seen:
            raise InputError(path, where, f"is the same vehicle, date and drives as {seen[key]}")
        seen[key] = where
    return items


def _csv_rows(path: Path) -> list[tuple[str, dict[str, Any]]]:
    try:
        text = read_bytes(path, _LARGEST).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "not a text file") from None
    reader = csv.DictReader(io.StringIO(text, newline=""), restkey="")
    _check_names(path, "header", reader.fieldnames or (), ("vehicle", "twin", "drives"))
    rows: list[tuple[str, dict[str, Any]]] = []
    try:
        for row in reader:
            where = f"line {reader.line_num}"
            if "" in row:
                raise InputError(path, where, "has more values than the header has columns")
            plain: dict[str, Any] = {k: (v or "").strip() for k, v in row.items()}
            for several in ("drives", "references"):
                plain[several] = [p.strip() for p in plain.get(several, "").split(";") if p.strip()]
            rows.append((where, plain))
    except csv.Error as error:
        raise InputError(path, f"line {reader.line_num}", f"is no CSV: {error}") from None
    return rows


def _yaml_rows(path: Path) -> list[tuple[str, dict[str, Any]]]:
    data = read_yaml(path)
    if not isinstance(data, dict) or not isinstance(data.get("items"), list):
        raise InputError(path, "items: a list of vehicles and their drives is expected")
    for key in data:
        if key not in ("defaults", "items"):
            raise InputError(path, shown(key), "is not a key of a manifest (defaults, items)")
    defaults = data.get("defaults") or {}
    if not isinstance(defaults, dict):
        raise InputError(path, "defaults", "must be keys and values")
    _check_names(path, "defaults", defaults, ())
    rows = []
    for number, entry in enumerate(data["items"]):
        where = f"items.{number}"
        if not isinstance(entry, dict):
            raise InputError(path, where, "must be keys and values")
        row = {**defaults, **entry}
        _check_names(path, where, row, ("vehicle", "twin", "drives"))
        for several in ("drives", "references"):
            value = row.get(several) or []
            row[several] = [value] if isinstance(value, str) else value
        rows.append((where, row))
    return rows


def _check_names(path: Path, where: str, names: Any, needed: tuple[str, ...]) -> None:
    for name in names:
        if name not in _COLUMNS:
            hint = nearest(str(name), _COLUMNS)
            raise InputError(path, where, f"{shown(name)} is not one of {', '.join(_COLUMNS)}{hint}")
    for name in needed:
        if name not in names:
            raise InputError(path, where, f"{name} is missing")


def _item(path: Path, where: str, row: Mapping[str, Any]) -> Item:
    for name in ("vehicle", "twin", "drives"):
        if not row.get(name):
            raise InputError(path, where, f"{name} is empty")
    for name in ("vehicle", "date", "twin", "road"):
        if not isinstance(row.get(name) or "", str | int | float):
            raise InputError(path, where, f"{name}: a text is expected, is {shown(row[name])}")
    for name in ("drives", "references"):
        if not isinstance(row[name], list) or not all(isinstance(v, str) and v for v in row[name]):
            raise InputError(path, where, f"{name}: names of recordings are expected, is {shown(row[name])}")
    date = str(row.get("date") or "").strip()
    if date:
        try:
            datetime.fromisoformat(date.replace("Z", "+00:00"))
            Date.fromisoformat(date[:10])
        except ValueError:
            raise InputError(path, where, f"date: YYYY-MM-DD is expected, is {shown(date)}") from None

    def place(name: str) -> str:
        return _absolute(path.absolute().parent, name)

    return Item(
        vehicle=str(row["vehicle"]).strip(),
        date=date,
        twin=place(str(row["twin"])),
        drives=tuple(place(d) for d in row["drives"]),
        references=tuple(place(d) for d in row["references"]),
        road=place(str(row["road"])) if row.get("road") else "",
    )


def _absolute(folder: Path, name: str) -> str:
    if name.startswith("file://"):
        return unquote(urlsplit(name).path)
    return name if is_url(name) else str((folder / name).absolute())
