# SPDX-License-Identifier: Apache-2.0
"""How much a cloud lost by coding: the measures of MPEG's pc_error, as the common test conditions of G-PCC prescribe.

Geometry: D. Tian et al., "Geometric distortion metrics for point cloud compression", ICIP 2017. With e the vector from
a point of one cloud to its nearest neighbour in the other, D1 is the mean of |e|^2 and D2 the mean of (e n)^2, n the
normal at the neighbour. Both are taken from either cloud to the other and the larger one counts;
PSNR = 10 log10(3 peak^2 / D).
Colours: of each point and its nearest neighbour in the other cloud (the mean of all neighbours at that distance),
again the worse direction; PSNR = 10 log10(255^2 / MSE), for R, G, B and BT.709 Y, U, V.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ggslam.errors import InputError
from ggslam.geometry.normals import estimate_normals
from ggslam.system.tuning import Tuning


class CloudMetricTuning(Tuning):
    """How two clouds are compared."""

    points_at_once = 1 << 17
    """Points that are compared at a time."""
    ties = 8
    """Neighbours that are looked at for equal distances: between coarser voxels a centre has at most 8."""


_RGB_TO_YUV = np.array(
    [[0.2126, 0.7152, 0.0722], [-0.2126 / 1.8556, -0.7152 / 1.8556, 0.5], [0.5, -0.7152 / 1.5748, -0.0722 / 1.5748]]
)
"""BT.709, full range, without the offset of U and V."""


@dataclass(frozen=True)
class ColorQuality:
    """PSNR in dB of each component; infinite where nothing was lost."""

    r: float
    g: float
    b: float
    y: float
    u: float
    v: float

    def values(self) -> dict[str, float]:
        """By name."""
        return asdict(self)


@dataclass(frozen=True)
class GeometryQuality:
    """Mean squared errors in squared units of the positions, and PSNR in dB (infinite where nothing was lost).

    d1: point to point; d2: point to plane. The larger one of both directions.
    """

    d1_mse: float
    d2_mse: float
    d1: float
    d2: float


def psnr(mse: float, peak_squared: float) -> float:
    """10 log10(peak^2 / mse) in dB; infinite for mse 0."""
    return math.inf if mse == 0 else 10 * math.log10(peak_squared / mse)


def rgb_to_yuv(rgb: np.ndarray) -> np.ndarray:
    """BT.709 Y, U, V float64 [N, 3] of colours [N, 3] in [0, 255]; U and V are around 0."""
    return np.asarray(rgb, np.float64) @ _RGB_TO_YUV.T


def color_quality(reference: np.ndarray, decoded: np.ndarray) -> ColorQuality:
    """PSNR of colours [N, 3] in [0, 255], row by row: for clouds whose points correspond (`matching_rows`).

    Raises:
        InputError: the shapes differ, or there are no rows.
    """
    if reference.shape != decoded.shape or reference.ndim != 2 or not len(reference):
        raise InputError(f"expected two arrays [N, 3], found {reference.shape} and {decoded.shape}")
    return _color_quality(_color_mse(reference, decoded))


def matching_rows(reference: np.ndarray, decoded: np.ndarray) -> np.ndarray | None:
    """For clouds on one grid, int [N, 3]: int64 [N] so that decoded[result] equals reference; None if they are not the
    same set of points. Points that occur several times are paired in the order in which they come."""
    if reference.shape != decoded.shape:
        return None
    first, second = (np.lexsort(points.T[::-1]) for points in (reference, decoded))
    if not np.array_equal(reference[first], decoded[second]):
        return None
    rows = np.empty(len(first), np.int64)
    rows[first] = second
    return rows


class CloudPair:
    """A cloud and what coding made of it; neighbours are looked up once.

    Args:
        reference: points [N, 3].
        decoded: points [M, 3].
    """

    def __init__(self, reference: np.ndarray, decoded: np.ndarray) -> None:
        self._reference = np.asarray(reference, np.float64)
        self._decoded = np.asarray(decoded, np.float64)
        if not len(self._reference) or not len(self._decoded):
            raise InputError("a cloud without points cannot be compared")

    def geometry(self, peak: float, normals: np.ndarray | None = None) -> GeometryQuality:
        """D1 and D2.

        Args:
            peak: the side of the box that the points lie in, e.g. 1023 for 10 bits.
            normals: of the reference, [N, 3]; None: estimated. Decoded points take the mean of the normals of the
                reference points nearest to them, as pc_error does.
        """
        normals = estimate_normals(self._reference) if normals is None else np.asarray(normals, np.float64)
        d1 = max(float((distances[:, 0] ** 2).mean()) for distances, _ in (self._forward, self._backward))
        d2 = max(
            _plane_error(self._reference, self._decoded, self._forward, self._decoded_normals(normals)),
            _plane_error(self._decoded, self._reference, self._backward, normals),
        )
        return GeometryQuality(d1, d2, psnr(d1, 3 * peak**2), psnr(d2, 3 * peak**2))

    def colors(self, reference: np.ndarray, decoded: np.ndarray) -> ColorQuality:
        """PSNR of the colours [N, 3] and [M, 3], in [0, 255], of nearest neighbours, the worse direction."""
        forward = _color_mse(reference, _neighbour_mean(self._forward, decoded))
        backward = _color_mse(decoded, _neighbour_mean(self._backward, reference))
        return _color_quality(np.maximum(forward, backward))

    @cached_property
    def _forward(self) -> tuple[np.ndarray, np.ndarray]:
        return _neighbours(self._reference, self._decoded)

    @cached_property
    def _backward(self) -> tuple[np.ndarray, np.ndarray]:
        return _neighbours(self._decoded, self._reference)

    def _decoded_normals(self, normals: np.ndarray) -> np.ndarray:
        nearest = self._forward[1][:, 0]
        turned = normals * np.where((normals * normals[self._backward[1][nearest, 0]]).sum(1) < 0, -1, 1)[:, None]
        sums = np.stack([np.bincount(nearest, turned[:, i], len(self._decoded)) for i in range(3)], 1)
        counts = np.bincount(nearest, minlength=len(self._decoded))[:, None]
        return np.where(counts > 0, sums / np.maximum(counts, 1), normals[self._backward[1][:, 0]])


def _neighbours(points: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [N, k], ascending, and indices [N, k] of the nearest `others`."""
    count = min(CloudMetricTuning.ties, len(others))
    distances, index = cKDTree(others).query(points, count, workers=-1)
    return distances.reshape(-1, count), index.reshape(-1, count)


