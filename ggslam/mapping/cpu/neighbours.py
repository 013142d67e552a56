# SPDX-License-Identifier: Apache-2.0
"""The 3-D regularisation of identity vectors, on an index of neighbours that is refreshed as the map changes.

Ye et al., "Gaussian Grouping", 2024, eq. 4: L = (l_val / C) mean over sampled Gaussians j and their k nearest
neighbours i of KL(P_j || Q_i), P and Q being softmax(classifier(identity)), with being nothing as one class more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityVectorTuning
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class NeighbourTuning(Tuning):
    """Neighbours for the regularisation of identity vectors."""

    max_points = 65536
    """Most Gaussians that are indexed. Of a larger map, every second, third, ... one is."""


_COUNTERS = ("_growth", "_order", "_size", "_stride", "built")


@savable(save="state", take="set_state")
class NeighbourIndex:
    """k nearest neighbours among the Gaussians' means. Rows are those of the map as it is now.

    Args:
        growth: share by which the map may grow until the tree is built anew. Removals always lead to a new tree.
    """

    def __init__(self, growth: float) -> None:
        self._growth = growth
        self._tree: cKDTree | None = None
        self._order = -1
        self._size, self._stride = 0, 1  # of the map when the tree was built; every so manyth Gaussian is in it
        self.built = 0
        """Number of times the tree was built."""

    @staticmethod
    def tree_of(points: np.ndarray) -> cKDTree:
        """A tree of points [n, 3]; the same points always give the same one."""
        # Unbalanced and loose: built in a third of the time, asked nearly as fast.
        return cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False)

    def state(self) -> dict[str, Any]:
        """What is saved: counters, and the tree as its points, which float32 holds."""
        points = None if self._tree is None else np.asarray(self._tree.data).astype(np.float32)
        return {**{name: getattr(self, name) for name in _COUNTERS}, "points": points}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Fills the index from what `state` gave."""
        for name in _COUNTERS:
            setattr(self, name, saved[name])
        self._tree = None if saved["points"] is None else self.tree_of(saved["points"])

    def neighbours(self, gaussians: GaussianMap, rows: np.ndarray, k: int) -> np.ndarray:
        """int64 [M, k], the k nearest other Gaussians of each of `rows` [M]; k is less in a tiny map. In a map of more
        than `NeighbourTuning.max_points` those of a part of it."""
        size, means = len(gaussians), gaussians.means.numpy()
        if self._tree is None or self._order != gaussians.order or size > self._size * (1 + self._growth):
            self._stride = -(-size // NeighbourTuning.max_points)
            self._tree = self.tree_of(means[:: self._stride].copy())
            self._order, self._size = gaussians.order, size
            self.built += 1
        k = min(k, self._tree.n - 1)
        _, found = self._tree.query(means[rows], k + 1)
        found *= self._stride
        itself = rows % self._stride == 0  # is among those that are looked at, and the nearest
        return np.where(itself[:, None], found[:, 1:], found[:, :-1])


def kl_gradient(logits: np.ndarray, neighbour_logits: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mean of KL(P || Q) over samples and neighbours, and its gradients.

    Args:
        logits: of the samples, [M, C].
        neighbour_logits: [M, k, C].

    Returns:
        The mean, d mean / d logits [M, C], d mean / d neighbour_logits [M, k, C].
    """
    (log_p, nothing_p), (log_q, nothing_q) = _log_softmax(logits[:, None]), _log_softmax(neighbour_logits)
    p = np.exp(log_p)
    difference = log_p - log_q
    kl = (p * difference).sum(-1, keepdims=True) + np.exp(nothing_p) * (nothing_p - nothing_q)
    pairs = kl.size
    return (
        float(kl.sum() / pairs),
        (p * (difference - kl)).sum(1) / pairs,
        (np.exp(log_q) - p) / pairs,
    )


def _log_softmax(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the classes [..., C] and of nothing [..., 1]."""
    highest = z.max(-1, keepdims=True, initial=IdentityVectorTuning.nothing_logit)
    z, nothing = z - highest, IdentityVectorTuning.nothing_logit - highest
    log_sum = np.log(np.exp(z).sum(-1, keepdims=True) + np.exp(nothing))
    return z - log_sum, nothing - log_sum
