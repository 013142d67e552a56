# SPDX-License-Identifier: Apache-2.0
"""Steps of identity learning on an NVIDIA GPU, each by one call of the library or as a part of a call of training.

What all steps have in common is filled in when something that it names has moved. The steps are those that
`CudaIdentityLearner` makes of single operations, with the same pixels and samples; products with the classifier are
summed in another order.
"""

from __future__ import annotations

import ctypes
from typing import Any, Final, Protocol

import torch

from ggslam.abi.cuda import MOST_NEIGHBOURS, IdentityJob, IdentityStep
from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.memory import GrowingMemory, Slots
from ggslam.mapping.cuda.class_table import CudaClassTable
from ggslam.mapping.cuda.pixel_pool import PixelDrawer
from ggslam.mapping.identity import IdentityTimes, IdentityTuning, MaskOnGrid
from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.mapping.pixel_pool import PixelPool
from ggslam.rendering.cuda.pixel_terms import feature_step
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.pixel_terms import FeatureAdamSettings
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS

_SCHEDULES: Final = ("sampled", "votes")


class PoolStore:
    """Room for the pixels of keyframes.

    Args:
        device: where.
        size: pixels of a keyframe.
    """

    def __init__(self, device: torch.device, size: int) -> None:
        self._size = size
        self._pixels = Slots((size,), torch.int32, device)
        self._weights = Slots((size,), torch.float32, device)

    def make_room(self) -> None:
        """Makes some if there is none: to be called while nobody minds an allocation."""
        self._pixels.make_room()
        self._weights.make_room()

    def take(self) -> PixelPool[torch.Tensor]:
        """Room for one keyframe."""
        return PixelPool(self._pixels.take(), self._weights.take())

    def give_back(self, pool: PixelPool[torch.Tensor]) -> None:
        """What is not needed any more; nothing becomes of it if it is of another size."""
        if len(pool.pixels) == self._size:
            self._pixels.give_back(pool.pixels)
            self._weights.give_back(pool.vote_weights)


class Learner(Protocol):
    """What steps are filled in from, see `CudaIdentityLearner`."""

    settings: IdentitySettings
    times: IdentityTimes
    table: CudaClassTable
    library: CudaLibrary
    device: torch.device
    device_alias: torch.Tensor
    device_whole_of: torch.Tensor

    @property
    def drawer(self) -> PixelDrawer: ...

    def sample_count(self, neighbours: int) -> int: ...

    def pulls(self, gaussians: GaussianMap) -> bool: ...

    def labels_for_parts(self, gaussians: GaussianMap) -> torch.Tensor | None: ...

    def pool(self, number: int) -> PixelPool[torch.Tensor] | None: ...

    def keep_pool(self, number: int, pool: PixelPool[torch.Tensor]) -> PixelPool[torch.Tensor] | None: ...

    def note_losses(self, losses: torch.Tensor, known: torch.Tensor) -> None: ...


