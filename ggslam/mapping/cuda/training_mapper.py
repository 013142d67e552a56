# SPDX-License-Identifier: Apache-2.0
"""How the mapper on an NVIDIA GPU trains: steps are gathered and started by one call of the kernels' library, or, where
that does not know them, made of single calls. The host only starts work; the losses it reports are those that have
arrived without waiting."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import is_
from typing import Any

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.abi.cuda import KeyframeChoice, TargetImages, TrainingStep
from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.streams import Pace
from ggslam.cuda.transfers import HostMirror, download
from ggslam.mapping.comparing_mapper import ComparingMapper
from ggslam.mapping.cuda.between_view import CudaBetweenView
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.cuda.image_store import ImageStore
from ggslam.mapping.cuda.keyframe import CudaKeyframe, DeviceKeyframe
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.losses import CudaImageLoss, CudaLossResult
from ggslam.mapping.cuda.step_rows import KeptRow, StepKind, StepKinds, StepRow
from ggslam.mapping.cuda.training import CudaTraining
from ggslam.mapping.cuda.usable_pixels import UsablePixels
from ggslam.mapping.extra_loss import new_faults, refuse_faults
from ggslam.mapping.identity import MaskOnGrid
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.keyframe_exposures import KeyframeExposures
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.mapper import LossSums, MapperTuning
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.mapping.settings import MapperSettings
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import LOW_PASS, RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap


@dataclass(frozen=True)
class CudaMaskOnGrid(MaskOnGrid):
    """A keyframe's mask at the pixels of a grid, on the device, too."""

    device_mask: torch.Tensor | None = None


