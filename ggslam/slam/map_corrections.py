# SPDX-License-Identifier: Apache-2.0
"""Corrections of the map after a loop was closed: keyframes move, Gaussians with them, and the tracker follows."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np

from ggslam.mapping.mapper import Mapper
from ggslam.objects.same_object import LabelledVoxels, SameObjectTuning
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.loop_results import Correction
from ggslam.slam.map_paging import MapPager
from ggslam.slam.object_masks import ObjectMasks
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import TrackingResult


@savable(not_saved="_surface _mapper _pager _masks _held publishing")
class MapCorrections:
    """Keeps the surface, which the tracker's thread reads, in step with the corrections that the mapper's makes.

    Args:
        surface: that frames are aligned to.
        mapper: whose map is corrected.
        pager: of the map; None: all of it is in memory.
        masks: of objects; None: objects that both ends of a loop have mapped stay two.
    """

    moves: list[Pose]

    def __init__(
        self, surface: MeasuredSurface, mapper: Mapper, pager: MapPager | None, masks: ObjectMasks | None = None
    ) -> None:
        self._surface, self._mapper, self._pager, self._masks = surface, mapper, pager, masks
        self.moves = []
        self._held: tuple[GicpTarget | None] | None = None
        self.publishing = threading.Lock()
        """Is held while the surface changes, or what the tracker reads beside it."""

    def __len__(self) -> int:
        """How many times a closed loop has moved the map."""
        return len(self.moves)

    def pending_moves(self, known: int) -> tuple[GicpTarget | None, list[np.ndarray]]:
        """What the tracker aligns to now, and what moved the world about the camera, [4, 4] each, since so many
        corrections."""
        if self._held is not None:
            return self._held[0], self.moves[known:]
        with self.publishing:
            return self._surface.target, self.moves[known:]

    def hold_target(self) -> None:
        """Until `show_target` the tracker aligns to what there is now, whatever another thread does to the surface."""
        self._held = (self._surface.target,)

    def show_target(self) -> None:
        """The tracker sees again what the surface is."""
        self._held = None

    def follow(self, tracking: TrackingResult, known: int) -> TrackingResult:
        """A tracked frame moved along with the corrections after the first `known` ones."""
        for T_new_old in self.moves[known:]:
            tracking = replace(tracking, T_world_camera=T_new_old @ tracking.T_world_camera)
        return tracking

    def begin_points(self, tracking: TrackingResult) -> None:
        """Starts in another thread what `add_points` will have to do."""
        self._surface.begin(tracking.points, tracking.T_world_camera)

    def add_points(self, tracking: TrackingResult) -> None:
        """The points of a new keyframe join the surface."""
        with self.publishing:
            self._surface.add(tracking.points, tracking.T_world_camera)

    def apply(self, correction: Correction, loops: LoopCloser) -> None:
        """Moves the map after its keyframes, unites objects that both ends have mapped, takes out what is double now,
        and trains both ends of the loop."""
        ends = correction.kept & correction.active
        self._mapper.move_keyframes(correction.T_new_old)
        try:
            if self._pager is not None:
                self._pager.move_keyframes(correction.T_new_old)
                self._pager.bring_ends(ends)
        finally:  # the map has moved: whatever fails, everything else follows
            with self.publishing:
                self.moves.append(correction.T_new_old[-1])
                loops.apply(correction)
        self._unite_objects(correction)
        self._mapper.retrain_loop_ends(sorted(ends), sorted(correction.doubted), loops.settings.repair_iterations)

    def move_world(self, T_new_old: np.ndarray, loops: LoopCloser) -> None:
        """Moves everything [4, 4]; for the end, when nothing is tracked any more."""
        moves = np.tile(T_new_old, (len(loops), 1, 1))
        self._mapper.move_keyframes(moves)
        with self.publishing:
            loops.move_world(T_new_old)
            self.moves.append(T_new_old)

    def _unite_objects(self, correction: Correction) -> None:
        """One thing that was mapped when the camera left and again when it came back has two ids: it keeps the older.
        """
        mapper, masks = self._mapper, self._masks
        if masks is None or mapper.identity is None or not len(mapper.map):
            return
        gaussians = mapper.map
        birth, opacities = gaussians.birth_keyframe.cpu().numpy(), gaussians.opacities.detach().cpu().numpy()
        means, labels = gaussians.means.detach().cpu().numpy(), mapper.vote_labels().astype(np.int64)
        voxels = []
        for end in (correction.kept, correction.doubted):
            rows = np.isin(birth, sorted(end)) & (opacities >= SameObjectTuning.min_opacity)
            voxel = masks.settings.uniting.voxel
            voxels.append(LabelledVoxels.of(means[rows], labels[rows], opacities[rows], voxel))
        mapper.identity.merge(gaussians, masks.unite(voxels[0], voxels[1]))
