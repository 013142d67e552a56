# SPDX-License-Identifier: Apache-2.0
"""A map with its objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.objects.table import ObjectTable
from ggslam.scene.arrays import array_blocks, arrays_to_bytes, read_arrays
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.system.tuning import Tuning


class SegmentedMapTuning(Tuning):
    """How votes are read."""

    rows_at_once = 1 << 16
    """Rows that are read at a time."""


@dataclass
class ObjectVotes:
    """The mask ids under which each Gaussian was rendered with the most weight.

    Attributes:
        ids: uint16 [N, K], 0 = empty slot.
        weights: float32 [N, K], accumulated rendering weight, 0 in empty slots.
    """

    ids: np.ndarray
    weights: np.ndarray

    @staticmethod
    def of(gaussians: GaussianMap) -> ObjectVotes:
        """A copy of the votes that a map's Gaussians carry."""
        return ObjectVotes(gaussians.vote_ids.numpy().astype(np.uint16), gaussians.vote_weights.numpy().copy())

    def __len__(self) -> int:
        return len(self.ids)

    def labels(self) -> np.ndarray:
        """uint16 [N]: the heaviest id of each Gaussian, 0 where there is none."""
        return np.take_along_axis(self.ids, self.weights.argmax(1)[:, None], 1)[:, 0]

    def to_bytes(self) -> bytes:
        """Content of a file that `from_file` reads (NumPy's .npz)."""
        return arrays_to_bytes(ids=self.ids, weights=self.weights)

    @staticmethod
    def from_file(path: str | Path) -> ObjectVotes:
        """Reads votes.

        Raises:
            FormatError: missing, damaged, or arrays that do not fit together.
        """
        ids, weights = read_arrays(path, "votes", "ids", "weights")
        return ObjectVotes._check_votes(path, ids, weights)

    @staticmethod
    def labels_in_file(path: str | Path) -> np.ndarray:
        """`labels` of the votes in a file, which are never all in memory; errors as of `from_file`."""
        blocks = array_blocks(path, "votes", "ids", "weights", rows=SegmentedMapTuning.rows_at_once)
        labels = [ObjectVotes._check_votes(path, *block).labels() for block in blocks]
        return np.concatenate(labels) if labels else np.empty(0, np.uint16)

    @staticmethod
    def _check_votes(path: str | Path, ids: np.ndarray, weights: np.ndarray) -> ObjectVotes:
        if ids.ndim != 2 or ids.shape != weights.shape or not ids.shape[1] or not np.isfinite(weights).all():
            raise FormatError(f"{path}: shapes do not fit or weights are not finite: {ids.shape}, {weights.shape}")
        return ObjectVotes(ids.astype(np.uint16), weights.astype(np.float32))


@dataclass
class SegmentedMap:
    """A map whose Gaussians belong to objects.

    Attributes:
        gaussians: with `object_id` (0 = unlabelled) and identity vectors in `features`.
        classifier: of identity vectors.
        table: the objects.
        votes: of the Gaussians, if they were counted.
    """

    gaussians: GaussianMap
    classifier: IdentityClassifier
    table: ObjectTable
    votes: ObjectVotes | None = None
