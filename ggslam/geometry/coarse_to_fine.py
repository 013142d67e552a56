# SPDX-License-Identifier: Apache-2.0
"""Registers a cloud to another from a start that is a metre or so off: point-to-plane ICP of thinned clouds, whose
pairs may first be metres apart, then of all points.

Two things mislead ICP between scans. Pairs that may only be near each other hold a cloud where it began. And points in
rings or lines, as of laser scanners, have their nearest partners and neighbours along the lines, wherever the surface
is: of such sparse clouds pairs reach across the gaps, and normals are those of the thinned cloud where it shows planes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ggslam.errors import InputError
from ggslam.geometry.clouds import Cloud, Points, as_cloud, check_distance, overlap
from ggslam.geometry.icp import CloudRegistration, register
from ggslam.geometry.normals import estimate_normals
from ggslam.geometry.surface_distances import LazyNormals, surface_distances
from ggslam.geometry.thinning import thinned_points
from ggslam.scene.poses import separation, transform_points
from ggslam.system.tuning import Tuning


class CoarseToFineTuning(Tuning):
    """Steps of a registration that starts a metre off."""

    fine_m = (0.25, 0.10)
    """Largest distances of pairs of dense clouds, in metres, before the last step."""
    coarse_m = (2.0, 1.0, 0.5)
    """Largest distances of pairs of thinned clouds, in metres."""
    coarse_voxel_m = 0.25
    """Voxel of the thinned clouds, in metres."""
    max_last_m = 0.05
    """Largest distance of the last pairs, in metres, whatever the overlap distance is: many loose pairs outweigh good
    ones."""
    sparse_voxels = 1.5
    """Distance of the fourth nearest point, in voxels, from which a cloud counts as sparse."""
    sparse_distance = 2.0
    """Largest distance of pairs of sparse clouds, in multiples of that distance."""
    plane_thickness = 0.1
    """Largest thickness of a plane in a sparse cloud, see `estimate_normals`."""
    plane_width = 0.05
    """Smallest width of a plane in a sparse cloud, see `estimate_normals`."""
    kernels = (0.8, 0.4, 0.2)
    """Sizes of the robust kernel of sparse clouds, in voxels of their normals, one pass each."""
    same_share = 0.2
    """Largest difference of two results that are the same, as a share of the last pair distance."""


@dataclass(frozen=True)
class TargetSurface:
    """A cloud as the surface that another is registered to.

    Attributes:
        cloud: the points.
        normals: of it.
        pair_distance: metres that partners are apart at last.
        voxel: of the thinned cloud that gave the normals of a sparse one, metres; None: it is dense.
    """

    cloud: Cloud
    normals: LazyNormals
    pair_distance: float
    voxel: float | None

    @staticmethod
    def of(target: Points, max_distance: float) -> TargetSurface:
        """How a cloud is to be taken, if points `max_distance` metres apart are partners. Raises InputError if it is
        empty or not finite, or the distance is not positive."""
        cloud, distance = as_cloud(target), min(CoarseToFineTuning.max_last_m, check_distance(max_distance))
        spacing = point_spacing(cloud, distance)
        if spacing <= CoarseToFineTuning.sparse_voxels * distance:
            return TargetSurface(cloud, LazyNormals(cloud), distance, None)
        apart = CoarseToFineTuning.sparse_distance * spacing
        voxel = max(CoarseToFineTuning.coarse_voxel_m, apart)
        return TargetSurface(cloud, LazyNormals(cloud, _sparse_normals(cloud, voxel)), apart, voxel)


def register_coarse_to_fine(
    source: Points, target: Points, max_distance: float = 0.05, T_start: np.ndarray | None = None, seed: int = 0
) -> CloudRegistration:
    """Finds the motion that brings a source upon a target: the better one of ICP from the start, and from where coarse
    ICP leads.

    Args:
        source, target: [N, 3] and [M, 3] metres.
        max_distance: metres; the result's overlap is that within this distance. The last pairs of dense clouds are no
            farther apart than this and 5 cm.
        T_start: T_target_source to begin with; None: the identity.
        seed: of the draws.

    Raises:
        InputError: a cloud is empty or not finite, the distance is not positive, or too few points have a partner.
    """
    source, surface = as_cloud(source), TargetSurface.of(target, max_distance)
    start = np.eye(4) if T_start is None else np.asarray(T_start, np.float64)
    found: list[CloudRegistration] = []
    problem: InputError | None = None
    try:
        found.append(_fine(source, surface, start, seed))
    except InputError as error:
        problem = error
    coarse = _coarse(source, surface.cloud, start, max_distance, seed)
    same = CoarseToFineTuning.same_share * surface.pair_distance
    if coarse is not None and not (found and _far_apart(source, coarse, found[0].T_target_source) <= same):
        try:
            found.append(_fine(source, surface, coarse, seed))
        except InputError as error:
            problem = problem or error
    if not found:
        assert problem is not None
        raise problem

    def error_of(one: CloudRegistration) -> float:
        T, cut = one.T_target_source, CoarseToFineTuning.fine_m[0]
        off = surface_distances(source, surface.cloud, surface.pair_distance, cut, T, seed, surface.normals)
        return float((np.minimum(off, cut) ** 2).mean())

    return _from_start(min(found, key=error_of), source, surface.cloud, start, max_distance, seed)


def point_spacing(cloud: Points, voxel: float) -> float:
    """Metres from a typical point of a cloud, one kept per voxel, to the fourth nearest: on surfaces that are sampled
    more densely than the voxels, about a voxel. 0 of a cloud of a few points."""
    thinned = thinned_points(as_cloud(cloud).points, voxel)
    if len(thinned) < 5:
        return 0.0
    asked = thinned[Cloud(thinned).sample(20_000, 0)]
    return float(np.median(cKDTree(thinned).query(asked, 5, workers=-1)[0][:, 4]))


def _sparse_normals(cloud: Cloud, voxel: float) -> np.ndarray:
    """Normals [N, 3] of a cloud's points: that of the nearest point of the thinned cloud, zero where that is no
    plane."""
    thinned = thinned_points(cloud.points, voxel)
    tree = cKDTree(thinned)
    normals = estimate_normals(
        thinned, tree=tree, thickness=CoarseToFineTuning.plane_thickness, width=CoarseToFineTuning.plane_width
    )
    return normals[tree.query(cloud.points, workers=-1)[1]]


def _fine(source: Cloud, surface: TargetSurface, start: np.ndarray, seed: int) -> CloudRegistration:
    """ICP of all points."""
    if surface.voxel is None:
        steps = [*(max(surface.pair_distance, step) for step in CoarseToFineTuning.fine_m), surface.pair_distance]
        return register(source, surface.cloud, None, steps, start, seed=seed)
    thinned = Cloud(thinned_points(source.points, 0.4 * surface.voxel))
    normals = surface.normals.of(np.arange(len(surface.cloud)))
    reach, sizes = 2 * surface.voxel, [size * surface.voxel for size in CoarseToFineTuning.kernels]
    return register(thinned, surface.cloud, normals, [reach] * len(sizes), start, seed=seed, kernels=sizes)


def _coarse(source: Cloud, target: Cloud, start: np.ndarray, farthest: float, seed: int) -> np.ndarray | None:
    """T_target_source by the thinned clouds, pairs being `farthest` metres apart at first if that is more than usual;
    None if nothing holds them."""
    steps = [farthest] * (farthest > CoarseToFineTuning.coarse_m[0]) + list(CoarseToFineTuning.coarse_m)
    one, other = (thinned_points(cloud.points, CoarseToFineTuning.coarse_voxel_m) for cloud in (source, target))
    try:
        return register(one, other, None, steps, start, sample=20_000, seed=seed).T_target_source
    except InputError:
        return None


def _far_apart(source: Cloud, T_one: np.ndarray, T_other: np.ndarray) -> float:
    """Metres between where two poses bring the source, at most, by the corners of its box."""
    low, high = source.points.min(0), source.points.max(0)
    corners = np.array([np.where(step, high, low) for step in np.ndindex(2, 2, 2)])
    off = transform_points(corners, T_one) - transform_points(corners, T_other)
    return float(np.linalg.norm(off, axis=1).max())


def _from_start(
    found: CloudRegistration, source: Cloud, target: Cloud, start: np.ndarray, max_distance: float, seed: int
) -> CloudRegistration:
    """The result with its motion told from the start of all, and the overlap within the distance asked for."""
    T, middle = found.T_target_source, source.points.mean(0, keepdims=True)
    return replace(
        found, overlap=overlap(source, target, max_distance, T, seed),
        moved_m=float(np.linalg.norm(transform_points(middle, T) - transform_points(middle, start))),
        turned_deg=separation(start, T)[1],
    )  # fmt: skip
