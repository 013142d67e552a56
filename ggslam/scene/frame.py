# SPDX-License-Identifier: Apache-2.0
"""A frame: one instant of a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from ggslam.errors import InputError
from ggslam.scene.camera import Camera
from ggslam.system.array_forms import ColorImage, DepthImage, Form, Mask, Pose
from ggslam.system.savable import savable


@savable()
@dataclass(frozen=True)
class Frame:
    """One RGB-D image pair with what is known about it.

    Its arrays may be read-only, for a reader may hand out views of what it read: nobody writes into them. What needs
    other pixels makes a new array and a new frame of it (`dataclasses.replace`).

    Attributes:
        index: position in the sequence that it was read from (0, 1, 2, ...); of a slice it counts from 0 again.
        source_index: position in the whole recording, before start/stop/stride and slices.
        timestamp: seconds.
        color: uint8 [H, W, 3], RGB.
        depth: float32 [H, W], metres along the optical axis, 0 where unknown; registered to `color`.
        camera: intrinsics of both images.
        mask: uint16 [H, W] instance ids, 0 = unlabelled; None when the recording has none, or it was not read.
        T_world_camera: float64 [4, 4] true pose if the recording has it. Used for scores only, never for tracking.
        mask_loader: reads the mask on demand; see `load_mask`.
        valid: bool [H, W], False where colour shows nothing (beyond the border of an undistorted image); the same array
            for all frames of a recording; None: all of it shows something.
        moving: bool [H, W], True where something is seen that moves; None: nothing, as far as is known.
        no_return: bool [H, W], True where the sensor says that there is nothing within its range (+inf, REP 117); depth
            is 0 there. None: nowhere, as far as is known.
        depth_delay: seconds after `timestamp`, which is that of colour, at which depth was taken.
        camera_number: of the camera in its rig; 0 without one.
        instant: number of the instant at which the cameras of a rig took their images together; None without a rig.
    """

    index: int
    source_index: int
    timestamp: float
    color: ColorImage
    depth: DepthImage
    camera: Camera
    mask: Annotated[np.ndarray, Form("u2", None, None)] | None = None
    T_world_camera: Pose | None = None
    mask_loader: Callable[[], np.ndarray | None] | None = field(default=None, repr=False, compare=False)
    valid: Mask | None = field(default=None, repr=False, compare=False)
    moving: Mask | None = field(default=None, repr=False, compare=False)
    no_return: Mask | None = field(default=None, repr=False, compare=False)
    depth_delay: float = 0.0
    camera_number: int = 0
    instant: int | None = None

    def __post_init__(self) -> None:
        """Raises InputError for images of another type or size than the attributes say, or a time that is no number."""
        if not isinstance(self.camera, Camera):
            raise InputError(f"camera: expected a Camera, found {type(self.camera).__name__}")
        if isinstance(self.timestamp, bool) or not isinstance(self.timestamp, (int, float, np.number)):
            raise InputError(f"timestamp: expected seconds, found {type(self.timestamp).__name__}")
        size = (self.camera.height, self.camera.width)
        _check_image("color", self.color, np.uint8, (*size, 3))
        _check_image("depth", self.depth, np.float32, size)
        for name, dtype in (("mask", np.uint16), ("valid", np.bool_), ("moving", np.bool_), ("no_return", np.bool_)):
            if getattr(self, name) is not None:
                _check_image(name, getattr(self, name), dtype, size)
        if self.T_world_camera is not None and np.shape(self.T_world_camera) != (4, 4):
            raise InputError(f"T_world_camera: expected [4, 4], found {list(np.shape(self.T_world_camera))}")

    def depth_or_infinity(self) -> np.ndarray:
        """Depth float32 [H, W], metres: 0 where unknown, +inf where the sensor found nothing."""
        return self.depth if self.no_return is None else np.where(self.no_return, np.float32(np.inf), self.depth)

    def load_mask(self) -> np.ndarray | None:
        """The mask; reads it from disk on every call if it did not come with the frame.

        Raises:
            SequenceError: it is damaged.
        """
        if self.mask is not None or self.mask_loader is None:
            return self.mask
        return self.mask_loader()


def _check_image(name: str, image: object, dtype: type, shape: tuple[int, ...]) -> None:
    """Raises InputError unless it is an array of this type and shape, which is that of the camera's images."""
    wanted = f"{name}: expected {np.dtype(dtype).name} {list(shape)}"
    if not isinstance(image, np.ndarray):
        raise InputError(f"{wanted} (numpy), found {type(image).__name__}")
    if image.dtype != dtype or image.shape != shape:
        raise InputError(f"{wanted}, found {image.dtype.name} {list(image.shape)}")
