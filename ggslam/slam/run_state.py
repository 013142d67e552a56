# SPDX-License-Identifier: Apache-2.0
"""The state of a run: its parts, wired together, and its results so far."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import ConfigError
from ggslam.mapping.extra_loss import ExtraLoss
from ggslam.mapping.keyframe import Keyframe
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS
from ggslam.slam.color_poses import ColorPoses
from ggslam.slam.config import Config
from ggslam.slam.filter_chain import FilterChain
from ggslam.slam.filters.frame_filter import FilterContext
from ggslam.slam.filters.movers import MoverFilter
from ggslam.slam.frame_locator import FrameLocator
from ggslam.slam.frame_poses import FramePoses
from ggslam.slam.joining import Joining
from ggslam.slam.loop_results import Correction
from ggslam.slam.map_corrections import MapCorrections
from ggslam.slam.map_parts import MapParts
from ggslam.slam.map_removal import MapRemoval
from ggslam.slam.modes import modes_of, notes
from ggslam.slam.object_finalizer import ObjectFinalizer
from ggslam.slam.parts import RunParts, check_arguments, make_parts
from ggslam.slam.result import LearnedObjects, SlamTimes, TrackedFrame
from ggslam.slam.schedules import BesideTraining, Schedule
from ggslam.slam.step_log import StepLog
from ggslam.tracking.keyframes import KeyframePolicy
from ggslam.tracking.settings import DepthNoise


class RunState:
    """The parts of a run. `Slam` is the loop that works with them.

    Arguments and errors as of `Slam`.
    """

    scale: float
    _noise: DepthNoise | None
    dropped_frames: list[int]
    refine_iterations: int
    is_rig: ClassVar[bool] = False

    def __init__(
        self, camera: Camera, config: Config | None = None, has_masks: bool | None = None, paging: Path | None = None,
        library: CudaLibrary | None = None, extra_loss: ExtraLoss | None = None,
    ) -> None:  # fmt: skip
        check_arguments(camera, config, extra_loss)
        self.camera = camera
        self.config = config or Config()
        parts = make_parts(camera, self.config, has_masks, paging, library, compact=extra_loss is None)
        self.context, self.masks, self.tracker, self.surface = parts.context, parts.masks, parts.tracker, parts.surface
        self.mapper, self.pager, self.loops = parts.mapper, parts.pager, parts.loops
        self.start_notes = [*parts.notes, *notes(modes_of(self.config, self.is_rig, parts.on_device), self.config)]
        """What the user should know before the first frame: what the settings chose, and what such runs leave out."""
        self.end_notes = list[str]()
        """What errors have kept from the result."""
        self.mapper.extra_loss = extra_loss
        self.policy = KeyframePolicy(self.config.keyframes)
        self.scale = 1.0
        """Size of the scene against a room's, see `geometry.scene_size`."""
        self.poses = FramePoses()
        self.dropped_frames = []
        self.refine_iterations = 0
        """Steps of the final refinement so far."""
        self.times = SlamTimes()
        self.steps = StepLog()
        self.growing = True
        """Whether keyframes are made and the map is trained; off: frames are located in the map as it is."""
        made_of = FilterContext(self.config, self.context)
        self.chains = self._make_filters(made_of)
        """Filters of the frames, by `Frame.camera_number`."""
        self.filters = FilterChain.join(self.chains)
        """All of them, each once."""
        self.movers.detector.source = parts.evidence
        self.locator = self._make_locator(parts)
        self.schedule = Schedule()
        self.joining = Joining[Correction | None]()
        """Of the newest keyframe, where the next frames do not wait for it."""
        if parts.on_device:
            self.schedule = BesideTraining(self.mapper.beside_others(host_waits=False))
            self.use_context_beside_mapping()
        self.locator.before_search = self.catch_up
        self.corrections = MapCorrections(self.surface, self.mapper, self.pager, self.masks)
        self.removal = MapRemoval(self.surface, self.mapper, self.pager, self.corrections.publishing)
        self.parts = MapParts(self.mapper, self.poses, self.corrections, self.loops)
        self.objects = ObjectFinalizer(self.masks)
        self.moves_followed = 0
        """How many corrections of the map the newest tracked pose knows of."""
        self._noise = None

    def _make_filters(self, made_of: FilterContext) -> list[FilterChain]:
        return [FilterChain.make_all(made_of)]

    def _make_locator(self, parts: RunParts) -> FrameLocator:
        return FrameLocator(self.config, parts, self.policy, self.poses, self.filters)

    def load_map(self, gaussians: GaussianMap, keyframes: list[Keyframe], objects: LearnedObjects | None) -> None:
        """Starts in a map made before; `surface` and `loops` hold its keyframes already. The camera counts as lost
        until `loops` finds it.

        Args:
            gaussians: the map.
            keyframes: its keyframes.
            objects: its objects.

        Raises:
            ConfigError: memory is limited, and maps made before are taken whole.
        """
        if self.pager is not None:
            raise ConfigError("memory_limit_mb: cannot be combined with starting in the map of another run (`map`)")
        self.objects.learned, self.poses.keyframes_made = objects, len(keyframes)
        self.mapper.load_map(gaussians, keyframes)
        if objects is None or gaussians.feature_channels != IDENTITY_CHANNELS:
            self.mapper.identity = None
        elif self.mapper.identity is not None:
            self.mapper.identity.resume(objects.classifier)
        assert self.surface.target is not None
        self.tracker.start_lost(self.surface.target)

    @property
    def frames(self) -> list[TrackedFrame]:
        """How each frame so far was tracked."""
        return self.poses.frames

    @property
    def map(self) -> GaussianMap:
        """As trained so far; on the device that it is trained on."""
        return self.mapper.map

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Of the frames, by `Frame.camera_number`."""
        return (self.camera,)

    @property
    def movers(self) -> MoverFilter:
        """Knows what moves."""
        return self.filters.get(MoverFilter)

    @property
    def color_poses(self) -> ColorPoses:
        """Aligns frames to the map by colour."""
        return self.locator.color_poses

    @property
    def gaussian_count(self) -> int:
        """Gaussians of the map, in memory and on disk."""
        return self.mapper.map.count + (0 if self.pager is None else self.pager.on_disk)

    def pose_of(self, frame: TrackedFrame) -> np.ndarray:
        """T_world_camera [4, 4] of a frame that was not lost, as far as is known by now."""
        return self.poses.pose_of(frame, self.mapper.keyframes)

    @property
    def refinement_steps(self) -> int:
        """Optimisation steps that `finish` makes, including those that an interrupted run made."""
        if not self.mapper.keyframes or not self.growing:
            return 0
        asked, before = self.config.refine_iterations, self.mapper.times.iterations - self.refine_iterations
        return asked if asked >= 0 else self.mapper.last_iterations(before)

    def use_context_beside_mapping(self) -> None:
        """The kernels of one context take turns: frames are located with one of their own, beside what the map's does.
        """
        self.tracker.context = NativeContext(self.context.threads, self.context.instruction_set)
        self.filters.use_context(self.tracker.context)

    def end_joining(self) -> None:
        """Waits for the newest keyframe, if it still joins what frames are aligned to; raises what that raised."""
        self.joining.end()

    def give_up_joining(self) -> None:
        """The newest keyframe could not join what frames are aligned to: they see what that is without it."""
        self.corrections.show_target()
        self._complete_keyframes()

    def _complete_keyframes(self) -> None:
        """Where an error has kept keyframes of the map from surface and places, they are there without points and
        features, so that the numbers of keyframes, and corrections of all of them, are the same everywhere."""
        for keyframe in self.mapper.keyframes[len(self.surface) :]:
            self.surface.add_unseen(keyframe.T_world_camera)
        if self.loops is not None:
            for keyframe in self.mapper.keyframes[len(self.loops) :]:
                self.loops.add_unseen(keyframe)

    def settle(self) -> None:
        """What a step has left is done as far as it can be, for the end of a run or after an error: the newest keyframe
        has joined, and everything has followed all corrections. What joining raises is noted, not raised: the error
        that ended the run is known, and the result does not depend on this one."""
        try:
            self.end_joining()
        except Exception as error:
            self.end_notes.append(f"the newest keyframe was not taken over as a whole: {error!r}")
        self._complete_keyframes()
        self.follow_corrections()
        self.poses.leave_missing(self.mapper.keyframes)

    def catch_up(self) -> list[np.ndarray]:
        """The newest keyframe has joined, if it was at it, and everything that knows a pose of the camera has followed;
        what moved it, [4, 4] each."""
        before = self.moves_followed
        if self.joining.is_under_way:
            self.end_joining()
            self.follow_corrections()
        return self.corrections.moves[before : self.moves_followed]

    def follow_corrections(self) -> None:
        """Everything that knows a pose of the camera goes along with corrections of the map made since the last frame.
        """
        published, moves = self.corrections.pending_moves(self.moves_followed)
        self.moves_followed += len(moves)
        for T_new_old in moves:
            for holder in (self.tracker, self.locator, self.filters, self.policy, self.poses):
                holder.move(T_new_old)
        target = self.locator.target(published)
        if target is not None and target is not self.tracker.state.target:
            self.tracker.set_target(target)

    def join_parts(self) -> None:
        """Makes one part of those that the recording fell into, see `MapParts`; when there are no more frames."""
        self.end_joining()
        self.parts.join_parts()

    def close(self) -> None:
        """Removes what is on disk of map and keyframes, for a run that has no result."""
        self.joining.drop()
        if self.pager is not None:
            self.pager.close()
