# SPDX-License-Identifier: Apache-2.0
"""Corrections of the map after a loop was closed: keyframes move, Gaussians with them, and the tracker follows."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np

from ggslam.mapping.keyframe import ELSEWHERE
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.pruning import blank_part, drop_before, drop_moved, drop_pixels
from ggslam.native.loader import NativeContext
from ggslam.objects.uniting import FAINT, LabelledVoxels
from ggslam.scene.frame import Frame
from ggslam.slam.camera_fixtures import CameraFixtures
from ggslam.slam.earlier_views import EarlierViews
from ggslam.slam.loop_closing import Correction, LoopCloser
from ggslam.slam.map_paging import MapPager
from ggslam.slam.object_masks import ObjectMasks
from ggslam.slam.run_movers import RunMovers
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import TrackingResult

LOOKED_BACK = 64
"""So many of the latest keyframes are searched for what has moved since."""


@savable(not_saved="_surface _mapper _pager _masks _publishing")
class MapCorrections:
    """Keeps the surface, which the tracker's thread reads, in step with the corrections that the mapper's makes.

    Args:
        surface: that frames are aligned to.
        mapper: whose map is corrected.
        pager: of the map; None: all of it is in memory.
        masks: of objects; None: objects that both ends of a loop have mapped stay two.
    """

    _moves: list[Pose]

    def __init__(
        self, surface: MeasuredSurface, mapper: Mapper, pager: MapPager | None, masks: ObjectMasks | None = None
    ) -> None:
        self._surface, self._mapper, self._pager, self._masks = surface, mapper, pager, masks
        self._moves = []
        self._left_out = 0  # changes of what is fixed to the camera that the map knows of
        self._publishing = threading.Lock()

    def __len__(self) -> int:
        """How many times a closed loop has moved the map."""
        return len(self._moves)

    def news(self, known: int) -> tuple[GicpTarget | None, list[np.ndarray]]:
        """What the tracker aligns to now, and what moved the world about the camera, [4, 4] each, since so many
        corrections."""
        with self._publishing:
            return self._surface.target, self._moves[known:]

    def follow(self, tracking: TrackingResult, known: int) -> TrackingResult:
        """A tracked frame moved along with the corrections after the first `known` ones."""
        for T_new_old in self._moves[known:]:
            tracking = replace(tracking, T_world_camera=T_new_old @ tracking.T_world_camera)
        return tracking

    def begin_points(self, tracking: TrackingResult) -> None:
        """Starts in another thread what `add_points` will have to do."""
        self._surface.begin(tracking.points, tracking.T_world_camera)

    def add_points(self, tracking: TrackingResult) -> None:
        """The points of a new keyframe join the surface."""
        with self._publishing:
            self._surface.add(tracking.points, tracking.T_world_camera)

    def leave_out(self, fixtures: CameraFixtures, newest: Frame) -> None:
        """What has turned out to be fixed to the camera goes from map, keyframes and surface, which have the newest
        frame. What is on disk where memory is limited stays."""
        if fixtures.mask is None or (fixtures.changes == self._left_out and not newest.depth[fixtures.mask].any()):
            return
        self._left_out = fixtures.changes
        if self._pager is None:
            drop_pixels(self._mapper.map, self._mapper.keyframes, fixtures.mask, fixtures.nearest)
            with self._publishing:
                self._surface.drop_pixels(fixtures.mask, fixtures.nearest, self._mapper.keyframes[-1].camera)

    def take_out(self, movers: RunMovers, newest: Frame) -> None:
        """What was mapped before it began to move goes from map, keyframes and surface, as far as the newest frame,
        which has just become a keyframe, looks through where it was. What is on disk where memory is limited stays."""
        if not movers.has_trail or self._pager is not None:
            return
        keyframes = self._mapper.keyframes
        latest, earlier = keyframes[-1], [k for k in keyframes[-1 - LOOKED_BACK : -1] if k.frame_index != ELSEWHERE]
        views = [(k.depth_m(), k.T_world_camera, k.mask) for k in earlier]
        gone = movers.gone_since(views, newest, latest.T_world_camera)
        parts = [(k, part) for k, part in zip(earlier, gone, strict=True) if part is not None]
        if not parts:
            return
        drop_moved(self._mapper.map, parts)
        if self._mapper.identity is not None:
            self._mapper.identity.forget_pixels([k.index for k, _ in parts])
        with self._publishing:
            self._surface.drop_pixels_of({k.index: (part, k.camera) for k, part in parts})

    def take_out_outdated(self, views: EarlierViews, newest: Frame, tracking: TrackingResult, noise: DepthNoise | None,
                          context: NativeContext) -> None:  # fmt: skip
        """What a map that the run began with shows, and the run looks through, goes from map, keyframes and surface.

        Args:
            views: of that map.
            newest: about to become a keyframe.
            tracking: where it is.
            noise: of the depth camera.
            context: that it is computed in.
        """
        mapper = self._mapper
        found = views.look(mapper.keyframes, newest, tracking, noise, context)
        if not found:
            return
        births = np.array([k.index for k in mapper.keyframes if k.frame_index == ELSEWHERE])
        gone = [(k, parts) for k, parts in found if parts.gone.any()]
        went = drop_before(mapper.map, births, [(k, parts.gone, parts.around) for k, parts in gone]) if gone else 0
        for keyframe, parts in found:
            blank_part(keyframe, parts.around | parts.hidden)
        if mapper.identity is not None:
            mapper.identity.forget_pixels([k.index for k, _ in found])
        with self._publishing:
            self._surface.drop_pixels_of({k.index: (parts.around, k.camera) for k, parts in gone})
        views.gaussians += went

    def apply(self, correction: Correction, loops: LoopCloser) -> None:
        """Moves the map after its keyframes, unites objects that both ends have mapped, takes out what is double now,
        and trains both ends of the loop."""
        ends = correction.kept & correction.active
        self._mapper.move_keyframes(correction.T_new_old)
        if self._pager is not None:
            self._pager.move_keyframes(correction.T_new_old)
            self._pager.bring_ends(ends)
        with self._publishing:
            loops.settle(correction)
            self._moves.append(correction.T_new_old[-1])
        self._unite_objects(correction)
        self._mapper.mend(sorted(ends), sorted(correction.doubted), loops.settings.repair_iterations)

    def move_world(self, T_new_old: np.ndarray, loops: LoopCloser) -> None:
        """Moves everything [4, 4]; for the end, when nothing is tracked any more."""
        moves = np.tile(T_new_old, (len(loops.poses), 1, 1))
        self._mapper.move_keyframes(moves)
        with self._publishing:
            loops.move_world(T_new_old)
            self._moves.append(T_new_old)

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
            rows = np.isin(birth, sorted(end)) & (opacities >= FAINT)
            voxel = masks.settings.uniting.voxel
            voxels.append(LabelledVoxels.of(means[rows], labels[rows], opacities[rows], voxel))
        mapper.identity.merge(gaussians, masks.unite(voxels[0], voxels[1]))
