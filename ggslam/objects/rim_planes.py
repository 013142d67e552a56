# SPDX-License-Identifier: Apache-2.0
"""The planes around a hole: RANSAC on the surface that is seen along the removed object's outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.objects.hole_views import HoleView
from ggslam.system.tuning import Tuning


class RimPlaneTuning(Tuning):
    """How planes around a hole are found."""

    points = 4000
    """Most points of the rim."""
    trials = 300
    """Trials of RANSAC."""
    max_planes = 6
    """Most planes."""
    min_share = 0.03
    """Smallest share of the points on a plane."""
    min_parallel = 0.85
    """Smallest cosine between a plane's normal and those at its points."""
    ring_width = 0.4
    """Width of the rim, as a share of the root of the covered area."""


@dataclass(frozen=True)
class RimPlane:
    """A plane n . x = offset with the points it was found from.

    Attributes:
        normal: unit [3], towards the cameras.
        offset: metres.
        points: [M, 3], the rim's points on it.
        tolerance: metres; distance within which something lies on it.
    """

    normal: np.ndarray
    offset: float
    points: np.ndarray
    tolerance: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances [M] of points [M, 3], positive towards the cameras."""
        return points @ self.normal - self.offset

    def is_met(self, points: np.ndarray, depth: float) -> np.ndarray:
        """Whether points [M, 3] are just behind the known part of the plane, up to `depth` metres: another plane ends
        there. bool [M]"""
        axes = np.linalg.svd(self.normal[None])[2][1:]
        low, high = np.percentile(self.points @ axes.T, [1, 99], axis=0)
        flat, distance = points @ axes.T, self.distance(points) + self.tolerance
        return (distance < 0) & (distance > -depth) & ((flat >= low) & (flat <= high)).all(1)


def rim_points(views: Sequence[HoleView]) -> tuple[np.ndarray, np.ndarray]:
    """World points [M, 3] of the surfaces seen around the object's outlines, from all views together, and their unit
    normals [M, 3] (of either sign; meaningless at edges)."""
    points, normals = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    for v in views:
        covered = v.covered.astype(np.uint8)
        width = int(np.clip(RimPlaneTuning.ring_width * np.sqrt(covered.sum()), 4, 40))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
        ring = (cv2.dilate(covered, disc) > 0) & (cv2.dilate(covered, np.ones((3, 3), np.uint8)) == 0) & (v.now > 0)
        surface = v.view.points(v.now)
        smooth = cv2.blur(surface, (5, 5))
        normal = np.cross(np.gradient(smooth, axis=1), np.gradient(smooth, axis=0))[ring]
        points.append(surface[ring])
        normals.append(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))
    pick = np.random.default_rng(0).permutation(sum(len(part) for part in points))[:RimPlaneTuning.points]
    return np.concatenate(points)[pick], np.concatenate(normals)[pick]


def find_rim_planes(points: np.ndarray, normals: np.ndarray, cameras: np.ndarray, tolerance: float) -> list[RimPlane]:
    """Planes that many points lie on, the largest first.

    Args:
        points, normals: [M, 3], see `rim_points`.
        cameras: positions [V, 3], to tell the front of a plane.
        tolerance: metres.
    """
    rng = np.random.default_rng(0)
    planes: list[RimPlane] = []
    left, facing = points.astype(np.float64), normals.astype(np.float64)
    least = max(30, RimPlaneTuning.min_share * len(points))
    while len(left) >= least and len(planes) < RimPlaneTuning.max_planes:
        plane = _best_plane(left, facing, tolerance, rng)
        near = _on(plane, left, facing, tolerance)
        if near.sum() < least:
            break
        if (cameras @ plane[:3] - plane[3]).mean() < 0:
            plane = -plane
        planes.append(RimPlane(plane[:3], float(plane[3]), left[near], tolerance))
        stays = ~_on(plane, left, facing, 1.5 * tolerance)
        left, facing = left[stays], facing[stays]
    return planes


def _on(plane: np.ndarray, points: np.ndarray, normals: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether points lie on a plane (nx, ny, nz, offset) and their surface runs along it, bool [M]."""
    return (np.abs(points @ plane[:3] - plane[3]) <= tolerance) & (
        np.abs(normals @ plane[:3]) >= RimPlaneTuning.min_parallel
    )


def _best_plane(points: np.ndarray, normals: np.ndarray, tolerance: float, rng: np.random.Generator) -> np.ndarray:
    """(nx, ny, nz, offset) of the best of many planes through a point along its surface, fitted to all its inliers."""
    seeds = rng.integers(0, len(points), RimPlaneTuning.trials)
    offsets = np.einsum("ti,ti->t", normals[seeds], points[seeds])
    close = np.abs(points @ normals[seeds].T - offsets) <= tolerance
    best = (close & (np.abs(normals @ normals[seeds].T) >= RimPlaneTuning.min_parallel)).sum(0).argmax()
    plane = np.append(normals[seeds[best]], offsets[best])
    for _ in range(4):
        inliers = points[_on(plane, points, normals, tolerance)]
        if len(inliers) < 3:
            break
        plane = _fit_plane(inliers)
    return plane


def _fit_plane(points: np.ndarray) -> np.ndarray:
    """(nx, ny, nz, offset) of the plane through points with the least squared distances."""
    centre = points.mean(0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    return np.append(normal, normal @ centre)
