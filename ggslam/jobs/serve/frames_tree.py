# SPDX-License-Identifier: Apache-2.0
"""The tree of frames by REP 105: the camera moves in `odom` without a jump, and whatever corrects the map (closed
loops, relocalisation, parts that join, refined keyframes) moves `odom` in `map`."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ggslam.jobs.serve.channels import CAMERA, FLOOR, MAP, ODOM, OPTICAL, T_CAMERA_OPTICAL
from ggslam.messages.contents import Transforms
from ggslam.scene.poses import inverse

T_OPTICAL_CAMERA = inverse(T_CAMERA_OPTICAL)


class FramesTree:
    """Follows a run frame by frame.

    Attributes:
        T_map_odom: float64 [4, 4], where the camera's own reckoning lies in the map, as far as is known by now.
        T_odom_optical: float64 [4, 4], the camera by the motions that were tracked, one after the other.
    """

    def __init__(self) -> None:
        self.T_map_odom, self.T_odom_optical = np.eye(4), np.eye(4)
        self._T_world_odom: np.ndarray | None = None
        """Where `odom` is in the world that the tracker knows, which may lag behind the map."""

    def step(
        self, T_world_optical: np.ndarray, T_map_optical: np.ndarray, moves: Iterable[np.ndarray], unbroken: bool
    ) -> None:
        """A frame was located.

        Args:
            T_world_optical: its pose as tracked, float64 [4, 4].
            T_map_optical: its pose as far as is known by now.
            moves: corrections [4, 4] that the tracker has followed since the frame before.
            unbroken: whether its motion since the frame before was tracked; else the camera was lost in between, or was
                found anew, and stands still in `odom`.
        """
        for T_new_old in moves:
            self.move_world(T_new_old)
        if self._T_world_odom is None or not unbroken:
            self._T_world_odom = T_world_optical @ inverse(self.T_odom_optical)
        self.T_odom_optical = inverse(self._T_world_odom) @ T_world_optical
        self.correct(T_map_optical)

    def move_world(self, T_new_old: np.ndarray) -> None:
        """The tracker followed a correction [4, 4]."""
        if self._T_world_odom is not None:
            self._T_world_odom = T_new_old @ self._T_world_odom

    def correct(self, T_map_optical: np.ndarray) -> None:
        """The last frame turns out to be there [4, 4]."""
        self.T_map_odom = T_map_optical @ inverse(self.T_odom_optical)

    @property
    def transforms(self) -> Transforms:
        """The edges that change, for /tf."""
        T_odom_camera = self.T_odom_optical @ T_OPTICAL_CAMERA
        return Transforms(((MAP, ODOM, self.T_map_odom), (ODOM, CAMERA, T_odom_camera)))


def fixed_frames(T_floor_map: np.ndarray | None) -> Transforms:
    """The edges that stay, for /tf_static: the camera's optical frame, and the floor, if it is known: T_floor_map
    float64 [4, 4]."""
    edges: list[tuple[str, str, np.ndarray]] = [(CAMERA, OPTICAL, T_CAMERA_OPTICAL)]
    if T_floor_map is not None:
        edges.append((MAP, FLOOR, inverse(T_floor_map)))
    return Transforms(tuple(edges), fixed=True)
