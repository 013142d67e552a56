# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps as SOG (Spatially Ordered Gaussians), version 2, PlayCanvas' compressed format for the web.

A number of each Gaussian is a byte of a pixel in lossless WebP images, all in Morton order; `meta.json` says what the
bytes mean. Positions: 16 bits of sign(x) log(1 + |x|) between the least and the most of each axis. Logarithms of sizes,
base colours and higher spherical harmonics: tables of 256 numbers; spherical harmonics are rows of a palette of up to
65536. Opacity: a byte. Quaternions wxyz: the three smallest in 8 bits each, and which was the largest.

The files are either packed in a ZIP (`.sog`) or lie beside `meta.json`. Numbers are those of the PLY: SOG's description
puts y upwards, but programs convert PLY to SOG and back without turning anything. Object ids, where they are given, are
24 bits of an image of our own and names stand in `objects` of `meta.json`; readers pass over what they do not know.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ggslam.errors import FormatError, RunFolderError
from ggslam.formats.codebooks import scalar_codebook, vector_palette
from ggslam.formats.morton import morton_order
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.atomic import make_folder, write_bytes
from ggslam.system.tuning import Tuning

META = "meta.json"
LARGEST_COUNT: Final = 16380**2
"""Most Gaussians of a file: WebP images have at most 16383 rows and columns."""
_LARGEST_ID: Final = 2**24 - 1
"""Largest object id: a pixel of the image of ids holds 24 bits."""


class SogTuning(Tuning):
    """How large a palette is."""

    min_palette = 4096
    """Fewest entries, unless there are fewer Gaussians."""
    max_palette = 65536
    """Most entries."""
    rows_per_entry = 4
    """Gaussians per entry between these limits."""


PALETTE_COLUMNS: Final = 64
"""Palette entries in a row of the image of the palette."""
_LOSSLESS = [cv2.IMWRITE_WEBP_QUALITY, 101]


def write_sog(path: str | Path, gaussians: GaussianMap, objects: Mapping[int, str] | None = None) -> int:
    """Writes a map as SOG; each file appears whole or not at all.

    Args:
        path: the file to write, or `FOLDER/meta.json` for files that are not packed.
        gaussians: at least one.
        objects: names by object id, empty where an object has none; None: no object ids are written.

    Returns:
        Bytes written.

    Raises:
        FormatError: there is no Gaussian or too many, a number is not finite, or an object id is too large.
        RunFolderError: a file cannot be written.
    """
    path = Path(path)
    columns = SplatColumns.of(path, gaussians)
    if len(columns):
        columns = columns.take(morton_order(columns.means))
    files = sog_files(path, columns, objects)
    if path.name != META:
        data = _zip_of(files)
        write_bytes(path, data)
        return len(data)
    write_sog_folder(path.parent, files)
    return sum(map(len, files.values()))


