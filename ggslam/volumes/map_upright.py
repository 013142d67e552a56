# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a map of Gaussians."""

from __future__ import annotations

import numpy as np

from ggslam.geometry.normals import estimate_normals, turn_toward
from ggslam.rendering.types import Gaussians
from ggslam.system.tuning import Tuning
from ggslam.volumes.upright import Upright, estimate_up


class MapUprightTuning(Tuning):
    """Which Gaussians show the direction up."""

    samples = 20_000
    """Gaussians that are used, about."""
    neighbours = 64
    """Neighbours that give the normal at a Gaussian."""
    max_thickness = 0.1
    """Largest variance along the normal, as a share of the variance across. Five rooms came out within 0.1 to 1.8
    degrees."""
    min_opacity_logit = 0.0
    """Logit of the opacity above which a Gaussian belongs to a surface."""
    min_support = 0.05
    """Smallest share of the points on horizontal surfaces."""


def upright_of(gaussians: Gaussians, poses: np.ndarray, samples: int | None = None) -> Upright:
    """Up and floor from the surfaces of a map: the planes that neighbouring Gaussians lie in.

    Args:
        gaussians: the map.
        poses: T_world_camera [N, 4, 4] of the frames.
        samples: Gaussians that are used, about; None: `MapUprightTuning.samples`. With 4,000 rooms came out within
            .2 degrees and 2 mm of 20,000, in a third of the time.
    """
    opaque = gaussians.opacity_logits.numpy() > MapUprightTuning.min_opacity_logit
    points = gaussians.means.numpy()[opaque].astype(np.float64)
    rows = np.arange(0, len(points), max(1, len(points) // (samples or MapUprightTuning.samples)))
    if len(points) <= MapUprightTuning.neighbours:
        return estimate_up(poses, np.zeros((0, 3)), np.zeros((0, 3)))
    normals = estimate_normals(points, rows, MapUprightTuning.neighbours, thickness=MapUprightTuning.max_thickness)
    # A plane has no front; a camera saw it from the side where the cameras are.
    normals = turn_toward(normals, poses[:, :3, 3].mean(axis=0) - points[rows])
    return estimate_up(poses, points[rows], normals, MapUprightTuning.min_support)
