# SPDX-License-Identifier: Apache-2.0
"""Live samples into a recording, as the nodes would have got them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from suspension_twin.addons.sources.common.hub import Packet
from suspension_twin.drive.read import Topics
from suspension_twin.drive.write import BagWriter, write_samples
from suspension_twin.errors import WorkError

__all__ = ["LiveRecorder"]

#: s after which what was given is written out, as often as the bag goes to the disk.
_FLUSH = 1.0


class LiveRecorder:
    """Writes packets into a new recording; use it as a context manager.

    ``counts`` are the samples so far by stream. What came until about two seconds ago stays, whatever happens.
    Leaving the context without any sample raises WorkError and leaves what was there before; without any IMU sample it
    raises WorkError, too, and what a receiver gave is kept. InputError and WorkError as of
    :class:`~suspension_twin.drive.write.BagWriter`.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False) -> None:
        self.counts: Counter[str] = Counter()
        self._bag = BagWriter(path, overwrite=overwrite, live=True)
        self._flushed = time.monotonic()

    def __enter__(self) -> LiveRecorder:
        self._bag.__enter__()
        return self

    def write(self, packets: Iterable[Packet]) -> None:
        """Add samples."""
        for packet in packets:
            write_samples(self._bag, packet.samples, Topics())
            self.counts[packet.stream] += len(packet.samples)
        if time.monotonic() > self._flushed + _FLUSH:
            self._bag.flush()
            self._flushed = time.monotonic()

    def discard(self) -> None:
        """Leave nothing of it, for what was recorded is of no use; to be called before leaving the context."""
        self._bag.discard()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is KeyboardInterrupt:  # which is how a recording ends
            kind = error = trace = None
        missing = WorkError(f"{self._bag.path}: nothing recorded, no IMU sample arrived")
        if kind is None and not self.counts.total():
            self._bag.discard()
            self._bag.__exit__(WorkError, missing, None)
            raise missing
        self._bag.__exit__(kind, error, trace)
        if kind is None and not self.counts["imu"]:
            kept = ", ".join(f"{count} {stream}" for stream, count in self.counts.items())
            raise WorkError(f"{self._bag.path}: no IMU sample arrived; what a receiver gave is kept ({kept})")
