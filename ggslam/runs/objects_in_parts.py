# SPDX-License-Identifier: Apache-2.0
"""A run's map with its objects, read in parts: a view or a block of rows is in memory at a time."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ggslam.errors import RunFolderError
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.table import ObjectTable
from ggslam.reporting.pictures import IdentityColors, IdentityPictureTuning
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_index import MapInParts
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier


@dataclass(frozen=True)
class ObjectsInParts:
    """The objects and the map they are of.

    Attributes:
        map: on disk.
        classifier, table: as of a `SegmentedMap`.
        counts: Gaussians of each object id, 0 being those of none.
    """

    folder: RunFolder
    map: MapInParts
    classifier: IdentityClassifier
    table: ObjectTable
    counts: Counter[int]

    @staticmethod
    def of(folder: RunFolder) -> ObjectsInParts:
        """That of a run.

        Raises:
            RunFolderError: the run has no objects, or its files do not belong together.
            FormatError: a file is missing or damaged.
        """
        table, parts = folder.object_table(), folder.map_in_parts()
        classifier = folder.classifier()
        counts: Counter[int] = Counter()
        for block in parts.rows.blocks():
            ids, found = np.unique(block.object_id.numpy(), return_counts=True)
            counts.update(dict(zip(ids.tolist(), found.tolist(), strict=True)))
        folder.check_objects(table, classifier, parts.rows.like, counts)
        return ObjectsInParts(folder, parts, classifier, table, counts)

    def in_view(self, camera: Camera, T_camera_world: np.ndarray) -> SegmentedMap:
        """What a camera may see, without votes; see `MapInParts.in_view`."""
        return self.around(self.map.in_view(camera, T_camera_world))

    def around(self, gaussians: GaussianMap) -> SegmentedMap:
        """Some of the Gaussians with the objects of all."""
        return SegmentedMap(gaussians, self.classifier, self.table)

    def identity_colors(self) -> IdentityColors:
        """Colours of the identity vectors of the map, fitted to its labelled Gaussians; RunFolderError: it has none."""
        if not self.map.rows.like.feature_channels:
            raise RunFolderError(f"{self.folder.path}: its Gaussians have object ids, but no identity vectors")
        step = max(1, sum(count for name, count in self.counts.items() if name > 0) // IdentityPictureTuning.fitted)
        sample, seen = [np.empty((0, self.map.rows.like.features.shape[1]), np.float32)], 0
        for block in self.map.rows.blocks():
            labelled = np.flatnonzero(block.object_id.numpy() > 0)
            sample.append(block.features.numpy()[labelled[-seen % step :: step]])
            seen += len(labelled)
        return IdentityColors(np.concatenate(sample))

    def vote_labels(self) -> np.ndarray | None:
        """The heaviest id of each Gaussian, uint16 [N]; None if votes were not counted.

        Raises:
            FormatError, RunFolderError: they are damaged or not of this map.
        """
        votes = self.folder.path / "votes.npz"
        if not votes.is_file():
            return None
        labels = ObjectVotes.labels_in_file(votes)
        self.folder.check_votes(len(labels), len(self.map))
        return labels
