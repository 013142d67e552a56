# SPDX-License-Identifier: Apache-2.0
"""Sampled compositing: the Gaussians that contribute to single pixels.

A feature rendered at a pixel is the sum of weight times feature over the pixel's terms. With the terms at hand, feature
channels can be rendered and trained at a few thousand pixels of a view that is rendered for its colours anyway: whole
images of 16 channels, forward and backward, would cost more than everything else.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np

from ggslam.abi import core as structures
from ggslam.abi.arrays import address
from ggslam.errors import CoreInputError, RenderError
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.gaussian_map import GaussianMap

MAX_CHANNELS: Final = 64
"""Most channels of a feature image: the compiled core's limit."""


@dataclass(frozen=True)
class FeatureAdamSettings:
    """Adam on the features alone, with an update count per Gaussian (`GaussianMap.feature_updates`)."""

    rate: float = 0.05
    beta1: float = 0.9
    beta2: float = 0.99
    epsilon: float = 1e-15

    def schedule(self) -> np.ndarray:
        """float32 [rows, 2]: step size over the first bias correction, 1 / sqrt of the second, by update."""
        return _schedule(self.rate, self.beta1, self.beta2)


@lru_cache(maxsize=8)
def _schedule(rate: float, beta1: float, beta2: float) -> np.ndarray:
    rows = max(1 if beta in (0.0, 1.0) else math.ceil(math.log(1e-8) / math.log(beta)) for beta in (beta1, beta2))
    update = np.arange(1, rows + 1, dtype=np.float64)
    columns = [rate / (1 - beta1**update), 1 / np.sqrt(1 - beta2**update)]
    return np.ascontiguousarray(np.stack(columns, 1), np.float32)


