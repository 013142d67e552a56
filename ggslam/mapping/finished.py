# SPDX-License-Identifier: Apache-2.0
"""Training of finished maps: of a run, of a cell of a store, and at the seams of merged and updated runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ggslam.mapping.cpu.losses import CpuLossResult
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class FinishedMapTuning(Tuning):
    """Training of finished maps."""

    past_updates = 100
    """Optimizer steps that each Gaussian counts as having seen. Without them, Adam's first steps would be the
    longest."""


def load_finished(mapper: Mapper, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
    """Gives a mapper a finished map and its keyframes, numbered from 0. The map is changed by training."""
    gaussians.updates[:] = FinishedMapTuning.past_updates
    gaussians.feature_updates[:] = FinishedMapTuning.past_updates
    mapper.load_map(gaussians, keyframes)


def train_by_turns(
    mapper: Mapper, numbers: Sequence[int], steps: int, seed: int | Sequence[int],
    after_step: Callable[[Keyframe], None] = lambda keyframe: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:  # fmt: skip
    """Trains with falling rates. Every keyframe has its turn, in random order, before any has its second.

    Args:
        mapper: holds the map and the keyframes.
        numbers: of the keyframes to train on.
        steps: how many.
        seed: of the order.
        after_step: called after every step with its keyframe.
        progress: called with (steps done, steps).
    """
    random, turn = np.random.default_rng(seed), list[int]()
    for step in range(steps):
        turn = turn or random.permutation(np.array(numbers)).tolist()
        keyframe = mapper.keyframes[turn.pop()]
        mapper.iterate(keyframe, mapper.settings.refine_decay ** (step / max(1, steps - 1)))
        after_step(keyframe)
        progress(step + 1, steps)


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
        """Steps by turns on all keyframes, with falling rates; see `train_by_turns`.

        Returns:
            PSNR of what counts, before the first step on each keyframe and before the last one, mean in dB over those
            that were trained on more than once; NaN if none was.
        """
        found: dict[int, list[float]] = {}

        def note(keyframe: Keyframe) -> None:
            found.setdefault(keyframe.index, []).append(self.last_psnr)

        train_by_turns(self, range(len(self.keyframes)), steps, seed, note, progress)
        if self.fits_view_colors and steps:
            self._fit_view_colors()
        ends = [(values[0], values[-1]) for values in found.values() if len(values) > 1]
        before, after = np.mean(ends, axis=0) if ends else (np.nan, np.nan)
        return float(before), float(after)

    def valid_of(self, keyframe: Keyframe) -> np.ndarray | None:
        return self._counted[keyframe.index]

    def _finish_step(self, keyframe: Keyframe, twist: np.ndarray, loss: CpuLossResult, pose_rate: float) -> None:
        exposure = keyframe.exposure
        super()._finish_step(keyframe, twist, loss, 0.0)
        keyframe.exposure = exposure
