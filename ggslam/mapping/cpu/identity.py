# SPDX-License-Identifier: Apache-2.0
"""Identity learning on the CPU, see `ggslam.mapping.identity`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.mapping.cpu.class_table import CpuClassTable
from ggslam.mapping.cpu.color_table import ColorTable, color_loss
from ggslam.mapping.cpu.cross_entropy import cross_entropy
from ggslam.mapping.cpu.neighbours import NeighbourIndex, kl_gradient
from ggslam.mapping.cpu.pixel_pool import draw_pool
from ggslam.mapping.identity import IdentityLearner, IdentityTuning, MaskedKeyframe
from ggslam.mapping.pixel_pool import PixelPool
from ggslam.mapping.votes import merge_votes, vote_labels, vote_labels_of
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.pixel_terms import CpuPixelTerms, FeatureAdamSettings
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import SH_C0, GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS, IdentityClassifier
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class CpuIdentityTuning(Tuning):
    """Limits of identity learning on the CPU."""

    kept_pools = 64
    """Keyframes whose drawn pixels are kept; about 64 KB each with the default settings."""
    other_classes = 128
    """Classes outside a step's sample that its softmax includes, drawn at random if there are more."""


@savable(not_saved="settings seed")
@dataclass
class CpuIdentityLearner(IdentityLearner):
    """Trains identity vectors and classifier, counts votes.

    Args:
        settings: see there.
        seed: of sampling.
    """

    kept_pools = CpuIdentityTuning.kept_pools
    last_loss: float = float("nan")
    """Cross-entropy of the last step, or mean difference of its colours."""

    def __post_init__(self) -> None:
        super().__post_init__()
        kind = ColorTable if self.settings.schedule == "colors" else CpuClassTable
        self.table: CpuClassTable = kind(self._rng)
        self._index = NeighbourIndex(self.settings.neighbours.growth)

    # --- objects ------------------------------------------------------------------------------------------------------

    def _merge_votes(self, gaussians: GaussianMap) -> None:
        merge_votes(gaussians, torch.from_numpy(self._alias.astype(np.int32)))

    def _follow_votes(self, gaussians: GaussianMap, before: torch.Tensor) -> None:
        rows = np.flatnonzero(self._alias[before.numpy()] != before.numpy())
        now = vote_labels_of(gaussians, torch.from_numpy(rows)).numpy()
        gaussians.features.numpy()[rows] = self.table.codes(now)

    def _dissolve(self, gaussians: GaussianMap, dropped: Sequence[int]) -> None:
        features, voted = gaussians.features.numpy(), vote_labels(gaussians).numpy()
        rows, were = self.table.members(features, np.array(dropped), voted)
        for object_id in dropped:
            self.table.remove(object_id)
        features[rows] = self.table.codes(np.where(voted[rows] > 0, voted[rows], self._alias[were]))

    def split(
        self, gaussians: GaussianMap, rasterizer: CpuRasterizer, mask: np.ndarray, splits: Sequence[tuple[int, int]]
    ) -> None:
        splits = self._split_off(splits)
        if not splits:
            return
        seen = (
            np.arange(mask.size)
            .reshape(mask.shape)[:: IdentityTuning.split_stride, :: IdentityTuning.split_stride]
            .reshape(-1)
        )
        terms = rasterizer.pixel_terms(seen)
        used = np.arange(terms.weights.shape[1]) < terms.counts[:, None]
        gaussian, weight, size = terms.gaussians[used], terms.weights[used], len(gaussians)
        seen_as = np.repeat(self.current(mask.reshape(-1)[seen]), terms.counts)
        everywhere = np.maximum(np.bincount(gaussian, weight, size), 1e-9)
        ids, changed = gaussians.vote_ids.numpy(), []
        for whole, part in splits:
            inside = seen_as == part
            rows = np.flatnonzero(np.bincount(gaussian[inside], weight[inside], size) > 0.5 * everywhere)
            ids[rows] = np.where(ids[rows] == whole, part, ids[rows])
            changed.append(rows)
        self._merge_votes(gaussians)
        rows = np.concatenate(changed)
        if self.settings.initialisation == "votes" and len(rows):
            gaussians.features.numpy()[rows] = self.table.codes(vote_labels(gaussians).numpy()[rows])

    def _as_mapped(self, gaussians: GaussianMap, terms: CpuPixelTerms, labels: np.ndarray) -> np.ndarray:
        """Labels of pixels, those of a whole replaced by its part's where the map shows the part."""
        if not self._whole_of.any():
            return labels
        shown, _ = terms.labels(self._shown_labels(gaussians).numpy().astype(np.uint16))
        return np.where((self._whole_of[shown] == labels) & (shown > 0), shown, labels)

    def begin(self, gaussians: GaussianMap, rows: slice, labels: np.ndarray) -> None:
        ids = self.current(labels)
        gaussians.vote_ids.numpy()[rows, 0] = ids
        gaussians.vote_weights.numpy()[rows, 0] = np.where(ids > 0, IdentityTuning.birth_vote, 0)
        if self.settings.initialisation == "votes":
            gaussians.features.numpy()[rows] = self.table.codes(ids)
        else:
            shape = (len(labels), IDENTITY_CHANNELS)
            gaussians.features.numpy()[rows] = (self._rng.random(shape, np.float32) - 0.5) / SH_C0

    # --- steps --------------------------------------------------------------------------------------------------------

    def _learn_at_pixels(
        self, gaussians: GaussianMap, rasterizer: CpuRasterizer, keyframe: MaskedKeyframe, pixels: np.ndarray,
        vote_weights: np.ndarray, rate_factor: float,
    ) -> None:  # fmt: skip
        assert keyframe.mask is not None
        labels = self.current(keyframe.mask.reshape(-1)[pixels])
        terms = rasterizer.pixel_terms(pixels, IdentityTuning.max_terms, IdentityTuning.min_weight)
        labels = self._as_mapped(gaussians, terms, labels)
        classes = self.table.classes(labels)
        if self.settings.schedule == "sampled" and (classes >= 0).any():
            self._train(gaussians, terms, labels, vote_weights, classes, rate_factor)
        else:
            terms.vote(gaussians, labels, vote_weights)

    def _new_pool(self, keyframe: MaskedKeyframe, wanted: int) -> PixelPool[np.ndarray]:
        assert keyframe.mask is not None
        return draw_pool(self.current(keyframe.mask), wanted, self.settings, self._rng)

    def _dense(
        self, gaussians: GaussianMap, rasterizer: CpuRasterizer, keyframe: MaskedKeyframe, view: RenderBuffers
    ) -> torch.Tensor:
        s = self.settings
        assert keyframe.mask is not None and view.features is not None
        pixels = np.flatnonzero(keyframe.mask)
        labels = self.current(keyframe.mask.reshape(-1)[pixels])
        classes = self.table.classes(labels)
        pixels, labels, classes = (array[classes >= 0] for array in (pixels, labels, classes))
        features = view.features.numpy().reshape(IDENTITY_CHANNELS, -1)
        out, shown = np.zeros_like(features), features[:, pixels].T
        if s.schedule == "colors":
            self.last_loss, gradient = color_loss(shown, self.table.codes(labels))
            out[:, pixels] = s.weight * gradient.T
            return torch.from_numpy(out.reshape(view.features.shape))
        chosen = np.arange(self.table.count)
        self.last_loss, gradient, rows = cross_entropy(shown, self.classifier, classes, chosen, rasterizer.context)
        self.table.step(chosen, s.weight * rows, s.classifier_rate)
        out[:, pixels] = s.weight * gradient.T
        if self.pulls(gaussians):
            rows_pulled, pull = self._pull_together(gaussians)
            terms = CpuPixelTerms.of_gaussians(rows_pulled, 1, rasterizer.context)
            terms.step(gaussians, pull, FeatureAdamSettings(rate=s.rate))
        return torch.from_numpy(out.reshape(view.features.shape))

    def _train(
        self, gaussians: GaussianMap, terms: CpuPixelTerms, labels: np.ndarray, vote_weights: np.ndarray,
        classes: np.ndarray, rate_factor: float,
    ) -> None:  # fmt: skip
        """Votes and a step at pixels with these labels and their classes, int32 [P], some of which are none (-1): an
        object may have been taken back since its pixels were drawn."""
        s, features = self.settings, terms.features(gaussians)
        chosen = self._choose_competitors(classes[classes >= 0])
        self.last_loss, gradient, rows = cross_entropy(features, self.classifier, classes, chosen, terms.context)
        gradient *= np.float32(s.weight)
        if self.pulls(gaussians):
            pulled, pull = self._pull_together(gaussians)
            terms = terms.append(CpuPixelTerms.of_gaussians(pulled, terms.gaussians.shape[1], terms.context))
            gradient = np.concatenate([gradient, pull])
            labels, vote_weights = (np.pad(array, (0, len(pulled))) for array in (labels, vote_weights))
        terms.learn(gaussians, gradient, FeatureAdamSettings(rate=rate_factor * s.rate), labels, vote_weights)
        self.table.step(chosen, s.weight * rows, rate_factor * s.classifier_rate)

    def _choose_competitors(self, classes: np.ndarray) -> np.ndarray:
        """Classes that a step's softmax runs over: all, or with very many those that appear and some others."""
        if self.table.count <= CpuIdentityTuning.other_classes:
            return np.arange(self.table.count)
        return np.union1d(
            np.unique(classes), self._rng.choice(self.table.count, CpuIdentityTuning.other_classes, replace=False)
        )

    def _pull_together(self, gaussians: GaussianMap) -> tuple[np.ndarray, np.ndarray]:
        """Rows [R] of the 3-D loss and their gradients float32 [R, F]; a row may appear more than once."""
        s, classifier = self.settings.neighbours, self.classifier
        room = max(16, 400_000 // ((s.neighbours + 1) * max(1, len(classifier))))
        rows = self._rng.integers(0, len(gaussians), min(s.samples, room))
        near = self._index.neighbours(gaussians, rows, s.neighbours)
        features = gaussians.features.numpy()
        _, own, others = kl_gradient(classifier.logits(features[rows]), classifier.logits(features[near]))
        factor = np.float32(s.weight * s.value / len(classifier))
        gradient = np.concatenate([own, others.reshape(-1, len(classifier))]) @ classifier.weight
        return np.concatenate([rows, near.reshape(-1)]), (factor * gradient).astype(np.float32)

    def _learned_labels(self, gaussians: GaussianMap) -> torch.Tensor:
        ids = by_parts(self.classifier, gaussians.features.numpy(), self.settings.min_confidence)
        return torch.from_numpy(ids.astype(np.int32))


def by_parts(
    classifier: IdentityClassifier, features: np.ndarray, min_confidence: float, part: int = 16384
) -> np.ndarray:
    """Most probable object of each identity vector, uint16 [N], 0 below `min_confidence`; a part at a time, because N
    times C logits may not fit into memory."""
    out = np.zeros(len(features), np.uint16)
    for begin in range(0, len(features), part):
        ids, confidence = classifier.labels(features[begin : begin + part])
        out[begin : begin + part] = np.where(confidence >= min_confidence, ids, 0)
    return out
