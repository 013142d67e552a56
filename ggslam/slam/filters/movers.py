# SPDX-License-Identifier: Apache-2.0
"""Detects moving things in the frames of a run and keeps them out of tracking, map and places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ggslam.geometry.moved_depth import shift_between
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.movers.detector import DetectorTuning, MoverDetector, coarse_factor, grow
from ggslam.movers.recent import RecentFrame
from ggslam.movers.settings import MoverSettings
from ggslam.movers.tracks import MoverTracks
from ggslam.movers.trail import TrailTuning, gone_since, which_may_be_gone
from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.sequences.moving_pixels import MOVERS_FILE, MovingPixels
from ggslam.sight.margin import Margin
from ggslam.sight.passed_voxels import find_passed_parts
from ggslam.sight.places import CoarseView
from ggslam.slam.filters.frame_filter import FilterContext, FrameFilter, InRigs
from ggslam.slam.filters.keyframe_views import KeyframeViews
from ggslam.slam.map_removal import MapRemoval
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.points import DeferredPoints, FramePoints, PointSource
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

SURE = (TrackingStatus.FIRST, TrackingStatus.OK, TrackingStatus.DEGENERATE)
"""How frames are tracked in which something may be found that did not move before."""


class MoverFilterTuning(Tuning):
    """Search for moving things while a run is made."""

    max_shift_per_s = 3.0
    """Fastest shift of the image, in image widths per second. Beyond it, a rolling shutter warps the image."""
    max_keyframes = 64
    """Latest keyframes that are searched for what has moved since."""


DOUBTFUL = (TrackingStatus.LOST, TrackingStatus.DOUBTED)
"""Where frames are that nothing is said of: their poses may be wrong."""


@savable(not_saved="_reads_masks _noise _margin _views context")
class MoverFilter(FrameFilter):
    """Detects movers in each located frame, if the settings ask for it.

    Args:
        settings: see there.
        reads_masks: whether frames' masks may be asked for.
        context: that evidence is computed in; it may be replaced.
    """

    order = 40
    in_rigs = InRigs.SHARED  # switched off by the settings of a rig: frames of different cameras follow one another
    _before: tuple[float, Pose] | None

    def __init__(self, settings: MoverSettings, reads_masks: bool, context: NativeContext) -> None:
        self.detector = MoverDetector(settings)
        self._reads_masks, self.context = reads_masks, context
        self.pixels = MovingPixels()
        """What was found in the frames so far."""
        self.tracks = MoverTracks()
        """The movers one by one."""
        self._noise: DepthNoise | None = None
        self._margin = _margin(settings, DepthNoise())
        self._views = KeyframeViews()
        self._before = None
        """Time of the frame before, seconds, and T_world_camera; None: it was not located."""

    @classmethod
    def make(cls, made_of: FilterContext) -> MoverFilter:
        """One as the settings want it."""
        config = made_of.config
        return cls(config.movers, config.masks.source in ("auto", "recording"), made_of.context)

    @property
    def active(self) -> bool:
        """Whether anything is looked for."""
        return self.detector.settings.enabled

    @property
    def mask(self) -> np.ndarray | None:
        """What moves in the frame tracked last, bool [H, W]; None: nothing, as far as is known."""
        return self.detector.mask

    def use_context(self, context: NativeContext) -> None:
        """Evidence is computed in the tracker's thread, in this context."""
        self.context = context

    def expects_motion(self) -> bool:
        """Whether something in the frame tracked last moves, or may."""
        return self.detector.found is not None

    def expect(self, frame: Frame) -> Frame:
        """The frame to locate: without depth where something is expected to move."""
        if not self.detector.settings.enabled:
            return frame
        self.detector.prepare(frame, self._margin)
        return frame if self.detector.expected is None else self.detector.expect(frame)

    def judge(
        self, frame: Frame, result: TrackingResult, noise: DepthNoise | None
    ) -> tuple[Frame, TrackingResult]:  # fmt: skip
        """The frame without depth where something moves, which `Frame.moving` tells, and the result without points
        of it."""
        if not self.detector.settings.enabled:
            return frame, result
        result = self._look(frame, result, noise)
        return frame if self.detector.mask is None else self.detector.clean(frame), result

    def _look(self, frame: Frame, result: TrackingResult, noise: DepthNoise | None) -> TrackingResult:
        """Finds what moves in a frame that was located; returns the result without points of it."""
        if noise is not self._noise:
            self._noise, self._margin = noise, _margin(self.detector.settings, noise or DepthNoise())
        known = result.status not in DOUBTFUL
        shown = frame if self._reads_masks else replace(frame, mask=None, mask_loader=None)
        T_world_camera = result.T_world_camera if known else None
        swift = self._is_swift(frame, T_world_camera, result.median_depth_m)
        view = RecentFrame(shown, result.T_world_camera, self._margin)
        sure = result.status in SURE
        self.detector.look(shown, T_world_camera, self._margin, self.context, sure, swift, view.segments)
        if known:
            self.tracks.look(view, self.detector.things)
        else:
            self.tracks.clear()
        mask = self.detector.mask
        if mask is None:
            return result
        self.pixels.add(frame.index, mask)
        return replace(result, points=_without(result.points, mask))

    def _is_swift(self, frame: Frame, T_world_camera: np.ndarray | None, depth_m: float) -> bool:
        """Whether the image shifts so fast since the frame before that shutters warp it."""
        before, self._before = self._before, None if T_world_camera is None else (frame.timestamp, T_world_camera)
        if before is None or T_world_camera is None or not frame.timestamp > before[0]:
            return False
        shift = shift_between(T_world_camera, before[1], frame.camera, depth_m)
        return shift > MoverFilterTuning.max_shift_per_s * frame.camera.width * (frame.timestamp - before[0])

    def after_insertion(self, removal: MapRemoval, newest: Frame) -> None:
        """Removes what was mapped before it began to move, as far as the newest frame, which has just become a
        keyframe, looks through where it was."""
        if not self.has_trail or removal.is_paged:
            return
        keyframes = removal.keyframes[-1 - MoverFilterTuning.max_keyframes :]
        poses = removal.latest_poses(len(keyframes))
        own = [i for i, k in enumerate(keyframes[:-1]) if k.frame_index != FROM_EARLIER_RUN]
        earlier = [keyframes[i] for i in own]
        gone = self.gone_since(earlier, poses[own], newest, poses[-1])
        parts = [(k, part) for k, part in zip(earlier, gone, strict=True) if part is not None]
        if parts:
            removal.drop_moved(parts)

    @property
    def has_trail(self) -> bool:
        """Whether anything was ever found."""
        return self.active and len(self.detector.trail.keys) > 0

    def gone_since(
        self, earlier: Sequence[Keyframe], T_world_earlier: np.ndarray, newest: Frame, T_world_newest: np.ndarray
    ) -> list[np.ndarray | None]:
        """What earlier views show where something has moved since, and the newest frame looks through.

        Args:
            earlier: n keyframes.
            T_world_earlier: [n, 4, 4].
            newest: without what moves in it.
            T_world_newest: [4, 4].

        Returns:
            Of each, bool [H, W]; None: nothing.
        """
        settings, trail, margin = self.detector.settings, self.detector.trail, self._margin
        camera, shape = newest.camera, newest.depth.shape
        alike = [i for i, k in enumerate(earlier) if k.depth.shape == shape]
        if not alike:
            return [None] * len(earlier)
        fitting, poses = [earlier[i] for i in alike], T_world_earlier[alike]
        factor = coarse_factor(camera, settings)
        view = CoarseView.of(newest.depth, camera, factor, T_world_newest, margin, self.context)
        kept = self._views.of(fitting, camera, factor, margin, self.context)
        passed = find_passed_parts(
            kept, poses, view, trail.keys, TrailTuning.voxel_m, TrailTuning.min_in_trail, margin, self.context
        )
        found: dict[int, np.ndarray] = {}
        for i in which_may_be_gone(passed, np.array([k.mask is not None for k in fitting]), settings):
            k, old = fitting[i], replace(kept[i].view, T_world_camera=poses[i])
            part = gone_since(old, passed.evidence(i), trail, k.mask, shape, factor, settings)
            if part is not None:
                found[k.index] = grow(part, DetectorTuning.mask_margin)
        return [found.get(k.index) for k in earlier]

    def notes(self, frames: int) -> list[str]:
        """What the user should know of a run of so many frames."""
        found = len(self.pixels)
        return [f"something moves in {found} of {frames} frames: it is not mapped ({MOVERS_FILE})"] if found else []

    def move(self, T_new_old: np.ndarray) -> None:
        """Follows a correction [4, 4] of the world about the camera."""
        self.detector.move(T_new_old)
        if self._before is not None:
            self._before = self._before[0], T_new_old @ self._before[1]
        self.tracks.move(T_new_old)


def _margin(settings: MoverSettings, noise: DepthNoise) -> Margin:
    """What depths of one surface may differ by."""
    return Margin(settings.margin_m, 0.0, settings.margin_sigmas, noise.constant, noise.square)


def _without(points: PointSource, mask: np.ndarray) -> DeferredPoints:
    """Points of a frame but those on a mask bool [H, W]."""

    def choose() -> FramePoints:
        read = points.read()
        stays = ~mask[read.pixels[:, 1], read.pixels[:, 0]]
        return FramePoints(
            read.points[stays], read.normals[stays], read.covariances[stays], read.pixels[stays], read.weights[stays],
            None if read.depths is None else read.depths[stays],
        )  # fmt: skip

    return DeferredPoints(choose, points.median_depth, points)
