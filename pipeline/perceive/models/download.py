"""Downloads that appear complete and checked, or not at all, and resume."""

from __future__ import annotations

import fcntl
import hashlib
import http.client
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import IO, Final

from pipeline.core.errors import DownloadError
from pipeline.core.results import Progress, silent

__all__ = ["download"]

_TRIES: Final = 3
_CHUNK_BYTES: Final = 1 << 18
_SILENCE_S: Final = 30.0  # a server that sends nothing for so long is taken for gone
_OK, _PARTIAL, _RANGE_NOT_SATISFIABLE = 200, 206, 416


def download(
    url: str,
    file: Path,
    size_bytes: int,
    sha256: str,
    progress: Progress = silent,
    *,
    pause_s: float = 1.0,
) -> bool:
    """Make sure that a file of this content exists; False if it already did.

    A partial download is kept as `.NAME.part` until it is whole and has the right hash. It is resumed three
    times here, after `pause_s` and twice as long each time, and by the next call; servers without ranges send
    all of it again.

    Raises:
        DownloadError: no network, no such file, or other content; the file is then not written.
    """
    if file.exists() and _digest(file) == sha256:
        return False
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.parent / f".{file.name}.part"
    with part.open("ab") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as err:
            raise DownloadError(url, f"another process downloads {file} at this moment") from err
        if file.exists() and _digest(file) == sha256:  # by a process that just ended
            return False
        try:
            _complete(url, stream, size_bytes, progress, pause_s)
        except DownloadError as err:
            if not stream.tell():
                part.unlink()
            told = f"{err.problem}; or copy the file from another machine to {file}, and call again"
            raise DownloadError(url, told) from err
        found = _digest(part)
        if found != sha256:
            part.unlink()
            told = (
                f"its sha256 is {found}, not {sha256}: this is not the file of this release; nothing was kept"
            )
            raise DownloadError(url, told)
        part.replace(file)
    return True


def _complete(url: str, stream: IO[bytes], size_bytes: int, progress: Progress, pause_s: float) -> None:
    """Append to a part until it has its size."""
    for attempt in range(_TRIES):
        if stream.tell() == size_bytes:
            return
        try:
            _append(url, stream, size_bytes, progress)
        except urllib.error.HTTPError as err:
            if err.code == _RANGE_NOT_SATISFIABLE:
                _empty(stream)
            elif err.code < http.client.INTERNAL_SERVER_ERROR:  # another try would get the same answer
                raise DownloadError(url, f"the server answers {err.code} {err.reason}") from err
            problem = f"the server answers {err.code} {err.reason}"
        except (OSError, http.client.HTTPException) as err:
            problem = f"no connection: {getattr(err, 'reason', None) or err}"
        else:
            problem = "the server closed the connection early"
        if stream.tell() != size_bytes and attempt < _TRIES - 1:
            time.sleep(pause_s * 2**attempt)
    if stream.tell() != size_bytes:
        came = f"; {stream.tell():,} of {size_bytes:,} bytes were received, and the next call continues from there"
        raise DownloadError(url, problem + (came if stream.tell() else ""))


def _append(url: str, stream: IO[bytes], size_bytes: int, progress: Progress) -> None:
    """Download from the part's end on; from the beginning if the server has no ranges."""
    asked = urllib.request.Request(url, headers={"User-Agent": "boresight"})  # noqa: S310 - see download
    if stream.tell():
        asked.add_header("Range", f"bytes={stream.tell()}-")
    with urllib.request.urlopen(asked, timeout=_SILENCE_S) as answer:  # noqa: S310
        start = f"bytes {stream.tell()}-"
        if answer.status != _PARTIAL or not answer.headers.get("Content-Range", "").startswith(start):
            _empty(stream)
            if answer.status != _OK:
                return
        while block := answer.read1(_CHUNK_BYTES):
            if stream.tell() + len(block) > size_bytes:
                _empty(stream)
                raise DownloadError(url, f"more than {size_bytes:,} bytes come: another file than is meant")
            stream.write(block)
            stream.flush()
            progress(stream.tell(), size_bytes, "bytes")


def _empty(stream: IO[bytes]) -> None:
    stream.seek(0)
    stream.truncate()


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
