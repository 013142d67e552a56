# SPDX-License-Identifier: Apache-2.0
"""Planes in a depth image: blocks that are flat are grown into planes, which then claim their pixels.

The blockwise agglomeration follows the idea of Feng et al., "Fast Plane Extraction in Organized Point Clouds Using
Agglomerative Hierarchical Clustering", ICRA 2014; here on inverse depth, where a plane is a linear function.
"""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.pixel_passes import claim_planes, connected_pieces
from ggslam.objects.settings import REFERENCE_WIDTH, GeometricSettings
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class DepthPlaneTuning(Tuning):
    """When depth is flat."""

    block_sigmas = 2.0
    """Largest error of a flat block, in standard deviations of the noise."""
    plane_sigmas = 3.0
    """The same of a plane."""
    max_angle_deg = 40.0
    """Largest angle between a plane and the surface at its pixels, in degrees."""


def find_planes(surface: DepthSurface, camera: Camera, settings: GeometricSettings) -> tuple[np.ndarray, np.ndarray]:
    """Large planes of a depth image.

    Returns:
        int32 [H, W], number of the plane of each pixel from 1 on, larger planes first, 0 = none; and
        float32 [P, 3], per plane the vector w with 1/z = w . ray, in other words its normal over its distance.
    """
    size = max(4, round(settings.block_pixels * camera.width / REFERENCE_WIDTH))
    size = min(size, camera.width, camera.height)
    blocks = _Blocks(surface, camera, size)
    group = _grow(blocks, surface.sigma, settings)
    planes, plane_of_block = _fit(blocks, group, surface.sigma, settings)
    return _claim(surface, camera, planes, plane_of_block, size, settings), planes


class _Blocks:
    """Sums over square blocks of pixels from which planes are fitted to any union of blocks.

    Attributes:
        moments: float64 [rows, columns, 3, 3], sums of ray ray^T; right: [rows, columns, 3], sums of ray / z;
            squares: [rows, columns], sums of 1 / z^2; count: [rows, columns].
        full: bool [rows, columns], nearly every pixel has depth.
        plane: float64 [rows, columns, 3] fitted to each block; error: its root mean square in 1/m.
    """

    def __init__(self, surface: DepthSurface, camera: Camera, size: int) -> None:
        rows, columns = camera.height // size, camera.width // size
        weight = surface.valid.astype(np.float32)
        w = surface.inverse * weight
        rays = camera.rays()
        x, y = rays[0, :, 0][None, :], rays[:, 0, 1][:, None]

        def total(image: np.ndarray) -> np.ndarray:
            image = image[: rows * size, : columns * size].astype(np.float64)
            return cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA) * size**2

        xx, xy, yy = total(weight * x * x), total(weight * x * y), total(weight * y * y)
        x1, y1, self.count = total(weight * x), total(weight * y), total(weight)
        self.moments = np.stack([xx, xy, x1, xy, yy, y1, x1, y1, self.count], -1).reshape(rows, columns, 3, 3)
        self.right = np.stack([total(w * x), total(w * y), total(w)], -1)
        self.squares = total(w * surface.inverse)
        self.full = self.count >= 0.9 * size * size
        self.plane, self.error = fit(self.moments, self.right, self.squares, self.count)

    def sums_of(self, group: np.ndarray, n: int) -> _Sums:
        """Sums over the blocks of each of n groups (int [rows, columns], number of the group, others left out)."""
        inside = np.flatnonzero((group.ravel() >= 0) & (group.ravel() < n))
        which, rows = group.ravel()[inside], self._rows()[inside]
        return _Sums(np.stack([np.bincount(which, column, n) for column in rows.T], 1))

    def _rows(self) -> np.ndarray:
        """Moments, right sides, squares, counts and mean inverse depths of blocks: float64 [rows * columns, 15]."""
        middle = self.right[..., 2] / np.maximum(self.count, 1)
        columns = self.moments.reshape(-1, 9), self.right.reshape(-1, 3), self.squares, self.count, middle
        return np.column_stack([part.reshape(self.count.size, -1) for part in columns])


class _Sums:
    """What `_Blocks` has, summed over groups of blocks: a row a group."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    def fit(self) -> tuple[np.ndarray, np.ndarray]:
        """Planes [n, 3] and their errors [n]."""
        return fit(self.rows[:, :9].reshape(-1, 3, 3), self.rows[:, 9:12], self.rows[:, 12], self.rows[:, 13])

    def inverse(self) -> np.ndarray:
        """Sum over blocks of their mean inverse depth [n]."""
        return self.rows[:, 14]

    def errors_from(self, k: int, planes: np.ndarray) -> np.ndarray:
        """Root mean square distance, in 1/m, of group k from planes [P, 3]: [P]."""
        row = self.rows[k]
        bent = np.einsum("pi,ij,pj->p", planes, row[:9].reshape(3, 3), planes)
        return np.sqrt(np.maximum(row[12] - 2 * planes @ row[9:12] + bent, 0.0) / max(row[13], 1))


def fit(
    moments: np.ndarray, right: np.ndarray, squares: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of 1/z = plane . ray from sums [..., 3, 3], [..., 3], [...], [...]: plane and its RMS error."""
    regular = moments + 1e-9 * np.maximum(count, 1)[..., None, None] * np.eye(3)
    plane = np.linalg.solve(regular, right[..., None])[..., 0]
    residual = squares - 2 * (plane * right).sum(-1) + np.einsum("...i,...ij,...j->...", plane, moments, plane)
    return plane, np.sqrt(np.maximum(residual, 0) / np.maximum(count, 1))


