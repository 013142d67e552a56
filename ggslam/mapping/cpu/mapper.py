# SPDX-License-Identifier: Apache-2.0
"""The mapper on the CPU: the compiled core renders, differentiates and steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.mapping.between_frames import BetweenTuning, depth_factor
from ggslam.mapping.color_changes import scale_colors, take_colors
from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.insertion import fill_gaussians, find_unexplained, new_gaussians
from ggslam.mapping.cpu.keyframe_exposures import KeyframeExposures
from ggslam.mapping.cpu.losses import CpuImageLoss, CpuLossResult
from ggslam.mapping.cpu.view_colors import ShownColors, ViewColorTuning, fit_view_colors
from ggslam.mapping.densification import DensificationTuning, ScreenGradients, densify, sparse_pixels
from ggslam.mapping.identity import IdentityTuning
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe, PoseAdam, make_keyframe
from ggslam.mapping.labelling import Labeller, MapLabels
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.mapper import LossSums, Mapper
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid, grid_of_turn
from ggslam.mapping.settings import InsertionSettings, LossSettings, MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.exposure import SeenAgain, change_of, exactly_without_exposure, relative_sharpness
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.array_forms import check_indices
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class HiddenGaussianTuning(Tuning):
    """Search for Gaussians behind surfaces."""

    few_keyframes = 8
    """Keyframes below which each looks with all its pixels. With more, each looks with a quarter of them by turns."""


class SoftOutlineTuning(Tuning):
    """Training by depth of a camera that smooths its outlines."""

    depth_weight_share = 0.7
    """Weight of depth in the loss, as a share of the usual one."""


@savable(
    not_saved="settings residency extra_loss fits_view_colors _beside _rasterizer _loss _adam_of_pixel",
    growing="between", check="check",
)  # fmt: skip
class CpuMapper(Mapper):
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

    @property
    def keeps_between(self) -> bool:
        alone = self.residency is None and self.extra_loss is None and not self.is_live
        known = not self._is_noisy and self.depth_noise_px <= BetweenTuning.most_noise
        return alone and known and not self.settings.exposure.enabled

    def _is_plain(self, keyframe: Keyframe) -> bool:
        exposures = self._exposures
        steady = not exposures.changed and not exposures.blind[keyframe.index]
        return steady and super()._is_plain(keyframe)

    def render_view(self, camera: Camera, T_camera_world: np.ndarray) -> RenderBuffers:
        """The map as a camera sees it from a pose [4, 4], without identities; not beside `run`."""
        return self._rasterizer.forward(self.map, camera, T_camera_world, features=False)

    def _new_keyframe(self, frame: Frame, T_world_camera: np.ndarray) -> Keyframe:
        self._pose_optimizers.append(PoseAdam())
        self._exposures.add()
        return make_keyframe(len(self.keyframes), frame, T_world_camera)

    def _insert(
        self, keyframe: Keyframe, T_world_camera: np.ndarray, labeller: Labeller | None,
        begin_others: Callable[[], None],
    ) -> None:  # fmt: skip
        depth, s = keyframe.depth_m(), self._insertion
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

    def _colors(self, keyframe: Keyframe, seen: SeenAgain | None) -> np.ndarray:
        """Colours [H, W, 3] that Gaussians of a new keyframe get: as the map's exposure shows them. Of a keyframe that
        shows none, those that most of the map has."""
        exposures = self._exposures
        if exposures.lights_up(keyframe, seen):
            take_colors(self.map, keyframe)
        elif exposures.blind[keyframe.index]:
            usual = np.median(self.map.rgb.numpy(), axis=0).clip(0, 1)
            return np.broadcast_to(np.rint(255 * usual).astype(np.uint8), keyframe.color.shape).copy()
        elif seen is not None:
            return exposures.compensate(keyframe, seen, self.keyframes)
        return keyframe.color

    def use_typical_exposure(self, at_end: bool = False) -> None:
        if at_end:
            self._measure_exposures()
        gain = self._exposures.typical(self.keyframes)
        if gain is None or (not at_end and np.abs(np.log(gain)).max() < self.settings.exposure.typical):
            return
        scale_colors(self.map, gain)
        if self.residency is not None:
            self.residency.scale_colors(gain)
        self._exposures.follow(gain, self.keyframes)

    def _measure_exposures(self) -> None:
        """Keyframes but those of an earlier map are compared with the map as trained by now: exposures are measured
        again, and keyframes that are much less sharp colour it no longer."""
        if not self.settings.exposure.compensate:
            return
        for keyframe in (self.keyframes[number] for number in self._trainable()):
            if keyframe.frame_index != FROM_EARLIER_RUN:
                view = self._render(keyframe, features=False)
                self._exposures.measure_again(keyframe, self._look(keyframe, view))

    @staticmethod
    def _look(keyframe: Keyframe, view: RenderBuffers) -> SeenAgain:
        """What a view of the map shows where a keyframe looks; good until the next rendering."""
        return SeenAgain(view.image.numpy(), view.alpha.numpy(), view.expected_depth.numpy(), keyframe.depth_m())

    def judge_between(self) -> None:
        self.unfit = set()
        for number, places in self._find_beside(self._trainable()).items():
            keyframe = self.keyframes[number]
            usual = self._compare(keyframe)[1]
            for place in places:
                gain, sharpness = self._compare(self.between[place].view(keyframe))
                if abs(np.log(gain)) > BetweenTuning.most_gain or sharpness < BetweenTuning.least_sharpness * usual:
                    self.unfit.add(place)

    def _compare(self, keyframe: Keyframe) -> tuple[float, float]:
        """How much brighter (1: as bright) and sharper an image is than the map, where it looks at some, by a quarter
        of the pixels."""
        grid = grid_of_turn(0, keyframe.camera)
        view, valid = self._render(keyframe, features=False, grid=grid), self.valid_of(keyframe)
        alpha, depth, color = view.alpha.numpy(), view.expected_depth.numpy(), grid.color_of(keyframe.color)
        shown = alpha if valid is None else np.where(grid.valid_of(valid), alpha, np.float32(0))
        seen = SeenAgain(view.image.numpy(), shown, depth, depth)
        exposure = seen.measure(color)
        if exposure is None:
            return 1.0, 1.0
        return change_of(exposure), relative_sharpness(color, seen, exposure)

    def _show_labels(self, alpha: np.ndarray, depth: np.ndarray, stride: int = 2) -> MapLabels:
        """What the last rendering shows of the objects, looked at on every `stride`-th pixel and row."""
        height, width = alpha.shape
        grid = np.arange(height * width, dtype=np.int32).reshape(height, width)[::stride, ::stride]
        terms = self._rasterizer.pixel_terms(grid.reshape(-1), IdentityTuning.max_terms, IdentityTuning.min_weight)
        ids, share = terms.labels(self.vote_labels())
        ids, share = ids.reshape(grid.shape), share.reshape(grid.shape) * (alpha[::stride, ::stride] > 0.5)
        return MapLabels.from_grid(ids, share, depth, stride)

    def drop_hidden(self) -> None:
        least = self.settings.pruning.min_weight if self.settings.pruning.enabled else 0.0
        if not least or not self.keyframes or len(self._trainable()) < len(self._all_numbers):
            return
        keyframes = [self.keyframes[k] for k in self._all_numbers]
        own, newest = [k for k in keyframes if k.frame_index != FROM_EARLIER_RUN], keyframes[-1]
        untrained = {k.index for k in own if k is newest or (k.instant is not None and k.instant == newest.instant)}
        born = self.map.birth_keyframe.numpy()
        stays = ~np.isin(born, [k.index for k in own if k.index not in untrained])
        for keyframe in own:
            grid = (
                ALL_PIXELS
                if len(own) < HiddenGaussianTuning.few_keyframes
                else grid_of_turn(keyframe.index, keyframe.camera)
            )
            self._render(keyframe, features=False, grid=grid)
            self._rasterizer.mark_shown(stays, least)
        self.map.keep(torch.from_numpy(stays))

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

    @property
    def _insertion(self) -> InsertionSettings:
        """How Gaussians are inserted: beside soft outlines one for each pixel, as at sharp ones."""
        s = self.settings.insertion
        if self.settings.densification == "instead":
            width = s.scale_pixels * DensificationTuning.sparse_stride
            s = replace(s, scale_pixels=min(width, 100.0), adaptive_stride=False)
        return replace(s, fill_stride=min(s.fill_stride, 1)) if self.has_soft_outlines else s

    def _loss_settings(self, keyframe: Keyframe) -> LossSettings:
        """Terms of the loss: what smooths outlines smooths creases and relief, too, and says less of depth; beside
        frames without depth a keyframe's own says more."""
        s, factor = self.settings.loss, 1.0
        if self.has_soft_outlines:
            factor *= SoftOutlineTuning.depth_weight_share
        if keyframe.index in self._beside:
            factor *= depth_factor(keyframe.camera)
        return s if factor == 1 else replace(s, depth_weight=min(factor * s.depth_weight, 1e6))

    def _comparable(self, keyframe: Keyframe) -> np.ndarray | None:
        """Where a keyframe's colours are compared with the map's, bool [H, W]; None: everywhere."""
        valid, compared = self.valid_of(keyframe), self._exposures.usable_pixels(keyframe)
        if valid is None or compared is None:
            return compared if valid is None else valid
        return valid & compared

    def _exposure_of(self, keyframe: Keyframe) -> np.ndarray | None:
        return keyframe.exposure if self._exposures.is_exposed(keyframe) else None

    def _fit_view_colors(self) -> None:
        ridge = ViewColorTuning.noisy_ridge if self._is_noisy else ViewColorTuning.ridge
        fit_view_colors(self.map, self._shown_colors, ridge, self._rasterizer.context)

    def _shown_colors(self) -> Iterator[ShownColors]:
        """What the keyframes, and a frame beside each, show of the Gaussians where they have measured depth, or the map
        shows something: elsewhere places are guesses."""
        for keyframe in (self.keyframes[number] for number in self._trainable()):
            if keyframe.frame_index == FROM_EARLIER_RUN:
                continue
            yield self._show_colors(keyframe, keyframe.depth > 0)
            beside = self._beside.get(keyframe.index, [])
            if beside:
                yield self._show_colors(beside[len(beside) // 2].view(keyframe))

    def _show_colors(self, keyframe: Keyframe, shown: np.ndarray | None = None) -> ShownColors:
        view = self._render(keyframe, features=False)
        missing = self._colors_of_map(keyframe) - view.image
        shown = view.alpha.numpy() > 0.5 if shown is None else shown
        compared = self._comparable(keyframe)
        usable = torch.from_numpy(shown if compared is None else shown & compared).float()
        residuals = self._rasterizer.backward(missing * usable).sh
        weights = self._rasterizer.backward(usable.expand(3, -1, -1).contiguous()).sh
        return ShownColors(keyframe.T_world_camera[:3, 3], weights, residuals)

    def _colors_of_map(self, keyframe: Keyframe) -> torch.Tensor:
        """A keyframe's colours [3, H, W] as the map's exposure shows them."""
        exposure = self._exposure_of(keyframe)
        colors = keyframe.color if exposure is None else exactly_without_exposure(keyframe.color, exposure)
        return torch.from_numpy(np.ascontiguousarray(colors.transpose(2, 0, 1) / np.float32(255)))

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
