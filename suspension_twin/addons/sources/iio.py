# SPDX-License-Identifier: Apache-2.0
"""``iio:bmi160``: an IMU on the I²C or SPI bus of this machine (a Raspberry Pi), by Linux' Industrial I/O.

Source: Documentation/ABI/testing/sysfs-bus-iio and Documentation/driver-api/iio of the kernel. The device is the one
whose ``name`` is given. Samples come through its buffer if it has a trigger (its data-ready interrupt); otherwise, or
with ``poll=1``, the values are read one by one, which does for some 200 Hz. A value is (raw + offset) · scale, in m/s²
and rad/s; the mount matrix turns the sensor's axes into those of the board.

Options: ``rate`` Hz, which is set in the device; ``trigger``, the name of another trigger; ``poll``.
"""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from suspension_twin.addons.sources.common.clock import host_time
from suspension_twin.addons.sources.common.connection import Address, PlainSource, keep_connected
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.receiver import DescriptorStream
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = ["EXAMPLE", "TITLE", "Iio", "devices", "make"]

TITLE = "Linux IIO"
EXAMPLE = "iio:bmi160"

SYSFS: Path = Path("/sys/bus/iio/devices")
DEV: Path = Path("/dev")

_AXES: Final = tuple(f"in_{kind}_{axis}" for kind in ("accel", "anglvel") for axis in "xyz")
_TYPE: Final = re.compile(r"(be|le):([su])(\d+)/(8|16|32|64)(?:X1)?(?:>>(\d+))?$")
#: Scans in the kernel's buffer, and s of them that are read at once.
_LENGTH, _AT_ONCE = 4096, 0.005
_POLLED: Final = 100.0  # Hz where no rate is given


def devices() -> list[str]:
    """Names of the IIO devices that have an accelerometer and a gyroscope."""
    found = []
    for folder in sorted(SYSFS.glob("iio:device*")):
        if (folder / "in_accel_x_raw").exists() and (folder / "in_anglvel_x_raw").exists():
            found.append((folder / "name").read_text(encoding="utf-8").strip())
    return found


