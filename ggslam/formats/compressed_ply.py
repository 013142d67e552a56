# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps as the compressed PLY of PlayCanvas, which SuperSplat and web viewers open.

Axes as in the map. Three elements. `chunk`: the least and the most of positions (metres), logarithms of standard
deviations and base colours of 256 Gaussians. `vertex`: four words a Gaussian, the first number in the highest bits:
position and size in 11, 10 and 11 bits between the corners of the chunk, base colour likewise and opacity in 8 bits
each, and a quaternion: which of w x y z is the largest (2 bits), and the others in 10 bits between -sqrt(1/2) and
sqrt(1/2). `sh`: the higher spherical harmonics, a byte each, all of red, then green, then blue.

Neither object ids nor identities have a place.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.morton import morton_order
from ggslam.formats.ply import write_ply
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.scene.gaussian_map import SH_C0, GaussianMap
from ggslam.system.tuning import Tuning

CHUNK: Final = 256
"""Gaussians that share their corners in the format."""
SH_REACH: Final = 4.0
"""Spherical harmonics are bytes in steps of 1/32 from minus to plus this."""


class CompressedPlyTuning(Tuning):
    """How values are rounded to bytes."""

    blended = 16
    """Neighbours whose mean error is kept small: a pixel shows about so many Gaussians."""
    max_log_scale = 20.0
    """Largest absolute log scale that is written."""


_CORNERS = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))


def write_compressed_ply(path: str | Path, gaussians: GaussianMap) -> int:
    """Writes a compressed PLY, whole or not at all. Rows are put into Morton order, so that chunks are small.

    Spherical harmonics of the highest degrees are left out where rounding them would add more error than leaving them
    out, see `harmonics_worth_storing`.

    Args:
        path: the file to write.
        gaussians: at least one.

    Returns:
        The degree of the spherical harmonics that were written.

    Raises:
        FormatError: there is no Gaussian, or a number is not finite.
        RunFolderError: the file cannot be written.
    """
    if not len(gaussians):
        raise FormatError(f"{path}: a compressed PLY needs at least one Gaussian")
    columns = SplatColumns.of(path, gaussians)
    order = morton_order(columns.means)
    chunks, vertices = _pack(columns, order)
    elements = {"chunk": chunks, "vertex": vertices}
    steps = harmonics_worth_storing(columns.sh[order, 1:])
    if steps.shape[1]:
        elements["sh"] = _harmonics(steps)
    write_ply(path, elements)
    return math.isqrt(steps.shape[1] + 1) - 1


