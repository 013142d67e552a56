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

What is the same on every device is here: which ids were merged, split off or taken back, and the order of a step.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Final, Protocol

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.mapping.pixel_grid import PixelGrid
from ggslam.mapping.pixel_pool import PixelPool
from ggslam.mapping.votes import vote_labels, vote_shares
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.system.array_forms import Form, check_indices
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class IdentityTuning(Tuning):
    """Training of identity vectors."""

    pool_steps = 4
    """Training steps for which pixels of a keyframe are drawn at once."""
    max_terms = 32
    """Most contributions to a pixel that training reads."""
    min_weight = 2e-2
    """Smallest weight, in [0, 1], of a contribution that training reads."""
    split_stride = 2
    """Distance, in rows and columns, between the pixels that a split of an object reads."""
    birth_vote = 0.1
    """Weight of the vote that a Gaussian gets for the pixel that it is made from."""


IDS: Final = 65536
"""Object ids that uint16 holds, with 0 (none)."""
_OfEachId = Annotated[np.ndarray, Form("u2", IDS)]


@savable()
@dataclass
class IdentityTimes:
    """Seconds spent so far."""

    steps: float = 0.0
    labelling: float = 0.0
    count: int = 0


class Classes(Protocol):
    """A table of classes, see `CpuClassTable`."""

    @property
    def count(self) -> int: ...

    @property
    def classifier(self) -> IdentityClassifier: ...

    def classes(self, object_ids: np.ndarray) -> np.ndarray: ...

    def add(self, object_ids: np.ndarray) -> None: ...

    def resume(self, classifier: IdentityClassifier) -> None: ...

    def remove(self, object_id: int) -> None: ...


class MaskedKeyframe(Protocol):
    """What identity learning reads of a keyframe: its number, and its mask, uint16 [H, W], or None."""

    @property
    def index(self) -> int: ...

    @property
    def mask(self) -> np.ndarray | None: ...


@dataclass(frozen=True)
class MaskOnGrid:
    """A keyframe's mask at the pixels of a grid, uint16 [h, w]; see `MaskedKeyframe`."""

    index: int
    mask: np.ndarray | None

    @staticmethod
    def of(keyframe: MaskedKeyframe, grid: PixelGrid) -> MaskOnGrid:
        """That of a keyframe."""
        mask = keyframe.mask
        return MaskOnGrid(keyframe.index, None if mask is None else np.ascontiguousarray(grid.of(mask)))


def ids_of(mask: np.ndarray) -> np.ndarray:
    """Ids that are in a mask of uint16, each once, in order."""
    flat = mask.reshape(-1)
    begun = flat[1:][flat[1:] != flat[:-1]]  # the first pixel of each run of one id, which are few
    return np.flatnonzero(np.bincount(np.append(flat[:1], begun), minlength=1)).astype(np.uint16)


