# SPDX-License-Identifier: Apache-2.0
"""A frame: one instant of a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from ggslam.errors import SequenceError
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
        """Raises SequenceError for images that are no arrays, of another size than the camera's or of another type.
        `frame_checks.check_frame` also looks at the values, when a frame is mapped."""
        if not isinstance(self.camera, Camera):
            raise SequenceError(
                f"frame {self.source_index}: camera is {type(self.camera).__name__}, expected a ggslam.Camera"
            )
        size = (self.camera.height, self.camera.width)
        self._check("colour", self.color, (*size, 3), np.uint8)
        self._check("depth", self.depth, size, np.float32)

    def _check(self, name: str, image: object, shape: tuple[int, ...], kind: type) -> None:
        place = f"frame {self.source_index}: {name}"
        if not isinstance(image, np.ndarray):
            raise SequenceError(f"{place} is {type(image).__name__}, expected a numpy array")
        if image.shape[:2] != shape[:2]:
            found = "x".join(str(n) for n in image.shape[1::-1])
            raise SequenceError(f"{place} is {found}, expected {shape[1]}x{shape[0]}")
        if image.shape != shape or image.dtype != kind:
            found = f"{image.dtype} {list(image.shape)}"
            raise SequenceError(f"{place} is {found}, expected {np.dtype(kind)} {list(shape)}")

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