def _ties(distances: np.ndarray) -> np.ndarray:
    """Which neighbours, bool [N, k], are as near as the nearest one."""
    return distances <= distances[:, :1] * (1 + 1e-9)


def _plane_error(
    points: np.ndarray, others: np.ndarray, neighbours: tuple[np.ndarray, np.ndarray], normals: np.ndarray
) -> float:
    """Mean of (e n)^2 over `points`; where several neighbours are equally near, of their mean."""
    distances, index = neighbours
    ties = _ties(distances)
    sums = np.zeros(len(points))
    for k in range(index.shape[1]):
        rows = np.flatnonzero(ties[:, k])
        near = index[rows, k]
        sums[rows] += ((points[rows] - others[near]) * normals[near]).sum(1) ** 2
    return float((sums / ties.sum(1)).mean())


def _neighbour_mean(neighbours: tuple[np.ndarray, np.ndarray], values: np.ndarray) -> np.ndarray:
    """Mean [N, 3] of the values of all nearest neighbours."""
    distances, index = neighbours
    ties = _ties(distances)
    sums = np.zeros((len(index), values.shape[1]))
    for k in range(index.shape[1]):
        rows = np.flatnonzero(ties[:, k])
        sums[rows] += values[index[rows, k]]
    return sums / ties.sum(1)[:, None]


def _color_mse(reference: np.ndarray, decoded: np.ndarray) -> np.ndarray:
    """Mean squared errors [6] of R, G, B, Y, U, V."""
    difference = np.asarray(reference, np.float64) - decoded
    return np.concatenate([(difference**2).mean(0), (rgb_to_yuv(difference) ** 2).mean(0)])


def _color_quality(mse: np.ndarray) -> ColorQuality:
    return ColorQuality(*(psnr(float(value), 255.0**2) for value in mse))
