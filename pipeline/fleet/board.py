"""Where workers write how far they are: shared memory without locks: a killed worker blocks nobody."""

from __future__ import annotations

import ctypes
from multiprocessing import get_context

__all__ = ["Board"]

_TEXT_BYTES = 48


class _Slot(ctypes.Structure):
    _fields_ = (("done", ctypes.c_int64), ("total", ctypes.c_int64), ("what", ctypes.c_char * _TEXT_BYTES))


class Board:
    """One slot per item. A reader may see a slot half-written: it is for the eye only."""

    def __init__(self, items: int) -> None:
        self._slots = get_context("spawn").RawArray(_Slot, max(items, 1))

    def write(self, index: int, done: int, total: int, what: str) -> None:
        """Say how far an item is."""
        slot = self._slots[index]
        slot.done, slot.total, slot.what = done, total, what.encode()[: _TEXT_BYTES - 1]

    def read(self, index: int) -> tuple[int, int, str]:
        """What was last written: done, total, what."""
        slot = self._slots[index]
        return slot.done, slot.total, slot.what.decode(errors="replace")
