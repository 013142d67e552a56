# SPDX-License-Identifier: Apache-2.0
"""Poses of frames by colour against the map, where depth errs more than its images show."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.view_alignment import align_view, grey_of
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, orthonormalize, separation
from ggslam.slam.frame_poses import FramePoses
from ggslam.tracking.tracker import TrackerState, TrackingResult, TrackingStatus

UNDECIDED = 32
"""Of so many first frames images are kept in case frames are to be aligned, of later ones once they are."""
KEPT_BYTES = 1 << 26
"""Memory for images of frames that are aligned once more at the end; later frames stay as they were aligned first."""


@dataclass
class ColorPoses:
    """Aligns located frames to the map as it is, and once more to the map as it is at the end.

    Args:
        mapper: whose map it is.
        poses: of the frames so far.
        state: of the tracker, which knows how much noise its images hide.

    Attributes:
        images: of frames that were located: their number among all frames, and grey values uint8 [H, W].
        held_bytes: what they take.
        active: whether frames may be aligned: the map is trained on the CPU, and by the thread that tracks.
    """

    mapper: Mapper
    poses: FramePoses
    state: TrackerState
    images: list[tuple[int, np.ndarray]] = field(default_factory=list)
    held_bytes: int = 0
    active: bool = field(init=False)

    def __post_init__(self) -> None:
        self.active = isinstance(self.mapper, CpuMapper) and self.mapper.settings.view_alignment.enabled

    def align(self, frame: Frame, found: TrackingResult) -> TrackingResult:
        """What the tracker found, with the pose by colour where that is due and does not contradict it."""
        if found.status in (TrackingStatus.LOST, TrackingStatus.FIRST) or not self.active or not self.mapper.keyframes:
            return found
        number = len(self.poses.frames)
        if not self._is_due and number >= UNDECIDED:
            return found
        grey = grey_of(frame.color)
        if self.held_bytes < KEPT_BYTES:
            self.images.append((number, np.rint(255 * grey).astype(np.uint8)))
            self.held_bytes += grey.size
        if not self._is_due:
            return found
        # The map is where its keyframes are by now, the tracker's surface where they were when they came.
        keyframe, T_world_anchor = self.poses.anchor
        T_map_world = self.mapper.keyframes[keyframe].T_world_camera @ inverse(T_world_anchor)
        T = self._pose(grey, T_map_world @ found.T_world_camera, found.median_depth_m)
        return found if T is None else replace(found, T_world_camera=orthonormalize(inverse(T_map_world) @ T))

    def align_again(self) -> None:
        """Aligns the frames that are no keyframes to the map as it is now."""
        if not self.active or not self._is_due:
            return
        frames, keyframes = self.poses.frames, self.mapper.keyframes
        own = {keyframe.frame_index for keyframe in keyframes}
        for number, image in self.images:
            frame = frames[number]
            if frame.frame_index in own:
                continue
            T_world_keyframe = keyframes[frame.keyframe].T_world_camera
            grey = image.astype(np.float32) / 255
            T = self._pose(grey, T_world_keyframe @ frame.T_keyframe_camera, None)
            if T is not None:
                frames[number] = replace(frame, T_keyframe_camera=inverse(T_world_keyframe) @ T)

    @property
    def _is_due(self) -> bool:
        return self.state.residuals.hidden >= self.mapper.settings.view_alignment.hidden_noise

    def _pose(self, grey: np.ndarray, T_world_camera: np.ndarray, median_depth: float | None) -> np.ndarray | None:
        """T_world_camera [4, 4] by colour, from one near by; None if there is none that can be believed."""
        camera, settings = self.state.camera, self.mapper.settings.view_alignment
        T_camera_world = inverse(T_world_camera)
        assert isinstance(self.mapper, CpuMapper)
        view = self.mapper.render_view(camera, T_camera_world)
        depth, alpha = view.expected_depth.numpy(), view.alpha.numpy()
        rendered = grey_of(np.ascontiguousarray(view.image.numpy().clip(0, 1).transpose(1, 2, 0)))
        T = align_view(grey, rendered, depth, alpha, camera, settings)
        if T is None or self.state.noise is None:
            return None
        found = inverse(T @ T_camera_world)
        if median_depth is None:
            median_depth = float(np.median(depth[alpha > 0.5])) if (alpha > 0.5).any() else 1.0
        moved, turned = separation(found, T_world_camera)
        limit = settings.farthest_sigmas * self.state.noise.sigma(median_depth)
        return found if moved <= limit and np.radians(turned) * median_depth <= limit else None
