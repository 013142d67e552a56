# SPDX-License-Identifier: Apache-2.0
"""What the mappers of all devices do by comparing images with the map: exposures, what surfaces hide, frames between
keyframes, and colours that depend on the view.

A rendering stays where it was made; what is compared on the host is fetched from there.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch

from ggslam.mapping.between_frames import BetweenTuning, depth_factor
from ggslam.mapping.color_changes import scale_colors, take_colors
from ggslam.mapping.densification import DensificationTuning
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.keyframe_exposures import KeyframeExposures
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid, grid_of_turn
from ggslam.mapping.settings import InsertionSettings, LossSettings
from ggslam.mapping.view_colors import ShownColors, ViewColorTuning, fit_view_colors
from ggslam.native.loader import NativeContext
from ggslam.rendering.exposure import Seen, SeenAgain, change_of, exactly_without_exposure, relative_sharpness
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class HiddenGaussianTuning(Tuning):
    """Search for Gaussians behind surfaces."""

    few_keyframes = 8
    """Keyframes below which each looks with all its pixels. With more, each looks with a quarter of them by turns."""


class SoftOutlineTuning(Tuning):
    """Training by depth of a camera that smooths its outlines."""

    depth_weight_share = 0.7
    """Weight of depth in the loss, as a share of the usual one."""


class ComparingMapper(Mapper):
    """See `Mapper`. Subclasses say where a rendering is, and make `_exposures`."""

    _exposures: KeyframeExposures

    # --- where things are --------------------------------------------------------------------------------------------

    @abstractmethod
    def render_view(self, camera: Camera, T_camera_world: np.ndarray) -> RenderBuffers:
        """The map as a camera sees it from a pose [4, 4], without identities, on the host; not beside `run`."""

    @abstractmethod
    def _render_all(self, keyframe: Keyframe, grid: PixelGrid = ALL_PIXELS) -> RenderBuffers:
        """All of the map that a keyframe sees at a grid's pixels, without identities."""

    @abstractmethod
    def _fetch(self, *images: torch.Tensor) -> list[np.ndarray]:
        """Images on the host, good until the next rendering. Waits for a device."""

    @abstractmethod
    def _mark_shown(self, shown: torch.Tensor, least: float) -> None:
        """Marks, in bool [N] where the map is, the Gaussians to which the last rendering gives a weight of `least` in
        any pixel."""

    @property
    @abstractmethod
    def _context(self) -> NativeContext:
        """Threads of the CPU."""

    def _exposures_changed(self, gain: np.ndarray | None = None) -> None:  # noqa: B027
        """What `_exposures` says of some keyframes is another than before. `gain` [3]: the map became so many times as
        bright."""

    # --- exposures ---------------------------------------------------------------------------------------------------

    def _colors(self, keyframe: Keyframe, seen: Seen | None) -> np.ndarray:
        """Colours [H, W, 3] that Gaussians of a new keyframe get: as the map's exposure shows them. Of a keyframe that
        shows none, those that most of the map has."""
        exposures = self._exposures
        if exposures.lights_up(keyframe, seen):
            take_colors(self.map, keyframe)
        elif exposures.blind[keyframe.index]:
            usual = np.median(self.map.rgb.cpu().numpy(), axis=0).clip(0, 1)
            return np.broadcast_to(np.rint(255 * usual).astype(np.uint8), keyframe.color.shape).copy()
        elif seen is not None:
            colors = exposures.compensate(keyframe, seen, self.keyframes)
            self._exposures_changed()
            return colors
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
        self._exposures_changed(gain)

    def _measure_exposures(self) -> None:
        """Keyframes but those of an earlier map are compared with the map as trained by now: exposures are measured
        again, and keyframes that are much less sharp colour it no longer."""
        if not self.settings.exposure.compensate:
            return
        for keyframe in (self.keyframes[number] for number in self._trainable()):
            if keyframe.frame_index != FROM_EARLIER_RUN:
                view = self._render_all(keyframe)
                image, alpha, depth = self._fetch(view.image, view.alpha, view.expected_depth)
                self._exposures.measure_again(keyframe, SeenAgain(image, alpha, depth, keyframe.depth_m()))
        self._exposures_changed()

    def _exposure_of(self, keyframe: Keyframe) -> np.ndarray | None:
        return keyframe.exposure if self._exposures.is_exposed(keyframe) else None

    def _colors_of_map(self, keyframe: Keyframe) -> torch.Tensor:
        """A keyframe's colours [3, H, W] as the map's exposure shows them; on the host."""
        exposure = self._exposure_of(keyframe)
        colors = keyframe.color if exposure is None else exactly_without_exposure(keyframe.color, exposure)
        return torch.from_numpy(np.ascontiguousarray(colors.transpose(2, 0, 1) / np.float32(255)))

    def _comparable(self, keyframe: Keyframe) -> np.ndarray | None:
        """Where a keyframe's colours are compared with the map's, bool [H, W]; None: everywhere."""
        valid, compared = self.valid_of(keyframe), self._exposures.usable_pixels(keyframe)
        if valid is None or compared is None:
            return compared if valid is None else valid
        return valid & compared

    # --- frames between keyframes ------------------------------------------------------------------------------------

    @property
    def keeps_between(self) -> bool:
        alone = self.residency is None and self.extra_loss is None and not self.is_live
        known = not self._is_noisy and self.depth_noise_px <= BetweenTuning.most_noise
        return alone and known and not self.settings.exposure.enabled

    def _is_plain(self, keyframe: Keyframe) -> bool:
        exposures = self._exposures
        steady = not exposures.changed and not exposures.blind[keyframe.index]
        return steady and super()._is_plain(keyframe)

    def judge_between(self) -> None:
        self.unfit = set()
        for number, places in self._find_beside(self._trainable()).items():
            keyframe = self.keyframes[number]
            usual = self._compare(keyframe)[1]
            for place in places:
                gain, sharpness = self._compare(self._view_beside(self.between[place], keyframe))
                if abs(np.log(gain)) > BetweenTuning.most_gain or sharpness < BetweenTuning.least_sharpness * usual:
                    self.unfit.add(place)

    def _compare(self, keyframe: Keyframe) -> tuple[float, float]:
        """How much brighter (1: as bright) and sharper an image is than the map, where it looks at some, by a quarter
        of the pixels."""
        grid = grid_of_turn(0, keyframe.camera)
        view, valid = self._render_all(keyframe, grid), self.valid_of(keyframe)
        image, alpha, depth = self._fetch(view.image, view.alpha, view.expected_depth)
        color = grid.color_of(keyframe.color)
        shown = alpha if valid is None else np.where(grid.valid_of(valid), alpha, np.float32(0))
        seen = SeenAgain(image, shown, depth, depth)
        exposure = seen.measure(color)
        if exposure is None:
            return 1.0, 1.0
        return change_of(exposure), relative_sharpness(color, seen, exposure)

    # --- what surfaces hide ------------------------------------------------------------------------------------------

    def drop_hidden(self) -> None:
        least = self.settings.pruning.min_weight if self.settings.pruning.enabled else 0.0
        if not least or not self.keyframes or len(self._trainable()) < len(self._all_numbers):
            return
        keyframes = [self.keyframes[k] for k in self._all_numbers]
        own, newest = [k for k in keyframes if k.frame_index != FROM_EARLIER_RUN], keyframes[-1]
        untrained = {k.index for k in own if k is newest or (k.instant is not None and k.instant == newest.instant)}
        may_go = torch.zeros(len(self.keyframes) + 1, dtype=torch.bool)  # the last for what is of no keyframe, -1
        may_go[[k.index for k in own if k.index not in untrained]] = True
        stays = ~may_go.to(self.map.device)[self.map.birth_keyframe.long()]
        for keyframe in own:
            few = len(own) < HiddenGaussianTuning.few_keyframes
            self._render_all(keyframe, ALL_PIXELS if few else grid_of_turn(keyframe.index, keyframe.camera))
            self._mark_shown(stays, least)
        self._keep(stays)

    # --- terms of the loss, and insertion ----------------------------------------------------------------------------

    @property
    def _densification(self) -> str:
        """See `MapperSettings.densification`."""
        return self.settings.densification

    @property
    def _insertion_settings(self) -> InsertionSettings:
        """How Gaussians are inserted: beside soft outlines one for each pixel, as at sharp ones."""
        s = self.settings.insertion
        if self._densification == "instead":
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
        return s if factor == 1 else _with_depth_weight(s, min(factor * s.depth_weight, 1e6))

    # --- colours that depend on the view -----------------------------------------------------------------------------

    def _fit_view_colors(self) -> None:
        ridge = ViewColorTuning.noisy_ridge if self._is_noisy else ViewColorTuning.ridge
        fit_view_colors(self.map, self._shown_colors, ridge, self._context)

    def _shown_colors(self) -> Iterator[ShownColors]:
        """What the keyframes, and a frame beside each, show of the Gaussians where they have measured depth, or the map
        shows something: elsewhere places are guesses."""
        for keyframe in (self.keyframes[number] for number in self._trainable()):
            if keyframe.frame_index == FROM_EARLIER_RUN:
                continue
            yield self._show_colors(keyframe, keyframe.depth > 0)
            beside = self._beside.get(keyframe.index, [])
            if beside:
                yield self._show_colors(self._view_beside(beside[len(beside) // 2], keyframe))

    def _show_colors(self, keyframe: Keyframe, shown: np.ndarray | None = None) -> ShownColors:
        view, compared = self._render_all(keyframe), self._comparable(keyframe)
        missing = self._colors_of_map(keyframe).to(view.image.device) - view.image
        usable = view.alpha > 0.5 if shown is None else torch.from_numpy(shown).to(view.image.device)
        if compared is not None:
            usable = usable & torch.from_numpy(compared).to(view.image.device)
        counted = usable.float()
        residuals = self._rasterizer.backward(missing * counted).sh
        weights = self._rasterizer.backward(counted.expand(3, -1, -1).contiguous()).sh
        return ShownColors(keyframe.T_world_camera[:3, 3], weights.cpu(), residuals.cpu())


@lru_cache(maxsize=16)
def _with_depth_weight(settings: LossSettings, weight: float) -> LossSettings:
    """Kept: every step asks for it."""
    return replace(settings, depth_weight=weight)
