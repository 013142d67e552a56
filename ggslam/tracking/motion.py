# SPDX-License-Identifier: Apache-2.0
"""The motion of the camera and its last located frames, as a tracker remembers them."""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import median
from typing import Annotated, Any

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, orthonormalize, separation
from ggslam.system.array_forms import Form, Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.image_turn import image_turn, small_image
from ggslam.tracking.photometric import PhotometricReference
from ggslam.tracking.points import PointSource
from ggslam.tracking.settings import PhotometricSettings, TrackerSettings


class MotionTuning(Tuning):
    """When grey values make a pose doubtful."""

    frames = 6
    """Frames whose grey residuals define the usual one."""
    sudden_factor = 2.0
    """Grey residual that makes a pose doubtful, in multiples of the usual one..."""
    min_sudden = 0.015
    """...if it is above this value, in [0, 1]."""


class SeenFrame:
    """A frame's image at reduced size, see `small_image`; made when it is first asked for.

    Args:
        color: uint8 [H, W, 3]; None: `small` is given.
        small: of the frame.
    """

    def __init__(self, color: np.ndarray | None, small: np.ndarray | None = None) -> None:
        self._color, self._small = color, small

    def small(self) -> np.ndarray:
        """Float32 [h, w]."""
        if self._small is None:
            assert self._color is not None
            self._small, self._color = small_image(self._color), None
        return self._small


@savable(not_saved="reference seen before", save="state", after="forget_images")
@dataclass
class CameraMotion:
    """Pose and motion of the camera.

    Attributes:
        T_world_camera: float64 [4, 4], the last known pose.
        velocity: float64 [4, 4], the last motion from one frame to the next.
        lost: whether the last frame was not located.
        views: the last located frames, the newest first.
        reference_view: an earlier one, not too far away, whose grey values frames are compared with.
        reference: the same, prepared; None: not yet.
        greys: how much grey values of the last located frames differed from the reference, the newest first.
        wary: so many more frames are located as if something near moved.
        small: of the last frame, located or not, see `small_image`; None: there was none. Only in a saved state: a run
            has `seen`.
        turned: float64 [4, 4], by how the image shifted, from the last located frame to the one at hand, once
            `settle_turn` was called.
        seen: the last frame, located or not; None: there was none.
        before: the frame before, and the camera, if `turned` is still to be made; None: it is made.
    """

    T_world_camera: Pose
    velocity: Pose = field(default_factory=lambda: np.eye(4))
    lost: bool = False
    views: list[FeatureView] = field(default_factory=list)
    reference_view: FeatureView | None = None
    reference: PhotometricReference | None = None
    greys: list[float] = field(default_factory=list)
    wary: int = 0
    small: Annotated[np.ndarray, Form("f4", "h", "w")] | None = None
    turned: Pose = field(default_factory=lambda: np.eye(4))
    seen: SeenFrame | None = None
    before: tuple[SeenFrame | None, Camera] | None = None

    def watch(self, color: np.ndarray, camera: Camera) -> None:
        """Sees the next frame's colour uint8 [H, W, 3]."""
        if self.lost:
            self.settle_turn()
        earlier = SeenFrame(None, self.small) if self.seen is None and self.small is not None else self.seen
        turned, self.before = self.turned, (earlier, camera)
        self.seen = SeenFrame(color)
        if self.lost:
            self.turned = turned @ self.settle_turn()

    def settle_turn(self) -> np.ndarray:
        """Makes `turned` of the last two frames, where few ask for it; gives it."""
        if self.before is not None:
            (earlier, camera), self.before, self.turned = self.before, None, np.eye(4)
            if earlier is not None and self.seen is not None:
                before, now = earlier.small(), self.seen.small()
                if before.shape == now.shape:
                    self.turned = image_turn(before, now, camera)
        return self.turned

    def state(self) -> dict[str, Any]:
        """What is saved."""
        self.settle_turn()
        self.small = self.small if self.seen is None else self.seen.small()
        return vars(self)

    def forget_images(self) -> None:
        """The state is that of a file: what images the object saw is not."""
        self.seen = self.before = None

    def predict(self) -> np.ndarray:
        """The next pose [4, 4] at constant velocity; of a lost camera, as the images shifted since it was located."""
        return self.T_world_camera @ (self.turned if self.lost else self.velocity)

    def is_sudden(self, residual: float) -> bool:
        """Whether images that differ by `residual` agree far less than those of the frames before did: something near
        that moves may have taken the pose along."""
        if len(self.greys) < MotionTuning.frames:
            return False
        return residual > max(MotionTuning.sudden_factor * median(self.greys), MotionTuning.min_sudden)

    def note_greys(self, residual: float) -> None:
        """The grey values of a located frame differ by so much from the reference."""
        self.greys = [residual, *self.greys[: MotionTuning.frames - 1]]

    def follow(self, view: FeatureView, T_world_camera: np.ndarray) -> None:
        """A frame was located at `T_world_camera` [4, 4], which becomes its view's pose."""
        self.velocity = np.eye(4) if self.lost else inverse(self.T_world_camera) @ T_world_camera
        self.lost = False
        self.T_world_camera = view.T_world_camera = T_world_camera

    def lose(self) -> None:
        """A frame was not located: the camera stays where it was last known, standing still."""
        self.settle_turn()
        self.velocity, self.lost = np.eye(4), True

    def restart(self, view: FeatureView, T_world_camera: np.ndarray) -> None:
        """The camera was found at `T_world_camera` [4, 4] by other means; the frames remembered are of elsewhere."""
        self.velocity, self.lost = np.eye(4), False
        self.T_world_camera = view.T_world_camera = T_world_camera
        self.views, self.reference_view, self.reference, self.greys = [], None, None, []

    def move(self, T_new_old: np.ndarray) -> None:
        """The world about the camera was moved by a correction [4, 4]."""
        self.T_world_camera = orthonormalize(T_new_old @ self.T_world_camera)
        for view in {id(v): v for v in (*self.views, self.reference_view) if v is not None}.values():
            view.T_world_camera = T_new_old @ view.T_world_camera
        self.reference = None

    def remember(self, view: FeatureView, points: PointSource, settings: TrackerSettings) -> None:
        """Keeps the last located frames for feature matching, and a not too distant one for its grey values. A view
        without depth (of a camera that the others of its rig located) tells nothing of either."""
        some = view.depth[::8, ::8]  # of most views these have depth
        if not (np.logical_or.reduce(some, axis=None) or np.logical_or.reduce(view.depth, axis=None)):
            return
        self.views = [view, *self.views[: settings.recovery.views - 1]]
        if self.reference_view is None or self._is_far(self.reference_view, view, points, settings.photometric):
            self.reference_view, self.reference = view, None

    @staticmethod
    def _is_far(reference: FeatureView, view: FeatureView, points: PointSource, settings: PhotometricSettings) -> bool:
        moved, turned = separation(reference.T_world_camera, view.T_world_camera)
        return moved > settings.renew_translation * points.median_depth or turned > settings.renew_rotation_deg
