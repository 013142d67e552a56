# SPDX-License-Identifier: Apache-2.0
"""Reads SOG, version 2: packed (`.sog`), beside `meta.json`, and the finest level of a streamed one; `sog` describes
the format and writes it.

Nothing is decoded before it is known how large it gets: an image has to have about as many pixels as there are
Gaussians, which its first bytes tell.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.compressed_ply_reading import quaternions_of_smallest
from ggslam.formats.gaussian_usd import USD_ENDINGS
from ggslam.formats.sog import LARGEST_COUNT, META, PALETTE_COLUMNS
from ggslam.formats.splat_columns import SplatColumns, check_count
from ggslam.formats.splat_reader import read_whole
from ggslam.formats.splat_repair import columns_of, logits_of
from ggslam.system.images import claimed_size, decode_image
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import FileTuning, is_plain_name, member, read_untrusted
from ggslam.system.zip_files import ZIP_DAMAGE, open_zip, read_member

LEVELS = "lod-meta.json"
"""Index of a streamed SOG."""


class SogLimitTuning(Tuning):
    """A limit on damaged files."""

    max_spare_pixels = 1 << 20
    """Pixels that an image may have beyond twice those that are needed."""


_DAMAGE = (*ZIP_DAMAGE, KeyError, IndexError, TypeError, RecursionError)
Files = Callable[[str, int], bytes]
"""Gives a file by name, of at most so many bytes."""


def read_sog(path: Path) -> tuple[SplatColumns, dict[int, str] | None]:
    """The Gaussians of a `.sog`, or of a `meta.json` with its images, and the names of objects by id (None: the file
    knows of no objects).

    Raises:
        FormatError: it is damaged, of another version, or not what it says.
    """
    try:
        if path.name.lower() == META:
            return _decode(lambda name, limit: read_untrusted(member(path.parent, _plain(name)), limit))
        with open_zip(path) as archive:
            inner = {Path(info.filename).name: info for info in archive.infolist()}

            return _decode(lambda name, limit: read_member(archive, inner[_plain(name)], limit))
    except FormatError as error:
        raise (error if str(path) in str(error) else FormatError(f"{path}: {error}")) from None
    except _DAMAGE as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else f"{error}"
        raise FormatError(f"{path}: not a SOG that can be read: {reason}") from None


def read_streamed_sog(path: Path) -> tuple[SplatColumns, dict[int, str] | None]:
    """The finest level of a streamed SOG, of which `path` is the index; see `read_sog`."""
    try:
        index = json.loads(read_untrusted(path, FileTuning.max_text_bytes))
        pieces: set[tuple[int, int, int]] = set()
        waiting = [index["tree"]]
        while waiting:
            node = waiting.pop()
            waiting += node.get("children") or []
            if "lods" in node:
                finest = node["lods"][min(node["lods"], key=int)]
                pieces.add((int(finest["file"]), int(finest.get("offset", 0)), int(finest["count"])))
        files = [member(path.parent, str(name)) for name in index["filenames"]]
        used = [files[number] for number in sorted({piece[0] for piece in pieces})]
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        raise FormatError(f"{path}: not the index of a streamed SOG: {error!r}") from None
    if len(set(used)) < len(used):
        raise FormatError(f"{path}: names a file twice")
    found = dict(zip(sorted({piece[0] for piece in pieces}), map(read_sog, used), strict=True))
    if sum(count for _, _, count in pieces) > sum(len(columns) for columns, _ in found.values()):
        raise FormatError(f"{path}: names more Gaussians than are in its files")
    parts = [found[file][0].take(np.arange(start, start + count)) for file, start, count in sorted(pieces)
             if start >= 0 and start + count <= len(found[file][0])]  # fmt: skip
    if len(parts) < len(pieces) or not parts:
        raise FormatError(f"{path}: names Gaussians that are not in its files")
    names = [name for _, name in found.values() if name is not None]
    return SplatColumns.join(parts), {k: v for name in names for k, v in name.items()} if names else None


def _decode(read: Files) -> tuple[SplatColumns, dict[int, str] | None]:
    meta = json.loads(read(META, FileTuning.max_text_bytes))
    if meta.get("version") != 2:
        raise ValueError(f"version {meta.get('version', 1)}, expected 2")
    count = int(meta["count"])
    if not 0 < count <= LARGEST_COUNT:
        raise ValueError(f"it claims {count} Gaussians")
    # Positions hardly pack; the other images may be of one colour.
    check_count(count, 8 * sum(len(read(str(name), FileTuning.max_image_bytes)) for name in meta["means"]["files"][:2]))

    def pixels(part: str, number: int = 0, size: int = count) -> np.ndarray:
        return _pixels(read(str(meta[part]["files"][number]), FileTuning.max_image_bytes), size)

    quats = pixels("quats")
    if quats[:, 3].min(initial=255) < 252:
        raise ValueError("quaternions do not mark the number that is left out")
    three = (quats[:, :3] / 255 - 0.5) * math.sqrt(2)
    base, table = pixels("sh0"), _table(meta, "sh0")
    sh = [table[base[:, :3]][:, None]]
    if "shN" in meta:
        sh.append(_harmonics(meta["shN"], _table(meta, "shN"), pixels))
    means = _positions(meta["means"], pixels("means"), pixels("means", 1))
    ids, names = None, None
    if "objects" in meta:
        ids = pixels("objects") @ np.array([1, 1 << 8, 1 << 16, 0])
        names = {int(number): str(name) for number, name in meta["objects"]["names"].items()}
    columns = columns_of(
        means, _table(meta, "scales")[pixels("scales")[:, :3]], quaternions_of_smallest(three, quats[:, 3] - 252),
        logits_of(base[:, 3] / 255), np.concatenate(sh, 1), ids,
    )  # fmt: skip
    return columns, names


def _positions(meta: Any, low_bytes: np.ndarray, high_bytes: np.ndarray) -> np.ndarray:
    low, high = np.array(meta["mins"], np.float64), np.array(meta["maxs"], np.float64)
    if low.shape != (3,) or high.shape != (3,):
        raise ValueError("positions have no corners")
    logs = low + (high - low) * ((high_bytes << 8 | low_bytes)[:, :3] / 65535)
    with np.errstate(over="ignore"):
        return np.sign(logs) * np.expm1(np.abs(logs))


def _harmonics(meta: Any, table: np.ndarray, pixels: Callable[..., np.ndarray]) -> np.ndarray:
    """float64 [N, K, 3]."""
    coefficients, entries = {1: 3, 2: 8, 3: 15}[int(meta["bands"])], int(meta["count"])
    if not 0 < entries <= 1 << 16:
        raise ValueError(f"a palette of {entries} colours")
    rows = PALETTE_COLUMNS * coefficients * math.ceil(entries / PALETTE_COLUMNS)
    palette = table[pixels("shN", 0, rows)[: entries * coefficients, :3]].reshape(entries, coefficients, 3)
    labels = pixels("shN", 1)
    return palette[labels[:, 0] | labels[:, 1] << 8]


def _table(meta: Any, part: str) -> np.ndarray:
    table = np.array(meta[part]["codebook"], np.float64)
    if table.shape != (256,):
        raise ValueError(f"the table of {part} has not 256 numbers")
    return table


def _pixels(data: bytes, count: int) -> np.ndarray:
    """The first pixels of a WebP image, row by row, RGBA int64 [count, 4]."""
    size = claimed_size(data)
    if size is None or data[12:16] not in (b"VP8L", b"VP8X"):
        raise ValueError("no WebP image that is lossless")
    if not count <= size[0] * size[1] <= 2 * count + SogLimitTuning.max_spare_pixels:
        raise ValueError(f"an image of {size[0]}x{size[1]} pixels for {count} numbers")
    image = decode_image("WebP", data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 3 or image.dtype != np.uint8:
        raise ValueError("an image that is not of colours")
    rgba = cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGBA)
    return rgba.reshape(-1, 4)[:count].astype(np.int64)


def _plain(name: str) -> str:
    if not is_plain_name(name):
        raise ValueError(f"names a file {name!r}")
    return name


def _is_sog(path: Path, head: bytes) -> bool:
    if path.name.lower() == META or path.suffix.lower() == ".sog":
        return True
    return path.suffix.lower() not in USD_ENDINGS and head[:2] == b"PK" and _is_zip_with_meta(path)


def _is_zip_with_meta(path: Path) -> bool:
    try:
        with open_zip(path) as archive:
            return any(name.lower().endswith(META) for name in archive.namelist())
    except (*ZIP_DAMAGE, FormatError):
        return False


READER = read_whole("SOG", _is_sog, read_sog, (META,))
STREAMED = read_whole("streamed SOG", lambda path, head: path.name.lower() == LEVELS, read_streamed_sog, (LEVELS,))
