"""Downloads that appear complete and checked, or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pooch

from pipeline.core.errors import DownloadError
from pipeline.core.results import Progress, silent

__all__ = ["download"]

_RETRIES: Final = 2  # after one and two seconds, from the beginning: models have 4 and 15 MB
_CHUNK_BYTES: Final = 1 << 18
_SILENCE_S: Final = 30.0  # a server that sends nothing for so long is taken for gone


def download(url: str, file: Path, size_bytes: int, sha256: str, progress: Progress = silent) -> bool:
    """Make sure that a file of this content exists; False if it already did.

    Raises:
        DownloadError: no network, no such file, or other content; the file is then not written.
    """
    if file.exists() and pooch.file_hash(str(file)) == sha256:
        return False
    pooch.get_logger().setLevel("ERROR")  # the caller shows what is downloaded
    shown = _Shown(url, size_bytes, progress)
    source = pooch.HTTPDownloader(progressbar=shown, chunk_size=_CHUNK_BYTES, timeout=_SILENCE_S)
    models = pooch.create(
        file.parent, "", registry={file.name: sha256}, urls={file.name: url}, retry_if_failed=_RETRIES
    )
    try:
        models.fetch(file.name, downloader=source)
    except (OSError, ValueError) as err:
        told = f"{err}; try again, or copy the file from another machine to {file}"
        raise DownloadError(url, told) from err
    file.chmod(0o644)  # pooch leaves it to its owner alone
    return True


class _Shown:
    """Progress bar of pooch's interface; refuses an answer that announces more bytes than are meant."""

    def __init__(self, url: str, size_bytes: int, progress: Progress) -> None:
        self.url, self.size_bytes, self.progress, self.done = url, size_bytes, progress, 0

    def _begin(self, announced_bytes: int) -> None:
        self.done = 0
        if announced_bytes > self.size_bytes:
            raise DownloadError(self.url, f"has more than {self.size_bytes:,} bytes: not the expected file")

    total = property(fset=_begin)

    def update(self, more_bytes: int) -> None:
        self.done = min(self.done + more_bytes, self.size_bytes)  # the last piece counts as a whole one
        self.progress(self.done, self.size_bytes, "bytes")

    def reset(self) -> None:
        self.done = 0

    close = reset
