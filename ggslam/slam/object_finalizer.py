# SPDX-License-Identifier: Apache-2.0
"""The objects that a run has learned. They are finalized once, at its end."""

from __future__ import annotations

import numpy as np

from ggslam.mapping.mapper import Mapper
from ggslam.slam.map_paging import MapPager
from ggslam.slam.object_chances import count_chances, typical_points
from ggslam.slam.object_masks import ObjectMasks, observations
from ggslam.slam.result import LearnedObjects
from ggslam.system.savable import savable


@savable(not_saved="_masks", formerly="ggslam.slam.run_objects.RunObjects")
class ObjectFinalizer:
    """Objects of a run.

    Args:
        masks: of its keyframes.
    """

    learned: LearnedObjects | None

    def __init__(self, masks: ObjectMasks) -> None:
        self._masks = masks
        self.learned = None
        """Those of the map that the run started from until `finalize`, then those of this run."""
        self._settled = False

    def finalize(self, mapper: Mapper, pager: MapPager | None) -> LearnedObjects | None:
        """The last identity steps, and every Gaussian's object; only the first call does anything. None if nothing was
        learned.

        Args:
            mapper: of the run.
            pager: of its map; None: all of it is in memory.
        """
        identity = mapper.identity
        if self._settled or identity is None or not identity.table.count:
            return self.learned
        self._settled = True  # if it fails below, the map can still be had by another call
        earlier = None if self.learned is None else self.learned.observations
        keyframes = [keyframe for keyframe in mapper.keyframes if keyframe.index not in mapper.left_out]
        seen = observations(keyframes, identity.current, earlier)
        labels = mapper.vote_labels()
        sizes = np.bincount(labels, minlength=65536)
        if pager is not None:
            sizes += pager.vote_sizes()
        chances: dict[int, int] = {}
        if self._masks.supervision != "masks":
            points = typical_points(mapper.map.means.cpu().numpy(), labels)
            since = {i: observation.first_frame for i, observation in seen.items()}
            chances = count_chances(points, since, keyframes)
        ids, known = identity.classifier.class_ids, earlier or {}
        noise = self._masks.noise(ids, seen, len(keyframes), sizes, chances, known)
        identity.forget(mapper.map, noise)
        mapper.finish_identity()
        kept = {i: observation for i, observation in seen.items() if i not in noise}
        self.learned = LearnedObjects(identity.classifier, self._masks.supervision, kept)
        return self.learned
