# SPDX-License-Identifier: Apache-2.0
"""The fusion of one view, which may have to be started again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from ggslam.abi.cuda import FusedCount
from ggslam.errors import VoxelError
from ggslam.volumes.cuda.view_inputs import SentImages
from ggslam.volumes.fusion_view import FusionView
from ggslam.volumes.tsdf import TsdfMap

if TYPE_CHECKING:
    from ggslam.volumes.cuda.fused_state import FusedState

MOST_LISTED: Final = 1 << 23
"""Blocks that a view may tell about, as of the compiled core."""
MOST_UPDATES: Final = 1 << 20
"""Blocks with voxels that it may change, likewise."""


class ViewOperation:
    """A view on the device.

    Args:
        state: of the map.
        view: the images' sizes, and the pose.
        sent: where the images are.
    """

    def __init__(self, state: FusedState, view: FusionView, sent: SentImages) -> None:
        self._state, self._view, self._sent = state, view, sent
        self._depth = state.images[state.ring.next_place].depth
        self._cut_beyond = self._refused = False

    def __call__(self, number: int) -> None:
        """Starts it."""
        if self._refused:
            return
        state = self._state
        job = state.fusion.job(state.memory.structure(), state.memory.room, self._view, self._sent)
        job.cut_beyond = int(self._cut_beyond)
        state.fusion.start(job, number)

    def is_too_large(self, counts: np.ndarray) -> bool:
        """Whether the view shows more than a view may, by what the counts say it needs. Depth beyond the range is then
        left out; if that was done, nothing is fused."""
        many = counts[FusedCount.LIST_NEEDED] > MOST_LISTED or counts[FusedCount.UPDATES_NEEDED] > MOST_UPDATES
        if not many:
            return False
        beyond = (self._depth > self._state.settings.max_depth).any()
        if beyond and not self._cut_beyond:
            self._cut_beyond = True
        else:
            self._refused = True
        return True

    def check(self) -> None:
        """Raises a VoxelError if the view was refused: the compiled core's, which names voxels that work, if it refuses
        the view, too."""
        if self._refused:
            T, settings = np.linalg.inv(self._view.T_camera_world), self._state.settings
            TsdfMap(settings, points=False).integrate(self._depth, self._view.camera, T)
            raise VoxelError(f"view: it shows too many blocks for voxels of {settings.voxel:g} m on a device")
