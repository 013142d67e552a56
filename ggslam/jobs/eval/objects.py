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
from ggslam.objects.rendered_ids import object_ids
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import vote_label_image
from ggslam.rendering.types import RenderBuffers
from ggslam.reporting.pictures import color_of_ids, identity_picture
from ggslam.runs.map_index import MapInParts
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.scene.frame import Frame
from ggslam.system.tuning import Tuning


class ObjectScoreTuning(Tuning):
    """At which pixels and views objects are scored."""

    vote_stride = 2
    """Labels by votes are scored at every n-th pixel of every n-th row: at all pixels they would cost more than all
    other scores."""
    truth_stride = 3
    """Every n-th view votes for the true labels of Gaussians: many views see each Gaussian."""


_NOTHING = np.empty(0, np.int32), np.empty(0, np.float32)



class ObjectScorer:
    """Compares rendered object ids with the masks of the frames.

    Args:
        objects: the map and its objects.
        sets: name of each set of views -> the `Frame.index` values that belong to it; "all" must be one and hold the
            others.
        names: of true ids, where known.
    """

    def __init__(self, objects: ObjectsInParts, sets: Mapping[str, set[int]], names: Mapping[int, str]) -> None:
        self._objects, self._sets, self._names = objects, sets, names
        self._learned = {name: SegmentationCounts() for name in sets}
        self._voted = {name: SegmentationCounts(boundary=None) for name in sets}
        self._votes = objects.vote_labels()
        self._truth = GaussianTruth(len(objects.map))
        self._palette = objects.table.palette()
        self._colors = objects.identity_colors()

    @property
    def map(self) -> MapInParts:
        """The map."""
        return self._objects.map

    def add(
        self, frame: Frame, rasterizer: CpuRasterizer, view: RenderBuffers, T_camera_world: np.ndarray,
        pictured: Frame | None,
    ) -> list[np.ndarray] | None:  # fmt: skip
        """Counts one view in, if its frame has a mask.

        Args:
            frame: the recorded frame.
            rasterizer: which rendered `view` last.
            view: the rendered frame with features, of what `map.in_view` gave last.
            T_camera_world: [4, 4], the pose it was rendered from.
            pictured: the frame with the mask that pictures show, all of whose pixels have ids; None: no pictures are
                wanted.

        Returns:
            Pictures of the true ids, the rendered ids and the rendered identities, uint8 [H, W, 3], if wanted. True ids
            have the colours of the objects they match in this view.
        """
        if frame.mask is None and pictured is None:
            return None
        scene = self._objects.in_view(frame.camera, T_camera_world)
        ids = object_ids(rasterizer, view, scene)
        truth = frame.mask if frame.mask is not None else np.zeros_like(ids)
        counts = SegmentationCounts()
        if frame.mask is not None:
            counts.add(ids, truth)
            self._merge(self._learned, frame.index, counts)
            rows = self.map.shown_rows()
            if (self._learned["all"].frames - 1) % ObjectScoreTuning.truth_stride == 0:
                means = scene.gaussians.means.numpy()
                self._truth.add(frame.camera, T_camera_world, frame.depth, truth, means, rows)
            if self._votes is not None:
                voted = SegmentationCounts(boundary=None)
                labels = vote_label_image(rasterizer, view, self._votes[rows], stride=ObjectScoreTuning.vote_stride)
                voted.add(labels, truth[::ObjectScoreTuning.vote_stride, ::ObjectScoreTuning.vote_stride])
                self._merge(self._voted, frame.index, voted)
        if pictured is None:
            return None
        drawn = truth if pictured.mask is None else pictured.mask
        return [
            color_of_ids(drawn, self._truth_palette(counts.match())),
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
        out["supervision"] = self._objects.table.supervision
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
        blocks = [(b.object_id.numpy().copy(), b.opacities.numpy()) for b in self.map.rows.blocks()] or [_NOTHING]
        labels, opacities = (np.concatenate(column) for column in zip(*blocks, strict=True))
        scores = asdict(self._truth.scores(labels, opacities, learned))
        by_votes = None if self._votes is None else self._truth.scores(self._votes, opacities, voted).accuracy
        return {**scores, "votes_accuracy": by_votes}
