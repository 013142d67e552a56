# SPDX-License-Identifier: Apache-2.0
"""Scores of a run of a rig, camera by camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.scene.frame import Frame
from ggslam.sequences.rig import RigSequence


class RigScores:
    """What is scored of each camera of a rig, and of all of it.

    Args:
        sequence: of the rig.
        sets: frames that each kind of score is about.
    """

    def __init__(self, sequence: RigSequence, sets: Mapping[str, set[int]]) -> None:
        self._sequence, self._names = sequence, sequence.rig.names
        self._frames = [set(sequence.frames_of(number).tolist()) for number in range(len(self._names))]
        self._sets = sets

    def sets(self) -> dict[str, set[int]]:
        """The frames of each camera that each kind of score is about."""
        return {
            f"{name}/{kind}": frames & own
            for name, own in zip(self._names, self._frames, strict=True) for kind, frames in self._sets.items()
        }  # fmt: skip

    def trajectory(self, poses: Mapping[int, np.ndarray]) -> dict[str, Any] | None:
        """Of the rig: the first frame of each instant; see `evaluation.trajectory`.

        Args:
            poses: T_world_camera [4, 4] by frame index.
        """
        _, first = np.unique(self._sequence.places[:, 0], return_index=True)
        cameras = self._sequence.places[first, 1]
        most = np.bincount(cameras).argmax()  # distances are of one camera's motion
        return self._score(first[cameras == most], poses)

    def of_cameras(self, poses: Mapping[int, np.ndarray], images: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """What metrics.json holds of each camera.

        Args:
            poses: as of `trajectory`.
            images: scores of `sets`.
        """
        return {
            name: {
                "trajectory": self._score(np.array(sorted(own), int), poses),
                "images": {kind: images[f"{name}/{kind}"] for kind in self._sets},
            } for name, own in zip(self._names, self._frames, strict=True)
        }  # fmt: skip

    def _score(self, frames: np.ndarray, poses: Mapping[int, np.ndarray]) -> dict[str, Any] | None:
        truth = self._sequence.ground_truth
        if truth is None or not len(frames):
            return None
        scores = score_trajectory([poses.get(i) for i in frames.tolist()], truth[frames])
        return None if scores is None else asdict(scores)


def shows_anything(frame: Frame) -> bool:
    """Whether a camera saw anything at all: black images without depth are in no score."""
    return bool(frame.depth.any() or frame.color.any())
