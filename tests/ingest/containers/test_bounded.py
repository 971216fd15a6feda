"""Damaged and forged sizes: what is announced wrongly costs a chunk, never the machine's memory."""

import bz2
import os
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from pipeline.core.errors import LogError
from pipeline.ingest.containers import rosbag2_folder
from pipeline.ingest.containers.bounded import unpack, unpack_zstd
from pipeline.ingest.containers.reader import content_identity, open_log

CONTENT = bytes(range(256)) * 40
PACKED = {
    "zstd": zstandard.ZstdCompressor().compress(CONTENT), "lz4": lz4.frame.compress(CONTENT),
    "bz2": bz2.compress(CONTENT), "none": CONTENT, "": CONTENT,
}  # fmt: skip


@pytest.mark.parametrize("compression", PACKED)
def test_content_of_the_size_announced_comes_back_and_any_other_is_refused(compression):
    assert unpack(compression, PACKED[compression], len(CONTENT)) == CONTENT
    for size in (len(CONTENT) - 1, len(CONTENT) + 1):
        with pytest.raises(ValueError, match="announced"):
            unpack(compression, PACKED[compression], size)


def test_a_zstd_frame_is_read_up_to_the_limit_whether_its_header_has_no_size_or_another():
    frame = zstandard.ZstdCompressor(write_content_size=False).compress(CONTENT)
    assert unpack_zstd(frame, len(CONTENT)) == unpack_zstd(frame, 1 << 24) == CONTENT
    frame = bytearray(zstandard.ZstdCompressor().compress(bytes(1 << 20)))
    # Frame header (RFC 8878, 3.1.1): magic, descriptor, window or single segment, then the content size.
    at = bytes(frame).index(struct.pack("<I", 1 << 20))
    frame[at : at + 4] = struct.pack("<I", 0xFFFFFFF0)  # before memory is taken
    with pytest.raises(ValueError, match="4294967280"):
        unpack_zstd(bytes(frame), 1 << 20)


def test_a_pipe_is_named_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    for reads in (open_log, content_identity):
        with pytest.raises(LogError, match="neither a file nor a folder"):
            reads(tmp_path / "pipe.mcap")


def test_what_a_killed_process_unpacked_a_day_ago_is_removed_by_the_next_one(kit, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    ended = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True
    )
    name, ended_pid = rosbag2_folder._UNPACKED, ended.stdout.decode().strip()
    left, new, mine = (
        tmp_path / f"{name}{pid}" for pid in (f"{ended_pid}-x", f"{ended_pid}-y", f"{os.getpid()}-x")
    )
    for folder in (left, new, mine):
        folder.mkdir()
    for folder in (left, mine):
        os.utime(folder, (0, 0))
    folder = kit.Kit().drive().folder(tmp_path / "bag")
    plain = next(folder.glob("*.db3"))
    packed = Path(f"{plain}.zstd")
    packed.write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    open_log(packed).close()
    assert not left.exists()
    assert new.exists()  # another container's process may have it open
    assert mine.exists()
