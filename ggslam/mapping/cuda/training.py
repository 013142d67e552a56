# SPDX-License-Identifier: Apache-2.0
"""Training steps on an NVIDIA GPU, many by one call of the library.

What all steps have in common is filled in when something that it names has moved; of a step itself there are only its
keyframe's row, its images and its rates. The steps are those that `CudaRasterizer`, `CudaImageLoss` and
`KeyframeStates` make one by one, by the same kernels: forward, loss, backward with the optimizer, the keyframe's step.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass, replace
from typing import Any, Final

import torch

from ggslam.abi.arrays import address
from ggslam.abi.core import GaussianGradients
from ggslam.abi.cuda import IdentityJob, IdentityStep, KeyframeStepJob, TrainingJob, TrainingStep
from ggslam.mapping.cuda.keyframe import CudaKeyframe, CudaKeyframeImages
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.lessons import CudaLessons
from ggslam.mapping.cuda.losses import CudaImageLoss
from ggslam.mapping.cuda.step_graphs import StepGraphs
from ggslam.mapping.settings import LossSettings, MapperSettings
from ggslam.rendering.adam import ADAM_GROUPS, AdamSettings
from ggslam.rendering.arguments import image_gradients
from ggslam.rendering.cuda.adam import AdamSteps
from ggslam.rendering.cuda.finished import MapState
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import SH_C0, GaussianMap

_MOST_STEPS: Final = 64
"""Steps that are gathered for one call."""


@dataclass(frozen=True, eq=False)
class StepKind:
    """What steps of one call have in common.

    Attributes:
        camera: of the keyframes.
        settings: of the mapper.
        loss: of the images.
        exposed: whether keyframes have exposures of their own, which follow their gradients.
        low_pass: filter of the renderings, pixels^2.
        close_below: see `CudaRasterizer`.
    """

    camera: Camera
    settings: MapperSettings
    loss: LossSettings
    exposed: bool
    low_pass: float
    close_below: float

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, StepKind):
            return NotImplemented
        same = self.settings is other.settings and self.exposed == other.exposed
        same = same and (self.low_pass, self.close_below) == (other.low_pass, other.close_below)
        same = same and (self.camera is other.camera or self.camera == other.camera)
        return same and (self.loss is other.loss or self.loss == other.loss)


@dataclass(frozen=True)
class _Filled:
    """What the job was filled from, but for the kind of steps: as long as it is equal, so is the job."""

    map: MapState
    room: int
    memory: int
    near_plane: float
    optimizer: tuple[object, ...]


class CudaTraining:
    """Gathers steps and starts them.

    Args:
        rasterizer: to render with, one that does not wait.
        loss: evaluates the images.
        states: of the keyframes.

    Attributes:
        graphs: by which steps are started.
    """

    def __init__(self, rasterizer: CudaRasterizer, loss: CudaImageLoss, states: KeyframeStates) -> None:
        self._rasterizer, self._loss, self._states = rasterizer, loss, states
        self._library, self._device = rasterizer.library, rasterizer.device
        self._job = TrainingJob()
        self._steps: Any = (TrainingStep * _MOST_STEPS)()
        self._lessons: Any = (IdentityStep * _MOST_STEPS)()
        self.count = 0
        """Of the steps that were gathered and not started."""
        self._lesson_count = 0
        self._identity: IdentityJob | None = None
        self._images: list[object] = []  # of the steps: they stay until the steps are started
        self._kind: StepKind | None = None
        self._optimizer: AdamSettings | None = None  # of the last step
        self._rates: Any = (ctypes.c_float * len(ADAM_GROUPS))()
        self._adam_steps = AdamSteps()
        self._recent = ctypes.c_int64(0)
        self._filled: _Filled | None = None
        self._named: tuple[object, ...] = ()  # what the job has addresses of
        size = self._library.functions.ggslam_cuda_training_bytes()
        self._desk = torch.zeros(size, dtype=torch.uint8, device=self._device)
        self._twist = torch.zeros(6, dtype=torch.float64, device=self._device)
        self.fillings = 0
        """How often the job was filled."""
        self.graphs = StepGraphs(self._library, self._device.index or 0)

    @property
    def is_ready(self) -> bool:
        """Whether it is known about how much room a rendering needs: the first one has to be waited for."""
        if self._recent.value <= 0:
            self._recent.value = self._rasterizer.counter.recent_pairs()
        return self._recent.value > 0

    def fits(self, like: StepKind) -> bool:
        """Whether a step of this kind may join those that were gathered."""
        return self.count == 0 or (self.count < _MOST_STEPS and like == self._kind)

    def add(
        self, kind: StepKind, row: int, images: CudaKeyframeImages, depth_unit: float, shown: torch.Tensor | None,
        optimizer: AdamSettings, pose_rate: float,
    ) -> None:  # fmt: skip
        """A step joins those that were gathered, which it `fits`.

        Args:
            kind: what it has in common with others.
            row: of the keyframe among the states; none is appended until the step is started.
            images: of the keyframe.
            depth_unit: of its depth, metres.
            shown: bool [H, W] on the device, where its colours count; None: everywhere.
            optimizer: of the map.
            pose_rate: size of the pose's step in metres and radians; 0: the pose stays.
        """
        if kind != self._kind:
            self._kind, self._filled = kind, None
        step = self._steps[self.count]
        target, keyframe = step.images, step.keyframe
        target.color, target.depth = images.color.data_ptr(), images.depth.data_ptr()
        target.valid = None if shown is None else shown.data_ptr()
        target.depth_scale, target.depth_is_float = depth_unit, 0
        keyframe.state, keyframe.pose_rate = self._states.address(row), pose_rate
        keyframe.step_exposure = kind.exposed and row > 0
        if optimizer is not self._optimizer:
            self._optimizer = optimizer
            self._rates[:] = [float(optimizer.learning_rates.get(name, 0.0)) for name in ADAM_GROUPS]
        step.rates, step.bounded, step.lesson = self._rates, 0, -1
        self._images += (images, shown)
        self.count += 1

    def teach_last(self, lessons: CudaLessons, gaussians: GaussianMap, keyframe: CudaKeyframe) -> None:
        """On the rendering of the last step that was gathered, a step of identity learning is made, too."""
        camera, number = keyframe.camera, self._lesson_count
        size = (camera.height, camera.width)
        self._identity = lessons.fill(self._lessons[number], gaussians, keyframe, size, 1.0)
        self._steps[self.count - 1].lesson = number
        self._images.append(keyframe.device_mask)
        self._lesson_count += 1

    def bound_last(self) -> None:
        """After the last step that was gathered, sizes and, of degree 0, colours are brought within their bounds."""
        self._steps[self.count - 1].bounded = 1

    def start(self, gaussians: GaussianMap) -> None:
        """Starts the steps that were gathered, on torch's current stream."""
        count = self.count
        if count == 0:
            return
        self._fill(gaussians)
        self._job.rendering.stream = self._states.begin_steps()
        self._rasterizer.forget()
        identity = ctypes.byref(self._identity) if self._identity is not None and self._lesson_count else None
        ends = self.graphs.handle, self._rasterizer.counter.handle, ctypes.byref(self._recent)
        steps, lessons = self._steps, self._lessons
        self.count = self._lesson_count = 0
        self._library.call("train", ctypes.byref(self._job), steps, count, identity, lessons, *ends)
        self._images.clear()

    # --- the job -----------------------------------------------------------------------------------------------------

    def _fill(self, gaussians: GaussianMap) -> None:
        """Fills the job if it is not as it should be."""
        kind, optimizer, rasterizer = self._kind, self._optimizer, self._rasterizer
        assert kind is not None and optimizer is not None
        rasterizer.low_pass, rasterizer.close_below = kind.low_pass, kind.close_below
        state = MapState.of(gaussians)
        if self._filled is None or self._filled.map != state:  # there may have been other renderings since
            self._recent.value = rasterizer.counter.recent_pairs()
        room = rasterizer.counter.room_for(self._recent.value) or rasterizer.counter.spare_pairs
        allocations = rasterizer.memory.allocations + self._loss.memory.allocations
        wanted = _Filled(state, room, allocations, rasterizer.near_plane, _shape_of(optimizer))
        if wanted == self._filled:
            return
        self._fill_in(gaussians, kind, room, optimizer)
        allocations = rasterizer.memory.allocations + self._loss.memory.allocations
        self._filled = replace(wanted, memory=allocations)
        self.fillings += 1

    def _fill_in(self, gaussians: GaussianMap, kind: StepKind, room: int, optimizer: AdamSettings) -> None:
        job, rasterizer, settings, camera = self._job, self._rasterizer, kind.settings, kind.camera
        memory = rasterizer.memory
        rendering = rasterizer.plan(gaussians, camera, room)
        job.rendering = rendering.native
        job.loss = self._loss.plan(rendering.buffers, (camera.height, camera.width), kind.loss)
        job.loss.exposure = self._desk.data_ptr() if kind.exposed else None
        result, rows = self._loss.result, memory.block("gradients", rendering.gradient_bytes)
        gradients = (result.d_image, result.d_depth, result.d_alpha, None)
        job.image_gradients = image_gradients(rendering.buffers, gradients, True, self._device)
        touched = memory.block("touched", max(1, len(gaussians)))
        job.gradients = GaussianGradients(twist=address(self._twist), touched=address(touched))
        job.adam = self._adam_steps.make(gaussians, optimizer, self._device)
        job.keyframe = KeyframeStepJob(
            twist=address(self._twist), results=address(result.results), skipped=address(rasterizer.last_overflowed),
            totals=address(self._states.totals), exposure_rate=settings.exposure.rate,
            exposure_regularization=settings.exposure.regularization,
        )  # fmt: skip
        job.row_memory, job.desk = address(rows), address(self._desk)
        job.largest_log_scale = math.log(settings.pruning.max_scale_m)
        job.darkest, job.brightest = -0.5 / SH_C0, 0.5 / SH_C0
        job.bounds_colors = gaussians.sh_degree == 0
        self._named = (rendering, result, rows, touched, self._loss.memory.block("loss", 0))


def _shape_of(optimizer: AdamSettings) -> tuple[object, ...]:
    """What the job has of an optimizer: all but its rates."""
    o = optimizer
    times = (o.decay, o.decay_floor, o.decayed_groups, o.fall_updates, o.fall_floor, o.falling_groups)
    return (o.beta1, o.beta2, o.epsilon, *times)
