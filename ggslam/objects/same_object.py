# SPDX-License-Identifier: Apache-2.0
"""Which objects of two maps are one thing: by the surface they share, and by their shapes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.geometry.voxels import voxel_keys
from ggslam.objects.settings import SameObjectSettings
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class SameObjectTuning(Tuning):
    """Which Gaussians tell that two objects are one."""

    min_opacity = 0.1
    """Smallest opacity."""


@dataclass(frozen=True)
class LabelledVoxels:
    """A map in voxels.

    Attributes:
        keys: int64 [V], ascending.
        labels: uint16 [V], object with the most opacity in each, 0 = none.
    """

    keys: np.ndarray
    labels: np.ndarray

    @staticmethod
    def of(means: np.ndarray, labels: np.ndarray, weights: np.ndarray, voxel: float) -> LabelledVoxels:
        """Of Gaussians: means [N, 3], object ids [N], weights [N]."""
        present, where = np.unique(voxel_keys(means, voxel), return_inverse=True)
        pairs, of_pair = np.unique(where.reshape(-1).astype(np.int64) << 16 | labels, return_inverse=True)
        weight = np.bincount(of_pair.reshape(-1), weights)
        order = np.lexsort((weight, pairs >> 16))  # the heaviest of a voxel comes last
        best = order[np.append(np.diff(pairs[order] >> 16) > 0, True)] if len(order) else order
        return LabelledVoxels(present, (pairs[best] & 0xFFFF).astype(np.uint16))

    @staticmethod
    def of_map(gaussians: GaussianMap, voxel: float, only: np.ndarray | None = None) -> LabelledVoxels:
        """Of a map whose Gaussians have objects; of these objects alone, if `only` names some."""
        opacities = gaussians.opacities.numpy()
        seen = opacities >= SameObjectTuning.min_opacity
        if only is not None:
            seen &= np.isin(gaussians.object_id.numpy(), only)
        labels = gaussians.object_id.numpy()[seen].astype(np.int64)
        return LabelledVoxels.of(gaussians.means.numpy()[seen], labels, opacities[seen], voxel)


def sizes_of(voxels: LabelledVoxels) -> np.ndarray:
    """Number of voxels of each object, int64 [65536]."""
    return np.bincount(voxels.labels, minlength=1 << 16)


@dataclass(frozen=True)
class Counterpart:
    """An object of a second map and the one of the first map that it is.

    Attributes:
        first, second: ids.
        score: share of the voxels they have in common of those that either has; or, of a part, of the smaller's.
        is_part: whether it is taken for a part of the first, or the other way round.
    """

    first: int
    second: int
    score: float
    is_part: bool


def find_counterparts(
    first: LabelledVoxels, second: LabelledVoxels, settings: SameObjectSettings
) -> list[Counterpart]:
    """For each object of the second map the one of the first that it is, if there is one. Only voxels that both maps
    know count, so that an object of which each map has another part is found by what they share.

    Several objects of the second map may be one of the first (it was cut into pieces there); an object of the second
    map is never more than one of the first.
    """
    _, a, b = np.intersect1d(first.keys, second.keys, assume_unique=True, return_indices=True)
    ours, theirs = first.labels[a].astype(np.int64), second.labels[b].astype(np.int64)
    sizes, their_sizes = np.bincount(ours, minlength=1 << 16), np.bincount(theirs, minlength=1 << 16)
    whole, their_whole = sizes_of(first), sizes_of(second)
    both = (ours > 0) & (theirs > 0)
    pairs, shared = np.unique(ours[both] << 16 | theirs[both], return_counts=True)
    best: dict[int, Counterpart] = {}
    for pair, count in zip(pairs.tolist(), shared.tolist(), strict=True):
        i, j = pair >> 16, pair & 0xFFFF
        if count < max(settings.min_shared, settings.min_share * min(whole[i], their_whole[j])):
            continue
        found = _judge(i, j, count, int(sizes[i]), int(their_sizes[j]), settings)
        if found is not None and (j not in best or found.score > best[j].score):
            best[j] = found
    return [best[j] for j in sorted(best)]


def _judge(
    first: int, second: int, shared: int, size: int, other: int, settings: SameObjectSettings
) -> Counterpart | None:
    """Whether two objects are one that fill so many of the voxels that both maps know."""
    overlap, smaller = shared / (size + other - shared), min(size, other)
    if overlap >= settings.min_overlap:
        return Counterpart(first, second, overlap, False)
    if shared >= settings.min_contained * smaller and max(size, other) <= settings.max_size_ratio * smaller:
        return Counterpart(first, second, shared / smaller, True)
    return None
