# SPDX-License-Identifier: Apache-2.0
"""Scores of the objects of a run against true instance masks, collected while its views are rendered."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from ggslam.evaluation.gaussian_labels import GaussianTruth
from ggslam.evaluation.segmentation import Matching, SegmentationCounts
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import vote_label_image
from ggslam.rendering.types import RenderBuffers
from ggslam.rendering_jobs import identity_colors, identity_picture, object_ids
from ggslam.reporting.pictures import color_of_ids
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap

VOTE_STRIDE = 2
"""Labels by votes are scored at every second pixel of every second row: at all of them they would cost more than
everything else that is scored."""

TRUTH_STRIDE = 3
"""The true labels of Gaussians are voted for by every third view: each Gaussian is seen by many."""


class ObjectScorer:
    """Compares rendered object ids with the masks of the frames.

    Args:
        segmented: the map and its objects.
        sets: name of each set of views -> the `Frame.index` values that belong to it; "all" must be one and hold the
            others.
        names: of true ids, where known.
    """

    def __init__(self, segmented: SegmentedMap, sets: Mapping[str, set[int]], names: Mapping[int, str]) -> None:
        self._segmented, self._sets, self._names = segmented, sets, names
        self._learned = {name: SegmentationCounts() for name in sets}
        self._voted = {name: SegmentationCounts(boundary=None) for name in sets}
        self._votes = None if segmented.votes is None else segmented.votes.labels()
        self._truth = GaussianTruth(segmented.gaussians.means.numpy())
        self._palette = segmented.table.palette()
        self._colors = identity_colors(segmented)

    @property
    def gaussians(self) -> GaussianMap:
        """The map."""
        return self._segmented.gaussians

    def add(
        self, frame: Frame, rasterizer: CpuRasterizer, view: RenderBuffers, T_camera_world: np.ndarray, pictured: bool
    ) -> list[np.ndarray] | None:
        """Counts one view in, if its frame has a mask.

        Args:
            frame: the recorded frame.
            rasterizer: which rendered `view` last.
            view: the rendered frame with features.
            T_camera_world: [4, 4], the pose it was rendered from.
            pictured: whether pictures are wanted.

        Returns:
            Pictures of the true ids, the rendered ids and the rendered identities, uint8 [H, W, 3], if wanted. True ids
            have the colours of the objects they match in this view.
        """
        if frame.mask is None and not pictured:
            return None
        ids = object_ids(rasterizer, view, self._segmented)
        truth = frame.mask if frame.mask is not None else np.zeros_like(ids)
        counts = SegmentationCounts()
        if frame.mask is not None:
            counts.add(ids, truth)
            self._merge(self._learned, frame.index, counts)
            if (self._learned["all"].frames - 1) % TRUTH_STRIDE == 0:
                self._truth.add(frame.camera, T_camera_world, frame.depth, truth)
            if self._votes is not None:
                voted = SegmentationCounts(boundary=None)
                labels = vote_label_image(rasterizer, view, self._votes, stride=VOTE_STRIDE)
                voted.add(labels, truth[::VOTE_STRIDE, ::VOTE_STRIDE])
                self._merge(self._voted, frame.index, voted)
        if not pictured:
            return None
        return [
            color_of_ids(truth, self._truth_palette(counts.match())),
            color_of_ids(ids, self._palette),
            identity_picture(view, self._colors),
        ]

    def to_dict(self) -> dict[str, Any] | None:
        """What `metrics.json` holds as `segmentation`; None if no frame had a mask. Ids are matched once, over all
        views that were counted, and so for every set."""
        if not self._learned["all"].frames:
            return None
        learned, voted = self._learned["all"].match(), self._voted["all"].match()
        out: dict[str, Any] = {}
        for name, counts in self._learned.items():
            scores = asdict(counts.scores(learned))
            del scores["matching"], scores["per_object"]
            scores["votes_miou"] = math.nan if self._votes is None else self._voted[name].scores(voted).miou
            out[name] = scores
        out["matching"] = learned.kind
        out["supervision"] = self._segmented.table.supervision
        per_object = self._learned["all"].scores(learned).per_object
        out["per_object"] = {i: {"name": self._names.get(i), **asdict(score)} for i, score in per_object.items()}
        out["gaussians"] = self._gaussians(learned, voted)
        return out

    def _merge(self, sums: dict[str, SegmentationCounts], frame: int, counts: SegmentationCounts) -> None:
        for name, members in self._sets.items():
            if frame in members:
                sums[name].merge(counts)

    def _truth_palette(self, matching: Matching) -> np.ndarray:
        palette = self._palette.copy()
        for true_id, predicted in matching.predicted.items():
            palette[true_id] = self._palette[predicted]
        return palette

    def _gaussians(self, learned: Matching, voted: Matching) -> dict[str, Any]:
        gaussians = self._segmented.gaussians
        opacities = gaussians.opacities.numpy()
        scores = asdict(self._truth.scores(gaussians.object_id.numpy(), opacities, learned))
        by_votes = None if self._votes is None else self._truth.scores(self._votes, opacities, voted).accuracy
        return {**scores, "votes_accuracy": by_votes}
