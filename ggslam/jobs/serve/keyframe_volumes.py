# SPDX-License-Identifier: Apache-2.0
"""TSDF and distance field of keyframes: growing with them, or made at once of those that a run ended with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ggslam.jobs.plan.map_files import TSDF
from ggslam.mapping.keyframe import Keyframe
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse
from ggslam.system.atomic import make_folder
from ggslam.system.tuning import Tuning
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.floor_frame import FLOOR_FILE, write_floor_file
from ggslam.volumes.output_frame import OutputFrame
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.tsdf_file import save_tsdf


class KeyframeVolumesTuning(Tuning):
    """How keyframes are fused."""

    voxel_m = 0.05
    """Edge of a voxel in a room, in metres; it grows with the scene as that of `ggslam volumes` does."""
    moved_m = 0.025
    """A keyframe that has moved what it sees by more than this, in metres, since it was fused lies wrong there..."""
    reach_m = 3.0
    """...where what it sees is so far away, in metres."""


@dataclass(frozen=True)
class PlacedKeyframe:
    """A keyframe, whose images do not change, and where it was: T_camera_world float64 [4, 4]."""

    keyframe: Keyframe
    T_camera_world: np.ndarray


def keyframes_now(keyframes: Sequence[Keyframe]) -> list[PlacedKeyframe]:
    """Keyframes where they are now."""
    return [PlacedKeyframe(keyframe, keyframe.T_camera_world.copy()) for keyframe in list(keyframes)]


@dataclass(frozen=True)
class Floor:
    """T_floor_map float64 [4, 4], and whether a floor was seen there; else it is a guess."""

    T_floor_map: np.ndarray
    seen: bool


class FusedKeyframes:
    """What was fused.

    Args:
        scale: of the scene, see `geometry.scene_size.scene_scale`.
        context: threads to work on.
    """

    def __init__(self, scale: float, context: NativeContext | None = None) -> None:
        settings = TsdfSettings().in_scene(scale)
        times = settings.voxel / TsdfSettings().voxel
        self.tsdf = TsdfMap(replace(settings, voxel=KeyframeVolumesTuning.voxel_m * times), context)
        self.field = DistanceField(self.tsdf)
        self._poses: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self._poses)

    def still_fits(self, views: Sequence[PlacedKeyframe], moved_m: float) -> bool:
        """Whether what was fused is among some keyframes, and what they see no farther than `moved_m` from there."""
        now = {view.keyframe.index: view.T_camera_world for view in views}
        if not self._poses.keys() <= now.keys():
            return False
        if not self._poses:
            return True
        moves = np.stack([now[k] for k in self._poses]) @ inverse(np.stack(list(self._poses.values())))
        turned = np.linalg.norm(moves[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2)
        far = np.linalg.norm(moves[:, :3, 3], axis=1) + KeyframeVolumesTuning.reach_m * turned
        return bool(far.max() <= moved_m)

    def add(self, views: Sequence[PlacedKeyframe], go_on: Callable[[], bool] = lambda: True) -> bool:
        """Fuses what was not yet, at least one and as long as `go_on` says; returns whether all of them are."""
        for view in views:
            if view.keyframe.index in self._poses:
                continue
            self._fuse(view)
            if not go_on():
                break
        self.field.update()
        return len(self) == len(views)

    def _fuse(self, view: PlacedKeyframe) -> None:
        keyframe = view.keyframe
        depth, moving = keyframe.depth_m(), keyframe.moving
        if moving is not None:
            depth = np.where(moving, np.float32(0), depth)
        self.tsdf.integrate(depth, keyframe.camera, inverse(view.T_camera_world), keyframe.color)
        self._poses[keyframe.index] = view.T_camera_world


class KeyframeVolumes:
    """Files of a run's volumes, made of its keyframes.

    Args:
        keyframes: as the run ended with them.
        scale: of the scene.
        floor: of the map.
    """

    def __init__(self, keyframes: Sequence[Keyframe], scale: float, floor: Floor) -> None:
        self._keyframes, self._scale, self._floor = keyframes, scale, floor

    def write(self, folder: Path) -> None:
        """Writes the TSDF and where the floor is.

        Raises:
            RunFolderError: they cannot be written.
        """
        fused = FusedKeyframes(self._scale)
        fused.add(keyframes_now(self._keyframes))
        make_folder(folder)
        save_tsdf(folder / TSDF, fused.tsdf)
        write_floor_file(folder / FLOOR_FILE, self._floor.T_floor_map, OutputFrame.map, self._floor.seen)
