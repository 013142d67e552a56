# SPDX-License-Identifier: Apache-2.0
"""Slow, obvious numpy versions of the tracking kernels, which the tests hold the kernels against."""

from __future__ import annotations

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import quaternion_to_matrix, skew
from ggslam.tracking.settings import AlignSettings, DepthNoise, PointSettings, TargetSettings


def pack(matrices: np.ndarray) -> np.ndarray:
    """Symmetric matrices [n, 3, 3] as xx xy xz yy yz zz, [n, 6]."""
    return np.stack([matrices[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], 1)


def unpack(packed: np.ndarray) -> np.ndarray:
    """Inverse of `pack`."""
    return packed[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def regularize(
    covariances: np.ndarray, min_thickness: float, max_thickness: float, max_elongation: float
) -> np.ndarray:
    """Equation 1 of GS-ICP, S' = S / median(S), with bounds on thickness and elongation; [n, 3, 3] to [n, 3, 3]."""
    values, axes = np.linalg.eigh(covariances)  # ascending
    largest = np.maximum(values[:, 2], 1e-20)
    median = np.maximum(values[:, 1], largest / max_elongation)
    shape = np.stack(
        [np.clip(values[:, 0] / median, min_thickness, max_thickness), np.ones_like(median), largest / median], 1
    )
    return np.einsum("nij,nj,nkj->nik", axes, shape, axes)


def point_shape(
    depth: np.ndarray, camera: Camera, pixel: tuple[int, int], settings: PointSettings, noise: DepthNoise, step: int = 1
) -> tuple[np.ndarray, np.ndarray] | None:
    """Normal [3] and regularised covariance [3, 3] of the point at a pixel (u, v), or None: too few neighbours."""
    u, v = pixel
    z = float(depth[v, u])
    points = camera.back_project(depth).astype(float)
    neighbours = []
    for j in range(-settings.window, settings.window + 1):
        for i in range(-settings.window, settings.window + 1):
            e = float(depth[v + j * step, u + i * step])
            reach = 4.0 * z / camera.fx * max(abs(i), abs(j)) * step + 3.0 * noise.sigma(z)
            if e > 0 and abs(e - z) <= reach:
                neighbours.append(points[v + j * step, u + i * step])
    if len(neighbours) < settings.min_neighbours * (2 * settings.window + 1) ** 2:
        return None
    values, axes = np.linalg.eigh(np.cov(np.array(neighbours).T, bias=True))
    normal = axes[:, 0] * (-1 if axes[:, 0] @ points[v, u] > 0 else 1)
    along = (normal @ points[v, u]) ** 2 / (points[v, u] @ points[v, u])
    values[0] = max(values[0] - 2 * noise.sigma(z) ** 2 * along, 0.0)
    shape = regularize((axes * values @ axes.T)[None], settings.min_thickness, 1.0, settings.max_elongation)[0]
    return normal, shape


def gaussian_shapes(
    quaternions: np.ndarray, log_scales: np.ndarray, settings: TargetSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Normals [n, 3] (sign as the axis has it) and regularised covariances [n, 3, 3] of Gaussians."""
    R = quaternion_to_matrix(quaternions.astype(float))
    variances = np.exp(2 * log_scales.astype(float))
    covariances = np.einsum("nij,nj,nkj->nik", R, variances, R)
    normals = np.take_along_axis(R, variances.argmin(1)[:, None, None], 2)[:, :, 0]
    return normals, regularize(covariances, settings.min_thickness, 1.0, settings.max_elongation)


def voxel_means(
    means: np.ndarray, log_scales: np.ndarray, opacity_logits: np.ndarray, voxel: float, min_opacity: float
) -> dict[tuple[int, int, int], np.ndarray]:
    """Mean [3] of each voxel, weighted by opacity over the Gaussians' middle variance (with the core's floor)."""
    opacity = 1 / (1 + np.exp(-opacity_logits.astype(float)))
    middle = np.exp(2 * np.sort(log_scales.astype(float), 1)[:, 1])
    weights = opacity * voxel**2 / (middle + 0.01 * voxel**2)
    cells = np.floor(means.astype(np.float32) * np.float32(1 / voxel)).astype(int)
    found: dict[tuple[int, int, int], list[int]] = {}
    for i in np.flatnonzero(opacity >= min_opacity):
        found.setdefault(tuple(cells[i]), []).append(int(i))
    return {cell: np.average(means[rows].astype(float), axis=0, weights=weights[rows]) for cell, rows in found.items()}


def nearest_voxels(
    points: np.ndarray, normals: np.ndarray, voxel_means: np.ndarray, voxel_normals: np.ndarray, size: float,
    min_normal_dot: float,
) -> np.ndarray:  # fmt: skip
    """Index of the nearest voxel mean within `size` of each point among those with a like normal, or -1; [n]."""
    squared = ((points[:, None] - voxel_means[None]) ** 2).sum(2)
    squared[(normals @ voxel_normals.T <= min_normal_dot) | (squared >= size * size)] = np.inf
    best = squared.argmin(1)
    return np.where(np.isfinite(squared[np.arange(len(points)), best]), best, -1)


def match_precisions(covariances: np.ndarray, voxel_covariances: np.ndarray, R: np.ndarray) -> np.ndarray:
    """(C_voxel + R C_point R^T)^-1, [n, 3, 3]."""
    return np.linalg.inv(voxel_covariances + R @ covariances @ R.T)


def cost(
    points: np.ndarray, weights: np.ndarray, targets: np.ndarray, precisions: np.ndarray, T: np.ndarray,
    settings: AlignSettings, noise: DepthNoise, plane_variance: float,
) -> float:  # fmt: skip
    """Robust cost of matched points [n, 3] at pose T with precisions held fixed, square metres times weight."""
    d = targets - (points @ T[:3, :3].T + T[:3, 3])
    squared = plane_variance * np.einsum("ni,nij,nj->n", d, precisions, d)
    sigma = noise.constant + noise.square * points[:, 2] ** 2
    g = (settings.kernel_constant + settings.kernel_sigmas * sigma) ** 2
    return float((weights * g * squared / (g + squared)).sum())


def normal_equations(
    points: np.ndarray, weights: np.ndarray, targets: np.ndarray, precisions: np.ndarray, T: np.ndarray,
    settings: AlignSettings, noise: DepthNoise, plane_variance: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Gauss-Newton's H [6, 6] and b [6] for the twist about the camera centre (translation first), matched points."""
    sigma = noise.constant + noise.square * points[:, 2] ** 2
    g = (settings.kernel_constant + settings.kernel_sigmas * sigma) ** 2
    H, b = np.zeros((6, 6)), np.zeros(6)
    for i, point in enumerate(points):
        q = T[:3, :3] @ point
        d = targets[i] - q - T[:3, 3]
        squared = plane_variance * d @ precisions[i] @ d
        M = weights[i] * (g[i] / (g[i] + squared)) ** 2 * plane_variance * precisions[i]
        J = np.hstack([np.eye(3), -skew(q)])
        H += J.T @ M @ J
        b += J.T @ M @ d
    return H, b