@dataclass(frozen=True)
class CpuPixelTerms:
    """The terms of P pixels.

    Attributes:
        gaussians: int32 [P, capacity], rows in the map; the first `counts[p]` of row p are in use, front to back.
        weights: float32 [P, capacity], rendering weights.
        counts: int32 [P].
        context: threads to work on.
    """

    gaussians: np.ndarray
    weights: np.ndarray
    counts: np.ndarray
    context: NativeContext

    @staticmethod
    def empty(pixels: int, capacity: int, context: NativeContext) -> CpuPixelTerms:
        """Room for terms."""
        if capacity < 1:
            raise RenderError(f"capacity must be at least 1, found {capacity}")
        return CpuPixelTerms(
            np.empty((pixels, capacity), np.int32), np.empty((pixels, capacity), np.float32),
            np.zeros(pixels, np.int32), context,
        )  # fmt: skip

    def rows(self) -> np.ndarray:
        """Rows of the Gaussians that any of the pixels show, int32 [n], some more than once."""
        return self.gaussians[np.arange(self.gaussians.shape[1]) < self.counts[:, None]]

    @staticmethod
    def of_gaussians(rows: np.ndarray, capacity: int, context: NativeContext) -> CpuPixelTerms:
        """Pseudo-pixels that show one Gaussian each, with weight 1: `rows` [M]."""
        terms = CpuPixelTerms.empty(len(rows), capacity, context)
        terms.gaussians[:, 0], terms.weights[:, 0], terms.counts[:] = rows, 1, 1
        return terms

    def append(self, other: CpuPixelTerms) -> CpuPixelTerms:
        """These pixels followed by those of `other`, which must have the same capacity."""
        return CpuPixelTerms(
            np.concatenate([self.gaussians, other.gaussians]), np.concatenate([self.weights, other.weights]),
            np.concatenate([self.counts, other.counts]), self.context,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.counts)

    def native(self) -> structures.PixelTerms:
        """As the compiled core wants it; valid as long as this object lives."""
        return structures.PixelTerms(
            len(self), self.gaussians.shape[1], self.gaussians.ctypes.data, self.weights.ctypes.data,
            self.counts.ctypes.data,
        )  # fmt: skip

    def opacity(self) -> np.ndarray:
        """Sum of the weights, float32 [P]."""
        used = np.arange(self.weights.shape[1]) < self.counts[:, None]
        return np.where(used, self.weights, 0).sum(1)

    def features(self, gaussians: GaussianMap) -> np.ndarray:
        """Rendered features, float32 [P, F]."""
        channels = _checked_channels(gaussians)
        out = np.empty((len(self), channels), np.float32)
        load_library().ggslam_terms_blend(
            self.context.handle, ctypes.byref(self.native()), address(gaussians.features), len(gaussians), channels,
            out.ctypes.data,
        )  # fmt: skip
        return out

    def step(self, gaussians: GaussianMap, gradient: np.ndarray, optimizer: FeatureAdamSettings) -> None:
        """One Adam step on the features of the Gaussians that appear in the terms, in place.

        Args:
            gaussians: the map, with moments; unchanged in number and order since the terms were made.
            gradient: d loss / d rendered features, float32 [P, F].
            optimizer: rates.

        Raises:
            RenderError: wrong shape, no moments, out of memory.
        """
        gradient, adam = self._feature_adam(gaussians, gradient, optimizer)
        _check(load_library().ggslam_terms_step(self.context.handle, *self._arguments(gradient, adam)))

    def learn(
        self, gaussians: GaussianMap, gradient: np.ndarray, optimizer: FeatureAdamSettings, labels: np.ndarray,
        pixel_weights: np.ndarray,
    ) -> None:  # fmt: skip
        """`step` and `vote` at once, which is quicker than one after the other.

        Raises:
            RenderError: wrong shape, no moments, out of memory.
        """
        gradient, adam = self._feature_adam(gaussians, gradient, optimizer)
        labels, pixel_weights = _checked_labels(labels, len(self)), np.ascontiguousarray(pixel_weights, np.float32)
        ids, weights = gaussians.vote_ids, gaussians.vote_weights
        votes = structures.TermVotes(
            labels.ctypes.data, pixel_weights.ctypes.data, address(ids), address(weights), ids.shape[1]
        )
        _check(
            load_library().ggslam_terms_learn(
                self.context.handle, *self._arguments(gradient, adam), ctypes.byref(votes)
            )
        )

    def _arguments(self, gradient: np.ndarray, adam: structures.FeatureAdam) -> tuple[Any, ...]:
        return ctypes.byref(self.native()), gradient.ctypes.data, ctypes.byref(adam)

    def _feature_adam(
        self, gaussians: GaussianMap, gradient: np.ndarray, optimizer: FeatureAdamSettings
    ) -> tuple[np.ndarray, structures.FeatureAdam]:
        """The gradient as the compiled core wants it, and the optimizer; its schedule lives in a cache."""
        channels = _checked_channels(gaussians)
        if gradient.shape != (len(self), channels) or gradient.dtype != np.float32:
            raise RenderError(
                f"gradient: expected float32 {[len(self), channels]}, found {gradient.dtype} {list(gradient.shape)}"
            )
        if not gaussians.moments:
            raise RenderError("step: the map was made without moments")
        schedule = optimizer.schedule()
        first, second = gaussians.moments["features"]
        compact = gaussians.compact_features
        adam = structures.FeatureAdam(
            len(gaussians), address(gaussians.features), None if compact else address(first), address(second),
            address(gaussians.feature_updates), schedule.ctypes.data, len(schedule), channels,
            optimizer.beta1, optimizer.beta2, optimizer.epsilon, address(first) if compact else None,
        )  # fmt: skip
        return np.ascontiguousarray(gradient), adam

    def vote(self, gaussians: GaussianMap, labels: np.ndarray, pixel_weights: np.ndarray | None = None) -> None:
        """Adds the pixels' weights to the votes of their Gaussians.

        Args:
            gaussians: the map; `vote_ids` and `vote_weights` are changed.
            labels: object id seen at each pixel, uint16 [P]; 0 votes for nothing.
            pixel_weights: how much each pixel counts, float32 [P]; None: 1.
        """
        labels = _checked_labels(labels, len(self))
        if pixel_weights is not None:
            pixel_weights = np.ascontiguousarray(pixel_weights, np.float32)
        ids, weights = gaussians.vote_ids, gaussians.vote_weights
        _check(
            load_library().ggslam_terms_vote(
                self.context.handle, ctypes.byref(self.native()), labels.ctypes.data,
                None if pixel_weights is None else pixel_weights.ctypes.data, len(gaussians), ids.shape[1],
                address(ids), address(weights),
            )
        )  # fmt: skip

    def labels(self, gaussian_labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The label with the largest rendering weight at each pixel, uint16 [P], and its share, float32 [P].

        Args:
            gaussian_labels: label of each Gaussian of the map, uint16 [N].
        """
        gaussian_labels = np.ascontiguousarray(gaussian_labels, np.uint16)
        ids, shares = np.empty(len(self), np.uint16), np.empty(len(self), np.float32)
        try:
            load_library().ggslam_terms_label(
                self.context.handle, ctypes.byref(self.native()), gaussian_labels.ctypes.data, len(gaussian_labels),
                ids.ctypes.data, shares.ctypes.data,
            )  # fmt: skip
        except CoreInputError as error:
            raise RenderError(
                f"gaussian_labels: a label for every Gaussian of the map, found {len(gaussian_labels)}"
            ) from error
        return ids, shares


def _checked_channels(gaussians: GaussianMap) -> int:
    channels = gaussians.features.shape[1]
    if not 1 <= channels <= MAX_CHANNELS:
        raise RenderError(f"features: expected 1 to {MAX_CHANNELS} channels, found {channels}")
    return channels


def _checked_labels(labels: np.ndarray, pixels: int) -> np.ndarray:
    if labels.shape != (pixels,):
        raise RenderError(f"labels: expected shape {[pixels]}, found {list(labels.shape)}")
    return np.ascontiguousarray(labels, np.uint16)


def _check(status: int) -> None:
    if status != 0:
        raise RenderError("out of memory")
