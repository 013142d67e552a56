# SPDX-License-Identifier: Apache-2.0
"""The surface of a map as points: Gaussians' middles lie centimetres beside it.

Of a growing map it is what its keyframes measured. Each keyframe's points are thinned once, in the frame of its camera,
and stand where its pose stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.jobs.serve.keyframe_volumes import PlacedKeyframe
from ggslam.jobs.serve.tiles import TileTuning, thin_points
from ggslam.mapping.keyframe import Keyframe
from ggslam.runs.folder import RunFolder
from ggslam.runs.opened_points import surface_points
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.tuning import Tuning


class SeenPointsTuning(Tuning):
    """Which of a keyframe's pixels are taken."""

    columns = 128
    """Most pixels along an image's side that are looked at."""
    near_edge = 0.05
    """Share of its depth by which a pixel's neighbours may differ: beside edges of depth sensors see neither."""


@dataclass(frozen=True)
class PointCloud:
    """Points [N, 3] (metres), colours uint8 [N, 3], objects uint16 [N] (0: none)."""

    xyz: np.ndarray
    rgb: np.ndarray
    ids: np.ndarray


class SeenPoints:
    """Gathers keyframes' points. Not for several threads at a time."""

    def __init__(self) -> None:
        self._parts: dict[int, PointCloud] = {}

    def cloud(self, views: Sequence[PlacedKeyframe], ids: np.ndarray | None) -> PointCloud:
        """The points of keyframes, where these are.

        Args:
            views: the keyframes.
            ids: uint16 [65536], object of each id of the masks; None: there are no objects.
        """
        for view in views:
            if view.keyframe.index not in self._parts:
                self._parts[view.keyframe.index] = points_in_camera(view.keyframe)
        parts = [(self._parts[view.keyframe.index], inverse(view.T_camera_world)) for view in views]
        xyz = [transform_points(part.xyz, T).astype(np.float32) for part, T in parts]
        labels = np.concatenate([np.zeros(0, np.uint16), *(part.ids for part, _ in parts)])
        labels = np.zeros_like(labels) if ids is None else ids[labels]
        rgb = [np.zeros((0, 3), np.uint8), *(part.rgb for part, _ in parts)]
        return PointCloud(np.concatenate([np.zeros((0, 3), np.float32), *xyz]), np.concatenate(rgb), labels)


def saved_points(folder: RunFolder) -> PointCloud:
    """The surface of a saved run, see `surface_points`; errors as there."""
    found = surface_points(folder, None)
    ids = np.zeros(len(found), np.uint16) if found.object_id is None else found.object_id.astype(np.uint16)
    return PointCloud(found.points.astype(np.float32), found.colors, ids)


def points_in_camera(keyframe: Keyframe) -> PointCloud:
    """A keyframe's points in its camera's frame, one for each cell of `TileTuning.point_m` that it sees."""
    depth = keyframe.depth_m()
    step = max(1, -(-max(depth.shape) // SeenPointsTuning.columns))
    good = (depth > 0) & _is_smooth(depth)
    if keyframe.moving is not None:
        good &= ~keyframe.moving
    chosen = np.zeros(depth.shape, bool)
    chosen[::step, ::step] = good[::step, ::step]
    xyz = keyframe.camera.rays()[chosen] * depth[chosen][:, None]
    ids = np.zeros(len(xyz), np.uint16) if keyframe.mask is None else keyframe.mask[chosen]
    thin = thin_points(xyz, keyframe.color[chosen], ids, TileTuning.point_m)
    return PointCloud(thin.xyz, thin.rgb, thin.ids)


def _is_smooth(depth: np.ndarray) -> np.ndarray:
    """Bool [H, W]: the pixels left, right, above and below are about as far."""
    most = SeenPointsTuning.near_edge * depth
    smooth = np.ones(depth.shape, bool)
    across, down = np.abs(np.diff(depth, axis=1)), np.abs(np.diff(depth, axis=0))
    smooth[:, 1:] &= across <= most[:, 1:]
    smooth[:, :-1] &= across <= most[:, :-1]
    smooth[1:] &= down <= most[1:]
    smooth[:-1] &= down <= most[:-1]
    return smooth
