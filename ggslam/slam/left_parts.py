# SPDX-License-Identifier: Apache-2.0
"""The last known pose of the camera in each part of the map that it left.

What made the camera lose its way may have been a thing that covered the view for a while, and that a part began with.
Once it is gone, the camera is where it was lost, or near.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.slam.loop_closing import LoopCloser
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.motion import CameraMotion
from ggslam.tracking.tracker import Tracker, TrackingResult, TrackingStatus


class LeftPartTuning(Tuning):
    """Memory of the parts of the map that the camera left."""

    max_parts = 3
    """Most parts that are searched for the camera, the last ones left."""


@savable(not_saved="target")
@dataclass
class LeftPart:
    """A part that the camera left.

    Attributes:
        keyframe: number of the keyframe that poses hung on then.
        T_world_keyframe: its pose [4, 4], by which `motion` is.
        motion: of the camera when it was lost.
        target: what is seen from about there; None: not gathered yet.
    """

    keyframe: int
    T_world_keyframe: Pose
    motion: CameraMotion
    target: GicpTarget | None = None

    def follow(self, T_world_keyframe: np.ndarray) -> None:
        """The keyframe is at another pose [4, 4] now."""
        if not np.array_equal(T_world_keyframe, self.T_world_keyframe):
            self.motion.move(T_world_keyframe @ inverse(self.T_world_keyframe))
            self.T_world_keyframe, self.target = T_world_keyframe.copy(), None


@savable()
@dataclass
class LeftParts:
    """The parts left last, the latest at the end."""

    parts: list[LeftPart] = field(default_factory=list)

    def leave(self, keyframe: int, T_world_keyframe: np.ndarray, tracker: Tracker) -> None:
        """The camera was lost, and tracking will go on elsewhere.

        Args:
            keyframe: that poses hang on.
            T_world_keyframe: its pose [4, 4], as the tracker has it.
            tracker: knows how the camera moved.
        """
        motion = replace(tracker.state.motion, views=list(tracker.state.motion.views))
        if motion.reference_view is not None:
            self.parts = [*self.parts, LeftPart(keyframe, T_world_keyframe.copy(), motion)][-LeftPartTuning.max_parts:]

    def forget_targets(self) -> None:
        """The camera is located: what was gathered to find it is not needed."""
        for part in self.parts:
            part.target = None

    def find(self, frame: Frame, here: int, tracker: Tracker, loops: LoopCloser) -> tuple[TrackingResult, int] | None:
        """Looks for a lost frame where the camera was lost before; the tracker goes on from there.

        Args:
            frame: the frame.
            here: number of the keyframe that poses hang on now.
            tracker: of the run.
            loops: knows where keyframes are.

        Returns:
            What tracking says, and the number of the keyframe that it hangs on; None: it is not there.
        """
        count = len(loops)
        if here >= count:  # its part has just begun, and its keyframe waits for the mapper
            return None
        self.parts = [p for p in self.parts if p.keyframe >= count or not loops.parts.together(p.keyframe, here)]
        for part in reversed([part for part in self.parts if part.keyframe < count]):
            part.follow(loops.poses[part.keyframe])
            part.target = part.target or loops.target_around(part.keyframe)
            result = tracker.track_from(frame, replace(part.motion), part.target)
            if result.status is not TrackingStatus.LOST:
                self.parts = [other for other in self.parts if other is not part]
                loops.go_on_at(frame, part.keyframe, "where the camera was lost before")
                return result, part.keyframe
        return None
