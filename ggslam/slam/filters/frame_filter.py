# SPDX-License-Identifier: Apache-2.0
"""The interface of filters of frames."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.slam.config import Config
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult

if TYPE_CHECKING:
    from ggslam.slam.map_removal import MapRemoval


@dataclass(frozen=True)
class FilterContext:
    """What filters are constructed with.

    Attributes:
        config: all settings of the run.
        context: threads of the compiled core.
    """

    config: Config
    context: NativeContext


class InRigs(Enum):
    """How a rig of cameras uses a filter."""

    PER_CAMERA = "one for each camera"
    SHARED = "one for all cameras"
    LEFT_OUT = "left out"


class FrameFilter:
    """Inspects every frame of one camera and corrects it. By default, each hook does nothing.

    The hooks are called in this order. For every frame: `clean`, `expect`, `judge`. For every keyframe, in the
    mapper's thread: `before_insertion`, `after_insertion`. When a loop was closed: `loop_closed` in the mapper's
    thread, and `move` before the next frame is located.

    All attributes are part of the run's saved state, see `system.object_tree`.
    """

    order: ClassVar[int]
    """Filters with smaller numbers come first."""
    in_rigs: ClassVar[InRigs] = InRigs.LEFT_OUT
    """What a rig of cameras does with it."""

    @classmethod
    def make(cls, made_of: FilterContext) -> FrameFilter:
        """A fresh one."""
        return cls()

    def use_context(self, context: NativeContext) -> None:
        """The frames are located in another thread than the map is trained in; this is the context for it."""

    def clean(self, frame: Frame) -> Frame:
        """The frame as the run uses it; before it is located."""
        return frame

    def expect(self, frame: Frame) -> Frame:
        """The frame that the tracker aligns: it may have less depth than the frame that the run uses."""
        return frame

    def judge(
        self, frame: Frame, result: TrackingResult, noise: DepthNoise | None
    ) -> tuple[Frame, TrackingResult]:  # fmt: skip
        """The frame and the result, corrected by what the frame's pose tells.

        Args:
            frame: as `clean` gave it.
            result: where it is; lost frames come here, too.
            noise: of the depth camera, as far as it is known.
        """
        return frame, result

    def expects_motion(self) -> bool:
        """Whether something in the frame located last moves, or may move."""
        return False

    def before_insertion(self, removal: MapRemoval, newest: Frame, tracking: TrackingResult) -> None:
        """Removes from the map what the frame, about to become a keyframe, shows to be wrong."""

    def after_insertion(self, removal: MapRemoval, newest: Frame) -> None:
        """Removes from the map what the newest keyframe, made of this frame, shows to be wrong."""

    def loop_closed(self) -> None:
        """A loop was closed: keyframes moved against one another."""

    def move(self, T_new_old: np.ndarray) -> None:
        """The world about the camera was moved by a correction [4, 4]."""

    def notes(self, frames: int) -> list[str]:
        """What the user should know at the end of a run of so many frames."""
        return []
