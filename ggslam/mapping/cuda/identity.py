# SPDX-License-Identifier: Apache-2.0
"""Identity learning on an NVIDIA GPU: `ggslam.mapping.identity` with map, masks, samples, classifier and votes on
a device.

A step is only started, on torch's current stream: nothing in it waits for the device. What comes with keyframes (new
ids, merges, splits, removals) and the results may wait. Otherwise than on the CPU the softmax always runs over all
classes, and neighbours are those of the map as it is.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.abi.cuda import BirthLabelJob
from ggslam.cuda.library import CudaLibrary, library_and_device
from ggslam.cuda.transfers import upload
from ggslam.mapping.class_numbers import ClassTuning
from ggslam.mapping.cuda.class_learning import ClassKernels
from ggslam.mapping.cuda.class_table import CudaClassTable
from ggslam.mapping.cuda.insertion import NewRows
from ggslam.mapping.cuda.lessons import CudaLessons
from ggslam.mapping.cuda.neighbours import cuda_neighbours
from ggslam.mapping.cuda.pixel_pool import PixelDrawer
from ggslam.mapping.cuda.vote_labels import CudaVoteLabels
from ggslam.mapping.identity import IDS, IdentityLearner, IdentityTuning, MaskedKeyframe
from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.mapping.pixel_pool import PixelPool
from ggslam.mapping.votes import merge_votes, vote_labels
from ggslam.rendering.cuda.pixel_terms import CudaPixelTerms
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.pixel_terms import FeatureAdamSettings
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import SH_C0, VOTE_SLOTS, GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS
from ggslam.system.tuning import Tuning

Neighbours = Callable[[torch.Tensor, torch.Tensor, int, CudaLibrary], torch.Tensor]
"""Of points (float32 [N, 3]), rows (int64 [M]) and k: the k nearest other points of each of the rows, int64 [M, k]."""


class CudaIdentityTuning(Tuning):
    """Limits of identity learning on a GPU."""

    logits_at_once = 2**24
    """Logits computed in one batch of the dense schedule; the 3-D loss computes a tenth of it."""
    kept_pools = 256
    """Keyframes whose drawn pixels are kept, about 64 KB each with the default settings. The oldest are dropped
    first."""
    split_pixels = 32768
    """Pixels that a split of an object reads in one batch."""
    split_terms = 48
    """Most contributions to a pixel that a split reads."""
    split_min_weight = 1e-3
    """Smallest weight, in [0, 1], of a contribution that a split reads."""


class CudaMaskedKeyframe(MaskedKeyframe, Protocol):
    """A keyframe whose mask is on the device, too."""

    @property
    def device_mask(self) -> torch.Tensor | None: ...


class CudaIdentityLearner(IdentityLearner):
    """Trains identity vectors and classifier, counts votes.

    Args:
        settings: see there.
        seed: of sampling. On one device all draws repeat with the same seed.
        device: CUDA device of the map; None: the current one.
        library: the compiled kernels; None: those of the device, compiled if need be.
        neighbours: finds nearest Gaussians without a wait; None: `cuda_neighbours`.

    Raises:
        MissingDependency: no CUDA device, or the kernels cannot be compiled.
        NativeCoreError: the compiled kernels do not fit this code.
    """

    kept_pools: ClassVar[int] = CudaIdentityTuning.kept_pools

    def __init__(
        self,
        settings: IdentitySettings,
        seed: int = 0,
        device: torch.device | str | None = None,
        library: CudaLibrary | None = None,
        neighbours: Neighbours | None = None,
    ) -> None:
        super().__init__(settings, seed)
        self.library, self.device = library_and_device(device, library)
        self._kernels = ClassKernels(self.device, self.library)
        self.table: CudaClassTable = CudaClassTable(self._rng, self._kernels)
        drawn_from = int(np.random.default_rng([seed, 17]).integers(2**62))
        self._drawer = PixelDrawer(self.device, self.library, drawn_from)
        self._neighbours = neighbours or cuda_neighbours
        self._has_parts = False
        self._votes = CudaVoteLabels(self.device, self.library)
        self.device_alias = torch.arange(IDS, dtype=torch.int32, device=self.device)
        self.device_whole_of = torch.zeros(IDS, dtype=torch.int32, device=self.device)
        self._last: tuple[torch.Tensor, torch.Tensor] | None = None  # losses of the last step's pixels, their number
        self.lessons = CudaLessons(self)

    @property
    def last_loss(self) -> float:
        """Cross-entropy of the last step, NaN if there was none. Waits for the device."""
        if self._last is None:
            return float("nan")
        losses, known = self._last
        return float(losses.double().sum() / known)

    # --- objects ------------------------------------------------------------------------------------------------------

    def _ids_changed(self) -> None:
        super()._ids_changed()
        self._has_parts = bool(self._whole_of.any())
        self.device_alias.copy_(upload(self._alias.astype(np.int32), self.device))
        self.device_whole_of.copy_(upload(self._whole_of.astype(np.int32), self.device))

    def _vote_labels(self, gaussians: GaussianMap) -> torch.Tensor:
        return self._votes.of(gaussians)

    def _merge_votes(self, gaussians: GaussianMap) -> None:
        merge_votes(gaussians, self.device_alias)

    def _follow_votes(self, gaussians: GaussianMap, before: torch.Tensor) -> None:
        other = self.device_alias[before.long()] != before
        codes = self.table.codes(vote_labels(gaussians))
        gaussians.features.copy_(torch.where(other[:, None], codes, gaussians.features))

    def _dissolve(self, gaussians: GaussianMap, dropped: Sequence[int]) -> None:
        voted = vote_labels(gaussians)
        member, were = self.table.members(gaussians.features, np.array(dropped), voted)
        for object_id in dropped:
            self.table.remove(object_id)
        codes = self.table.codes(torch.where(voted > 0, voted, self.device_alias[were.long()]))
        gaussians.features.copy_(torch.where(member[:, None], codes, gaussians.features))

    def split(
        self, gaussians: GaussianMap, rasterizer: CudaRasterizer, mask: np.ndarray, splits: Sequence[tuple[int, int]]
    ) -> None:
        splits = self._split_off(splits)
        if not splits:
            return
        grid = (
            np.arange(mask.size, dtype=np.int32)
            .reshape(mask.shape)[:: IdentityTuning.split_stride, :: IdentityTuning.split_stride]
            .reshape(-1)
        )
        seen = upload(grid, self.device)
        seen_as = upload(self.current(mask.reshape(-1)[grid]).astype(np.int32), self.device)
        everywhere, *here = (torch.zeros(len(gaussians), device=self.device) for _ in range(1 + len(splits)))
        for begin in range(0, len(seen), CudaIdentityTuning.split_pixels):
            pixels = seen[begin : begin + CudaIdentityTuning.split_pixels].contiguous()
            terms = rasterizer.pixel_terms(pixels, CudaIdentityTuning.split_terms, CudaIdentityTuning.split_min_weight)
            everywhere += terms.weight_sums(len(gaussians))
            for k, (_, part) in enumerate(splits):
                here[k] += terms.weight_sums(
                    len(gaussians), (seen_as[begin : begin + CudaIdentityTuning.split_pixels] == part).float()
                )
        changed = torch.zeros(len(gaussians), dtype=torch.bool, device=self.device)
        for k, (whole, part) in enumerate(splits):
            chosen = here[k] > 0.5 * everywhere.clamp_min(1e-9)
            gaussians.vote_ids.masked_fill_(chosen[:, None] & (gaussians.vote_ids == whole), part)
            changed |= chosen
        self._merge_votes(gaussians)
        if self.settings.initialisation == "votes":
            codes = self.table.codes(vote_labels(gaussians))
            gaussians.features.copy_(torch.where(changed[:, None], codes, gaussians.features))

    def _as_mapped(self, gaussians: GaussianMap, terms: CudaPixelTerms, labels: torch.Tensor) -> torch.Tensor:
        """Labels of pixels, those of a whole replaced by its part's where the map shows the part."""
        if not self._has_parts:
            return labels
        shown, _ = terms.labels(self._shown_labels(gaussians))
        return torch.where((self.device_whole_of[shown.long()] == labels) & (shown > 0), shown, labels)

    def begin(self, gaussians: GaussianMap, rows: slice, labels: torch.Tensor) -> None:
        labels = labels.to(torch.int32).contiguous()
        if rows.stop > rows.start:
            job = self._fill_births(gaussians, rows, BirthLabelJob(labels=labels.data_ptr()))
            self.library.call("birth_labels", ctypes.byref(job))
            self.finish_births(gaussians, rows)

    def births(self, gaussians: GaussianMap, keyframe: CudaMaskedKeyframe, new: NewRows) -> BirthLabelJob:
        """As `begin`, of Gaussians that a keyframe brings, of which there are some: what the library starts;
        `finish_births` has to follow."""
        objects = BirthLabelJob(pixels=new.pixels, mask=address(keyframe.device_mask))
        return self._fill_births(gaussians, new.rows, objects)

    def finish_births(self, gaussians: GaussianMap, rows: slice) -> None:
        """First vectors of new Gaussians that do not follow from their votes."""
        if self.settings.initialisation != "votes" and rows.stop > rows.start:
            shape = (rows.stop - rows.start, IDENTITY_CHANNELS)
            random = torch.rand(shape, generator=self._drawer.generator, device=self.device)
            gaussians.features[rows] = (random - 0.5) / SH_C0

    def _fill_births(self, gaussians: GaussianMap, rows: slice, job: BirthLabelJob) -> BirthLabelJob:
        """Fills in `job`, which names the objects of new Gaussians, whose votes are zero."""
        count, by_votes = rows.stop - rows.start, self.settings.initialisation == "votes"
        storage, channels = gaussians.storage, gaussians.feature_channels
        job.alias, job.class_of = self.device_alias.data_ptr(), self.table.class_of.data_ptr()
        job.class_rows, job.code_length = self.table.training_arrays[0].data_ptr(), ClassTuning.code_length
        job.vote_ids = storage["vote_ids"].data_ptr() + 4 * VOTE_SLOTS * rows.start
        job.vote_weights = storage["vote_weights"].data_ptr() + 4 * VOTE_SLOTS * rows.start
        job.features = storage["features"].data_ptr() + 4 * channels * rows.start if by_votes else None
        job.vote, job.count, job.channels, job.slots = IdentityTuning.birth_vote, count, channels, VOTE_SLOTS
        job.device, job.stream = self.device.index or 0, self.library.stream(self.device)
        return job

    def observe(self, mask: np.ndarray) -> None:
        super().observe(mask)
        if self.settings.schedule in ("sampled", "votes"):
            self.lessons.pools.make_room()

    # --- steps --------------------------------------------------------------------------------------------------------

    def step(
        self, gaussians: GaussianMap, rasterizer: Any, keyframe: Any, view: RenderBuffers, rate_factor: float = 1.0
    ) -> torch.Tensor | None:
        if not isinstance(rasterizer, CudaRasterizer) or not self.lessons.takes(gaussians):
            return super().step(gaussians, rasterizer, keyframe, view, rate_factor)
        start = time.perf_counter()
        self.lessons.run(gaussians, rasterizer, keyframe, rate_factor)
        self.times.steps += time.perf_counter() - start
        return None

    def _learn_at_pixels(
        self, gaussians: GaussianMap, rasterizer: CudaRasterizer, keyframe: CudaMaskedKeyframe, pixels: torch.Tensor,
        vote_weights: torch.Tensor, rate_factor: float,
    ) -> None:  # fmt: skip
        labels = self._kernels.labels(_mask_of(keyframe), pixels, self.device_alias)
        terms = rasterizer.pixel_terms(pixels, IdentityTuning.max_terms, IdentityTuning.min_weight)
        labels = self._as_mapped(gaussians, terms, labels)
        if self.settings.schedule == "sampled" and self.table.count:
            self._train(gaussians, terms, labels, vote_weights, rate_factor)
        else:
            terms.vote(gaussians, labels, vote_weights)

    def _new_pool(self, keyframe: CudaMaskedKeyframe, wanted: int) -> PixelPool[torch.Tensor]:
        return self._drawer.draw(_mask_of(keyframe), self.device_alias, wanted, self.settings)

    def _train(
        self, gaussians: GaussianMap, terms: CudaPixelTerms, labels: torch.Tensor, vote_weights: torch.Tensor,
        rate_factor: float,
    ) -> None:  # fmt: skip
        s = self.settings
        classes, known = self._kernels.classes(labels, self.table.class_of)
        losses = torch.empty(len(labels), device=self.device)
        gradient, rows = self.table.cross_entropy(terms.features(gaussians), classes, known, losses, s.weight)
        self._last = losses, known
        if self.pulls(gaussians):
            pulled, pull = self._pull_together(gaussians)
            others = CudaPixelTerms.of_gaussians(pulled, terms.capacity, terms.library)
            terms, gradient = terms.append(others), torch.cat([gradient, pull])
        # Without a known pixel nothing may change; a Gaussian in no term makes no step.
        terms = CudaPixelTerms(terms.gaussians, terms.weights, terms.counts * (known > 0), terms.library)
        terms.vote(gaussians, labels, vote_weights)
        terms.step(gaussians, gradient, FeatureAdamSettings(rate=rate_factor * s.rate))
        self.table.step(rows, known, rate_factor * s.classifier_rate)

    def _dense(
        self, gaussians: GaussianMap, rasterizer: CudaRasterizer, keyframe: CudaMaskedKeyframe, view: RenderBuffers
    ) -> torch.Tensor:
        s, mask = self.settings, _mask_of(keyframe)
        size = mask.numel()
        assert view.features is not None
        pixels = torch.arange(size, dtype=torch.int32, device=self.device)
        classes, known = self._kernels.classes(
            self._kernels.labels(mask, pixels, self.device_alias), self.table.class_of
        )
        features, out = view.features.view(IDENTITY_CHANNELS, size), torch.empty_like(view.features)
        losses, rows = torch.empty(size, device=self.device), torch.zeros_like(self.table.rows)
        part = max(1, CudaIdentityTuning.logits_at_once // max(1, self.table.count))
        for begin in range(0, size, part):
            here = slice(begin, begin + part)
            gradient, of_rows = self.table.cross_entropy(
                features[:, here].T, classes[here], known, losses[here], s.weight
            )
            out.view(IDENTITY_CHANNELS, size)[:, here] = gradient.T
            rows += of_rows
        self._last = losses, known
        self.table.step(rows, known, s.classifier_rate)
        if self.pulls(gaussians):
            pulled, pull = self._pull_together(gaussians)
            terms = CudaPixelTerms.of_gaussians(pulled, 1, self.library)
            terms.step(gaussians, pull, FeatureAdamSettings(rate=s.rate))
        return out

    def _pull_together(self, gaussians: GaussianMap) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows int64 [R] of the 3-D loss and their gradients float32 [R, F]; a row may appear more than once."""
        s, classes, size = self.settings.neighbours, self.table.count, len(gaussians)
        k = min(s.neighbours, size - 1)
        samples = self.sample_count(k)
        rows = torch.randint(size, (samples,), generator=self._drawer.generator, device=self.device)
        near = self._neighbours(gaussians.means, rows, k, self.library)
        pulled = torch.cat([rows, near.reshape(-1)])
        logits = self.table.logits(gaussians.features[pulled])
        gradients = self._kernels.neighbour_loss(logits, samples, s.weight * s.value / classes)
        return pulled, torch.mm(gradients, self.table.weight)

    # --- what `CudaLessons` fills in ----------------------------------------------------------------------------------

    @property
    def drawer(self) -> PixelDrawer:
        """Of pixels."""
        return self._drawer

    def sample_count(self, neighbours: int) -> int:
        """Gaussians that the 3-D loss draws, each with so many neighbours."""
        at_once = CudaIdentityTuning.logits_at_once // 10 // ((neighbours + 1) * self.table.count)
        return min(self.settings.neighbours.samples, max(16, at_once))

    def labels_for_parts(self, gaussians: GaussianMap) -> torch.Tensor | None:
        """The map's labels by votes as of the newest keyframe, int32 [N]; None while no object has parts."""
        return self._shown_labels(gaussians) if self._has_parts else None

    def pool(self, number: int) -> PixelPool[torch.Tensor] | None:
        """Pixels that were drawn ahead of a keyframe."""
        return self._pools.get(number)

    def keep_pool(self, number: int, pool: PixelPool[torch.Tensor]) -> PixelPool[torch.Tensor] | None:
        """Keeps the pixels of a keyframe; returns those of another that there is no room for any more."""
        self._pools.pop(number, None)
        self._pools[number] = pool
        return self._pools.pop(next(iter(self._pools))) if len(self._pools) > self.kept_pools else None

    def note_losses(self, losses: torch.Tensor, known: torch.Tensor) -> None:
        """Where a step leaves its losses (float32 [P]) and how many pixels have one (int32 [1])."""
        self._last = losses, known

    def _learned_labels(self, gaussians: GaussianMap) -> torch.Tensor:
        return self.table.labels(gaussians.features, self.settings.min_confidence)


def _mask_of(keyframe: CudaMaskedKeyframe) -> torch.Tensor:
    mask = keyframe.device_mask
    assert mask is not None
    return mask
