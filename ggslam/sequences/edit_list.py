# SPDX-License-Identifier: Apache-2.0
"""Frames at the start of an MP4 that its edit list hides from players (ISO/IEC 14496-12).

A writer that is told to begin later than its first frame keeps that frame in the file, and lets the edit list begin
after it: the file counts one frame more than anybody who plays it gets.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ggslam.errors import SequenceError
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted


class EditListTuning(Tuning):
    """A limit on damaged videos."""

    max_table_bytes = 1 << 26
    """Largest table of a file, in bytes."""


Box = tuple[int, int]
"""Where the content of a box begins and ends in the file."""


def count_hidden_frames(path: Path) -> int:
    """Frames of the first video track that come before the beginning of its edit list; 0 without one, and for files
    that are no MP4."""
    try:
        with open_untrusted(path, SequenceError) as file:
            return _count_hidden(file, os.fstat(file.fileno()).st_size)
    except (OSError, struct.error, ValueError, SequenceError):
        return 0


def _count_hidden(file: BinaryIO, size: int) -> int:
    movie = _find(file, (0, size), b"moov")
    for track in _children(file, movie, b"trak") if movie else ():
        media = _find(file, track, b"mdia")
        if media is None or not _is_video(file, media):
            continue
        begin = _edit_begin(file, track)
        table = _find(file, media, b"minf", b"stbl")
        return 0 if begin is None or table is None else int((_presentation_times(file, table) < begin).sum())
    return 0


def _boxes(file: BinaryIO, inside: Box) -> Iterator[tuple[bytes, Box]]:
    at, end = inside
    while at + 8 <= end:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        head = 8
        if length == 1:
            length, head = struct.unpack(">Q", file.read(8))[0], 16
        elif length == 0:
            length = end - at
        if length < head:
            return
        yield kind, (at + head, min(at + length, end))
        at += length


def _children(file: BinaryIO, inside: Box, kind: bytes) -> list[Box]:
    return [box for found, box in _boxes(file, inside) if found == kind]


def _find(file: BinaryIO, inside: Box, *kinds: bytes) -> Box | None:
    """The first box on the way through `kinds`."""
    found: Box | None = inside
    for kind in kinds:
        found = next(iter(_children(file, found, kind)), None) if found else None
    return found


def _content(file: BinaryIO, box: Box) -> bytes:
    if box[1] - box[0] > EditListTuning.max_table_bytes:
        raise ValueError("impossible size")
    file.seek(box[0])
    return file.read(box[1] - box[0])


def _is_video(file: BinaryIO, media: Box) -> bool:
    handler = _find(file, media, b"hdlr")
    return handler is not None and _content(file, handler)[8:12] == b"vide"


def _edit_begin(file: BinaryIO, track: Box) -> int | None:
    """Time of the media at which its first edit begins, in the media's own unit."""
    box = _find(file, track, b"edts", b"elst")
    if box is None:
        return None
    content = _content(file, box)
    wide = content[0] == 1
    for number in range(struct.unpack(">I", content[4:8])[0]):
        entry = content[8 + number * (20 if wide else 12) :]
        begin = struct.unpack(">q", entry[8:16])[0] if wide else struct.unpack(">i", entry[4:8])[0]
        if begin >= 0:  # -1 is a pause before the beginning
            return int(begin)
    return None


def _presentation_times(file: BinaryIO, table: Box) -> np.ndarray:
    """Times of the frames in the media's unit, int64 [n], in the order in which they are stored."""
    steps = _runs(file, table, b"stts", ">u4")
    decoded = np.concatenate([[0], np.cumsum(steps)[:-1]]) if len(steps) else steps
    offsets = _runs(file, table, b"ctts", ">i4")
    return decoded + offsets if len(offsets) == len(decoded) else decoded


def _runs(file: BinaryIO, table: Box, kind: bytes, number: str) -> np.ndarray:
    """Values of a table of runs (count, value)."""
    box = _find(file, table, kind)
    if box is None:
        return np.zeros(0, np.int64)
    content = _content(file, box)
    entries = np.frombuffer(content[8 : 8 + 8 * struct.unpack(">I", content[4:8])[0]], [("n", ">u4"), ("v", number)])
    if entries["n"].sum(dtype=np.int64) > EditListTuning.max_table_bytes:
        raise ValueError("impossible count")
    return np.repeat(entries["v"].astype(np.int64), entries["n"])
