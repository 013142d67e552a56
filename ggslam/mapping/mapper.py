# SPDX-License-Identifier: Apache-2.0
"""The mapper: inserts Gaussians for new keyframes and optimises the map against the keyframes' images."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from ggslam.mapping.deformation import move_with_keyframes
from ggslam.mapping.duplicates import remove_duplicates
from ggslam.mapping.exposure import ExposureAdam
from ggslam.mapping.identity import IdentityLearner
from ggslam.mapping.insertion import fill_gaussians, new_gaussians, unexplained
from ggslam.mapping.keyframe import DEPTH_UNITS_PER_METRE, Keyframe, PoseAdam, make_keyframe
from ggslam.mapping.labelling import KeyframeLabels, Labeller, MapLabels
from ggslam.mapping.losses import ImageLoss, KeyframeImages
from ggslam.mapping.pruning import prune
from ggslam.mapping.residency import Residency
from ggslam.mapping.sampling import KeyframeSampler
from ggslam.mapping.settings import MapperSettings
from ggslam.mapping.votes import vote_labels
from ggslam.native.loader import NativeContext
from ggslam.rendering.adam import ADAM_GROUPS, AdamSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse

FINAL_DECAY = 0.2
"""The last identity steps fall to this share of their length."""
FINAL_STEPS_A_VIEW = 4
"""Of the last identity steps so many follow each other on one rendering, which takes as long as a step."""


@dataclass
class MapperTimes:
    """Seconds spent so far in each part, and how often."""

    insertion: float = 0.0
    forward: float = 0.0
    loss: float = 0.0
    backward: float = 0.0
    identity: float = 0.0
    identity_finish: float = 0.0
    iterations: int = 0
    keyframes: int = 0

    @property
    def iteration_ms(self) -> float:
        """Mean milliseconds of one optimisation step."""
        return 1e3 * (self.forward + self.loss + self.backward + self.identity) / max(1, self.iterations)


@dataclass
class LossSums:
    """Sums over all iterations so far of the terms of the loss, see `LossValues`: the loss itself, colour (L1), SSIM
    and depth (metres)."""

    total: float = 0.0
    color: float = 0.0
    ssim: float = 0.0
    depth: float = 0.0


class Mapper:
    """Holds the map and its keyframes.

    Args:
        gaussians: the map; empty or loaded.
        settings: see `MapperSettings`.
        context: threads and instruction set.
        seed: of the draw of keyframes. With the same seed, frames and iteration counts a run on one machine repeats
            bit for bit, for any number of threads.
        identity: learns objects from the keyframes' masks; None: nobody does. The map needs feature channels for it.
    """

    def __init__(
        self,
        gaussians: GaussianMap,
        settings: MapperSettings,
        context: NativeContext,
        seed: int = 0,
        identity: IdentityLearner | None = None,
    ) -> None:
        self.map = gaussians
        self.settings = settings
        self.identity = identity
        self.keyframes: list[Keyframe] = []
        self.times = MapperTimes()
        self.losses = LossSums()
        self.last_psnr = float("nan")
        self.depth_sigma = 0.004
        """Standard deviation of the depth camera at the scene's median depth, metres; set it when it is known."""
        self.residency: Residency | None = None
        """Who keeps a part of the map on disk; None: all of it is in memory."""
        self._rasterizer = CpuRasterizer(context=context)
        self._loss = ImageLoss(context)
        self._standard_adam = self._adam(1.0)
        self._sampler = KeyframeSampler(float(np.random.default_rng(seed).random()))
        self._pose_optimizers: list[PoseAdam] = []
        self._exposure_optimizers: list[ExposureAdam] = []

    # --- growth ------------------------------------------------------------------------------------------------------

    def add_keyframe(
        self, frame: Frame, T_world_camera: np.ndarray, labeller: Labeller | None = None
    ) -> Keyframe:
        """Makes a keyframe of `frame` seen from `T_world_camera` [4, 4] and inserts what the map lacks there.

        Args:
            labeller: tells the keyframe's object mask, if objects are learned.
        """
        start = time.perf_counter()
        keyframe = make_keyframe(len(self.keyframes), frame, T_world_camera)
        self._insert(keyframe, T_world_camera, labeller)
        self.keyframes.append(keyframe)
        self._pose_optimizers.append(PoseAdam())
        self._exposure_optimizers.append(ExposureAdam(self.settings.exposure))
        if len(self.keyframes) % self.settings.pruning.every_keyframes == 0:
            prune(self.map, self.settings.pruning)
        self.times.insertion += time.perf_counter() - start
        self.times.keyframes += 1
        return keyframe

    def adopt(self, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
        """Goes on with a map made before. Keyframes without images keep their Gaussians but are never trained on."""
        self.map, self.keyframes = gaussians, keyframes
        self._pose_optimizers = [PoseAdam() for _ in keyframes]
        self._exposure_optimizers = [ExposureAdam(self.settings.exposure) for _ in keyframes]

    def move_keyframes(self, T_new_old: np.ndarray) -> None:
        """Moves keyframes, and with each the Gaussians that it inserted.

        Args:
            T_new_old: [K, 4, 4], for each keyframe what moves the world about it.
        """
        for keyframe, T in zip(self.keyframes, T_new_old, strict=True):
            keyframe.T_camera_world = inverse(T @ keyframe.T_world_camera)
        move_with_keyframes(self.map, T_new_old)

    def mend(self, kept: list[int], doubted: list[int], iterations: int) -> None:
        """After the keyframes were moved so that two ends of a loop meet: drops what the newer end had mapped again,
        and trains both ends.

        Args:
            kept: numbers of the keyframes at the older end.
            doubted: of those that may have mapped the same again.
            iterations: optimisation steps, on keyframes of either end by turns.
        """
        remove_duplicates(self.map, np.array(kept, int), np.array(doubted, int), 2 * self.depth_sigma)
        there = set(self._trainable())
        pairs = zip(reversed(doubted), reversed(kept), strict=False)
        ends = [self.keyframes[n] for pair in pairs for n in pair if n in there]
        for i in range(iterations if ends else 0):
            self.iterate(ends[i % len(ends)])

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
            self._take_labels(self.identity, keyframe, labeller(keyframe, show))
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

    def _take_labels(self, identity: IdentityLearner, keyframe: Keyframe, labels: KeyframeLabels) -> None:
        """The rasterizer's last rendering is the map as the keyframe sees it (if there was a map)."""
        keyframe.mask = labels.mask
        if labels.mask is None:
            return
        for kept, dropped in labels.merges:
            identity.merge(self.map, kept, dropped)
        identity.observe(labels.mask)
        for whole, part in labels.splits:
            identity.split(self.map, self._rasterizer, labels.mask, whole, part)

    def _show_labels(self, alpha: np.ndarray, depth: np.ndarray, stride: int = 2) -> MapLabels:
        """What the last rendering shows of the objects, looked at on every `stride`-th pixel and row."""
        height, width = alpha.shape
        grid = np.arange(height * width, dtype=np.int32).reshape(height, width)[::stride, ::stride]
        terms = self._rasterizer.pixel_terms(grid.reshape(-1))
        ids, share = terms.labels(vote_labels(self.map))
        ids, share = ids.reshape(grid.shape), share.reshape(grid.shape) * (alpha[::stride, ::stride] > 0.5)

        def enlarged(image: np.ndarray) -> np.ndarray:
            return image.repeat(stride, 0).repeat(stride, 1)[:height, :width]

        return MapLabels(enlarged(np.where(share > 0, ids, 0).astype(np.uint16)), enlarged(share), depth)

    # --- optimisation ------------------------------------------------------------------------------------------------

    def run(self, iterations: int) -> None:
        """Optimisation steps, see `KeyframeSampler` for their order."""
        numbers = self._trainable()
        for _ in range(iterations):
            self.iterate(self._drawn(numbers))

    def _trainable(self) -> Sequence[int]:
        return range(len(self.keyframes)) if self.residency is None else self.residency.trainable()

    def _drawn(self, numbers: Sequence[int]) -> Keyframe:
        return self.keyframes[numbers[self._sampler.draw(len(numbers))]]

    def _stages(self, steps: int) -> Iterator[tuple[Sequence[int], int]]:
        """Keyframes to train together, and how many of `steps` are theirs: as many as their share of all keyframes."""
        if self.residency is None:
            yield range(len(self.keyframes)), steps
            return
        done = 0
        for numbers in self.residency.stages():
            before, done = done, done + len(numbers)
            yield numbers, steps * done // len(self.keyframes) - steps * before // len(self.keyframes)

    def iterate(self, keyframe: Keyframe, rate_factor: float = 1.0) -> None:
        """One optimisation step on one keyframe: forward, loss, backward with the optimizer fused in.

        Args:
            keyframe: what to train on.
            rate_factor: multiplies every learning rate.
        """
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
        self.last_psnr = loss.psnr
        self.losses.total += loss.values.total
        self.losses.color += loss.values.color
        self.losses.ssim += loss.values.ssim
        self.losses.depth += loss.values.depth

    def refine(self, iterations: int, progress: Callable[[int, int], None] | None = None) -> None:
        """Final refinement: learning rates fall exponentially, for each part of a map that is in memory by turns."""
        done = 0
        for numbers, steps in self._stages(iterations):
            for i in range(steps):
                factor = self.settings.refine_decay ** (i / max(1, steps - 1))
                self.iterate(self._drawn(numbers), factor)
                done += 1
                if progress is not None and (done % 20 == 0 or done == iterations):
                    progress(done, iterations)

    def finish_identity(self) -> None:
        """The last identity steps, see `IdentitySettings.final_passes`, and every Gaussian's object. Colours, shapes
        and poses stay as they are."""
        if self.identity is None:
            return
        start, settings = time.perf_counter(), self.identity.settings
        total = settings.final_passes * len(self.keyframes) if settings.schedule == "sampled" else 0
        for numbers, steps in self._stages(total) if total else ():
            for i in range(0, steps, FINAL_STEPS_A_VIEW):
                keyframe = self._drawn(numbers)
                if keyframe.mask is None:
                    continue
                view = self._rasterizer.forward(self.map, keyframe.camera, keyframe.T_camera_world, features=False)
                for _ in range(FINAL_STEPS_A_VIEW):
                    self.identity.step(self.map, self._rasterizer, keyframe, view, FINAL_DECAY ** (i / steps))
        self.identity.label(self.map)
        self.times.identity_finish += time.perf_counter() - start

    def _adam(self, rate_factor: float) -> AdamSettings:
        r = self.settings.rates
        young = r.young_factor
        decay = (1 / young) ** (1 / max(1, r.young_updates)) if young > 1 else 1.0
        rates = {name: young * rate_factor * getattr(r, name) for name in ADAM_GROUPS}
        if self.identity is not None:
            rates["features"] = self.identity.settings.rate
        return AdamSettings(
            learning_rates=rates, beta1=r.beta1, beta2=r.beta2, epsilon=r.epsilon, decay=decay, decay_floor=1 / young,
            decayed_groups=tuple(name for name in ADAM_GROUPS if name != "features"),
        )  # fmt: skip

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
