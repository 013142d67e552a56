# SPDX-License-Identifier: Apache-2.0
"""Small files in recordings that would become large: refused before memory is taken."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from format_makers import make_record3d
from little_memory import with_little_memory

from ggslam.sequences.lzfse_blocks import END, claimed_bytes

READ = "from ggslam.sequences import open_sequence; open_sequence(path).frame(3)"


def with_member(path: Path, name: str, content: bytes, way: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path) as archive:
        members = {n: archive.read(n) for n in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for n, data in {**members, name: content}.items():
            archive.writestr(n, data, way if n == name else zipfile.ZIP_STORED)
    return path


def test_depth_that_expands_to_500_mb(tmp_path: Path) -> None:
    liblzfse = pytest.importorskip("liblzfse")
    blocks = liblzfse.compress(bytes(1 << 20)).removesuffix(END)  # of all of it takes minutes
    bomb = 500 * blocks + END
    assert len(bomb) < 1 << 20
    path = with_member(make_record3d(tmp_path), "rgbd/3.depth", bomb)
    ended = with_little_memory("from ggslam.sequences import open_sequence", READ, path, 300 << 20)
    assert ended.kind == "SequenceError" and "it holds 524,288,000 bytes, at most" in ended.message
    assert ended.taken < 30 << 20


@pytest.mark.parametrize(
    ("way", "megabytes"), [(zipfile.ZIP_DEFLATED, 300), (zipfile.ZIP_LZMA, 40)], ids=["deflated", "LZMA"]
)
def test_a_member_of_an_archive_that_expands(tmp_path: Path, way: int, megabytes: int) -> None:
    path = with_member(make_record3d(tmp_path, compress=False), "rgbd/3.jpg", bytes(megabytes << 20), way)
    assert path.stat().st_size < 1 << 20
    ended = with_little_memory("from ggslam.sequences import open_sequence", READ, path, 300 << 20)
    reason = "has 314,572,800 bytes; at most" if way == zipfile.ZIP_DEFLATED else "packed by a method that is not read"
    assert ended.kind == "SequenceError" and reason in ended.message
    assert ended.taken < 30 << 20


def black_png(path: Path, side: int, rgb: bool) -> None:
    """All zero, written row by row."""
    packer, row = zlib.compressobj(9), bytes(1 + side * (3 if rgb else 1))
    rows = b"".join([packer.compress(row) for _ in range(side)]) + packer.flush()
    header = struct.pack(">IIBBBBB", side, side, 8, 2 if rgb else 0, 0, 0, 0)
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, data in ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b"")):
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))


@pytest.mark.parametrize("rgb", [True, False], ids=["RGB", "grey"])
def test_masks_of_98_megapixels(make: Callable[[str], Path], rgb: bool) -> None:
    """All ids, the doubts of an inspection, and each frame's mask: their headers are enough."""
    path = make("replica")
    for mask in (path / "semantic_instance").iterdir():
        black_png(mask, 9900, rgb)
    assert mask.stat().st_size < 300_000
    code = "inspect_sequence(opened := open_sequence(path)); opened.frame(3)"
    before = (
        "from ggslam.sequences import open_sequence; from ggslam.sequences.inspection import inspect_sequence\n"
        "open_sequence(path := Path(sys.argv[1])).frame(0, masks=False)"
    )
    ended = with_little_memory(before, code, path, 300 << 20)
    assert ended.kind == "SequenceError" and "claims 9900x9900 pixels; at most 4,000,000 are read" in ended.message
    assert ended.taken < 60 << 20


@pytest.mark.parametrize("count", [1, 100, 4095, 5000, 196_608, 2_000_000])
def test_blocks_tell_what_they_hold(count: int) -> None:
    """Of each kind: stored, LZVN, LZFSE."""
    compress = pytest.importorskip("liblzfse").compress
    random = np.random.default_rng(0)
    for data in (bytes(count), random.bytes(count), (np.arange(count) // 7).astype(np.uint8).tobytes()):
        assert claimed_bytes(compress(data)) == len(data)


@pytest.mark.parametrize("content", [b"", b"bvx-", b"bvx-\xff\xff\0\0abc", b"bvx2" + bytes(40), b"none" + bytes(20)])
def test_what_is_no_stream_of_blocks(content: bytes) -> None:
    with pytest.raises(ValueError, match="truncated|a block"):
        claimed_bytes(content)
