# SPDX-License-Identifier: Apache-2.0
"""Removes depth between two surfaces, which cameras that smooth their depth images produce."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ggslam.geometry.soft_edges import edge_sharpness, soft_edges
from ggslam.scene.frame import Frame
from ggslam.slam.filters.frame_filter import FrameFilter, InRigs
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class DepthEdgeTuning(Tuning):
    """When a depth camera counts as smoothing its outlines."""

    min_sharpness = 0.4
    """Smallest median share of a depth step that lies between two neighbouring pixels where outlines are sharp."""
    min_pixels = 200
    """Fewest pixels on outlines that a decision is made from."""
    max_frames = 30
    """Frames after which outlines count as sharp if none had enough pixels."""


@savable()
@dataclass
class DepthEdges(FrameFilter):
    """Decides on the first frames whether outlines of depth are sharp. If they are not, slopes are removed.

    Attributes:
        soft: whether they are slopes; None: not known yet.
        frames: looked at so far.
    """

    order = 10
    in_rigs = InRigs.PER_CAMERA

    soft: bool | None = None
    frames: int = 0

    def clean(self, frame: Frame) -> Frame:
        """The frame without depth that hangs between two surfaces: itself if the camera has sharp outlines."""
        reach = max(2, round(frame.depth.shape[1] / 80))
        if self.soft is None:
            self.frames += 1
            sharpness, told = edge_sharpness(frame.depth, reach)
            if told >= DepthEdgeTuning.min_pixels or self.frames == DepthEdgeTuning.max_frames:
                self.soft = told >= DepthEdgeTuning.min_pixels and sharpness < DepthEdgeTuning.min_sharpness
        if not self.soft:
            return frame
        return replace(frame, depth=np.where(soft_edges(frame.depth, reach), np.float32(0), frame.depth))
