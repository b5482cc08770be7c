# SPDX-License-Identifier: Apache-2.0
"""Limits of what a small file may cost: how much memory it may take once it is unpacked, and how much time.

Recordings of sensors shrink to a tenth at best. A file that unpacks to thousands of times its size is made to fill a
memory, and is refused while it unpacks, not after. A library that cannot be bounded runs in a process that is.
"""

from __future__ import annotations

import bz2
import json
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Final, Protocol, TypeVar, final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from suspension_twin.errors import InputError, SuspensionTwinError, WorkError
from suspension_twin.files import reading

__all__ = ["VARIABLE", "ZSTD_MAGIC", "Budget", "TooLarge", "inflate", "serve_child", "within_limits"]

#: The environment variable that raises the limit, in MiB.
VARIABLE: Final = "SUSPENSION_TWIN_UNPACKED_MIB"
ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"

_FLOOR: Final = 64 << 20
_RATIO: Final = 32
#: s of processor time for any file and for each byte of it (tolerance, by hand: the slowest reader, that of nested
#: MATLAB structs, takes 2 MB/s).
_SECONDS, _SECONDS_PER_BYTE = 5.0, 2e-6
#: Times the processor time that the reader may take by the clock (tolerance, by hand: it starts within 2 s, and as many
#: readers share a core).
_PATIENCE: Final = 6.0
#: Address space that a reader in a process of its own takes for each byte of the budget: its input and two copies.
_COPIES: Final = 3
#: Bytes fed at a time. They make 32 MiB at most (zstd: blocks of 4 bytes for 128 KiB), and a decompressor that fails
#: returns nothing of the bytes that it was given last.
_PIECE: Final = 1 << 10


class TooLarge(InputError):
    """A file unpacks to more than it may."""


@final
class Budget:
    """Bytes that ``source`` of ``size`` bytes on disk may take in memory; each part read is taken from it.

    ``seconds`` is the processor time that reading it may take. Raises InputError if the environment variable is no
    number of MiB.
    """

    def __init__(self, source: str | Path, size: int) -> None:
        given = os.environ.get(VARIABLE, "")
        if given and not (given.isascii() and given.isdigit()):
            raise InputError(VARIABLE, f"must be a number of MiB, is {given[:40]!r}")
        self.source = source
        self.allowed = self.left = int(given) << 20 if given else max(_FLOOR, _RATIO * size)
        self.seconds = _SECONDS + _SECONDS_PER_BYTE * size

    def take(self, count: int) -> None:
        """``count`` bytes more; raises TooLarge where they are too many."""
        self.left -= count
        if self.left < 0:
            raise TooLarge(
                self.source,
                f"unpacks to more than {self.allowed >> 20} MiB: if that is right, {VARIABLE}="
                f"{2 * max(self.allowed >> 20, 1)} in the environment allows more",
            )


Found = TypeVar("Found")

#: The child finds the package where this process found it, and nothing in the folder in which it is started.
_CHILD: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from suspension_twin.drive.unpack import serve_child; serve_child()"
)


def within_limits(
    function: Callable[..., Found], *arguments: object, budget: Budget, kind: str, module: str
) -> Found:
    """``function(*arguments)`` in a process of its own, which gets the memory and the time of ``budget`` and no more.

    For readers of foreign files in libraries that cannot be bounded. ``module`` is the library, which is imported
    before the limits hold; ``kind`` names the file in errors, see :func:`reading`. Function, arguments and result are
    pickled over pipes that only the two hold. Raises what ``function`` raises as one line about the file; InputError
    where it takes too much.
    """
    asked = pickle.dumps((function, arguments, budget, kind, module))
    too_long = f"is not {kind} that can be read in {budget.seconds:.0f} s: damaged, or too large"
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-c", _CHILD, json.dumps(sys.path)],
            input=asked,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            check=False,
            timeout=_PATIENCE * budget.seconds,
        )
    except subprocess.TimeoutExpired:  # it waits for its disk
        raise InputError(budget.source, too_long) from None
    if done.returncode == 0:
        found, error = pickle.loads(done.stdout)
        if error is not None:
            raise (InputError if error[0] == InputError.exit_status else WorkError)(error[1])
        result: Found = found
        return result
    if done.returncode in (-getattr(signal, "SIGXCPU", 0), -getattr(signal, "SIGKILL", 0)):
        raise InputError(budget.source, too_long)
    raise InputError(budget.source, f"is not {kind} that can be read: its reader failed")


def serve_child() -> None:
    """Answer the one request of :func:`within_limits` on the standard streams; libraries may print meanwhile."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    function, arguments, budget, kind, module = pickle.load(sys.stdin.buffer)
    try:
        with reading(budget.source, kind):
            import_module(module)
            _limit(budget)
            found = function(*arguments)
        answer = pickle.dumps((found, None))
    except SuspensionTwinError as wrong:
        answer = pickle.dumps((None, (wrong.exit_status, str(wrong))))
    answers.write(answer)
    answers.close()
    os._exit(0)


def _limit(budget: Budget) -> None:
    """Limit the address space and the processor time of this process to what it has and what the budget gives."""
    try:
        import resource
    except ImportError:  # Windows
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    spent = used.ru_utime + used.ru_stime
    seconds = int(spent + budget.seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError), open("/proc/self/statm", "rb") as file:
        held = int(file.read().split()[0]) * resource.getpagesize()
        most = held + _COPIES * budget.allowed
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


class _Decompressor(Protocol):
    """The interface that the decompressors of zstandard, lz4 and bz2 share."""

    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, /) -> bytes: ...


_STREAMS: Final[dict[str, Callable[[], _Decompressor]]] = {
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


def inflate(compression: str, data: bytes, budget: Budget) -> tuple[bytes, bool]:
    """The decompressed bytes up to the first damage, and whether they came to a proper end.

    ``compression`` is ``zstd``, ``lz4`` or ``bz2``, or empty or ``none``; ValueError for another. Each piece is taken
    from ``budget``, uncompressed ones too, as an index may name a block a thousand times. Raises TooLarge as it goes.
    """
    if compression in ("", "none"):
        budget.take(len(data))
        return data, True
    if compression not in _STREAMS:
        raise ValueError(f"compression {compression[:20]!r} is not known")
    stream = _STREAMS[compression]()
    pieces = []
    for at in range(0, len(data), _PIECE):
        try:
            pieces.append(stream.decompress(data[at : at + _PIECE]))
        except (zstandard.ZstdError, RuntimeError, OSError, EOFError, MemoryError):
            break
        budget.take(len(pieces[-1]))
        if stream.eof:
            return b"".join(pieces), True
    return b"".join(pieces), False
