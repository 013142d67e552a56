# SPDX-License-Identifier: Apache-2.0
"""Training steps on an NVIDIA GPU, many by one call of the library.

Of a step itself there are only its row (see `StepRow`) and its rates. The steps are those that `CudaRasterizer`,
`CudaImageLoss` and `KeyframeStates` make one by one, by the same kernels: forward, loss, backward with the optimizer,
the keyframe's step.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, Final

import torch

from ggslam.abi.cuda import IdentityJob, IdentityStep, TrainingStep
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.lessons import CudaLessons
from ggslam.mapping.cuda.losses import CudaImageLoss
from ggslam.mapping.cuda.step_graphs import StepGraphs
from ggslam.mapping.cuda.step_rows import StepKind, StepRow
from ggslam.mapping.cuda.training_jobs import TrainingJobs
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.scene.gaussian_map import GaussianMap

_MOST_STEPS: Final = 64
"""Steps that are gathered for one call."""


class CudaTraining:
    """Gathers steps and starts them.

    Args:
        rasterizer: to render with, one that does not wait.
        loss: evaluates the images.
        states: of the keyframes.
    """

    def __init__(self, rasterizer: CudaRasterizer, loss: CudaImageLoss, states: KeyframeStates) -> None:
        self._rasterizer, self._states = rasterizer, states
        self._library, self._device = rasterizer.library, rasterizer.device
        self._steps: Any = (TrainingStep * _MOST_STEPS)()
        self._lessons: Any = (IdentityStep * _MOST_STEPS)()
        self.count = 0
        """Of the steps that were gathered and not started."""
        self._lesson_count = 0
        self._identity: IdentityJob | None = None
        self._named: list[object] = []  # what the steps have addresses of: it stays until they are started
        self._kind: StepKind | None = None  # of the steps
        self._optimizer: AdamSettings | None = None  # of the last one
        self._recent = ctypes.c_int64(0)
        size = self._library.functions.ggslam_cuda_training_bytes()
        self._desk = torch.zeros(size, dtype=torch.uint8, device=self._device)
        self._jobs = TrainingJobs(rasterizer, loss, states, self._desk)
        self.graphs = StepGraphs(self._library, self._device.index or 0)

    @property
    def fillings(self) -> int:
        """How often what steps have in common was filled in."""
        return self._jobs.fillings

    @property
    def is_ready(self) -> bool:
        """Whether it is known about how much room a rendering needs: the first one has to be waited for."""
        if self._recent.value <= 0:
            self._recent.value = self._rasterizer.counter.recent_pairs()
        return self._recent.value > 0

    def add(self, rows: Sequence[StepRow], optimizer: AdamSettings, pose_rate: float) -> bool:
        """Steps join those that were gathered. False: none does. They do not go together, their images are not kept
        any more, or others have to be started before.

        Args:
            rows: of keyframes, or of frames between keyframes; none is appended until the steps are started.
            optimizer: of the map.
            pose_rate: size of a pose's step in metres and radians where it is not the world's; 0: poses stay.
        """
        kind, count = self._kind if self.count else rows[0].kind, self.count
        if count + len(rows) > _MOST_STEPS:
            return False
        for row in rows:
            if row.kind is not kind or not row.images.is_kept:
                return False
        self._kind, self._optimizer = kind, optimizer
        for row in rows:  # at every frame, and so without calls
            if row.optimizer is not optimizer or row.pose_rate != pose_rate:
                row.set_rates(optimizer, pose_rate)
            self._steps[count] = row.step
            self._named.append((row.images.color, row.images.depth, row.shown))
            count += 1
        self.count = count
        return True

    def teach(
        self, number: int, lessons: CudaLessons, gaussians: GaussianMap, keyframe: Any, mask: torch.Tensor | None
    ) -> None:
        """On the rendering of a step that was gathered, by its number, a step of identity learning is made, too, with
        a keyframe's mask on its grid. Of several steps, the earlier one is to be told first."""
        assert self._kind is not None and mask is not None
        lesson, camera = self._lesson_count, self._kind.camera
        size = (camera.height, camera.width)
        self._identity = lessons.fill(self._lessons[lesson], gaussians, keyframe, mask, size, 1.0)
        self._steps[number].lesson = lesson
        self._named.append(mask)
        self._lesson_count += 1

    def clamp_after(self, number: int) -> None:
        """After a step that was gathered, sizes and, of degree 0, colours are brought within their bounds."""
        self._steps[number].bounded = 1

    def start(self, gaussians: GaussianMap) -> None:
        """Starts the steps that were gathered, on torch's current stream."""
        count = self.count
        if count == 0:
            return
        job = self._job(gaussians)
        job.rendering.stream = self._states.begin_steps()
        self._rasterizer.forget()
        identity = ctypes.byref(self._identity) if self._identity is not None and self._lesson_count else None
        counter, recent = self._rasterizer.counter.handle, ctypes.byref(self._recent)
        steps, lessons, graphs = self._steps, self._lessons, self.graphs.handle
        self.count = self._lesson_count = 0
        self._library.call("train", ctypes.byref(job), steps, count, identity, lessons, graphs, counter, recent)
        self._states.note_steps()
        self._named.clear()

    def _job(self, gaussians: GaussianMap) -> Any:
        kind, optimizer, counter = self._kind, self._optimizer, self._rasterizer.counter
        assert kind is not None and optimizer is not None
        if not self._jobs.knows(gaussians):  # there may have been other renderings since
            self._recent.value = counter.recent_pairs()
        room = counter.room_for(self._recent.value) or counter.spare_pairs
        return self._jobs.job(kind, optimizer, gaussians, room)
