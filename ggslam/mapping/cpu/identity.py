# SPDX-License-Identifier: Apache-2.0
"""Identity learning: every Gaussian learns which object it belongs to, from instance masks of the keyframes.

As in Ye et al., "Gaussian Grouping", 2024 and GG-SLAM, a Gaussian carries a 16-D identity vector o, rendered like
colour; a 1x1 convolution classifies what is rendered. Loss: l_obj CE(logits, mask) + l_obj3d (l_val / C) mean KL over
nearest neighbours. Otherwise than there

- the cross-entropy is taken at sampled pixels, balanced among objects, through the terms of the view that is rendered
  for its colours anyway (`rendering.pixel_terms`): no identity image is ever composited;
- classes are added as ids appear;
- the same terms count votes: how much rendering weight a Gaussian had under each mask id. They label the map from the
  first keyframe on, give new Gaussians their first vector, and check what was learned.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.mapping.cpu.class_table import ClassTable
from ggslam.mapping.cpu.neighbours import NeighbourIndex, kl_gradient
from ggslam.mapping.cpu.pixel_pool import PixelPool, draw_pool
from ggslam.mapping.cpu.votes import merge_votes, vote_labels, vote_shares
from ggslam.mapping.identity_objects import BIRTH_VOTE, MIN_WEIGHT, POOL_STEPS, TERMS, IdentityObjects
from ggslam.mapping.keyframe import Keyframe
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.pixel_terms import FeatureAdamSettings, PixelTerms
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS, NOTHING_LOGIT, IdentityClassifier

SH_C0 = 0.28209479177387814
MANY_CLASSES = 128
"""Beyond so many classes a step's softmax runs over those in its sample and this many others, drawn at random."""


