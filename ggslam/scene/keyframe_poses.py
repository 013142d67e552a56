# SPDX-License-Identifier: Apache-2.0
"""Poses of the keyframes of a run, in one place that all parts of the run read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import overload

import numpy as np

from ggslam.errors import FormatError
from ggslam.system.array_forms import Pose, PoseForm
from ggslam.system.savable import savable


@savable(check="check")
class KeyframePoses(Sequence[np.ndarray]):
    """T_world_camera of keyframes as they were tracked and as closed loops have corrected them; the mapper refines its
    own on top of these. Whoever derives something from them makes it again when `version` has changed.

    Poses that were handed out never change: a correction puts others in their place. A thread that reads while another
    one moves them gets each pose whole, from before or from after.

    Args:
        poses: T_world_camera [4, 4] of the first keyframes.
    """

    _poses: list[Pose]

    def __init__(self, poses: Iterable[np.ndarray] = ()) -> None:
        self._poses = [_own(T) for T in poses]
        self.version = 0
        """How many times keyframes have moved; new ones do not count."""

    def check(self) -> None:
        """Raises FormatError if these are no poses: they may come from a file."""
        if self._poses and (found := PoseForm("f8", len(self._poses)).check(self.array(), {})):
            raise FormatError(f"poses of keyframes: {found}")

    def __len__(self) -> int:
        return len(self._poses)

    @overload
    def __getitem__(self, number: int) -> np.ndarray: ...

    @overload
    def __getitem__(self, number: slice) -> list[np.ndarray]: ...

    def __getitem__(self, number: int | slice) -> np.ndarray | list[np.ndarray]:
        """T_world_camera of a keyframe, float64 [4, 4]."""
        return self._poses[number]

    def array(self) -> np.ndarray:
        """All of them, float64 [K, 4, 4]."""
        return np.array(self._poses, float).reshape(-1, 4, 4)

    def append(self, T_world_camera: np.ndarray) -> int:
        """A keyframe was made; returns its number."""
        self._poses.append(_own(T_world_camera))
        return len(self._poses) - 1

    def replace(self, T_world_camera: np.ndarray) -> None:
        """All keyframes are somewhere else now, float64 [K, 4, 4].

        Raises:
            ValueError: these are not as many poses.
        """
        if np.shape(T_world_camera) != (len(self), 4, 4):
            raise ValueError(f"T_world_camera: expected [{len(self)}, 4, 4], found {list(np.shape(T_world_camera))}")
        self._poses = [_own(T) for T in T_world_camera]
        self.version += 1

    def move(self, T_new_old: np.ndarray) -> None:
        """The world was moved: by one transform [4, 4], or about each keyframe by its own [K, 4, 4]."""
        self.replace(np.array([T @ old for T, old in zip(self._each(T_new_old), self._poses, strict=True)]))

    def _each(self, T_new_old: np.ndarray) -> Iterable[np.ndarray]:
        return [T_new_old] * len(self) if T_new_old.ndim == 2 else list(T_new_old)


def _own(T: np.ndarray) -> Pose:
    """A copy that nobody can change."""
    copy = np.array(T, float)
    copy.flags.writeable = False
    return copy
