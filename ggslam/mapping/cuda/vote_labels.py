# SPDX-License-Identifier: Apache-2.0
"""`ggslam.mapping.votes.vote_labels` on an NVIDIA GPU, by one kernel, in memory that is used again."""

from __future__ import annotations

import ctypes

import torch

from ggslam.abi.cuda import VoteLabelJob
from ggslam.cuda.library import CudaLibrary
from ggslam.scene.gaussian_map import VOTE_SLOTS, GaussianMap


class CudaVoteLabels:
    """Labels of Gaussians by their votes.

    Args:
        device: of the map.
        library: the kernels.
    """

    def __init__(self, device: torch.device, library: CudaLibrary) -> None:
        self._device, self._library = device, library
        self._labels = torch.empty(0, dtype=torch.int32, device=device)

    def of(self, gaussians: GaussianMap) -> torch.Tensor:
        """Object with the most votes of each Gaussian of a map with votes, int32 [N], 0 where there are none; the next
        call overwrites it."""
        self._library.call("vote_labels", ctypes.byref(self.job(gaussians)))
        return self._labels[: len(gaussians)]

    def job(self, gaussians: GaussianMap) -> VoteLabelJob:
        """The same, for the library; its labels are valid until the next call."""
        if len(self._labels) < gaussians.count:
            self._labels = torch.empty(gaussians.capacity, dtype=torch.int32, device=self._device)
        storage = gaussians.storage
        return VoteLabelJob(
            vote_ids=storage["vote_ids"].data_ptr(), vote_weights=storage["vote_weights"].data_ptr(),
            labels=self._labels.data_ptr(), stream=self._library.stream(self._device), count=gaussians.count,
            device=self._device.index or 0, slots=VOTE_SLOTS,
        )  # fmt: skip
