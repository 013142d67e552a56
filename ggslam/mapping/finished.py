# SPDX-License-Identifier: Apache-2.0
"""Training of finished maps: of a run, of a cell of a store, and at the seams of merged and updated runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ggslam.mapping.cpu.losses import CpuLossResult
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.mapper import Mapper, MapperTuning
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class FinishedMapTuning(Tuning):
    """Training of finished maps."""

    past_updates = 800
    """Optimizer steps that each Gaussian counts as having seen: means, rotations and colours move as little as at the
    end of a run."""
    rising_steps = 100
    """Steps over which rates rise from 0. Adam knows nothing of gradients' usual sizes at first, and moves every
    parameter by its whole rate: one step of a map that is the mean of many would cost up to 6 dB."""
    averaged_share = 0.5
    """Share of the steps, the last ones, that the map becomes the mean over. Without, what few steps change is noise of
    single views, up to 0.5 dB where depth is noisy."""
    measured_keyframes = 24
    """Most keyframes that are rendered to tell how good the map is."""


def load_finished(mapper: Mapper, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
    """Gives a mapper a finished map and its keyframes, numbered from 0. The map is changed by training."""
    gaussians.updates[:] = FinishedMapTuning.past_updates
    gaussians.feature_updates[:] = FinishedMapTuning.past_updates
    mapper.pixel_m = _pixel_m(keyframes)
    mapper.load_map(gaussians, keyframes)


def _pixel_m(keyframes: Sequence[Keyframe]) -> float:
    """Metres that a pixel is wide at the median depth, as the median of keyframes; 0: none has depth."""
    measured = [(k, k.depth[::4, ::4][k.depth[::4, ::4] > 0]) for k in keyframes]
    widths = [float(np.median(depth)) * k.depth_unit / k.camera.fx for k, depth in measured if len(depth)]
    return float(np.median(widths)) if widths else 0.0


def train_by_turns(
    mapper: Mapper, numbers: Sequence[int], steps: int, seed: int | Sequence[int],
    after_step: Callable[[Keyframe], None] = lambda keyframe: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:  # fmt: skip
    """Trains with rates that rise, then fall, and averages the map over the last steps. Every keyframe has its turn, in
    random order, before any has its second.

    Args:
        mapper: holds the map and the keyframes.
        numbers: of the keyframes to train on.
        steps: how many.
        seed: of the order.
        after_step: called after every step with its keyframe.
        progress: called with (steps done, steps).
    """
    t, random, turn = FinishedMapTuning, np.random.default_rng(seed), list[int]()
    averaged = int(t.averaged_share * steps)
    for step in range(steps):
        turn = turn or random.permutation(np.array(numbers)).tolist()
        keyframe = mapper.keyframes[turn.pop()]
        rising = min(1.0, (step + 1) / t.rising_steps)
        falling = mapper.settings.refine_decay ** (step / max(1, steps - 1))
        mapper.iterate(keyframe, rising * falling, settles=step >= MapperTuning.settling_from * steps)
        after_step(keyframe)
        mapper.average(steps - 1 - step, averaged)
        progress(step + 1, steps)
    mapper.end_refinement()


class StillMapper(CpuMapper):
    """Trains a finished map. Poses and exposures are fixed, and nothing is inserted.

    Args:
        gaussians: the map.
        settings: of the run that it is from.
        context: threads.
        keyframes: numbered from 0.
        valid: of each keyframe the pixels that count, bool [H, W]; None: all.
        fits_view_colors: as the attribute of `Mapper`.
    """

    def __init__(
        self, gaussians: GaussianMap, settings: MapperSettings, context: NativeContext, keyframes: list[Keyframe],
        valid: Sequence[np.ndarray | None], fits_view_colors: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(gaussians, settings, context)
        self.fits_view_colors = fits_view_colors
        load_finished(self, gaussians, keyframes)
        self._counted = valid

    def train(
        self, steps: int, seed: Sequence[int], progress: Callable[[int, int], None] = lambda done, total: None
    ) -> tuple[float, float]:
        """Steps by turns on all keyframes, see `train_by_turns`.

        Returns:
            PSNR of what counts before the first step and after the last one, mean in dB over the keyframes or some of
            them; NaN without steps.
        """
        if not steps:
            return float("nan"), float("nan")
        before = self._mean_psnr()
        train_by_turns(self, range(len(self.keyframes)), steps, seed, progress=progress)
        if self.fits_view_colors:
            self._fit_view_colors()
        return before, self._mean_psnr()

    def _mean_psnr(self) -> float:
        """Of keyframes, evenly chosen, as the map is, dB."""
        step = -(-len(self.keyframes) // FinishedMapTuning.measured_keyframes)
        return float(np.mean([self._psnr_of(keyframe) for keyframe in self.keyframes[::step]]))

    def _psnr_of(self, keyframe: Keyframe) -> float:
        """Of what counts of a keyframe, dB."""
        return self._evaluate_loss(keyframe, self._render(keyframe, features=False)).psnr

    def valid_of(self, keyframe: Keyframe) -> np.ndarray | None:
        return self._counted[keyframe.index]

    def _finish_step(self, keyframe: Keyframe, twist: np.ndarray, loss: CpuLossResult, pose_rate: float) -> None:
        exposure = keyframe.exposure
        super()._finish_step(keyframe, twist, loss, 0.0)
        keyframe.exposure = exposure
