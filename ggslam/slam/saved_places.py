# SPDX-License-Identifier: Apache-2.0
"""`places.npz` in a run folder: what another recording needs to start in the run's map.

The surface that frames are aligned to, the features by which places are found, and for going on with the map which
keyframe each Gaussian came from. `starting.py` reads it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from ggslam.scene.arrays import arrays_to_bytes
from ggslam.scene.camera import Camera
from ggslam.tracking.settings import DepthNoise

if TYPE_CHECKING:
    from ggslam.scene.gaussian_map import GaussianMap
    from ggslam.slam.loop_closing import LoopCloser
    from ggslam.tracking.surface import MeasuredSurface

PLACES_FILE = "places.npz"
KEYFRAME_CAMERAS = "keyframe_cameras"
"""In places.npz of a run of several cameras: the camera of each keyframe, as the row `camera`."""


def saved_places_to_bytes(
    camera: Camera, surface: MeasuredSurface, loops: LoopCloser, noise: DepthNoise, scale: float,
    keyframe_poses: np.ndarray, parts: Iterable[GaussianMap], keyframe_cameras: Iterable[Camera] | None = None,
) -> bytes:  # fmt: skip
    """Content of `places.npz`.

    Args:
        camera: of the run.
        surface: that its frames were aligned to.
        loops: the features of its keyframes.
        noise: of its depth camera.
        scale: size of the scene against a room's.
        keyframe_poses: T_world_camera, float64 [n, 4, 4].
        parts: its map in the order of map.ply.
        keyframe_cameras: of its keyframes, if they are not all of `camera`.
    """
    arrays = {f"surface_{name}": values for name, values in surface.to_arrays().items()}
    arrays |= {f"loops_{name}": values for name, values in loops.to_arrays().items()}
    arrays |= {
        "camera": camera_row(camera),
        "noise": np.array([noise.constant, noise.square]),
        "scale": np.array(scale),
        "keyframe_poses": keyframe_poses,
        "birth": np.concatenate([np.zeros(0, np.int32), *(part.birth_keyframe.numpy() for part in parts)]),
    }  # fmt: skip
    if keyframe_cameras is not None:
        arrays[KEYFRAME_CAMERAS] = np.stack([camera_row(of_keyframe) for of_keyframe in keyframe_cameras])
    return arrays_to_bytes(**arrays)


def camera_row(camera: Camera) -> np.ndarray:
    """A camera as six numbers: width, height, fx, fy, cx, cy."""
    return np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy], float)
