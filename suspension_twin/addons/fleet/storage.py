# SPDX-License-Identifier: Apache-2.0
"""Files here and in object storage: who they are, how large, and a copy where a reader needs one.

Everything goes through ``fsspec``. A file here is identified by the SHA-256 of its bytes, an object by the checksum,
version or time that its store gives without a transfer.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from suspension_twin.errors import InputError
from suspension_twin.files import open_file, read_yaml

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem  # type: ignore[import-untyped]

__all__ = ["Outline", "identity", "is_url", "outline", "staged", "transient"]

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_CHUNK = 1 << 20
#: Bytes of one read of an object's end; the summary of a drive's MCAP has 1 to 3 kB.
_READ = 16 << 10
#: What a store gives, the best first: checksums of the content, then its version or the time of writing.
_MARKS = ("ETag", "etag", "md5Hash", "crc32c", "version_id", "VersionId", "LastModified", "mtime", "updated")
_NOT_TRANSIENT = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError, FileExistsError)
#: botocore's and aiohttp's own errors that may pass, which are not always OSErrors; neither need be installed here.
_TRANSIENT = {
    "HTTPClientError",
    "EndpointConnectionError",
    "ConnectionClosedError",
    "ClientError",
    "FSTimeoutError",
}


@dataclass(frozen=True)
class Outline:
    """Size and time of a recording, known without reading it: ``bytes``, ``start`` s since the epoch (None: not known),
    ``duration`` s (0: not known)."""

    bytes: int
    start: float | None = None
    duration: float = 0.0

    @property
    def date(self) -> str:
        """The day of the start in UTC, ``YYYY-MM-DD``; empty where it is not known."""
        if self.start is None or self.start < 1e8:  # a clock that was never set
            return ""
        return f"{datetime.fromtimestamp(self.start, tz=timezone.utc):%Y-%m-%d}"


def transient(error: BaseException) -> bool:
    """Whether an error may pass by itself: a store out of reach, a time-out, a connection that broke."""
    if isinstance(error, _NOT_TRANSIENT):
        return False
    if isinstance(error, TimeoutError | ConnectionError | EOFError):
        return True
    names = {c.__name__ for c in type(error).__mro__}
    return bool(names & _TRANSIENT) or (isinstance(error, OSError) and error.filename is None)


def is_url(name: str) -> bool:
    """Whether a name is a URL of object storage; ``file://`` is none, it names a file here."""
    return _URL.match(name) is not None and not name.startswith("file://")


@contextmanager
def _reaching(name: str) -> Iterator[None]:
    """Turn errors of a store into one line that names the file; others, which may pass, go on as they are."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(name, "No such file or directory") from None
    except PermissionError:
        raise InputError(name, "access is denied") from None
    except ImportError as error:
        raise InputError(name, f"needs a package that is not installed: {error}") from None
    except ValueError as error:
        raise InputError(name, f"cannot be opened: {error}") from None
    except Exception as error:
        if type(error).__name__ == "NoCredentialsError":
            raise InputError(name, "no credentials for this store were found") from None
        raise


class _Stored:
    """A file or folder in a store: its file system ``fs`` of fsspec, the ``path`` there, and for every file its name
    below the path with the store's facts about it; one file has the name ``""``."""

    def __init__(self, name: str) -> None:
        import fsspec  # type: ignore[import-untyped]

        self.fs, path = fsspec.core.url_to_fs(name)
        self.path = str(path)
        info = self.fs.info(self.path)
        self.files: dict[str, dict[str, object]] = {"": info}
        if info["type"] == "directory":
            found = self.fs.find(self.path, detail=True)
            if not found:
                raise FileNotFoundError(self.path)
            self.files = {str(PurePosixPath(p).relative_to(self.path)): i for p, i in found.items()}