@dataclass
class IdentityLearner(IdentityObjects):
    """Trains identity vectors and classifier, counts votes.

    Args:
        settings: see there.
        seed: of sampling.
    """

    last_loss: float = float("nan")
    """Cross-entropy of the last step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.table: ClassTable = ClassTable(self._rng)
        self._pools: dict[int, PixelPool] = {}
        self._shown: np.ndarray | None = None  # labels by votes, of the last keyframe's time
        self._shown_order = -1
        self._index = NeighbourIndex(self.settings.neighbours.growth)

    # --- objects ------------------------------------------------------------------------------------------------------

    def _labels_changed(self) -> None:
        self._shown = None

    def _merge_votes(self, gaussians: GaussianMap) -> None:
        merge_votes(gaussians, self._alias)

    def _dissolve(self, gaussians: GaussianMap, kept: int, dropped: int) -> None:
        labels = vote_labels(gaussians)
        wrong = self.table.classifier.labels(gaussians.features.numpy())[0] == dropped
        self.table.remove(dropped)
        gaussians.features.numpy()[wrong] = self.table.codes(np.where(labels[wrong] > 0, labels[wrong], kept))

    def split(
        self, gaussians: GaussianMap, rasterizer: CpuRasterizer, mask: np.ndarray, whole: int, part: int
    ) -> None:
        """An object turned out to be two: what the last rendering shows where `mask` [H, W] has the part, and more of
        it there than elsewhere, now votes for the part as it did for the whole. In older keyframes the map decides
        from now on which pixels of the whole are the part's (`_as_mapped`)."""
        whole, part = int(self._alias[whole]), int(self._alias[part])
        if not self._split_off(whole, part):
            return
        terms = rasterizer.pixel_terms(np.arange(mask.size))
        inside = self.current(mask.reshape(-1)) == part
        used = np.arange(terms.weights.shape[1]) < terms.counts[:, None]
        weights = np.where(used, terms.weights, 0)
        size = len(gaussians)
        here = np.bincount(terms.gaussians[inside][used[inside]], terms.weights[inside][used[inside]], size)
        everywhere = np.bincount(terms.gaussians[used], weights[used], size)
        rows = np.flatnonzero(here > 0.5 * np.maximum(everywhere, 1e-9))
        ids = gaussians.vote_ids.numpy()
        ids[rows] = np.where(ids[rows] == whole, part, ids[rows])
        merge_votes(gaussians, self._alias)
        if self.settings.initialisation == "votes" and len(rows):
            gaussians.features.numpy()[rows] = self.table.codes(vote_labels(gaussians)[rows])

    def _as_mapped(self, gaussians: GaussianMap, terms: PixelTerms, labels: np.ndarray) -> np.ndarray:
        """Labels of pixels, those of a whole replaced by its part's where the map shows the part."""
        if not self._whole_of.any():
            return labels
        if self._shown is None or self._shown_order != gaussians.order or len(self._shown) != len(gaussians):
            self._shown, self._shown_order = vote_labels(gaussians), gaussians.order
        shown, _ = terms.labels(self._shown)
        return np.where((self._whole_of[shown] == labels) & (shown > 0), shown, labels)

    def begin(self, gaussians: GaussianMap, rows: slice, labels: np.ndarray) -> None:
        """New Gaussians get their first identity vectors and votes.

        Args:
            rows: where they are in the map.
            labels: uint16 [M], object under the pixel each was born from, 0 = unknown.
        """
        ids = self.current(labels)
        gaussians.vote_ids.numpy()[rows, 0] = ids
        gaussians.vote_weights.numpy()[rows, 0] = np.where(ids > 0, BIRTH_VOTE, 0)
        if self.settings.initialisation == "votes":
            gaussians.features.numpy()[rows] = self.table.codes(ids)
        else:
            shape = (len(labels), IDENTITY_CHANNELS)
            gaussians.features.numpy()[rows] = (self._rng.random(shape, np.float32) - 0.5) / SH_C0

    # --- steps --------------------------------------------------------------------------------------------------------

    def step(
        self, gaussians: GaussianMap, rasterizer: CpuRasterizer, keyframe: Keyframe, view: RenderBuffers,
        rate_factor: float = 1.0,
    ) -> torch.Tensor | None:  # fmt: skip
        """One step on the view that `rasterizer` rendered last, which must be that of `keyframe`.

        Args:
            rate_factor: multiplies the learning rates (of the sampled schedule).

        Returns:
            With the dense schedule the gradient of the rendered features [F, H, W], for the caller's backward pass;
            else None, and the step is made.
        """
        start = time.perf_counter()
        gradient = None
        if self.settings.schedule == "dense":
            gradient = self._dense(gaussians, rasterizer, keyframe, view)
        pixels, vote_weights = self._draw(keyframe)
        if len(pixels):
            assert keyframe.mask is not None
            labels = self.current(keyframe.mask.reshape(-1)[pixels])
            terms = rasterizer.pixel_terms(pixels, TERMS, MIN_WEIGHT)
            labels = self._as_mapped(gaussians, terms, labels)
            terms.vote(gaussians, labels, vote_weights)
            if self.settings.schedule == "sampled":
                self._train(gaussians, terms, self.table.classes(labels), rate_factor)
        self.times.steps += time.perf_counter() - start
        self.times.count += 1
        return gradient

    def _dense(
        self, gaussians: GaussianMap, rasterizer: CpuRasterizer, keyframe: Keyframe, view: RenderBuffers
    ) -> torch.Tensor:
        """Cross-entropy of a whole rendered identity image, as published; updates the classifier."""
        s = self.settings
        assert keyframe.mask is not None and view.features is not None
        pixels = np.flatnonzero(keyframe.mask)
        classes = self.table.classes(self.current(keyframe.mask.reshape(-1)[pixels]))
        pixels, classes = pixels[classes >= 0], classes[classes >= 0]
        features = view.features.numpy().reshape(IDENTITY_CHANNELS, -1)
        chosen = np.arange(self.table.count)
        self.last_loss, gradient, rows = cross_entropy(features[:, pixels].T, self.classifier, classes, chosen)
        self.table.step(chosen, s.weight * rows, s.classifier_rate)
        out = np.zeros_like(features)
        out[:, pixels] = s.weight * gradient.T
        if s.neighbours.weight > 0 and self.times.count % s.neighbours.every == 0 and len(gaussians) > 1:
            rows_pulled, pull = self._pull_together(gaussians)
            terms = PixelTerms.of_gaussians(rows_pulled, 1, rasterizer.context)
            terms.step(gaussians, pull, FeatureAdamSettings(rate=s.rate))
        return torch.from_numpy(out.reshape(view.features.shape))

    def _train(self, gaussians: GaussianMap, terms: PixelTerms, classes: np.ndarray, rate_factor: float) -> None:
        s, known = self.settings, classes >= 0  # an object may have been taken back since its pixels were drawn
        if not known.any():
            return
        chosen = self._competing(classes[known])
        features = terms.features(gaussians)
        gradient = np.zeros_like(features)
        self.last_loss, of_known, rows = cross_entropy(features[known], self.classifier, classes[known], chosen)
        gradient[known] = s.weight * of_known
        if s.neighbours.weight > 0 and self.times.count % s.neighbours.every == 0 and len(gaussians) > 1:
            pulled, pull = self._pull_together(gaussians)
            terms = terms.joined(PixelTerms.of_gaussians(pulled, terms.gaussians.shape[1], terms.context))
            gradient = np.concatenate([gradient, pull])
        terms.step(gaussians, gradient, FeatureAdamSettings(rate=rate_factor * s.rate))
        self.table.step(chosen, s.weight * rows, rate_factor * s.classifier_rate)

    def _competing(self, classes: np.ndarray) -> np.ndarray:
        """Classes that a step's softmax runs over: all, or with very many those that appear and some others."""
        if self.table.count <= MANY_CLASSES:
            return np.arange(self.table.count)
        return np.union1d(np.unique(classes), self._rng.choice(self.table.count, MANY_CLASSES, replace=False))

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

    def _draw(self, keyframe: Keyframe) -> tuple[np.ndarray, np.ndarray]:
        """The next pixels of a keyframe, int32 [P], and the weight each has as a vote."""
        pool = self._pools.get(keyframe.index)
        if pool is None or pool.used + self.settings.pixels > len(pool.pixels):
            assert keyframe.mask is not None
            wanted = POOL_STEPS * self.settings.pixels
            pool = draw_pool(self.current(keyframe.mask), wanted, self.settings, self._rng)
            self._pools[keyframe.index] = pool
        part = slice(pool.used, pool.used + self.settings.pixels)
        pool.used = part.stop
        return pool.pixels[part], pool.vote_weights[part]

    # --- results ------------------------------------------------------------------------------------------------------

    def label(self, gaussians: GaussianMap) -> None:
        """Writes each Gaussian's object into `object_id`: the one with a share of `min_confidence` of its votes, else
        the learned one if it is as probable, else 0. Votes first: what is rendered is learned as a whole, and single
        Gaussians in it may be wrong (in a rendered room 95 % of Gaussians were right by votes, 91 % as learned)."""
        start = time.perf_counter()
        ids, share = vote_shares(gaussians)
        sure = share >= self.settings.min_confidence
        if self.settings.schedule != "votes":
            seen = share > 0
            learned = by_parts(self.classifier, gaussians.features.numpy(), self.settings.min_confidence)
            ids = np.where(sure, ids, np.where(seen, learned, 0))
        gaussians.object_id.numpy()[:] = ids
        self.times.labelling += time.perf_counter() - start


def cross_entropy(
    features: np.ndarray, classifier: IdentityClassifier, classes: np.ndarray, chosen: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mean softmax cross-entropy of classified features; being nothing competes with the classes.

    Args:
        features: float32 [P, F].
        classifier: C classes.
        classes: true class of each, int [P].
        chosen: classes that the softmax runs over, int [K], sorted, all of `classes` among them.

    Returns:
        The mean, its gradient by the features [P, F], and by the rows of `chosen` [K, F + 1] (weights, then bias).
    """
    weight = classifier.weight[chosen]
    z = features @ weight.T + classifier.bias[chosen]
    highest = z.max(1, keepdims=True, initial=NOTHING_LOGIT)
    z -= highest
    rows, true = np.arange(len(z)), np.searchsorted(chosen, classes)
    right = z[rows, true]
    np.exp(z, out=z)
    sums = z.sum(1) + np.exp(NOTHING_LOGIT - highest[:, 0])
    loss = float((np.log(sums) - right).mean())
    z /= sums[:, None]
    z[rows, true] -= 1
    z /= len(z)
    return loss, z @ weight, np.concatenate([z.T @ features, z.sum(0)[:, None]], 1)


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
