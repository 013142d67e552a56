# SPDX-License-Identifier: Apache-2.0
"""Schedules of mapping: keyframes are inserted and trained after each frame, or beside the next frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Protocol

from ggslam.mapping.mapper import Mapper
from ggslam.scene.frame import Frame
from ggslam.tracking.tracker import Tracker, TrackingResult


@dataclass(frozen=True)
class NewKeyframe:
    """A frame that becomes a keyframe.

    Attributes:
        frame: as the run uses it.
        tracking: where it is.
        moves_followed: how many corrections of the map this pose knows of.
    """

    frame: Frame
    tracking: TrackingResult
    moves_followed: int


class MapSteps(Protocol):
    """The steps that a schedule calls, see `Slam`."""

    mapper: Mapper
    tracker: Tracker

    def map_keyframe(self, new: NewKeyframe, train: Callable[[], None] | None = None) -> None:
        """Steps 4 to 6; with `train`, 5 and 6 beside the next frames."""

    def end_joining(self) -> None:
        """A keyframe that joins beside the next frames has joined."""

    def train(self, frames: int, keyframes_before: int) -> None:
        """Step 7."""


class Schedule:
    """Maps and trains after each frame: everything one after the other in one thread, so that runs repeat bit for bit.
    """

    takes_keyframes = True
    """Whether a keyframe that is found now will be mapped."""

    def begin_step(self) -> None:
        """A step begins."""

    def beside_mapping(self) -> AbstractContextManager[object]:
        """Context in which frames are located."""
        return nullcontext()

    def map(self, slam: MapSteps, keyframes: Sequence[NewKeyframe], frames: int) -> None:
        """Maps the keyframes of a step, and trains the map.

        Args:
            slam: the run.
            keyframes: new ones; there may be none.
            frames: of the step, by which the training is counted.
        """
        before = len(slam.mapper.keyframes)
        if keyframes:
            slam.tracker.target = None  # the surface may be made anew; the next frame gets what it is then
        for keyframe in keyframes:
            slam.map_keyframe(keyframe)
        slam.train(frames, before)


class BesideTraining(Schedule):
    """The same on a GPU: the points of a step's last keyframe join the surface, and loops are looked for, beside the
    next frame, which is aligned to the surface without them. Frames are located beside the training, before it where
    both wait for room on the GPU. Of the map, frames see what they see on the CPU.

    Args:
        beside: context for work beside the mapper's.
    """

    def __init__(self, beside: AbstractContextManager[object]) -> None:
        self._beside = beside

    def beside_mapping(self) -> AbstractContextManager[object]:
        return self._beside

    def map(self, slam: MapSteps, keyframes: Sequence[NewKeyframe], frames: int) -> None:
        before = len(slam.mapper.keyframes)
        if not keyframes:
            slam.train(frames, before)
            return
        slam.end_joining()
        for keyframe in keyframes[:-1]:
            slam.map_keyframe(keyframe)
        slam.map_keyframe(keyframes[-1], train=lambda: slam.train(frames, before))
