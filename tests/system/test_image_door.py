# SPDX-License-Identifier: Apache-2.0
"""The decoder of pictures counts before it decodes."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from little_memory import with_little_memory

from ggslam.errors import FormatError, MemoryFullError, RunFolderError
from ggslam.system.images import PNG_SIGNATURE, PictureLimits, claimed_size, decode_image, read_picture
from ggslam.system.opencv import opencv_errors

PICTURE = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def flat_png(width: int, height: int) -> bytes:
    """A whole black picture, as small as deflating makes it: pieces of zeros are all alike, so one is packed."""
    size, piece = (1 + 3 * width) * height, 1 << 22

    def pack(count: int, way: int) -> bytes:
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        return packer.compress(bytes(count)) + packer.flush(way)

    pieces = pack(piece, zlib.Z_FULL_FLUSH) * (size // piece) + pack(size % piece, zlib.Z_FINISH)
    adler = struct.pack(">HH", size % 65521, 1)  # of zeros
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (b"IHDR", head), (b"IDAT", b"\x78\xda" + pieces + adler), (b"IEND", b"")
    return PNG_SIGNATURE + b"".join(png_chunk(*part) for part in parts)


def test_the_bomb_is_a_picture() -> None:
    image = cv2.imdecode(np.frombuffer(flat_png(2000, 1500), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None and image.shape == (1500, 2000, 3) and not image.any()


def encoded(ending: str, *options: int) -> bytes:
    done, data = cv2.imencode(ending, PICTURE[..., ::-1], options)
    assert done
    return data.tobytes()


def test_a_picture_comes_back_as_it_was_written(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encoded(".png"))
    assert np.array_equal(read_picture(tmp_path / "a.png"), PICTURE)
    assert np.array_equal(read_picture(tmp_path / "a.png", 64 * 48), PICTURE)


@pytest.mark.parametrize(
    ("ending", "options"),
    [
        (".png", ()), (".jpg", ()), (".jpg", (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)),
        (".webp", (cv2.IMWRITE_WEBP_QUALITY, 80)), (".webp", (cv2.IMWRITE_WEBP_QUALITY, 101)),
    ],
)  # fmt: skip
def test_the_size_is_read_from_the_header(ending: str, options: tuple[int, ...]) -> None:
    content = encoded(ending, *options)
    assert claimed_size(content) == (64, 48)
    with pytest.raises(FormatError, match=r"x: claims 64x48 pixels; at most 3,071 are read"):
        decode_image("x", content, cv2.IMREAD_COLOR, 64 * 48 - 1)


@pytest.mark.parametrize("hidden", [b"\xff\x01", b"\xff\xd0", b"\xff\xff"], ids=["TEM", "RST0", "padding"])
def test_markers_without_a_length_do_not_hide_the_size(hidden: bytes) -> None:
    """They would lead a reader that skips by lengths past the header, which the decoder finds."""
    content = encoded(".jpg")
    assert claimed_size(content[:2] + hidden + content[2:]) == (64, 48)


@pytest.mark.parametrize("content", [b"", b"II*\0" + bytes(60), b"GIF89a" + bytes(60), b"P6 9 9 255 ",
                                     PNG_SIGNATURE + bytes(40), b"\xff\xd8" + bytes(40), encoded(".bmp")])  # fmt: skip
def test_what_tells_no_size_is_not_decoded(content: bytes) -> None:
    assert claimed_size(content) is None
    with pytest.raises(FormatError, match="no size"):
        decode_image("x", content, cv2.IMREAD_COLOR)


@pytest.mark.parametrize(
    ("size", "most"),
    [((30000, 29000), PictureLimits.max_pixels), ((9000, 9000), 3 * 100 * 3 * 80)],
    ids=["any", "of a known size"],
)
def test_a_bomb_takes_no_memory(tmp_path: Path, size: tuple[int, int], most: int) -> None:
    """2.6 GB or 240 MB of pixels in at most 3 MB: within 100 MB of address space, less than 20 MB are taken."""
    path = tmp_path / "bomb.png"
    path.write_bytes(flat_png(*size))
    assert path.stat().st_size < 3 << 20
    ended = with_little_memory(
        "from ggslam.system.images import read_picture", f"read_picture(path, {most})", path, 100 << 20
    )
    assert (ended.kind, ended.exit_code) == ("FormatError", 2)
    assert f"claims {size[0]}x{size[1]} pixels; at most {most:,} are read" in ended.message
    assert ended.taken < 20 << 20


def test_full_memory_is_no_fault_of_the_picture(tmp_path: Path) -> None:
    """A picture within the limits, and less memory than its pixels take."""
    path = tmp_path / "a.png"
    path.write_bytes(flat_png(6000, 6000))
    ended = with_little_memory("from ggslam.system.images import read_picture", "read_picture(path)", path, 60 << 20)
    assert (ended.kind, ended.exit_code) == ("MemoryFullError", 1)
    assert ended.message.startswith(f"{path}: memory is full: ")
    with pytest.raises(MemoryFullError), opencv_errors("x", FormatError):
        raise_no_memory()


def raise_no_memory() -> None:
    error = cv2.error("Insufficient memory")
    error.code = cv2.Error.StsNoMem
    raise error


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "text", "cut off"])
def test_what_is_no_picture_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.png"
    {
        "pipe": lambda: os.mkfifo(path), "device": lambda: path.symlink_to("/dev/zero"), "folder": path.mkdir,
        "text": lambda: path.write_text("mine"), "cut off": lambda: path.write_bytes(encoded(".png")[:-20]),
    }[kind]()  # fmt: skip
    reason = {"text": "expected a PNG or JPEG", "cut off": "truncated"}.get(kind, "not a regular file")
    with pytest.raises(RunFolderError, match=reason):
        read_picture(path, error=RunFolderError)