def write_sog_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes the files of `sog_files` into a folder, `meta.json` last; raises RunFolderError if one cannot be."""
    make_folder(folder)
    for name, data in files.items():
        write_bytes(folder / name, data)


def sog_files(
    path: str | Path, columns: SplatColumns, objects: Mapping[int, str] | None = None
) -> dict[str, bytes]:
    """The files of a SOG by name, `meta.json` last.

    Args:
        path: what is written; for messages.
        columns: of the Gaussians, in the order of the files.
        objects: names by object id; None: no object ids are written.

    Raises:
        FormatError, RunFolderError: as in `write_sog`.
    """
    count = len(columns)
    if not 0 < count <= LARGEST_COUNT:
        raise FormatError(f"{path}: SOG holds 1 to {LARGEST_COUNT} Gaussians, found {count}")
    images = _Images(path, count)
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "ggslam"}, "count": count, "antialias": False}
    meta["means"] = _positions(images, columns.means)
    table, labels = scalar_codebook(columns.log_scales)
    meta["scales"] = {"codebook": _numbers(table), "files": [images.add("scales.webp", labels)]}
    meta["quats"] = {"files": [images.add("quats.webp", _quaternions(columns.quaternions))]}
    table, labels = scalar_codebook(columns.sh[:, 0])
    opacity = np.rint(255 * (0.5 + 0.5 * np.tanh(0.5 * columns.logits.astype(np.float64))))
    meta["sh0"] = {"codebook": _numbers(table), "files": [images.add("sh0.webp", np.column_stack([labels, opacity]))]}
    if columns.sh.shape[1] > 1:
        meta["shN"] = _harmonics(images, columns.sh[:, 1:])
    if objects is not None:
        meta["objects"] = _objects(images, path, columns.object_id, objects)
    return {**images.files, META: json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()}


class _Images:
    """Lossless WebP images, all of the same size, with room for `count` pixels."""

    def __init__(self, path: str | Path, count: int) -> None:
        self.files: dict[str, bytes] = {}
        self._path = path
        self._width = 4 * math.ceil(math.sqrt(count) / 4)
        self._height = 4 * math.ceil(count / self._width / 4)

    def add(self, name: str, values: np.ndarray, width: int = 0, height: int = 0) -> str:
        """Puts numbers from 0 to 255, [N, 3 or 4], into the pixels of an image; returns its name."""
        width, height = width or self._width, height or self._height
        channels = values.shape[1]
        image = np.zeros((height * width, channels), np.uint8)
        image[: len(values), :3] = values[:, 2::-1]  # OpenCV has blue first
        image[: len(values), 3:] = values[:, 3:]
        done, data = cv2.imencode(".webp", image.reshape(height, width, channels), _LOSSLESS)
        if not done:
            raise RunFolderError(f"cannot write {self._path}: OpenCV does not write {name}")
        self.files[name] = data.tobytes()
        return name


def _positions(images: _Images, means: np.ndarray) -> dict[str, Any]:
    """Stores positions [N, 3]; returns their entry of `meta.json`."""
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = logs.min(0), logs.max(0)
    steps = np.rint(65535 * (logs - low) / np.where(high > low, high - low, 1.0)).astype(np.uint32)
    files = [images.add("means_l.webp", steps & 255), images.add("means_u.webp", steps >> 8)]
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": files}


def _quaternions(unit: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4] of unit length as bytes [N, 4]: three, and 252 + which is left out."""
    largest = np.abs(unit).argmax(1)
    others = unit * np.where(np.take_along_axis(unit, largest[:, None], 1) < 0, -1, 1)  # q and -q turn alike
    others = others[np.arange(4) != largest[:, None]].reshape(-1, 3)
    steps = np.rint(255 * (others.astype(np.float64) * math.sqrt(0.5) + 0.5))
    return np.column_stack([steps.clip(0, 255), 252 + largest])


def _harmonics(images: _Images, higher: np.ndarray) -> dict[str, Any]:
    """Stores the higher spherical harmonics [N, K, 3]; returns their entry of `meta.json`."""
    count, coefficients = higher.shape[:2]
    rows = np.ascontiguousarray(higher.reshape(count, -1))
    most = max(SogTuning.min_palette, count // SogTuning.rows_per_entry)
    palette, labels = vector_palette(rows, min(SogTuning.max_palette, most))
    table, entries = scalar_codebook(palette.reshape(-1, 3))
    height = math.ceil(len(palette) / PALETTE_COLUMNS)
    files = [
        images.add("shN_centroids.webp", entries, PALETTE_COLUMNS * coefficients, height),
        images.add("shN_labels.webp", _bytes_of(labels, 3)),
    ]
    bands = math.isqrt(coefficients + 1) - 1
    return {"count": len(palette), "bands": bands, "codebook": _numbers(table), "files": files}


def _objects(images: _Images, path: str | Path, ids: np.ndarray, names: Mapping[int, str]) -> dict[str, Any]:
    """Stores object ids [N]; returns their entry of `meta.json`."""
    if ids.min() < 0 or ids.max() > _LARGEST_ID:
        raise FormatError(f"{path}: object ids are 0 to {_LARGEST_ID} in SOG, found {ids.min()} to {ids.max()}")
    file = images.add("object_ids.webp", _bytes_of(ids, 3))
    return {"names": {str(number): name for number, name in names.items()}, "files": [file]}


def _bytes_of(numbers: np.ndarray, count: int) -> np.ndarray:
    """Whole numbers [N] as bytes [N, count], the lowest first."""
    return np.column_stack([numbers >> 8 * place & 255 for place in range(count)])


def _numbers(table: np.ndarray) -> list[float]:
    """Float32 numbers in as few digits as tell them apart."""
    return [float(str(number)) for number in table]


def _zip_of(files: Mapping[str, bytes]) -> bytes:
    """A ZIP of files, not compressed again, the same at any time."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data)
    return packed.getvalue()


def _write(path: Path, splats: Splats) -> str:
    size = write_sog(path, splats.whole(), splats.names)
    return splats.text(path, with_ids=True, size=size)


WRITER = Writer(
    "sog", (".sog", META), Takes.GAUSSIANS, "the same in fewer bytes, as images", _write, by_object=True
)
