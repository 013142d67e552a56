# SPDX-License-Identifier: Apache-2.0
"""What identity learning remembers of objects, wherever it computes: which ids were merged, split off or taken back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch

from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier

POOL_STEPS = 8
"""Steps' worth of pixels that are drawn from a keyframe at once."""
TERMS, MIN_WEIGHT = 32, 5e-3
"""Contributions to a pixel that training looks at: at most so many, none lighter."""
BIRTH_VOTE = 0.1
"""Weight of the vote that a Gaussian gets for the pixel it is born from."""
IDS = 65536
"""Object ids there can be, 0 (none) among them."""


@dataclass
class IdentityTimes:
    """Seconds spent so far."""

    steps: float = 0.0
    labelling: float = 0.0
    count: int = 0


class Classes(Protocol):
    """A table of classes, see `ClassTable`."""

    @property
    def count(self) -> int: ...

    @property
    def classifier(self) -> IdentityClassifier: ...

    def classes(self, object_ids: np.ndarray) -> np.ndarray: ...

    def add(self, object_ids: np.ndarray) -> None: ...

    def resume(self, classifier: IdentityClassifier) -> None: ...

    def remove(self, object_id: int) -> None: ...


class MaskedKeyframe(Protocol):
    """What is asked of a keyframe: its number, and its mask, uint16 [H, W], or None."""

    @property
    def index(self) -> int: ...

    @property
    def mask(self) -> np.ndarray | None: ...


@dataclass
class IdentityObjects(ABC):
    """Objects and their ids.

    Args:
        settings: of identity learning.
        seed: of sampling.
    """

    settings: IdentitySettings
    seed: int = 0
    times: IdentityTimes = field(default_factory=IdentityTimes)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng([self.seed, 16])
        self._alias = np.arange(IDS, dtype=np.uint16)
        self._whole_of = np.zeros(IDS, np.uint16)
        self._pools: dict[int, Any] = {}
        self._iterations = 0
        self.table: Classes

    @property
    def classifier(self) -> IdentityClassifier:
        """As trained so far."""
        return self.table.classifier

    def resume(self, classifier: IdentityClassifier) -> None:
        """Goes on with the classes of a map made before, whose Gaussians bring their vectors and votes."""
        self.table.resume(classifier)

    def due(self, keyframe: MaskedKeyframe) -> bool:
        """Whether this mapping iteration shall have an identity step. To be asked once an iteration."""
        self._iterations += 1
        return keyframe.mask is not None and self.table.count > 0 and self._iterations % self.settings.every == 0

    # --- a map that is partly on disk ---------------------------------------------------------------------------------

    def catch_up(self, gaussians: GaussianMap) -> None:
        """The votes of Gaussians that were on disk follow the merges and removals of objects since; their identity
        vectors are left to further steps."""
        if (self._alias != np.arange(IDS)).any():
            self._merge_votes(gaussians)

    def catch_up_and_label(self, gaussians: GaussianMap) -> None:
        """The end for a part of the map that was on disk, see `label`."""
        self.catch_up(gaussians)
        self.label(gaussians)

    def keep_pools(self, keyframes: Iterable[int]) -> None:
        """Forgets the pixels that were drawn ahead from any but these keyframes."""
        self._pools = {number: self._pools[number] for number in keyframes if number in self._pools}

    # --- objects ------------------------------------------------------------------------------------------------------

    def current(self, ids: np.ndarray) -> np.ndarray:
        """Object ids with those replaced that were merged into others."""
        return self._alias[ids]

    def observe(self, mask: np.ndarray) -> None:
        """A keyframe with this mask (uint16 [H, W]) arrives: its objects get classes."""
        self._labels_changed()
        self.table.add(np.flatnonzero(np.bincount(self.current(mask).reshape(-1), minlength=1)).astype(np.uint16))

    def merge(self, gaussians: GaussianMap, kept: int, dropped: int) -> None:
        """Two objects turned out to be one: masks, votes and classes of `dropped` become those of `kept`."""
        kept = int(self._alias[kept])
        if kept == dropped:
            return
        self._alias[self._alias == dropped] = kept
        self._whole_of[dropped] = 0
        self._ids_changed()
        self._merge_votes(gaussians)
        self.table.add(np.array([kept], np.uint16))
        if self.table.classes(np.array([dropped]))[0] >= 0:
            self._dissolve(gaussians, kept, dropped)

    def forget(self, gaussians: GaussianMap, object_ids: Sequence[int]) -> None:
        """Objects that were none: their class goes, their Gaussians become what else they look like."""
        for object_id in object_ids:
            self.table.remove(object_id)
            self._alias[self._alias == object_id] = 0
        self._whole_of[list(object_ids)] = 0
        self._ids_changed()
        self._merge_votes(gaussians)

    def _split_off(self, whole: int, part: int) -> bool:
        """Remembers a part of an object; False if both were merged into one."""
        if whole == part:
            return False
        self._whole_of[part] = whole
        self._ids_changed()
        return True

    # --- what depends on where the map is -----------------------------------------------------------------------------

    @abstractmethod
    def begin(self, gaussians: GaussianMap, rows: slice, labels: Any) -> None:
        """New Gaussians get their first identity vectors and votes.

        Args:
            rows: where they are in the map.
            labels: [M], object under the pixel each was born from, 0 = unknown; uint16 on the host, int32 on a device.
        """

    @abstractmethod
    def step(
        self, gaussians: GaussianMap, rasterizer: Any, keyframe: Any, view: RenderBuffers, rate_factor: float = 1.0
    ) -> torch.Tensor | None:
        """One step on the view that `rasterizer` rendered last, which must be that of `keyframe`.

        Args:
            rate_factor: multiplies the learning rates (of the sampled schedule).

        Returns:
            With the dense schedule the gradient of the rendered features [F, H, W], for the caller's backward pass;
            else None, and the step is made.
        """

    @abstractmethod
    def split(self, gaussians: GaussianMap, rasterizer: Any, mask: np.ndarray, whole: int, part: int) -> None:
        """An object turned out to be two: what the last rendering shows where `mask` (uint16 [H, W]) has the part, and
        more of it there than elsewhere, now votes for the part as it did for the whole. In older keyframes the map
        decides from now on which pixels of the whole are the part's."""

    @abstractmethod
    def label(self, gaussians: GaussianMap) -> None:
        """Writes each Gaussian's object into `object_id`."""

    @abstractmethod
    def _labels_changed(self) -> None:
        """The map's labels by votes are to be looked at anew."""

    def _ids_changed(self) -> None:
        """`_alias` or `_whole_of` changed."""
        self._labels_changed()

    @abstractmethod
    def _merge_votes(self, gaussians: GaussianMap) -> None:
        """The votes follow `_alias`."""

    @abstractmethod
    def _dissolve(self, gaussians: GaussianMap, kept: int, dropped: int) -> None:
        """Removes the class of `dropped`; Gaussians that have it get the code of what they are by votes, else of
        `kept`."""
