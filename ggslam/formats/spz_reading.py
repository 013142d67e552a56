# SPDX-License-Identifier: Apache-2.0
"""Reads SPZ (Niantic) of versions 1 to 4; no package is needed but for version 4 zstandard.

github.com/nianticlabs/spz: a header of 16 bytes and, one attribute after the other, positions (24 bits with a binary
point; version 1: float16), opacities, base colours, logarithms of sizes, quaternions (versions 1 and 2: x y z in
bytes; 3 and 4: the three smallest) and higher harmonics. Versions 1 to 3 are one gzip stream. Version 4 has a table of
zstd frames, one for each attribute. y is upwards and z backwards.

The flag `antialiased` says that a renderer has to make Gaussians more transparent by what its low-pass filter widens
them in the image, as Mip-Splatting does. How much that is depends on the view, so no opacity in the file can be right
for all: it is read as it is, which is right from nearby, and named.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.compressed_ply_reading import quaternions_of_smallest
from ggslam.formats.optional_package import package_for
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_reader import read_whole
from ggslam.formats.splat_repair import columns_of, logits_of
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted, read_untrusted

MAGIC = b"NGSP"
_HEADER: Final = 16
"""Bytes of SPZ's header."""
_ANTIALIASED: Final = 1
"""Bit of the header's flags."""
_FLAGS: Final = 14
"""Where they are in the header, of every version."""
_COLOR_SCALE: Final = 0.15
"""SPZ's factor of colours before they are rounded to bytes."""


class SpzTuning(Tuning):
    """Limits on damaged files."""

    max_expanded_bytes = 64 << 20
    """Bytes that a file of any size may expand to."""
    max_ratio = 64
    """Largest expansion of larger files."""
    head_bytes = 4096
    """Bytes of a file that its header is looked for in."""


def read_spz(path: Path) -> SplatColumns:
    """The Gaussians of a file, turned so that y is down and z forward.

    Raises:
        FormatError: it is damaged, of another version, or expands to more than it may.
        MissingDependency: it is of version 4, and zstandard is not installed.
    """
    return spz_columns(path, read_untrusted(path))


def spz_columns(path: Path, data: bytes) -> SplatColumns:
    """The Gaussians of the bytes of a file; see `read_spz`."""
    try:
        version, count, degree, fraction, streams = _unpack(path, data)
        columns = _columns(version, count, degree, fraction, streams)
    except (ValueError, struct.error, zlib.error, IndexError, OverflowError) as error:
        raise FormatError(f"{path}: not an SPZ that can be read: {error}") from None
    columns.turn_upright()
    return columns


def _widths(version: int, degree: int) -> list[int]:
    """Bytes of each attribute of a Gaussian."""
    return [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1)]


def _unpack(path: Path, data: bytes) -> tuple[int, int, int, int, list[bytes]]:
    """Version, number of Gaussians, degree, bits behind the point, and the attributes' bytes."""
    if data[:4] == MAGIC:
        return _unpack_frames(path, data)
    head = zlib.decompressobj(31).decompress(data, _HEADER)
    magic, version, count, degree, fraction = struct.unpack_from("<4sIIBB", head)
    if magic != MAGIC or not 1 <= version <= 3:
        raise ValueError(f"it begins with {magic!r}, version {version}")
    widths = _checked_widths(version, count, degree, len(data))
    size = _HEADER + count * sum(widths)
    body = zlib.decompressobj(31).decompress(data, size)
    if len(body) < size:
        raise ValueError(f"{len(body)} bytes for {count} Gaussians, which take {size}")
    ends = _HEADER + count * np.cumsum(widths)
    return version, count, degree, fraction, [body[e - count * w : e] for e, w in zip(ends, widths, strict=True)]