def _pack(columns: SplatColumns, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The elements `chunk` and `vertex`."""
    log_scales = columns.log_scales[order].clip(-CompressedPlyTuning.max_log_scale, CompressedPlyTuning.max_log_scale)
    colors = 0.5 + SH_C0 * columns.sh[order, 0]
    opacity = 0.5 + 0.5 * np.tanh(0.5 * columns.logits[order].astype(np.float64))
    starts = np.arange(0, len(order), CHUNK)
    corners: dict[str, np.ndarray] = {}
    shares = []
    for names, values in zip(_CORNERS, (columns.means[order], log_scales, colors), strict=True):
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        corners |= dict(zip([f"min_{name}" for name in names], low.T, strict=True))
        corners |= dict(zip([f"max_{name}" for name in names], high.T, strict=True))
        shares.append(_shares(values, low, high))
    color = np.column_stack([shares[2], opacity.clip(1 / 255, 254 / 255)])  # 0 and 1 are infinite as logits
    words = {
        "packed_position": _word(shares[0], (11, 10, 11)), "packed_rotation": _rotation(columns.quaternions[order]),
        "packed_scale": _word(shares[1], (11, 10, 11)), "packed_color": _word(color, (8, 8, 8, 8)),
    }  # fmt: skip
    return _rows(corners, "<f4"), _rows(words, "<u4")


def _shares(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Where numbers [N, 3] lie between the corners [chunks, 3] of their chunks, 0 to 1, float64."""
    low, high = low.repeat(CHUNK, 0)[: len(values)], high.repeat(CHUNK, 0)[: len(values)]
    extent = high.astype(np.float64) - low
    return (values.astype(np.float64) - low) / np.where(extent > 0, extent, 1.0)


def _rotation(unit: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4] of unit length as words [N]."""
    largest = np.abs(unit).argmax(1)
    others = unit * np.where(np.take_along_axis(unit, largest[:, None], 1) < 0, -1, 1)  # q and -q turn alike
    others = others[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest.astype(np.uint32) << np.uint32(30) | _word(others * np.sqrt(0.5) + 0.5, (10, 10, 10))


def _word(shares: np.ndarray, widths: tuple[int, ...]) -> np.ndarray:
    """Numbers from 0 to 1, [N, k], as words uint32 [N]: rounded to so many bits each, the first in the highest."""
    word = np.zeros(len(shares), np.uint32)
    for column, width in zip(shares.T, widths, strict=True):
        most = 2**width - 1
        word = word << np.uint32(width) | np.floor(column * most + 0.5).clip(0, most).astype(np.uint32)
    return word


def harmonics_worth_storing(higher: np.ndarray) -> np.ndarray:
    """Bytes of the harmonics that come back nearer to the map than none, of whole degrees from 1 on.

    A byte is the middle of an interval of 1/32, so that small numbers come back as 1/64 and -1/64: more than most
    harmonics of a trained map have. A pixel shows many Gaussians, though. If neighbours are rounded up and down by
    chance, in proportion to how near a number is to both middles, their mean comes back; if each is rounded to the
    nearest, neighbours that are alike all err alike. Of each degree that rounding is taken whose error is less, and of
    all degrees as many as leave the least error, both measured on means of `CompressedPlyTuning.blended` neighbours.

    Args:
        higher: float32 [N, K, 3] without the base colour, neighbours in space following one another.

    Returns:
        uint8 values as float [N, k, 3], k = 0, 3, 8 or 15, at most K.
    """
    degree, steps = math.isqrt(higher.shape[1] + 1) - 1, []
    errors, random = np.zeros(degree + 1), np.random.default_rng(0)  # of what is kept up to each degree
    for band in range(1, degree + 1):
        values = higher[:, band**2 - 1 : (band + 1) ** 2 - 1].astype(np.float64)
        place = (values / (2 * SH_REACH) + 0.5) * 256
        choices = [np.floor(place).clip(0, 255), np.floor(place - 0.5 + random.random(values.shape)).clip(0, 255)]
        left = [_error_of_means(levels_of_steps(choice) - values) for choice in choices]
        steps.append(choices[int(np.argmin(left))])
        errors[band:] += min(left)
        errors[:band] += _error_of_means(values)
    kept = int(errors.argmin())
    return np.concatenate([np.empty((len(higher), 0, 3)), *steps[:kept]], 1)


def _error_of_means(errors: np.ndarray) -> float:
    """Squares of means of `CompressedPlyTuning.blended` neighbours, summed; [N, k, 3]."""
    starts = np.arange(0, len(errors), CompressedPlyTuning.blended)
    counts = np.diff(np.append(starts, len(errors)))[:, None, None]
    return float(np.square(np.add.reduceat(errors, starts) / counts).sum())


def levels_of_steps(steps: np.ndarray) -> np.ndarray:
    """The numbers that readers take intervals for: 0 and 255 are the ends, others the middles."""
    shares = np.where(steps <= 0, 0.0, np.where(steps >= 255, 1.0, (steps + 0.5) / 256))
    return (shares - 0.5) * (2 * SH_REACH)


def _harmonics(steps: np.ndarray) -> np.ndarray:
    """The element `sh` of bytes [N, K, 3]."""
    channel_major = steps.transpose(0, 2, 1).reshape(len(steps), -1)
    return _rows({f"f_rest_{i}": column for i, column in enumerate(channel_major.T)}, "u1")


def _rows(columns: dict[str, np.ndarray], kind: str) -> np.ndarray:
    rows = np.empty(len(next(iter(columns.values()))), [(name, kind) for name in columns])
    for name, column in columns.items():
        rows[name] = column
    return rows


def _write(path: Path, splats: Splats) -> str:
    degree, written = splats.like.sh_degree, write_compressed_ply(path, splats.whole())
    if written == degree:
        return splats.text(path)
    which = f"degree {degree}" if written == degree - 1 else f"degrees {written + 1} to {degree}"
    return f"{splats.text(path)}; left out colours of {which}: they are too faint for its steps of 1/32"


WRITER = Writer(
    "compressed-ply", (".compressed.ply", ".ply"), Takes.GAUSSIANS, "the same in fewer bytes", _write
)
