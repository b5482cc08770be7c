# SPDX-License-Identifier: Apache-2.0
"""The manifest of a fleet: which drives of which vehicle, with which twin, over which road, on which date.

CSV with a header, or YAML with ``defaults`` and ``items``. A relative name is looked for from the folder of the
manifest; a URL (``s3://``, ``gs://``, ``file://``, whatever ``fsspec`` knows) is taken as it is.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import date as Date, datetime
from pathlib import Path
from urllib.parse import unquote, urlsplit

from suspension_twin.addons.fleet.storage import is_url
from suspension_twin.errors import InputError, nearest, shown
from suspension_twin.files import read_bytes, read_yaml, reader

__all__ = ["Item", "read_manifest"]

#: Bytes of a manifest: a million rows.
_LARGEST = 256 << 20
_COLUMNS = ("vehicle", "date", "twin", "drives", "references", "road")
_NEEDED, _LISTS = ("vehicle", "twin", "drives"), ("drives", "references")
Entry = dict[str, object]


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


@reader("a manifest")
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
    rows_of = {".yaml": _yaml_rows, ".yml": _yaml_rows, ".csv": _csv_rows}.get(path.suffix.lower())
    if rows_of is None:
        raise InputError(path, "is no manifest: a name that ends in .csv, .yaml or .yml is expected")
    items = []
    seen: dict[tuple[str, ...], str] = {}
    for where, row in rows_of(path):
        item = _item(path, where, row)
        first = seen.setdefault((item.vehicle, item.date, *item.drives), where)
        if first != where:
            raise InputError(path, where, f"is the same vehicle, date and drives as {first}")
        items.append(item)
    if not items:
        raise InputError(path, "holds no drives")
    return tuple(items)


def _csv_rows(path: Path) -> Iterator[tuple[str, Entry]]:
    """Entries, and where they stand."""
    try:
        text = read_bytes(path, _LARGEST).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "not a text file") from None
    reader = csv.DictReader(io.StringIO(text, newline=""), restkey="")
    _check_names(path, "header", reader.fieldnames or (), _NEEDED)
    try:
        for row in reader:
            where = f"line {reader.line_num}"
            if "" in row:
                raise InputError(path, where, "has more values than the header has columns")
            texts = {name: (value or "").strip() for name, value in row.items()}
            lists = {
                name: [p.strip() for p in texts.get(name, "").split(";") if p.strip()] for name in _LISTS
            }
            yield where, {**texts, **lists}
    except csv.Error as error:
        raise InputError(path, f"line {reader.line_num}", f"is no CSV: {error}") from None


def _yaml_rows(path: Path) -> Iterator[tuple[str, Entry]]:
    """Entries, and where they stand."""
    data = read_yaml(path)
    if not isinstance(data, dict) or not isinstance(data.get("items"), list):
        raise InputError(path, "items: a list of vehicles and their drives is expected")
    for key in data:
        if key not in ("defaults", "items"):
            raise InputError(path, shown(key), "is not a key of a manifest (defaults, items)")
    defaults = data.get("defaults") or {}
    for where, entry in (("defaults", defaults), *((f"items.{k}", e) for k, e in enumerate(data["items"]))):
        if not isinstance(entry, dict):
            raise InputError(path, where, "must be keys and values")
        if entry is defaults:
            _check_names(path, where, entry, ())
            continue
        row = {**defaults, **entry}
        _check_names(path, where, row, _NEEDED)
        for name in _LISTS:
            value = row.get(name) or []
            row[name] = [value] if isinstance(value, str) else value
        yield where, row


def _check_names(path: Path, where: str, names: Iterable[str], needed: tuple[str, ...]) -> None:
    known = list(names)
    for name in known:
        if name not in _COLUMNS:
            hint = nearest(str(name), _COLUMNS)
            raise InputError(path, where, f"{shown(name)} is not one of {', '.join(_COLUMNS)}{hint}")
    for name in needed:
        if name not in known:
            raise InputError(path, where, f"{name} is missing")


def _item(path: Path, where: str, row: Entry) -> Item:
    for name in _NEEDED:
        if not row.get(name):
            raise InputError(path, where, f"{name} is empty")
    texts: dict[str, str] = {}
    for name in ("vehicle", "date", "twin", "road"):
        if not isinstance(row.get(name) or "", str | int | float):
            raise InputError(path, where, f"{name}: a text is expected, is {shown(row[name])}")
        texts[name] = str(row.get(name) or "").strip()
    lists: dict[str, tuple[str, ...]] = {}
    for name in _LISTS:
        values = row[name]
        if not isinstance(values, list) or not all(isinstance(v, str) and v for v in values):
            raise InputError(path, where, f"{name}: names of recordings are expected, is {shown(values)}")
        lists[name] = tuple(_absolute(path, value) for value in values)
    date = texts["date"]
    try:
        if date:
            datetime.fromisoformat(date.replace("Z", "+00:00"))
            Date.fromisoformat(date[:10])
    except ValueError:
        raise InputError(path, where, f"date: YYYY-MM-DD is expected, is {shown(date)}") from None
    road = _absolute(path, texts["road"]) if texts["road"] else ""
    return Item(texts["vehicle"], date, _absolute(path, texts["twin"]), **lists, road=road)


def _absolute(manifest: Path, name: str) -> str:
    """A URL, or the absolute path of a name in a manifest."""
    if name.startswith("file://"):
        return unquote(urlsplit(name).path)
    return name if is_url(name) else str((manifest.absolute().parent / name).absolute())
