"""Files of a few kilobytes that would become gigabytes: each is refused by name, at once and in little memory."""

import bz2
import json
import sqlite3
import struct
import subprocess
import sys
import zlib

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard

GIB = 1 << 30
MOST_S, MOST_MIB = 1.0, 300
# What opens each file of a folder in turn; memory is that of the greediest.
_OPEN = """
import json, sys, time
from pathlib import Path
import zstandard
from pipeline.core.errors import LogError
from pipeline.ingest.containers.reader import open_log
from pipeline.ingest.messages.image import inspect_image

def peak():
    # Not ru_maxrss: a process inherits that of the one that started it.
    line = next(t for t in open("/proc/self/status") if t.startswith("VmHWM"))
    return int(line.split()[1]) >> 10

def said_of(path):
    try:
        if path.suffix == ".picture":
            inspect_image(path.read_bytes())
            return "decoded"
        log = open_log(path)
        return f"{len(list(log.scan()))} messages, {dict(log.damage)}"
    except (LogError, ValueError) as err:
        return str(err)

for path in sorted(Path(sys.argv[1]).iterdir()):
    before, began = peak(), time.process_time()
    said = said_of(path)
    print(json.dumps([path.name.removesuffix(".picture"), said, time.process_time() - began, peak() - before]))
"""


def zstd_zeros(size=GIB):
    return zstandard.ZstdCompressor().compress(bytes(size))


def mcap(compression, packed, size=GIB):
    """An MCAP file of one chunk that announces `size` bytes."""
    name = compression.encode()
    chunk = struct.pack("<QQQII", 0, 1, size, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    records = ((0x01, bytes(8)), (0x06, chunk), (0x0F, bytes(4)))
    return b"\x89MCAP0\r\n" + b"".join(struct.pack("<BQ", op, len(c)) + c for op, c in records)


def bag(compression, packed, size=GIB):
    """A ROS 1 bag of one chunk that announces `size` bytes."""

    def record(data, **fields):
        named = [n.encode() + b"=" + v for n, v in fields.items()]
        header = b"".join(struct.pack("<I", len(n)) + n for n in named)
        return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data

    head = record(b"", op=b"\x03", index_pos=bytes(8), conn_count=bytes(4), chunk_count=b"\x01\0\0\0")
    chunk = record(packed, op=b"\x05", compression=compression, size=struct.pack("<I", size))
    return b"#ROSBAG V2.0\n" + head + chunk


def db3(path, message):
    """A ROS 2 database of one message."""
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        db.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp INTEGER, data BLOB)")
        db.execute("INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/String', 'cdr')")
        db.execute("INSERT INTO messages VALUES (1, 1, 1, ?)", (message,))


def resized(ending, marker, skip, layout, *values, options=()):
    """An image of 64 x 64 pixels whose header says another size."""
    data = bytearray(cv2.imencode(ending, np.zeros((64, 64, 3), np.uint8), options)[1].tobytes())
    struct.pack_into(layout, data, data.index(marker) + skip, *values)
    return bytes(data)


def png(side=60_000):
    """A PNG that says so, its checksum right."""
    data = bytearray(resized(".png", b"IHDR", 4, ">II", side, side))
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4)
    return bytes(data)


PICTURES = {
    "webp": lambda: resized(".webp", b"VP8L", 9, "<I", 16382 | 16382 << 14, options=[cv2.IMWRITE_WEBP_QUALITY, 101]),
    "lossy webp": lambda: resized(".webp", b"VP8 ", 14, "<HH", 16383, 16383, options=[cv2.IMWRITE_WEBP_QUALITY, 50]),
    "avif": lambda: resized(".avif", b"ispe", 8, ">II", 65536, 65536),
    "jpeg 2000": lambda: resized(".jp2", b"\xff\x4f\xff\x51", 8, ">II", 60_000, 60_000),
    "png": png,
    "jpeg": lambda: resized(".jpg", b"\xff\xc0", 5, ">HH", 60_000, 60_000),
}  # fmt: skip


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """By name, what is said of each bomb, in how many seconds of CPU and MiB of memory."""
    folder = tmp_path_factory.mktemp("bombs")
    for name, make in PICTURES.items():
        (folder / f"{name}.picture").write_bytes(make())
    uniform, blocks = zstd_zeros(), bz2.compress(bytes(1 << 24)) * 16
    (folder / "chunk by zstd.mcap").write_bytes(mcap("zstd", uniform))
    (folder / "chunk by lz4.mcap").write_bytes(mcap("lz4", lz4.frame.compress(bytes(GIB >> 2))))
    (folder / "chunk by lz4.bag").write_bytes(bag(b"lz4", lz4.frame.compress(bytes(GIB >> 2))))
    (folder / "chunk by bz2.bag").write_bytes(bag(b"bz2", blocks))
    db3(folder / "message.db3", uniform)
    (folder / "whole file.zstd").write_bytes(uniform)
    (folder / "twice.zstd").write_bytes(zstandard.ZstdCompressor().compress(uniform))
    said = subprocess.run(
        [sys.executable, "-c", _OPEN, str(folder)], capture_output=True, text=True, check=True
    )
    return {name: rest for name, *rest in map(json.loads, said.stdout.splitlines())}


@pytest.mark.parametrize(
    ("bomb", "reason"),
    [
        *((name, "pixels are more than a camera has") for name in PICTURES),
        ("chunk by zstd.mcap", "'oversized_chunks': 1"),
        ("chunk by lz4.mcap", "'oversized_chunks': 1"),
        ("chunk by lz4.bag", "'oversized_chunks': 1"),
        ("chunk by bz2.bag", "'oversized_chunks': 1"),
        ("message.db3", "'oversized_rows': 1"),
        ("whole file.zstd", "unpacks to more than"),
        ("twice.zstd", "compressed twice"),
    ],
)
def test_a_bomb_is_refused_by_name_at_once_and_in_little_memory(opened, bomb, reason):
    said, cpu_s, grown_mib = opened[bomb]
    assert reason in said
    assert cpu_s < MOST_S
    assert grown_mib < MOST_MIB
