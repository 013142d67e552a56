# SPDX-License-Identifier: Apache-2.0
"""The mapper on the CPU: the compiled core renders, differentiates and steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.mapping.comparing_mapper import ComparingMapper
from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.insertion import fill_gaussians, find_unexplained, new_gaussians
from ggslam.mapping.cpu.losses import CpuImageLoss, CpuLossResult
from ggslam.mapping.densification import DensificationTuning, ScreenGradients, densify, sparse_pixels
from ggslam.mapping.identity import IdentityTuning
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe, PoseAdam, make_keyframe
from ggslam.mapping.keyframe_exposures import KeyframeExposures
from ggslam.mapping.labelling import Labeller, MapLabels
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.mapper import LossSums
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.exposure import SeenAgain
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.array_forms import check_indices
from ggslam.system.savable import savable


@savable(
    not_saved="settings residency extra_loss fits_view_colors _beside _rasterizer _loss _adam_of_pixel",
    growing="between", check="check",
)  # fmt: skip
class CpuMapper(ComparingMapper):
    """See `Mapper`. With the same seed, frames and iteration counts a run on one machine repeats bit for bit, for any
    number of threads.

    Args:
        context: threads and instruction set.
        Others: as in `Mapper`.
    """

    identity: CpuIdentityLearner | None
    _rasterizer: CpuRasterizer

    _pose_optimizers: list[PoseAdam]

    def check(self) -> None:
        """Raises FormatError if its parts are not of the same keyframes and Gaussians: it may come from a file."""
        count = len(self.keyframes)
        check_indices("keyframes that were left out", self.left_out, count)
        check_indices("frames between keyframes", (frame.keyframe for frame in self.between), count)
        check_indices("frames between keyframes that do not train", self.unfit, len(self.between))
        for frame in self.between:
            frame.check(self.keyframes[frame.keyframe])
        if len(self._pose_optimizers) != count:
            raise FormatError(f"optimisers of poses: expected {count}, found {len(self._pose_optimizers)}")
        self._exposures.check(count)
        if self.identity is not None:
            self.identity.check(self.keyframes)
        if not self._mean.fits(self.map):
            raise FormatError("the mean of the map does not match its Gaussians")
        self.map.check(count)

    def __init__(
        self,
        gaussians: GaussianMap,
        settings: MapperSettings,
        context: NativeContext,
        seed: int = 0,
        identity: CpuIdentityLearner | None = None,
    ) -> None:
        super().__init__(gaussians, settings, seed, identity)
        self._losses = LossSums()
        self._last_psnr = float("nan")
        self._rasterizer = CpuRasterizer(context=context)
        self._loss = CpuImageLoss(context)
        self._pose_optimizers = []
        self._exposures = KeyframeExposures(settings.exposure)

    @property
    def losses(self) -> LossSums:
        return self._losses

    @property
    def last_psnr(self) -> float:
        return self._last_psnr

    def load_map(self, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
        super().load_map(gaussians, keyframes)
        self._pose_optimizers = [PoseAdam() for _ in keyframes]
        self._exposures.load(keyframes)

    def render_view(self, camera: Camera, T_camera_world: np.ndarray) -> RenderBuffers:
        return self._rasterizer.forward(self.map, camera, T_camera_world, features=False)

    def _render_all(self, keyframe: Keyframe, grid: PixelGrid = ALL_PIXELS) -> RenderBuffers:
        return self._render(keyframe, features=False, grid=grid)

    def _fetch(self, *images: torch.Tensor) -> list[np.ndarray]:
        return [image.numpy() for image in images]

    def _mark_shown(self, shown: torch.Tensor, least: float) -> None:
        self._rasterizer.mark_shown(shown.numpy(), least)

    @property
    def _context(self) -> NativeContext:
        return self._rasterizer.context

    def _new_keyframe(self, frame: Frame, T_world_camera: np.ndarray) -> Keyframe:
        self._pose_optimizers.append(PoseAdam())
        self._exposures.add()
        return make_keyframe(len(self.keyframes), frame, T_world_camera)

    def _insert(
        self, keyframe: Keyframe, T_world_camera: np.ndarray, labeller: Labeller | None,
        begin_others: Callable[[], None],
    ) -> None:  # fmt: skip
        depth, s = keyframe.depth_m(), self._insertion_settings
        where, alpha = None, np.zeros(depth.shape, np.float32)
        show: Callable[[], MapLabels] | None = None
        seen: SeenAgain | None = None
        if self.map.count:
            view = self._render(keyframe, features=False, close_below=self.settings.close_below)
            alpha, rendered = view.alpha.numpy(), view.expected_depth.numpy()
            where = find_unexplained(depth, alpha, rendered, s)
            show = partial(self._show_labels, alpha, rendered)
            seen = SeenAgain(view.image.numpy(), alpha, rendered, depth)
        if self.settings.densification == "instead":
            where = sparse_pixels(where, depth.shape)
        begin_others()
        color = self._colors(keyframe, seen)
        valid = self.valid_of(keyframe)
        if valid is not None:
            alpha = np.where(valid, alpha, np.float32(1))  # where images show nothing there is nothing to fill
        if self.identity is not None and labeller is not None:
            self._take_labels(keyframe, labeller(keyframe, show))
        # Others work by now: threads for the few pixels of a later keyframe would only wait for one another.
        context = self._rasterizer.context if where is None else None
        parts = [new_gaussians(color, depth, keyframe.camera, T_world_camera, where, s, context)]
        if s.fill_stride:
            parts.append(fill_gaussians(color, depth, alpha, keyframe.camera, T_world_camera, s))
        logit = float(np.log(s.opacity / (1 - s.opacity)))
        for new in parts:
            rows = self.map.insert(
                torch.from_numpy(new.means), torch.from_numpy(new.quaternions), torch.from_numpy(new.log_scales),
                torch.full((len(new.means),), logit), torch.from_numpy(new.rgb), birth_keyframe=keyframe.index,
            )  # fmt: skip
            if self.identity is not None:
                mask = keyframe.mask
                labels = np.zeros(len(new.pixels), np.uint16) if mask is None else mask.reshape(-1)[new.pixels]
                self.identity.begin(self.map, rows, labels)

    def _show_labels(self, alpha: np.ndarray, depth: np.ndarray, stride: int = 2) -> MapLabels:
        """What the last rendering shows of the objects, looked at on every `stride`-th pixel and row."""
        height, width = alpha.shape
        grid = np.arange(height * width, dtype=np.int32).reshape(height, width)[::stride, ::stride]
        terms = self._rasterizer.pixel_terms(grid.reshape(-1), IdentityTuning.max_terms, IdentityTuning.min_weight)
        ids, share = terms.labels(self.vote_labels())
        ids, share = ids.reshape(grid.shape), share.reshape(grid.shape) * (alpha[::stride, ::stride] > 0.5)
        return MapLabels.from_grid(ids, share, depth, stride)

    def _densify(self) -> None:
        if self.settings.densification == "never":
            return
        gradients = ScreenGradients.none(len(self.map))
        for number in self._trainable()[-DensificationTuning.views :]:
            keyframe = self.keyframes[number]
            if keyframe.frame_index == FROM_EARLIER_RUN:
                continue
            loss = self._evaluate_loss(keyframe, self._render(keyframe, features=False))
            found = self._rasterizer.backward(loss.d_image, loss.d_depth, loss.d_alpha)
            shown = found.touched.numpy().astype(bool)
            gradients.add(keyframe, self.map.means.numpy(), found.means.numpy(), shown)
        densify(self.map, gradients, len(self.keyframes))

    def _render(
        self, keyframe: Keyframe, features: bool, grid: PixelGrid = ALL_PIXELS, close_below: float = 0.0
    ) -> RenderBuffers:
        camera, pose = grid.camera(keyframe.camera), keyframe.T_camera_world
        low_pass = grid.low_pass(self._rasterizer.low_pass)
        return self._rasterizer.forward(
            self.map, camera, pose, features=features, low_pass=low_pass, close_below=close_below
        )

    def _evaluate_loss(self, keyframe: Keyframe, view: RenderBuffers, grid: PixelGrid = ALL_PIXELS) -> CpuLossResult:
        shown = self._comparable(keyframe)
        color, depth = grid.color_of(keyframe.color), grid.depth_of(keyframe.depth)
        shown = None if shown is None else grid.valid_of(shown)
        target = LossTarget(color, depth, keyframe.depth_unit, self._exposure_of(keyframe), shown)
        return self._loss.evaluate(view, target, self._loss_settings(keyframe))

    def _finish_step(self, keyframe: Keyframe, twist: np.ndarray, loss: CpuLossResult, pose_rate: float) -> None:
        if pose_rate:
            optimizer, T_before = self._pose_optimizers[keyframe.index], keyframe.T_camera_world
            keyframe.T_camera_world = optimizer.step(T_before, twist, pose_rate)
            self._move_rig(keyframe, T_before)
        if keyframe.index > 0 and self._exposures.is_exposed(keyframe):
            optimizer_of_exposure = self._exposures.optimizers[keyframe.index]
            keyframe.exposure = optimizer_of_exposure.step(keyframe.exposure, loss.exposure_gradient)
        self._last_psnr = loss.psnr
        self._losses.total += loss.values.total
        self._losses.color += loss.values.color
        self._losses.ssim += loss.values.ssim
        self._losses.depth += loss.values.depth
