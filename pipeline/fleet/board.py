"""Progress of workers in shared memory, without locks, so that a killed worker blocks no other process."""

from __future__ import annotations

import ctypes
from multiprocessing import get_context

__all__ = ["Board"]

_TEXT_BYTES = 48


class _Slot(ctypes.Structure):
    _fields_ = (("done", ctypes.c_int64), ("total", ctypes.c_int64), ("what", ctypes.c_char * _TEXT_BYTES))


class Board:
    """One slot per item. A reader may see a half-written slot: use it for display only."""

    def __init__(self, items: int) -> None:
        self._slots = get_context("spawn").RawArray(_Slot, max(items, 1))

    def write(self, index: int, done: int, total: int, what: str) -> None:
        """Write the progress of an item."""
        slot = self._slots[index]
        slot.done, slot.total, slot.what = done, total, what.encode()[: _TEXT_BYTES - 1]

    def read(self, index: int) -> tuple[int, int, str]:
        """Last progress of an item: done, total, what."""
        slot = self._slots[index]
        return slot.done, slot.total, slot.what.decode(errors="replace")
