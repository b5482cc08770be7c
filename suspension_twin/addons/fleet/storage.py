# SPDX-License-Identifier: Apache-2.0
"""Files here and in object storage: who they are, how large, and a copy where a reader needs one.

Everything goes through ``fsspec``. A file here is identified by the SHA-256 of its bytes, an object by the checksum,
version or time that its store gives without a transfer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
from typing import Any

from suspension_twin.addons.fleet.manifest import is_url
from suspension_twin.errors import InputError
from suspension_twin.files import read_yaml

__all__ = ["Outline", "identity", "outline", "staged", "transient"]

_CHUNK = 1 << 20
#: Bytes of one read of an object's end; the summary of a drive's MCAP has 1 to 3 kB.
_READ = 16 << 10
#: What a store gives, the best first: checksums of the content, then its version or the time of writing.
_MARKS = ("ETag", "etag", "md5Hash", "crc32c", "version_id", "VersionId", "LastModified", "mtime", "updated")
_NOT_TRANSIENT = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError, FileExistsError)


@dataclass(frozen=True)
class Outline:
    """What a recording holds, known without reading it: ``bytes``, ``start`` s since the epoch (None: not known),
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
    # botocore's and aiohttp's own, which are not always OSErrors; neither need be installed here.
    known = {
        "HTTPClientError",
        "EndpointConnectionError",
        "ConnectionClosedError",
        "ClientError",
        "FSTimeoutError",
    }
    return bool(names & known) or (isinstance(error, OSError) and error.filename is None)


@contextmanager
def _reaching(name: str) -> Iterator[None]:
    """One line for what is wrong with a name; what may pass by itself goes on as it is."""
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


def _opened(name: str) -> tuple[Any, str]:
    import fsspec  # type: ignore[import-untyped]

    fs, path = fsspec.core.url_to_fs(name)
    return fs, str(path)


def _files(fs: Any, path: str) -> dict[str, dict[str, Any]]:
    """Name below ``path`` and what the store says of every file; one file has the name ``""``."""
    info = fs.info(path)
    if info["type"] != "directory":
        return {"": info}
    found = fs.find(path, detail=True)
    if not found:
        raise FileNotFoundError(path)
    base = PurePosixPath(path)
    return {str(PurePosixPath(p).relative_to(base)): i for p, i in found.items()}


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
        if not is_url(name):
            path = Path(name)
            if not path.exists():
                raise FileNotFoundError(name)
            files = [p for p in sorted(path.rglob("*")) if p.is_file()] if path.is_dir() else [path]
            for file in files:
                whole.update(f"{'' if file == path else file.relative_to(path).as_posix()}\0".encode())
                whole.update(_sha(file))
            return whole.hexdigest()
        fs, path_there = _opened(name)
        for part, info in sorted(_files(fs, path_there).items()):
            marks = {m: str(info[m]) for m in _MARKS if info.get(m) is not None}
            mark = next(iter(marks.items()), ("", ""))
            whole.update(json.dumps([part, info.get("size"), *mark]).encode())
    return whole.hexdigest()


def _sha(path: Path) -> bytes:
    found = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            found.update(chunk)
    return found.digest()


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
        fs, path = _opened(name)
        files = _files(fs, path)
        size = sum(int(info.get("size") or 0) for info in files.values())
        if "" in files and path.endswith(".mcap"):
            return _of_mcap(fs, path, size)
        if "metadata.yaml" in files and not is_url(name):
            return _of_metadata(Path(path) / "metadata.yaml", size)
        recordings = [part for part in files if part.endswith(".mcap")]
        if recordings:
            return _of_mcap(fs, f"{path}/{recordings[0]}", size)
        return Outline(size)


def _of_metadata(path: Path, size: int) -> Outline:
    try:
        known = read_yaml(path)["rosbag2_bagfile_information"]
        start = known["starting_time"]["nanoseconds_since_epoch"]
        return Outline(size, int(start) * 1e-9, int(known["duration"]["nanoseconds"]) * 1e-9)
    except (
        InputError,
        KeyError,
        TypeError,
        ValueError,
    ):  # the reader of the drive says what is wrong with it
        return Outline(size)


def _of_mcap(fs: Any, path: str, size: int) -> Outline:
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    with fs.open(path, "rb", block_size=_READ, cache_type="bytes") as file:
        try:
            summary = make_reader(file).get_summary()
        except (McapError, EOFError, ValueError, OverflowError):
            return Outline(size)  # cut off: what can be saved is read when its turn comes
    statistics = None if summary is None else summary.statistics
    if statistics is None or not statistics.message_count:
        return Outline(size)
    start, end = statistics.message_start_time * 1e-9, statistics.message_end_time * 1e-9
    return Outline(size, start, max(end - start, 0.0))


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
        fs, path = _opened(name)
        base = PurePosixPath(path).name
        for part in _files(fs, path):
            if ".." in PurePosixPath(part).parts:
                raise InputError(name, part, "leads out of its folder")
            target = folder / base / part if part else folder / base
            target.parent.mkdir(parents=True, exist_ok=True)
            fs.get_file(f"{path}/{part}" if part else path, str(target))
        return folder / base
