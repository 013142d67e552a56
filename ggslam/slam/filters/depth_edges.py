# SPDX-License-Identifier: Apache-2.0
"""Depth of cameras that smooth their images is not used where it hangs between two surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ggslam.geometry.soft_edges import edge_sharpness, soft_edges
from ggslam.scene.frame import Frame
from ggslam.slam.filters.frame_filter import FrameFilter, InRigs
from ggslam.system.savable import savable

SHARP = 0.4
"""Outlines are sharp if this share of the change lies between two neighbouring pixels, in the median."""
FEWEST, FRAMES = 200, 30
"""Pixels on outlines that have to tell it, and frames among which one must have so many; else outlines are sharp."""


@savable()
@dataclass
class DepthEdges(FrameFilter):
    """Finds out in the first frames whether outlines of depth are sharp, and drops slopes where they are not.

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
            if told >= FEWEST or self.frames == FRAMES:
                self.soft = told >= FEWEST and sharpness < SHARP
        if not self.soft:
            return frame
        return replace(frame, depth=np.where(soft_edges(frame.depth, reach), np.float32(0), frame.depth))
