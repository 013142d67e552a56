# SPDX-License-Identifier: Apache-2.0
"""`places.npz` in a run folder: what another recording needs to start in the run's map.

The surface that frames are aligned to, the features by which places are found, and for going on with the map which
keyframe each Gaussian came from. `starting.py` reads it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
    kept: Sequence[int] = (),
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
        kept: numbers that the keyframes of the run had in `surface` and `loops`, if these have others besides.
    """
    arrays = {f"surface_{name}": values for name, values in surface.to_arrays().items()}
    arrays |= {f"loops_{name}": values for name, values in loops.to_arrays().items()}
    if len(kept) and len(kept) < len(surface):
        arrays = _of_keyframes(arrays, list(kept))
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


def _of_keyframes(arrays: dict[str, np.ndarray], kept: list[int]) -> dict[str, np.ndarray]:
    """What there is of some keyframes, which are numbered anew."""
    out, stays = dict(arrays), np.isin(np.arange(len(arrays["loops_poses"])), kept)
    for group, names in (("surface_", ("points", "normals")), ("loops_places_", ("descriptors", "points"))):
        rows = np.repeat(stays, arrays[group + "counts"])
        out |= {group + name: arrays[group + name][rows] for name in names}
    one_each = ("surface_counts", "surface_reach", "surface_poses", "loops_poses", "loops_median_depths",
                "loops_places_counts", "loops_places_codes")  # fmt: skip
    out |= {name: arrays[name][stays] for name in one_each}
    return out | {"loops_places_numbers": np.arange(len(kept), dtype=np.int32)}


def camera_row(camera: Camera) -> np.ndarray:
    """A camera as six numbers: width, height, fx, fy, cx, cy."""
    return np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy], float)
