"""Protobuf messages, decoded by mcap-protobuf-support with the schema in the MCAP."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

from pipeline.ingest.containers.reader import BYTES_AS_TEXT, PROTOBUF, Channel

__all__ = ["content_without_stamp", "frame_id_of", "parse", "stamp_ns_of"]

_LAST_S = 2**33  # beyond it nanoseconds overflow int64: a damaged number


def parse(channel: Channel, data: memoryview) -> Any:
    """Decode a message by its schema; raises ValueError if schema or bytes are invalid."""
    from google.protobuf.message import DecodeError  # noqa: PLC0415  # logs of ROS alone need no protobuf

    try:
        return _decoder(channel)(bytes(data))
    except DecodeError as err:
        raise ValueError(f"bytes do not fit the schema: {err}") from err


def stamp_ns_of(channel: Channel, data: memoryview) -> int | None:
    """The message's `timestamp`; None if it is unset or invalid, or the message is damaged."""
    try:
        stamp = parse(channel, data).timestamp
        seconds, nanoseconds = int(stamp.seconds), int(stamp.nanos)
    except (ValueError, AttributeError):
        return None
    is_time = 0 <= seconds < _LAST_S and 0 <= nanoseconds < 10**9 and seconds + nanoseconds > 0
    return seconds * 10**9 + nanoseconds if is_time else None


def frame_id_of(channel: Channel, data: memoryview) -> str:
    """The message's `frame_id`; "" if it has none."""
    return str(getattr(parse(channel, data), "frame_id", "")).lstrip("/")


def content_without_stamp(channel: Channel, data: memoryview) -> bytes:
    """Bytes that are equal for messages that differ only in their stamp."""
    message = parse(channel, data)
    message.ClearField("timestamp")
    return message.SerializeToString(deterministic=True)


@lru_cache(maxsize=64)
def _decoder(channel: Channel) -> Callable[[bytes], Any]:
    from mcap.exceptions import McapError  # noqa: PLC0415
    from mcap.records import Schema  # noqa: PLC0415
    from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415

    schema = Schema(1, channel.definition.encode(BYTES_AS_TEXT), channel.definition_format, channel.msgtype)
    try:
        decoder = DecoderFactory().decoder_for(PROTOBUF, schema)
    except (McapError, TypeError, KeyError) as err:
        raise ValueError(f"the log's schema of it cannot be used: {err}") from err
    if decoder is None:
        raise ValueError("the log carries no protobuf schema of it")
    return decoder
