# SPDX-License-Identifier: Apache-2.0
"""A truncated signed distance field on a GPU: the fusion of the compiled core (`TsdfMap`) by CUDA kernels.

The host waits for nothing while views are fused, and no memory is allocated but where the map grows: before it is full,
by what came back of views some frames ago. A view that does not fit all the same changes nothing, nor do those after
it; its images are kept on the device until it is known to be fused, and it is fused again once there is room.
"""

from __future__ import annotations

import numpy as np
import torch

from ggslam.abi.cuda import FusedCount
from ggslam.cuda.library import CudaLibrary, library_and_device
from ggslam.errors import InputError
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame_checks import wrong_unit
from ggslam.scene.origin import local_origin, moved_pose
from ggslam.volumes.cuda.conversion import blocks_of_host, map_on_host, put_bytes
from ggslam.volumes.cuda.fused_state import FusedState
from ggslam.volumes.cuda.room import Room
from ggslam.volumes.cuda.view_operation import ViewOperation
from ggslam.volumes.fusion_view import FusionView
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import MOST_VOXELS, SIDE, TsdfMap, has_beyond

_MOST_BLOCKS = 1 << 20
"""Coordinates of blocks are smaller than this: three of them make a key of 64 bits."""


class CudaTsdf:
    """The map on a GPU. Its blocks and values are those of a `TsdfMap` that fused the same views, up to rounding.

    Args:
        settings: of the fusion.
        device: CUDA device; None: the current one.
        points: whether measured points are counted, as of a `TsdfMap`.
        library: the kernels; None: those of the device, compiled if need be.
        room: at first.

    Raises:
        MissingDependency: no GPU or no kernels.
    """

    def __init__(
        self, settings: TsdfSettings | None = None, device: torch.device | str | None = None, points: bool = True,
        library: CudaLibrary | None = None, room: Room | None = None,
    ) -> None:  # fmt: skip
        self.settings, self.points = settings or TsdfSettings(), points
        self.origin: np.ndarray | None = None
        """Where in the world blocks are counted from, as of a `TsdfMap`; None until the first view."""
        self.library, self.device = library_and_device(device, library)
        self.state = FusedState(self.library, self.device, self.settings, points, room or Room())

    @classmethod
    def of_native(
        cls, tsdf: TsdfMap, device: torch.device | str | None = None, library: CudaLibrary | None = None
    ) -> CudaTsdf:
        """A map of the compiled core on a GPU, to be gone on with."""
        blocks = len(tsdf)
        room = Room().with_room_for(rows=2 * blocks, slots=2 * tsdf.dense_blocks)
        found = cls(tsdf.settings, device, tsdf.points, library, room)
        found.origin = tsdf.origin if blocks else None
        memory = found.state.memory
        for name, array in blocks_of_host(tsdf, tsdf.points, 1).items():
            put_bytes(memory.read(name, getattr(room, "rows" if name == "blocks" else "slots")), array)
        counts = np.zeros(len(memory.counts), np.int32)
        counts[FusedCount.ROWS_USED] = counts[FusedCount.PRESENT_BLOCKS] = blocks
        counts[FusedCount.SLOTS_USED] = counts[FusedCount.DENSE_BLOCKS] = tsdf.dense_blocks
        memory.counts.copy_(torch.from_numpy(counts))
        memory.grow(room)  # makes the table of keys
        found.state.begin_with(counts)
        return found

    def __len__(self) -> int:
        """Number of blocks; waits for the views so far."""
        return int(self.state.settle()[FusedCount.PRESENT_BLOCKS])

    @property
    def dense_blocks(self) -> int:
        """Blocks with voxels; waits for the views so far."""
        return int(self.state.settle()[FusedCount.DENSE_BLOCKS])

    @property
    def recent_blocks(self) -> int:
        """Number of blocks some views ago, for which nobody waits."""
        return self.state.recent_blocks

    @property
    def memory_bytes(self) -> int:
        """Memory of the map on the device."""
        return self.state.memory.bytes

    def integrate(
        self, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray, color: np.ndarray | None = None,
        labels: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Fuses a view; arguments as of `TsdfMap.integrate`.

        Raises:
            InputError: an image of another size or kind than the camera's, a pose that is not finite and rigid, or
                depth that cannot be in metres.
            VoxelError: a view before (or this one) shows too many blocks for voxels of this size.
        """
        s = self.settings
        pose = np.asarray(T_world_camera, np.float64)
        if pose.shape == (4, 4) and np.isfinite(pose).all():  # else it is refused
            self.origin = local_origin(pose[:3, 3]) if self.origin is None else self.origin
            pose = moved_pose(pose, -self.origin)
        limit = min(MOST_VOXELS, 0.5 * _MOST_BLOCKS * SIDE) * s.voxel
        view = FusionView(depth, camera, pose, color, labels, limit)
        if has_beyond(view.depth, s.max_depth) and (unit := wrong_unit(view.depth)):
            raise InputError(unit)
        self.state.make_room()
        place = self.state.ring.next_place
        self.state.ring.start(ViewOperation(self.state, view, self.state.images[place].send(view)))

    def clear(self) -> None:
        """Forgets everything but the origin."""
        self.state.clear()

    def to_native(self, context: NativeContext | None = None) -> TsdfMap:
        """The same map in the compiled core, for meshes and files; waits for the views so far."""
        counts = self.state.settle()
        rows, slots = int(counts[FusedCount.ROWS_USED]), int(counts[FusedCount.SLOTS_USED])
        return map_on_host(self.state.memory, rows, slots, self.settings, self.origin, context)
