# SPDX-License-Identifier: Apache-2.0
"""Rows of a segmented map: Gaussians and their votes are dropped, appended and copied together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.rendering.types import PARAMETERS, Gaussians, GaussianTensors


def keep_rows(scene: SegmentedMap, rows: np.ndarray) -> None:
    """Keeps some Gaussians (bool [N])."""
    scene.gaussians.keep(torch.from_numpy(rows))
    if scene.votes is not None:
        scene.votes = ObjectVotes(scene.votes.ids[rows], scene.votes.weights[rows])


def append_copies(scene: SegmentedMap, rows: np.ndarray) -> np.ndarray:
    """Appends copies of some Gaussians (bool [N]); returns which they are, bool of the new length."""
    g, index = scene.gaussians, torch.from_numpy(np.flatnonzero(rows))
    new = g.insert(
        g.means[index], g.quaternions[index], g.log_scales[index], g.opacity_logits[index], g.rgb[index],
        g.features[index], object_id=g.object_id[index],
    )  # fmt: skip
    g.sh[new] = g.sh[index]
    g.birth_keyframe[new] = g.birth_keyframe[index]
    if scene.votes is not None:
        own = scene.votes
        scene.votes = ObjectVotes(
            np.concatenate([own.ids, own.ids[rows]]), np.concatenate([own.weights, own.weights[rows]])
        )
    return np.arange(len(g)) >= new.start


def copies_of(gaussians: Gaussians, rows: np.ndarray) -> GaussianTensors:
    """Some Gaussians (bool [N]) as they are now."""
    index = torch.from_numpy(np.flatnonzero(rows))
    return GaussianTensors(**{name: getattr(gaussians, name)[index] for name in PARAMETERS})


def join_gaussians(parts: Sequence[GaussianTensors]) -> GaussianTensors:
    """Several sets as one."""
    return GaussianTensors(**{name: torch.cat([getattr(part, name) for part in parts]) for name in PARAMETERS})


def merged_votes(votes: ObjectVotes, merged: int, kept: int) -> ObjectVotes:
    """Votes for `merged` counted for `kept`, in one slot."""
    ids, weights = np.where(votes.ids == merged, kept, votes.ids).astype(np.uint16), votes.weights.copy()
    own = ids == kept
    total, first = np.where(own, weights, 0).sum(1), own.argmax(1)
    weights[own], ids[own] = 0, 0
    rows = np.flatnonzero(own.any(1))
    ids[rows, first[rows]], weights[rows, first[rows]] = kept, total[rows]
    return ObjectVotes(ids, weights)


def votes_without(votes: ObjectVotes, ids: Sequence[int]) -> ObjectVotes:
    """Votes for some ids are taken out."""
    gone = np.isin(votes.ids, ids)
    return ObjectVotes(np.where(gone, 0, votes.ids).astype(np.uint16), np.where(gone, 0, votes.weights))
