# SPDX-License-Identifier: Apache-2.0
"""Planes in a depth image: blocks that are flat are grown into planes, which then claim their pixels.

The blockwise agglomeration follows the idea of Feng et al., "Fast Plane Extraction in Organized Point Clouds Using
Agglomerative Hierarchical Clustering", ICRA 2014; here on inverse depth, where a plane is a linear function.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ggslam.objects.depth_surfaces import DepthSurface
from ggslam.objects.segments import connected_pieces
from ggslam.objects.settings import GeometricSettings
from ggslam.scene.camera import Camera

_REFERENCE_WIDTH = 320
_FLAT_SIGMAS = 2.0
_PLANE_SIGMAS = 3.0
_NORMAL_DEGREES = 40.0


def find_planes(surface: DepthSurface, camera: Camera, settings: GeometricSettings) -> tuple[np.ndarray, np.ndarray]:
    """Large planes of a depth image.

    Returns:
        int32 [H, W], number of the plane of each pixel from 1 on, larger planes first, 0 = none; and
        float32 [P, 3], per plane the vector w with 1/z = w . ray, in other words its normal over its distance.
    """
    size = max(4, round(settings.block_pixels * camera.width / _REFERENCE_WIDTH))
    size = min(size, camera.width, camera.height)
    blocks = _Blocks(surface, camera, size)
    group = _grow(blocks, surface.sigma, settings)
    planes, supports = _fit(blocks, group, surface.sigma, settings)
    return _claim(surface, camera, planes, supports, size, settings), planes


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

    def fit_union(self, members: np.ndarray) -> tuple[np.ndarray, float]:
        """Plane [3] and its error of the blocks `members` (bool [rows, columns])."""
        sums = [array[members].sum(0) for array in (self.moments, self.right, self.squares, self.count)]
        plane, error = fit(*sums)
        return plane, float(error)

    def error_of(self, plane: np.ndarray, members: np.ndarray) -> float:
        """Root mean square distance, in 1/m, of the blocks `members` from a plane [3]."""
        moments, right, squares, count = (
            array[members].sum(0) for array in (self.moments, self.right, self.squares, self.count)
        )
        return float(np.sqrt(max(squares - 2 * plane @ right + plane @ moments @ plane, 0.0) / max(count, 1)))


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
    flat = blocks.full & (blocks.error < _FLAT_SIGMAS * sigma)
    unit = blocks.plane / np.maximum(np.linalg.norm(blocks.plane, axis=-1, keepdims=True), 1e-9)
    centre = blocks.right[..., 2] / np.maximum(blocks.count, 1)
    limit = np.cos(np.radians(settings.plane_degrees))
    number = np.arange(flat.size).reshape(flat.shape)
    ray = blocks.moments[..., 2, :] / np.maximum(blocks.count, 1)[..., None]
    starts, ends = [], []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        alike = flat[a] & flat[b] & ((unit[a] * unit[b]).sum(-1) > limit)
        for own, other in ((a, b), (b, a)):
            reach = np.abs((blocks.plane[own] * ray[other]).sum(-1) - centre[other])
            alike &= reach < 3 * sigma + settings.tolerance_m * centre[other] ** 2
        starts.append(number[a][alike])
        ends.append(number[b][alike])
    links = np.concatenate(starts), np.concatenate(ends)
    graph = coo_matrix((np.ones(len(links[0]), bool), links), shape=(flat.size, flat.size))
    group = connected_components(graph, directed=False)[1].reshape(flat.shape)
    return np.where(flat, group, -1)


def _fit(
    blocks: _Blocks, group: np.ndarray, sigma: float, settings: GeometricSettings
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Planes [P, 3] of the groups that are large and flat as a whole, largest first, and their blocks.

    Groups on the plane of a larger one join it, wherever they are: noise breaks one wall into several groups.
    """
    sizes = np.bincount(group[group >= 0], minlength=1)
    planes: list[np.ndarray] = []
    supports: list[np.ndarray] = []
    for k in np.argsort(-sizes, kind="stable"):
        if sizes[k] < settings.min_plane_blocks:
            break
        members = group == k
        plane, error = blocks.fit_union(members)
        inverse = float((blocks.right[members][:, 2] / blocks.count[members]).mean())
        limit = _PLANE_SIGMAS * sigma + settings.tolerance_m * inverse**2
        if error >= limit:
            continue
        angles = [_cosine(plane, other) for other in planes]
        alike = [
            i for i, other in enumerate(planes)
            if angles[i] > np.cos(np.radians(2 * settings.plane_degrees)) and blocks.error_of(other, members) < limit
        ]  # fmt: skip
        if alike:
            i = max(alike, key=lambda i: angles[i])
            supports[i] = supports[i] | members
            planes[i] = blocks.fit_union(supports[i])[0]
        else:
            planes.append(plane)
            supports.append(members)
    return np.array(planes, np.float32).reshape(-1, 3), supports


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def _claim(
    surface: DepthSurface, camera: Camera, planes: np.ndarray, supports: list[np.ndarray], size: int,
    settings: GeometricSettings,
) -> np.ndarray:  # fmt: skip
    """Plane of each pixel: the nearest of those that it lies on and has the normal of, in pieces with blocks."""
    rays = camera.rays()
    x, y = rays[:1, :, 0], rays[:, :1, 1]
    label = np.zeros(surface.valid.shape, np.int32)
    nearest = settings.tolerance_sigmas * surface.sigma + settings.tolerance_m * surface.inverse**2
    nearest[~surface.valid] = 0
    limit, normals = np.cos(np.radians(_NORMAL_DEGREES)), surface.normals.reshape(-1, 3)
    for number, plane in enumerate(planes, 1):
        away = np.abs(surface.inverse - (plane[0] * x + (plane[1] * y + plane[2])))
        chosen = np.flatnonzero(away < nearest)
        chosen = chosen[normals.take(chosen, 0) @ (-plane / np.linalg.norm(plane)) > limit]
        label.ravel()[chosen] = number
        nearest.ravel()[chosen] = away.ravel()[chosen]
    support = np.zeros(label.shape, np.int32)
    blocks = sum((k * members for k, members in enumerate(supports, 1)), np.zeros((1, 1), np.int32))
    grown = blocks.repeat(size, 0).repeat(size, 1)
    support[: grown.shape[0], : grown.shape[1]] = grown
    pieces = connected_pieces(label)
    kept = np.zeros(int(pieces.max()) + 1, bool)
    kept[pieces[(support == label) & (label > 0)]] = True
    return np.where(kept[pieces], label, 0)
