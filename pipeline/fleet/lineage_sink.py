"""Sends OpenLineage events to a file or a server in a thread, so that a dead sink delays nothing."""

from __future__ import annotations

import os
import queue
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from openlineage.client.event_v2 import RunEvent
    from openlineage.client.transport import Transport

__all__ = ["LineageSink"]

_WAITING = 10_000  # queued events: a fleet of a thousand could end at once; each is a few kilobytes
_TIMEOUT_S = 5.0  # default of the library
_TRIES = 3  # tries per event; after this many events lost in a row, sending stops
_ENDPOINT = "api/v1/lineage"  # OpenLineage's default, if the URL has no path


class LineageSink:
    """A thread that sends events in order.

    Args:
        target: http:// or https:// URL of an OpenLineage server (key in $OPENLINEAGE_API_KEY), or a file, to
            which a line of JSON per event is appended.
    """

    def __init__(self, target: str) -> None:
        self._transport = _transport(target)
        self._events: queue.Queue[RunEvent | None] = queue.Queue(_WAITING)
        self._lost, self._in_a_row, self._problem = 0, 0, ""
        self._thread = threading.Thread(target=self._send, name="lineage", daemon=True)
        self._thread.start()

    def emit(self, event: RunEvent) -> None:
        """Queue an event for sending; it is lost if the queue is full."""
        try:
            self._events.put_nowait(event)
        except queue.Full:
            self._lost, self._problem = self._lost + 1, self._problem or "it is too slow"

    def close(self, timeout_s: float) -> str:
        """Wait until all events are sent, at most `timeout_s`; returns the problem in words, or ""."""
        until = time.monotonic() + timeout_s
        try:
            self._events.put(None, timeout=timeout_s)
        except queue.Full:
            self._problem = self._problem or "it is too slow"
        self._thread.join(max(0.0, until - time.monotonic()))
        lost = self._lost + max(0, self._events.qsize() - 1) if self._thread.is_alive() else self._lost
        if not lost and not self._thread.is_alive():
            return ""
        return f"{lost} events were not sent: {self._problem or 'it is too slow'}"

    def _send(self) -> None:
        while (event := self._events.get()) is not None:
            if self._in_a_row >= _TRIES:
                self._lost += 1
                continue
            try:
                self._transport.emit(event)
                self._in_a_row = 0
            except Exception as err:  # noqa: BLE001 - whatever a server answers, the night goes on
                self._lost, self._in_a_row = self._lost + 1, self._in_a_row + 1
                self._problem = f"{type(err).__name__}: {err}"


def _transport(target: str) -> Transport:
    from openlineage.client.transport.file import FileConfig, FileTransport  # noqa: PLC0415 - an extra
    from openlineage.client.transport.http import HttpConfig, HttpTransport  # noqa: PLC0415

    if not target.startswith(("http://", "https://")):
        return FileTransport(FileConfig(str(Path(target).absolute()), append=True))
    parts = urlsplit(target)
    given: dict[str, Any] = {
        "url": f"{parts.scheme}://{parts.netloc}",
        "endpoint": parts.path.strip("/") or _ENDPOINT,
        "timeout": _TIMEOUT_S,
        "retry": {"total": _TRIES - 1, "backoff_factor": 0.3, "status_forcelist": [500, 502, 503, 504],
                  "allowed_methods": ["POST"]},
    }  # fmt: skip
    if key := os.environ.get("OPENLINEAGE_API_KEY"):
        given["auth"] = {"type": "api_key", "apiKey": key}
    return HttpTransport(HttpConfig.from_dict(given))
