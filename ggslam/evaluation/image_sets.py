# SPDX-License-Identifier: Apache-2.0
"""Mean image scores over sets of frames (keyframes, all, held out), from a stream."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np

from ggslam.evaluation.images import ImageScores, psnr, score_image, unit_range
from ggslam.evaluation.lpips import Lpips
from ggslam.scene.frame import Frame


@dataclass(frozen=True)
class RenderedView:
    """The rendering of a frame's view.

    Attributes:
        color: [H, W, 3], see `score_image`.
        depth: [H, W] metres or None.
        color_3dgs: the colour by the rules of 3D Gaussian Splatting, [H, W, 3], or None.
        exposure: gain and offset of each channel that the frame's exposure has against the map's, [3, 2], or None.
        typical: gain of each channel that the recording's typical exposure has against the map's, [3].
    """

    color: np.ndarray
    depth: np.ndarray | None = None
    color_3dgs: np.ndarray | None = None
    exposure: np.ndarray | None = None
    typical: np.ndarray = field(default_factory=lambda: np.ones(3))

    def score(self, frame: Frame, lpips: Lpips | None = None) -> ImageScores:
        """Scores the view against the recorded frame."""
        scores = score_image(self.color, self.depth, frame.color, frame.depth, lpips)
        valid = np.isfinite(frame.depth) & (frame.depth > 0)
        if self.exposure is not None:
            gain = self.exposure[:, 0] / self.typical  # in the map's own range all errors of a dark map are small
            brought = unit_range((unit_range(frame.color) - self.exposure[:, 1]) / gain)
            shown = unit_range(unit_range(self.color) * self.typical)
            scores = replace(scores, psnr_exposed=psnr(shown, brought, valid))
        if self.color_3dgs is None:
            return scores
        return replace(scores, psnr_3dgs=psnr(unit_range(self.color_3dgs), unit_range(frame.color), valid))


Render = Callable[[Frame], "RenderedView | None"]
"""Gives what the map shows of a frame's view; None if its pose is unknown."""


@dataclass
class ImageScoreMean:
    """A running mean over views. A score that a view lacks (NaN) leaves that score's mean alone."""

    frames: int = 0
    """Views scored."""
    frames_without_pose: int = 0
    """Views that could not be rendered; they are in no mean, so look at this number beside them."""
    _sums: dict[str, float] = field(default_factory=dict)
    _counts: dict[str, int] = field(default_factory=dict)

    def add(self, scores: ImageScores | None) -> None:
        """Counts one view in; None says that it could not be rendered."""
        if scores is None:
            self.frames_without_pose += 1
            return
        self.frames += 1
        for item in fields(scores):
            value = getattr(scores, item.name)
            if not math.isnan(value):
                self._sums[item.name] = self._sums.get(item.name, 0.0) + value
                self._counts[item.name] = self._counts.get(item.name, 0) + 1

    def mean(self) -> ImageScores:
        """Mean of each score over the views that have it; PSNR is averaged in dB, as is the custom."""
        return ImageScores(**{name: total / self._counts[name] for name, total in self._sums.items()})

    def to_dict(self) -> dict[str, float | int | None]:
        """For JSON: the means and the numbers of views."""
        counts = {"frames": self.frames, "frames_without_pose": self.frames_without_pose}
        return {**self.mean().to_dict(), **counts}


def score_images(
    render: Render,
    frames: Iterable[Frame],
    sets: Mapping[str, Container[int] | None],
    lpips: Lpips | None = None,
    on_frame: Callable[[Frame, ImageScores | None], None] | None = None,
) -> dict[str, ImageScoreMean]:
    """Renders and scores the views of a recording, one at a time; no more than one frame is held here.

    Args:
        render: shows the map from a frame's (estimated) pose.
        frames: the recording; frames that belong to no set are not rendered.
        sets: name of each set -> the `Frame.index` values that belong to it, None for every frame. Sets may overlap;
            each frame is rendered once.
        lpips: the metric if it shall be scored.
        on_frame: called after each rendered frame, for progress or per-frame records.

    Returns:
        Mean scores by name of the set.
    """
    means = {name: ImageScoreMean() for name in sets}
    for frame in frames:
        names = [name for name, members in sets.items() if members is None or frame.index in members]
        if not names:
            continue
        view = render(frame)
        scores = None if view is None else view.score(frame, lpips)
        for name in names:
            means[name].add(scores)
        if on_frame is not None:
            on_frame(frame, scores)
    return means