class CudaLessons:
    """Fills in the steps of a learner.

    Args:
        learner: whose objects, classes and pixels they are of.
    """

    def __init__(self, learner: Learner) -> None:
        self._learner, self._device = learner, learner.device
        self._job, self._step = IdentityJob(), IdentityStep()
        self._filled: tuple[object, ...] = ()  # what the job was filled from: as long as it is equal, so is the job
        self._named: tuple[object, ...] = ()
        self._sizes: set[tuple[int, int]] = set()  # of pictures that the job has room for
        self._memory = GrowingMemory(learner.device)
        self._known = torch.zeros(1, dtype=torch.int32, device=learner.device)
        self._losses = torch.zeros(learner.settings.pixels, device=learner.device)
        pixels = torch.zeros(learner.settings.pixels, dtype=torch.int32, device=learner.device)
        self._once = PixelPool(pixels, torch.zeros_like(self._losses))
        self.pools = PoolStore(learner.device, IdentityTuning.pool_steps * learner.settings.pixels)

    def takes(self, gaussians: GaussianMap) -> bool:
        """Whether the library makes steps on a map."""
        s: IdentitySettings = self._learner.settings
        few = s.neighbours.weight == 0 or s.neighbours.neighbours <= MOST_NEIGHBOURS
        fits = gaussians.with_moments and gaussians.feature_channels == IDENTITY_CHANNELS
        return fits and few and s.schedule in _SCHEDULES and gaussians.count > 0

    def run(self, gaussians: GaussianMap, rasterizer: CudaRasterizer, keyframe: Any, rate_factor: float) -> None:
        """A step at pixels of what was rendered last."""
        rendering, library = rasterizer.last_rendering.native, self._learner.library
        rendering.stream = library.stream(self._device)
        size = (rendering.view.height, rendering.view.width)
        job = self.fill(self._step, gaussians, keyframe, keyframe.device_mask, size, rate_factor)
        library.call("learn", ctypes.byref(job), ctypes.byref(self._step), ctypes.byref(rendering))

    def fill(
        self, step: IdentityStep, gaussians: GaussianMap, keyframe: Any, mask: torch.Tensor, size: tuple[int, int],
        rate_factor: float,
    ) -> IdentityJob:  # fmt: skip
        """Fills in the next step on a keyframe, or its mask on a grid, whose picture is of `size` (height, width), and
        counts it; returns the job that goes with it. Valid until map, masks or classes change. `mask`: what the
        keyframe gives as `device_mask`."""
        learner = self._learner
        self._fill_job(gaussians, size)
        step.mask, step.rate_factor = mask.data_ptr(), rate_factor
        if isinstance(keyframe, MaskOnGrid):
            self._fill_once(step)
        else:
            self._fill_pixels(step, keyframe.index)
        step.pulls = self._job.samples > 0 and learner.pulls(gaussians)  # without classes there are none
        step.pull = learner.times.count
        if self._job.trains:
            learner.note_losses(self._losses, self._known)
        learner.times.count += 1
        return self._job

    def _fill_pixels(self, step: IdentityStep, number: int) -> None:
        """The next pixels of a keyframe; as `IdentityLearner` draws them."""
        learner, wanted = self._learner, self._learner.settings.pixels
        pool, step.drawn = learner.pool(number), 0
        if pool is None or not pool.has(wanted):
            pool = self.pools.take() if pool is None or len(pool.pixels) < len(self._losses) else pool
            step.drawn, step.draw, pool.used = len(pool.pixels), learner.drawer.next_draw(), 0
            dropped = learner.keep_pool(number, pool)
            if dropped is not None:
                self.pools.give_back(dropped)
        step.pool, step.pool_weights = pool.pixels.data_ptr(), pool.vote_weights.data_ptr()
        step.used = pool.used
        pool.used += wanted

    def _fill_once(self, step: IdentityStep) -> None:
        """Pixels of this step alone: the next one has another grid."""
        step.drawn, step.draw, step.used = len(self._once.pixels), self._learner.drawer.next_draw(), 0
        step.pool, step.pool_weights = self._once.pixels.data_ptr(), self._once.vote_weights.data_ptr()

    def _fill_job(self, gaussians: GaussianMap, size: tuple[int, int]) -> None:
        learner = self._learner
        table, shown = learner.table, learner.labels_for_parts(gaussians)
        parts = None if shown is None else shown.data_ptr()
        wanted = (gaussians, gaussians.version, gaussians.allocations, table.places, parts)
        if wanted != self._filled:
            self._fill_in(gaussians, shown)
            self._filled, self._sizes = wanted, set()
        if size not in self._sizes:
            room = learner.library.functions.ggslam_cuda_identity_bytes(ctypes.byref(self._job), *size)
            self._job.workspace = self._memory.block("lesson", room).data_ptr()
            self._sizes.add(size)

    def _fill_in(self, gaussians: GaussianMap, shown: torch.Tensor | None) -> None:
        job, learner, s = self._job, self._learner, self._learner.settings
        table, near, count = learner.table, learner.settings.neighbours, gaussians.count
        classes = table.count
        storage = gaussians.storage
        job.means, job.gaussians = storage["means"].data_ptr(), count
        job.adam = feature_step(gaussians, FeatureAdamSettings(rate=0.0))
        job.vote_ids, job.vote_weights = storage["vote_ids"].data_ptr(), storage["vote_weights"].data_ptr()
        job.alias, job.class_of = learner.device_alias.data_ptr(), table.class_of.data_ptr()
        job.whole_of = None if shown is None else learner.device_whole_of.data_ptr()
        job.shown = None if shown is None else shown.data_ptr()
        rows, first, second, steps = table.training_arrays
        job.rows, job.first_moments, job.second_moments = rows.data_ptr(), first.data_ptr(), second.data_ptr()
        job.steps, job.losses, job.known = steps.data_ptr(), self._losses.data_ptr(), self._known.data_ptr()
        job.balance, job.boundary, job.rate, job.classifier_rate = s.balance, s.boundary, s.rate, s.classifier_rate
        job.seed, job.weight, job.min_weight = learner.drawer.seed, s.weight, IdentityTuning.min_weight
        job.channels, job.classes, job.pixels = IDENTITY_CHANNELS, classes, s.pixels
        job.capacity, job.trains = IdentityTuning.max_terms, s.schedule == "sampled" and classes > 0
        pulls = job.trains and near.weight > 0 and count > 1
        job.neighbours = min(near.neighbours, count - 1) if pulls else 0
        job.samples = learner.sample_count(job.neighbours) if pulls else 0
        job.pull_weight = near.weight * near.value / max(1, classes)
        self._named = (shown, rows, first, second)
