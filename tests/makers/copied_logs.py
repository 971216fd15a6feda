"""Copies of MCAP logs with some messages changed, left out, or with an early end."""

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer


def copy_log(source, target, change):
    """Copy a log with the data that `change(topic, type, data)` returns; None leaves a message out.

    The copy ends where `change` raises StopIteration.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with source.open("rb") as log, target.open("wb") as copy:
        writer, channels = Writer(copy, chunk_size=4 << 20, compression=CompressionType.LZ4), {}
        writer.start(profile="ros2", library="tests")
        for schema, channel, message in make_reader(log).iter_messages():
            try:
                data = change(channel.topic, schema.name, message.data)
            except StopIteration:
                break
            if data is None:
                continue
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                about = (channel.topic, channel.message_encoding, kind, channel.metadata)
                channels[channel.id] = writer.register_channel(*about)
            writer.add_message(
                channels[channel.id], message.log_time, data, message.publish_time, message.sequence
            )
        writer.finish()
    return target
