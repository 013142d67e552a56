# SPDX-License-Identifier: Apache-2.0
"""What training steps of a kind have in common, as the library takes it: filled in when something that it names has
moved, kept for the kinds that were used last."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import torch

from ggslam.abi.core import GaussianGradients
from ggslam.abi.cuda import KeyframeStepJob, TrainingJob
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.losses import CudaImageLoss
from ggslam.mapping.cuda.step_rows import StepKind
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.arguments import image_gradients
from ggslam.rendering.cuda.adam import AdamSteps
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.scene.gaussian_map import SH_C0, GaussianMap

_KEPT: Final = 4
"""Jobs; the library keeps graphs of as many."""


@dataclass
class _KeptJob:
    """A job, what it was filled from besides map and memory, and what it has addresses of."""

    job: TrainingJob
    sources: tuple[object, ...]
    named: tuple[object, ...]


class TrainingJobs:
    """Makes the jobs.

    Args:
        rasterizer: to render with, one that does not wait.
        loss: evaluates the images.
        states: of the keyframes.
        desk: where the library lays steps down.
    """

    def __init__(
        self, rasterizer: CudaRasterizer, loss: CudaImageLoss, states: KeyframeStates, desk: torch.Tensor
    ) -> None:
        self._rasterizer, self._loss, self._states, self._desk = rasterizer, loss, states, desk
        self._twist = torch.zeros(6, dtype=torch.float64, device=rasterizer.device)
        self._adam_steps = AdamSteps()
        self._kept: dict[StepKind, _KeptJob] = {}
        self._rateless: tuple[AdamSettings | None, tuple[object, ...]] = None, ()
        self._filled_for: tuple[object, ...] = ()  # map and memory that the jobs name
        self.fillings = 0
        """How often a job was filled."""

    def knows(self, gaussians: GaussianMap) -> bool:
        """Whether the map is as it was when a job was made last."""
        return (gaussians, gaussians.version, gaussians.allocations) == self._filled_for[:3]

    def job(self, kind: StepKind, optimizer: AdamSettings, gaussians: GaussianMap, room: int) -> TrainingJob:
        """The job of steps of a kind on a map, with room for so many pairs of a Gaussian and a tile. Valid until
        another is asked for."""
        rasterizer = self._rasterizer
        if self._places(gaussians) != self._filled_for:
            self._kept = {}  # jobs of what has moved would keep it in memory
        if self._rateless[0] is not optimizer:
            self._rateless = optimizer, _all_but_rates(optimizer)
        sources = room, rasterizer.near_plane, *self._rateless[1]
        kept = self._kept.pop(kind, None)
        if kept is None or kept.sources != sources:
            rasterizer.low_pass, rasterizer.close_below = kind.low_pass, kind.close_below
            before = self._places(gaussians)
            kept = self._fill(kind, optimizer, gaussians, room, sources)
            self._filled_for = self._places(gaussians)
            if self._filled_for != before:
                self._kept = {}
            self.fillings += 1
        self._kept[kind] = kept  # the one used last stands last
        if len(self._kept) > _KEPT:
            del self._kept[next(iter(self._kept))]
        return kept.job

    def _places(self, gaussians: GaussianMap) -> tuple[object, ...]:
        memory = self._rasterizer.memory.allocations, self._loss.memory.allocations
        return gaussians, gaussians.version, gaussians.allocations, *memory

    def _fill(
        self, kind: StepKind, optimizer: AdamSettings, gaussians: GaussianMap, room: int, sources: tuple[object, ...]
    ) -> _KeptJob:
        job, rasterizer, settings, camera = TrainingJob(), self._rasterizer, kind.settings, kind.camera
        memory = rasterizer.memory
        rendering = rasterizer.plan(gaussians, camera, room)
        job.rendering = rendering.native
        job.loss = self._loss.plan(rendering.buffers, (camera.height, camera.width), kind.loss)
        job.loss.exposure = self._desk.data_ptr() if kind.exposed else None
        result, rows = self._loss.result, memory.block("gradients", rendering.gradient_bytes)
        gradients = (result.d_image, result.d_depth, result.d_alpha, None)
        job.image_gradients = image_gradients(rendering.buffers, gradients, True, rasterizer.device)
        touched = memory.block("touched", max(1, len(gaussians)))
        twist = self._twist.data_ptr()
        job.gradients = GaussianGradients(twist=twist, touched=touched.data_ptr())
        job.adam = self._adam_steps.make(gaussians, optimizer, rasterizer.device)
        job.keyframe = KeyframeStepJob(
            twist=twist, results=result.results.data_ptr(), skipped=rasterizer.last_overflowed.data_ptr(),
            totals=self._states.totals.data_ptr(), exposure_rate=settings.exposure.rate,
            exposure_regularization=settings.exposure.regularization,
        )  # fmt: skip
        job.row_memory, job.desk = rows.data_ptr(), self._desk.data_ptr()
        job.largest_log_scale = math.log(settings.pruning.max_scale_m)
        job.darkest, job.brightest = -0.5 / SH_C0, 0.5 / SH_C0
        job.bounds_colors = gaussians.sh_degree == 0
        named = (rendering, result, rows, touched, self._loss.memory.block("loss", 0))
        return _KeptJob(job, sources, named)


def _all_but_rates(optimizer: AdamSettings) -> tuple[object, ...]:
    """What the job has of an optimizer."""
    o = optimizer
    times = (o.decay, o.decay_floor, o.decayed_groups, o.fall_updates, o.fall_floor, o.falling_groups)
    return (o.beta1, o.beta2, o.epsilon, *times)
