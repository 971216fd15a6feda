"""Check by the header at its start whether a message's bytes match the ROS generation that its log claims.

Both generations begin with 4 bytes (CDR's encapsulation, ROS 1's sequence number), a stamp and the frame's
name. CDR counts and writes a zero after the name, ROS 1 does not.
"""

from __future__ import annotations

import struct

from pipeline.ingest.containers.reader import PROTOBUF, Channel

__all__ = ["encoding_fault"]

_WRITTEN_BY = {"cdr": "ROS 2", "ros1": "ROS 1"}
_NAME = 16  # offset of the frame's name; its length is in the 4 bytes before
_LONGEST_NAME = 1024


def encoding_fault(channel: Channel, data: memoryview) -> str:
    """Reason why a message with a header is not in its log's encoding, and the remedy; else empty."""
    said = channel.encoding
    if said == PROTOBUF:
        return ""
    if said not in _WRITTEN_BY:
        return f"is logged as {said!r}, which is none of cdr, ros1 and protobuf: record or convert it as one of these"
    found = _written_as(data)
    if found in ("", said):
        return ""
    return (
        f"is logged as {said} ({_WRITTEN_BY[said]}), but its bytes are {found} ({_WRITTEN_BY[found]}): convert the "
        f"recording again with a tool that writes what its bytes are, as `mcap convert` does from a .bag or .db3"
    )


def _written_as(data: memoryview) -> str:
    """Encoding of the header at the start of a message; empty if undetermined."""
    if len(data) < _NAME:
        return ""
    for order, encoding in (("<", "ros1"), ("<" if data[1] & 1 else ">", "cdr")):
        length = struct.unpack_from(f"{order}I", data, _NAME - 4)[0]
        name = bytes(data[_NAME : _NAME + min(length, _LONGEST_NAME)])
        if len(name) != length or not length:
            continue
        is_ended = name.endswith(b"\0")
        if is_ended == (encoding == "cdr") and _is_text(name[: length - is_ended]):
            return encoding
    return ""


def _is_text(name: bytes) -> bool:
    return name.isascii() and name.decode("ascii").isprintable()