@dataclass
class IdentityLearner(ABC):
    """Objects and their ids.

    Args:
        settings: of identity learning.
        seed: of sampling.
    """

    settings: IdentitySettings
    seed: int = 0
    times: IdentityTimes = field(default_factory=IdentityTimes)

    kept_pools: ClassVar[int | None] = None
    """Keyframes whose pixels drawn ahead are kept; beyond, those drawn first go. None: all."""

    _alias: _OfEachId = field(init=False, repr=False, compare=False)
    _whole_of: _OfEachId = field(init=False, repr=False, compare=False)
    _pools: dict[int, PixelPool[Any]] = field(init=False, repr=False, compare=False)
    _shown: torch.Tensor | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng([self.seed, 16])
        self._alias = np.arange(IDS, dtype=np.uint16)
        self._whole_of = np.zeros(IDS, np.uint16)
        self._pools = {}
        self._iterations = 0
        self._shown = None  # labels by votes, of the last keyframe's time
        self._shown_order = -1
        self.table: Classes

    def check(self, keyframes: Sequence[MaskedKeyframe]) -> None:
        """Raises FormatError if pixels are drawn ahead of masks that do not have them: it may come from a file."""
        check_indices("pixels drawn ahead", self._pools, len(keyframes))
        for number, pool in self._pools.items():
            mask = keyframes[number].mask
            pool.check(0 if mask is None else mask.size)
        if self._shown is not None and not (self._shown.dtype == torch.int32 and self._shown.ndim == 1):
            raise FormatError("labels of the map: expected int32")

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
        return self._iterations % self.settings.every == 0 and keyframe.mask is not None and self.table.count > 0

    def due_turns(self, iterations: int) -> range:
        """As `due` of so many iterations to come: the numbers, from 0, of those that shall have an identity step if
        their keyframes have masks."""
        every, done = self.settings.every, self._iterations
        self._iterations += iterations
        return range(every - 1 - done % every, iterations, every) if self.table.count > 0 else range(0)

    # --- a map that is partly on disk ---------------------------------------------------------------------------------

    def catch_up(self, gaussians: GaussianMap) -> None:
        """The votes and identity vectors of Gaussians that were on disk follow the merges and removals of objects
        since."""
        if (self._alias != np.arange(IDS)).any():
            before = vote_labels(gaussians)
            self._merge_votes(gaussians)
            self._follow_votes(gaussians, before)

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
        self._forget_shown()
        self.table.add(np.unique(self.current(ids_of(mask))))

    def merge(self, gaussians: GaussianMap, pairs: Sequence[tuple[int, int]]) -> None:
        """Objects turned out to be one: masks, votes and classes of the second of each pair become those of the
        first. However many pairs there are, the Gaussians are gone through once."""
        kept, dropped = [], []
        for first, second in pairs:
            into = int(self._alias[first])
            if into != second:
                self._alias[self._alias == second] = into
                self._whole_of[second] = 0
                kept.append(into)
                dropped.append(second)
        if not dropped:
            return
        self._ids_changed()
        self._merge_votes(gaussians)
        self.table.add(np.unique(self._alias[kept]))
        gone = [i for i in dropped if self.table.classes(np.array([i]))[0] >= 0]
        if gone:
            self._dissolve(gaussians, gone)

    def forget(self, gaussians: GaussianMap, object_ids: Sequence[int]) -> None:
        """Objects that were none: their class goes, their Gaussians become what else they look like."""
        for object_id in object_ids:
            self.table.remove(object_id)
            self._alias[self._alias == object_id] = 0
        self._whole_of[list(object_ids)] = 0
        before = vote_labels(gaussians)
        self._ids_changed()
        self._merge_votes(gaussians)
        self._follow_votes(gaussians, before)

    def _shown_labels(self, gaussians: GaussianMap) -> torch.Tensor:
        """The map's labels by votes as of the newest keyframe, int32 [N]."""
        if self._shown is None or self._shown_order != gaussians.order or len(self._shown) != len(gaussians):
            self._shown, self._shown_order = self._vote_labels(gaussians), gaussians.order
        return self._shown

    def _vote_labels(self, gaussians: GaussianMap) -> torch.Tensor:
        """As `vote_labels`; the next call may overwrite it."""
        return vote_labels(gaussians)

    def _forget_shown(self) -> None:
        self._shown = None

    def _split_off(self, splits: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
        """Remembers parts of objects; without those that were merged into one."""
        current = [(int(self._alias[whole]), int(self._alias[part])) for whole, part in splits]
        found = [(whole, part) for whole, part in current if whole != part]
        for whole, part in found:
            self._whole_of[part] = whole
        if found:
            self._ids_changed()
        return found

    # --- steps --------------------------------------------------------------------------------------------------------

    def step(
        self, gaussians: GaussianMap, rasterizer: Any, keyframe: Any, view: RenderBuffers, rate_factor: float = 1.0
    ) -> torch.Tensor | None:
        """One step on the view that `rasterizer` rendered last, which must be that of `keyframe` (or of its
        `MaskOnGrid`). On a GPU it is only started, and `times.steps` counts the seconds that takes.

        Args:
            rate_factor: multiplies the learning rates (of the sampled schedule).

        Returns:
            With a schedule that renders images of identities the gradient of the rendered features [F, H, W], for the
            caller's backward pass; else None, and the step is made.
        """
        start = time.perf_counter()
        gradient = None
        if self.settings.renders_images:
            gradient = self._dense(gaussians, rasterizer, keyframe, view)
        pixels, vote_weights = self._draw(keyframe)
        if len(pixels):
            self._learn_at_pixels(gaussians, rasterizer, keyframe, pixels, vote_weights, rate_factor)
        self.times.steps += time.perf_counter() - start
        self.times.count += 1
        return gradient

    def forget_pixels(self, keyframes: Sequence[int]) -> None:
        """Keyframes by number whose masks have changed: their pixels are drawn anew."""
        for number in keyframes:
            self._pools.pop(number, None)

    def _draw(self, keyframe: Any) -> tuple[Any, Any]:
        """The next pixels of a keyframe, int32 [P], and the weight each has as a vote. On a grid none are drawn ahead:
        the next step has another one."""
        if isinstance(keyframe, MaskOnGrid):
            return self._new_pool(keyframe, self.settings.pixels).take(self.settings.pixels)
        pool = self._pools.get(keyframe.index)
        if pool is None or not pool.has(self.settings.pixels):
            pool = self._new_pool(keyframe, IdentityTuning.pool_steps * self.settings.pixels)
            self._pools.pop(keyframe.index, None)
            self._pools[keyframe.index] = pool
            if self.kept_pools is not None and len(self._pools) > self.kept_pools:
                del self._pools[next(iter(self._pools))]
        return pool.take(self.settings.pixels)

    def pulls(self, gaussians: GaussianMap) -> bool:
        """Whether the next step has the 3-D loss."""
        s = self.settings.neighbours
        return s.weight > 0 and self.times.count % s.every == 0 and gaussians.count > 1

    # --- results ------------------------------------------------------------------------------------------------------

    def label(self, gaussians: GaussianMap) -> None:
        """Writes each Gaussian's object into `object_id`: the one with a share of `min_confidence` of its votes, else
        the learned one if it is as probable, else 0. Votes first: what is rendered is learned as a whole, and single
        Gaussians in it may be wrong (in a rendered room 95 % of Gaussians were right by votes, 91 % as learned)."""
        start = time.perf_counter()
        ids, share = vote_shares(gaussians)
        if self.settings.schedule != "votes":
            learned = self._learned_labels(gaussians)
            sure = share >= self.settings.min_confidence
            ids = torch.where(sure, ids, torch.where(share > 0, learned, 0))
        gaussians.object_id.copy_(ids)
        self.times.labelling += time.perf_counter() - start

    # --- what depends on where the map is -----------------------------------------------------------------------------

    @abstractmethod
    def begin(self, gaussians: GaussianMap, rows: slice, labels: Any) -> None:
        """New Gaussians get their first identity vectors and votes.

        Args:
            rows: where they are in the map.
            labels: [M], object under the pixel each was born from, 0 = unknown; uint16 on the host, int32 on a device.
        """

    @abstractmethod
    def _new_pool(self, keyframe: Any, wanted: int) -> PixelPool[Any]:
        """So many labelled pixels of a keyframe that has a mask."""

    @abstractmethod
    def _learn_at_pixels(
        self, gaussians: GaussianMap, rasterizer: Any, keyframe: Any, pixels: Any, vote_weights: Any,
        rate_factor: float,
    ) -> None:  # fmt: skip
        """Votes, and with the sampled schedule a step, at pixels of a keyframe's mask."""

    @abstractmethod
    def _dense(self, gaussians: GaussianMap, rasterizer: Any, keyframe: Any, view: RenderBuffers) -> torch.Tensor:
        """Cross-entropy of a whole rendered identity image, as published; updates the classifier. Or the difference of
        a whole image of colours. Returns the gradient of the rendered features [F, H, W]."""

    @abstractmethod
    def split(
        self, gaussians: GaussianMap, rasterizer: Any, mask: np.ndarray, splits: Sequence[tuple[int, int]]
    ) -> None:
        """Objects turned out to be two, a whole and a part each: what the last rendering shows where `mask` (uint16
        [H, W]) has the part, and more of it there than elsewhere, now votes for the part as it did for the whole. In
        older keyframes the map decides from now on which pixels of the whole are the part's."""

    @abstractmethod
    def _learned_labels(self, gaussians: GaussianMap) -> torch.Tensor:
        """Most probable object of each Gaussian's identity vector, int32 [N], 0 below `min_confidence`."""

    def _ids_changed(self) -> None:
        """`_alias` or `_whole_of` changed."""
        self._forget_shown()

    @abstractmethod
    def _merge_votes(self, gaussians: GaussianMap) -> None:
        """The votes follow `_alias`."""

    @abstractmethod
    def _follow_votes(self, gaussians: GaussianMap, before: torch.Tensor) -> None:
        """Gaussians whose votes named an object before (int32 [N]) that is another one by now, or none, get the code of
        what their votes name."""

    @abstractmethod
    def _dissolve(self, gaussians: GaussianMap, dropped: Sequence[int]) -> None:
        """Removes the classes of merged objects; Gaussians that have them get the code of what they are by votes, else
        of what they were merged into."""
