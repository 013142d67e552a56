# SPDX-License-Identifier: Apache-2.0
"""Evaluates the votes of Gaussians: the rendering weight of each under its most frequent mask ids. Everything stays on
the map's device, and nothing waits for it."""

from __future__ import annotations

import torch

from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class VoteTuning(Tuning):
    """Reading of votes."""

    rows_at_once = 65536
    """Gaussians whose votes are read in one batch on the CPU, so that votes are not in memory twice."""


def vote_labels(gaussians: GaussianMap) -> torch.Tensor:
    """Object with the most votes of each Gaussian, int32 [N], 0 where there are none."""
    return vote_shares(gaussians)[0]


def vote_shares(gaussians: GaussianMap) -> tuple[torch.Tensor, torch.Tensor]:
    """Object with the most votes of each Gaussian, int32 [N], and its share of all votes there, float32 [N]; 0 where
    there are none."""
    ids, weights = gaussians.vote_ids, gaussians.vote_weights
    labels, most = _winners(ids, weights)
    total = sum(weights.unbind(1), torch.zeros_like(most))  # in this order on every device
    return labels, most / total.clamp_min(1e-12)


def vote_labels_of(gaussians: GaussianMap, rows: torch.Tensor) -> torch.Tensor:
    """As `vote_labels`, of some rows (int64 [M])."""
    return _winners(gaussians.vote_ids[rows], gaussians.vote_weights[rows])[0]


def _winners(ids: torch.Tensor, weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Id with the most weight of each row, 0 where there is none, and that weight."""
    most, best = weights.max(1)
    return torch.where(most > 0, ids.gather(1, best[:, None])[:, 0], 0), most


def merge_votes(gaussians: GaussianMap, alias: torch.Tensor) -> None:
    """Replaces ids in the votes by `alias` (int32 [65536] on the map's device); slots that then name one object become
    one."""
    ids, weights = gaussians.vote_ids, gaussians.vote_weights
    if ids.device.type != "cpu":  # to ask which rows change would wait for the device
        merged = alias[ids.long()]
        _merge_rows(merged, weights)
        ids.copy_(merged)
        return
    for ids_here, weights_here in zip(
        ids.split(VoteTuning.rows_at_once), weights.split(VoteTuning.rows_at_once), strict=True
    ):
        merged = alias[ids_here.long()]
        rows = (merged != ids_here).any(1).nonzero()[:, 0]
        if len(rows):
            ids_there, weights_there = merged[rows], weights_here[rows]
            _merge_rows(ids_there, weights_there)
            ids_here[rows], weights_here[rows] = ids_there, weights_there


def _merge_rows(ids: torch.Tensor, weights: torch.Tensor) -> None:
    """Slots of a row that name one object become one, and those that name none lose their weight."""
    weights.masked_fill_(ids == 0, 0)
    for a in range(ids.shape[1]):
        for b in range(a + 1, ids.shape[1]):
            same = (ids[:, a] == ids[:, b]) & (ids[:, a] != 0)
            weights[:, a] += torch.where(same, weights[:, b], 0)
            ids[:, b].masked_fill_(same, 0)
            weights[:, b].masked_fill_(same, 0)