class TrainingMapper(ComparingMapper):
    """The part of `CudaMapper` that trains; arguments as there."""

    identity: CudaIdentityLearner | None
    _rasterizer: CudaRasterizer

    def __init__(
        self, gaussians: GaussianMap, settings: MapperSettings, library: CudaLibrary, seed: int = 0,
        identity: CudaIdentityLearner | None = None,
    ) -> None:  # fmt: skip
        super().__init__(gaussians, settings, seed, identity)
        self.device = library.whole_device(None)
        self._rasterizer = CudaRasterizer(self.device, library=library, waits=False)
        self._loss = CudaImageLoss(self.device, library, leaves_saturated=True)
        self._states = KeyframeStates(self.device, library)
        self._images = ImageStore(self.device, is_awaited=lambda: self._training.count > 0)
        self._rasterizer.overflows = self._states.report[6:].view(torch.int64)
        self._report = HostMirror(self._states.report)
        self._pace = Pace(self.device)
        self._repeated = 0
        self._training = CudaTraining(self._rasterizer, self._loss, self._states)
        self._gathers = False  # steps that are started together
        self._kinds = StepKinds()
        self._exposures = KeyframeExposures(settings.exposure)
        self._usable = UsablePixels(self.device)
        self._views: dict[int, CudaBetweenView] = {}  # by frame
        self._faults = new_faults(self.device)
        self._newest_faults = HostMirror(self._faults)

    @property
    def losses(self) -> LossSums:
        return LossSums(*self._report.newest()[:4].tolist())

    @property
    def last_psnr(self) -> float:
        return float(self._report.newest()[4])

    def leave_out(self, numbers: set[int]) -> None:
        super().leave_out(numbers)
        for keyframe in self.keyframes:  # another one may be the world now
            assert isinstance(keyframe, CudaKeyframe)
            keyframe.rows.clear()

    def run(self, iterations: int) -> None:
        iterations += self._count_missed()
        self._gathers = True
        try:
            if self._knows_all_steps:
                self._run_steps(iterations)
            else:
                super().run(iterations)
        finally:
            self._gathers = False
            self._start_steps()
        self._report.send()
        if self.extra_loss is not None:
            self._newest_faults.send()
            refuse_faults(self._newest_faults.newest())
        self._pace.piece_ends()

    def refine(self, iterations: int, progress: Callable[[int, int], None] | None = None, begin: int = 0) -> None:
        self._repeated = int(download(self._rasterizer.overflows)[0][0])
        super().refine(iterations, progress, begin)
        if self.extra_loss is not None:
            refuse_faults(download(self._faults)[0])
        self._views = {}
        self._report.send()

    def _repeat_missed(self, numbers: Sequence[int], averages: bool) -> None:
        for _ in range(self._count_missed(int(download(self._rasterizer.overflows)[0][0]))):
            falling = self.settings.refine_decay
            self.iterate(self._draw(numbers), 1.0 if averages else falling, averages)
            if averages:
                self._mean.add(self.map)

    @property
    def _loss_faults(self) -> torch.Tensor | None:
        return self._faults

    def _count_missed(self, overflows: int | None = None) -> int:
        """Iterations that did nothing, as far as is known, because their rendering found no room: to be made again."""
        overflows = int(self._report.newest()[6:].view(np.int64)[0]) if overflows is None else overflows
        missed = max(0, overflows - self._repeated)
        self._repeated += missed
        return missed

    def _choose_grid(self, keyframe: Keyframe) -> PixelGrid:
        return ALL_PIXELS

    @property
    def _steps_wholly(self) -> bool:
        return not self._needs_all_pixels  # with a loss of whole pictures there is one step, as on the CPU

    def last_iterations(self, before: int) -> int:
        return round(MapperTuning.all_pixels_end_share * before) if self.is_live else super().last_iterations(before)

    # --- what keyframes are compared with ---------------------------------------------------------------------------

    def _masks_on(self, keyframe: Keyframe, grid: PixelGrid) -> Keyframe | MaskOnGrid:
        if grid.is_whole or not isinstance(keyframe, CudaKeyframe):
            return super()._masks_on(keyframe, grid)
        return CudaMaskOnGrid(keyframe.index, None, self._images.mask_of(keyframe, grid))

    def _render(
        self, keyframe: Keyframe, features: bool, grid: PixelGrid = ALL_PIXELS, close_below: float = 0.0
    ) -> RenderBuffers:
        assert isinstance(keyframe, DeviceKeyframe)
        camera = keyframe.camera if grid.is_whole else grid.camera(keyframe.camera)
        self._rasterizer.low_pass, self._rasterizer.close_below = grid.low_pass(LOW_PASS), close_below
        return self._rasterizer.forward(self.map, camera, keyframe.device_pose, features=features)

    def _evaluate_loss(self, keyframe: Keyframe, view: RenderBuffers, grid: PixelGrid = ALL_PIXELS) -> CudaLossResult:
        assert isinstance(keyframe, DeviceKeyframe)
        images, exposure = keyframe.device_images(grid), None
        if self._exposures.is_exposed(keyframe):
            exposure = self._states.exposure(keyframe.index)
        shown = self._comparable_on_device(keyframe, grid)
        target = LossTarget(images.color, images.depth, keyframe.depth_unit, exposure, shown)
        return self._loss.evaluate(view, target, self._loss_settings(keyframe))

    def valid_on_device(self, keyframe: Keyframe, grid: PixelGrid = ALL_PIXELS) -> torch.Tensor | None:
        """`valid_of` at a grid's pixels."""
        sources = (self._valid.get(keyframe.camera_number), keyframe.moving)
        return self._usable.valid(keyframe, sources, lambda: self.valid_of(keyframe), grid)

    def _comparable_on_device(self, keyframe: Keyframe, grid: PixelGrid) -> torch.Tensor | None:
        """`_comparable` at a grid's pixels, but for saturated ones, which the loss leaves out."""
        if self._exposures.blind[keyframe.index]:
            return self._usable.nowhere(keyframe, grid)
        return self.valid_on_device(keyframe, grid)

    # --- steps -------------------------------------------------------------------------------------------------------

    @property
    def _knows_all_steps(self) -> bool:
        """Whether the library makes all steps of `run` by one call."""
        return self.residency is None and self._is_known(learns=True)

    def _run_steps(self, iterations: int) -> None:
        if iterations == 0:
            return
        optimizer, pose_rate, identity = self._standard_adam(), self._pose_rate, self.identity
        keyframes: list[Any] = [
            self.keyframes[number] for number in self._sampler.choose_many(self._trainable(), iterations)
        ]
        lessons = range(0) if identity is None else identity.due_turns(iterations)
        rows = self._rows_of(keyframes, ALL_PIXELS)
        together = self._training.add(rows, optimizer, pose_rate)
        for turn, (keyframe, row) in enumerate(zip(keyframes, rows, strict=True)):
            if not together:
                self._gather(keyframe, ALL_PIXELS, optimizer, pose_rate)
            number = turn if together else self._training.count - 1
            if turn in lessons and identity is not None and keyframe.mask is not None:
                mask = self._images.mask_of(keyframe, ALL_PIXELS, row.images if row.images.is_kept else None)
                self._training.teach(number, identity.lessons, self.map, keyframe, mask)
            keyframe.iterations += 1
            self.times.steps += 1
            self.times.iterations += 1
            if self.times.iterations % MapperTuning.bound_every == 0:
                self._training.clamp_after(number)

    def _step(
        self, keyframe: Keyframe, factors: tuple[float, float], grid: PixelGrid, learns: bool, settles: bool = False
    ) -> None:
        assert isinstance(keyframe, DeviceKeyframe)
        rate_factor, pose_factor = factors
        if not self._is_known(learns):
            self._start_steps()
            super()._step(keyframe, factors, grid, learns, settles)
            return
        pose_rate = self._pose_rate_of(keyframe, grid, pose_factor)
        self._gather(keyframe, grid, self._optimizer(rate_factor, settles), pose_rate)
        if learns and self.identity is not None:
            masked: Any = self._masks_on(keyframe, grid)
            last = self._training.count - 1
            self._training.teach(last, self.identity.lessons, self.map, masked, masked.device_mask)
        self.times.steps += 1
        keyframe.iterations += 1

    def _is_known(self, learns: bool) -> bool:
        """Whether the library makes a step by one call, one of identity learning with it if `learns`."""
        if self.extra_loss is not None or not self._training.is_ready:
            return False
        return not learns or self.identity is None or self.identity.lessons.takes(self.map)

    def _gather(
        self, keyframe: DeviceKeyframe, grid: PixelGrid, optimizer: AdamSettings, pose_rate: float
    ) -> None:
        """A step joins those that are started together; arguments as of `CudaTraining.add`."""
        rows = self._rows_of([keyframe], grid)
        while not self._training.add(rows, optimizer, pose_rate):
            self._start_steps()

    def _rows_of(self, keyframes: Sequence[DeviceKeyframe], grid: PixelGrid) -> list[StepRow]:
        """Rows of keyframes on a grid's pixels. A row is made once and holds while what it was made from are the same
        objects; this is asked for every step, and so in one loop without calls."""
        rows, exposures, valid, beside = list[StepRow](), self._exposures, self._valid, self._beside
        of_all = (self._states.table, self.settings, self.has_soft_outlines, self._usable.kept_since)
        for keyframe in keyframes:
            own, number = vars(keyframe), keyframe.index
            sources = (
                own.get("depth"), own.get("moving"), valid.get(keyframe.camera_number), exposures.blind[number],
                exposures.optimizers[number].anchor, number in beside, *of_all,
            )  # fmt: skip
            for kept in keyframe.rows:
                if kept.grid is grid and kept.row.images.is_kept and all(map(is_, kept.sources, sources)):
                    rows.append(kept.row)
                    break
            else:
                made = KeptRow(grid, sources, self._make_row(keyframe, grid))
                keyframe.rows = [kept for kept in keyframe.rows if kept.grid is not grid] + [made]
                rows.append(made.row)
        self._images.use([row.images for row in rows])
        return rows

    def _make_row(self, keyframe: DeviceKeyframe, grid: PixelGrid) -> StepRow:
        images, shown = keyframe.device_images(grid), self._comparable_on_device(keyframe, grid)
        exposed, number = self._exposures.is_exposed(keyframe), keyframe.index
        camera = keyframe.camera if grid.is_whole else grid.camera(keyframe.camera)
        filters = grid.low_pass(LOW_PASS), self.settings.close_below
        kind = StepKind(camera, self.settings, self._loss_settings(keyframe), exposed, *filters)
        step = TrainingStep(lesson=-1, T_camera_keyframe=address(keyframe.T_camera_keyframe_on_device))
        step.images = TargetImages(
            images.color.data_ptr(), images.depth.data_ptr(), address(shown), keyframe.depth_unit, False
        )  # fmt: skip
        step.keyframe = KeyframeChoice(self._states.address(number), 0.0, exposed and number > 0)
        return StepRow(self._kinds.only(kind), step, images, shown, self.is_world(keyframe))

    def _start_steps(self) -> None:
        """Starts the steps that were gathered."""
        if self._training.count:
            start = time.perf_counter()
            self._training.start(self.map)
            self.times.backward += time.perf_counter() - start

    def _count_iteration(self) -> None:
        super()._count_iteration()
        if not self._gathers:
            self._start_steps()

    def _bound_values(self) -> None:
        if self._training.count:
            self._training.clamp_after(self._training.count - 1)
        else:
            super()._bound_values()

    def _finish_step(self, keyframe: Keyframe, twist: torch.Tensor, loss: CudaLossResult, pose_rate: float) -> None:
        steps_exposure = keyframe.index > 0 and self._exposures.is_exposed(keyframe)
        self._states.step(
            keyframe.index, twist, loss.results, self._rasterizer.last_overflowed, pose_rate,
            self.settings.exposure if steps_exposure else None,
        )  # fmt: skip
