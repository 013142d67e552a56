# SPDX-License-Identifier: Apache-2.0
"""Normals of a point cloud.

Depth images have neighbours in their grid instead, and three parts take normals from there, each what it needs: the
compiled core the shape of a point, noise taken off, for G-ICP (`tracking.points`), new Gaussians none beside a jump
(`mapping.cpu.insertion`), the segmenter one at every pixel, from inverse depth (`objects.depth_surface`).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ggslam.system.tuning import Tuning


class NormalTuning(Tuning):
    """Estimation of normals."""

    neighbours = 16
    """Points that a normal is estimated from, with the point itself."""
    chunk = 1 << 17
    """Points whose normals are estimated in one batch."""


def estimate_normals(
    points: np.ndarray, rows: np.ndarray | None = None, neighbours: int = NormalTuning.neighbours,
    tree: cKDTree | None = None, workers: int = -1, beside: np.ndarray | None = None, thickness: float | None = None,
    width: float | None = None,
) -> np.ndarray:  # fmt: skip
    """Unit normals float64 [n, 3] of points [N, 3], the direction of least variance among each point's nearest
    neighbours; their sign is arbitrary.

    Args:
        points: the cloud, N > 0.
        rows: int [n], the points whose normals are wanted; None: all.
        neighbours: points in a plane, the point itself included.
        tree: of the points; None: one is built.
        beside: [N, k], further coordinates in which neighbours lie near; the tree then is of all.
        thickness: normals are zero where the variance along them is above this share of the middle one, across the
            neighbours' second narrowest direction: there is no surface.
        width: normals are zero where the middle variance is below this share of the largest: the neighbours lie along a
            line, as one ring of a laser scanner, and do not show which way the surface is turned.
        workers: threads that search; one is faster for a few hundred points.
    """
    points = np.asarray(points, np.float64)
    places = points if beside is None else np.concatenate([points, beside], 1)
    tree = cKDTree(places) if tree is None else tree
    rows, count = np.arange(len(points)) if rows is None else rows, min(neighbours, len(points))
    normals = np.empty((len(rows), 3))
    for start in range(0, len(rows), NormalTuning.chunk):
        part = slice(start, start + NormalTuning.chunk)
        near = points[tree.query(places[rows[part]], count, workers=workers)[1].reshape(-1, count)]
        offsets = near - near.mean(1, keepdims=True)
        variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
        normals[part] = axes[:, :, 0]
        if thickness is not None:
            normals[start:][: len(near)][variances[:, 0] > thickness * variances[:, 1]] = 0
        if width is not None:
            normals[start:][: len(near)][variances[:, 1] < width * variances[:, 2]] = 0
    return normals


def turn_toward(normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Normals [n, 3], each turned to the side that its direction [n, 3] points to."""
    return np.where((normals * directions).sum(1, keepdims=True) < 0, -normals, normals)
