# SPDX-License-Identifier: Apache-2.0
"""`ggslam.mapping.cpu.votes` on the map's device. Nothing waits for it."""

from __future__ import annotations

import torch

from ggslam.scene.gaussian_map import GaussianMap


def vote_labels(gaussians: GaussianMap) -> torch.Tensor:
    """Object with the most votes of each Gaussian, int32 [N], 0 where there are none."""
    return vote_shares(gaussians)[0]


def vote_shares(gaussians: GaussianMap) -> tuple[torch.Tensor, torch.Tensor]:
    """Object with the most votes of each Gaussian, int32 [N], and its share of all votes there, float32 [N]; 0 where
    there are none."""
    ids, weights = gaussians.vote_ids, gaussians.vote_weights
    most, best = weights.max(1)
    labels = torch.where(most > 0, ids.gather(1, best[:, None])[:, 0], 0)
    return labels, most / weights.sum(1).clamp_min(1e-12)


def merge_votes(gaussians: GaussianMap, alias: torch.Tensor) -> None:
    """Replaces ids in the votes by `alias` (int32 [65536] on the device); slots that then name one object become
    one."""
    ids, weights = gaussians.vote_ids, gaussians.vote_weights
    ids.copy_(alias[ids.long()])
    weights.masked_fill_(ids == 0, 0)
    for a in range(ids.shape[1]):
        for b in range(a + 1, ids.shape[1]):
            same = (ids[:, a] == ids[:, b]) & (ids[:, a] != 0)
            weights[:, a] += torch.where(same, weights[:, b], 0)
            ids[:, b].masked_fill_(same, 0)
            weights[:, b].masked_fill_(same, 0)