def identity(name: str) -> str:
    """Identify the content of a file or folder.

    Parameters
    ----------
    name : str
        Path or URL.

    Returns
    -------
    str
        Hexadecimal; the same content at another place here gives the same.

    Raises
    ------
    InputError
        There is no such file, or it cannot be opened.

    Examples
    --------
    >>> len(identity("bags/bump_15kmh/twin.yaml"))
    64
    """
    whole = hashlib.sha256()
    with _reaching(name):
        if is_url(name):
            for part, info in sorted(_Stored(name).files.items()):
                marks = [(m, str(info[m])) for m in _MARKS if info.get(m) is not None] or [("", "")]
                whole.update(json.dumps([part, info.get("size"), *marks[0]]).encode())
            return whole.hexdigest()
        path = Path(name)
        if not path.exists():
            raise FileNotFoundError(name)
        for file in [p for p in sorted(path.rglob("*")) if p.is_file()] if path.is_dir() else [path]:
            whole.update(f"{'' if file == path else file.relative_to(path).as_posix()}\0".encode())
            content = hashlib.sha256()
            with open_file(file) as opened:
                while chunk := opened.read(_CHUNK):
                    content.update(chunk)
            whole.update(content.digest())
    return whole.hexdigest()


def outline(name: str) -> Outline:
    """Size and time of a recording, from a folder's ``metadata.yaml`` or the summary at the end of an MCAP file.

    Parameters
    ----------
    name : str
        Path or URL.

    Returns
    -------
    Outline
        A recording without either has its size alone.

    Raises
    ------
    InputError
        There is no such file, or it cannot be opened.

    Examples
    --------
    >>> round(outline("bags/bump_15kmh").duration)
    70
    """
    with _reaching(name):
        stored = _Stored(name)
        files, path = stored.files, stored.path
        size = sum(int(str(info.get("size") or 0)) for info in files.values())
        if "" in files and path.endswith(".mcap"):
            return Outline(size, *_times_of_mcap(stored.fs, path))
        if "metadata.yaml" in files and not is_url(name):
            return Outline(size, *_times_of_metadata(Path(path) / "metadata.yaml"))
        recording = next((part for part in files if part.endswith(".mcap")), None)
        return Outline(size, *(_times_of_mcap(stored.fs, f"{path}/{recording}") if recording else ()))


def _times_of_metadata(path: Path) -> tuple[float, float] | tuple[()]:
    """Start and duration in s; nothing where it cannot be read: the reader of the drive says why."""
    try:
        known = read_yaml(path)["rosbag2_bagfile_information"]
        start = known["starting_time"]["nanoseconds_since_epoch"]
        return int(start) * 1e-9, int(known["duration"]["nanoseconds"]) * 1e-9
    except (InputError, KeyError, TypeError, ValueError):
        return ()


def _times_of_mcap(fs: AbstractFileSystem, path: str) -> tuple[float, float] | tuple[()]:
    """Start and duration in s; nothing of a file that is cut off: it is repaired when it is read."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    with fs.open(path, "rb", block_size=_READ, cache_type="bytes") as file:
        try:
            summary = make_reader(file).get_summary()
        except (McapError, EOFError, ValueError, OverflowError):
            return ()
    statistics = None if summary is None else summary.statistics
    if statistics is None or not statistics.message_count:
        return ()
    start, end = statistics.message_start_time * 1e-9, statistics.message_end_time * 1e-9
    return start, max(end - start, 0.0)


def staged(name: str, folder: Path) -> Path:
    """Where a file or folder can be read: its own place, or a copy of an object in ``folder``.

    Parameters
    ----------
    name : str
        Path or URL.
    folder : Path
        Where copies are put.

    Returns
    -------
    Path
        The copy keeps the last part of the name.

    Raises
    ------
    InputError
        There is no such object, or the store refuses.

    Examples
    --------
    >>> staged("bags/bump_15kmh/twin.yaml", Path("copies")).name
    'twin.yaml'
    """
    if not is_url(name):
        return Path(name)
    with _reaching(name):
        stored = _Stored(name)
        copy = folder / PurePosixPath(stored.path).name
        for part in stored.files:
            if ".." in PurePosixPath(part).parts:
                raise InputError(name, part, "leads out of its folder")
            target = copy / part if part else copy
            target.parent.mkdir(parents=True, exist_ok=True)
            stored.fs.get_file(f"{stored.path}/{part}" if part else stored.path, str(target))
        return copy
