# SPDX-License-Identifier: Apache-2.0
"""The mapper on the CPU: the compiled core renders, differentiates and steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from ggslam.mapping.cpu.exposure import ExposureAdam
from ggslam.mapping.cpu.identity import IdentityLearner
from ggslam.mapping.cpu.insertion import fill_gaussians, new_gaussians, unexplained
from ggslam.mapping.cpu.losses import ImageLoss, KeyframeImages
from ggslam.mapping.cpu.votes import vote_labels
from ggslam.mapping.keyframe import DEPTH_UNITS_PER_METRE, Keyframe, PoseAdam, make_keyframe
from ggslam.mapping.labelling import Labeller, MapLabels
from ggslam.mapping.mapper import LossSums, Mapper
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap


class CpuMapper(Mapper):
    """See `Mapper`. With the same seed, frames and iteration counts a run on one machine repeats bit for bit, for any
    number of threads.

    Args:
        context: threads and instruction set.
        Others: as in `Mapper`.
    """

    identity: IdentityLearner | None

    def __init__(
        self,
        gaussians: GaussianMap,
        settings: MapperSettings,
        context: NativeContext,
        seed: int = 0,
        identity: IdentityLearner | None = None,
    ) -> None:
        super().__init__(gaussians, settings, seed, identity)
        self._losses = LossSums()
        self._last_psnr = float("nan")
        self._rasterizer = CpuRasterizer(context=context)
        self._loss = ImageLoss(context)
        self._pose_optimizers: list[PoseAdam] = []
        self._exposure_optimizers: list[ExposureAdam] = []

    @property
    def losses(self) -> LossSums:
        return self._losses

    @property
    def last_psnr(self) -> float:
        return self._last_psnr

    def vote_labels(self) -> np.ndarray:
        return vote_labels(self.map)

    def adopt(self, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
        super().adopt(gaussians, keyframes)
        self._pose_optimizers = [PoseAdam() for _ in keyframes]
        self._exposure_optimizers = [ExposureAdam(self.settings.exposure) for _ in keyframes]

    def _new_keyframe(self, frame: Frame, T_world_camera: np.ndarray) -> Keyframe:
        self._pose_optimizers.append(PoseAdam())
        self._exposure_optimizers.append(ExposureAdam(self.settings.exposure))
        return make_keyframe(len(self.keyframes), frame, T_world_camera)

    def _insert(self, keyframe: Keyframe, T_world_camera: np.ndarray, labeller: Labeller | None) -> None:
        depth, s = keyframe.depth_m(), self.settings.insertion
        where, alpha = np.ones(depth.shape, bool), np.zeros(depth.shape, np.float32)
        show: Callable[[], MapLabels] | None = None
        if self.map.count:
            view = self._rasterizer.forward(self.map, keyframe.camera, keyframe.T_camera_world, features=False)
            alpha, rendered = view.alpha.numpy(), view.expected_depth.numpy()
            where = unexplained(depth, alpha, rendered, s)
            show = partial(self._show_labels, alpha, rendered)
        if self.identity is not None and labeller is not None:
            self._take_labels(keyframe, labeller(keyframe, show))
        parts = [new_gaussians(keyframe.color, depth, keyframe.camera, T_world_camera, where, s)]
        if s.fill_stride:
            parts.append(fill_gaussians(keyframe.color, depth, alpha, keyframe.camera, T_world_camera, s))
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

    def _split(self, mask: np.ndarray, whole: int, part: int) -> None:
        assert self.identity is not None
        self.identity.split(self.map, self._rasterizer, mask, whole, part)

    def _show_labels(self, alpha: np.ndarray, depth: np.ndarray, stride: int = 2) -> MapLabels:
        """What the last rendering shows of the objects, looked at on every `stride`-th pixel and row."""
        height, width = alpha.shape
        grid = np.arange(height * width, dtype=np.int32).reshape(height, width)[::stride, ::stride]
        terms = self._rasterizer.pixel_terms(grid.reshape(-1))
        ids, share = terms.labels(self.vote_labels())
        ids, share = ids.reshape(grid.shape), share.reshape(grid.shape) * (alpha[::stride, ::stride] > 0.5)
        return MapLabels.from_grid(ids, share, depth, stride)

    def iterate(self, keyframe: Keyframe, rate_factor: float = 1.0) -> None:
        s, t0 = self.settings, time.perf_counter()
        learn = self.identity is not None and self.identity.due(keyframe)
        dense = learn and self.identity is not None and self.identity.settings.schedule == "dense"
        view = self._rasterizer.forward(self.map, keyframe.camera, keyframe.T_camera_world, features=dense)
        t1 = time.perf_counter()
        exposure = keyframe.exposure if s.exposure.enabled else None
        target = KeyframeImages(keyframe.color, keyframe.depth, 1 / DEPTH_UNITS_PER_METRE, exposure)
        loss = self._loss.evaluate(view, target, s.loss)
        t2 = time.perf_counter()
        grad_features = None
        if learn and self.identity is not None:
            grad_features = self.identity.step(self.map, self._rasterizer, keyframe, view)
        t3 = time.perf_counter()
        optimizer = self._standard_adam if rate_factor == 1 else self._adam(rate_factor)
        step = self._rasterizer.backward_step(
            self.map, loss.d_image, loss.d_depth, loss.d_alpha, grad_features, optimizer=optimizer,
            detach_features=self.identity is None or self.identity.settings.detach,
        )  # fmt: skip
        self._refine_keyframe(keyframe, step.twist, loss.exposure_gradient, rate_factor)
        t4 = time.perf_counter()
        self.times.forward += t1 - t0
        self.times.loss += t2 - t1
        self.times.identity += t3 - t2
        self.times.backward += t4 - t3
        self.times.iterations += 1
        keyframe.iterations += 1
        self._last_psnr = loss.psnr
        self._losses.total += loss.values.total
        self._losses.color += loss.values.color
        self._losses.ssim += loss.values.ssim
        self._losses.depth += loss.values.depth

    def _train_identity(self, keyframe: Keyframe, steps: int, rate_factor: float) -> None:
        if self.identity is None:
            return
        view = self._rasterizer.forward(self.map, keyframe.camera, keyframe.T_camera_world, features=False)
        for _ in range(steps):
            self.identity.step(self.map, self._rasterizer, keyframe, view, rate_factor)

    def _refine_keyframe(
        self, keyframe: Keyframe, twist: np.ndarray, exposure_gradient: np.ndarray, rate_factor: float
    ) -> None:
        """Pose and exposure of a keyframe follow their gradients. The first keyframe stays: it is the world."""
        s = self.settings
        if keyframe.index == 0:
            return
        if s.pose_refinement.enabled:
            rate = min(s.pose_refinement.rate_sigmas * self.depth_sigma, s.pose_refinement.max_rate)
            optimizer = self._pose_optimizers[keyframe.index]
            keyframe.T_camera_world = optimizer.step(keyframe.T_camera_world, twist, rate_factor * rate)
        if s.exposure.enabled:
            keyframe.exposure = self._exposure_optimizers[keyframe.index].step(keyframe.exposure, exposure_gradient)
