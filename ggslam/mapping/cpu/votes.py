# SPDX-License-Identifier: Apache-2.0
"""What the votes that Gaussians carry say: the rendering weight each had under the mask ids it was seen with most."""

from __future__ import annotations

import numpy as np

from ggslam.scene.gaussian_map import GaussianMap


def vote_labels(gaussians: GaussianMap) -> np.ndarray:
    """Object with the most votes of each Gaussian, uint16 [N], 0 where there are none."""
    return vote_shares(gaussians)[0]


def vote_shares(gaussians: GaussianMap) -> tuple[np.ndarray, np.ndarray]:
    """Object with the most votes of each Gaussian, uint16 [N], and its share of all votes there, [N]; 0 where there are
    none."""
    ids, weights = gaussians.vote_ids.numpy(), gaussians.vote_weights.numpy()
    best = weights.argmax(1)[:, None]
    most = np.take_along_axis(weights, best, 1)[:, 0]
    label = np.where(most > 0, np.take_along_axis(ids, best, 1)[:, 0], 0)
    return label.astype(np.uint16), most / np.maximum(weights.sum(1), 1e-12)


def merge_votes(gaussians: GaussianMap, alias: np.ndarray) -> None:
    """Replaces ids in the votes by `alias` [65536]; slots that then name one object become one."""
    ids, weights = gaussians.vote_ids.numpy(), gaussians.vote_weights.numpy()
    ids[:] = alias[ids]
    weights[ids == 0] = 0
    for a in range(ids.shape[1]):
        for b in range(a + 1, ids.shape[1]):
            same = (ids[:, a] == ids[:, b]) & (ids[:, a] != 0)
            weights[same, a] += weights[same, b]
            ids[same, b], weights[same, b] = 0, 0
