# SPDX-License-Identifier: Apache-2.0
"""Finds the object at a place."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ggslam.errors import InputError
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.given_map import given_map


def objects_at(
    gaussians: GaussianMap, points: np.ndarray, radius: float = 0.05, min_opacity: float = 0.1
) -> np.ndarray:
    """Object of the nearest Gaussian at each place.

    Args:
        gaussians: a map whose Gaussians have object ids: of a finished run with masks, or read from its map.ply.
        points: [n, 3] or [3], metres, world frame.
        radius: metres; places farther than this from any Gaussian's centre have no object.
        min_opacity: fainter Gaussians are not looked at.

    Returns:
        uint16 [n] object ids, 0 = no object.

    Raises:
        InputError: points of another shape, or that are not finite, or no map.
    """
    gaussians = given_map(gaussians)
    places = np.atleast_2d(np.asarray(points, np.float64))
    if places.ndim != 2 or places.shape[1] != 3 or not np.isfinite(places).all():
        raise InputError(f"points: expected finite numbers [n, 3], found shape {list(np.shape(points))}")
    rows = np.flatnonzero(gaussians.opacities.detach().cpu().numpy() >= min_opacity)
    found = np.zeros(len(places), np.uint16)
    if not len(rows) or not len(places):
        return found
    distance, nearest = cKDTree(gaussians.means.detach().cpu().numpy()[rows]).query(places, distance_upper_bound=radius)
    near = np.isfinite(distance)
    found[near] = gaussians.object_id.cpu().numpy()[rows[nearest[near]]]
    return found
