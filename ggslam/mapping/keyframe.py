# SPDX-License-Identifier: Apache-2.0
"""Keyframes: frames that the map is trained on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Final

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.array_archive import ArrayArchive
from ggslam.rendering.exposure import identity_exposure
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp
from ggslam.system.array_forms import ColorImage, Form, IdImage, Mask, MaybeNan, Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning

FROM_EARLIER_RUN: Final = -1
"""Frame index of keyframes that belong to another recording: to the map that the run started from."""
DEPTH_UNIT: Final = 1 / 5000.0
"""Unit of a keyframe's depth in metres: uint16 steps of 0.2 mm (range 13.1 m), the resolution of TUM recordings.
Keyframes that see farther use a multiple, see `depth_unit_for`."""


class DepthRangeTuning(Tuning):
    """Range of the depth that keyframes keep."""

    far_share = 0.02
    """Largest share of pixels beyond the range of a depth unit. They count as errors of an indoor sensor."""


_MOST_UNITS: Final = 65535
"""Largest value of uint16."""
_IMAGES = ("color", "depth", "mask", "moving")


Exposure = Annotated[np.ndarray, Form("f8", 3, 2, finite=True)]


@savable(fixed="color depth mask moving", check="check")
@dataclass
class Keyframe:
    """Images are kept as integers: 8 bytes a pixel less than floats, for every keyframe of a long recording.

    Attributes:
        index: number of the keyframe (0, 1, 2, ...).
        frame_index: index of the frame it was made from, or `FROM_EARLIER_RUN`.
        color: uint8 [H, W, 3].
        depth: uint16 [H, W], units of `depth_unit`, 0 = none.
        T_camera_world: float64 [4, 4], the pose as refined so far.
        exposure: float64 [3, 2], gain and offset per channel applied to the rendered colour.
        mask: uint16 [H, W] or None.
        moving: bool [H, W], what is not of the map because it moved; None: nothing, as far as is known.
    """

    index: int
    frame_index: int
    timestamp: MaybeNan
    camera: Camera
    color: ColorImage
    depth: Annotated[np.ndarray, Form("u2", "h", "w")]
    T_camera_world: Pose
    mask: IdImage | None = field(default_factory=lambda: None)
    exposure: Exposure = field(default_factory=identity_exposure)
    iterations: int = 0
    archive: ArrayArchive | None = None
    """Has the images once they were put away; they are read from there."""
    camera_number: int = 0
    instant: int | None = None
    """Of a rig, see `Frame`."""
    moving: Mask | None = field(default_factory=lambda: None)
    depth_unit: float = DEPTH_UNIT
    """Metres."""

    def check(self) -> None:
        """Raises FormatError if its images are not of its camera: it may come from a file. It may have none."""
        height, width = self.camera.height, self.camera.width
        images = [image for image in (self.color, self.depth, self.mask, self.moving) if image is not None]
        if any(image.size and image.shape[:2] != (height, width) for image in images):
            raise FormatError(f"keyframe {self.index}: its images do not have the size of its camera, {width}x{height}")
        if not self.depth_unit > 0 or self.iterations < 0:
            raise FormatError(f"keyframe {self.index}: {self.iterations} iterations, depth in {self.depth_unit} m")

    def put_away(self, archive: ArrayArchive) -> None:
        """Hands the images to an archive, which keeps them in memory or not. They must not be changed any more."""
        images = {name: image for name in _IMAGES if (image := getattr(self, name)) is not None}
        archive.put(self._name, images)
        self.archive = archive
        for name in images:
            delattr(self, name)

    def __getattr__(self, name: str) -> np.ndarray:
        """Images that were put away; asked only for what the object itself does not have."""
        if name not in _IMAGES or self.archive is None:
            raise AttributeError(name)
        return self.archive.get(self._name)[name]

    @property
    def _name(self) -> str:
        return f"keyframe{self.index:06d}"

    @property
    def T_world_camera(self) -> np.ndarray:
        """The refined pose, camera to world."""
        return inverse(self.T_camera_world)

    def depth_m(self, of: np.ndarray | None = None) -> np.ndarray:
        """Depth in metres, float32 [H, W]; `of`: of a part of the depth image."""
        return (self.depth if of is None else of).astype(np.float32) / np.float32(1 / self.depth_unit)


def make_keyframe(index: int, frame: Frame, T_world_camera: np.ndarray) -> Keyframe:
    """The keyframe of a frame seen from `T_world_camera`."""
    unit = depth_unit_for(frame.depth)
    units = _units_of(frame.depth, unit)
    return Keyframe(
        index, frame.index, frame.timestamp, frame.camera, np.ascontiguousarray(frame.color), units,
        inverse(T_world_camera), frame.mask, camera_number=frame.camera_number, instant=frame.instant,
        moving=frame.moving, depth_unit=unit,
    )  # fmt: skip


def _units_of(depth: np.ndarray, unit: float) -> np.ndarray:
    """Depth, float [H, W] in metres, rounded to units of so many metres, uint16; 0 where it is beyond their range."""
    scaled = depth * np.float32(1 / unit)
    if _is_within(scaled, _MOST_UNITS) and scaled.min(initial=0) >= 0:
        scaled += 0.5
        return scaled.astype(np.uint16)
    beyond = scaled > _MOST_UNITS
    scaled += 0.5
    units = np.clip(scaled, 0, _MOST_UNITS, out=scaled).astype(np.uint16)
    units[beyond] = 0
    return units


def _is_within(depth: np.ndarray, limit: float) -> bool:
    """Whether no depth is known to be beyond a limit: one pass, for nearly all images."""
    return bool(depth.max(initial=0) <= limit)


def depth_unit_for(depth: np.ndarray) -> float:
    """Unit for depth, float [H, W], in metres: `DEPTH_UNIT`, doubled until at most `DepthRangeTuning.far_share` of the
    pixels with depth are beyond its range."""
    unit = DEPTH_UNIT
    if _is_within(depth, _MOST_UNITS * unit):
        return unit
    known = np.count_nonzero(depth > 0)
    while known and np.count_nonzero(depth > _MOST_UNITS * unit) / known > DepthRangeTuning.far_share:
        unit *= 2
    return unit


@savable()
class PoseAdam:
    """Adam on the 6-D twist of one keyframe's pose (left perturbation in the camera frame, translation first)."""

    beta1: float
    beta2: float
    first: Annotated[np.ndarray, Form("f8", 6, finite=True)]
    second: Annotated[np.ndarray, Form("f8", 6, finite=True)]
    steps: int

    def __init__(self, beta1: float = 0.9, beta2: float = 0.99) -> None:
        self.beta1, self.beta2 = beta1, beta2
        self.first, self.second, self.steps = np.zeros(6), np.zeros(6), 0

    def step(self, T_camera_world: np.ndarray, gradient: np.ndarray, rate: float) -> np.ndarray:
        """The pose after one step of size `rate` (metres, radians) down `gradient` [6]."""
        if not np.isfinite(gradient).all():
            return T_camera_world
        self.steps += 1
        self.first += (1 - self.beta1) * (gradient - self.first)
        self.second += (1 - self.beta2) * (gradient**2 - self.second)
        first = self.first / (1 - self.beta1**self.steps)
        second = self.second / (1 - self.beta2**self.steps)
        return se3_exp(-rate * first / (np.sqrt(second) + 1e-15)) @ T_camera_world
