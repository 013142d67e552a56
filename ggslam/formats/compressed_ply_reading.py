# SPDX-License-Identifier: Apache-2.0
"""Reads PlayCanvas' compressed PLY; `compressed_ply` describes the layout and writes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.compressed_ply import CHUNK, levels_of_steps
from ggslam.formats.ply import read_ply
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_reader import properties_of_ply, read_whole
from ggslam.formats.splat_repair import columns_of, logits_of
from ggslam.scene.gaussian_map import SH_C0

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
"""Properties of `vertex` by which such a file is known."""
_ROOT_2 = float(np.sqrt(2.0))


def read_compressed_ply(path: Path) -> SplatColumns:
    """The Gaussians of a file.

    Raises:
        FormatError: it is damaged, or elements or properties are missing.
    """
    elements = read_ply(path).elements
    vertex, chunk = (_rows(path, elements, name) for name in ("vertex", "chunk"))
    words = {name: _column(path, vertex, name).astype(np.uint32) for name in PACKED}
    if len(chunk) < -(-len(vertex) // CHUNK):
        raise FormatError(f"{path}: {len(chunk)} chunks are too few for {len(vertex)} Gaussians of {CHUNK} each")
    own = chunk[np.arange(len(vertex)) // CHUNK]
    means = _between(path, own, "x y z", _shares(words["packed_position"], (11, 10, 11)))
    log_scales = _between(path, own, "scale_x scale_y scale_z", _shares(words["packed_scale"], (11, 10, 11)))
    rgba = _shares(words["packed_color"], (8, 8, 8, 8))
    colors = rgba[:, :3]
    if "min_r" in (chunk.dtype.names or ()):  # the first files had none
        colors = _between(path, own, "r g b", colors)
    base = ((colors - 0.5) / SH_C0)[:, None]
    sh = np.concatenate([base, _harmonics(path, elements.get("sh"), len(vertex))], 1)
    return columns_of(means, log_scales, _quaternions(words["packed_rotation"]), logits_of(rgba[:, 3]), sh)


def quaternions_of_smallest(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] of unit length of which the three others, [N, 3] in their order, and the place of the largest,
    whole numbers from 0 to 3 [N], are known; the largest is not negative."""
    others = np.arange(4) != largest[:, None]
    out = np.zeros((len(three), 4))
    out[others] = three.ravel()
    out[~others] = np.sqrt(np.maximum(0.0, 1.0 - np.square(three).sum(1)))
    return out


def _quaternions(words: np.ndarray) -> np.ndarray:
    three = (_shares(words, (2, 10, 10, 10))[:, 1:] - 0.5) * _ROOT_2
    return quaternions_of_smallest(three, words >> np.uint32(30))


def _shares(words: np.ndarray, widths: tuple[int, ...]) -> np.ndarray:
    """Numbers from 0 to 1, float64 [N, k], of words of which the first has the highest bits."""
    out, shift = np.empty((len(words), len(widths))), sum(widths)
    for column, width in enumerate(widths):
        shift -= width
        most = (1 << width) - 1
        out[:, column] = (words >> np.uint32(shift) & np.uint32(most)) / most
    return out


def _between(path: Path, chunk: np.ndarray, names: str, shares: np.ndarray) -> np.ndarray:
    """Numbers that lie so far from the least to the most of their chunks, float64 [N, 3]."""
    low, high = (np.stack([_column(path, chunk, f"{end}_{name}").astype(np.float64) for name in names.split()], 1)
                 for end in ("min", "max"))  # fmt: skip
    return low + shares * (high - low)


def _harmonics(path: Path, rows: np.ndarray | None, count: int) -> np.ndarray:
    """float64 [N, K, 3] of bytes, of which 0 and 255 are the ends and others the middles of their intervals."""
    names = [] if rows is None else list(rows.dtype.names or ())
    if rows is None or not names:
        return np.empty((count, 0, 3))
    if len(rows) != count or len(names) not in (9, 24, 45):
        raise FormatError(f"{path}: 'sh' has {len(rows)} rows of {len(names)}, expected {count} of 9, 24 or 45")
    steps = np.stack([_column(path, rows, f"f_rest_{i}").astype(np.float64) for i in range(len(names))], 1)
    return levels_of_steps(steps).reshape(count, 3, -1).transpose(0, 2, 1)


def _rows(path: Path, elements: dict[str, np.ndarray], name: str) -> np.ndarray:
    if name not in elements:
        raise FormatError(f"{path}: no element '{name}', which a compressed PLY has")
    return elements[name]


def _column(path: Path, rows: np.ndarray, name: str) -> np.ndarray:
    if name not in (rows.dtype.names or ()) or rows.dtype[name].kind not in "fiu":
        raise FormatError(f"{path}: no numbers '{name}', which a compressed PLY has")
    return rows[name]


READER = read_whole(
    "compressed PLY", lambda path, head: set(PACKED) <= properties_of_ply(path, head), read_compressed_ply
)
