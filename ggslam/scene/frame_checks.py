# SPDX-License-Identifier: Apache-2.0
"""Whether a frame is what its recording promised."""

from __future__ import annotations

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame

FARTHEST_SCENE_M = 100.0
"""No depth camera sees farther; a room in millimetres has numbers above it."""


def in_millimetres(depth: np.ndarray) -> bool:
    """Whether a depth image [H, W] that should be in metres can only be in millimetres; looks at every eighth pixel
    and row."""
    return _median(depth) > FARTHEST_SCENE_M


def _median(depth: np.ndarray) -> float:
    """Of the depths that are known, 0 if none is."""
    seen = depth[::8, ::8]
    seen = seen[(seen > 0) & np.isfinite(seen)]
    return float(np.median(seen)) if len(seen) else 0.0


def check_frame(frame: Frame, camera: Camera) -> None:
    """Raises SequenceError unless the frame's images have the camera's size and the types that `Frame` promises."""
    size = (camera.height, camera.width)
    for name, image, shape, kind in (("colour", frame.color, (*size, 3), "u1"), ("depth", frame.depth, size, "f4")):
        if image.shape[:2] != size:
            found = "x".join(str(n) for n in image.shape[1::-1])
            expected = f"{camera.width}x{camera.height}"
            raise SequenceError(f"frame {frame.source_index}: {name} is {found}, expected {expected}")
        if image.shape != shape or image.dtype != np.dtype(kind):
            found = f"{image.dtype} {list(image.shape)}"
            raise SequenceError(
                f"frame {frame.source_index}: {name} is {found}, expected {np.dtype(kind)} {list(shape)}"
            )
    if in_millimetres(frame.depth):
        raise SequenceError(
            f"frame {frame.source_index}: depth looks like millimetres (median {_median(frame.depth):.0f}), expected "
            "metres: divide it by 1000"
        )
    if not (frame.depth >= 0).all() or not np.isfinite(frame.depth).all():
        raise SequenceError(f"frame {frame.source_index}: depth has negative, infinite or NaN values; 0 means none")
