# SPDX-License-Identifier: Apache-2.0
"""The live map of a robot that drives along a lane: TSDF, distance field and band of heights."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from safety_robot import Robot
from safety_world import Lane, LaneCaster

from ggslam.driving.bands import band_map
from ggslam.driving.robot import Robot as Body
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_grid import SlicePlane
from ggslam.volumes.esdf import DistanceField, FieldSettings
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap


class LiveMapTuning(Tuning):
    """How the map is made."""

    band_low = 0.15
    """Metres above the floor below which nothing counts: the floor may be a voxel of 10 cm off."""
    approach = 1.5
    """Metres that the robot drives, and maps, before an encounter begins."""
    between = 0.15
    """Metres between the views of that approach."""
    field_reach = 0.3
    """Metres, or three voxels, up to which distances are computed."""


@dataclass(frozen=True)
class Saved:
    """Voxels of a TSDF, to be put back."""

    dense: np.ndarray
    voxels: dict[str, np.ndarray]
    free: np.ndarray
    free_weight: np.ndarray


class LiveMap:
    """The map of one lane, begun with the approach.

    Args:
        lane: where the robot drives.
        robot: its body.
        camera: of the depth images.
        voxel: edge, metres.
        max_depth: range of the map, metres.
        clearance: voxels that the robot keeps away from things.
        noise: whether depth is that of a structured-light camera.

    Attributes:
        seconds: processor time of each frame fused: TSDF, field and the band of heights along the way. Frames after
            which the field follows a restored map, too, are left out.
    """

    def __init__(
        self, lane: Lane, robot: Robot, camera: Camera, voxel: float, max_depth: float, clearance: float = 1.0,
        noise: bool = False,
    ) -> None:  # fmt: skip
        self.lane, self.robot, self.camera, self.voxel = lane, robot, camera, voxel
        self.clearance = clearance * voxel
        self._body = Body(height=robot.heights[1], radius=robot.radius, step=LiveMapTuning.band_low)
        context = NativeContext(1)
        self.tsdf = TsdfMap(TsdfSettings(voxel=voxel, max_depth=max_depth), context)
        self.field = DistanceField(self.tsdf, FieldSettings(max_distance=max(LiveMapTuning.field_reach, 3 * voxel)))
        self.seconds: list[float] = []
        self._restored = False
        caster = LaneCaster(lane, camera, robot.camera_height, noise=0 if noise else None)
        for x in np.arange(0.0, LiveMapTuning.approach + 1e-9, LiveMapTuning.between):
            self.add(caster.depth(x), caster.pose(x))
        self._saved, self.seconds = self._save(), []

    def add(self, depth: np.ndarray, T_lane_camera: np.ndarray) -> float:
        """Fuses a frame and tells what `contact` does afterwards."""
        start = time.thread_time()
        self.tsdf.integrate(depth, self.camera, T_lane_camera)
        self.field.update()
        found = self.contact()
        if not self._restored:
            self.seconds.append(time.thread_time() - start)
        self._restored = False
        return found

    def contact(self) -> float:
        """The x of the robot's centre at which, by the map, it comes within its clearance of something; infinite if it
        does not."""
        reach = self.robot.radius + self.clearance
        way = SlicePlane(np.zeros(3), *np.eye(3)[:2], (0.0, -reach), (self.lane.end + reach, reach))
        x, y = band_map(self.field, way, self._body, self.voxel).points.T
        near = np.abs(y) < reach
        return float((x[near] - np.sqrt(reach**2 - y[near] ** 2)).min(initial=np.inf))

    def restore(self) -> None:
        """Makes the map again what it was after the approach; its distance field follows with the next frame."""
        self.tsdf.clear()
        self.tsdf.write(self._saved.dense, **self._saved.voxels)
        self.tsdf.write_free(self._saved.free, self._saved.free_weight)
        self._restored = True

    def refresh(self) -> None:
        """Brings the distance field up to date, so that a frame need not wait for it."""
        self.field.update()
        self._restored = False

    def _save(self) -> Saved:
        blocks = self.tsdf.blocks()
        dense = blocks.coordinates[blocks.dense]
        held = self.tsdf.read(dense)
        voxels = {name: getattr(held, name) for name in ("value", "weight", "hits", "octants")}
        return Saved(dense, voxels, blocks.coordinates[~blocks.dense], blocks.free_weight[~blocks.dense])
