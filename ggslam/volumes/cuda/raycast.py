# SPDX-License-Identifier: Apache-2.0
"""The surface of a map on a GPU as a camera sees it: that of `render_depth`, by CUDA kernels."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.abi.cuda import CastJob
from ggslam.cuda.memory import GrowingMemory
from ggslam.cuda.transfers import download
from ggslam.scene.camera import Camera
from ggslam.scene.origin import moved_pose
from ggslam.volumes.cuda.fusion_jobs import grid_blocks
from ggslam.volumes.cuda.tsdf import CudaTsdf
from ggslam.volumes.raycast import RenderedSurface, check_view
from ggslam.volumes.tsdf import FULL_WEIGHT


@dataclass(frozen=True)
class DeviceSurface:
    """Images on the device, good until the next ones are rendered: depth [H, W] and normals [H, W, 3], float32; colours
    [H, W, 3], uint8; labels [H, W], uint16 as bytes [H, W, 2]. They are right once `CudaRaycast.read` or anything else
    has waited for the map, which may have to grow first."""

    depth: torch.Tensor
    normals: torch.Tensor
    colors: torch.Tensor
    labels: torch.Tensor


class CudaRaycast:
    """Casts rays into a map.

    Args:
        tsdf: the map.
    """

    def __init__(self, tsdf: CudaTsdf) -> None:
        self._tsdf, self._grid = tsdf, grid_blocks(tsdf.library)
        self._cells, self._images = GrowingMemory(tsdf.device), GrowingMemory(tsdf.device)

    def render(
        self, camera: Camera, T_world_camera: np.ndarray, near: float = 0.1, far: float = 10.0,
        min_weight: float | None = None,
    ) -> DeviceSurface:  # fmt: skip
        """Starts to cast a ray through every pixel centre; arguments and errors as of `render_depth`. The host waits
        for nothing."""
        pose = check_view(T_world_camera, near, far)
        tsdf, c = self._tsdf, camera
        pose = pose if tsdf.origin is None else moved_pose(pose, -tsdf.origin)
        images = self._surface(c.height, c.width)
        weight = tsdf.settings.least_weight if min_weight is None else min_weight
        share = min(max(weight / tsdf.settings.max_weight, 0), 1)
        numbers = CastJob(
            depth=images.depth.data_ptr(), normals=images.normals.data_ptr(), colors=images.colors.data_ptr(),
            labels=images.labels.data_ptr(), fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy, nearest=near, farthest=far,
            width=c.width, height=c.height, device=tsdf.device.index or 0, grid=self._grid,
            least_weight=max(1, math.ceil(share * FULL_WEIGHT)),
        )  # fmt: skip
        numbers.rotation[:], numbers.position[:] = pose[:3, :3].ravel().tolist(), pose[:3, 3].tolist()
        tsdf.state.make_room()
        tsdf.state.ring.start(lambda _number: self._run(numbers))
        return images

    def read(self, images: DeviceSurface) -> RenderedSurface:
        """The images on the host; waits for the map and them."""
        self._tsdf.state.settle()
        depth, normals, colors, labels = download(images.depth, images.normals, images.colors, images.labels)
        return RenderedSurface(depth, normals, colors, labels.view(np.uint16)[..., 0])

    def _run(self, job: CastJob) -> None:
        state, room = self._tsdf.state, self._tsdf.state.memory.room
        job.map, job.stream = state.memory.structure(), self._tsdf.library.stream(self._tsdf.device)
        job.cells = self._cells.block("cells", 64 * room.rows).data_ptr()
        job.kinds = self._cells.block("kinds", room.rows).data_ptr()
        self._tsdf.library.call("cast_rays", ctypes.byref(job))

    def _surface(self, height: int, width: int) -> DeviceSurface:
        pixels, memory = height * width, self._images
        floats = [memory.block(n, s * pixels)[: s * pixels].view(torch.float32) for n, s in (("z", 4), ("n", 12))]
        depth, normals = floats[0].view(height, width), floats[1].view(height, width, 3)
        colors = memory.block("colors", 3 * pixels)[: 3 * pixels].view(height, width, 3)
        labels = memory.block("labels", 2 * pixels)[: 2 * pixels].view(height, width, 2)
        return DeviceSurface(depth, normals, colors, labels)
