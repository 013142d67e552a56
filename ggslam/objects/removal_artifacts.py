# SPDX-License-Identifier: Apache-2.0
"""What a removed object leaves behind: Gaussians of its surroundings that were trained to look like its outline or to
mend its colour, and what was guessed where it hid everything."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ggslam.objects.hole_views import RENDERED, CameraView, HoleViewTuning, mark_removed, pick_views
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.segmented_rows import copies_of, keep_rows
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import PARAMETERS, Gaussians, GaussianTensors
from ggslam.scene.poses import inverse
from ggslam.sight.view import View
from ggslam.system.tuning import Tuning


class ArtifactTuning(Tuning):
    """When a Gaussian is left over from a removed object."""

    views = 32
    """Most views that are compared."""
    max_hidden = 0.15
    """It was hidden if its weight without the object is at most this share of its weight now."""
    max_clear = 0.5
    """It belongs to the object if at most this share of its weight lies beside the object."""


def places(removed: GaussianTensors, touching: float = 0.05) -> list[GaussianTensors]:
    """Splits what was removed into sets that hang together: each leaves one hole. Sets of a few floaters leave none.

    Args:
        removed: from any number of objects.
        touching: metres; things nearer to each other are one set.
    """
    points = removed.means.numpy()
    if not len(points):
        return []
    cell = max(touching / 2, 1e-6)
    cells, number = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells * cell).query_pairs(touching * 1.2, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), (len(cells), len(cells)))
    part = connected_components(links, directed=False)[1][number.reshape(-1)]
    sizes = np.bincount(part)
    large = np.flatnonzero(sizes >= max(8, 0.02 * len(points)))
    return [copies_of(removed, part == k) for k in large]


def drop_artifacts(
    scene: SegmentedMap, removed: GaussianTensors, views: Sequence[CameraView], ignored: Sequence[int] = (),
    spared: Sequence[int] = (),
) -> int:  # fmt: skip
    """Drops what a removed object left in its surroundings; returns how many Gaussians.

    Args:
        scene: the map without what was removed; changed in place.
        removed: Gaussians that were there, one of `places`.
        views: from where the map was seen.
        ignored: ids of objects that are no part of the surroundings and stay as they are.
        spared: ids of objects that are, and stay as they are: the removed was cut out of them.
    """
    owners = scene.gaussians.object_id.numpy()
    around = ~np.isin(owners, list(ignored))
    dropped = np.zeros(len(around), bool)
    dropped[around] = find_artifacts(copies_of(scene.gaussians, around), removed, views)
    dropped &= ~np.isin(owners, list(spared))
    keep_rows(scene, ~dropped)
    return int(dropped.sum())


def find_artifacts(kept: Gaussians, removed: Gaussians, views: Sequence[CameraView]) -> np.ndarray:
    """Which of the kept Gaussians are no observation of what is there without the object, bool [N].

    What such a Gaussian adds to the views goes mostly to pixels that the object covers, or nowhere: it was trained to
    look like the object or to mend its colour from behind, or is the object's under a wrong label (masks are wrong by a
    pixel along outlines), or was hidden nearly all the time and only shows now. Those far from the object, by its own
    size, stay, and those that stand before it.
    """
    own, means = removed.means.numpy(), kept.means.numpy()
    reach = float(np.linalg.norm(np.ptp(own, axis=0)))
    near = np.isfinite(cKDTree(own).query(means, distance_upper_bound=reach)[0])
    both, rasterizer = mark_removed(kept, removed), CpuRasterizer()
    alone = GaussianTensors(**{name: getattr(both, name)[: len(near)] for name in PARAMETERS})
    weights = torch.zeros(len(near), 3)
    for view in pick_views([view for view in views if view.project(means[near])[2].any()], ArtifactTuning.views):
        image = rasterizer.forward(both, view.camera, view.T_camera_world).features
        assert image is not None
        covered = (image[0] > HoleViewTuning.covered).float()
        covered = torch.nn.functional.max_pool2d(covered[None, None], 3, 1, 1)[0, 0]
        added = _pixel_weights(rasterizer, [1 - covered, covered])[: len(near)]
        if covered.any():
            rasterizer.forward(alone, view.camera, view.T_camera_world)
            weights[:, 2] += _pixel_weights(rasterizer, [covered, covered])[:, 0]
            before = torch.from_numpy(_before(means, removed, view))
            added[before] = torch.stack([added[before].sum(1), torch.zeros(int(before.sum()))], 1)
        weights[:, :2] += added
    clear, through, now = weights.numpy().T
    return near & ((clear <= ArtifactTuning.max_clear * (clear + through)) | (clear <= ArtifactTuning.max_hidden * now))


def _before(points: np.ndarray, removed: Gaussians, view: CameraView) -> np.ndarray:
    """Which points [N, 3] stand clearly before an object, bool [N]: what they hide of it is no artifact of it."""
    out = CpuRasterizer().forward(removed, view.camera, view.T_camera_world, features=False)
    depth = np.where(out.alpha.numpy() > HoleViewTuning.covered, out.expected_depth.numpy(), np.inf).astype(np.float32)
    nearest = cv2.erode(depth, np.ones((5, 5), np.uint8))
    nearest[~np.isfinite(nearest)] = 0
    sight = View.of(nearest, view.camera, inverse(view.T_camera_world), RENDERED)
    return sight.classify_points(points).before


def _pixel_weights(rasterizer: CpuRasterizer, areas: Sequence[torch.Tensor]) -> torch.Tensor:
    """What each Gaussian of the last rendering added to some areas (images of 0 and 1), float32 [N, areas]: the
    derivative of a feature image's sum over an area is the sum of the Gaussian's weights there."""
    gradients = rasterizer.backward(None, grad_features=torch.stack(list(areas)))
    assert gradients.features is not None
    return gradients.features
