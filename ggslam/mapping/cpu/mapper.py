# SPDX-License-Identifier: Apache-2.0
"""The mapper on the CPU: the compiled core renders, differentiates and steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from ggslam.mapping.cpu.exposure import ExposureAdam
from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.insertion import fill_gaussians, find_unexplained, new_gaussians
from ggslam.mapping.cpu.losses import CpuImageLoss, CpuLossResult
from ggslam.mapping.identity import MIN_WEIGHT, TERMS
from ggslam.mapping.keyframe import DEPTH_UNITS_PER_METRE, ELSEWHERE, Keyframe, PoseAdam, make_keyframe
from ggslam.mapping.labelling import Labeller, MapLabels
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.mapper import LossSums, Mapper
from ggslam.mapping.pixel_grid import WHOLE, PixelGrid, grid_of_turn
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.exposure import change_of, measure_exposure, without_exposure
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap

FEW_LOOKS = 8
"""Where fewer keyframes look for what surfaces hide, each looks with all its pixels; else with a quarter of them by
turns, so that what one misses another one shows."""
MOST_TERMS = 256
"""Shares of a pixel that are looked at; a pixel has hardly more that count."""
TERMS_AT_ONCE = 1 << 22
"""Shares of pixels that are looked at together; each takes eight bytes."""


class CpuMapper(Mapper):
    """See `Mapper`. With the same seed, frames and iteration counts a run on one machine repeats bit for bit, for any
    number of threads.

    Args:
        context: threads and instruction set.
        Others: as in `Mapper`.
    """

    identity: CpuIdentityLearner | None
    _rasterizer: CpuRasterizer

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
        self._pose_optimizers: list[PoseAdam] = []
        self._exposure_optimizers: list[ExposureAdam] = []
        self._exposure_changed = False
        """Whether a keyframe has an anchor: as soon as one has, those that follow are compared with the map's."""

    @property
    def losses(self) -> LossSums:
        return self._losses

    @property
    def last_psnr(self) -> float:
        return self._last_psnr

    def adopt(self, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
        super().adopt(gaussians, keyframes)
        self._pose_optimizers = [PoseAdam() for _ in keyframes]
        self._exposure_optimizers = [ExposureAdam(self.settings.exposure) for _ in keyframes]

    def render_view(self, camera: Camera, T_camera_world: np.ndarray) -> RenderBuffers:
        """The map as a camera sees it from a pose [4, 4], without identities; not beside `run`."""
        return self._rasterizer.forward(self.map, camera, T_camera_world, features=False)

    def _new_keyframe(self, frame: Frame, T_world_camera: np.ndarray) -> Keyframe:
        self._pose_optimizers.append(PoseAdam())
        self._exposure_optimizers.append(ExposureAdam(self.settings.exposure))
        return make_keyframe(len(self.keyframes), frame, T_world_camera)

    def _insert(self, keyframe: Keyframe, T_world_camera: np.ndarray, labeller: Labeller | None) -> None:
        depth, s = keyframe.depth_m(), self.settings.insertion
        where, alpha = None, np.zeros(depth.shape, np.float32)
        show: Callable[[], MapLabels] | None = None
        color = keyframe.color
        if self.map.count:
            view = self._render(keyframe, features=False, close_below=self.settings.close_below)
            alpha, rendered = view.alpha.numpy(), view.expected_depth.numpy()
            where = find_unexplained(depth, alpha, rendered, s)
            show = partial(self._show_labels, alpha, rendered)
            color = self._compensate(keyframe, depth, view, rendered)
        valid = self.valid_of(keyframe)
        if valid is not None:
            alpha = np.where(valid, alpha, np.float32(1))  # where images show nothing there is nothing to fill
        if self.identity is not None and labeller is not None:
            self._take_labels(keyframe, labeller(keyframe, show))
        context = self._rasterizer.context
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

    def _compensate(
        self, keyframe: Keyframe, depth: np.ndarray, view: RenderBuffers, rendered_depth: np.ndarray
    ) -> np.ndarray:
        """A keyframe seen with another exposure than the map gets what is measured; its colours [H, W, 3] as the map's
        exposure would have shown them."""
        if not self.settings.exposure.compensate:
            return keyframe.color
        images = (view.image.numpy(), view.alpha.numpy(), rendered_depth)
        found = measure_exposure(keyframe.color, depth, *images)
        if found is None:
            return keyframe.color
        self._exposure_optimizers[keyframe.index].measured = found
        if not self._exposure_changed and abs(np.log(change_of(found))) > self.settings.exposure.change:
            for earlier in self.keyframes:
                self._anchor(earlier)
            self._exposure_changed = True
        return self._anchor(keyframe) if self._exposure_changed else keyframe.color

    def _anchor(self, keyframe: Keyframe) -> np.ndarray:
        """Gives a keyframe the exposure that was measured, if it differs from the map's; returns as `_compensate`."""
        optimizer = self._exposure_optimizers[keyframe.index]
        measured = optimizer.measured
        if np.abs(np.log(measured[:, 0])).max() < self.settings.exposure.least:
            return keyframe.color
        keyframe.exposure, optimizer.anchor = measured.copy(), measured
        return without_exposure(keyframe.color, measured)

    def _is_exposed(self, keyframe: Keyframe) -> bool:
        """Whether it has an exposure of its own."""
        return self.settings.exposure.enabled or self._exposure_optimizers[keyframe.index].is_anchored

    def _show_labels(self, alpha: np.ndarray, depth: np.ndarray, stride: int = 2) -> MapLabels:
        """What the last rendering shows of the objects, looked at on every `stride`-th pixel and row."""
        height, width = alpha.shape
        grid = np.arange(height * width, dtype=np.int32).reshape(height, width)[::stride, ::stride]
        terms = self._rasterizer.pixel_terms(grid.reshape(-1), TERMS, MIN_WEIGHT)
        ids, share = terms.labels(self.vote_labels())
        ids, share = ids.reshape(grid.shape), share.reshape(grid.shape) * (alpha[::stride, ::stride] > 0.5)
        return MapLabels.from_grid(ids, share, depth, stride)

    def drop_hidden(self) -> None:
        least = self.settings.pruning.min_weight
        if not least or not self.keyframes or len(self._trainable()) < len(self._all_numbers):
            return
        keyframes = [self.keyframes[k] for k in self._all_numbers]
        own, newest = [k for k in keyframes if k.frame_index != ELSEWHERE], keyframes[-1]
        untrained = {k.index for k in own if k is newest or (k.instant is not None and k.instant == newest.instant)}
        born = self.map.birth_keyframe.numpy()
        stays = ~np.isin(born, [k.index for k in own if k.index not in untrained])
        for keyframe in own:
            grid = WHOLE if len(own) < FEW_LOOKS else grid_of_turn(keyframe.index, keyframe.camera)
            view = self._render(keyframe, features=False, grid=grid)
            terms = min(int(1 / least) + 1, MOST_TERMS)  # a pixel has no more of such a share
            pixels, some = np.arange(view.alpha.numel(), dtype=np.int32), TERMS_AT_ONCE // terms
            for begin in range(0, len(pixels), some):
                stays[self._rasterizer.pixel_terms(pixels[begin : begin + some], terms, least).rows()] = True
        self.map.keep(torch.from_numpy(stays))

    def _render(
        self, keyframe: Keyframe, features: bool, grid: PixelGrid = WHOLE, close_below: float = 0.0
    ) -> RenderBuffers:
        camera, pose = grid.camera(keyframe.camera), keyframe.T_camera_world
        low_pass = grid.low_pass(self._rasterizer.low_pass)
        return self._rasterizer.forward(
            self.map, camera, pose, features=features, low_pass=low_pass, close_below=close_below
        )

    def _evaluate_loss(self, keyframe: Keyframe, view: RenderBuffers, grid: PixelGrid = WHOLE) -> CpuLossResult:
        exposure = keyframe.exposure if self._is_exposed(keyframe) else None
        valid = self.valid_of(keyframe)
        color, depth = grid.of(keyframe.color), grid.of(keyframe.depth)
        shown = None if valid is None else grid.of(valid)
        target = LossTarget(color, depth, 1 / DEPTH_UNITS_PER_METRE, exposure, shown)
        return self._loss.evaluate(view, target, self.settings.loss)

    def _finish_step(self, keyframe: Keyframe, twist: np.ndarray, loss: CpuLossResult, pose_rate: float) -> None:
        if pose_rate:
            optimizer, T_before = self._pose_optimizers[keyframe.index], keyframe.T_camera_world
            keyframe.T_camera_world = optimizer.step(T_before, twist, pose_rate)
            self._move_rig(keyframe, T_before)
        if keyframe.index > 0 and self._is_exposed(keyframe):
            optimizer_of_exposure = self._exposure_optimizers[keyframe.index]
            keyframe.exposure = optimizer_of_exposure.step(keyframe.exposure, loss.exposure_gradient)
        self._last_psnr = loss.psnr
        self._losses.total += loss.values.total
        self._losses.color += loss.values.color
        self._losses.ssim += loss.values.ssim
        self._losses.depth += loss.values.depth
