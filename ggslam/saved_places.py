# SPDX-License-Identifier: Apache-2.0
"""`places.npz` in a run folder: what another recording needs to start in the run's map.

The surface that frames are aligned to, the features by which places are found, and for going on with the map which
keyframe each Gaussian came from. `starting.py` reads it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ggslam.scene.arrays import arrays_to_bytes
from ggslam.scene.camera import Camera
from ggslam.tracking.settings import DepthNoise

if TYPE_CHECKING:
    from ggslam.scene.gaussian_map import GaussianMap
    from ggslam.slam import Slam
    from ggslam.submaps.gaussian_cells import GaussianCells

PLACES_FILE = "places.npz"


def places_to_bytes(
    slam: Slam, gaussians: GaussianMap, cells: GaussianCells | None = None
) -> bytes | None:
    """Content of `places.npz`; None if the run looked for no loops and so remembers no places.

    Args:
        slam: the run.
        gaussians: its map, or the part of it that is in memory.
        cells: its map, if that is on disk.
    """
    if slam.loops is None or not len(slam.surface):
        return None
    noise = slam.tracker.noise or DepthNoise()
    parts = [gaussians] if cells is None else (part for _, part in cells.parts())
    arrays = {f"surface_{name}": values for name, values in slam.surface.to_arrays().items()}
    arrays |= {f"loops_{name}": values for name, values in slam.loops.to_arrays().items()}
    arrays |= {
        "camera": _camera_row(slam.camera),
        "noise": np.array([noise.constant, noise.square]),
        "scale": np.array(slam.scale),
        "keyframe_poses": np.stack([k.T_world_camera for k in slam.mapper.keyframes]),
        "birth": np.concatenate([np.zeros(0, np.int32), *(part.birth_keyframe.numpy() for part in parts)]),
    }  # fmt: skip
    return arrays_to_bytes(**arrays)


def _camera_row(camera: Camera) -> np.ndarray:
    return np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy], float)
