# SPDX-License-Identifier: Apache-2.0
"""Profiles in ERD files (University of Michigan, Engineering Research Division), text and binary.

The header is text: ``ERDFILEV2.00``; a line of the numbers of channels, samples, records and bytes,
the kind of the data, and the step; lines that begin with a keyword of eight characters, one of
``&1000`` going on with the line before; ``END``. Text data follow. Binary data (2-byte integers,
kind 0, or 4-byte floats, kind 1; all channels of a sample together) follow too, or lie in a file
of the same name with ``.bin`` added.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.profile import Profile, unit_of

__all__ = ["read_erd"]

_TEXT = 5
_KINDS = {0: "<i2", 1: "<f4"}
_FIELD = {"SHORTNAM": 8, "UNITSNAM": 8, "LONGNAME": 32, "GENNAME": 32}


def read_erd(path: Path, raw: bytes) -> Profile:
    """The channels of an ERD file that are heights, in m; raises InputError."""
    if not raw.upper().startswith(b"ERDFILEV2.00"):
        raise InputError(path, "line 1", "ERDFILEV2.00 is read, this is another version")
    end = re.search(rb"(?m)^END[ \t]*\r?\n", raw)
    if end is None:
        raise InputError(path, "has no line END after its header")
    header = raw[: end.start()].decode("latin-1").splitlines()
    channels, samples, kind, step = _sizes(path, header)
    words = _keywords(header[2:])
    body = raw[end.end() :]
    if kind == _TEXT:
        values = _text(path, body, channels)
    else:
        beside = path.with_name(path.name + ".bin")
        if not body.strip() and beside.is_file():
            body = beside.read_bytes()
        values = _binary(path, body, channels, kind)
    if samples > 0 and values.shape[0] != samples:
        raise InputError(path, "data", f"{values.shape[0]} samples, the header says {samples}")
    gains, offsets = (_numbers(path, words, key, channels) for key in ("GAINS", "OFFSETS"))
    if gains is not None:
        values = values * gains
    if offsets is not None:
        values = values + offsets
    names = _fields(words.get("LONGNAME") or words.get("SHORTNAM", ""), 32 if "LONGNAME" in words else 8)
    names = [*names, *[f"channel {i + 1}" for i in range(len(names), channels)]][:channels]
    units = [*_fields(words.get("UNITSNAM", ""), 8), *["m"] * channels][:channels]
    along = unit_of(words.get("XUNITS", "").strip() or "m", path, "XUNITS")
    chosen = []
    for i, unit in enumerate(units):
        try:
            chosen.append((i, unit_of(unit or "m", path, "UNITSNAM")))
        except InputError:
            continue  # a slope, an acceleration, a speed
    if not chosen:
        raise InputError(path, "UNITSNAM", f"no channel is a height: {', '.join(units)}")
    z = np.array([values[:, i] * scale for i, scale in chosen])
    if not np.isfinite(z).all():
        raise InputError(path, "data", "hold a value that is not finite")
    return Profile(path.name, step * along, z, tuple(names[i] for i, _ in chosen))


def _sizes(path: Path, header: list[str]) -> tuple[int, int, int, float]:
    """Channels, samples, kind of data, and step."""
    parts = re.split(r"[,\s]+", header[1].strip().rstrip(",")) if len(header) > 1 else []
    try:
        channels, samples, kind, step = int(parts[0]), int(parts[1]), int(parts[4]), float(parts[5])
    except (ValueError, IndexError):
        raise InputError(
            path, "line 2", "needs numbers of channels, samples, records, bytes, kind, step"
        ) from None
    if channels < 1 or not (np.isfinite(step) and step > 0.0):
        raise InputError(path, "line 2", f"{channels} channels with a step of {step:g}")
    if kind not in (*_KINDS, _TEXT):
        raise InputError(
            path, "line 2", f"data of kind {kind}; read are 0 (2-byte integers), 1 (floats), 5 (text)"
        )
    return channels, samples, kind, step


def _keywords(lines: list[str]) -> dict[str, str]:
    words: dict[str, str] = {}
    last = ""
    for line in lines:
        key, rest = line[:8].strip().upper(), line[8:]
        if key.startswith("&") and last:
            words[last] += rest
        elif key:
            last = key
            words[key] = rest
            if key in _FIELD:
                # A field may be cut off at the end of its line.
                words[key] = rest.ljust(-(-len(rest) // _FIELD[key]) * _FIELD[key])
    return words


def _fields(text: str, width: int) -> list[str]:
    return [text[i : i + width].strip() for i in range(0, len(text.rstrip()), width)]


def _numbers(path: Path, words: dict[str, str], key: str, channels: int) -> Floats | None:
    if key not in words:
        return None
    try:
        values = np.array([float(part) for part in re.split(r"[,\s]+", words[key].strip(" ,"))])
    except ValueError:
        raise InputError(path, key, f"{words[key].strip()!r} are not numbers") from None
    if values.size != channels:
        raise InputError(path, key, f"{values.size} numbers for {channels} channels")
    return values


def _text(path: Path, body: bytes, channels: int) -> Floats:
    try:
        flat = np.array(body.replace(b",", b" ").split(), dtype=np.float64)
    except ValueError:
        raise InputError(path, "data", "hold a word that is not a number") from None
    return _rows(path, flat, channels)


def _binary(path: Path, body: bytes, channels: int, kind: int) -> Floats:
    dtype = np.dtype(_KINDS[kind])
    if len(body) % dtype.itemsize:
        raise InputError(path, "data", f"{len(body)} bytes are no whole number of values")
    return _rows(path, np.frombuffer(body, dtype=dtype).astype(np.float64, copy=True), channels)


def _rows(path: Path, flat: Floats, channels: int) -> Floats:
    if flat.size < 2 * channels or flat.size % channels:
        raise InputError(path, "data", f"{flat.size} values for {channels} channels")
    rows: Floats = flat.reshape(-1, channels)
    return rows
