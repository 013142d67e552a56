# SPDX-License-Identifier: Apache-2.0
"""Finds surfaces that a loop mapped twice: when the camera left and when it came back."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from ggslam.scene.gaussian_map import GaussianMap


def remove_duplicates(
    gaussians: GaussianMap, kept_births: np.ndarray, doubted_births: np.ndarray, least_distance_m: float
) -> int:
    """Drops Gaussians that lie on a surface which other keyframes had mapped before; returns how many.

    A doubted Gaussian goes if a kept one that is not transparent lies nearer than its own extent along the surface
    (and in any case if nearer than `least_distance_m`), so that what fills a hole between the kept ones stays.

    Args:
        gaussians: the map, after the loop was closed. Where it is on a GPU, means and scales are copied to the host.
        kept_births: numbers of the keyframes whose Gaussians stay.
        doubted_births: numbers of the keyframes whose Gaussians are judged.
        least_distance_m: what counts as the same place anyway: the depth camera's noise, metres.
    """
    birth = gaussians.birth_keyframe.cpu().numpy()
    kept = np.isin(birth, kept_births) & (gaussians.opacities.cpu().numpy() > 0.3)
    doubted = np.flatnonzero(np.isin(birth, doubted_births))
    if not kept.any() or not len(doubted):
        return 0
    means = gaussians.means.cpu().numpy()
    tree = cKDTree(means[kept])
    # The middle of the three scales is the lesser extent along a disc's surface.
    extent = np.sort(gaussians.scales.cpu().numpy()[doubted], axis=1)[:, 1]
    reach = np.maximum(extent, least_distance_m)
    distance, _ = tree.query(means[doubted], distance_upper_bound=float(reach.max()))
    stays = np.ones(len(gaussians), bool)
    stays[doubted[distance < reach]] = False
    return gaussians.keep(torch.from_numpy(stays))