def _unpack_frames(path: Path, data: bytes) -> tuple[int, int, int, int, list[bytes]]:
    version, count, degree, fraction, _, frames, table = struct.unpack_from("<4xIIBBBBI", data)
    if version != 4:
        raise ValueError(f"version {version}, expected 1 to 4")
    widths = [width for width in _checked_widths(version, count, degree, len(data)) if width]
    if frames < len(widths):
        raise ValueError(f"{frames} attributes, expected {len(widths)}")
    decoder = package_for(path, "zstandard", "splats", verb="read").ZstdDecompressor()
    streams, start = [], table + 16 * frames
    for number, width in enumerate(widths):
        packed, size = struct.unpack_from("<QQ", data, table + 16 * number)
        frame = data[start : start + packed]
        if size != width * count or len(frame) < packed:
            raise ValueError(f"attribute {number} has {size} bytes, expected {width * count}")
        streams.append(_expand(decoder, frame, size))
        start += packed
    return version, count, degree, fraction, streams + [b""] * (6 - len(streams))


def _expand(decoder: object, frame: bytes, size: int) -> bytes:
    """A zstd frame of so many bytes; more are not made."""
    with decoder.stream_reader(frame) as reader:  # type: ignore[attr-defined]
        out = bytearray()
        try:
            while len(out) <= size and (more := reader.read(size + 1 - len(out))):
                out += more
        except MemoryError:
            raise
        except Exception as error:  # zstandard's own class, which is not there without the package
            raise ValueError(f"zstandard: {error}") from None
    if len(out) != size:
        raise ValueError(f"an attribute has not the {size} bytes that it claims")
    return bytes(out)


def _checked_widths(version: int, count: int, degree: int, held: int) -> list[int]:
    if degree > 3:
        raise ValueError(f"harmonics of degree {degree}, expected 0 to 3")
    widths = _widths(version, degree)
    if count * sum(widths) > max(SpzTuning.max_expanded_bytes, SpzTuning.max_ratio * held):
        raise ValueError(f"it claims {count} Gaussians, which {held:,} bytes cannot hold")
    return widths


def _columns(version: int, count: int, degree: int, fraction: int, streams: list[bytes]) -> SplatColumns:
    positions, opacities, colors, sizes, rotations, higher = (np.frombuffer(stream, "u1") for stream in streams)
    if version == 1:
        means = positions.view("<f2").astype(np.float64).reshape(count, 3)
    else:
        parts = positions.reshape(count, 3, 3).astype(np.int32)
        whole = (parts[..., 2] << 24 | parts[..., 1] << 16 | parts[..., 0] << 8) >> 8  # signed
        means = whole / float(1 << fraction)
    sh = np.concatenate([
        ((colors.reshape(count, 1, 3) / 255 - 0.5) / _COLOR_SCALE),
        (higher.reshape(count, (degree + 1) ** 2 - 1, 3) - 128.0) / 128,
    ], 1)  # fmt: skip
    turns = _first_three(rotations.reshape(count, 3)) if version < 3 else _smallest_three(rotations.view("<u4"))
    return columns_of(means, sizes.reshape(count, 3) / 16 - 10, turns, logits_of(opacities / 255), sh)


def _first_three(xyz: np.ndarray) -> np.ndarray:
    """Quaternions wxyz of the bytes x y z; w is not negative."""
    three = xyz / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - np.square(three).sum(1)))
    return np.column_stack([w, three])


def _smallest_three(words: np.ndarray) -> np.ndarray:
    """Quaternions wxyz: the largest of x y z w in the two highest bits, the others in a sign and 9 bits each."""
    shares = np.stack([(words >> shift & 511) / 511 * np.where(words >> shift + 9 & 1, -1, 1)
                       for shift in (20, 10, 0)], 1)  # fmt: skip
    return np.roll(quaternions_of_smallest(shares * np.sqrt(0.5), words >> 30), 1, axis=1)


def _notes(path: Path) -> list[str]:
    with open_untrusted(path) as file:
        head = file.read(SpzTuning.head_bytes)
    if head[:4] != MAGIC:
        head = zlib.decompressobj(31).decompress(head, _HEADER)
    if len(head) <= _FLAGS or not head[_FLAGS] & _ANTIALIASED:
        return []
    return ["antialiased: it is made for renderers that take from opacities what their low-pass filter adds to sizes; "
            "here small and far Gaussians look bolder"]  # fmt: skip


READER = read_whole(
    "SPZ", lambda path, head: path.suffix.lower() == ".spz" or head[:4] == MAGIC, read_spz, notes=_notes
)