@dataclass(frozen=True)
class _Scan:
    """How the bytes of one scan are laid out: ``dtype`` with a field for each element, and its shift and bits."""

    dtype: np.dtype[Any]
    fields: dict[str, tuple[int, int, bool]]

    @classmethod
    def of_elements(cls, elements: dict[str, tuple[int, str]], where: str) -> _Scan:
        """From index and type of each element; InputError for a type that is none."""
        names, formats, offsets, fields, at, widest = [], [], [], {}, 0, 1
        for name, (_, kind) in sorted(elements.items(), key=lambda item: item[1][0]):
            match = _TYPE.match(kind)
            if match is None:
                raise InputError(where, f"{name}: the type {kind!r} is not known")
            order, sign, bits, storage, shift = match.groups()
            size = int(storage) // 8
            at = -(-at // size) * size  # elements are aligned to their own size
            names.append(name)
            formats.append(f"{'<' if order == 'le' else '>'}u{size}")
            offsets.append(at)
            fields[name] = int(shift or 0), int(bits), sign == "s"
            at, widest = at + size, max(widest, size)
        size = -(-at // widest) * widest
        layout: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
        return cls(np.dtype(layout), fields)

    def values(self, scans: NDArray[Any], name: str) -> NDArray[np.int64]:
        """The numbers (n,) of one element."""
        shift, bits, signed = self.fields[name]
        number = scans[name].astype(np.uint64) >> np.uint64(shift)
        if bits < 64:
            number &= np.uint64((1 << bits) - 1)
        found = number.astype(np.int64)
        return (
            np.where(found >> (bits - 1) & 1, found - (1 << bits), found) if signed and bits < 64 else found
        )


class Iio(PlainSource):
    """One device."""

    steps: Sequence[str] = (
        "The sensor is screwed or glued to the body; its place and axes belong into the twin file (imu).",
        "?rate=1600 sets its rate, where its interrupt is connected.",
    )

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        address.check_options(("rate", "trigger", "poll"))
        self._wanted = address.path or address.host
        self._rate = address.number("rate", 0.0, 1.0, 4000.0)
        self._poll = bool(address.number("poll", 0, 0, 1))
        self._trigger = address.options.get("trigger", "")
        self._hub = hub
        self.device = hub.own_device(str(address), f"IMU {self._wanted}", rank=rank)
        self.notes = []

    async def start(self) -> None:
        """InputError for a device that is not there or may not be set up."""
        self._folder = self._find()
        try:
            self._set_up()
        except PermissionError as error:
            raise InputError(
                str(error.filename), "permission denied: IIO is root's unless udev says otherwise"
            ) from None
        except OSError as error:
            raise InputError(
                str(error.filename or self._folder), error.strerror or "cannot be read"
            ) from None

    async def run(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        await keep_connected(self._hub, self.device.name, self._polled if self._poll else self._buffered)

    async def stop(self) -> None:
        """Leave the device as it was found."""
        if hasattr(self, "_folder") and not self._poll:
            self._enable(False)

    # Set-up

    def _find(self) -> Path:
        names = {}
        for folder in sorted(SYSFS.glob("iio:device*")):
            names[(folder / "name").read_text(encoding="utf-8").strip()] = folder
            names[folder.name] = folder
        if self._wanted not in names:
            known = ", ".join(n for n in names if not n.startswith("iio:")) or "none (is its driver loaded?)"
            raise InputError(f"iio:{self._wanted}", f"is not there; there are {known}")
        return names[self._wanted]

    def _read(self, *names: str, default: str | None = None) -> str:
        """The first of these attributes that is there."""
        for name in names:
            path = self._folder / name
            if path.exists():
                return path.read_text(encoding="utf-8").strip()
        if default is None:
            raise InputError(
                str(self._folder), f"has no {names[0]}: it is no IMU with accelerometer and gyroscope"
            )
        return default

    def _write(self, name: str, value: object, *, must: bool = True) -> None:
        path = self._folder / name
        if must or path.exists():
            # Not by a file beside it, as everything else is written: these are the kernel's.
            descriptor = os.open(path, os.O_WRONLY)
            try:
                os.write(descriptor, f"{value}".encode())
            finally:
                os.close(descriptor)

    def _set_up(self) -> None:
        self._numbers = {}
        for axis in _AXES:
            kind = axis[:-2]
            scale = self._read(f"{kind}_scale", f"{axis}_scale")
            offset = self._read(f"{axis}_offset", f"{kind}_offset", default="0")
            self._read(f"{axis}_raw")
            self._numbers[axis] = _float(scale, self._folder), _float(offset, self._folder)
        self._turns = [
            _matrix(
                self._read(
                    f"{kind}_mount_matrix", "in_mount_matrix", "mount_matrix", default="1,0,0;0,1,0;0,0,1"
                )
            )
            for kind in ("in_accel", "in_anglvel")
        ]
        if self._rate:
            for name in (
                "in_accel_sampling_frequency",
                "in_anglvel_sampling_frequency",
                "sampling_frequency",
            ):
                self._write(name, f"{self._rate:g}", must=False)
        rate = self._read("in_accel_sampling_frequency", "sampling_frequency", default="")
        self._enable(False)
        self._poll = self._poll or not self._has_trigger()
        way = "read one by one, as it has no trigger" if self._poll else "through its buffer"
        self.notes = [f"IIO: {self._wanted}, {way}{f', {rate} Hz' if rate and not self._poll else ''}"]
        if self._poll:
            return
        self._write("current_timestamp_clock", "realtime", must=False)
        elements = {}
        for name in (*_AXES, "in_timestamp"):
            self._write(f"scan_elements/{name}_en", 1)
            kind = self._read(f"scan_elements/{name}_type", f"scan_elements/{name[:-2]}_type")
            elements[name] = int(self._read(f"scan_elements/{name}_index")), kind
        self._scan = _Scan.of_elements(elements, str(self._folder))
        self._write("buffer/length", _LENGTH)
        at_once = max(int(_float(rate or "100", self._folder) * _AT_ONCE), 1)
        self._write("buffer/watermark", at_once, must=False)

    def _has_trigger(self) -> bool:
        """Whether the buffer can be filled: by the trigger asked for, the one set, or the device's own."""
        if not (self._folder / "buffer" / "enable").exists():
            return False
        current = self._folder / "trigger" / "current_trigger"
        if not current.exists():
            return not self._trigger  # a buffer that fills itself
        there = [
            (path / "name").read_text(encoding="utf-8").strip() for path in sorted(SYSFS.glob("trigger*"))
        ]
        own = f"{self._read('name')}-dev{self._folder.name.removeprefix('iio:device')}"
        if self._trigger and self._trigger not in there:
            raise InputError(
                f"iio:{self._wanted}",
                f"has no trigger {self._trigger}; there are {', '.join(there) or 'none'}",
            )
        if self._trigger or (own in there and not current.read_text(encoding="utf-8").strip()):
            self._write("trigger/current_trigger", self._trigger or own)
        return bool(self._trigger or current.read_text(encoding="utf-8").strip())

    def _enable(self, on: bool) -> None:
        try:
            self._write("buffer/enable", int(on), must=on)
        except OSError:
            if on:
                raise

    # Samples

    def _hand_on(self, t: Floats, raw: list[Floats], arrival: float) -> None:
        """Raw values of the six axes at stamps ``t`` (n,) s."""
        columns = [
            (values + self._numbers[axis][1]) * self._numbers[axis][0]
            for axis, values in zip(_AXES, raw, strict=True)
        ]
        force: Floats = np.column_stack(columns[:3]) @ self._turns[0].T
        rate: Floats = np.column_stack(columns[3:]) @ self._turns[1].T
        self.device.imu(t, force, rate, arrival)

    async def _buffered(self) -> None:
        descriptor = os.open(DEV / self._folder.name, os.O_RDONLY | os.O_NONBLOCK)
        try:
            self._enable(True)
            stream, rest, size = DescriptorStream(descriptor), b"", self._scan.dtype.itemsize
            while True:
                data = rest + await stream.read()
                arrival = host_time()
                whole = len(data) // size
                scans = np.frombuffer(data, dtype=self._scan.dtype, count=whole)
                rest = data[whole * size :]
                if whole:
                    t = np.asarray(self._scan.values(scans, "in_timestamp") * 1e-9, dtype=np.float64)
                    raw = [self._scan.values(scans, axis).astype(np.float64) for axis in _AXES]
                    self._hand_on(t, raw, arrival)
        finally:
            os.close(descriptor)

    async def _polled(self) -> None:
        loop, period = asyncio.get_running_loop(), 1.0 / (self._rate or _POLLED)
        files = [os.open(self._folder / f"{axis}_raw", os.O_RDONLY) for axis in _AXES]
        try:
            due = loop.time()
            while True:
                before = host_time()
                raw: list[Floats] = [
                    np.array([_float(os.pread(file, 64, 0).decode("ascii", "replace"), self._folder)])
                    for file in files
                ]
                after = host_time()
                self._hand_on(np.array([0.5 * (before + after)], dtype=np.float64), raw, after)
                due = max(due + period, loop.time() - 10.0 * period)
                await asyncio.sleep(max(due - loop.time(), 0.0))
        finally:
            for file in files:
                os.close(file)


def _float(text: str, where: Path) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(str(where), f"{text.strip()[:40]!r} is no number") from None


def _matrix(text: str) -> Floats:
    """``1, 0, 0; 0, 1, 0; 0, 0, 1``, by which axes of the sensor are turned into those of the board."""
    try:
        rows = [[float(value) for value in row.split(",")] for row in text.split(";")]
        matrix = np.array(rows)
    except ValueError:
        matrix = np.zeros(0)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=0.01):
        raise InputError("mount matrix", f"{text!r} does not turn three axes")
    return matrix


#: See ``SourceModule``.
make = Iio
