# SPDX-License-Identifier: Apache-2.0
"""Splats as pages read them: 19 to 26 bytes each, column by column, compressed."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from ggslam.rendering.types import Gaussians
from ggslam.system.tuning import Tuning
from ggslam.viewer.splats import DrawnSplatTuning, opacities_of

STATIC = Path(__file__).with_name("static")
MAP_SCRIPTS = (
    "splat_rules.js", "unpack.js", "displacement.js", "seen_shapes.js", "sorter.js", "webgl_programs.js",
    "splat_textures.js", "webgl_renderer.js", "splat_projector.js", "tile_painter.js", "painting_worker.js",
    "painter_pool.js", "processor_renderer.js", "map_lines.js", "picker.js", "resolution.js", "map_view.js",
    "chunk_levels.js",
)  # fmt: skip
"""What `MapView` consists of, in the order in which a page needs it."""


class PackedSplatTuning(Tuning):
    """How exactly splats are stored."""

    min_size_m = 1e-4
    """Smallest standard deviation that is stored, in metres."""


SCALES = (float(np.log(PackedSplatTuning.min_size_m)), float(np.log(DrawnSplatTuning.max_size_m)))
"""Logarithms of the smallest and largest standard deviation that are written, 255 steps (4 %) apart."""



def pack_splats(
    gaussians: Gaussians, rows: np.ndarray, colors: np.ndarray, owners: np.ndarray, identity: np.ndarray | None,
    seen: np.ndarray | None = None, level: int = 9,
) -> tuple[bytes, np.ndarray, np.ndarray]:  # fmt: skip
    """Splats as compressed bytes, column by column.

    Args:
        gaussians: the map.
        rows: int [N], which of them.
        colors: uint8 [N, 3], theirs.
        owners: object ids uint16 [N], theirs.
        identity: colours of their identity vectors uint8 [N, 3], or None.
        seen: from where they were seen, uint8 [N, 4] of `viewed_sides`, or None.
        level: effort of compression, 1 to 9.

    Returns:
        The bytes, and the lowest and highest corner [3] of the centres, between which these are written in 65,535
        steps an axis.
    """
    means = gaussians.means.numpy()[rows].astype(np.float64)
    low, high = (means.min(axis=0), means.max(axis=0)) if len(means) else (np.zeros(3), np.ones(3))
    steps = np.rint((means - low) / np.maximum(high - low, 1e-9) * 65535).astype(np.uint16)
    scales = (gaussians.log_scales.numpy()[rows] - SCALES[0]) / (SCALES[1] - SCALES[0])
    turns = gaussians.quaternions.numpy()[rows]
    turns = turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-12)
    columns = [_halves(steps[:, axis]) for axis in range(3)]
    columns += [
        np.rint(255 * np.clip(scales, 0, 1)).astype(np.uint8).T,
        (np.rint(127 * turns) + 128).astype(np.uint8).T,
    ]
    columns += [colors.T, np.rint(255 * opacities_of(gaussians)[rows]).astype(np.uint8), _halves(owners)]
    columns += [] if identity is None else [identity.T]
    columns += [] if seen is None else [seen.T]
    return zlib.compress(b"".join(np.ascontiguousarray(column).tobytes() for column in columns), level), low, high


def _halves(values: np.ndarray) -> np.ndarray:
    """Low bytes, then high bytes, uint8 [2, N], of uint16 [N]: columns of one kind compress better."""
    return np.stack([values & 255, values >> 8]).astype(np.uint8)
