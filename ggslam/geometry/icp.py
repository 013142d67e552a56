# SPDX-License-Identifier: Apache-2.0
"""Point-to-plane ICP: registers a cloud to another (Y. Chen and G. Medioni, "Object Modelling by Registration of
Multiple Range Images", 1992).

For clouds that are compared once. The tracker aligns a frame to voxels of Gaussians instead, by compiled G-ICP, see
`tracking.gicp`; `kdtree_gicp.py` is what that is measured against and shares nothing with either on purpose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.errors import InputError
from ggslam.geometry.clouds import Cloud, Overlap, Points, as_cloud, check_distance, overlap
from ggslam.geometry.surface_distances import LazyNormals
from ggslam.scene.poses import orthonormalize, se3_exp, transform_points, translation, turning_angle
from ggslam.system.tuning import Tuning


class IcpTuning(Tuning):
    """Point-to-plane ICP."""

    min_pairs = 10
    """Fewest pairs of points that determine a pose."""
    min_step = 3e-5
    """Step, in metres and radians, below which ICP ends."""


@dataclass(frozen=True)
class CloudRegistration:
    """Result of ICP.

    Attributes:
        T_target_source: float64 [4, 4].
        overlap: of the moved source upon the target, over all points.
        moved_m, turned_deg: size of the motion from the start to the result, `moved_m` at the middle of the source.
        iterations: made at all distances together.
        converged: whether the last distance ended by a small step.
    """

    T_target_source: np.ndarray
    overlap: Overlap
    moved_m: float
    turned_deg: float
    iterations: int
    converged: bool


def register(
    source: Points, target: Points, target_normals: np.ndarray | None = None,
    max_distances: Sequence[float] = (0.25, 0.10, 0.05), T_start: np.ndarray | None = None, iterations: int = 30,
    sample: int = 50_000, seed: int = 0, kernels: Sequence[float] | None = None,
) -> CloudRegistration:  # fmt: skip
    """Finds the motion that brings a source upon a target.

    Args:
        source, target: [N, 3] and [M, 3] metres.
        target_normals: [M, 3]; None: estimated where they are needed. Pairs with a normal of zero do not count.
        max_distances: pairs farther apart are no pairs; from the first to the last. The last counts for the overlap.
        T_start: T_target_source to begin with; None: the identity.
        iterations: at most, at each distance.
        sample: the source's points that steer the motion, drawn at random.
        seed: of the draw.
        kernels: at each distance, the size in metres from which on a point-to-plane distance counts for less (Geman and
            McClure); None: all count alike.

    Raises:
        InputError: a cloud is empty or not finite, a distance is not positive, or fewer than 10 points have a partner
            at some iteration.
    """
    source, target = as_cloud(source), as_cloud(target)
    distances = [check_distance(d) for d in max_distances]
    centre = target.points.mean(0)
    normals = LazyNormals(target, target_normals)
    chosen = source.points[source.sample(sample, seed)]
    start = np.eye(4) if T_start is None else np.asarray(T_start, np.float64)
    T, made, converged = start, 0, False
    sizes = [np.inf] * len(distances) if kernels is None else [check_distance(size) for size in kernels]
    for distance, size in zip(distances, sizes, strict=True):
        converged = False
        for _ in range(iterations):
            step = _step(transform_points(chosen, T), target, normals, distance, size, centre)
            T = orthonormalize(translation(centre) @ se3_exp(step) @ translation(-centre) @ T)
            made += 1
            if np.abs(step).max() < IcpTuning.min_step:
                converged = True
                break
    middle = source.points.mean(0, keepdims=True)
    return CloudRegistration(
        T_target_source=T,
        overlap=overlap(source, target, distances[-1], T, seed),
        moved_m=float(np.linalg.norm(transform_points(middle, T) - transform_points(middle, start))),
        turned_deg=float(np.degrees(turning_angle(start, T))),
        iterations=made,
        converged=converged,
    )


def _step(
    moved: np.ndarray, target: Cloud, normals: LazyNormals, distance: float, kernel: float, centre: np.ndarray
) -> np.ndarray:
    """Gauss-Newton step (translation, rotation) [6], applied from the left about a centre [3], of the point-to-plane
    distances. About an origin far away, turning and moving could not be told apart."""
    apart, nearest = target.tree.query(moved, distance_upper_bound=distance, workers=-1)
    pairs = np.isfinite(apart)
    if pairs.sum() < IcpTuning.min_pairs:
        raise InputError(f"expected at least {IcpTuning.min_pairs} points within {distance} m of the target, found "
                         f"{int(pairs.sum())} of {len(moved)}")  # fmt: skip
    p, q, n = moved[pairs], target.points[nearest[pairs]], normals.of(nearest[pairs])
    J = np.concatenate([n, np.cross(p - centre, n)], 1)
    residual = ((p - q) * n).sum(1)
    weight = 1 / (1 + (residual / kernel) ** 2) ** 2
    # Directions that nothing holds stay as they are.
    return np.linalg.lstsq((J * weight[:, None]).T @ J, -J.T @ (weight * residual), rcond=1e-9)[0]
