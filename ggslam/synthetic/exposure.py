# SPDX-License-Identifier: Apache-2.0
"""Images of a camera that moves while its shutters are open, and between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class ExposureTuning(Tuning):
    """How finely time is sampled."""

    moments = 5
    """Views that an exposure is the mean of."""
    bands = 12
    """Bands of rows that a rolling shutter reads one after the other."""


View = Callable[[Camera, np.ndarray], np.ndarray]
"""An image of a camera at T_world_camera [4, 4]."""


@dataclass(frozen=True)
class Shutter:
    """How the images of a frame lie in time. All are shares of the time between two frames.

    Attributes:
        blur: for which colour is exposed, 0 to 1.
        rolling: between the first row that is read and the last, of colour and of depth, 0 to 1.
        depth_delay: by which depth is later than colour, -0.4 to 0.4.
    """

    blur: float = 0.0
    rolling: float = 0.0
    depth_delay: float = 0.0

    def __post_init__(self) -> None:
        inside = 0 <= self.blur <= 1 and 0 <= self.rolling <= 1 and abs(self.depth_delay) <= 0.4
        if not inside:
            raise ValueError(
                "shutter: expected a blur and a rolling from 0 to 1 and a delay of depth from -0.4 to 0.4, found "
                f"{self.blur:g}, {self.rolling:g} and {self.depth_delay:g}"
            )

    @property
    def is_plain(self) -> bool:
        """Whether every image is of one moment, its frame's."""
        return self == Shutter()

    def color(self, view: View, camera: Camera, poses: np.ndarray, frame: int) -> np.ndarray:
        """Colour uint8 [H, W, 3] of a frame; `poses` T_world_camera [n, 4, 4] of all frames."""
        moments = self.blur * np.linspace(-0.5, 0.5, ExposureTuning.moments if self.blur else 1)

        def expose(part: Camera, offset: float) -> np.ndarray:
            views = [view(part, pose) for pose in poses_at(poses, frame, offset + moments)]
            return np.rint(np.mean(views, 0, np.float32)).astype(np.uint8)

        return self._roll(expose, camera, 0.0)

    def depth(self, view: View, camera: Camera, poses: np.ndarray, frame: int) -> np.ndarray:
        """Depth float32 [H, W], metres, of a frame."""
        return self._sharp(view, camera, poses, frame, self.depth_delay)

    def mask(self, view: View, camera: Camera, poses: np.ndarray, frame: int) -> np.ndarray:
        """Ids uint16 [H, W] in the middle of colour's exposure."""
        return self._sharp(view, camera, poses, frame, 0.0)

    def _sharp(self, view: View, camera: Camera, poses: np.ndarray, frame: int, delay: float) -> np.ndarray:
        def look(part: Camera, offset: float) -> np.ndarray:
            return view(part, poses_at(poses, frame, np.array([offset]))[0])

        return self._roll(look, camera, delay)

    def _roll(self, image: Callable[[Camera, float], np.ndarray], camera: Camera, offset: float) -> np.ndarray:
        """Bands of rows one below the other, each of its own moment about `offset`."""
        edges = np.linspace(0, camera.height, ExposureTuning.bands + 1 if self.rolling else 2).astype(int)
        times = offset + self.rolling * ((edges[:-1] + edges[1:]) / 2 / camera.height - 0.5)
        parts = [
            Camera(camera.width, bottom - top, camera.fx, camera.fy, camera.cx, camera.cy - top)
            for top, bottom in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
        ]
        return np.concatenate([image(part, time) for part, time in zip(parts, times.tolist(), strict=True)])


def poses_at(poses: np.ndarray, frame: int, offsets: np.ndarray) -> np.ndarray:
    """T_world_camera, float64 [k, 4, 4], at moments beside a frame's own.

    Args:
        poses: of all frames, [n, 4, 4].
        frame: which one.
        offsets: of the moments, in times between two frames; beyond -1 to 1 they count as these, [k].
    """
    offsets = np.clip(offsets, -1, 1)
    around = np.clip([frame - 1, frame, frame + 1], 0, len(poses) - 1)
    found = np.tile(np.eye(4), (len(offsets), 1, 1))
    found[:, :3, :3] = Slerp([-1, 0, 1], Rotation.from_matrix(poses[around, :3, :3]))(offsets).as_matrix()
    before, middle, after = poses[around, :3, 3]
    back, forth = np.maximum(-offsets, 0)[:, None], np.maximum(offsets, 0)[:, None]
    found[:, :3, 3] = middle + back * (before - middle) + forth * (after - middle)
    return found