def _grow(blocks: _Blocks, sigma: float, settings: GeometricSettings) -> np.ndarray:
    """Number of the group of each flat block, int [rows, columns], -1 = not flat: neighbours with like planes."""
    # Rounding of float32 sums adds a little to the noise.
    flat = blocks.full & (blocks.error < DepthPlaneTuning.block_sigmas * sigma)
    unit = blocks.plane / np.maximum(np.linalg.norm(blocks.plane, axis=-1, keepdims=True), 1e-9)
    centre = blocks.right[..., 2] / np.maximum(blocks.count, 1)
    limit = np.cos(np.radians(settings.plane_degrees))
    ray = blocks.moments[..., 2, :] / np.maximum(blocks.count, 1)[..., None]
    links = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        alike = flat[a] & flat[b] & ((unit[a] * unit[b]).sum(-1) > limit)
        for own, other in ((a, b), (b, a)):
            reach = np.abs((blocks.plane[own] * ray[other]).sum(-1) - centre[other])
            alike &= reach < 3 * sigma + settings.tolerance_m * centre[other] ** 2
        links.append(alike)
    return np.where(flat, connected_pieces(flat, (links[0], links[1])), -1)


def _fit(
    blocks: _Blocks, group: np.ndarray, sigma: float, settings: GeometricSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Planes [P, 3] of the groups that are large and flat as a whole, largest first, and the number of each block's,
    int32 [rows, columns], from 1 on, 0 = none.

    Groups on the plane of a larger one join it, wherever they are: noise breaks one wall into several groups.
    """
    sizes = np.bincount(group[group >= 0], minlength=1)
    order = np.argsort(-sizes, kind="stable")
    order = order[sizes[order] >= settings.min_plane_blocks]
    number = np.full(len(sizes) + 1, -1)  # the last one: of blocks without group
    number[order] = np.arange(len(order))
    group = number[group]
    sums = blocks.sums_of(group, len(order))
    fitted, error = sums.fit()
    limit = DepthPlaneTuning.plane_sigmas * sigma + settings.tolerance_m * (sums.inverse() / sizes[order]) ** 2
    planes = np.zeros((0, 3))
    members: list[list[int]] = []
    for k in np.flatnonzero(error < limit).tolist():
        angle = _cosines(fitted[k], planes)
        alike = np.flatnonzero(angle > np.cos(np.radians(2 * settings.plane_degrees)))
        alike = alike[sums.errors_from(k, planes[alike]) < limit[k]]
        if len(alike):
            i = int(alike[angle[alike].argmax()])
            members[i].append(k)
            planes[i] = _Sums(sums.rows[members[i]].sum(0, keepdims=True)).fit()[0][0]
        else:
            planes = np.concatenate([planes, fitted[k : k + 1]])
            members.append([k])
    plane_of = np.zeros(len(order) + 1, np.int32)  # the last one: of blocks without plane
    for i, joined in enumerate(members, 1):
        plane_of[joined] = i
    return planes.astype(np.float32), plane_of[group]


def _cosines(plane: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Cosines of the angles between the normals of a plane [3] and of others [P, 3]: [P]."""
    return others @ plane / (np.linalg.norm(others, axis=1) * np.linalg.norm(plane))


def _claim(
    surface: DepthSurface, camera: Camera, planes: np.ndarray, plane_of_block: np.ndarray, size: int,
    settings: GeometricSettings,
) -> np.ndarray:  # fmt: skip
    """Plane of each pixel: the nearest of those that it lies on and has the normal of, in pieces with blocks."""
    label = claim_planes(surface, camera.rays(), planes, np.cos(np.radians(DepthPlaneTuning.max_angle_deg)), settings)
    support = np.zeros(label.shape, np.int32)
    grown = plane_of_block.repeat(size, 0).repeat(size, 1)
    support[: grown.shape[0], : grown.shape[1]] = grown
    pieces = connected_pieces(label)
    kept = np.zeros(int(pieces.max()) + 1, bool)
    kept[pieces[(support == label) & (label > 0)]] = True
    return np.where(kept[pieces], label, 0)
